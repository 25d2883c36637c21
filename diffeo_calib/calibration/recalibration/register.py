"""Rows of any kinds beside an old model: `model.registered`, where devices and markers are, and what is learnt.

Where a device measured coordinates, it says where the robot stands: the frame of the device (of the largest session) is
found by a registration. Sockets and the devices of readings stand around the robot that the model knows.

What is learnt is one problem of old and new rows with the old scales, of the robot as it is now. Old rows differ from
this robot by shifts that they share: the places of device and markers in their session, and what has drifted since.
These are part of their noise (:class:`Noise`): nothing but the rows' covariance knows of sessions. The old rows follow
from the old momenta (:meth:`FittedMap.measured`), from which the search starts.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from math import degrees, log, nan
from operator import itemgetter
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffeo_calib.calibration.placing.placement import Sessions
from diffeo_calib.calibration.placing.readings import ball_of
from diffeo_calib.calibration.recalibration.drift import ChangedPart, grown, parts_of
from diffeo_calib.calibration.recalibration.find_place import (
    MARKER_DEVIATIONS,
    UNMOVED_LOG_ODDS,
    find_place,
    opened,
    warn_about,
)
from diffeo_calib.calibration.recalibration.new_rows import NewRows, NewSetUp, UsualNoise
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, few, sentence, warn_user
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import check_same_robot, rows_used_in_fit
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap, SessionMarkers
from diffeo_calib.kinematics.registered_map import RegisteredMap, Registration, fitted_markers, moved, robot_map
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.maps.observation import LinearFunctionals, Observation, Part, Stacked, single_coordinates
from diffeo_calib.measurements.poses import own_blocks
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conjugate_gradients import MAX_DENSE
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.coordinates import check_shown, mounted_of, sensor_of, with_earlier_cameras
from diffeo_calib.sensors.devices import Extrinsics
from diffeo_calib.sensors.kinds import (
    ball_tip,
    check_markers,
    divided,
    measured_positions,
    rows_of_one_kind,
    with_markers,
    with_points,
)
from diffeo_calib.sensors.known_drift import KnownDrift
from diffeo_calib.sensors.set_ups import frame_slopes

LOG = logging.getLogger(__name__)
LARGEST_M_RAD = 0.03  # deviation of a place, m or rad, from which its rows teach nothing about the robot
STEPS = GaussNewton(max_iterations=2, tolerance=0.0)  # the first is within 2 % of the optimum, the second 0.1 %
Marker = Literal["evidence", "same", "moved", "other"]
LARGEST_TURN_RAD = 0.1  # standard deviation of the turn of the measuring device from which its place is open
USUAL_RATIO = 3e-3  # relative error of distances that no robot has


def registered(
    model: CalibratedKinematics, new: Any, *, free: str, marker_std: float | None, learn: bool
) -> CalibratedKinematics:
    """See :meth:`CalibratedKinematics.registered`; everything on the CPU."""
    if not issubclass(type(new), RowGroups):
        raise InputError.of("`measurements`", expected="dc.Measurements", got=type(new).__name__)
    new = with_earlier_cameras(new, model)
    rows = measured_positions(new)
    check_same_robot(model, new)
    if rows is None:
        return model.changed(placement=devices_beside(model, new))
    rows = with_points(mounted_of(model).in_any_frame(rows).largest_session(), model)
    here = model.to(HOST)._carrying(model.nominal.load.under(rows.payload).typical)
    ball = model.ball and bool(rows.points[:, -1].isnan().all())
    placed, record = _placed(here, rows, free=free, marker_std=marker_std, ball=ball, learn=learn, opens=True)
    learns, before = placed.registration is None, getattr(model.registration, "table_sha256", "")
    record = replace(record, table_sha256=" ".join([before, new.sha256][: 1 + learns]).strip())
    vars(placed).update({} if learns else {"registration": record})
    changes = {"map": placed.to(model.configurations.device), "lever": record.lever, "placement": (), "ball": ball}
    result = model.changed(**changes, learnt=record if learns else None)._carrying(model.nominal.load)
    same = record.same and ball == model.ball
    if lost := [devices for devices in model.placement if devices.reads and not same]:
        names = few([f"'{name}'" for devices in lost for name in devices.names])
        what = f"the model no longer knows the devices {names}: these rows show other markers than what they read"
        warn_user(sentence(what, fix="pass rows of the fit's markers, or rows of these devices, to keep them"))
    kept = model.changed(placement=tuple(devices for devices in model.placement if devices not in lost))
    result = result.changed(placement=carried_devices(kept, result, record.transform))
    return result.changed(placement=devices_beside(result, new))


@small_work()
def _placed(
    here: CalibratedKinematics, data: Measurements, *, learn: bool, **asked: Any
) -> tuple[FittedMap, Registration]:
    """The map in its new place, by rows that say where the robot stands, and the record."""
    model = here.map
    (new, registration), fit = find_place(model, here.lever, data, **asked), model.unregistered
    warn_about(registration, among=new.changed_among)
    LOG.info("registered anew: RMS %.4f mm on %d rows", 1e3 * registration.rms_after, registration.rows)
    open_by = max(float(registration.frame_deviations.max()), registration.known_m)
    learn = learn and new.marks.same and open_by < LARGEST_M_RAD and not registration.doubtful
    learn = learn and (model.registration is None or registration.free == "both")  # what is held must be known
    N, m = len(fit.x), fit.m  # more new rows than leave a dense matrix dense cannot join, nor rows of no coordinates
    dense = fit.data is not None or not N * m <= MAX_DENSE < (N + len(new)) * m
    shown = new.observe is None and (fit.shows_points or not fit.stands_free)
    if not (learn and dense and shown):
        placed = moved(fit, registration.transform).inflated(new.inflation)
        return RegisteredMap(placed, registration), registration
    open_, marks = new.deviations.clone(), new.marks
    open_[:6] = open_[:6].clamp(max=PLACES.found_m_rad)
    if new.marker == "same":
        open_[6:], marks = open_[6:].bool() * PLACES.same_m, FlangePoints(marks.fitted, new.old_markers, same=True)
    together, factor = replace(new, marks=marks, deviations=open_), new.changed(deviations=open_).inflation
    problem, start = both_dates(together, factor)  # as if nothing but places had changed
    solution = STEPS.solve(problem, fit.geodesic.integrator, start)
    if solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum
    learnt = problem.calibrated(problem.deform(solution.momenta, fit.geodesic.integrator))
    learnt = replace(moved(learnt, registration.transform), unresolved=fit.inflated(factor).unresolved)
    markers = fitted_markers(learnt)
    return learnt, replace(registration, markers=markers, shift=markers - new.old_markers)


def place_again(model: CalibratedKinematics, new: Any, marker: Marker = "evidence", *, opens: bool = True) -> NewSetUp:
    """Find where device and markers are now.

    Args:
        marker: how far the markers may be from where they were: in directions that the rows leave open, this is all
            that is known of them.

    Raises:
        InputError: joints in another order, or markers that the model cannot be compared with.
        MeasurementError: too few rows, rows that show no error, or of another size than the robot's.
    """
    new = with_earlier_cameras(new.to(HOST), model)
    check_shown(new)
    coordinates, readings = divided(new)
    check_same_robot(model, new)
    rare = [name for table, _ in rows_of_one_kind(new) for name in sensor_of(table).rare(table)]
    if rare:
        what = f"rows that say nothing, since they are alone in their socket: {few(rare)}"
        warn_user(sentence(what, fix="check the names, or measure more rows there"))
    model.nominal.load.under(new.payload).checked()
    other = "measure the same kind again, calibrate again with all rows, or register the model (`model.registered`)"
    if model.registration is not None:  # at other markers than those of the calibration
        other = "measure the markers of the calibration itself, or calibrate again with all rows"
    check_markers(model, coordinates, readings, other)
    old = model.map.unregistered.to(HOST)
    nominal = robot_map(old)
    geometry = nominal.geometry.absorb(nominal.split(old.deformation.momenta.theta)[0])  # without deformation
    tip = ball_tip(readings, nominal.geometry.on[-1])
    place = ball_of([reading.table for reading in readings], geometry, tip)
    ball = None if place is None else place.tool[0]
    new_ball = ball is not None and not knows_ball(model)
    if ball is not None and new_ball:
        old = with_ball(old, ball, tip, PLACES.found_m_rad)
        nominal = robot_map(old)
    set_up = NewSetUp(old, new, coordinates, readings, ball=ball, new_ball=new_ball)
    if coordinates is None:
        return set_up
    table = with_markers(coordinates.table, nominal.geometry.markers, model.lever)
    coordinates = coordinates._replace(table=mounted_of(model).in_any_frame(table))
    # the rows judge "same", too
    stated = MARKER_DEVIATIONS[marker][0] if marker in ("moved", "other") else None
    rows, place, points = _place_of_device(old, model.lever, coordinates.table, stated, opens=opens)
    geometry = nominal.geometry.absorb(nominal.split(old.deformation.momenta.theta)[0])
    geometry = replace(geometry, base=place.transform @ geometry.base)
    sessions, coordinates = Sessions.beside(coordinates, geometry, points)
    return replace(set_up, coordinates=coordinates, sessions=sessions, registration=place, registered=rows)


def weighed(set_up: NewSetUp, marker: str, *, opens: bool = False) -> NewRows:
    """The new rows with their weights, and with the markers as free as is asked or as is most probable."""
    fitted, record, ball = set_up.fitted, set_up.registration, None if set_up.new_ball else set_up.ball
    old = fitted_markers(fitted)
    other, earlier = old.clone(), slice(len(old) - set_up.new_ball)
    if record is not None:
        other[earlier] = record.markers[earlier]
    elif ball is not None:
        other[-1] = ball
    names = [*MARKER_DEVIATIONS] if set_up.registered is None else [set_up.registered.marker]
    names = names if marker == "evidence" else [marker]
    names = ["same"] if record is None and ball is None else names
    usual = UsualNoise(typical_noise(fitted.noise) if fitted.slopes is None else fitted.new_noise, 1.0)
    frame, shown = [PLACES.found_m_rad * (record is not None)] * 6, set_up.seen_before.repeat_interleave(3)
    likely = []
    for name in names:
        markers = other if name == "other" else old
        deviations = torch.cat([old.new_tensor(frame), MARKER_DEVIATIONS[name][1] * shown.to(old)])
        rows = set_up.rows((set_up.transform, markers), usual, deviations, marker=name)
        rows = _levelled(rows).with_weights()
        beside = opened(rows, set_up.data) if opens else rows
        likely.append(rows if beside is rows else beside.with_weights())
    return max(likely, key=lambda each: each.given.log_evidence() + UNMOVED_LOG_ODDS * (each.marker == "same"))


def typical_noise(noise: Noise) -> Tensor:
    """The block (m, m) of median size among the rows that show everything: outliers have larger ones.

    If no row does, the blocks of median size of every marker, as if their errors were independent.
    """
    blocks, shown = noise.covariance[:, None], noise.visible.all(1, keepdim=True)
    if not bool(shown.any()):
        shown = noise.visible[:, ::3]
        blocks = own_blocks(noise.covariance, shown.shape[1])
    sizes = blocks.diagonal(dim1=2, dim2=3).sum(2).masked_fill(~shown, nan)
    typical = (sizes == sizes.nanmedian(0).values).long().argmax(0)
    return torch.block_diag(*[blocks[row, k] for k, row in enumerate(typical.tolist())])


NOISE_LEVELS = 10.0 ** torch.linspace(-2, 2, 17, dtype=torch.float64, device="cpu")  # factors on variances
NOISE_EFOLDS = 2.0  # prior standard deviation of their logarithm: wide


def _levelled(rows: NewRows) -> NewRows:
    """The rows with the likeliest noise of every kind of device that the old fit does not know."""
    known = rows.fitted.shows_points
    if known and single_coordinates(rows.slopes):
        return rows
    drifting = rows.drifting([part.root(rows.at) for part in parts_of(rows.fitted)])  # no noise
    kinds, noise = rows.noise_model.kinds, rows.noise
    for kind in range(int(known), int(kinds.max()) + 1):
        mask = (kinds == kind).repeat_interleave(rows.y.shape[1] // kinds.shape[1], 1) & rows.visible
        levels = []
        for factor in NOISE_LEVELS.tolist():
            root = torch.where(mask, factor**0.5, 1.0)
            level = drifting.changed(noise=root[:, :, None] * noise * root[:, None, :])
            levels.append((level.given.log_evidence() - 0.5 * (log(factor) / NOISE_EFOLDS) ** 2, level.noise))
        noise = max(levels, key=itemgetter(0))[1]
    return rows.changed(noise=noise)


def knows_ball(model: CalibratedKinematics) -> bool:
    """Whether the last marker of the fit is a ball whose position no device measured."""
    return model.ball or model.map.unregistered.stands_free


def _place_of_device(
    old: FittedMap, lever: float | None, device: Measurements, marker_std: float | None, *, opens: bool
) -> tuple[NewRows, Registration, Tensor]:
    """Where the device of the largest session is, and the points (M, P, 3) of all rows in its frame, m."""
    rows, record = find_place(old, lever, device.largest_session(), marker_std=marker_std, opens=opens)
    turn, T = float(record.frame_deviations[3:].max()), record.transform
    if turn > LARGEST_TURN_RAD:
        raise MeasurementError.of(
            "the new rows do not tell where the measuring device stands",
            expected="markers that are not all on one line or at one place",
            got=f"its turn is known to {degrees(turn):.2g} degrees only",
            fix="measure poses in which several joints move",
        )
    middles = [rows.given.shown(each).unflatten(1, (-1, 3)).nanmean(1) for each in (rows.y, rows.points)]
    measured, predicted = (float((each - each.mean(0)).norm()) for each in middles)
    if abs(measured - predicted) > USUAL_RATIO * predicted:
        what = f"distances between the new rows are {measured / predicted:.4f} times those that the model predicts"
        warn_user(sentence(what, fix="check the scale of the measuring device"))
    points = old.geodesic.with_nominal(robot_map(old).under(device.payload))(device.q).detach().unflatten(1, (-1, 3))
    return rows, record, points @ T[:3, :3].mT + T[:3, 3]


def with_ball(fitted: FittedMap, ball: Tensor, tip: str, deviation: float) -> FittedMap:
    """Add a ball (3,) in the frame of a tip as the last marker of a map, with a deviation of its prior, m."""
    old, nominal = fitted.geodesic, robot_map(fitted)
    end = nominal.geometry.size
    tool = torch.cat([nominal.geometry.tool, ball[None]])
    geometry = nominal.geometry.with_tool(tool, (*nominal.geometry.on, tip))
    after = nominal.with_geometry(geometry)
    prior, theta = old.spec.prior_variance, old.momenta.theta
    prior = torch.cat([prior[:end], prior.new_full((3,), deviation**2), prior[end:]])
    theta = torch.cat([theta[:end], theta.new_zeros(3), theta[end:]])
    p = old.momenta.task.view(len(old.x), -1, 3)
    p = torch.cat([p, p.new_zeros(len(p), 1, 3)], 1).flatten(0, 1)
    by_row = old.spec.at_controls
    if isinstance(by_row, SessionMarkers):  # the ball is at one place in all sessions
        tools = torch.cat([by_row.tools, ball.expand(len(by_row.tools), 1, 3)], 1)
        by_row = SessionMarkers(after.with_payload(by_row.load), by_row.session, tools)
    elif isinstance(by_row, GeometryMap):
        by_row = after.with_payload(by_row.load)
    spec = replace(old.spec, nominal=after, prior_variance=prior, at_controls=by_row)
    deformation = GeodesicDeformation(spec, old.x, Momenta(old.momenta.joint, p, theta), old.integrator)
    markers = nominal.geometry.markers
    slopes = pad(fitted.functionals, (0, 3))
    new_noise = torch.block_diag(fitted.new_noise, own_blocks(fitted.new_noise[None], markers)[0].mean(0))
    return replace(fitted, deformation=deformation, new_noise=new_noise, slopes=slopes, y=fitted.measured())


def check_arguments(model: object, new: object, marker: object) -> None:
    """Raise InputError for arguments of the wrong kind."""
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of("`model`", expected="a calibrated model of a robot", got=type(model).__name__)
    if not isinstance(new, RowGroups):
        expected = "dc.Measurements, dc.Readings or dc.Observations"
        raise InputError.of("the new rows", expected=expected, got=type(new).__name__)
    if not isinstance(marker, str) or marker not in get_args(Marker):
        raise InputError.of("`marker`", expected=", ".join(map(repr, get_args(Marker))), got=as_written(marker))


def check_other_table(model: CalibratedKinematics, new: Any) -> None:
    """Raise InputError for rows of the model's own fit, or that it learnt from: they would count twice."""
    hashes = [each.table_sha256 for each in (model.provenance, model.registration) if each is not None]
    if new.sha256 in " ".join(hashes).split():
        used = int(rows_used_in_fit(model, new.q).sum())
        if used:
            what = f"the model was fitted to {used} of these {len(new)} measurements: they would count twice"
            raise InputError.of(what, fix="pass rows that were measured later")


