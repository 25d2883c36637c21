"""Campaigns in several set-ups of the measuring device: found, fitted, saved, and as accurate as in one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from product_bank import with_usual_scales
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation

pytestmark = pytest.mark.slow  # several calibrations

ROWS, NAMES = 105, ("Monday", "Tuesday", "Friday")


def frames(seed: int = 0) -> Tensor:
    """From the frame of the first session to each one: some millimetres and milliradians about the workspace."""
    rng = np.random.default_rng(seed)
    found = torch.eye(4, dtype=torch.float64).repeat(len(NAMES), 1, 1)
    for T in found[1:]:
        T[:3, :3] = rotation(torch.from_numpy(1e-3 * rng.standard_normal(3)))
        T[:3, 3] = torch.from_numpy(5e-3 * rng.standard_normal(3))
    return found


@pytest.fixture(scope="module")
def arm() -> SimulatedArm:
    return SimulatedArm(seed=5, markers=2)


def campaign(arm: SimulatedArm, *, shuffled: bool, moved: bool = True) -> dc.Measurements:
    """Rows of three sessions."""
    q, points = arm.measure(ROWS, seed=1)
    numbers = torch.arange(ROWS) * len(NAMES) // ROWS
    T = frames()[numbers] if moved else torch.eye(4, dtype=torch.float64).expand(ROWS, 4, 4)
    points = points @ T[:, :3, :3].mT + T[:, None, :3, 3]
    order = torch.from_numpy(np.random.default_rng(2).permutation(ROWS)) if shuffled else torch.arange(ROWS)
    data = dc.Measurements(q[order], points[order], arm.nominal.joint_names)
    return data.with_sessions([NAMES[number] for number in numbers[order].tolist()])


@pytest.fixture(scope="module")
def result(arm: SimulatedArm) -> Any:
    return with_usual_scales(arm.nominal, campaign(arm, shuffled=True))


def test_the_frames_are_found(result: Any) -> None:
    sessions = result.sessions
    truth = torch.stack([frames()[NAMES.index(name)] for name in sessions.names])
    expected = truth @ torch.linalg.inv(truth[sessions.reference])
    centre = torch.tensor([0.0, 0.0, 0.5, 1.0], dtype=torch.float64)
    assert_close(sessions.transforms[:, :3, :3], expected[:, :3, :3], rtol=0, atol=1e-4)
    assert_close(sessions.transforms @ centre, expected @ centre, rtol=0, atol=3e-4)
    assert len(sessions.sentences()) == len(NAMES) - 1


def test_new_rows_of_a_session_are_brought_into_the_model_frame(arm: SimulatedArm, result: Any) -> None:
    q, T = arm.sample(50, seed=8), frames()[1]
    seen = dc.Measurements(q, arm.true_points(q) @ T[:3, :3].mT + T[:3, 3], arm.nominal.joint_names)
    aligned = result.aligned(seen.with_sessions(["Tuesday"] * 50))
    assert dc.evaluate(result.model, aligned).rms < 2e-4
    with pytest.raises(MeasurementError, match=r"the sessions \['Sunday'\]: expected some of .*; register the model"):
        result.aligned(seen.with_sessions(["Sunday"] * 50))


def test_rows_of_several_set_ups_are_not_compared_with_a_model(arm: SimulatedArm, result: Any, tmp_path: Path) -> None:
    q, points = arm.measure(6, seed=9)
    data = dc.Measurements(q, points, arm.nominal.joint_names).with_sessions(["a", "b"] * 3)
    for judge in (dc.evaluate, lambda model, rows: dc.write_report(model, tmp_path / "page.html", rows)):
        with pytest.raises(MeasurementError, match=r"session 'a': expected 4 rows, got 'a' in 3 rows"):
            judge(result.model, data)
    whole = campaign(arm, shuffled=False)
    refused(
        (r"session 'a': expected 4 rows, got 'a' in 3 rows", lambda: dc.evaluate(result.model, data.rows([0, 2, 4]))),
        (
            "session 'b': expected 4 rows, got 'b' in 3 rows",
            lambda: dc.calibrate(arm.nominal, whole.with_sessions(["a"] * (ROWS - 3) + ["b"] * 3)),
        ),
        (r"the names of sessions: expected 6 names", lambda: data.with_sessions(["a", "b"])),
        (r"the names of sessions: expected 6 names", lambda: data.with_sessions(torch.zeros(6, device="meta"))),
        (r"the names of sessions: 1 row\(s\)", lambda: data.with_sessions(["a", " ", "b", "b", "a", "a"])),
    )
