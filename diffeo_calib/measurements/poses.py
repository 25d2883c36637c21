"""Rotations by named conventions, and poses as three points.

A measured pose is represented by three points fixed to its frame, an equilateral triangle around the frame's origin.
The kinematics predict points, and flows of space move points; the rigid motion that fits the three points best gives
the pose back. One frame is measured or one on each of several tips: (N, T, 4, 4), 3 T points. Users pass and get
(N, 4, 4) where there is a single one. A frame that a row does not show is NaN as a whole, and so are its points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from math import pi

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_number, real_tensor, wrapped
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.measurements.table_format import ALL_CONVENTIONS, ANGLE_UNITS, numbers_of
from diffeo_calib.robots.se3 import ONE_POSE, TOLERANCE, Place, checked_rotations, rigid_poses, skew, transforms

MARKS = ((1.0, 0.0, 0.0), (-0.5, 0.75**0.5, 0.0), (-0.5, -(0.75**0.5), 0.0))
"""Directions u_k from the frame's origin to its three points, one per row: their sum is zero."""
POINTS = 3  # points that represent a frame
FLATTEST_TRIANGLE_LEVERS = 1e-3  # points whose triangle is thinner than this, in levers, have no orientation


def marks(device: torch.device) -> Tensor:
    """The directions u_k as a tensor (3, 3)."""
    return torch.tensor(MARKS, dtype=torch.float64, device=device)


def rotation_matrices(values: object, convention: str, *, angle: str = "rad", place: Place = "row {}".format) -> Tensor:
    """Rotation matrices (N, 3, 3) of rotations written as rows of numbers.

    Args:
        values: (N, k) numbers: three Euler angles in the order of the letters, a rotation vector, a quaternion
            with its scalar last (``xyzw``) or first (``wxyz``), or nine entries row by row.
        convention: ``"rotvec"``, ``"quat_xyzw"``, ``"quat_wxyz"``, ``"matrix"``, or an order of Euler angles with
            SciPy's letters: extrinsic as ``"xyz"``, intrinsic as ``"XYZ"``.
        angle: unit of Euler angles and rotation vectors, ``"rad"`` or ``"deg"``; other conventions have no unit.
        place: names a row in messages.
    Raises InputError: unknown convention or unit, another number of columns, values that are not finite, quaternions
        whose length is not 1 or matrices that are not orthonormal to 0.001 (row named).
    """
    count = numbers_of(convention, angle)
    fix = f"pass the {count} numbers of {convention!r} in every row"
    table = as_tensor(values, "rotations", ("N", count), fix=fix).detach()
    if count == 9:
        return checked_rotations(table.unflatten(1, (3, 3)), place)
    off = (table.norm(dim=1) - 1).abs() > TOLERANCE
    if count == 4 and off.any():
        row = int(off.nonzero()[0])
        expected, fix = f"a quaternion of length 1 to {TOLERANCE:g}", "check the order of the columns"
        raise InputError.of(place(row), expected=expected, got=f"{float(table[row].norm()):.6g}", fix=fix)
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  # slow to import, needed for poses only

    numbers, degrees = table.cpu().numpy(), angle == "deg"
    if convention == "rotvec":
        rotation = Rotation.from_rotvec(numbers, degrees=degrees)
    elif count == 4:
        rotation = Rotation.from_quat(numbers[:, [1, 2, 3, 0]] if convention == "quat_wxyz" else numbers)
    else:
        rotation = Rotation.from_euler(convention, numbers, degrees=degrees)
    return torch.as_tensor(rotation.as_matrix(), dtype=torch.float64, device=table.device)


def readings_of(numbers: Tensor) -> Iterator[tuple[str, str, Tensor]]:
    """Convention, unit and rotations (N, 3, 3) of numbers (N, k), in all conventions in which they write rotations."""
    for convention in (name for name in ALL_CONVENTIONS if numbers_of(name) == numbers.shape[1]):
        for angle in ANGLE_UNITS if numbers.shape[1] == 3 else ANGLE_UNITS[:1]:
            with suppress(InputError):
                yield convention, angle, rotation_matrices(numbers, convention, angle=angle)


