"""Wrong labels of rows, of sessions and payloads, are named where rows look wrong for them."""

from __future__ import annotations

import warnings

import pytest
import torch
from reading_bank import scales
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.placing.placement import OtherLabel, label_text
from diffeo_calib.robots import SimulatedArm

ARM, ROWS = SimulatedArm(seed=0), 60


def said(data: dc.Measurements) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dc.calibrate(ARM.nominal, data, hyperparameters=scales())
    return [str(one.message) for one in caught if "look wrong and fit" in str(one.message)]


def measured(payload: Tensor | None = None) -> dc.Measurements:
    return dc.Measurements(*ARM.measure(ROWS, seed=1, payload=payload))


@pytest.mark.slow
def test_a_session_that_begins_earlier_than_said() -> None:
    """Of right sessions nothing is said: tests/calibration/test_sessions.py, where a warning is an error."""
    whole, late = measured(), 3
    points = whole.points.clone()
    points[30:] += torch.tensor([2e-3, -1e-3, 5e-4], dtype=torch.float64)
    names = ["before"] * (30 + late) + ["after"] * (30 - late)
    (text,) = said(dc.Measurements(whole.q, points).with_sessions(names))
    assert "3 rows look wrong and fit session 'after': lines 30, 31, 32" in text


@pytest.mark.parametrize("wrong", [0, 3])
def test_rows_that_carried_another_payload_than_said(wrong: int) -> None:
    masses = torch.tensor([0.0, 5.0, 10.0], dtype=torch.float64)[torch.arange(ROWS) % 3]
    labels = masses.clone()
    labels[2 : 3 * wrong : 3] = 0.0
    texts = said(measured(masses).with_payload(labels))
    assert len(texts) == bool(wrong)
    assert all("fit a payload of 10: lines 2," in text for text in texts)


def test_a_label_must_explain_most_of_the_error_of_two_rows() -> None:
    errors, lines = torch.tensor([1.0, 1.0, 1.0, 0.1]), torch.arange(10, 14)
    wrong, all_rows = torch.tensor([True, True, True, False]), torch.ones(4, dtype=torch.bool)
    better = OtherLabel("b", all_rows, torch.tensor([0.1, 0.2, 0.9, 0.0]))
    worse = OtherLabel("c", all_rows, torch.tensor([0.9, 0.2, 0.9, 0.0]))
    text = label_text(errors, wrong, lines, [worse, better])
    assert text is not None
    assert "2 rows look wrong and fit b: lines 10, 11" in text
    assert label_text(errors, wrong, lines, [worse]) is None
    assert label_text(errors, wrong, lines, [better._replace(applies=lines > 10)]) is None
    assert label_text(errors, wrong, lines, []) is None
