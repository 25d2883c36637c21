"""Measurements in memory, and rows of several kinds in one table: validation, noise, hidden ones, subsets, splits."""

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numbers_bank import normal as values
from table_bank import held, in_order, random_poses, says, some
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.poses import mark_jacobian, mark_points
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import FEWEST_PER_DEVICE, REPEAT_TOLERANCE
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import LEVER


def test_what_a_table_holds() -> None:
    q = torch.tensor([[0.5, 1.0]], dtype=torch.float32, requires_grad=True)
    points = np.array([[1, 2, 3]])
    data = Measurements(q, points, joint_names=["a", "b"], marker_names=["tip"])
    points[0, 0] = 99
    assert data.q.dtype == data.points.dtype == torch.float64
    assert not data.q.requires_grad
    assert data.points.tolist() == [[[1.0, 2.0, 3.0]]]
    assert (len(data), data.n, data.markers) == (1, 2, 1)
    assert (data.joint_names, data.marker_names) == (("a", "b"), ("tip",))
    assert repr(data) == "Measurements(1 row, 2 joints, 1 marker)"
    poses = random_poses(5)
    data = Measurements.from_poses(some(5).q, poses, ["a", "b"], lever=0.2)
    assert_close(held(data.poses), poses, rtol=0, atol=1e-15)
    assert_close(data.points, mark_points(poses, 0.2), rtol=0, atol=1e-15)
    assert (len(data), data.n, data.markers, data.lever, data.joint_names) == (5, 2, 3, 0.2, ("a", "b"))
    assert repr(data) == "Measurements(5 rows, 2 joints, poses)"
    assert Measurements.from_poses(some(5).q, poses).lever == LEVER


LAST_PLACE = torch.arange(48).view(3, 4, 4) == 19
STRETCHED = torch.diag_embed(torch.tensor([2.0, 1.0, 1.0, 1.0])).double()
P, FRAMES = random_poses(3), random_poses(6).unflatten(0, (3, 2))
MIRRORED = P * torch.tensor([1.0, -1.0, 1.0, 1.0])[:, None]
ONE, TWO = torch.tensor(1), torch.tensor(2)
Q = [[0.0], [1.0], [2.0]]
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"q": [[0.0, 0.0]], "points": [[1, 1e300, 3]]}, "`points` ... too large ... index [0, 1] ... 1e+300"),
    ({"q": [[0.0, 1e12]], "points": [[1, 2, 3]]}, "`q` ... cannot be measured ... index [0, 1] ... 1e+12"),
    ({"q": [[0.0, nan]], "points": [[1, 2, 3]]}, "`q` ... finite ... index [0, 1] ... nan"),
    ({"q": [0.0, 1.0], "points": [1, 2, 3]}, "`q` ... (N, n) ... (2,)"),
    ({"q": [[0.0]], "points": [[1, 2]]}, "`points` ... (N, P, 3) or (N, 3) ... (1, 2)"),
    ({"q": np.empty((0, 2)), "points": np.empty((0, 3))}, "`q` is empty ... (0, 2); pass at least one row"),
    ({"q": [[0.0, 1.0], [2.0]], "points": [[1, 2, 3]] * 2}, "`q` ... numbers ... rows of equal length"),
    ({"q": [[0.0, 1.0]], "points": [[1, 2, 3]], "joint_names": ["a", "a"]}, "`joint_names` ... distinct"),
    ({"q": [[0.0]], "points": [[1, 2, 3]], "marker_names": ["a", "b"]}, "`marker_names`: expected 1 ... got 2"),
    ({"points": [[1, 2, 3], [4, 5, 6], [nan] * 3]}, "`points` has 3 value(s) that are not finite"),
    ({"points": [[[1, 2, 3], [nan, nan, 6]]] * 2 + [[[1, 2, 3]] * 2]}, "row 0, marker 1 (and 1 more): expected three"),
    ({"points": [[[1, 2, 3]] * 2, [[nan] * 3] * 2, [[nan] * 3] * 2]}, "`points`, row 1, 2: no marker was seen"),
    ({"points": [[[1, 2, 3], [nan] * 3]] * 3, "marker_names": ["a", "tool"]}, "marker tool: hidden in all 3 rows"),
    ({"points": [[1, 2, 3]] * 3, "std": 0.0}, "`std`: expected positive ... got 0"),
    ({"points": [[1, 2, 3]] * 3, "std": [1e-5, -1e-5, 1.0]}, "`std`, first at index [1] ... got -1e-05"),
    ({"points": [[1, 2, 3]] * 3, "std": [1e-5] * 2}, "`std` ... () or (3,) or (3, 1) or (3, 1, 3) ... got (2,)"),
    ({"poses": torch.stack([*P[:2], STRETCHED])}, "`poses`, row 2 ... rotation matrix"),
    ({"poses": P[:, :3]}, "`poses` ... (N, 4, 4) ... (3, 3, 4)"),
    ({"poses": P.mT}, "`poses`, row 0 ... last row ... transpose"),
    ({"poses": P.masked_fill(LAST_PLACE, nan)}, "`poses` ... index [1, 0, 3]"),
    ({"poses": MIRRORED}, "`poses`, row 0 ... mirrored"),
    ({"poses": P[:2]}, "`q` and `poses` ... expected 3 ... got 2"),
    ({"poses": P, "lever": 0}, "`lever` ... above 0 ... got 0"),
    ({"poses": P, "rotation_std": [1, 0, 1]}, "`rotation_std`, first at index [1] ... got 0"),
    ({"poses": FRAMES.mT}, "`poses`, row 0, frame 0 ... not its transpose"),
    ({"poses": FRAMES.index_fill(0, TWO, nan)}, "`poses`, row 2: no frame was seen"),
    ({"poses": FRAMES.index_fill(1, ONE, nan), "on": ["left", "right"]}, "the frame on 'right': hidden in all 3 rows"),
    ({"poses": FRAMES, "on": ["left"]}, "`on`: expected 2 names ... per measured frame"),
    ({"poses": FRAMES, "camera_on_tool": True}, "poses of a camera on the tool: expected one tip, got 2"),
]


