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
from diffeo_calib.kinematics.re_registration.usual_noise import larger, noise_of_poses
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.measurements.bodies import Bodies, Body
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
    own, seen = Bodies(lever), data.bodies
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
    rows = data.q, data.points, _noise(model, data, data.covariance, known=known), zero[0, :3], zero
    by_fit = zero if not same else _by_fit(fit.with_nominal(nominal.typical), nominal, old, zero)
    session = Session(fit, nominal, same, *rows, by_fit, _shared(data), free != "marker", free != "base", ball)
    view = session.view(old)
    T = (at_old_places(session, old, view) if known else anywhere(session, old)).T
    earlier, centre = zero, session.seen(T).flatten(0, 1).nanmean(0)
    if before is not None:
        earlier = _earlier(before, old, centre, known=known)
    seen = data.in_frames(torch.linalg.inv(T).expand(len(data), -1, -1))
    own = None if data.covariance is None else turned(data.covariance, T[:3, :3].mT)
    errors = {"noise": _noise(model, seen, own, known=known), "shared": _shared(seen)}
    return Known(replace(session, **errors, centre=centre, known=earlier), old, view, known)


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


def _shared(data: Measurements) -> Tensor:
    """(M, 3 P, c) effects of errors of unit variance that rows share, of lenses and boards, m."""
    found = [own.slopes for own in data.shared_errors()]
    return torch.cat(found, 2) if found else data.points.new_zeros(len(data), 3 * data.markers, 0)


def _noise(model: FittedMap, data: Measurements, own: Tensor | None, *, known: bool) -> Tensor:
    """Covariance of rows (M, 3 P, 3 P) in the frame of the fit, m^2; hidden markers carry no information.

    It is that of the fit, or their own where it is larger. Poses of the fit turn and stand as each row has them. For
    another number of markers each has the mean covariance of the fitted ones.

    Args:
        model: as it stands now. data: rows in the frame of the fit. own: (M, 3 P, 3 P) what is known of them, m^2.
        known: whether they may show the bodies of the fit.
    """
    new_noise, size, fit = model.new_noise, 3 * data.markers, model.unregistered
    if len(new_noise) != size:
        blocks = new_noise.unflatten(0, (-1, 3)).unflatten(2, (-1, 3)).diagonal(dim1=0, dim2=2)  # (3, 3, P)
        new_noise = torch.block_diag(*[blocks.mean(-1)] * data.markers)
    by_row = noise_of_poses(fit, data) if known else None
    inflation = model.new_noise.trace() / fit.new_noise.trace()
    total = new_noise.expand(len(data), size, size) if by_row is None else inflation * by_row
    total = total if own is None else larger(total, own)
    return without_hidden(total, data.visible.repeat_interleave(3, 1))


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
