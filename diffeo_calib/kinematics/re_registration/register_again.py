"""`model.registered`: estimates under several priors, outliers, and the record of what was found.

Rows of a registration that contradict all others.

Leaving rows J out lowers the quadratic form of the residuals by mu_J^T (K^-1)_JJ^-1 mu_J with K = V + S P S^T and
mu = K^-1 r (r the residual minus S times the prior mean). Compared with what remains, this is an F test (externally
studentised residuals), so that an outlier does not hide itself. Single rows are tried first, then pairs, which may hide
each other.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import combinations
from math import exp, log, nan
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, as_written, few, sentence, warn_user
from diffeo_calib.common.quantiles import known
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.re_registration.both_dates import NewDate, both_dates, joins
from diffeo_calib.kinematics.re_registration.estimate import (
    Estimate,
    Place,
    Session,
    anywhere,
    at_old_places,
    doubt,
    estimate,
)
from diffeo_calib.kinematics.re_registration.registered_map import (
    RegisteredMap,
    Registration,
    moved,
    robot_map,
    turned,
    undetermined,
)
from diffeo_calib.kinematics.re_registration.session import Known, session_of
from diffeo_calib.maps.noise import mean_block
from diffeo_calib.measurements.bodies import Body
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.coordinates import check_joint_order, sensor_of
from diffeo_calib.sensors.places import DRIFT, PlacedDevices
from diffeo_calib.sensors.set_ups import mounted_of
from diffeo_calib.sensors.tables import rows_of_one_kind

LOG = logging.getLogger(__name__)
FREE = ("both", "base", "marker")
SAME_PLACE, OTHER_MARKER = PLACES.same_registered_m, PLACES.other_registered_m
"""Prior standard deviations, m, of a marker that stayed where it was, and of another one."""
MARKER_DEVIATIONS = (SAME_PLACE, PLACES.remounted_m, OTHER_MARKER)
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
    learn = learn and found.part.session.same and open_by < LARGEST_M_RAD and not registration.doubtful
    learn = learn and (model.registration is None or free == "both")  # what is held must be known
    if not (learn and joins(fit, len(found.best.rows.residual))):
        placed = moved(fit, registration.transform).inflated(found.best.inflation)
        return RegisteredMap(placed, registration), registration
    learnt = moved(_learnt(fit, nominal, found), found.best.T)
    own, old = robot_map(learnt), found.best.body.old
    markers = own.geometry.tool + learnt.deformation.momenta.theta[own.geometry.slices["tool"]].view(-1, 3)
    return learnt, replace(registration, transform=found.best.T, markers=markers, shift=markers - old)


LARGEST_M_RAD = 0.03
"""Deviation of a place, m or rad, from which its rows teach nothing about the robot: to first order they would."""
STEPS = GaussNewton(max_iterations=2, tolerance=0.0)
"""The first one is within 2 % of the optimum, the second within 0.1 %."""


def _learnt(fit: FittedMap, nominal: GeometryMap, found: FoundPlace) -> FittedMap:
    """The fit conditioned on the rows that took part, too, in its own frame, as if nothing but places had changed."""
    session, best, odds = found.part.session, found.best, found.odds
    metres = max(odds, key=lambda each: odds[each])
    rows, P = best.rows, len(best.body.points)
    free = rows.residual.new_full((3 * P,), (PLACES.same_m if metres == SAME_PLACE else metres) * session.body_free)
    free[len(free) - 3 * session.ball :] = 0.0
    new = NewDate(
        markers=best.body.old if metres == SAME_PLACE else best.body.points,
        payload=session.nominal.payload,
        q=session.q,
        y=session.seen(best.T).flatten(1).nan_to_num(0.0),
        noise=session.noise * doubt(best.weights)[:, None, None],
        seen=rows.visible,
        shared=session.shared,
        new_noise=_mean_noise(session, rows.visible),
        frame=PLACES.found_m_rad * session.frame_free,
        free=free,
        centre=session.centre,
    )
    problem, start = both_dates(fit, nominal, new, [], best.inflation)
    solution = STEPS.solve(problem, fit.geodesic.integrator, start)
    if solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum
    return problem.calibrated(problem.deform(solution.momenta, fit.geodesic.integrator))


class FoundPlace(NamedTuple):
    """Result of a registration.

    Args:
        part: the rows that took part. best: the most probable estimate. odds: probability of each prior deviation of
            the markers, m. registration: the record.
    """

    part: Known
    best: Estimate
    odds: dict[float, float]
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
    every = session_of(model, nominal, lever, some, free, ball=ball)
    priors = _priors(free, marker_std, known=every.known)
    kept, dropped = torch.arange(len(some), device=some.q.device), []
    while True:
        part = every.rows(kept)
        starts = _starts(part, max(priors))
        plain = _likeliest(_estimates(starts, priors, torch.ones_like(part.session.q[:, 0])))
        worst = worst_rows(plain)
        if not worst or len(dropped) + len(worst) > LARGEST_OUTLIER_PART * len(some):
            break
        dropped += kept[worst].tolist()
        kept = kept[[row for row in range(len(kept)) if row not in worst]]
    before = _rms(model(some.q).unflatten(1, (-1, 3)) - some.points) if every.known else None
    outliers = tuple(some.line_numbers[sorted(dropped)].tolist()) if dropped else ()
    odds = {metres: odds for metres, odds in zip(priors, _odds(starts, priors), strict=True) if odds > 0}
    weighed = list(zip(odds.values(), _estimates(starts, tuple(odds)), strict=True))
    said = {"free": free, "outliers": outliers, "rms_before": before, "excess": scale(plain) ** 0.5}
    said["same_place"] = odds.get(SAME_PLACE, 0.0) if len(priors) > 1 else None
    best = max(weighed, key=lambda each: each[0])[1]
    return FoundPlace(part, best, odds, _record(part, best, _mean(part.session, weighed, best), said))


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
    return MARKER_DEVIATIONS if known else (OTHER_MARKER,)


def _starts(part: Known, widest: float) -> list[Place]:
    """With the markers at their old places, if they are known; with markers anywhere, if they may be."""
    session, old, view, same = part
    starts = [at_old_places(session, old, view)] if same or not session.frame_free else []
    needed = 6 + len(old.from_old)  # as many coordinates as unknowns would fit any place
    points = session.points[:, : session.points.shape[1] - session.ball]
    shown = bool((~points.isnan()).any(2).any(0).all())  # else some marker could be anywhere
    free = shown and session.frame_free and session.body_free
    if free and widest >= OTHER_MARKER and len(known(session.points)) > needed:
        starts.append(anywhere(session, old))
    return starts


def _estimates(starts: list[Place], priors: tuple[float, ...], weights: Tensor | None = None) -> list[Estimate]:
    """The likeliest estimate under every prior."""
    found = []
    for metres in priors:
        usable = starts if metres >= OTHER_MARKER else starts[:1]
        found.append(_likeliest([estimate(start, metres, weights) for start in usable]))
    return found


def _odds(starts: list[Place], priors: tuple[float, ...]) -> list[float]:
    """Probabilities of the priors, with the weights of the rows that the widest one finds."""
    weights = _estimates(starts, priors[-1:])[0].weights
    found = zip(priors, _estimates(starts, priors, weights), strict=True)
    logs = [each.log_evidence + UNMOVED_LOG_ODDS * (metres == SAME_PLACE) for metres, each in found]
    odds = [exp(each - max(logs)) for each in logs]
    likely = [each if each > NEGLIGIBLE_PROBABILITY * sum(odds) else 0.0 for each in odds]
    return [each / sum(likely) for each in likely]


def _likeliest(found: list[Estimate]) -> Estimate:
    return max(found, key=lambda each: each.log_evidence)


class _Mean(NamedTuple):
    """Mean of estimates: frame, markers, and covariance and gain of both, in the frame of the fit."""

    T: Tensor
    body: Body
    covariance: Tensor
    gain: Tensor


def _mean(session: Session, weighed: list[tuple[float, Estimate]], best: Estimate) -> _Mean:
    """The mean of estimates by their odds, around the best one; their differences are part of the covariance."""
    motions = [_motion(session, best.T, each.T) for _, each in weighed]
    away = [
        torch.cat([d, each.body.from_old - best.body.from_old]) for d, (_, each) in zip(motions, weighed, strict=True)
    ]
    step = torch.stack([w * d for d, (w, _) in zip(away, weighed, strict=True)]).sum(0)
    covariance, gain = torch.zeros_like(session.known), best.gain.new_zeros(len(step), best.gain.shape[1])
    for d, (w, each) in zip(away, weighed, strict=True):
        own = session.known.clone()
        own[each.free], own[:, each.free] = 0.0, 0.0
        own[each.free[:, None], each.free] = each.covariance * best.inflation
        covariance += w * (own + torch.outer(d - step, d - step))
        gain[each.free] += w * each.gain
    out = torch.block_diag(torch.eye(6, dtype=step.dtype, device=step.device), best.body.slopes)
    T, body = session.moved(best.T, step[:6]), best.body.stepped(step[6:])
    return _Mean(T, body, out @ covariance @ out.mT, out @ gain)


def _motion(session: Session, T: Tensor, other: Tensor) -> Tensor:
    """The small motion (6,) about the session's centre that leads from T to another transform."""
    D = torch.linalg.inv(T) @ other
    skewed = D[:3, :3] - D[:3, :3].mT
    turn = 0.5 * torch.stack([skewed[2, 1], skewed[0, 2], skewed[1, 0]])
    return torch.cat([D[:3, :3] @ session.centre + D[:3, 3] - session.centre, turn])