@pytest.mark.parametrize(("given", "message"), WRONG)
def test_wrong_input_is_one_clear_error(given: dict[str, Any], message: str) -> None:
    make = Measurements.from_poses if "poses" in given else Measurements
    with pytest.raises(MeasurementError, match=in_order(message)):
        make(**({"q": Q} | given))


def test_repeats_and_values_like_degrees_are_doubted_and_kept() -> None:
    q, points = [[0.0], [1.0], [-0.0], [1.0]], [[1, 2, 3], [4, 5, 6], [1, 2, 3], [4, 5, 7]]
    with pytest.warns(DiffeoCalibWarning, match=r"1 of 4 rows.*row 2, of row 0") as record:
        data = Measurements(q, points)
    assert len(data) == 4
    assert record[0].filename == __file__  # the warning points at the user's line
    assert len(data[[0, 2]]) == 2  # a subset does not warn again
    with pytest.warns(DiffeoCalibWarning, match=r"column 1 \('b'\).* 90.*degrees.*millimetres of a prismatic joint"):
        Measurements([[0.0, 90.0]], [[1, 2, 3]], ["a", "b"])
    Measurements([[0.0, -4 * math.pi]], [[1, 2, 3]])  # two whole turns are plausible
    poses = random_poses(3)[[0, 1, 0]]
    with pytest.warns(DiffeoCalibWarning, match=r"1 of 3 rows.*row 2, of row 0"):
        data = Measurements.from_poses([[0.0], [1.0], [0.0]], poses)
    assert data.copies() == [(0, 2)]
    assert data.groups().tolist() == [0, 1, 0]
    poses[2, :3, :3] = poses[1, :3, :3]  # the same place, turned
    assert Measurements.from_poses(data.q, poses).copies() == []


