"""Errors that are those of a moved device or a moved marker: the best rigid motion, and how much it explains."""

from __future__ import annotations

from math import degrees
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.quantiles import known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.re_registration.registered_map import marker_slopes
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import rigid_fit

LEAST_EXPLAINED = 0.5
"""Part of the squared error, per degree of freedom, that a motion must explain."""
LEAST_EXCESS = 2.0
"""Errors below this multiple of the expected ones are not examined."""
MOST_LEFT = 5.0
"""Errors that remain may be this multiple of the expected ones: a wrong unit is no motion."""
AS_GOOD = 0.02
"""Motions that explain nearly as much as the best one are named, too."""
MOST_ROWS, MOST_EXPECTED = 500, 100
"""Rows that are looked at, and those from which the typical expected error is found."""


class Motion(NamedTuple):
    """A motion that explains errors.

    Args:
        what: "the measuring device" or "the marker". shift: m, of the device at the middle of the rows.
        turn: rad, 0 for a marker. explained: part of the squared error.
        left: (N, m) the errors that remain, m, NaN where hidden.
    """

    what: str
    shift: float
    turn: float
    explained: float
    left: Tensor

    @property
    def sentence(self) -> str:
        """Such as ``moving the measuring device by 12.3 mm and 0.4 degrees explains 95 % of the squared error``."""
        turn = f" and {degrees(self.turn):.2g} degrees" if self.turn else ""
        share = f"explains {100 * self.explained:.4g} % of the squared error"
        return f"moving {self.what} by {1e3 * self.shift:.3g} mm{turn} {share}"


def motions(model: CalibratedKinematics, data: Measurements) -> list[Motion]:
    """The motions that explain most of a model's errors on rows of its markers, the best first; or none."""
    data, some = (data.rows(slice(None, None, -(-len(data) // most))) for most in (MOST_ROWS, MOST_EXPECTED))
    laden = model.at_payloads(data.payload)
    mean = laden(data.q).detach()
    covariance = model.at_payloads(some.payload).map.posterior(some.q)[1]
    expected = float(covariance.diagonal(dim1=1, dim2=2).mean(1).median())

    def size(errors: Tensor) -> float:
        """Median of the mean squares of the rows' known coordinates."""
        return float(errors.flatten(1).square().nanmean(1).median())

    if size(data.points - mean) < LEAST_EXCESS**2 * expected:
        return []
    found = [_device(mean, data.points), _marker(laden, data.q, (data.points - mean).flatten(1))]
    found = [each for each in found if size(each.left) < MOST_LEFT**2 * expected]
    least = max([LEAST_EXPLAINED, *(each.explained - AS_GOOD for each in found)])
    return sorted((each for each in found if each.explained >= least), key=lambda motion: -motion.explained)


def _device(predicted: Tensor, measured: Tensor) -> Motion:
    T = rigid_fit(predicted.flatten(0, 1), measured.flatten(0, 1))
    left = measured - predicted @ T[:3, :3].mT - T[:3, 3]
    shift = float((measured - predicted).nanmean((0, 1)).norm())
    turn = float(angle_between(torch.eye(3, dtype=T.dtype, device=T.device), T[:3, :3]))
    return Motion("the measuring device", shift, turn, _explained(measured - predicted, left, 6), left)


def _marker(model: CalibratedKinematics, q: Tensor, errors: Tensor) -> Motion:
    points = FlangePoints(model.nominal, model.geometry.tool, same=True)
    geodesic, seen = model.map.geodesic.with_nominal(points), ~errors.isnan()
    slopes = marker_slopes(geodesic, points, geodesic.linearise(q))  # (N, m, m)
    step = torch.linalg.lstsq(slopes[seen], errors[seen][:, None], driver="gelsd").solution[:, 0]
    left = errors - slopes @ step
    shift = step.view(-1, 3).norm(dim=1)
    what = f"{model.bodies.moved_words(len(shift))} on the flange"
    return Motion(what, float(shift.max()), 0.0, _explained(errors, left, len(step)), left)


def _explained(before: Tensor, after: Tensor, unknowns: int) -> float:
    """1 - mean square after / before, per degree of freedom."""
    before, after = known(before), known(after)
    freedom = len(before) - unknowns
    if freedom <= 0:
        return 0.0
    squares = float(after.square().sum()) / freedom, float(before.square().sum()) / len(before)
    return 1.0 - squares[0] / squares[1]
