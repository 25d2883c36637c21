"""Find the base of a robot and the markers on its tool from measured points, without a start value."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product
from math import sqrt
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import (
    Identification,
    Prior,
    checked_rows,
    in_mm,
    rms_distance,
)
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.robots.chain import Chain
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import nearest_rotations, rotation, skew

UNDETERMINED_MOTION_M = 1e-5
"""A direction is undetermined if its unit step (1 m or 1 rad) moves the points by less than this RMS distance [m]."""
MAX_ITERATIONS = 100
"""Of Levenberg-Marquardt on the rotation; about ten are usual."""
CONVERGED_TURN_RAD = 1e-13
"""The iteration ends when the best rotation changes by less [rad]."""
ROUNDING_INCREASE = 1e-12
"""Relative increase of the sum of squares that is attributed to rounding, so that the last steps are accepted."""
SMALLEST_DAMPING_M2 = 1e-30
"""Keeps the normal equations of a robot that does not move invertible [m^2]."""


def register(robot: Chain | Geometry, q: Tensor, points: Tensor) -> Identification:
    """Find the base and the markers of a robot in the frame of the measuring device, joint errors untouched.

    Minimises sum |B (R_i c_k + t_i) - y_ik|^2 over the base B and the markers c_k, (R_i, t_i) the tip's poses.
    No start is needed: for a given rotation all other unknowns are linear. Eliminating them leaves a quadratic on
    SO(3), which Levenberg-Marquardt minimises from 25 rotations (24 of the cube, and the linear solution).

    Args:
        robot: a chain, or a geometry whose joint errors are kept (its base and markers are not used).
        q: (N, n) joint values [rad or m].
        points: (N, P, 3) measured markers [m].

    Raises:
        InputError: wrong shapes, or values that are not finite.
        MeasurementError: fewer measured coordinates than unknowns (6 + 3 P), or numbers of rows that differ.
    """
    chain = robot.chain if isinstance(robot, Geometry) else robot
    q, points = checked_rows(chain, q, points)
    bare = Geometry.nominal(chain, points.shape[1])
    if isinstance(robot, Geometry):
        bare = replace(bare, joint_errors=robot.joint_errors)
    unknowns = 6 + 3 * bare.markers
    if points.numel() < unknowns:
        need = -(-unknowns // (3 * bare.markers))
        what = f"{unknowns} unknowns (base 6, markers {3 * bare.markers}) cannot be found"
        expected, got = f"at least {need} poses", f"{len(q)}, that is {points.numel()} coordinates"
        raise MeasurementError.of(what, expected=expected, got=got, fix="measure more poses")
    problem = _reduce(bare.poses(q), points)
    turn, iterations = _best_rotation(problem.factor)
    base, tool = _place(problem, turn)
    geometry = replace(bare, base=base, tool=tool)
    return _registered(geometry, q, points, iterations)


class _Reduced(NamedTuple):
    """Registration with everything but the rotation eliminated, see :func:`_reduce`."""

    factor: Tensor  # (10, 10) or fewer rows: |factor [vec B; -1]|^2 is the sum of squares
    by_turn: Tensor  # (3 N P, 9) and
    fixed: Tensor  # (3 N P,): left-hand side by_turn vec(B) - fixed, centred
    tool_inverse: Tensor  # (3 P, 3 N P) pseudo-inverse for the markers
    poses: Tensor  # (N, 4, 4)
    centre: Tensor  # (3,) mean of the points [m]


def _reduce(poses: Tensor, points: Tensor) -> _Reduced:
    """Eliminate markers and translation from  B (y_ik - y0) - t_i = R_i c_k + s,  B the inverse base rotation.

    The equations are linear in (vec B, c, s). Centring eliminates s, a projection eliminates c, and a QR factor
    represents the result without forming normal equations. Where the poses leave the markers undetermined (a planar
    arm, a tool that never turns), the markers of smallest norm are taken and the base accounts for the difference.
    """
    N, P, _ = points.shape
    centre = points.mean(dim=(0, 1))
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    own = torch.eye(P, dtype=points.dtype, device=points.device)
    by_turn = torch.einsum("ac,nkb->nkacb", eye, points - centre).reshape(N * P, 3, 9)
    fixed = poses[:, None, :3, 3].expand(N, P, 3).reshape(N * P, 3)
    by_tool = torch.einsum("nab,kl->nkalb", poses[:, :3, :3], own).reshape(N * P, 3, 3 * P)
    by_turn, fixed, by_tool = ((part - part.mean(dim=0)).flatten(0, 1) for part in (by_turn, fixed, by_tool))
    U, s, Vt = torch.linalg.svd(by_tool, full_matrices=False)
    kept = s > UNDETERMINED_MOTION_M * sqrt(N)
    U, s, Vt = U[:, kept], s[kept], Vt[kept]
    both = torch.cat([by_turn, fixed[:, None]], dim=1)
    factor = torch.linalg.qr(both - U @ (U.mT @ both), mode="r").R
    return _Reduced(factor, by_turn, fixed, (Vt.mT / s) @ U.mT, poses, centre)


def _place(problem: _Reduced, B: Tensor) -> tuple[Tensor, Tensor]:
    """Base (4, 4) and markers (P, 3) that belong to the inverse base rotation B (3, 3)."""
    tool = (problem.tool_inverse @ (problem.by_turn @ B.flatten() - problem.fixed)).reshape(-1, 3)
    seen = tool @ problem.poses[:, :3, :3].mT + problem.poses[:, None, :3, 3]  # in the robot's base
    base = torch.eye(4, dtype=B.dtype, device=B.device)
    base[:3, :3] = B.mT
    base[:3, 3] = problem.centre - B.mT @ seen.mean(dim=(0, 1))
    return base, tool


def _best_rotation(factor: Tensor) -> tuple[Tensor, int]:
    """Minimise |factor [vec B; -1]|^2 over rotations by Levenberg-Marquardt, all starts at once: best B, steps."""
    F, f = factor[:, :9], factor[:, 9]
    linear = torch.linalg.lstsq(F, f[:, None], driver="gelsd").solution.reshape(3, 3)
    B = torch.cat([nearest_rotations(linear)[None], _cube_rotations(factor.device)])  # (starts, 3, 3)
    eye = torch.eye(3, dtype=factor.dtype, device=factor.device)
    generators = skew(eye)  # d (B exp([w]x)) / dw_c = B generators[c] at w = 0
    loss = (B.flatten(1) @ F.mT - f).square().sum(1)
    damping = torch.full_like(loss, 1e-3)
    for step in range(MAX_ITERATIONS):
        r = B.flatten(1) @ F.mT - f
        J = (B[:, None] @ generators).flatten(2) @ F.mT  # (starts, 3, rows)
        H = J @ J.mT
        scale = damping * H.diagonal(dim1=1, dim2=2).sum(1) + SMALLEST_DAMPING_M2
        delta = -torch.linalg.solve(H + scale[:, None, None] * eye, J @ r[..., None])[..., 0]
        trial = B @ rotation(delta)
        new = (trial.flatten(1) @ F.mT - f).square().sum(1)
        better = new <= loss * (1 + ROUNDING_INCREASE)
        B, loss = torch.where(better[:, None, None], trial, B), torch.where(better, new, loss)
        damping = torch.where(better, damping / 10, damping * 10).clamp(1e-15, 1e6)
        if float(delta[loss.argmin()].norm()) < CONVERGED_TURN_RAD:
            return B[loss.argmin()], step + 1
    return B[loss.argmin()], MAX_ITERATIONS


def _cube_rotations(device: torch.device) -> Tensor:
    """The 24 rotations of the cube (24, 3, 3)."""
    eye = torch.eye(3, dtype=torch.float64, device=device)
    signed = [
        eye[list(order)] * torch.tensor(signs, dtype=torch.float64, device=device)
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return torch.stack([matrix for matrix in signed if float(torch.linalg.det(matrix)) > 0])


def _registered(geometry: Geometry, q: Tensor, points: Tensor, iterations: int) -> Identification:
    """Residual, covariance and status of a registration."""
    parts = geometry.slices
    places = [*range(parts["base"].start, parts["base"].stop), *range(parts["tool"].start, parts["tool"].stop)]
    sought = torch.tensor(places, device=q.device)
    slopes = geometry.sensitivities(q)[..., sought].flatten(0, 2)  # (3 N P, 6 + 3 P)
    _, s, Vt = torch.linalg.svd(slopes, full_matrices=False)
    count = points[..., 0].numel()
    kept = s > UNDETERMINED_MOTION_M * sqrt(count)
    rank, rms = int(kept.sum()), rms_distance(geometry, q, points)
    noise = rms * sqrt(count / max(points.numel() - rank, 1))
    covariance = torch.zeros(geometry.size, geometry.size, dtype=q.dtype, device=q.device)
    block = (Vt[kept].mT / s[kept].square() * noise**2) @ Vt[kept]
    covariance[sought[:, None], sought] = block
    done = "converged" if iterations < MAX_ITERATIONS else "stopped before converging"
    status = f"{done} after {iterations} steps: {in_mm(rms, noise, 'estimated')}"
    if rank < len(sought):
        status += (
            f"; these poses leave {len(sought) - rank} of {len(sought)} directions of base and markers undetermined"
            " (chosen so that the markers are close to the tip): turn more joints, above all the wrist"
        )
    elif points.numel() == rank:
        status += (
            "; there are only as many coordinates as unknowns, so other bases and markers may fit as well: measure "
            "more poses"
        )
    tails = Tails.none(len(q), geometry.markers, device=q.device)
    theta = torch.zeros(geometry.size, dtype=q.dtype, device=q.device)
    return Identification(geometry, rms, noise, covariance, iterations, status + ".", theta, Prior(), tails)