def test_set_ups_and_loads_of_rows() -> None:
    data, names = some(5), ["a", "b", "b", "a", "b"]
    named = data.with_sessions(names)
    assert named.largest_session().points.tolist() == data.points[[1, 2, 4]].tolist()
    assert named.rows([0, 3]).largest_session().present_sessions == ("a",)
    posed = Measurements.from_poses(data.q, random_poses(5))
    for call, message in (
        (lambda: data.with_sessions(["a", None, "b", nan, " "]), "3 row(s) have no name, the first is row 1"),  # pyright: ignore
        (lambda: data.with_sessions(names[:2]), "expected 5 names, one per row, got 2"),
        (lambda: posed.with_sessions(names, remounted=True), "mounted anew: expected positions, got poses"),
        (lambda: data.with_payload([1, 2, -3, 4, 5]), "`payload`, row 2: expected a mass of 0 or more, got -3"),
        (lambda: data.with_payload(-1.0), "`payload`: expected a mass of 0 or more, got -1"),
        (lambda: Readings.distances(data.q, 1.0, offset_std=-1.0), "`offset_std`: expected 0 or more, got -1.0"),
        (lambda: Readings.distances(data.q, [1, 1, 0, 1, 1]), "`lengths`: expected above 0, got 0 m in row 2"),
    ):
        with pytest.raises(MeasurementError, match=in_order(message)):
            call()


def test_rows_and_groups() -> None:
    data = some(5)
    for index, expected in [
        (2, [2]),
        (-1, [4]),
        (slice(1, 4, 2), [1, 3]),
        ([3, 0, 3], [3, 0, 3]),
        (np.array([True, False, False, False, True]), [0, 4]),
        (torch.tensor([1, 2]), [1, 2]),
    ]:
        assert_close((data[index].q, data[index].points), (data.q[expected], data.points[expected]))
    assert [len(row) for row in data] == [1] * 5
    for empty in ([], slice(0, 0), [False] * 5):
        with pytest.raises(MeasurementError, match="no row"):
            data[empty]
    for outside in (5, [0, 9], [True, False]):
        with pytest.raises(IndexError):
            data[outside]
    step = 0.9 * REPEAT_TOLERANCE
    q = [[2.0, 0.0], [0.0, 0.0], [step, -step], [2 * step, 0.0], [2.0, 1.1 * REPEAT_TOLERANCE]]
    data = Measurements(q, np.arange(15.0).reshape(5, 3))
    assert data.groups().tolist() == [0, 1, 1, 2, 3]
    assert data.groups(tolerance=0.5 * step).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("shape", [(), (4,), (4, 2), (4, 2, 3)])
def test_known_noise_of_points_is_diagonal_and_missing_where_they_are_hidden(shape: tuple[int, ...]) -> None:
    std = np.random.default_rng(0).uniform(1e-5, 1e-4, shape)
    points = some(4, markers=2).points
    points[1, 0] = nan
    wide = np.broadcast_to(std.reshape(shape + (1,) * (3 - len(shape))), (4, 2, 3)).copy()
    wide[1, 0] = nan
    for own in (std, wide):
        data = Measurements(some(4).q, points, std=own)
        np.testing.assert_array_equal(held(data.std).numpy(), wide)
        expected = np.nan_to_num(wide.reshape(4, 6)) ** 2
        assert_close(held(data.covariance), torch.diag_embed(torch.from_numpy(expected)))
    wide[2, 1, 0] = nan
    with pytest.raises(MeasurementError, match=r"`std` has 1 value\(s\) that are not finite"):
        Measurements(some(4).q, points, std=wide)


@pytest.mark.parametrize("shape", [(), (5,), (5, 3)])
@pytest.mark.parametrize("known", ["position", "rotation"])
def test_known_noise_of_poses_is_that_of_their_points(shape: tuple[int, ...], known: str) -> None:
    std = np.random.default_rng(0).uniform(1e-5, 1e-4, shape)
    wide = torch.from_numpy(np.broadcast_to(std.reshape(shape + (1,) * (2 - len(shape))), (5, 3)).copy())
    parts = [wide, 0 * wide] if known == "position" else [0 * wide, wide]
    factor = mark_jacobian(random_poses(5), 0.15) * torch.cat(parts, 1)[:, None]
    data = Measurements.from_poses(some(5).q, random_poses(5), lever=0.15, **{f"{known}_std": std})  # pyright: ignore
    assert_close(held(data.covariance), factor @ factor.mT, rtol=1e-9, atol=1e-18)
    assert torch.linalg.matrix_rank(held(data.covariance), rtol=1e-9).tolist() == [3] * 5


