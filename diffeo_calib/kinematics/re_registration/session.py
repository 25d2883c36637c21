"""Start of a registration: the rows as the fitted map sees them, and the markers before."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.re_registration.estimate import Session, View, anywhere, at_old_places
from diffeo_calib.kinematics.re_registration.registered_map import Registration, turned
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.measurements.bodies import Body, bodies_of
from diffeo_calib.measurements.pose_frames import kind_of_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.se3 import skew

LEAST_POINTS = 3
"""Points that determine where a frame is."""


class Known(NamedTuple):
    """The rows, the markers before with their view, and whether the measured markers may be these."""

    session: Session
    old: Body
    view: View
    known: bool

    def rows(self, keep: Tensor) -> Known:
        """The same with some of the rows."""
        return self._replace(session=self.session.rows(keep), view=self.view.rows(keep))


def session_of(
    model: FittedMap, nominal: GeometryMap, lever: float | None, data: Measurements, free: str, *, ball: bool = False
) -> Known:
    """The rows as the fitted map sees them, in its own frame; ``ball``: see :class:`Session`.

    Raises:
        InputError: the markers are to stay, but other ones were measured.
        MeasurementError: fewer coordinates than unknowns.
    """
    before, fit = model.registration, model.unregistered
    markers = _markers(fit, nominal) if before is None else before.markers
    own, seen = bodies_of(lever), data.bodies
    known = own.kind == seen.kind and data.markers == len(markers)
    if known:
        data, seen = own.represented(data), own
    if not known and free == "base":
        what, fix = 'free="base" keeps the markers', 'pass free="both" for other markers'
        got = kind_of_points(data.markers, data.lever)
        raise InputError.of(what, expected=kind_of_points(len(markers), lever), got=got, fix=fix)
    old = seen.at(markers if known else seen.nowhere(data.markers, data.points))
    same = known and (before is None or before.same)
    size = 6 + len(old.from_old)
    _check_enough(data, 6 * (free != "marker") + (0 if known else size - 6), frame_free=free != "marker")
    zero = data.points.new_zeros(size, size)
    rows = data.q, data.points, _noise(model.new_noise, data, None), zero[0, :3], zero
    by_fit = zero if not same else _by_fit(fit.with_nominal(nominal.typical), nominal, old, zero)
    session = Session(fit, nominal, same, *rows, by_fit, free != "marker", free != "base", ball)
    view = session.view(old)
    T = (at_old_places(session, old, view) if known else anywhere(session, old)).T
    earlier, centre = zero, session.seen(T).flatten(0, 1).nanmean(0)
    if before is not None:
        earlier = _earlier(before, old, centre, known=known)
    noise = _noise(model.new_noise, data, T[:3, :3].mT)
    return Known(replace(session, noise=noise, centre=centre, known=earlier), old, view, known)


def _markers(fit: FittedMap, nominal: GeometryMap) -> Tensor:
    """The fitted markers (P, 3) in the tip's frame, m."""
    shifts = fit.deformation.momenta.theta[nominal.geometry.slices["tool"]]
    return nominal.geometry.tool + shifts.view(-1, 3)


def _by_fit(fit: FittedMap, nominal: GeometryMap, old: Body, zero: Tensor) -> Tensor:
    """Covariance (6 + d, 6 + d) of the body's place by the fit."""
    part = nominal.geometry.slices["tool"]
    numbers = torch.arange(part.start, part.stop, device=zero.device)
    to = torch.linalg.pinv(old.slopes)
    found = zero.clone()
    found[6:, 6:] = to @ fit.parameter_covariance(numbers) @ to.mT
    return found


def _noise(new_noise: Tensor, data: Measurements, R: Tensor | None) -> Tensor:
    """Covariance of the rows (M, 3 P, 3 P) in the frame of the map: that of the fit; known deviations if larger.

    Hidden markers carry no information.

    For another number of markers each has the mean covariance of the fitted ones.

    Args:
        new_noise: that of the fit. data: rows, with known deviations perhaps. R: (3, 3) turns these into the frame.
    """
    size = 3 * data.markers
    if len(new_noise) != size:
        blocks = new_noise.unflatten(0, (-1, 3)).unflatten(2, (-1, 3)).diagonal(dim1=0, dim2=2)  # (3, 3, P)
        new_noise = torch.block_diag(*[blocks.mean(-1)] * data.markers)
    known, visible = data.covariance, data.visible.repeat_interleave(3, 1)
    total = new_noise.expand(len(data), size, size)
    if known is not None and float(known.diagonal(dim1=1, dim2=2)[visible].mean()) > float(new_noise.diagonal().mean()):
        total = total + (known if R is None else turned(known, R))
    return total if bool(visible.all()) else without_hidden(total, visible)


def _earlier(before: Registration, old: Body, centre: Tensor, *, known: bool) -> Tensor:
    """Covariance (6 + d, 6 + d) of frame, about another centre, and body from an earlier registration."""
    arms = torch.eye(6, dtype=centre.dtype, device=centre.device)
    arms[:3, 3:] = -skew(centre - before.centre)
    if known:
        to = torch.block_diag(arms, torch.linalg.pinv(old.slopes))
        return to @ before.covariance @ to.mT
    covariance = centre.new_zeros(6 + len(old.from_old), 6 + len(old.from_old))
    covariance[:6, :6] = arms @ before.covariance[:6, :6] @ arms.mT
    return covariance


def _check_enough(data: Measurements, unknowns: int, *, frame_free: bool) -> None:
    """Raise MeasurementError unless there are more coordinates than unknowns without a prior."""
    each = data.bodies.numbers * float(data.seen_bodies.sum()) / len(data)
    points = -(-LEAST_POINTS // data.markers) if frame_free else 1
    least = max(int(unknowns // each) + 1, points)  # one coordinate more than unknowns: a contradiction can show
    if len(data) < least:
        what, fix = "these rows do not determine where everything is", "measure 6 to 10 poses"
        raise MeasurementError.of(what, expected=f"at least {least} rows", got=len(data), fix=fix)
