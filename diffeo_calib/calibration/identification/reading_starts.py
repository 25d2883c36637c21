"""Start values of ball and devices from readings alone, in closed form.

With the tip's poses (R_i, t_i) and the ball c, z_i = R_i c + t_i,

    |z - f|^2 = (l - o)^2:    t.t - 2 f.t + 2 c.(R^T t) - 2 f^T R c + (|c|^2 + |f|^2 - o^2) = l^2 - 2 o l
    n.z - d = h:              n.t + tr(R^T n c^T) - d = h,    |n| = 1

are linear in (f, c, f c^T, ...) and in (n, n c^T, d). Devices of a ball that is
known are found in kinematics/reading_devices.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.kinematics.reading_devices import KINDS, Devices, devices_at, least_squares, unit_least_squares
from diffeo_calib.measurements.readings import Readings

LONGEST_TOOL_M = 1.0
LARGEST_UNEXPLAINED, FEWEST_SPARE_ROWS = 1e-2, 5
"""Share of the heights' variance, and rows of a plane beyond its unknowns, that say something about their unit."""
LEAST_SHARE = 1e-4
"""Directions of the unknowns that data determine less than this, relative to the best one, are left at zero."""


def starts(data: Readings, R: Tensor, t: Tensor) -> list[tuple[Tensor, Devices]]:
    """Balls (3,) in the tip's frame, m, and devices: in closed form by each device, and with the ball at the tip.

    Args:
        data: the readings. R: (N, 3, 3), t: (N, 3), the tip's poses in the base, m.
    """
    found = [(torch.zeros(3, dtype=t.dtype, device=t.device), devices_at(data, t))]
    if data.kind == "image":
        return found
    rows = [data.device == number for number in range(len(data.names))]
    alone = [_alone(data.rows(own), R[own], t[own]) for own in rows]
    for ball, _ in alone:
        if float(ball.norm()) < LONGEST_TOOL_M:
            found.append((ball, devices_at(data, (R @ ball[:, None])[..., 0] + t)))
    constants = torch.stack([its for _, its in alone])
    middle = torch.stack([ball for ball, _ in alone]).median(0).values
    return [*found, (middle, KINDS[data.kind].of(data, constants))]


def height_factor(data: Readings, R: Tensor, t: Tensor) -> float:
    """Measured heights per height that the tip's poses explain, the largest of the planes; 1 where they explain none.

    Args:
        data: heights. R: (N, 3, 3), t: (N, 3), the tip's poses in the base, m.
    """
    factors = [1.0]
    for number in range(len(data.names)):
        own = data.device == number
        matrix, heights = torch.cat([t, R.flatten(1), -torch.ones_like(t[:, :1])], 1)[own], data.values[own, 0]
        spare = len(heights) - matrix.shape[1]
        if spare < FEWEST_SPARE_ROWS or not bool(heights.any()):
            continue
        found = least_squares(matrix, heights)
        unexplained = (heights - matrix @ found).square().sum() / spare
        if float(unexplained) < LARGEST_UNEXPLAINED * float(heights.var()):
            factors.append(float(found[:3].norm()))
    return max(factors)


def _alone(data: Readings, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Ball (3,) in the tip's frame, and constants (4,) of one device, from its own rows."""
    values, one = data.values[:, 0], torch.ones_like(data.values)
    if data.kind == "distance":
        columns = [-2 * t, 2 * (R.mT @ t[:, :, None])[..., 0], -2 * R.flatten(1), one]
        columns += [2 * values[:, None]] * bool(data.offset_std)
        found = least_squares(torch.cat(columns, 1), values**2 - t.square().sum(1))
        offset = found[16:17] if data.offset_std else found.new_zeros(1)
        return found[3:6], torch.cat([found[:3], offset])
    others = torch.cat([R.flatten(1), -one], 1)  # their unknowns follow from the normal
    basis = torch.linalg.svd(others, full_matrices=False)
    Q = basis.U[:, LEAST_SHARE * basis.S[0] < basis.S]
    t_left, values_left = t - Q @ (Q.mT @ t), values - Q @ (Q.mT @ values)
    n = unit_least_squares(t_left, values_left)
    found = least_squares(others, values - t @ n)
    return found[:9].view(3, 3).mT @ n, torch.cat([n, found[9:]])