TIPS, ROWS = ("left", "right", "head"), 6
GONE = [(0, 1), (2, 0), (2, 2)]
"""Row and number of the frames that were not seen."""


def frames_on_tips() -> Measurements:
    rng = np.random.default_rng(3)
    poses = random_poses(3 * ROWS, seed=5).unflatten(0, (ROWS, 3))
    std, turns = (rng.uniform(1e-5, 1e-3, (ROWS, 3, 3)) for _ in range(2))
    for row, frame in GONE:
        poses[row, frame] = nan
    known: dict[str, Any] = {"on": TIPS, "lever": 0.2, "position_std": std, "rotation_std": turns}
    return Measurements.from_poses(rng.uniform(-1, 1, (ROWS, 2)), poses, ["a", "b"], **known)


def test_frames_are_tables_of_one_frame_side_by_side() -> None:
    data, T = frames_on_tips(), random_poses(ROWS, seed=8)
    covariance, moved = held(data.covariance), data.in_frames(T)
    for frame in range(3):
        rows = ~held(data.frames)[:, frame].isnan().flatten(1).any(1)
        std, turns = held(data.std)[rows, frame], held(data.rotation_std)[rows, frame]
        known: dict[str, Any] = {"lever": 0.2, "position_std": std, "rotation_std": turns}
        one = Measurements.from_poses(data.q[rows], held(data.poses)[rows, frame], **known)
        own = slice(9 * frame, 9 * frame + 9)
        assert_close(data.points[rows, 3 * frame : 3 * frame + 3], one.points)
        assert_close(covariance[rows, own, own], held(one.covariance), rtol=1e-12, atol=0)
        assert not bool(data.visible[~rows, 3 * frame : 3 * frame + 3].any())
        assert not bool(covariance[rows][:, own, : 9 * frame].any())
        expected = one.in_frames(T[rows])
        assert_close(held(moved.frames)[rows, frame], held(expected.poses))
        assert_close(held(moved.rotation_std)[rows, frame], held(expected.rotation_std))
        assert_close(held(moved.std)[rows, frame], held(expected.std)[:, 0])
    assert data.on == tuple(tip for tip in TIPS for _ in range(3))
    assert repr(data) == "Measurements(6 rows, 2 joints, poses on 3 tips, 3 of 18 sightings hidden)"
    again = Measurements.of_points(data.q, data.points, data.on, data.lever)
    assert_close(held(again.poses), held(data.poses), equal_nan=True)
    plain = Measurements.from_poses(data.q, random_poses(6)[:, None], on="hand")  # of several axes, one frame
    assert_close(held(plain.poses), random_poses(6), rtol=0, atol=1e-15)
    assert plain.on == ("hand",) * 3


def test_nan_is_a_hidden_marker_and_follows_its_row() -> None:
    rng = np.random.default_rng(0)
    places, gone = rng.uniform(-2, 2, (12, 3, 3)), rng.random((12, 3)) < 0.4
    gone[gone.all(1), 0] = False
    places[gone] = nan
    data = Measurements(rng.uniform(-3, 3, (12, 2)), places, marker_names=["a", "b", "c"])
    assert data.visible.tolist() == (~gone).tolist()
    assert f"{int(gone.sum())} of 36 sightings hidden" in repr(data)
    assert "hidden" not in repr(data.rows(~gone.any(1)))
    train, test = data.split(0.6, seed=1)
    assert Measurements.joined([train, test]).visible.sum() == (~gone).sum()
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = turn[[1, 2, 0], :3]
    assert data.in_frames(turn.expand(12, 4, 4)).visible.tolist() == (~gone).tolist()


def everything(data: Measurements) -> dict[str, Tensor]:
    names = ("q", "points", "poses", "std", "rotation_std", "covariance")
    return {name: getattr(data, name) for name in names if getattr(data, name) is not None}


