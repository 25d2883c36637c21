"""Where a robot stands and what it carries, from poses of its tip and measured points: closed forms, no start value.

    y_ik = B (R_ik c_k + t_ik)

with the poses (R_ik, t_ik) of the tip that carries marker c_k, and a rigid transform B. For a given rotation all other
unknowns are linear. Eliminating them leaves a quadratic on SO(3), which Levenberg-Marquardt minimises from 25 rotations
(24 of the cube, and the linear solution).

Markers are near the tip: c_k ~ N(0, 0.3 m). Without this prior a tool that hardly ever turns puts them metres away:
an error of the robot of a millimetre, divided by a turn of a milliradian, is a metre. Such errors are common to many
rows and do not average out, so that the prior weighs as much as all rows together. With tools that turn by a radian it
moves the markers by less than a micrometre.

What is known of the places of devices, bases and markers before any row is seen: one table of Gaussian priors.

A shift and a turn that have one number are known to as many metres as radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.robots.se3 import nearest_rotations, rotation, skew, transforms


@dataclass(frozen=True)
class PlacePriors:
    """Standard deviations."""

    marker_m: float = 0.3  # of a marker from the tip: no tool is larger
    # open_base_m, open_base_rad: of a base that the rows do not determine, around any place: a turn may be half of one
    open_base_m: float = 5.0
    open_base_rad: float = 2.0
    sought_base_m_rad: float = 1.0  # of a base or a measuring frame around the start of a search: no constraint
    found_m_rad: float = 0.1  # of a base, a marker, a device or a socket around the place where it was found: wide
    session_m_rad: float = 0.01  # of what remains between the frames of sessions after these were found
    remounted_m: float = 1e-3  # of a marker between sessions, or since the fit: a tool that was mounted again
    same_m: float = 5e-5  # of a marker that nobody touched since the fit
    other_m: float = 0.1  # of another one, around where it was found
    # same_registered_m, other_registered_m: the same two in a registration, around where the fit had the marker
    same_registered_m: float = 1e-5
    other_registered_m: float = 0.3


PLACES = PlacePriors()


UNDETERMINED_MOTION_M = 1e-5
"""A direction is undetermined if its unit step (1 m or 1 rad) moves the points by less than this RMS distance [m]."""
MAX_ITERATIONS = 100  # of damped Newton steps on the rotation; about ten are usual
CONVERGED_TURN_RAD = 1e-13  # the iteration ends when the best rotation changes by less [rad]
ROUNDING_INCREASE = 1e-12
"""Relative increase of the sum of squares that is attributed to rounding, so that the last steps are accepted."""
SMALLEST_DAMPING_M2 = 1e-30  # keeps the normal equations of a robot that does not move invertible [m^2]


class Placement(NamedTuple):
    """Base (4, 4) and markers (P, 3) in m; a marker that is never seen is at its tip."""

    base: Tensor
    tool: Tensor


def place(poses: Tensor, points: Tensor) -> Placement:
    """Minimise sum |B (R_i c_k + t_i) - y_ik|^2 + N (s / 0.3 m)^2 sum |c_k|^2 over the base B and the markers c_k.

    s is the residual per coordinate that remains without the prior.

    Args:
        poses: (N, P, 4, 4) of the markers' tips [m]. points: (N, P, 3) measured markers [m]; NaN where hidden.
    """
    visible, eye = ~points.isnan().any(2), torch.eye(points.shape[1], dtype=points.dtype, device=points.device)
    sightings = _Sightings(poses[visible], points[visible], eye.expand(len(points), -1, -1)[visible])
    base, tool = _solved(sightings, 0.0)
    left = sightings.points - sightings.predicted(tool) @ base[:3, :3].mT - base[:3, 3]
    return _solved(sightings, float(left.square().sum() / (3 * len(tool))) / PLACES.marker_m**2)


def rigid_fit(points: Tensor, targets: Tensor) -> Tensor:
    """The rigid transform T that minimises sum |T x_i - y_i|^2: (N, 3), (N, 3) -> (4, 4) [m].

    Pairs without a target (NaN) do not count.
    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    visible = ~targets.isnan().any(1)
    points, targets = points[visible], targets[visible]
    centre, aim = points.mean(0), targets.mean(0)
    turn = nearest_rotations((targets - aim).mT @ (points - centre))
    return transforms(turn, aim - turn @ centre)


