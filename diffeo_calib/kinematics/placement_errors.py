"""How well a model knows a tool apart from what a cell teaches anyway: where the base stands, how the tool is mounted.

The errors e of three points of the tool at configurations X all over the model's own are split into what a motion of
the base and one of the tool on its flange explain, w = S(X)^+ e(X) with S(X) their derivatives by both motions, and the
rest, which counts: at the commands x it is e(x) - S(x) w.

Devices that measure one marker, and rows in sockets or readings even more, leave these two motions open to millimetres:
errors of the first joint look like one of the base, those of the last one like one of the tool.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.flange_points import FlangePoints
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap, frame_slopes, marker_slopes
from diffeo_calib.kinematics.tool import ToolKinematics, tool_points
from diffeo_calib.measurements.poses import pose_directions, poses_from_marks
from diffeo_calib.runtime.program import TOOL_LEVER

REFERENCE_ROWS = 40
"""Most configurations of the model over which the two motions are found."""
SMALLEST_MOTION = 1e-9
"""Of a motion, relative to the largest: smaller ones are the same for base and tool, as a SCARA robot's lift is."""


def covariance_without_placement(
    model: CalibratedKinematics, q: Tensor, tool: Tensor, tip: str | None = None
) -> Tensor:
    """Covariances (M, 6, 6) of a tool's shifts [m] and turns [rad], about the axes of the measuring frame.

    Args:
        model: the calibrated model. q: (M, n) joint values, rad or m.
        tool: (4, 4) tool centre point in the tip's frame, m. tip: that carries it, for a robot with several.
    """
    fitted = model.map.fitted if isinstance(model.map, RegisteredMap) else model.map
    kinematics = ToolKinematics(fitted, model.nominal, tool, "measuring", tip or model.tool_tip)
    known = model.configurations
    every = torch.linspace(0, len(known) - 1, min(len(known), REFERENCE_ROWS), dtype=torch.float64, device=known.device)
    rows = torch.cat([known[every.round().long()], q.detach()])
    points, at = kinematics.deformation.linearised_value(rows)
    covariance = fitted.covariance_between(at)  # directions that the data leave open are those of both motions
    points = points.unflatten(1, (3, 3))
    motions = _motions(kinematics, rows, points).flatten(0, 1)  # (9 (R + M), 12)
    reference, own = motions.split([9 * len(every), 9 * len(q)])
    eye = torch.eye(len(own), dtype=own.dtype, device=own.device)
    rest = torch.cat([-own @ torch.linalg.pinv(reference, rtol=SMALLEST_MOTION), eye], 1)
    seen = poses_from_marks(points[len(every) :], TOOL_LEVER)
    rest = pose_directions(seen, TOOL_LEVER) @ rest.unflatten(0, (-1, 9))  # (M, 6, 9 (R + M))
    return rest @ covariance @ rest.mT


def _motions(kinematics: ToolKinematics, q: Tensor, points: Tensor) -> Tensor:
    """Derivatives of points (N, 3, 3) by a motion of the base and one of the tool on its flange: (N, 9, 12)."""
    base = frame_slopes(points, points.mean((0, 1)))
    own = tool_points(kinematics.tool).to(points)
    flange = FlangePoints(kinematics.nominal, own, on=(kinematics.tip,) * 3)
    by_place = marker_slopes(kinematics.deformation, flange, q)
    return torch.cat([base, by_place @ frame_slopes(own[None], own.mean(0))[0]], 2)
