"""A calibrated model as constants: psi, the chain and phi^-1, evaluated for any points of the flange."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.common.threads import one_thread
from diffeo_calib.runtime.arrays import Array, cross
from diffeo_calib.runtime.chain import CalibratedChain, tip_poses
from diffeo_calib.runtime.flow import RecordedFlow

TOOL_LEVER = 0.1  # distance of the three points from a tool centre point, m; orientations hardly depend on it
LONGEST_TOOL = 1e3  # m; beyond it the three points of a tool lose digits
FEW_ROWS = 64
"""Queries of more rows are limited to one thread; fewer use no more, and the limit would take longer than they do."""
FRAMES = ("base", "measuring")
"""Frames in which poses are given: the robot's base as it was found, or that of the measuring device."""
MARKS = np.array([[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]])
"""Directions from a frame's origin to the three points that represent it; see measurements/poses.py."""


@dataclass(frozen=True, eq=False)
class Program:
    """k1(q; m) = psi(k0(phi^-1(q); m)) for points m of the flange, without torch."""

    joint_flow: RecordedFlow  # phi^-1
    chain: CalibratedChain  # k0
    task_flow: RecordedFlow  # psi
    markers: Array  # (P, 3) the measured markers in the frames of their tips [m]
    on: tuple[int, ...]  # numbers of the tips of the markers, P of them
    tip: int = 0  # number of the tip that carries other points

    def at(self, tip: str) -> Program:
        """Return the program for points on another tip."""
        return replace(self, tip=self.chain.nominal.tips.index(tip))

    def points(self, q: Array, points: Array | None = None) -> Array:
        """Points in the measuring frame: q (N, n), points (P, 3) in the tip's frame -> (N, P, 3) [m]."""
        points, on = self._placed(points)
        with one_thread() if len(q) > FEW_ROWS else nullcontext():
            tip = tip_poses(self.chain, self.joint_flow(q))[:, on]  # (N, P, 4, 4)
            placed = (tip[..., :3, :3] @ points[..., None])[..., 0] + tip[..., :3, 3]
            return self.task_flow(placed.reshape(-1, 3)).reshape(placed.shape)

    def _placed(self, points: Array | None) -> tuple[Array, list[int]]:
        """Points and the numbers of their tips: the markers if none are given."""
        return (self.markers, list(self.on)) if points is None else (points, [self.tip] * len(points))

    def points_and_jacobian(self, q: Array, points: Array | None = None) -> tuple[Array, Array]:
        """Points (N, P, 3) [m] and their derivatives (N, P, 3, n) [m/rad or m/m]."""
        points, on = self._placed(points)
        with one_thread() if len(q) > FEW_ROWS else nullcontext():
            xi, M = self.joint_flow.with_jacobian(q)
            tips, slopes = self.chain.poses_and_jacobian(xi)
            tip, slopes = tips[:, on], (slopes @ M[:, None])[:, on]  # (N, P, 4, 4), (N, P, 6, n)
            arms = (tip[..., :3, :3] @ points[..., None])[..., 0]  # (N, P, 3)
            turned = cross(slopes[:, :, 3:].swapaxes(2, 3), arms[:, :, None])  # (N, P, n, 3)
            placed = slopes[:, :, :3] + turned.swapaxes(2, 3)
            moved, bent = self.task_flow.with_jacobian((arms + tip[..., :3, 3]).reshape(-1, 3))
            return moved.reshape(arms.shape), bent.reshape(*arms.shape, 3) @ placed

    def poses(self, q: Array, tool: Array, frame: str) -> Array:
        """Poses (N, 4, 4) [m] in a frame of :data:`FRAMES` of a tool (4, 4) in the tip's frame, by points around it."""
        return self._to(frame) @ nearest_poses(self.points(q, tool_points(tool)))

    def poses_and_jacobian(self, q: Array, tool: Array, frame: str) -> tuple[Array, Array]:
        """Poses (N, 4, 4) and their derivatives (N, 6, n), linear, then angular velocity; see :meth:`poses`."""
        points, slopes = self.points_and_jacobian(q, tool_points(tool))
        poses, to_frame = nearest_poses(points), self._to(frame)
        velocities = pose_slopes(points, slopes, poses[:, :3, :3])
        return to_frame @ poses, np.kron(np.eye(2), to_frame[:3, :3]) @ velocities

    def _to(self, frame: str) -> Array:
        """(4, 4) from the measuring frame to another one."""
        return np.eye(4) if frame == "measuring" else inverse(self.chain.start)


def check_frame(frame: str) -> None:
    """Raise InputError unless this is one of :data:`FRAMES`."""
    if frame not in FRAMES:
        raise InputError.of("`frame`", expected=" or ".join(map(repr, FRAMES)), got=as_written(frame))


def inverse(transform: Array) -> Array:
    """The inverse of a rigid transform (4, 4)."""
    out, R = np.eye(4), transform[:3, :3].T
    out[:3, :3], out[:3, 3] = R, -R @ transform[:3, 3]
    return out


def tool_points(tool: Array) -> Array:
    """The three points around a tool (4, 4): (3, 3) [m]."""
    return tool[:3, 3] + TOOL_LEVER * (MARKS @ tool[:3, :3].T)


def nearest_poses(points: Array) -> Array:
    """The poses whose three points are nearest in the least-squares sense: (N, 3, 3) -> (N, 4, 4)."""
    centre = points.mean(axis=1)
    U, _, Vt = np.linalg.svd((points - centre[:, None]).swapaxes(1, 2) @ MARKS)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    out = np.zeros((len(points), 4, 4))
    out[:, :3, :3], out[:, :3, 3], out[:, 3, 3] = U @ Vt, centre, 1.0
    return out


def pose_slopes(points: Any, slopes: Any, R: Any, use: tuple[Any, Any, Any] = (np, MARKS, np.eye(3))) -> Any:
    """Derivative of the pose that fits three points best, exact also where they are not rigid.

    With S = sum_k (p_k - c) u_k^T = R P, R the rotation and P symmetric, a change dS turns R by R exp([b]x),

        (tr(P) 1 - P) b = axial(R^T dS - dS^T R).

    Args:
        points: (N, 3, 3) the three points, one per row [m]. slopes: (N, 3, 3, n) their derivatives by n parameters.
        R: (N, 3, 3) the rotations of the poses. use: an array library with its :data:`MARKS` and unit matrix.

    Returns (N, 6, n) velocity of the origin, then angular velocity, about the axes of the points' frame.
    """
    library, marks, unit = use
    centre, centred = slopes.mean(1), points - points.mean(1)[:, None]
    P = R.swapaxes(1, 2) @ (centred.swapaxes(1, 2) @ marks)
    dS = library.einsum("nkcj,kd->njcd", slopes - centre[:, None], marks)
    A = R.swapaxes(1, 2)[:, None] @ dS
    turns = A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]
    turning = library.einsum("nkk->n", P)[:, None, None] * unit - P
    return library.concatenate([centre, R @ library.linalg.solve(turning, library.stack(turns, 1))], 1)
