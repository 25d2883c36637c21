"""Errors of kinematics against NumPy, in position and orientation, and warnings about calibrated models."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from kind_bank import kind_named, marked
from product_bank import Case
from table_bank import random_poses, refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.kinematics.evaluation import (
    joints_outside_range,
    refuse_other_angles,
    rows_used_in_fit,
    warn_outside_range,
)
from diffeo_calib.measurements.poses import mark_points, rotation_matrices, transforms
from diffeo_calib.measurements.rows import with_attributes


def moved(poses: Tensor, shifts: np.ndarray, vectors: np.ndarray) -> Tensor:
    """Poses with errors: shifts in m, turns in rad."""
    rotations = rotation_matrices(vectors, "rotvec") @ poses[:, :3, :3]
    return transforms(rotations, poses[:, :3, 3] + torch.from_numpy(shifts))


@pytest.mark.parametrize("lever", [0.02, 1.5])
@pytest.mark.parametrize(("rows", "size"), [(1, 1e-9), (200, 1e-2)])
def test_errors_of_poses_are_distances_of_origins_and_angles(rows: int, size: float, lever: float) -> None:
    """The lever changes neither, although it moves the points; tiny errors are not lost."""
    rng = np.random.default_rng(rows)
    poses = random_poses(rows, seed=1)
    shifts, vectors = 0.1 * size * rng.normal(size=(rows, 3)), size * rng.normal(size=(rows, 3))
    data = dc.Measurements.from_poses(rng.normal(size=(rows, 2)), poses, lever=lever)
    found: Any = dc.evaluate(lambda _: mark_points(moved(poses, shifts, vectors), lever), data)
    distances, degrees = np.linalg.norm(shifts, axis=1), np.degrees(np.linalg.norm(vectors, axis=1))
    np.testing.assert_allclose(found.errors.numpy(), distances[:, None], rtol=1e-6, atol=1e-15)
    assert found.angles is not None
    np.testing.assert_allclose(found.angles.numpy(), np.radians(degrees), rtol=1e-6, atol=1e-15)
    for judged, values, floor in ((found, distances, 1e-15), (found.orientation, degrees, 1e-13)):
        assert judged.rms == pytest.approx(float(np.sqrt(np.mean(values**2))), rel=1e-6, abs=floor)
        shares = ((judged.median, 0.5), (judged.p95, 0.95), (judged.max, 1.0), (judged.quantile(0.25), 0.25))
        for value, share in shares:
            assert value == pytest.approx(float(np.quantile(values, share)), rel=1e-6, abs=floor)
    assert found.mean == pytest.approx(float(np.mean(distances)), rel=1e-6, abs=1e-15)


def test_predictions_that_do_not_fit_the_rows(posed: Case, arm: Case) -> None:
    two = dc.Measurements(arm.test.q, arm.test.points.repeat(1, 2, 1))
    points = dc.Measurements(posed.test.q, posed.test.points)  # three markers, as far as shapes go
    shape = r"not have the same markers: expected predictions of shape \(300, 2, 3\), got \(300, 1, 3\); evaluate on"
    expected = "calibrated with poses: expected measured poses, got points; name the"
    line, nan = "row 0: the points of the pose lie on one line", [[0.0] * 5 + [math.nan]]
    refused(
        (shape, lambda: dc.evaluate(arm.model, two)),
        (expected, lambda: dc.evaluate(posed.model, points)),
        ("with points: expected measured points, got poses; leave", lambda: dc.evaluate(arm.model, posed.test)),
        (line, lambda: dc.evaluate(lambda q: q.new_zeros(len(q), 3, 3), posed.test)),
        (r"`q`.*\(N, 6\)", lambda: rows_used_in_fit(arm.model, arm.test.q[:, :5])),
        (r"`q` has 1 value\(s\) that are not finite", lambda: joints_outside_range(arm.model, nan)),
    )


def test_rows_of_the_fit_are_recognised_up_to_rounding(arm: Case) -> None:
    fitted, others = arm.train.q, arm.test.q
    mixed = torch.cat([others[:2], fitted[5:8] + 1e-10, fitted[5:6] + 1e-8])
    assert rows_used_in_fit(arm.model, mixed).tolist() == [False, False, True, True, True, False]
    many = torch.cat([fitted.repeat(20, 1), others])
    expected = torch.arange(len(many)) < 20 * len(fitted)
    assert torch.equal(rows_used_in_fit(arm.model, many.tolist()), expected)
    assert rows_used_in_fit(arm.model, others[:0]).shape == (0,)


def test_joints_outside_the_range_of_the_fit(arm: Case) -> None:
    """A quarter of the range of each joint is allowed on both sides; that of a wide one is then a whole turn."""
    low, high = arm.train.q.amin(0), arm.train.q.amax(0)
    for joint in range(6):
        step = (high - low)[joint] * torch.eye(6, dtype=torch.float64)[joint]
        q = torch.stack([low - 0.24 * step, low - 0.26 * step, high + 0.24 * step, high + 0.26 * step])
        expected = torch.zeros(4, 6, dtype=torch.bool)
        expected[[1, 3], joint] = bool(1.52 * step.sum() < 2 * math.pi)
        assert torch.equal(joints_outside_range(arm.model, q), expected)
    assert not joints_outside_range(arm.model, arm.train.q).any()
    assert not joints_outside_range(arm.model, arm.train.q % (2 * math.pi)).any()  # as joints that count from 0 to 360


def test_rows_outside_the_range_are_a_warning(arm: Case) -> None:
    warn_outside_range(arm.model, arm.train.q)  # no warning, and warnings are errors here
    q = arm.train.q[:5].clone()
    q[1:3, 0] += 20.0
    q[4, 3] -= 20.0
    first, _, _, fourth, *_ = arm.robot.joint_names
    message = rf"^3 of 5 rows are outside the joint range of the fit \({first}, {fourth}\); trust them less than"
    with pytest.warns(dc.DiffeoCalibWarning, match=message) as record:
        warn_outside_range(arm.model, q)
    assert record[0].filename == __file__


def in_other_unit(rows: Any, factor: float) -> Any:
    if isinstance(rows, dc.Observations):
        return dc.Observations([in_other_unit(part, factor) for part in rows.parts], rows.index)
    return with_attributes(rows, q=factor * rows.q)


@pytest.mark.parametrize(("factor", "unit"), [(math.pi / 180, "radians"), (180 / math.pi, "degrees")])
@pytest.mark.parametrize("name", marked("ball in sockets", "positions", "heights"))
def test_rows_in_another_unit_of_angles_are_named(name: str, factor: float, unit: str) -> None:
    """Refused; small values of some joints lie in the ranges of the fit, too, and are warned of."""
    kind = kind_named(name)
    words = f"the joint values seem to be {unit}.*check the angle unit"
    for verb in (dc.evaluate, dc.CalibratedKinematics.registered, dc.recalibrate, dc.compare):
        with pytest.raises((MeasurementError, dc.DiffeoCalibWarning), match=words):
            verb(kind.model, in_other_unit(kind.new, factor))


def test_what_is_not_taken_for_another_unit(arm: Case) -> None:
    """Small motions; rows of another region, all of them outside the joint ranges of the fit and in them over 57."""
    q = arm.test.q.clone()
    low, high = arm.train.q[:, 1].amin(), arm.train.q[:, 1].amax()
    q[:, 1] = 0.5 * (low + high) + math.pi  # on the other side of the axis, whatever turns it has made
    near = arm.train.q.mean(0) + 1e-4 * (arm.train.q - arm.train.q.mean(0))
    for rows in (q, near, near[:1], arm.train.q, arm.train.q[:0]):
        refuse_other_angles(arm.model, rows)


MISTAKES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "seem to be radians that were converted": lambda q: q * math.pi / 180,
    "seem to be degrees": lambda q: q * 180 / math.pi,
    "with joints=.waist_joint,elbow_joint,shoulder_joint,forearm_roll_joint,": lambda q: q[:, [0, 2, 1, 3, 4, 5]],
}


@pytest.mark.parametrize("words", MISTAKES)
@pytest.mark.filterwarnings("ignore:no distance between sockets", "ignore:shoulder_joint. hardly moved")
def test_rows_in_sockets_with_wrong_joint_values_are_refused(words: str) -> None:
    kind = kind_named("ball in sockets")
    data = with_attributes(kind.data, distances=())
    with pytest.raises(MeasurementError, match=words):
        dc.calibrate(kind.robot, with_attributes(data, q=MISTAKES[words](data.q)), hyperparameters=kind.scales)
