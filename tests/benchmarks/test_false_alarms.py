"""Clean tables of positions, as people make them, are not refused, and nothing untrue is said of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import clean_campaigns
import false_alarms
import pytest
import torch

TABLES = 13, *(pytest.param(number, marks=pytest.mark.slow) for number in (26, 108))


@pytest.mark.parametrize("number", TABLES)
def test_a_clean_table(number: int) -> None:
    found = false_alarms.judged(number)
    assert not found["refused"], found["texts"]
    assert not found["untrue"], found["texts"]


def test_a_mistake_is_an_untrue_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """The device was moved, and the corpus does not know it."""
    honest = clean_campaigns.campaign

    def moved(of: Any, folder: Path) -> Any:
        made = honest(replace(of, rows=60, noise_mm=0.02, off_mm=0.3), folder)
        shift = torch.zeros(60, 1, 3, dtype=torch.float64)
        shift[30:] = 0.003
        return replace(made, data=made.data.shifted(shift))

    monkeypatch.setattr(false_alarms, "campaign", moved)
    assert "something moved" in str(false_alarms.judged(22)["untrue"])