def _record(part: Known, best: Estimate, mean: _Mean, said: dict[str, Any]) -> Registration:
    """Everything in the new measuring frame."""
    session = part.session
    R, count = mean.T[:3, :3], len(mean.covariance) - 6
    turn = torch.block_diag(R, R, torch.eye(count, dtype=R.dtype, device=R.device))
    covariance = turn @ mean.covariance @ turn.mT
    covariance = 0.5 * (covariance + covariance.mT)
    visible = best.rows.visible
    usual = float(best.rows.V.diagonal()[visible.flatten()].median().sqrt())
    arm = float((session.seen(mean.T) - session.centre).square().sum(-1).nanmean().sqrt())
    geometry, rigid = session.nominal.geometry, mean.body.lever is not None
    tips = geometry.on if len(geometry.on) == len(mean.body.points) else (geometry.chain.tip,) * len(mean.body.points)
    return Registration(
        transform=mean.T,
        markers=mean.body.points,
        lever=mean.body.lever,
        same=session.same,
        shift=mean.body.points - mean.body.old if part.known else None,
        covariance=covariance,
        centre=R @ session.centre + mean.T[:3, 3],
        q=session.q,
        gain=turn @ (mean.gain.unflatten(1, (-1, 3)) @ R.mT).flatten(1),
        noise=turned(best.inflation * _mean_noise(session, visible), R),
        rms_after=_rms(best.rows.residual.masked_fill(~visible, nan).unflatten(1, (-1, 3))),
        left_out_rms=_rms(best.left_out.unflatten(1, (-1, 3))),
        undetermined=undetermined(covariance, mean.body.points, arm, usual, tips, rigid=rigid),
        **said,
    )


