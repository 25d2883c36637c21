"""`model.registered`: the record of where device and markers are, what is learnt from the rows, and the devices."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, few, sentence, warn_user
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.re_registration.both_dates import both_dates, joins
from diffeo_calib.kinematics.re_registration.find_place import SAME_PLACE, FoundPlace, find_place, warn_about
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap, Registration, moved, robot_map
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.coordinates import sensor_of
from diffeo_calib.sensors.places import DRIFT, PlacedDevices
from diffeo_calib.sensors.set_ups import mounted_of
from diffeo_calib.sensors.tables import rows_of_one_kind

LOG = logging.getLogger(__name__)
LARGEST_M_RAD = 0.03
"""Deviation of a place, m or rad, from which its rows teach nothing about the robot: to first order they would."""
STEPS = GaussNewton(max_iterations=2, tolerance=0.0)
"""The first one is within 2 % of the optimum, the second within 0.1 %."""


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
    learn = learn and found.rows.points.same and open_by < LARGEST_M_RAD and not registration.doubtful
    learn = learn and (model.registration is None or free == "both")  # what is held must be known
    if not (learn and joins(fit, len(found.rows))):
        placed = moved(fit, registration.transform).inflated(found.rows.inflation)
        return RegisteredMap(placed, registration), registration
    learnt = moved(_learnt(fit, found), registration.transform)
    own, old = robot_map(learnt), found.rows.old_markers
    markers = own.geometry.tool + learnt.deformation.momenta.theta[own.geometry.slices["tool"]].view(-1, 3)
    return learnt, replace(registration, markers=markers, shift=markers - old)


def _learnt(fit: FittedMap, found: FoundPlace) -> FittedMap:
    """The fit conditioned on the rows that took part, too, in its own frame, as if nothing but places had changed."""
    new, same = found.rows, found.metres == SAME_PLACE
    known = torch.full_like(new.deviations, PLACES.found_m_rad)
    known[6:] = PLACES.same_m if same else found.metres
    points = FlangePoints(new.points.fitted, new.old_markers, same=True) if same else new.points
    new = replace(new, points=points, deviations=known * (new.deviations > 0))
    problem, start = both_dates(new, found.rows.inflation)
    solution = STEPS.solve(problem, fit.geodesic.integrator, start)
    if solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum
    return problem.calibrated(problem.deform(solution.momenta, fit.geodesic.integrator))


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