def rotation_numbers(matrices: Tensor, convention: str, *, angle: str = "rad") -> Tensor:
    """The inverse of :func:`rotation_matrices`: (..., 3, 3) -> (..., k), NaN where a matrix holds NaN.

    Where a rotation can be written in several ways, quaternions have a non-negative scalar, rotation vectors are no
    longer than pi, and Euler angles are SciPy's choice.
    Raises InputError: unknown convention or unit, or no rotation matrices.
    """
    count, given = numbers_of(convention, angle), real_tensor(matrices, "rotations").detach()
    if given.ndim < 3 or given.shape[-2:] != (3, 3):
        raise InputError.of("`rotations` has the wrong shape", expected="(N, 3, 3)", got=tuple(given.shape))
    visible = ~given.isnan().flatten(-2).any(-1)
    values = given.new_full((*visible.shape, count), torch.nan)
    exact = checked_rotations(given[visible])
    if count == 9 or not len(exact):
        values[visible] = exact.flatten(1)[:, :count]
        return values
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  # slow to import, needed for poses only

    rotation, degrees = Rotation.from_matrix(exact.cpu().numpy()), angle == "deg"
    if convention == "rotvec":
        numbers = rotation.as_rotvec(degrees=degrees)
    elif count == 4:
        numbers = rotation.as_quat()
        numbers[numbers[:, 3] < 0] *= -1
        numbers = numbers[:, [3, 0, 1, 2]] if convention == "quat_wxyz" else numbers
    else:
        with quiet(UserWarning):  # gimbal lock: SciPy sets the third angle to zero
            numbers = rotation.as_euler(convention, degrees=degrees)
    values[visible] = torch.as_tensor(numbers.copy(), dtype=torch.float64, device=exact.device)
    return values


def mark_points(poses: Tensor, lever: float) -> Tensor:
    """The three points p_k = t + lever R u_k, m, that represent poses: (..., 4, 4) -> (..., 3 points, 3)."""
    return poses[..., None, :3, 3] + _arms(poses, lever)


def poses_from_marks(points: Tensor, lever: float) -> Tensor:
    """The poses (N, 4, 4), m, whose three points are nearest to points (N, 3, 3), m, in the sum of squares.

    They are detached, except inside transforms of torch.func and while a program is recorded.
    Raises InputError: wrong shape, values that are not finite, or points on one line, which have no orientation.
    """
    check_lever(lever)
    if isinstance(points, Tensor) and wrapped(points):
        return poses_of_triangles(points)
    places = as_tensor(points, "points", ("N", 3, 3), fix="pass the three points of a pose", empty=True).detach()
    spread = (places - places.mean(1, keepdim=True)).mT @ marks(places.device)  # sum_k (p_k - centre) u_k^T
    thickness = torch.linalg.svdvals(spread)[:, 1] / (1.5 * lever)  # 1 for an unbent triangle
    if bool((thickness < FLATTEST_TRIANGLE_LEVERS).any()):
        what = f"row {int((thickness < FLATTEST_TRIANGLE_LEVERS).nonzero()[0])}: the points of the pose lie on one line"
        raise InputError.of(what, expected=f"a triangle with corners {lever:g} m from its centre")
    return poses_of_triangles(places)


def poses_of_triangles(points: Tensor) -> Tensor:
    """The poses (..., 4, 4) of points (..., 3, 3), m, that are not on a line, in closed form, differentiable by torch.

    The points' directions u_k have no third coordinate, so that the first two columns of R are the polar factor of
    A = sum_k (p_k - t) u_k^T, (3, 2): A M^-1/2 with M = A^T A, and M^-1/2 = (tr(M) + s - M) / (s sqrt(tr(M) + 2 s)),
    s = sqrt(det M).
    """
    centre = points.mean(-2)
    A = (points - centre[..., None, :]).mT @ marks(points.device).to(points.dtype)[:, :2]  # (..., 3, 2)
    x, y = A.unbind(-1)
    xx, xy, yy = ((a * b).sum(-1, keepdim=True) for a, b in ((x, x), (x, y), (y, y)))
    s = (xx * yy - xy * xy).sqrt()
    scale = 1.0 / (s * (xx + yy + 2.0 * s).sqrt())
    first, second = ((yy + s) * x - xy * y) * scale, ((xx + s) * y - xy * x) * scale
    third = torch.linalg.cross(first, second)
    return transforms(torch.stack([first, second, third], -1), centre)