@pytest.mark.parametrize("kind", ["points", "poses"])
def test_parts_carry_poses_and_known_noise(kind: str) -> None:
    rng, q = np.random.default_rng(0), some(12).q
    if kind == "poses":
        known: dict[str, Any] = {"position_std": rng.uniform(1, 2, (12, 3)), "rotation_std": rng.uniform(1, 2, (12, 3))}
        data = Measurements.from_poses(q, random_poses(12), ["a", "b"], lever=0.3, **known)
    else:
        points, std = some(12, markers=2).points, rng.uniform(1, 2, (12, 2, 3))
        data = Measurements(q, points, ["a", "b"], ["m", "n"], std=std)
    whole = everything(data)
    assert len(whole) == (6 if kind == "poses" else 4)
    for part in (data[3:7], data[[5, 1]], *data.split(0.6), next(iter(data)), copy.deepcopy(data)):
        rows = [int((data.q == own).all(1).nonzero()[0, 0]) for own in part.q]
        for name, column in everything(part).items():
            assert_close(column, whole[name][rows], rtol=0, atol=0)
        assert (set(everything(part)), part.lever, part.joint_names) == (set(whole), data.lever, data.joint_names)
        assert part.marker_names == data.marker_names
    renamed = data.with_joint_names(["c", "d"])
    assert (renamed.joint_names, data.joint_names) == (("c", "d"), ("a", "b"))
    with pytest.raises(MeasurementError, match=r"`names`.*expected 2.*got 1"):
        data.with_joint_names(["c"])


@st.composite
def repeated_measurements(draw: st.DrawFn) -> Measurements:
    """Between 2 and 8 configurations, each measured 1 to 6 times with some jitter, in random order."""
    sizes = draw(st.lists(st.integers(1, 6), min_size=2, max_size=8))
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))
    label = rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    q = np.stack([label * 0.5, label % 3], axis=1) + rng.uniform(-4e-4, 4e-4, (len(label), 2))
    points = np.stack([np.arange(len(label)), label, 0 * label], axis=1)  # x: the row, y: its group
    return Measurements(q, points)


@given(repeated_measurements(), st.floats(0.05, 0.95), st.integers(0, 5))
def test_splits_cut_no_group(data: Measurements, fraction: float, seed: int) -> None:
    row, group = (data.points[:, 0, axis].int().tolist() for axis in (0, 1))
    largest = int(torch.bincount(data.groups()).max())
    train, test = data.split(fraction, seed)
    assert 0 < len(train) < len(data)
    assert abs(len(train) - round(fraction * len(data))) <= largest
    rows, others = (part.points[:, 0, 0].int().tolist() for part in (train, test))
    assert sorted(rows + others) == row
    assert rows == sorted(rows)
    assert not {group[own] for own in rows} & {group[own] for own in others}


def test_splits_without_repeats_and_refusals() -> None:
    data = some(100)
    first, again, second = (data.split(0.7, seed=seed)[0] for seed in (0, 0, 1))
    assert len(first) == len(second) == 70
    assert torch.equal(first.q, again.q)
    assert not torch.equal(first.q, second.q)
    repeated = Measurements(np.full((3, 2), 0.5), np.arange(9.0).reshape(3, 3))
    for data in (repeated, some(1)):
        with pytest.raises(MeasurementError, match=r"cannot split.*2 distinct configurations.*got 1"):
            data.split()
    for fraction in (0.0, 1.0, 70, nan):
        with pytest.raises(MeasurementError, match=r"`fraction`.*between 0 and 1"):
            some(10).split(fraction)


@pytest.mark.parametrize("seed", range(5))
def test_a_device_keeps_the_rows_that_place_it(seed: int) -> None:
    """Devices of other kinds are others whatever their names."""
    data = some(60).with_sessions(["few"] * 10 + ["many"] * 50)
    train, test = data.split(0.7, seed)
    assert train.device_names.count("few") >= FEWEST_PER_DEVICE
    assert test.device_names.count("few") <= 2
    lone = some(10).with_sessions(["few"] * 10)
    assert len(lone.split(0.3, seed)[1]) == 2
    assert len(lone.rows(slice(0, 5)).split(0.6, seed)[1]) == 2  # too few in any case
    own = some(30).q, torch.ones(30, dtype=torch.float64), ["one"] * 9 + ["two"] * 21
    train, _ = Observations.joined([Readings.distances(*own), Readings.heights(*own)]).split(0.6, seed)
    assert all(part.device_names.count("one") >= FEWEST_PER_DEVICE for part in train.parts)