def both_dates(new: NewRows, factor: float, drifts: Sequence[ChangedPart] = ()) -> tuple[Problem, Momenta]:
    """The problem of old and new rows, and the old momenta as its start.

    Args:
        new: the rows. factor: on all variances, which changes the uncertainty, but not the optimum.
        drifts: what has changed besides places.
    """
    old, count = new.fitted, len(new)
    spec, (b, p, theta), x = old.geodesic.spec, old.deformation.momenta.tensors, old.deformation.x
    nominal = robot_map(old).typical
    geometry = nominal.geometry
    newest = nominal.with_geometry(geometry.with_tool(new.marks.points - theta[geometry.slices["tool"]].view(-1, 3)))
    joint_kernel, prior = grown(spec, drifts)
    if bool(new.deviations[:6].any()):  # a device says where the base is
        prior[geometry.slices["base"]] = prior[geometry.slices["base"]].clamp(min=PLACES.found_m_rad**2)
    y, noise, observe = _together(new)
    before, rows = _shared(new, drifts), y.shape[1]
    before = pad(before, (0, new.shared.shape[2], 0, rows - before.shape[1]))
    since = pad(new.shared, (before.shape[2] - new.shared.shape[2], 0, 0, rows - new.shared.shape[1]))
    problem = Problem(
        newest,
        torch.cat([old.x, new.q]),
        y,
        joint_kernel=joint_kernel.scaled(factor),
        task_kernel=spec.task_kernel.scaled(factor),
        noise=Noise(factor * noise, factor**0.5 * torch.cat([before, since])),
        markers=geometry.markers,
        prior_variance=factor * prior,
        new_noise=factor * new.new_noise,
        observe=observe,
    )
    problem = problem.with_nominal_of_rows(_sessions(geometry.tool, new, newest))
    if old.data is not None or problem.y.numel() > MAX_DENSE:
        problem = problem.with_controls(torch.cat([x, new.q]))
    eye = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)[None]
    grew = [kernel.own_blocks(x[:1], eye).diagonal(dim1=1, dim2=2) for kernel in (spec.joint_kernel, joint_kernel)]
    b = b * (grew[0] / grew[1]).nan_to_num(1.0)  # fields start as they were
    b, p = pad(b, (0, 0, 0, count)) / factor, pad(p, (0, 0, 0, count * geometry.markers)) / factor
    return problem, Momenta(b, p, theta)


