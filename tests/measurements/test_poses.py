"""Rotations against SciPy and against written-out formulas, poses as three points, and a board seen from the tool."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from table_bank import CONVENTIONS, ORDERS, held, random_poses, random_rotations, says
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.csv.files import read_measurements, write_measurements
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.measurements.poses import (
    angle_between,
    inverse_poses,
    mark_jacobian,
    mark_points,
    marks,
    pose_jacobian,
    poses_from_marks,
    rigid_poses,
    rotation_matrices,
    rotation_numbers,
    transforms,
)
from diffeo_calib.measurements.table_format import TableFormat, numbers_of
from diffeo_calib.robots.se3 import rotation

EYE = torch.eye(3, dtype=torch.float64)


def turn(axis: str, angle: float) -> np.ndarray:
    """A turn about x, y or z, written out."""
    c, s = math.cos(angle), math.sin(angle)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    return np.array(rows.get(axis, [[c, -s, 0], [s, c, 0], [0, 0, 1]]))


# --- conventions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("angle", ["rad", "deg"])
def test_round_trips(convention: str, angle: str) -> None:
    matrices = random_rotations(200)
    numbers = rotation_numbers(matrices, convention, angle=angle)
    assert numbers.shape == (200, numbers_of(convention))
    if convention.startswith("quat"):
        assert float(numbers[:, convention.index("w") - len("quat_")].min()) >= 0  # the scalar
    assert_close(rotation_matrices(numbers, convention, angle=angle), matrices, rtol=0, atol=1e-14)


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_are_turns_in_their_order(order: str) -> None:
    """Extrinsic: the rotation of the last letter is the leftmost factor; intrinsic: that of the first letter."""
    angles = np.random.default_rng(1).uniform(-3, 3, (20, 3))
    found = rotation_matrices(angles, order).numpy()
    for R, (a, b, c) in zip(found, angles, strict=True):
        first, second, third = (turn(axis, t) for axis, t in zip(order.lower(), (a, b, c), strict=True))
        expected = third @ second @ first if order.islower() else first @ second @ third
        np.testing.assert_allclose(R, expected, atol=1e-14)
    degrees = rotation_matrices(np.degrees(angles), order, angle="deg").numpy()
    np.testing.assert_allclose(degrees, found, atol=1e-13)


def test_quaternions_and_vectors_and_matrices_written_out() -> None:
    half = math.pi / 6  # a turn of 60 degrees about z
    expected = torch.from_numpy(turn("z", 2 * half))[None]
    c, s = math.cos(half), math.sin(half)
    for values, convention in (
        ([0, 0, s, c], "quat_xyzw"),
        ([0, 0, -s, -c], "quat_xyzw"),
        ([c, 0, 0, s], "quat_wxyz"),
        ([0, 0, 2 * half], "rotvec"),
        (expected.flatten().tolist(), "matrix"),
    ):
        assert_close(rotation_matrices([values], convention), expected, rtol=0, atol=1e-15)
    assert_close(rotation_matrices([[0, 0, 60]], "rotvec", angle="deg"), expected, rtol=0, atol=1e-15)
    assert_close(rotation_numbers(expected, "quat_wxyz"), torch.tensor([[c, 0, 0, s]], dtype=torch.float64))
    assert_close(rotation_numbers(expected, "rotvec", angle="deg"), torch.tensor([[0.0, 0.0, 60.0]]).double())


def test_controllers_name_their_conventions() -> None:
    """KUKA: A about z, then B about the new y, C about the newest x; Fanuc: W, P, R about the fixed x, y, z."""
    a, b, c = 0.3, -0.7, 1.1
    expected = turn("z", a) @ turn("y", b) @ turn("x", c)
    for name, numbers in (("kuka_abc", [a, b, c]), ("fanuc_wpr", [c, b, a])):
        written = TableFormat("m", "rad", convention=name).convention
        assert PoseColumns.of(f"x,y,z,rx,ry,rz={name}").convention == written
        assert_close(rotation_matrices([numbers], str(written))[0].numpy(), expected, rtol=0, atol=1e-14)
    assert TableFormat("m", "rad", convention="ur_rotvec").convention == "rotvec"
    assert TableFormat("m", "rad", convention="abb_quaternion").convention == "quat_wxyz"


def test_gimbal_lock_is_written_without_a_warning() -> None:
    matrices = rotation_matrices([[0.3, math.pi / 2, 0.4]], "XYZ")
    numbers = rotation_numbers(matrices, "XYZ")  # warnings are errors here
    assert_close(rotation_matrices(numbers, "XYZ"), matrices, rtol=0, atol=1e-7)


@pytest.mark.parametrize("convention", ["matrix", "quat_xyzw", "quat_wxyz"])
def test_few_digits_are_enough(convention: str) -> None:
    matrices = random_rotations(50)
    numbers = rotation_numbers(matrices, convention).numpy().round(4)
    found = rotation_matrices(numbers, convention)
    assert_close(found.mT @ found, EYE.expand(50, 3, 3), rtol=0, atol=1e-14)
    assert_close(found, matrices, rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    ("values", "convention", "options", "message"),
    [
        ([[0, 0, 0]], "euler", {}, ("`convention`", "'rotvec'", "'xyz' (extrinsic)", "got 'euler'")),
        ([[0, 0, 0]], "xyZ", {}, ("`convention`", "got 'xyZ'")),
        ([[0, 0, 0]], "xyz", {"angle": "grad"}, ("`angle`", "'rad' or 'deg'", "got 'grad'")),
        ([[0, 0, 0]], "quat_xyzw", {}, ("`rotations`", "(N, 4)", "(1, 3)", "4 numbers of 'quat_xyzw'")),
        ([[0, 0, 0], [0, math.nan, 0]], "zyx", {}, ("`rotations`", "index [1, 1]", "nan")),
        ([[0, 0, 0, 1], [0, 0, 1, 1]], "quat_xyzw", {}, ("row 1: expected a quaternion of length 1", "got 1.41421")),
        ([[1.002, 0, 0, 0]], "quat_wxyz", {}, ("row 0", "got 1.002")),
        ([[1, 0, 0, 0, 1, 0, 0, 0, -1]], "matrix", {}, ("row 0", "mirrored")),
        ([[1, 0, 0, 0, 1, 0, 0, 0, 1], [2, 0, 0, 0, 2, 0, 0, 0, 2]], "matrix", {}, ("row 1", "up to 3", "scale")),
        ([[1, 2e-3, 0, 0, 1, 0, 0, 0, 1]], "matrix", {}, ("row 0", "0.002")),
    ],
)
def test_wrong_rotations_are_one_clear_error(
    values: Any, convention: Any, options: dict[str, Any], message: tuple[str, ...]
) -> None:
    with pytest.raises(InputError, match=says(*message)) as caught:
        rotation_matrices(values, convention, **options)
    assert str(caught.value).endswith(".")


def test_wrong_matrices_are_not_written() -> None:
    with pytest.raises(InputError, match=says("row 1", "rotation matrix")):
        rotation_numbers(torch.stack([EYE, 2 * EYE]), "rotvec")
    for options in ({"convention": "euler"}, {"convention": "xyz", "angle": "turns"}):
        with pytest.raises(InputError, match=r"`convention`|`angle`"):
            rotation_numbers(EYE[None], **options)


# --- angles ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-15, 1e-9, 1e-6, 1e-3, 0.5, math.pi / 2, 3.0, math.pi - 1e-6, math.pi])
def test_angles_between_rotations(size: float) -> None:
    R, axes = random_rotations(50), np.random.default_rng(3).normal(size=(50, 3))
    vectors = size * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    S = R @ torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix())
    assert_close(angle_between(R, S), torch.full((50,), size, dtype=torch.float64), rtol=1e-12, atol=1e-15)
    assert float(angle_between(R, R).max()) < 1e-15


# --- poses as points ------------------------------------------------------------------------------


@pytest.mark.parametrize("lever", [0.02, 0.1, 3.0])
def test_the_points_are_an_equilateral_triangle_around_the_origin(lever: float) -> None:
    poses = random_poses(20)
    points = mark_points(poses, lever)
    assert_close(points.mean(1), poses[:, :3, 3], rtol=0, atol=1e-14)
    assert_close((points - poses[:, None, :3, 3]).norm(dim=-1), torch.full((20, 3), lever).double())
    sides = (points - points.roll(1, 1)).norm(dim=-1)
    assert_close(sides, torch.full((20, 3), lever * math.sqrt(3), dtype=torch.float64))
    assert_close(marks(HOST).sum(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=0)


@pytest.mark.parametrize("lever", [0.001, 0.1, 2.0])
def test_poses_come_back_from_their_points(lever: float) -> None:
    poses = random_poses(200)
    back = poses_from_marks(mark_points(poses, lever), lever)
    assert_close(back, poses, rtol=0, atol=1e-14 * max(1.0, 1 / lever))
    assert_close(torch.linalg.det(back[:, :3, :3]), torch.ones(200, dtype=torch.float64))


def test_the_pose_of_bent_points_is_the_nearest() -> None:
    """Against SciPy's best rotation."""
    lever, poses = 0.1, random_poses(30)
    points = mark_points(poses, lever) + 1e-2 * torch.from_numpy(np.random.default_rng(5).normal(size=(30, 3, 3)))
    found = poses_from_marks(points, lever)
    assert_close(found[:, :3, 3], points.mean(1), rtol=0, atol=1e-15)
    for row in range(30):
        centred = (points[row] - points[row].mean(0)).numpy()
        best = Rotation.align_vectors(centred, marks(HOST).numpy())[0]
        assert_close(found[row, :3, :3], torch.from_numpy(best.as_matrix()), rtol=0, atol=1e-7)


