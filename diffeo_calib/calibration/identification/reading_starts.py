"""Start values of ball and devices from readings alone, in closed form.

With the tip's poses (R_i, t_i) and the ball c, z_i = R_i c + t_i,

    |z - f|^2 = (l - o)^2:    t.t - 2 f.t + 2 c.(R^T t) - 2 f^T R c + (|c|^2 + |f|^2 - o^2) = l^2 - 2 o l
    n.z - d = h:              n.t + tr(R^T n c^T) - d = h

are linear in (f, c, f c^T, ...) and in (n, n c^T, d). Devices of a ball that is
known are found in kinematics/reading_devices.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.kinematics.reading_devices import KINDS, SMALLEST_M, Devices, devices_at, least_squares
from diffeo_calib.measurements.readings import Readings

LONGEST_TOOL_M = 1.0


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


def _alone(data: Readings, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Ball (3,) in the tip's frame, and constants (4,) of one device, from its own rows."""
    values, one = data.values[:, 0], torch.ones_like(data.values)
    if data.kind == "distance":
        columns = [-2 * t, 2 * (R.mT @ t[:, :, None])[..., 0], -2 * R.flatten(1), one]
        columns += [2 * values[:, None]] * bool(data.offset_std)
        found = least_squares(torch.cat(columns, 1), values**2 - t.square().sum(1))
        offset = found[16:17] if data.offset_std else found.new_zeros(1)
        return found[3:6], torch.cat([found[:3], offset])
    matrix = torch.cat([t, R.flatten(1), -one, -values[:, None]], 1)
    matrix = matrix[:, :-1] if not bool(values.any()) else matrix
    # heights are far smaller than places: a free factor for them decides about the sign only
    scale = matrix.square().mean(0).sqrt().clamp(min=SMALLEST_M)
    found = torch.linalg.svd(matrix / scale, full_matrices=True).Vh[-1] / scale
    size = found[:3].norm() * (1.0 if len(found) < 14 or float(found[13]) >= 0 else -1.0)
    n = found[:3] / size
    return found[3:12].view(3, 3).mT @ n / size, torch.cat([n, found[12:13] / size])
