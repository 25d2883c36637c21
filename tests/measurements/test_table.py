"""The measurements in memory: validation, subsets, poses and known noise; repeats, splits and folds."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from table_bank import held, random_poses, says, some
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.poses import mark_jacobian, mark_points
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import FEWEST_PER_DEVICE, REPEAT_TOLERANCE
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import LEVER

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
    position, turn = (np.random.default_rng(seed).uniform(1e-5, 1e-4, shape) for seed in (0, 1))
    options = {"position_std": position} if given != "rotation" else {}
    options |= {"rotation_std": turn} if given != "position" else {}
    wide = [np.broadcast_to(std.reshape(shape + (1,) * (2 - len(shape))), (5, 3)) for std in (position, turn)]
    known = [
        own if f"{name}_std" in options else 0 * own for name, own in zip(("position", "rotation"), wide, strict=True)
    ]
    factor = mark_jacobian(random_poses(5), 0.15) * torch.from_numpy(np.concatenate(known, 1))[:, None]
    covariance = held(some_poses(5, lever=0.15, **options).covariance)
    assert_close(covariance, factor @ factor.mT, rtol=1e-9, atol=1e-18)
    ranks = torch.linalg.matrix_rank(covariance, rtol=1e-9)
    assert ranks.tolist() == [6 if given == "both" else 3] * 5


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


LAST_PLACE = torch.arange(48).view(3, 4, 4) == 19
STRETCHED = torch.diag_embed(torch.tensor([2.0, 1.0, 1.0, 1.0])).double()


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (torch.stack([*random_poses(2), STRETCHED]), {}, ("`poses`, row 2", "rotation matrix")),
        (random_poses(3)[:, :3], {}, ("`poses`", "(N, 4, 4)", "(3, 3, 4)")),
        (random_poses(3).mT, {}, ("`poses`, row 0", "last row", "transpose")),
        (random_poses(3).masked_fill(LAST_PLACE, math.nan), {}, ("`poses`", "index [1, 0, 3]")),
        (random_poses(3) * torch.tensor([1.0, -1.0, 1.0, 1.0])[:, None], {}, ("`poses`, row 0", "mirrored")),
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


def test_groups_gather_around_their_first_row_and_do_not_chain() -> None:
    step = 0.9 * REPEAT_TOLERANCE
    q = [[2.0, 0.0], [0.0, 0.0], [step, -step], [2 * step, 0.0], [2.0, 1.1 * REPEAT_TOLERANCE]]
    data = Measurements(q, np.arange(15.0).reshape(5, 3))
    assert data.groups().tolist() == [0, 1, 1, 2, 3]
    assert data.groups(tolerance=0.5 * step).tolist() == [0, 1, 2, 3, 4]
    assert data.groups().dtype == torch.int64


@st.composite
def repeated_measurements(draw: st.DrawFn) -> Measurements:
    """Between 2 and 8 configurations, each measured 1 to 6 times with some jitter, in random order."""
    sizes = draw(st.lists(st.integers(1, 6), min_size=2, max_size=8))
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))
    label = rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    q = np.stack([label * 0.5, label % 3], axis=1) + rng.uniform(-4e-4, 4e-4, (len(label), 2))
    points = np.stack([np.arange(len(label)), label, 0 * label], axis=1)  # x: the row, y: its group
    return Measurements(q, points)


def identity(data: Measurements) -> list[int]:
    return data.points[:, 0, 0].int().tolist()


def configuration(data: Measurements) -> list[int]:
    return data.points[:, 0, 1].int().tolist()


@given(repeated_measurements(), st.floats(0.05, 0.95), st.integers(0, 5))
def test_split_is_complete_disjoint_and_cuts_no_group(data: Measurements, fraction: float, seed: int) -> None:
    train, test = data.split(fraction, seed)
    assert sorted(identity(train) + identity(test)) == list(range(len(data)))
    assert identity(train) == sorted(identity(train))
    assert not set(configuration(train)) & set(configuration(test))
    assert len(train) > 0
    assert len(test) > 0
    largest = int(torch.bincount(data.groups()).max())
    assert abs(len(train) - round(fraction * len(data))) <= largest
    assert identity(data.split(fraction, seed)[0]) == identity(train)


@given(repeated_measurements(), st.integers(2, 4), st.integers(0, 5))
def test_folds_cover_every_row_once_and_cut_no_group(data: Measurements, k: int, seed: int) -> None:
    distinct = len(set(configuration(data)))
    if distinct < k:
        with pytest.raises(MeasurementError, match=says(f"{k} folds", f"got {distinct}")):
            data.folds(k, seed)
        return
    folds = data.folds(k, seed)
    assert len(folds) == k
    assert sorted(row for _, test in folds for row in identity(test)) == list(range(len(data)))
    for train, test in folds:
        assert sorted(identity(train) + identity(test)) == list(range(len(data)))
        assert not set(configuration(train)) & set(configuration(test))
    sizes = [len(test) for _, test in folds]
    assert max(sizes) - min(sizes) <= int(torch.bincount(data.groups()).max())


def test_split_without_repeats_is_exact_and_depends_on_the_seed() -> None:
    data = some(100)
    first, second = data.split(0.7, seed=0)[0], data.split(0.7, seed=1)[0]
    assert len(first) == len(second) == 70
    assert not torch.equal(first.q, second.q)
    assert [len(test) for _, test in data.folds(4)] == [25] * 4


@pytest.mark.parametrize("seed", range(5))
def test_a_device_keeps_the_rows_that_place_it(seed: int) -> None:
    data = some(60).with_sessions(["few"] * 10 + ["many"] * 50)
    train, test = data.split(0.7, seed)
    assert train.device_names.count("few") >= FEWEST_PER_DEVICE
    assert test.device_names.count("few") <= 2
    lone = some(10).with_sessions(["few"] * 10)
    assert len(lone.split(0.3, seed)[1]) == 2
    assert len(lone.rows(slice(0, 5)).split(0.6, seed)[1]) == 2  # too few in any case


@pytest.mark.parametrize("seed", range(5))
def test_devices_of_other_kinds_are_others_whatever_their_names(seed: int) -> None:
    table, names = some(30), ["one"] * 9 + ["two"] * 21
    given = table.q, torch.ones(30, dtype=torch.float64), names, table.joint_names
    train, _ = Observations.joined([Readings.distances(*given), Readings.heights(*given)]).split(0.6, seed)
    assert all(part.device_names.count("one") >= FEWEST_PER_DEVICE for part in train.parts)


def test_split_refuses_what_cannot_be_split() -> None:
    repeated = Measurements(np.full((3, 2), 0.5), np.arange(9.0).reshape(3, 3))
    for data in (repeated, some(1)):
        with pytest.raises(MeasurementError, match=says("cannot split", "2 distinct configurations", "got 1")):
            data.split()
    for fraction in (0.0, 1.0, 70, math.nan):
        with pytest.raises(MeasurementError, match=says("`fraction`", "between 0 and 1")):
            some(10).split(fraction)
    with pytest.raises(MeasurementError, match=says("`k`", "at least 2")):
        some(10).folds(1)
