"""`model.registered`: estimates under several priors, the record of what was found, and what is learnt from the rows.

A marker either stayed where it was (within 0.01 mm), moved a little (1 mm), or is another one (0.3 m): the marginal
likelihood of the rows chooses. The base may be anywhere.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from math import exp, log
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, as_written, few, sentence, warn_user
from diffeo_calib.common.quantiles import known
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.re_registration.both_dates import both_dates, joins
from diffeo_calib.kinematics.re_registration.estimate import Estimate
from diffeo_calib.kinematics.re_registration.registered_map import (
    RegisteredMap,
    Registration,
    moved,
    robot_map,
    turned,
    undetermined,
)
from diffeo_calib.kinematics.re_registration.session import Session
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.coordinates import check_joint_order, sensor_of
from diffeo_calib.sensors.places import DRIFT, PlacedDevices
from diffeo_calib.sensors.set_ups import mounted_of
from diffeo_calib.sensors.tables import rows_of_one_kind

LOG = logging.getLogger(__name__)
FREE = ("both", "base", "marker")
MARKER_DEVIATIONS = {
    "same": (PLACES.same_registered_m, PLACES.same_m),
    "moved": (PLACES.remounted_m, PLACES.remounted_m),
    "other": (PLACES.other_registered_m, PLACES.other_m),
}
"""Prior standard deviations, m, of markers from where they were, in a registration, and from where it found them."""
SAME_PLACE, OTHER_MARKER = MARKER_DEVIATIONS["same"][0], MARKER_DEVIATIONS["other"][0]
UNMOVED_LOG_ODDS = log(10.0)
"""Before the rows are seen: markers that nobody names as moved have not been touched."""
MOST_ROWS = 200
"""Of more rows, so many evenly spaced ones take part."""
LARGEST_OUTLIER_PART = 0.34
"""Largest part of the rows that are taken for outliers."""
NEGLIGIBLE_PROBABILITY = 0.01
"""Priors that are less probable count no more."""


@small_work()
def register_again(
    model: FittedMap,
    nominal: GeometryMap,
    lever: float | None,
    data: Measurements,
    *,
    free: str,
    marker_std: float | None,
    ball: bool = False,
    learn: bool = True,
) -> tuple[FittedMap, Registration]:
    """See :meth:`CalibratedKinematics.registered`; everything on the CPU."""
    found = find_place(model, nominal, lever, data, free=free, marker_std=marker_std, ball=ball)
    registration, fit = found.registration, model.unregistered
    warn_about(registration)
    LOG.info("registered anew: RMS %.4f mm on %d rows", 1e3 * registration.rms_after, registration.rows)
    open_by = max(float(registration.frame_deviations.max()), registration.known_m)
    learn = learn and found.best.session.same and open_by < LARGEST_M_RAD and not registration.doubtful
    learn = learn and (model.registration is None or free == "both")  # what is held must be known
    if not (learn and joins(fit, len(found.best.rows.residual))):
        placed = moved(fit, registration.transform).inflated(found.best.inflation)
        return RegisteredMap(placed, registration), registration
    learnt = moved(_learnt(fit, nominal, found.best), registration.transform)
    own, old = robot_map(learnt), found.best.session.old
    markers = own.geometry.tool + learnt.deformation.momenta.theta[own.geometry.slices["tool"]].view(-1, 3)
    return learnt, replace(registration, markers=markers, shift=markers - old)


LARGEST_M_RAD = 0.03
"""Deviation of a place, m or rad, from which its rows teach nothing about the robot: to first order they would."""
STEPS = GaussNewton(max_iterations=2, tolerance=0.0)
"""The first one is within 2 % of the optimum, the second within 0.1 %."""


def _learnt(fit: FittedMap, nominal: GeometryMap, found: Estimate) -> FittedMap:
    """The fit conditioned on the rows that took part, too, in its own frame, as if nothing but places had changed."""
    new, same = found.date, found.metres == SAME_PLACE
    known = torch.full_like(new.deviations, PLACES.found_m_rad)
    known[6:] = PLACES.same_m if same else found.metres
    points = FlangePoints(new.points.fitted, found.session.old, same=True) if same else new.points
    new = replace(new, points=points, deviations=known * found.session.free)
    problem, start = both_dates(nominal, new, new.mean_noise, [], found.inflation)
    solution = STEPS.solve(problem, fit.geodesic.integrator, start)
    if solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum
    return problem.calibrated(problem.deform(solution.momenta, fit.geodesic.integrator))


class FoundPlace(NamedTuple):
    """Result of a registration: the most probable estimate, and the record."""

    best: Estimate
    registration: Registration


def find_place(
    model: FittedMap,
    nominal: GeometryMap,
    lever: float | None,
    data: Measurements,
    *,
    free: str = "both",
    marker_std: float | None = None,
    ball: bool = False,
) -> FoundPlace:
    """Find where the device stands and where the markers sit; arguments as of :func:`register_again`.

    ``ball``: whether the last marker is a ball that no row shows, and that stays where it was on the tool.
    """
    _check_arguments(nominal, data, free, marker_std)
    data = data.to(HOST)
    evenly = [round(k * (len(data) - 1) / (MOST_ROWS - 1)) for k in range(MOST_ROWS)]
    some = data if len(data) <= MOST_ROWS else data.rows(evenly)
    nominal = nominal.under(some.payload)
    model = model.with_nominal(nominal)
    session = Session.of(model, nominal, lever, some, free, ball=ball)
    priors = _priors(free, marker_std, known=session.known)
    kept, outliers = torch.arange(len(some), device=some.q.device), list[int]()
    while True:
        part = session.rows(kept)
        starts = _starts(part, max(priors))
        found = {metres: _likeliest(starts, metres) for metres in priors}
        odds = _odds(found)
        best = found[max(odds, key=odds.__getitem__)]
        worst = best.worst_rows()
        if not worst or len(outliers) + len(worst) > LARGEST_OUTLIER_PART * len(some):
            break
        outliers += kept[worst].tolist()
        kept = kept[[row for row in range(len(kept)) if row not in worst]]
    said = {
        "free": free,
        "outliers": tuple(some.line_numbers[sorted(outliers)].tolist()) if outliers else (),
        "rms_before": _rms(model(some.q).unflatten(1, (-1, 3)) - some.points) if session.known else None,
        "excess": float(best.scale()[0]) ** 0.5,
        "same_place": odds.get(SAME_PLACE, 0.0) if len(priors) > 1 else None,
    }
    return FoundPlace(best, _record(best, said))


def registration_rows(data: Any, model: Any) -> Measurements | None:
    """The rows of one set-up that say where the robot stands, with a hidden ball where a model has one.

    None where no device measured positions. InputError for something else than rows.
    """
    if not isinstance(data, RowGroups):
        expected, got = "dc.Measurements", type(data).__name__
        raise InputError.of("`measurements`", expected=expected, got=got)
    known = mounted_of(model).in_any_frame
    own = [(sensor_of(part), sensor_of(part).set_up(part, known)) for part, _ in rows_of_one_kind(data)]
    return next((sensor.with_points(rows, model) for sensor, rows in own if rows is not None), None)


def devices_beside(model: Any, data: Any) -> tuple[PlacedDevices, ...]:
    """The devices of rows of any kinds, placed around a calibrated model that knows the rows' points.

    Devices that the model knows and that have no rows stay where they are.
    """
    found = list(model.placement)
    for part, _ in rows_of_one_kind(data):
        sensor_of(part).check(part, model)
        points = model.at_payloads(part.payload).map(part.q).detach().unflatten(1, (-1, 3))
        for own in sensor_of(part).settled(part, points, model.turns):
            same = next((number for number, old in enumerate(found) if own.same_set(old)), len(found))
            alone = [] if own.of_model else [own]
            found[same : same + 1] = [own.beside(old) for old in found[same : same + 1]] or alone
    return tuple(found)


def carried_devices(old: Any, new: Any, T: Tensor) -> tuple[PlacedDevices, ...]:
    """The devices of a model beside another one of the same robot, as it stands among them.

    A drift is none of them: it belongs to the rows of the old fit.

    Args:
        old, new: the models, of the same points.
        T: (4, 4) from the frame of the old one to that of the new one, m.
    """
    if not old.placement:
        return ()
    q, T = old.configurations, T.to(HOST)
    before, after, turns = (each.detach().to(HOST) for each in (old(q), new(q), new.turns(q)))
    P = min(before.shape[1], after.shape[1])
    away = (before @ T[:3, :3].mT + T[:3, 3])[:, :P] - after[:, :P]
    markers = (turns[:, :P].mT @ away[..., None])[..., 0].mean(0)
    return tuple(own.carried(T, before, after, markers) for own in old.placement if own.kind != DRIFT)


def registered_devices(old: Any, new: Any) -> tuple[PlacedDevices, ...]:
    """The devices of a model beside the same one registered anew; those that saw what it no longer knows are left out.

    Warns:
        DiffeoCalibWarning: devices that are left out.
    """
    same = new.registration.same and old.ball == new.ball
    lost = [own for own in old.placement if own.devices is not None and not same]
    if lost:
        names = few([f"'{name}'" for own in lost for name in own.names])
        what = f"the model no longer knows the devices {names}: these rows show other markers than what they read"
        warn_user(sentence(what, fix="pass rows of the fit's markers, or rows of these devices, to keep them"))
    kept = tuple(own for own in old.placement if own not in lost)
    return carried_devices(old._with(placement=kept), new, new.registration.transform)


def _check_arguments(nominal: GeometryMap, data: Measurements, free: str, marker_std: float | None) -> None:
    if free not in FREE:
        raise InputError.of("`free`", expected=" or ".join(map(repr, FREE)), got=as_written(free))
    chain = nominal.geometry.chain
    check_joint_order(chain, data)
    chain.joint_values(data.to(HOST).q)
    if marker_std is not None:
        check_number(marker_std, "`marker_std`, in m", above=0.0)


def _priors(free: str, marker_std: float | None, *, known: bool) -> tuple[float, ...]:
    """Prior standard deviations of the markers to try, m."""
    if free == "base":
        return (SAME_PLACE,)  # not used: the markers stay
    if marker_std is not None:
        return (marker_std,)
    return tuple(first for first, _ in MARKER_DEVIATIONS.values()) if known else (OTHER_MARKER,)


def _starts(session: Session, widest: float) -> list[Estimate]:
    """With the markers at their old places, if they are known; with markers anywhere, if they may be."""
    framed, points = bool(session.free[0]), session.data.points
    starts = [session.at_old_places()] if session.known or not framed else []
    may = session.free[6:].view(points.shape[1], -1).any(1)
    shown = (~points.isnan()).any(2).any(0) | ~may  # else some marker could be anywhere
    # as many coordinates as unknowns would fit any place
    if framed and bool(may.any()) and bool(shown.all()) and widest >= OTHER_MARKER:
        starts += [session.anywhere()] if len(known(points)) > len(session.free) else []
    return [Estimate.at(session, widest, *start) for start in starts]


def _likeliest(starts: list[Estimate], metres: float) -> Estimate:
    """The likeliest estimate under a prior."""
    usable = starts if metres >= OTHER_MARKER else starts[:1]
    return max((start.settled(metres) for start in usable), key=lambda each: each.rows.log_evidence())


def _odds(found: dict[float, Estimate]) -> dict[float, float]:
    """Probabilities of the priors that count. Errors as large as those under the widest prior are no evidence."""
    scale = max(1.0, float(found[max(found)].scale()[0]))
    logs = {metres: each.rows.log_evidence(scale) for metres, each in found.items()}
    logs |= {SAME_PLACE: logs[SAME_PLACE] + UNMOVED_LOG_ODDS} if SAME_PLACE in logs else {}
    odds = {metres: exp(each - max(logs.values())) for metres, each in logs.items()}
    likely = {metres: each for metres, each in odds.items() if each > NEGLIGIBLE_PROBABILITY * sum(odds.values())}
    return {metres: each / sum(likely.values()) for metres, each in likely.items()}


def _record(best: Estimate, said: dict[str, Any]) -> Registration:
    """Everything in the new measuring frame."""
    session, markers, free, rows = best.session, best.markers, best.free, best.rows
    R = best.T[:3, :3]
    whole, gain = session.earlier.clone(), rows.gain.new_zeros(len(session.free), rows.gain.shape[1])
    whole[free], whole[:, free], gain[free] = 0.0, 0.0, rows.gain
    whole[free[:, None], free] = rows.covariance * best.inflation
    out = torch.block_diag(R, R, torch.eye(markers.numel(), dtype=R.dtype, device=R.device))
    covariance = out @ whole @ out.mT
    covariance = 0.5 * (covariance + covariance.mT)
    usual = float((best.inflation * rows.V.diagonal()[rows.visible.flatten()].median()).sqrt())
    arm = float((session.seen(best.T) - session.centre).square().sum(-1).nanmean().sqrt())
    geometry, count, lever = session.nominal.geometry, len(markers), session.data.lever
    tips = geometry.on if len(geometry.on) == count else (geometry.chain.tip,) * count
    return Registration(
        transform=best.T,
        markers=markers,
        lever=lever,
        same=session.same,
        shift=markers - session.old if session.known else None,
        covariance=covariance,
        centre=R @ session.centre + best.T[:3, 3],
        q=session.data.q,
        gain=((out @ gain).unflatten(1, (-1, 3)) @ R.mT).flatten(1),
        noise=turned(best.inflation * best.date.mean_noise, R),
        rms_after=_rms(rows.shown(rows.residual).unflatten(1, (-1, 3))),
        left_out_rms=_rms(rows.left_out.unflatten(1, (-1, 3))),
        undetermined=undetermined(covariance, markers, arm, usual, tips, rigid=lever is not None),
        **said,
    )


def _rms(errors: Tensor) -> float:
    """Root mean square length of vectors (..., 3), NaN left out."""
    return float(errors.norm(dim=-1).square().nanmean().sqrt())


def warn_about(found: Registration, *, outliers: bool = True, excess: bool = True) -> None:
    """Warn of outliers, of exchanged markers, of directions that rows do not determine, and of errors that remain.

    Args:
        found: the registration.
        outliers: whether to name the rows that took no part. excess: whether to warn of errors that remain.
    """
    if found.outliers and outliers:
        what = f"{len(found.outliers)} row(s) contradict all others and took no part: row {few(found.outliers)}"
        warn_user(sentence(what, fix="measure these poses again"))
    if found.exchanged:
        what = (
            f"markers {few(found.exchanged)}, or axes of a measured frame, seem to be exchanged: each is where another "
        )
        what += "one was"
        warn_user(sentence(what, fix="put their columns in the order of the fit, unless they were mounted so"))
    for text in found.undetermined:
        warn_user(f"{text}.")
    if found.doubtful and excess:
        what = f"after registration the errors are {found.excess:.1f} times as large as the model leads to expect"
        fix = "something else has changed, or the rows are wrong: measure more poses and calibrate again"
        warn_user(sentence(what, fix=fix))
