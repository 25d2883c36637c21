"""The measurements in memory: validation, subsets, poses and known noise."""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from table_bank import held, random_poses, says, some
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.poses import LEVER, mark_points, transforms
from diffeo_calib.measurements.table import Measurements

# --- the table ------------------------------------------------------------------------------------


def test_holds_detached_float64_copies() -> None:
    q = torch.tensor([[0.5, 1.0]], dtype=torch.float32, requires_grad=True)
    points = np.array([[1, 2, 3]])
    data = Measurements(q, points, joint_names=["a", "b"], marker_names=["tip"])
    points[0, 0] = 99
    assert data.q.dtype == data.points.dtype == torch.float64
    assert not data.q.requires_grad
    assert_close(data.points, torch.tensor([[[1.0, 2.0, 3.0]]], dtype=torch.float64))
    assert (len(data), data.n, data.markers) == (1, 2, 1)
    assert data.joint_names == ("a", "b")
    assert data.marker_names == ("tip",)
    assert repr(data) == "Measurements(1 row, 2 joints, 1 marker)"
    assert repr(some(4, n=3, markers=2)) == "Measurements(4 rows, 3 joints, 2 markers)"


def test_is_frozen_and_can_be_copied() -> None:
    data = some(3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        data.q = torch.zeros(3, 2)  # pyright: ignore[reportAttributeAccessIssue]
    assert_close(copy.deepcopy(data).points, data.points)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0.0, 0.0]], [[1, 1e300, 3]], ["a", "b"]), ("`points`", "index [0, 1]", "too large", "1e+300")),
        (([[0.0, 1e12]], [[1, 2, 3]], ["a", "b"]), ("`q`", "index [0, 1]", "cannot be measured", "1e+12")),
        (([[0.0, math.nan]], [[1, 2, 3]], ["a", "b"]), ("`q`", "index [0, 1]", "finite", "nan")),
        (([[0.0]], [[[1, 2, 3], [math.nan, math.nan, 6]]]), ("`points`", "row 0, marker 1", "NaN for x, y only")),
        (([[0.0]], [[1, 2, 3]] * 2), ("rows", "expected 1", "got 2")),
        (([0.0, 1.0], [1, 2, 3]), ("`q`", "(N, n)", "(2,)")),
        (([[0.0]], [[1, 2]]), ("`points`", "(N, P, 3) or (N, 3)", "(1, 2)")),
        ((np.empty((0, 2)), np.empty((0, 3))), ("`q`", "at least one row", "(0, 2)")),
        (([[0.0, 1.0], [2.0]], [[1, 2, 3]] * 2), ("`q`", "numbers", "rows of equal length")),
        (([["zero"]], [[1, 2, 3]]), ("`q`", "numbers")),
        (([[0.0, 1.0]], [[1, 2, 3]], ["a", "a"]), ("`joint_names`", "distinct")),
        (([[0.0]], [[1, 2, 3]], None, ["a", "b"]), ("`marker_names`", "expected 1", "got 2")),
    ],
)
def test_wrong_input_is_one_clear_error(arguments: tuple[Any, ...], message: tuple[str, ...]) -> None:
    with pytest.raises(MeasurementError, match=says(*message)):
        Measurements(*arguments)


def test_exact_duplicates_are_reported_not_dropped() -> None:
    q, points = [[0.0], [1.0], [-0.0], [1.0]], [[1, 2, 3], [4, 5, 6], [1, 2, 3], [4, 5, 7]]
    with pytest.warns(DiffeoCalibWarning, match=says("1 of 4 rows", "row 2, of row 0")) as record:
        data = Measurements(q, points)
    assert len(data) == 4
    assert record[0].filename == __file__  # the warning points at the user's line
    assert len(data[[0, 2]]) == 2  # a subset does not warn again


def test_values_like_degrees_cause_a_warning() -> None:
    with pytest.warns(DiffeoCalibWarning, match=says("column 1 ('b')", "90", "degrees")) as record:
        Measurements([[0.0, 90.0]], [[1, 2, 3]], ["a", "b"])
    assert record[0].filename == __file__
    with pytest.warns(DiffeoCalibWarning, match="millimetres of a prismatic joint"):  # kinds not known
        Measurements([[0.0, 250.0]], [[1, 2, 3]])
    Measurements([[0.0, -4 * math.pi]], [[1, 2, 3]])  # two whole turns are plausible