def _together(new: NewRows) -> tuple[Tensor, Tensor, Observation | None]:
    """Numbers (N + M, R), m, their noise (N + M, R, R), and what they are of the points.

    Old rows are what was measured of k1 to first order around the fit; the old fit's own numbers if it knows.
    """
    old, own_noise = new.fitted, new.weighted_noise
    if new.of_coordinates:
        return torch.cat([old.measured(), new.y]), torch.cat([old.noise.covariance, own_noise]), None
    A, y = old.linearised_rows()
    (N, r, m), (M, count) = A.shape, new.y.shape
    size, rows = max(r, count), torch.arange(N + M, device=y.device)
    parts = [Part(rows[:N], torch.arange(m, device=y.device), torch.arange(r, device=y.device), LinearFunctionals(A))]
    theirs = (Part.of_coordinates(rows[:M], count),) if new.observe is None else new.observe.parts
    parts += [replace(part, rows=part.rows + N) for part in theirs]
    noise = [pad(each, 2 * (0, size - each.shape[1])) for each in (old.noise.covariance, own_noise)]
    visible = torch.cat([pad(each, (0, size - each.shape[1])) for each in (old.noise.visible, new.visible)])
    numbers = torch.cat([pad(values, (0, size - values.shape[1])) for values in (y, new.y)])
    return numbers, without_hidden(torch.cat(noise), visible), Stacked(N + M, size, m, parts)