def test_points_on_a_line_have_no_orientation() -> None:
    points = mark_points(random_poses(3), 0.1)
    points[1] = torch.tensor([[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0]], dtype=torch.float64)
    with pytest.raises(InputError, match=says("row 1", "on one line", "0.1 m")):
        poses_from_marks(points, 0.1)
    with pytest.raises(InputError, match=says("row 0", "on one line")):
        poses_from_marks(torch.zeros(1, 3, 3), 0.1)
    with pytest.raises(InputError, match=r"`points`.*\(N, 3, 3\)"):
        poses_from_marks(torch.zeros(4, 2, 3), 0.1)


@pytest.mark.parametrize("lever", [0, -0.1, math.nan, math.inf, True, "0.1", None])
def test_a_lever_is_a_positive_distance(lever: Any) -> None:
    for use in (mark_points, mark_jacobian):
        with pytest.raises(InputError, match="`lever`"):
            use(random_poses(1), lever)
    with pytest.raises(InputError, match="`lever`"):
        poses_from_marks(torch.zeros(1, 3, 3), lever)


def test_jacobian_of_the_points_against_differences() -> None:
    poses, lever, h = random_poses(10), 0.1, 1e-6
    columns = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = h

        def moved(sign: float, step: np.ndarray = step) -> Tensor:
            R = torch.from_numpy(Rotation.from_rotvec(sign * step[3:]).as_matrix())  # about the measuring frame's axes
            return mark_points(
                transforms(R @ poses[:, :3, :3], poses[:, :3, 3] + torch.from_numpy(sign * step[:3])), lever
            )

        columns.append((moved(1) - moved(-1)).flatten(1) / (2 * h))
    assert_close(mark_jacobian(poses, lever), torch.stack(columns, -1), rtol=0, atol=1e-9)