def test_rows() -> None:
    data = some(5)
    for index, expected in [
        (2, [2]),
        (-1, [4]),
        (slice(1, 4, 2), [1, 3]),
        ([3, 0, 3], [3, 0, 3]),
        (np.array([True, False, False, False, True]), [0, 4]),
        (torch.tensor([1, 2]), [1, 2]),
    ]:
        part = data[index]
        assert_close(part.q, data.q[expected])
        assert_close(part.points, data.points[expected])
        assert_close(data.rows(index).q, part.q)
    assert [len(row) for row in data] == [1] * 5
    for empty in ([], slice(0, 0), [False] * 5):
        with pytest.raises(MeasurementError, match="no row"):
            data[empty]
    for outside in (5, [0, 9], [True, False]):
        with pytest.raises(IndexError):
            data[outside]


# --- poses and known noise ------------------------------------------------------------------------


def some_poses(rows: int, **options: Any) -> Measurements:
    q = np.random.default_rng(1).uniform(-3, 3, (rows, 2))
    return Measurements.from_poses(q, random_poses(rows), ["a", "b"], **options)


def test_poses_are_held_with_the_points_that_represent_them() -> None:
    poses = random_poses(5)
    data = some_poses(5, lever=0.2)
    poses_given = held(data.poses)
    assert_close(poses_given, poses, rtol=0, atol=1e-15)
    assert_close(data.points, mark_points(poses, 0.2), rtol=0, atol=1e-15)
    assert (len(data), data.n, data.markers, data.lever) == (5, 2, 3, 0.2)
    assert data.joint_names == ("a", "b")
    assert data.marker_names is None
    assert data.std is data.rotation_std is data.covariance is None
    assert repr(data) == "Measurements(5 rows, 2 joints, poses)"
    assert some_poses(2).lever == LEVER


@pytest.mark.parametrize("shape", [(), (4,), (4, 2), (4, 2, 3)])
def test_known_noise_of_points_is_diagonal(shape: tuple[int, ...]) -> None:
    std = np.random.default_rng(0).uniform(1e-5, 1e-4, shape)
    q, points = some(4, markers=2).q, some(4, markers=2).points
    data = Measurements(q, points, std=std)
    expected = np.broadcast_to(std.reshape(shape + (1,) * (3 - len(shape))), (4, 2, 3))
    np.testing.assert_array_equal(held(data.std).numpy(), expected)
    assert_close(held(data.covariance), torch.diag_embed(torch.from_numpy(expected.reshape(4, 6).copy()) ** 2))