class _Sightings(NamedTuple):
    """The S pairs of a row and a marker that was seen in it."""

    poses: Tensor  # (S, 4, 4) of the marker's tip [m]
    points: Tensor  # (S, 3) [m]
    own: Tensor  # (S, P) one in the column of the marker, else zero

    def predicted(self, tool: Tensor) -> Tensor:
        """Markers (P, 3) in the robot's base: (S, 3) [m]."""
        return (self.poses[:, :3, :3] @ (self.own @ tool)[..., None])[..., 0] + self.poses[:, :3, 3]


def _solved(sightings: _Sightings, weight: float) -> Placement:
    """Base and markers; ``weight`` of the sum of the squared norms of the markers.

    B (y_ik - y0) - t_ik = R_ik c_k + s, B the inverse base rotation, is linear in vec B, c, s. Centring eliminates s,
    a projection c, and a QR factor represents the rest without normal equations. Where the poses leave the markers
    undetermined (a planar arm, a tool that never turns), the markers of smallest norm are taken and the base accounts
    for the difference.
    """
    poses, points, weights = sightings
    S, P = weights.shape
    centre, eye = points.mean(0), torch.eye(3 * P, dtype=points.dtype, device=points.device)
    by_turn = torch.einsum("ac,sb->sacb", eye[:3, :3], points - centre).reshape(S, 3, 9)
    by_tool = torch.einsum("sab,sl->salb", poses[:, :3, :3], weights).reshape(S, 3, 3 * P)
    parts = (by_turn, poses[:, :3, 3:], by_tool)
    by_turn, fixed, by_tool = ((part - part.mean(dim=0)).flatten(0, 1) for part in parts)
    both = torch.cat([torch.cat([by_turn, fixed], 1), eye.new_zeros(3 * P, 10)])
    U, s, Vt = torch.linalg.svd(torch.cat([by_tool, sqrt(weight) * eye]), full_matrices=False)
    kept = s > UNDETERMINED_MOTION_M * sqrt(S / P)
    U, s, Vt = U[:, kept], s[kept], Vt[kept]
    factor = torch.linalg.qr(both - U @ (U.mT @ both), mode="r").R  # |factor [vec B; -1]|^2 is the sum of squares
    B = _best_rotation(factor)
    tool = ((Vt.mT / s) @ (U.mT @ (both[:, :9] @ B.flatten() - both[:, 9]))).reshape(-1, 3)
    base = transforms(B.mT, centre - B.mT @ sightings.predicted(tool).mean(dim=0))
    return Placement(base, tool)


def _best_rotation(factor: Tensor) -> Tensor:
    """The rotation B that minimises |factor [vec B; -1]|^2, by damped Newton steps from all starts at once.

    Gauss-Newton alone needs a hundred steps where the residuals are large: rows that do not belong to the robot.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  # slow to import, not needed to use a model

    F, f = factor[:, :9], factor[:, 9]
    linear = torch.linalg.lstsq(F, f[:, None], driver="gelsd").solution.reshape(3, 3)
    B = torch.cat([nearest_rotations(linear)[None], factor.new_tensor(Rotation.create_group("O").as_matrix())])
    eye = torch.eye(3, dtype=factor.dtype, device=factor.device)
    generators = skew(eye)  # d (B exp([w]x)) / dw_c = B generators[c] at w = 0
    pairs = generators[:, None] @ generators
    curvature = 0.5 * (pairs + pairs.transpose(0, 1))  # d^2 (B exp([w]x)) / dw_c dw_d = B curvature[c, d] at w = 0
    loss = (B.flatten(1) @ F.mT - f).square().sum(1)
    damping = torch.full_like(loss, 1e-3)
    for _ in range(MAX_ITERATIONS):
        r = B.flatten(1) @ F.mT - f
        J = (B[:, None] @ generators).flatten(2) @ F.mT  # (starts, 3, rows)
        H = J @ J.mT
        newton = H + ((B[:, None, None] @ curvature).flatten(3) @ F.mT @ r[:, None, :, None])[..., 0]
        convex = torch.linalg.cholesky_ex(newton).info == 0
        H = torch.where(convex[:, None, None], newton, H)
        scale = damping * H.diagonal(dim1=1, dim2=2).sum(1) + SMALLEST_DAMPING_M2
        delta = -torch.linalg.solve(H + scale[:, None, None] * eye, J @ r[..., None])[..., 0]
        trial = B @ rotation(delta)
        new = (trial.flatten(1) @ F.mT - f).square().sum(1)
        better = new <= loss * (1 + ROUNDING_INCREASE)
        B, loss = torch.where(better[:, None, None], trial, B), torch.where(better, new, loss)
        damping = torch.where(better, damping / 10, damping * 10).clamp(1e-15, 1e6)
        if float(delta[loss.argmin()].norm()) < CONVERGED_TURN_RAD:
            break
    return B[loss.argmin()]
