"""Rotations against SciPy and against written-out formulas, and poses as three points: there, back, and derivatives."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from numbers_bank import normal as values
from scipy.spatial.transform import Rotation
from table_bank import CONVENTIONS, ORDERS, held, in_order, random_poses, random_rotations, refused
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.columns import PoseColumns
from diffeo_calib.measurements.poses import (
    angle_between,
    directions_of_frames,
    frames_of_points,
    inverse_poses,
    mark_points,
    marks,
    points_of_frames,
    pose_jacobian,
    poses_from_marks,
    rotation_matrices,
    rotation_numbers,
    transforms,
)
from diffeo_calib.measurements.table_format import TableFormat, numbers_of
from diffeo_calib.robots.se3 import rigid_poses, rotation

EYE = torch.eye(3, dtype=torch.float64)


def turn(axis: str, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    return np.array(rows.get(axis, [[c, -s, 0], [s, c, 0], [0, 0, 1]]))


@pytest.mark.parametrize("angle", ["rad", "deg"])
def test_round_trips(angle: str) -> None:
    matrices = random_rotations(50)
    for convention in CONVENTIONS:
        numbers = rotation_numbers(matrices, convention, angle=angle)
        assert numbers.shape == (50, numbers_of(convention))
        if convention.startswith("quat"):
            assert float(numbers[:, convention.index("w") - len("quat_")].min()) >= 0  # the scalar
        assert_close(rotation_matrices(numbers, convention, angle=angle), matrices, rtol=0, atol=1e-14)
    for convention in ("matrix", "quat_xyzw", "quat_wxyz"):  # few digits are enough
        found = rotation_matrices(rotation_numbers(matrices, convention).numpy().round(4), convention)
        assert_close(found.mT @ found, EYE.expand(50, 3, 3), rtol=0, atol=1e-14)
        assert_close(found, matrices, rtol=0, atol=2e-4)


def test_conventions_written_out() -> None:
    """Extrinsic: the rotation of the last letter is the leftmost factor; intrinsic: that of the first letter."""
    a, b, c = 0.3, -0.7, 2.1
    for order in ORDERS:
        first, second, third = (turn(axis, t) for axis, t in zip(order.lower(), (a, b, c), strict=True))
        expected = third @ second @ first if order.islower() else first @ second @ third
        np.testing.assert_allclose(rotation_matrices([[a, b, c]], order)[0], expected, atol=1e-14)
        degrees = rotation_matrices(np.degrees([[a, b, c]]), order, angle="deg")
        np.testing.assert_allclose(degrees[0], expected, atol=1e-14)
    matrices = rotation_matrices([[0.3, math.pi / 2, 0.4]], "XYZ")  # gimbal lock; warnings are errors here
    assert_close(rotation_matrices(rotation_numbers(matrices, "XYZ"), "XYZ"), matrices, rtol=0, atol=1e-7)
    half = math.pi / 6  # a turn of 60 degrees about z
    expected = torch.from_numpy(turn("z", 2 * half))[None]
    c, s = math.cos(half), math.sin(half)
    for numbers, convention in (
        ([0, 0, s, c], "quat_xyzw"),
        ([0, 0, -s, -c], "quat_xyzw"),
        ([c, 0, 0, s], "quat_wxyz"),
        ([0, 0, 2 * half], "rotvec"),
        (expected.flatten().tolist(), "matrix"),
    ):
        assert_close(rotation_matrices([numbers], convention), expected, rtol=0, atol=1e-15)
    assert_close(rotation_matrices([[0, 0, 60]], "rotvec", angle="deg"), expected, rtol=0, atol=1e-15)
    a, b, c = 0.3, -0.7, 1.1
    expected = turn("z", a) @ turn("y", b) @ turn("x", c)
    for name, numbers in (("kuka_abc", [a, b, c]), ("fanuc_wpr", [c, b, a])):
        written = TableFormat("m", "rad", convention=name).convention
        assert PoseColumns.of(f"x,y,z,rx,ry,rz={name}").convention == written
        assert_close(rotation_matrices([numbers], str(written))[0].numpy(), expected, rtol=0, atol=1e-14)
    assert TableFormat("m", "rad", convention="ur_rotvec").convention == "rotvec"
    assert TableFormat("m", "rad", convention="abb_quaternion").convention == "quat_wxyz"


@pytest.mark.parametrize(
    ("numbers", "convention", "message"),
    [
        ([[0, 0, 0]], "xyZ", "`convention` ... 'rotvec' ... 'xyz' (extrinsic) ... got 'xyZ'"),
        ([[0, 0, 0]], "quat_xyzw", "`rotations` ... (N, 4) ... (1, 3) ... 4 numbers of 'quat_xyzw'"),
        ([[0, 0, 0], [0, math.nan, 0]], "zyx", "`rotations` ... index [1, 1] ... nan"),
        ([[0, 0, 0, 1], [0, 0, 1, 1]], "quat_xyzw", "row 1: expected a quaternion of length 1 ... got 1.41421"),
        ([[1.002, 0, 0, 0]], "quat_wxyz", "row 0 ... got 1.002"),
        ([[1, 0, 0, 0, 1, 0, 0, 0, -1]], "matrix", "row 0 ... mirrored"),
        ([[1, 2e-3, 0, 0, 1, 0, 0, 0, 1]], "matrix", "row 0 ... 0.002 ... scale"),
    ],
)
def test_wrong_rotations_are_one_clear_error(numbers: Any, convention: Any, message: str) -> None:
    with pytest.raises(InputError, match=in_order(message)) as caught:
        rotation_matrices(numbers, convention)
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize("size", [1e-15, 1e-9, 1e-3, math.pi / 2, math.pi - 1e-6, math.pi])
def test_angles_between_rotations(size: float) -> None:
    R, axes = random_rotations(50), np.random.default_rng(3).normal(size=(50, 3))
    vectors = size * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    S = R @ torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix())
    assert_close(angle_between(R, S), torch.full((50,), size, dtype=torch.float64), rtol=1e-12, atol=1e-15)
    assert float(angle_between(R, R).max()) < 1e-15


@pytest.mark.parametrize("lever", [0.001, 0.1, 3.0])
def test_points_are_an_equilateral_triangle_around_the_origin_and_lead_back(lever: float) -> None:
    poses = random_poses(20)
    points = mark_points(poses, lever)
    assert_close(points.mean(1), poses[:, :3, 3], rtol=0, atol=1e-14)
    assert_close((points - poses[:, None, :3, 3]).norm(dim=-1), torch.full((20, 3), lever).double())
    sides = (points - points.roll(1, 1)).norm(dim=-1)
    assert_close(sides, torch.full((20, 3), lever * math.sqrt(3), dtype=torch.float64))
    assert_close(poses_from_marks(points, lever), poses, rtol=0, atol=1e-14 * max(1.0, 1 / lever))


def test_points_without_orientation_and_levers_without_length_are_refused() -> None:
    points = mark_points(random_poses(3), 0.1)
    points[1] = torch.tensor([[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0]], dtype=torch.float64)
    refused(
        (r"row 1.*on one line.*0\.1 m", lambda: poses_from_marks(points, 0.1)),
        (r"`points`.*\(N, 3, 3\)", lambda: poses_from_marks(torch.zeros(4, 2, 3), 0.1)),
    )
    for lever in (0, -0.1, math.nan, math.inf, True, "0.1", None):
        for use, given in ((mark_points, random_poses(1)), (poses_from_marks, torch.zeros(1, 3, 3))):
            with pytest.raises(InputError, match="`lever`"):
                use(given, lever)  # pyright: ignore[reportArgumentType]


def test_rounded_transforms_and_bent_points() -> None:
    poses = random_poses(20)
    found = rigid_poses(poses.numpy().round(5).tolist())
    assert_close(found, poses, rtol=0, atol=2e-5)
    assert_close(found[:, :3, :3].mT @ found[:, :3, :3], EYE.expand(20, 3, 3), rtol=0, atol=1e-14)
    lever, poses = 0.1, random_poses(30)
    points = mark_points(poses, lever) + 1e-2 * torch.from_numpy(np.random.default_rng(5).normal(size=(30, 3, 3)))
    found = poses_from_marks(points, lever)
    assert_close(found[:, :3, 3], points.mean(1), rtol=0, atol=1e-15)
    for row in range(30):
        centred = (points[row] - points[row].mean(0)).numpy()
        best = Rotation.align_vectors(centred, marks(HOST).numpy())[0]
        assert_close(found[row, :3, :3], torch.from_numpy(best.as_matrix()), rtol=0, atol=1e-7)


ROWS, STEP = 6, 1e-6


@pytest.mark.parametrize("camera_on_tool", [False, True])
def test_slopes_and_covariances_of_points_are_those_of_the_measured_pose(camera_on_tool: bool) -> None:
    """Differences by a shift and a turn along the axes of the device, the camera's if it is on the tool."""
    seen, position, turned = random_poses(ROWS, seed=3), *(1e-5 * (1 + values(ROWS, 3, seed=k).abs()) for k in (1, 2))
    known: dict[str, Any] = {"position_std": position, "rotation_std": turned, "camera_on_tool": camera_on_tool}
    data = dc.Measurements.from_poses(values(ROWS, 4), seen, lever=0.07, **known)
    assert_close(inverse_poses(held(data.poses)) if camera_on_tool else held(data.poses), seen, rtol=0, atol=1e-14)
    found = pose_jacobian(held(data.frames), 0.07, data.board)[:, 0]
    sign = -1.0 if camera_on_tool else 1.0  # errors of the camera are those of the board, negated

    def points(e: Tensor) -> Tensor:
        moved = transforms(rotation(e[3:]) @ seen[:, :3, :3], seen[:, :3, 3] + e[:3])
        return mark_points(inverse_poses(moved) if camera_on_tool else moved, 0.07).flatten(1)

    for k, change in enumerate(STEP * torch.eye(6, dtype=torch.float64, device=HOST)):
        slope = (points(change) - points(-change)) / (2 * STEP)
        assert_close(found[..., k], sign * slope, rtol=0, atol=1e-9)
    factor = found * torch.cat([position, turned], 1)[:, None]
    assert_close(held(data.covariance), factor @ factor.mT, rtol=1e-9, atol=1e-18)


def test_directions_of_several_frames_are_derivatives() -> None:
    """Of the poses by their points; no frame depends on the points of another."""
    frames = random_poses(2 * ROWS, seed=5).unflatten(0, (ROWS, 2))
    points = points_of_frames(frames, 0.3)
    found = directions_of_frames(frames, 0.3)
    for k in range(points[0].numel()):
        moved = points.flatten(1).clone()
        moved[:, k] += STEP
        away = frames_of_points(moved.view_as(points), 0.3)
        skewed = (away[..., :3, :3] @ frames[..., :3, :3].mT - EYE) / STEP
        turned = torch.stack([skewed[..., 2, 1], skewed[..., 0, 2], skewed[..., 1, 0]], -1)
        slope = torch.cat([(away - frames)[..., :3, 3] / STEP, turned], -1).flatten(1)
        assert_close(found[..., k], slope, rtol=0, atol=1e-4)
