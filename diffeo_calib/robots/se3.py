"""Rotations and rigid transforms: exponential map, its Jacobian, checks, the nearest rotation.

Symbols: ``w`` is a rotation vector [rad], ``[w]x`` its cross-product matrix, ``t`` a translation [m]. A twist is
(t, w), translation first. All functions but :func:`rigid` take leading batch dimensions, keep device and dtype, and are
differentiable by torch. Reference: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in
robotics", 2018.
"""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, cos, pi, sin

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, wrapped
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.runtime.chain import smooth

RIGID_TOLERANCE = 1e-6  # largest accepted entry of |R^T R - 1|: text files carry six digits or more
TOLERANCE = 1e-3
"""Measured quaternions and matrices may be off by this, because files have few digits; the nearest rotation is used."""
ROUNDING = 2e-15  # entries of R^T R - 1 that are rounding alone: such matrices are rotations already
ONE_POSE = "pass one rigid transform per row, (N, 4, 4), or one for each of T tips, (N, T, 4, 4)"

Place = Callable[[int], str]  # names a row in messages


def skew(vectors: Tensor) -> Tensor:
    """Cross-product matrices: (..., 3) -> (..., 3, 3), ``skew(a) @ b = a x b``."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, dim=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.stack(rows, dim=-2)


def rotation(w: Tensor) -> Tensor:
    """exp([w]x), Rodrigues: rotation vectors (..., 3) [rad] -> rotation matrices (..., 3, 3)."""
    x, W = (w * w).sum(-1)[..., None, None], skew(w)
    unit = torch.eye(3, dtype=w.dtype, device=w.device)
    sine, versine = _sine_and_versine(x)
    return unit + sine * W + versine * (W @ W)


def roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Tensor:
    """Rz(yaw) Ry(pitch) Rx(roll), the convention of URDF files: angles [rad] -> float64 (3, 3) on the CPU."""
    (ci, cj, ck), (si, sj, sk) = ([f(angle) for angle in (roll, pitch, yaw)] for f in (cos, sin))
    rows = [
        [cj * ck, sj * si * ck - ci * sk, sj * ci * ck + si * sk],
        [cj * sk, sj * si * sk + ci * ck, sj * ci * sk - si * ck],
        [-sj, cj * si, cj * ci],
    ]
    return torch.tensor(rows, dtype=torch.float64, device="cpu")


def roll_pitch_yaw_angles(matrix: Tensor) -> list[float]:
    """The inverse of :func:`roll_pitch_yaw`: rotation (3, 3) -> roll, pitch, yaw [rad], the pitch within 90 degrees.

    Exact to rounding also at a pitch of 90 degrees, where roll and yaw turn about one axis: whatever the roll is, the
    rotation that remains without it is Rz(yaw) Ry(pitch), whose angles are well determined.
    """
    roll = atan2(*matrix[2, 1:].tolist())
    rest = (matrix @ roll_pitch_yaw(roll, 0.0, 0.0).to(matrix).mT).tolist()
    return [roll, atan2(-rest[2][0], rest[2][2]), atan2(-rest[0][1], rest[1][1])]


def right_jacobian(w: Tensor) -> Tensor:
    """Jr of SO(3), exp([w + e]x) = exp([w]x) exp([Jr(w) e]x) to first order: (..., 3) -> (..., 3, 3)."""
    x, W = (w * w).sum(-1)[..., None, None], skew(w)
    unit = torch.eye(3, dtype=w.dtype, device=w.device)
    return unit - _sine_and_versine(x)[1] * W + smooth(x, 3, lambda a: (a - a.sin()) / a**3, torch.where) * (W @ W)


def transforms(rotations: Tensor, translations: Tensor) -> Tensor:
    """Rigid transforms [[R, t], [0, 0, 0, 1]]: (..., 3, 3), (..., 3) [m] -> (..., 4, 4)."""
    top = torch.cat([rotations, translations[..., None]], dim=-1)
    bottom = torch.nn.functional.pad(torch.ones_like(top[..., :1, :1]), (3, 0))  # [0, 0, 0, 1]
    return torch.cat([top, bottom], dim=-2)


def twist_transform(twists: Tensor) -> Tensor:
    """T(t, w) = [[exp([w]x), t], [0, 1]]: twists (..., 6) [m, rad] -> rigid transforms (..., 4, 4).

    This is not the screw exponential: the translation is t itself.
    """
    return transforms(rotation(twists[..., 3:]), twists[..., :3])


def twist_at(place: Tensor) -> Tensor:
    """(6, 6) from the shift of a body at the origin, and its turn, to those at a place (3,), m."""
    there = torch.eye(6, dtype=place.dtype, device=place.device)
    there[:3, 3:] = -skew(place)
    return there


def nearest_rotations(matrices: Tensor) -> Tensor:
    """The proper rotations nearest in the Frobenius norm: any matrices (..., 3, 3) -> (..., 3, 3).

    With M = U S V^T it is U diag(1, 1, det(U V^T)) V^T: a reflection is undone where it costs least.
    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    U, _, Vt = torch.linalg.svd(matrices)
    signs = torch.ones_like(matrices[..., 0])
    signs[..., 2] = torch.linalg.det(U @ Vt).sign()
    return (U * signs[..., None, :]) @ Vt