def mark_jacobian(poses: Tensor, lever: float) -> Tensor:
    """Derivatives (..., 9, 6) of the points of poses (..., 4, 4), m, by a shift dt, m, and a small rotation dw, rad.

    dp_k = dt + dw x (p_k - t), about the axes of the measuring frame; coordinates of a point are adjacent.
    """
    return _by_motion(_arms(poses, lever)).flatten(-3, -2)


def pose_directions(poses: Tensor, lever: float) -> Tensor:
    """Derivatives of (dt, dw) by the three points, as poses_from_marks to first order: (..., 4, 4) -> (..., 6, 9)."""
    J = mark_jacobian(poses, lever)
    return torch.linalg.solve(J.mT @ J, J.mT)  # least squares; J^T J is well-conditioned


def angle_between(R: Tensor, S: Tensor) -> Tensor:
    """Angle of the rotation from R to S: (..., 3, 3), (..., 3, 3) -> (...) rad, accurate near 0 and near pi too."""
    D = R.mT @ S
    sine = (D - D.mT).flatten(-2).norm(dim=-1) / 8**0.5
    cosine = (D.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.atan2(sine, cosine)


def check_lever(lever: object) -> None:
    """Raise InputError unless this is a positive distance."""
    check_number(lever, "`lever`, the distance in m of the points that represent a pose", above=0.0)


def _arms(poses: Tensor, lever: float) -> Tensor:
    """From the frame's origin to its points: (..., 3 points, 3)."""
    check_lever(lever)
    return float(lever) * (marks(poses.device) @ poses[..., :3, :3].mT)


def by_frame(values: Tensor) -> Tensor:
    """Poses (N, 4, 4) or (N, T, 4, 4), or covariances of the same form, as those of T frames: (N, T, k, k)."""
    return values if values.ndim == 4 else values[:, None]


def of_frames(values: Tensor) -> Tensor:
    """The inverse of :func:`by_frame`."""
    return values[:, 0] if values.shape[1] == 1 else values


def checked_frames(poses: object) -> Tensor:
    """Check poses (N, 4, 4) or (N, T, 4, 4) and return the nearest rigid ones (N, T, 4, 4), NaN where hidden.

    Raises:
        InputError: wrong shape, values that are not finite, no rigid transform, or a row without any frame.
    """
    given = real_tensor(poses, "poses").detach()
    if given.ndim != 4 or given.shape[1] < 2:
        return rigid_poses(given[:, 0] if given.ndim == 4 and given.shape[1] == 1 else given)[:, None]
    if given.shape[2:] != (4, 4):
        expected, got = "shape (N, 4, 4) or (N, T, 4, 4)", tuple(given.shape)
        raise InputError.of("`poses` has the wrong shape", expected=expected, got=got, fix=ONE_POSE)
    hidden = given.isnan().flatten(2).all(2)
    rows = hidden.all(1).nonzero()[:, 0].tolist()
    if rows:
        what = f"`poses`, row {rows[0]}: no frame was seen"
        raise InputError.of(what, expected="at least one in every row", fix="leave this row out")
    eye = torch.eye(4, dtype=given.dtype, device=given.device)
    count = given.shape[1]
    flat = torch.where(hidden[..., None, None], eye, given).flatten(0, 1)
    frames = rigid_poses(flat, lambda k: f"`poses`, row {k // count}, frame {k % count}").unflatten(0, (-1, count))
    return frames.masked_fill(hidden[..., None, None], torch.nan)


def points_of_frames(frames: Tensor, lever: float) -> Tensor:
    """The points that represent T frames, those of a frame adjacent: (N, T, 4, 4) -> (N, 3 T, 3) m."""
    return mark_points(frames, lever).flatten(1, 2)


def frames_of_points(points: Tensor, lever: float) -> Tensor:
    """The frames (N, T, 4, 4), NaN where hidden, of points (N, 3 T, 3), m; see :func:`poses_from_marks`."""
    triples = points.unflatten(1, (-1, POINTS))
    if wrapped(points):
        return poses_of_triangles(triples)
    visible = ~triples.isnan().flatten(2).any(2)
    frames = triples.new_full((*visible.shape, 4, 4), torch.nan)
    frames[visible] = poses_from_marks(triples[visible], lever)
    return frames


def transforms_of_frames(rotations: Tensor, places: Tensor) -> Tensor:
    """Poses (N, T, 4, 4) of rotations (N, T, 3, 3) and places (N, T, 3), m; NaN as a whole where either is."""
    frames = transforms(rotations, places)
    return frames.masked_fill(frames.isnan().any(3, keepdim=True).any(2, keepdim=True), torch.nan)


def from_spherical(numbers: Tensor, how: str) -> Tensor:
    """Places (..., 3), m, of distances, m, and angles, rad, see SPHERICAL of table_format."""
    distance, around, up = numbers.unbind(-1)
    sign, up = -1.0 if "clockwise" in how else 1.0, 0.5 * pi - up if "zenith" in how else up
    return torch.stack([around.cos() * up.cos(), sign * around.sin() * up.cos(), up.sin()], -1) * distance[..., None]


def to_spherical(places: Tensor, how: str) -> Tensor:
    """The inverse of :func:`from_spherical`."""
    x, y, z = places.unbind(-1)
    sign, flat = -1.0 if "clockwise" in how else 1.0, x.hypot(y)
    up = torch.atan2(flat, z) if "zenith" in how else torch.atan2(z, flat)
    return torch.stack([places.norm(dim=-1), torch.atan2(sign * y, x), up], -1)


def directions_of_frames(frames: Tensor, lever: float) -> Tensor:
    """Derivatives of all (dt, dw) by all points, see :func:`pose_directions`: (N, T, 4, 4) -> (N, 6 T, 9 T)."""
    return block_diagonal(pose_directions(frames, lever))


def block_diagonal(blocks: Tensor) -> Tensor:
    """Blocks (N, T, a, b) along the diagonal of matrices (N, T a, T b)."""
    eye = torch.eye(blocks.shape[1], dtype=blocks.dtype, device=blocks.device)
    return torch.einsum("ntab,ts->ntasb", blocks, eye).flatten(3, 4).flatten(1, 2)


def own_blocks(matrix: Tensor, count: int) -> Tensor:
    """The ``count`` blocks on the diagonal of matrices (N, m, m): (N, count, m / count, m / count)."""
    index, size = torch.arange(count, device=matrix.device), matrix.shape[1] // count
    return matrix.view(len(matrix), count, size, count, size)[:, index, :, index, :].movedim(0, 1)


def frame_tips(on: Sequence[str] | None, frames: int) -> tuple[str, ...]:
    """Names of measured frames: those of their tips, or frame1, frame2, ... where these are not known.

    Args:
        on: names of the tips of their points, in threes. frames: how many there are.
    """
    tips = tuple(on[::POINTS]) if on is not None else ()
    return tips if len(set(tips)) == frames else tuple(f"frame{k + 1}" for k in range(frames))


def kind_of_points(points: int, lever: float | None) -> str:
    """Phrase for a number of points, such as "2 marker(s)", "poses" or "poses on 2 tips"."""
    frames = points // POINTS
    return f"{points} marker(s)" if lever is None else f"poses on {frames} tips" if frames > 1 else "poses"


def inverse_poses(poses: Tensor) -> Tensor:
    """Camera in the board's frame from board in the camera's frame, or the other way round: (..., 4, 4)."""
    turned = poses[..., :3, :3].mT
    inverse = transforms(turned, -(turned @ poses[..., :3, 3:])[..., 0])
    return torch.where(poses.isnan(), poses, inverse)


def _by_motion(arms: Tensor) -> Tensor:
    """Derivatives (..., 3, 6) of points at arms (..., 3) by a shift and a small rotation of what carries them."""
    return torch.cat([torch.eye(3, dtype=arms.dtype, device=arms.device).expand(*arms.shape, 3), -skew(arms)], -1)


def pose_jacobian(poses: Tensor, lever: float, board: Tensor | None) -> Tensor:
    """Derivatives (N, T, 9, 6) of the three points of each frame by the errors of measured poses.

    Those of a camera on the tool are by errors (-dt, -dw) of the board's pose: shift, m, and turn, rad, along and about
    the axes of the camera. Coordinates of a point are adjacent.
    poses: (N, T, 4, 4), m, NaN where hidden; T is 1 for a camera. lever: distance of the points, m.
    board: (N, 3) its origin in the camera's frame, m; None if the measuring device stood and saw the tool.
    """
    if board is None:
        return mark_jacobian(poses, lever)
    arms = lever * marks(poses.device) - board[:, None]  # (N, point, 3) from the board, in the camera's frame
    return (poses[:, :, None, :3, :3] @ _by_motion(arms)[:, None]).flatten(2, 3)
