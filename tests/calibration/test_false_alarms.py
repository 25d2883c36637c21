"""Rows of an unchanged robot show no change: later batches of a kind, and a model with scales of its own."""

from __future__ import annotations

import warnings
from typing import Any

import batch_bank
import pytest

import diffeo_calib as dc

BATCHES = 6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["camera on the tool", "poses", "sessions"])
def test_clean_batches_show_no_change(name: str) -> None:
    """At a level of 1 % two alarms among six have a probability of 0.0015."""
    alarms = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        model = batch_bank.searched(name)
        for seed in range(BATCHES):
            found: Any = dc.compare(model, batch_bank.batch(name, seed))
            alarms += bool(found.changes.found)
    assert alarms < 2