@pytest.mark.parametrize("shape", [(), (5,), (5, 3)])
@pytest.mark.parametrize("given", ["both", "position", "rotation"])
def test_known_noise_of_poses_is_that_of_their_points(shape: tuple[int, ...], given: str) -> None:
    """The points' derivatives by differences of the pose, times the known variances."""
    rng, lever, h = np.random.default_rng(0), 0.15, 1e-6
    position, turn = rng.uniform(1e-5, 1e-4, shape), rng.uniform(1e-5, 1e-4, shape)
    options = {"position_std": position} if given != "rotation" else {}
    options |= {"rotation_std": turn} if given != "position" else {}
    data, poses = some_poses(5, lever=lever, **options), random_poses(5)
    covariance = held(data.covariance)
    assert covariance.shape == (5, 9, 9)
    ranks = torch.linalg.matrix_rank(covariance, rtol=1e-9)
    assert ranks.tolist() == [6 if given == "both" else 3] * 5
    wide = [np.broadcast_to(std.reshape(shape + (1,) * (2 - len(shape))), (5, 3)) for std in (position, turn)]
    expected = torch.zeros(5, 9, 9, dtype=torch.float64)
    for axis in range(6):
        if given == ("rotation", "position")[axis // 3]:
            continue
        step = np.zeros(6)
        step[axis] = h
        R = torch.from_numpy(Rotation.from_rotvec(step[3:]).as_matrix())
        moved = transforms(R @ poses[:, :3, :3], poses[:, :3, 3] + torch.from_numpy(step[:3]))
        column = ((mark_points(moved, lever) - mark_points(poses, lever)) / h).flatten(1)
        variance = torch.from_numpy(wide[axis // 3][:, axis % 3].copy() ** 2)
        expected += variance[:, None, None] * column[:, :, None] * column[:, None, :]
    assert_close(covariance, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def everything(data: Measurements) -> dict[str, Tensor]:
    names = ("q", "points", "poses", "std", "rotation_std", "covariance")
    return {name: getattr(data, name) for name in names if getattr(data, name) is not None}


@pytest.mark.parametrize("kind", ["points", "poses"])
def test_parts_carry_poses_and_known_noise(kind: str) -> None:
    rng = np.random.default_rng(0)
    if kind == "poses":
        std, turn = rng.uniform(1, 2, (12, 3)), rng.uniform(1, 2, (12, 3))
        data = some_poses(12, lever=0.3, position_std=std, rotation_std=turn)
    else:
        data = some(12, markers=2)
        data = Measurements(data.q, data.points, ["a", "b"], ["m", "n"], std=rng.uniform(1, 2, (12, 2, 3)))
    whole = everything(data)
    assert len(whole) == (6 if kind == "poses" else 4)
    for part in (data[3:7], data[[5, 1]], *data.split(0.6), *data.folds(3)[1], next(iter(data)), copy.deepcopy(data)):
        rows = [int((data.q == q).all(1).nonzero()[0, 0]) for q in part.q]
        for name, values in everything(part).items():
            assert_close(values, whole[name][rows], rtol=0, atol=0)
        assert (set(everything(part)), part.lever, part.joint_names) == (set(whole), data.lever, data.joint_names)
        assert part.marker_names == data.marker_names
    renamed = data.with_joint_names(["c", "d"])
    assert (renamed.joint_names, data.joint_names) == (("c", "d"), ("a", "b"))
    assert everything(renamed).keys() == whole.keys()
    with pytest.raises(MeasurementError, match=says("`names`", "expected 2", "got 1")):
        data.with_joint_names(["c"])


def test_repeated_poses_are_found() -> None:
    poses, q = random_poses(3)[[0, 1, 0]], [[0.0], [1.0], [0.0]]
    with pytest.warns(DiffeoCalibWarning, match=says("1 of 3 rows", "row 2, of row 0")) as record:
        data = Measurements.from_poses(q, poses)
    assert record[0].filename == __file__
    assert data.copies() == [(0, 2)]
    assert data.groups().tolist() == [0, 1, 0]
    poses[2, :3, :3] = poses[1, :3, :3]  # the same place, turned
    assert Measurements.from_poses(q, poses).copies() == []
    with pytest.warns(DiffeoCalibWarning, match="degrees"):
        Measurements.from_poses([[90.0]], poses[:1])


STRETCHED = torch.diag_embed(torch.tensor([2.0, 1.0, 1.0, 1.0])).double()


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (torch.stack([*random_poses(2), STRETCHED]), {}, ("`poses`, row 2", "rotation matrix")),
        (random_poses(2), {}, ("`q` and `poses`", "expected 3", "got 2")),
        (random_poses(3), {"lever": 0}, ("`lever`", "above 0", "got 0")),
        (random_poses(3), {"position_std": -1e-5}, ("`position_std`:", "positive", "got -1e-05", "leave it out")),
        (random_poses(3), {"rotation_std": [1, 0, 1]}, ("`rotation_std`, first at index [1]", "got 0")),
        (random_poses(3), {"position_std": [[1, 1]] * 3}, ("`position_std`", "(3, 3)", "got (3, 2)")),
        (random_poses(3), {"position_std": [1, math.nan, 1]}, ("`position_std`", "index [1]", "nan")),
        (random_poses(3), {"joint_names": ["a", "b"]}, ("`joint_names`", "expected 1", "got 2")),
    ],
)
def test_wrong_poses_are_one_clear_error(poses: Any, options: dict[str, Any], message: tuple[str, ...]) -> None:
    with pytest.raises(MeasurementError, match=says(*message)):
        Measurements.from_poses([[0.0], [1.0], [2.0]], poses, **options)


@pytest.mark.parametrize(
    ("std", "message"),
    [
        (0.0, ("`std`:", "positive", "got 0")),
        ([1e-5, -1e-5], ("`std`, first at index [1]", "positive", "got -1e-05")),
        ([1e-5] * 3, ("`std`", "() or (2,) or (2, 1) or (2, 1, 3)", "got (3,)")),
        (math.inf, ("`std`", "finite")),
    ],
)
def test_wrong_known_noise_is_one_clear_error(std: Any, message: tuple[str, ...]) -> None:
    with pytest.raises(MeasurementError, match=says(*message)):
        Measurements([[0.0], [1.0]], [[1, 2, 3], [4, 5, 6]], std=std)
