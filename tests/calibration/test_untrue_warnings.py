"""Rows of an unchanged robot show no change: later batches of a kind, and a model with scales of its own."""

from __future__ import annotations

import warnings
from typing import Any

import batch_bank
import pytest

import diffeo_calib as dc

BATCHES = 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["camera on the tool", "sessions"])
def test_clean_batches_show_no_change(name: str) -> None:
    """Not one at the level of 1 %, and none of these is near it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        model = batch_bank.searched(name)
        for seed in range(BATCHES):
            found: Any = dc.compare(model, batch_bank.batch(name, seed), level=0.02)
            assert not found.changes.found