NAMES = ("a", "b")
Tables = dict[str, Any]


def tables() -> Tables:
    q = [some(5, seed=seed).q for seed in range(10, 16)]
    return {
        "position": dc.Measurements(q[0], values(5, 3), NAMES),
        "pose": dc.Measurements.from_poses(q[1], random_poses(5), NAMES),
        "socket": dc.Measurements.from_sockets(q[2], ["f/0", "f/1", "g/0", "g/1", "f/0"], NAMES),
        "distance": Readings.distances(q[3], values(5).abs() + 1.0, ["A", "A", "B", "B", "A"], NAMES, std=1e-4),
        "height": Readings.heights(q[4], values(5), ["top"] * 5, NAMES),
        "image": Readings.images(q[5][:4], values(4, 2), None, NAMES, focal=(800.0, 900.0), centre=(1.0, 2.0)),
    }


@pytest.fixture
def whole() -> Observations:
    return Observations.joined(list(tables().values()))


def test_parts_and_selections_keep_their_order(whole: Observations) -> None:
    parts = tables()
    assert len(whole) == 29
    assert [part.kind for part in whole.parts] == list(parts)
    assert whole.kinds == tuple(kind for kind, table in parts.items() for _ in range(len(table)))
    assert_close(whole.q, torch.cat([table.q for table in parts.values()]))
    assert (whole.n, whole.joint_names, whole.payload) == (2, NAMES, None)
    assert whole.device_names[15:22] == ["A", "A", "B", "B", "A", "top", "top"]
    assert whole.session_names == ("f/0", "f/1", "g/0", "g/1", "A", "B", "top", "device")
    assert held(whole.session).tolist()[14:21] == [0, 4, 4, 5, 5, 4, 6]
    assert whole.places.tolist() == [*[-1] * 10, 0, 0, 1, 1, 0, *[-1] * 14]
    chosen = [28, 0, 16, 16, 12, 5, 1]
    some_rows = whole.rows(chosen)
    assert_close(some_rows.q, whole.q[chosen])
    assert some_rows.kinds == tuple(whole.kinds[row] for row in chosen)
    assert some_rows.line_numbers.tolist() == whole.line_numbers[chosen].tolist()
    assert [len(row) for row in some_rows] == [1] * 7
    again = Observations.joined([some_rows[:3], some_rows[3:]])
    assert_close(again.q, some_rows.q)
    assert again.kinds == some_rows.kinds
    with pytest.raises(MeasurementError, match="no row"):
        whole.rows([])


def test_what_is_held_out(whole: Observations) -> None:
    train, test = whole.split(0.5, seed=1)
    assert len(train) + len(test) == len(whole)
    assert "socket" not in test.kinds
    both = tables()
    blind = Observations.joined([both["socket"], both["distance"]])
    assert blind.without_device
    for seed in range(3):
        of_train, of_test = (set(part.places.tolist()) - {-1} for part in blind.split(0.6, seed))
        assert len(of_train) + len(of_test) == 2
    same = replace(both["distance"], q=both["socket"].q)  # read while the ball rested
    for seed in range(3):
        train, test = Observations.joined([both["socket"], same]).split(0.5, seed)
        assert not {*train.q[:, 0].tolist()} & {*test.q[:, 0].tolist()}


def test_the_simplest_table_that_holds_the_rows_and_copies_of_one_kind() -> None:
    parts = tables()
    near = parts["distance"]
    back = Readings.joined([near.rows([4, 2]), near.rows([0])])
    assert isinstance(back, Readings)
    assert_close(back.values, near.values[[4, 2, 0]])
    assert back.device_names == ["A", "B", "A"]
    assert isinstance(dc.Measurements.joined([parts["pose"], parts["pose"]]), dc.Measurements)
    assert isinstance(dc.Measurements.joined([parts["pose"], parts["position"]]), Observations)
    again = Observations.joined([near.rows([0, 1]), near.rows([2])]).rows([2, 0])
    assert_close(Readings.joined([again]).values, near.values[[2, 0]])
    near, far = tables()["distance"], tables()["position"]
    assert Observations.joined([far, replace(near, q=far.q)]).copies() == []
    assert Observations.joined([far, near, near.rows([3]), far.rows([0])]).copies() == [(8, 10), (0, 11)]


