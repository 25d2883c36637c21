"""Paths: corrections that change slowly, jumps that are named, commands that start at the row before."""

from __future__ import annotations

from math import radians

import numpy as np
import pytest
import torch
from product_bank import Case
from test_compensate import BOUND, commands, intended, misses, tool_frame
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.compensation.compensate import Pace


def line(case: Case, rows: int, seed: int = 3) -> Tensor:
    """A straight way between two configurations, away from singularities for seed 3."""
    first, last = commands(case, 2, seed) * 0.4
    first[4], last[4] = 0.6, 1.0
    return first + torch.linspace(0, 1, rows, dtype=torch.float64)[:, None] * (last - first)


def through_wrist(case: Case, rows: int) -> Tensor:
    q = line(case, rows)
    q[:, 4] = torch.linspace(-0.2, 0.2, rows, dtype=torch.float64)
    return q


def changes(found: dc.Compensation) -> Tensor:
    return found.correction.diff(dim=0).abs()


def test_a_path_without_jumps_is_that_of_its_rows(arm: Case) -> None:
    q = line(arm, 60)
    targets = intended(arm, q)
    alone = dc.compensate(arm.model, targets, q, tool=tool_frame())
    found = dc.compensate(arm.model, targets, q, tool=tool_frame(), path=True)
    assert bool(alone.reached.all())
    torch.testing.assert_close(found.q, alone.q, rtol=0, atol=0)
    assert found.jumps == ()
    assert float(changes(found).max()) < radians(0.1)


def test_through_a_singularity_the_corrections_stay_slow(arm: Case) -> None:
    q = through_wrist(arm, 81)
    targets = intended(arm, q)
    alone = dc.compensate(arm.model, targets, q, tool=tool_frame())
    rate = radians(0.15)
    assert float(changes(alone).max()) > rate  # there is something to slow down
    with pytest.warns(dc.DiffeoCalibWarning, match=r"corrections of the path jump after [\d, ]+ rows"):
        found = dc.compensate(arm.model, targets, q, tool=tool_frame(), path=True, rate=rate)
    assert float(changes(found).max()) <= rate + 1e-12
    assert float(found.correction.abs().max()) <= BOUND
    assert {row for row in range(1, 81) if float(changes(alone)[row - 1].max()) > rate + 1e-9} == set(found.jumps)
    distance, _ = misses(arm, found.q, targets)
    torch.testing.assert_close(found.miss, distance, rtol=1e-6, atol=1e-12)
    assert float(distance[found.reached].max()) <= 1e-9
    for row, status in enumerate(found.status):
        if status == "rate":
            assert float((found.q - alone.q)[row].abs().max()) > 1e-9
    assert float(distance.max()) < 2e-3
    assert found.counts["reached"] > 40


def test_seconds_instead_of_rows(arm: Case) -> None:
    q = through_wrist(arm, 41)
    targets = intended(arm, q)
    time = torch.linspace(0, 1, 41, dtype=torch.float64) ** 2
    rate = [0.2, 0.2, 0.2, 0.3, 0.2, 0.3]
    with pytest.warns(dc.DiffeoCalibWarning):
        found = dc.compensate(arm.model, targets, q, tool=tool_frame(), path=True, rate=rate, time=time)
    allowed = time.diff()[:, None] * torch.tensor(rate, dtype=torch.float64)
    assert bool((changes(found) <= allowed + 1e-12).all())


def test_the_slowest_change_of_a_jump() -> None:
    """A step is passed half before and half after; rows that miss their targets give way; NaN counts as nothing."""
    pace = Pace(np.arange(9.0), np.array([1.0]))
    step = np.array([0.0] * 4 + [4.0] * 5)[:, None]
    found = pace.limited(step, np.ones(9, dtype=bool))[:, 0]
    np.testing.assert_allclose(found, [0, 0.5, 1, 1.5, 2.5, 3, 3.5, 4, 4])
    spike = np.zeros((9, 1))
    spike[4] = 3.0
    firm = np.arange(9) != 4
    np.testing.assert_allclose(pace.limited(spike, firm)[:, 0], [0, 0, 0, 0, 1, 0, 0, 0, 0])
    spike[4] = np.nan
    kept = pace.limited(spike, firm)[:, 0]
    assert np.isnan(kept[4])
    assert not np.delete(kept, 4).any()


def test_one_start_for_a_whole_path(arm: Case) -> None:
    q = line(arm, 12)
    targets = intended(arm, q)
    found = dc.compensate(arm.model, targets, q[0], tool=tool_frame())
    assert bool(found.reached.all())
    torch.testing.assert_close(found.start[1:], found.q[:-1], rtol=0, atol=0)
    torch.testing.assert_close(found.start[0], q[0], rtol=0, atol=0)
    every = dc.compensate(arm.model, targets, q, tool=tool_frame())
    torch.testing.assert_close(found.q, every.q, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.1}, "`rate` and `time` limit how fast the corrections of a path change"),
        ({"path": True, "rate": -0.1}, "`rate`"),
        ({"path": True, "rate": [0.1, 0.1]}, "`rate` has the wrong shape"),
        ({"path": True, "time": [0.0, 1.0, 1.0]}, "`time`, row 2: expected increasing times, got 1 after 1"),
        ({"path": True, "time": [0.0, 1.0]}, "`time` has the wrong shape"),
    ],
)
def test_wrong_options_of_a_path(arm: Case, options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        dc.compensate(arm.model, torch.zeros(3, 3), torch.zeros(3, 6), **options)  # pyright: ignore[reportArgumentType]