def _mean_noise(session: Session, visible: Tensor) -> Tensor:
    """Covariance (m, m) of a new measurement, m^2: that of the fit for points that no row shows."""
    found, unseen = mean_block(session.noise, visible), ~visible.any(0)
    both = unseen[:, None] & unseen
    return torch.where(both, session.fitted.new_noise, found) if bool(unseen.any()) else found


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


PRIOR_FREEDOM = 10.0
"""The model's own covariance counts as an estimate of the scale with so many degrees of freedom."""
FALSE_ALARM_PROBABILITY = 0.001
"""Probability that clean rows have an outlier."""
MOST_PAIRS = 800


def worst_rows(found: Estimate) -> list[int]:
    """The one or two rows that contradict all others, or none."""
    M = len(found.rows.residual)
    for size in (1, 2):
        sets = list(combinations(range(M), size))
        if M - size < 3 or len(sets) > MOST_PAIRS:
            continue
        numbers = torch.tensor(sets, dtype=torch.int64, device=found.T.device)
        falls = _falls(found, numbers)
        chances = _chances(found, falls, numbers)
        best = int(np.lexsort((-falls.numpy(force=True), chances))[0])  # of equal chances the largest fall
        if chances[best] * len(sets) < FALSE_ALARM_PROBABILITY:
            return list(sets[best])
    return []


def scale(found: Estimate) -> float:
    """Square of the residuals' scale in units of what model and noise lead to expect."""
    return float(_scales(found, found.T.new_zeros(()), found.T.new_zeros(()))[0])


def _scales(found: Estimate, without: Tensor, coordinates: Tensor) -> tuple[Tensor, Tensor]:
    """The same without parts of the quadratic form that belong to so many coordinates, and degrees of freedom."""
    freedom = (found.rows.visible.sum() - coordinates - found.determined).clamp(min=0.0) + PRIOR_FREEDOM
    return ((found.quadratic - without).clamp(min=0.0) + PRIOR_FREEDOM) / freedom, freedom


def _falls(found: Estimate, sets: Tensor) -> Tensor:
    """Fall of the quadratic form without each set of rows: (K, size) -> (K,)."""
    m = found.rows.residual.shape[1]
    places = (sets[..., None] * m + torch.arange(m, device=sets.device)).flatten(1)  # (K, size m)
    blocks = found.factor.inverse[places[:, :, None], places[:, None, :]]
    chosen = found.solved[places]
    return (chosen * torch.linalg.solve(blocks, chosen[..., None])[..., 0]).sum(1)


def _chances(found: Estimate, falls: Tensor, sets: Tensor) -> np.ndarray:
    """Probabilities (K,) of such falls by chance."""
    from scipy.special import fdtrc  # noqa: PLC0415  # slow to import, not needed to use a model

    coordinates = found.rows.visible.sum(1).to(falls)[sets].sum(1)
    variances, freedom = _scales(found, falls, coordinates)
    ratios = falls / coordinates / variances
    return fdtrc(*(values.numpy(force=True) for values in (coordinates, freedom, ratios)))