# --- rigid transforms -----------------------------------------------------------------------------


def test_rounded_transforms_become_rigid() -> None:
    poses = random_poses(20)
    found = rigid_poses(poses.numpy().round(5).tolist())
    assert_close(found, poses, rtol=0, atol=2e-5)
    assert_close(found[:, :3, :3].mT @ found[:, :3, :3], EYE.expand(20, 3, 3), rtol=0, atol=1e-14)
    assert_close(rigid_poses(poses), poses, rtol=0, atol=1e-15)


ROWS = 6


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, device=HOST, generator=seeded(seed))


def seen(**options: Any) -> tuple[Tensor, dc.Measurements]:
    """Poses of the board in the camera, and the measurements that they are."""
    boards = random_poses(ROWS, seed=3)
    return boards, dc.Measurements.from_poses(draw(ROWS, 4), boards, camera_on_tool=True, **options)


def test_derivatives_of_the_points_are_those_of_the_inverted_pose() -> None:
    """Finite differences of the inverse of (exp(w) R, t + dt) by dt and w, in the camera's axes; so are deviations."""
    position, turn = (1e-5 * (1 + draw(ROWS, 3, seed=seed).abs()) for seed in (1, 2))
    boards, data = seen(lever=0.07, position_std=position, rotation_std=turn)
    found = pose_jacobian(held(data.frames), 0.07, held(data.board))[:, 0]
    step = 1e-6
    for k, change in enumerate(step * torch.eye(6, dtype=torch.float64, device=HOST)):

        def points(e: Tensor) -> Tensor:
            turned = rotation(e[3:]) @ boards[:, :3, :3]
            return mark_points(inverse_poses(transforms(turned, boards[:, :3, 3] + e[:3])), 0.07).flatten(1)

        slope = (points(change) - points(-change)) / (2 * step)
        assert_close(found[..., k], -slope, rtol=0, atol=1e-9)  # errors of the camera are those of the board, negated
    known = found * torch.cat([position, turn], 1)[:, None]
    assert_close(held(data.covariance), known @ known.mT, rtol=1e-9, atol=1e-18)