def _shared(new: NewRows, drifts: Sequence[ChangedPart]) -> Tensor:
    """(N, r, c) shifts of the old rows: those they shared already, device and markers since, what has drifted since."""
    old, tool = new.fitted, new.nominal.geometry.slices["tool"]
    A, at = old.functionals, old.geodesic.linearise(None if old.data is None else old.x)
    # about measured points, where the new map is: what rows leave open may be centimetres away in the old one
    places = old.measured() if old.slopes is None else old.fitted_points
    by_frame = frame_slopes(places.unflatten(1, (-1, 3)), new.centre)
    moved = A @ torch.cat([by_frame, at.sensitivity[..., tool]], 2) * new.deviations
    at = at.projected(A)
    return torch.cat([old.noise.shared, moved[..., new.free], *(part.before(at) for part in drifts)], 2)


def _sessions(tool: Tensor, new: NewRows, newest: GeometryMap) -> SessionMarkers:
    """k0 at the controls: every session with its own markers, every row with its own payload."""
    by_row, x = new.fitted.geodesic.spec.at_controls, new.fitted.deformation.x
    session, tools = torch.zeros(len(x), dtype=torch.int64, device=x.device), tool[None]
    if isinstance(by_row, SessionMarkers):
        session, tools, by_row = by_row.session, by_row.tools, by_row.nominal
    latest = torch.full((len(new.q),), len(tools), dtype=torch.int64, device=x.device)
    if isinstance(by_row, GeometryMap):
        before, after = by_row.load, new.marks.fitted.load
        newest = newest.under(torch.cat([before.masses, after.masses.to(before.masses)]) if before and after else None)
    return SessionMarkers(newest, torch.cat([session, latest]), torch.cat([tools, newest.geometry.tool[None]]))