def test_payloads_names_lines_and_files(whole: Observations) -> None:
    laden = whole.with_payload(torch.arange(29.0)).with_line_numbers(range(100, 129)).with_joint_names(["u", "v"])
    assert held(laden.payload).tolist() == list(range(29))
    assert held(laden.parts[1].payload).tolist() == [5, 6, 7, 8, 9]
    assert laden.rows([28, 3]).line_numbers.tolist() == [128, 103]
    assert laden.parts[4].joint_names == ("u", "v")
    own = tables()["distance"]
    lengths = own, own.with_payload(1.0), replace(own, std=None)
    different = laden, whole, whole.rows(range(28)), whole.rows([1, 0]), *lengths
    assert len({data.sha256 for data in different}) == len(different)
    assert laden.to("cpu").sha256 == laden.sha256
    files = [part.with_columns(file_sha256=name) for part, name in zip(whole.parts, "aba", strict=False)]
    assert [part.sha256 for part in files] == ["a", "b", "a"]
    assert Observations.joined(files[::2]).file_sha256 == "a"
    assert Observations.joined(files[:2]).file_sha256 is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: [], "tables to join: expected at least one"),
        (lambda t: [t["position"], t["position"].q], "dc.Measurements or dc.Readings, got Tensor"),
        (lambda t: [t["position"], t["height"].with_joint_names(["u", "v"])], "the tables differ in joint_names"),
        (lambda t: [t["position"], t["height"].with_payload(1.0)], "the tables differ in payload"),
        (lambda t: [t["pose"].with_payload(1.0, "x"), t["height"].with_payload(1.0)], "differ in payload_at"),
        (lambda t: [Readings.heights(values(3, 3)), t["image"]], "the tables differ in n, joint_names"),
        (lambda t: [t["height"].with_tips(["l"]), t["distance"].with_tips(["r"])], "expected one tip, got l, r"),
        (lambda t: [replace(t["socket"], distances=(("f/0", "f/1", own),)) for own in (1.0, 2.0)], "in distances"),
        (lambda t: [t["position"], dc.Measurements(values(1, 2), values(1, 2, 3), NAMES), t["height"]], "in markers"),
    ],
)
def test_tables_that_cannot_be_joined(change: Callable[[Tables], list[dc.Measurements]], said: str) -> None:
    with pytest.raises(MeasurementError, match=says(said)):
        Observations.joined(change(tables()))


def test_deviations_of_readings_and_positions_beside_images() -> None:
    q = values(3, 2)
    assert held(Readings.distances(q, 1.0, std=[1.0, 2.0, 3.0]).std)[:, 0].tolist() == [1.0, 2.0, 3.0]
    seen = Readings.images(q, values(3, 2), focal=(10.0, 20.0), centre=(1.0, 2.0), std=0.2)
    assert_close(held(seen.std)[0].tolist(), [0.02, 0.01])
    assert_close(held(seen.reported_std)[0].tolist(), [0.2, 0.2])
    assert_close(seen.reported, values(3, 2))
    for std, said in ((0.0, "positive"), ([1.0, 2.0], "std"), (float("nan"), "std")):
        with pytest.raises(MeasurementError, match=said):
            Readings.heights(q, std=std)
    with pytest.raises(MeasurementError, match=r"pass 2 per row\W*$"):  # pixels, no metres
        Readings.images(q, values(3, 3), focal=(10.0, 20.0), centre=(1.0, 2.0))
    data = some(4, markers=2)
    known = dc.Measurements(data.q, data.points, std=torch.linspace(1e-5, 8e-5, 8, dtype=torch.float64).view(4, 2))
    found = known.beside_images()
    assert len(found) == 2
    for marker, (own, rows) in enumerate(found):
        assert rows.tolist() == [0, 1, 2, 3]
        assert_close((own.values, own.std), (known.points[:, marker], held(known.std)[:, marker]), rtol=0, atol=0)
    ((posed, _),) = dc.Measurements.from_poses(data.q, random_poses(4)).beside_images()
    assert_close(posed.poses, random_poses(4))