def test_errors_move_with_the_board_to_another_frame() -> None:
    """A board in another frame is another name of the same errors: their covariance turns, and nothing else."""
    _, data = seen(position_std=1e-4 * (1 + draw(ROWS, 3, seed=8).abs()), rotation_std=1e-3 * (1 + draw(ROWS, 3).abs()))
    T = random_poses(1, seed=9)
    moved, R = data.in_frames(T.expand(ROWS, 4, 4)), torch.block_diag(*[T[0, :3, :3]] * 3)
    assert_close(held(moved.covariance), R @ held(data.covariance) @ R.T, rtol=0, atol=1e-14)
    assert_close(inverse_poses(held(data.poses)), random_poses(ROWS, seed=3), rtol=0, atol=1e-13)


def test_tables_keep_the_direction_in_which_the_camera_sees(tmp_path: Path) -> None:
    boards, data = seen(position_std=2e-4, rotation_std=1e-3)
    path, plain = tmp_path / "boards.csv", TableFormat("mm", "rad")
    table = TableFormat("mm", "rad", rotation=["a", "b", "c"], convention="rotvec", camera_on_tool=True)
    with pytest.raises(MeasurementError, match=says("camera_on_tool", "pass camera_on_tool=True")):
        write_measurements(path, data, plain)
    with pytest.raises(MeasurementError, match=says("camera_on_tool", "without such a camera")):
        write_measurements(path, dc.Measurements.from_poses(data.q, boards), table)
    write_measurements(path, data, table)
    given = {"length": "mm", "angle": "rad", "rotation": ["a", "b", "c"], "convention": "rotvec"}
    given |= {
        "std": ["std_x", "std_y", "std_z"],
        "rotation_std": ["std_rx", "std_ry", "std_rz"],
        "rotation_angle": "rad",
    }
    joints = [f"q{k + 1}" for k in range(4)]
    as_written = read_measurements(path, joints, ["x", "y", "z"], **given)  # the numbers are those of the board
    assert_close(held(as_written.poses), boards, rtol=0, atol=1e-12)
    again = read_measurements(path, joints, ["x", "y", "z"], **given, camera_on_tool=True)
    assert_close(held(again.poses), held(data.poses), rtol=0, atol=1e-12)
    assert_close(held(again.covariance), held(data.covariance), rtol=1e-9, atol=0)
    assert again.rows([2]).sha256 == again.sha256, "of the file"
    assert data.sha256 != dc.Measurements.from_poses(data.q, held(data.poses)).sha256


def test_a_camera_on_the_tool_measures_poses(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("q1,q2,x,y,z\n0,0,1,2,3\n", encoding="utf-8")
    with pytest.raises(MeasurementError, match=says("`camera_on_tool` without `rotation`", "name the columns")):
        read_measurements(
            tmp_path / "a.csv", ["q1", "q2"], ["x", "y", "z"], length="m", angle="rad", camera_on_tool=True
        )