def devices_beside(model: Any, data: Any, fitted: Sequence[Extrinsics] = ()) -> tuple[Extrinsics, ...]:
    """The devices of rows of any kinds, placed around a calibrated model that knows the rows' points.

    Devices that the model knows and that have no rows stay where they are.

    Args:
        model, data: the model and the rows.
        fitted: devices with their rows, if the model was fitted to these: set-ups are where the fit has them.
    """
    devices = list(model.placement)
    for part, _ in rows_of_one_kind(data):
        sensor_of(part).check(part, model)
        points = model.at_payloads(part.payload).map(part.q).detach().unflatten(1, (-1, 3))
        for placed in sensor_of(part).settled(part, points, model.turns):
            new, other = placed, next((each for each in fitted if each.same_set(placed)), None)
            if other is not None and not new.set_up:
                number = torch.tensor([new.names.index(name) for name in other.names], dtype=torch.int64, device=HOST)
                other = replace(new, rows=other.rows, device=number[other.device])
            new = new if other is None else other
            same = next((number for number, old in enumerate(devices) if new.same_set(old)), len(devices))
            alone = [] if new.set_up and len(new.names) == 1 else [new]
            devices[same : same + 1] = [new.beside(old) for old in devices[same : same + 1]] or alone
    return tuple(devices)


def carried_devices(old: Any, new: Any, T: Tensor) -> tuple[Extrinsics, ...]:
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
    return tuple(
        replace(devices, constants=devices.carried(T, before, after, markers))
        for devices in old.placement
        if devices.kind != KnownDrift.kind
    )