def checked_rotations(matrices: Tensor, place: Place = "row {}".format) -> Tensor:
    """The rotations nearest to matrices that are rotations up to rounding: (N, 3, 3) -> (N, 3, 3).

    Raises:
        InputError: a matrix that is off by more than 0.001 (row named).
    """
    away = (matrices.mT @ matrices - torch.eye(3, dtype=matrices.dtype, device=matrices.device)).abs().amax((1, 2))
    bad = ~(away <= TOLERANCE) | (torch.linalg.det(matrices) < 0)
    if bad.any():
        row = int(bad.nonzero()[0])
        mirrored = float(away[row]) <= TOLERANCE
        got = "a determinant of -1, a mirrored frame" if mirrored else f"R^T R - 1 of up to {float(away[row]):.2g}"
        expected = f"a rotation matrix, orthonormal to {TOLERANCE:g}"
        fix = "check that the entries come row by row and without a scale"
        raise InputError.of(place(row), expected=expected, got=got, fix=fix)
    exact = len(away) > 0 and float(away.max()) <= ROUNDING
    return matrices if exact else nearest_rotations(matrices)


def rigid_poses(poses: object, place: Place = "`poses`, row {}".format) -> Tensor:
    """The rigid poses nearest to poses [[R, t], [0, 0, 0, 1]]: (N, 4, 4) -> (N, 4, 4).

    Raises:
        InputError: wrong shape, values that are not finite, a last row other than [0, 0, 0, 1], or an R that is not a
            rotation.
    """
    frames = as_tensor(poses, "poses", ("N", 4, 4), fix=ONE_POSE).detach()
    bad = ((frames[:, 3] - frames.new_tensor([0.0, 0.0, 0.0, 1.0])).abs() > TOLERANCE).any(1)
    if bad.any():
        row = int(bad.nonzero()[0])
        what, fix = f"{place(row)}: the last row of the transform", "pass [[R, t], [0, 0, 0, 1]], not its transpose"
        raise InputError.of(what, expected=[0, 0, 0, 1], got=frames[row, 3].tolist(), fix=fix)
    return transforms(checked_rotations(frames[:, :3, :3], place), frames[:, :3, 3])


def rigid(value: object, name: str) -> Tensor:
    """Convert to a float64 (4, 4) rigid transform; ``name`` is used in messages.

    Raises RobotError: a last row other than (0, 0, 0, 1), or a corner that is not a proper rotation.
    """
    matrix = as_tensor(value, name, (4, 4))
    corner = matrix[:3, :3]
    away = (corner.mT @ corner - torch.eye(3, dtype=matrix.dtype, device=matrix.device)).abs().max()
    bottom = matrix[3] - torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=matrix.dtype, device=matrix.device)
    if float(away) > RIGID_TOLERANCE or float(torch.linalg.det(corner)) < 0 or float(bottom.abs().max()) > 0:
        expected = "a rigid transform [[R, t], [0, 0, 0, 1]] with R^T R = 1 and det R = 1"
        raise RobotError.of(name, expected=expected, got=matrix.detach().tolist(), fix="correct the matrix")
    return matrix


def _sine_and_versine(x: Tensor) -> tuple[Tensor, Tensor]:
    """sin(a) / a and (1 - cos a) / a^2 for x = a^2; by a fifth of the operations where x is not differentiated."""
    if x.requires_grad or wrapped(x):
        return smooth(x, 1, lambda a: a.sin() / a, torch.where), smooth(x, 2, _versine, torch.where)
    a = x.sqrt() / pi
    return torch.sinc(a), 0.5 * torch.sinc(0.5 * a).square()


def _versine(a: Tensor) -> Tensor:
    return 2 * ((a / 2).sin() / a) ** 2  # (1 - cos a) / a^2 without cancellation
