"""New rows of any kinds beside an old model: where devices and markers are now.

Where a device measured coordinates, it says where the robot stands: the frame of the device (of the largest session) is
found by a registration. Sockets and the devices of readings stand around the robot that the model knows.
"""

from __future__ import annotations

from dataclasses import replace
from math import degrees, log, nan
from operator import itemgetter
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from diffeo_calib.calibration.placing.readings import ball_of
from diffeo_calib.calibration.placing.sessions import Sessions
from diffeo_calib.calibration.recalibration.drift import parts_of
from diffeo_calib.calibration.recalibration.find_place import (
    MARKER_DEVIATIONS,
    UNMOVED_LOG_ODDS,
    find_place,
    opened,
)
from diffeo_calib.calibration.recalibration.new_rows import NewRows, NewSetUp, UsualNoise
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, few, sentence, warn_user
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import rows_used_in_fit
from diffeo_calib.kinematics.joint_ranges import check_same_robot
from diffeo_calib.kinematics.nominal import GeometryMap, SessionMarkers
from diffeo_calib.kinematics.registered_map import Registration, fitted_markers, robot_map
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.observation import single_coordinates
from diffeo_calib.measurements.checks import in_other_unit
from diffeo_calib.measurements.poses import own_blocks
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.coordinates import check_shown, mounted_of, sensor_of, with_earlier_cameras
from diffeo_calib.sensors.tables import (
    ball_tip,
    check_markers,
    divided,
    rows_of_one_kind,
    with_markers,
)


def place_again(model: CalibratedKinematics, new: Any, marker: Marker = "evidence", *, opens: bool = True) -> NewSetUp:
    """Find where device and markers are now.

    Args:
        model: the old model. new: the rows.
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
    """The new rows with their weights, and with the markers as free as is asked or as is most probable.

    Rows have the noise of a typical old row, or their own where it is larger.

    Args:
        set_up: the rows, and where devices and markers are. marker: see :func:`diffeo_calib.recalibrate`.
        opens: whether something may have changed among the rows.
    """
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

    def predicted(rows: Measurements) -> Tensor:
        return old.geodesic.with_nominal(robot_map(old).under(rows.payload))(rows.q).detach().unflatten(1, (-1, 3))

    largest = device.largest_session()
    ratio = size_ratio(predicted(largest), largest.points)
    if in_other_unit(ratio, OTHER_UNIT):
        what, expected = "do not have the robot's size", "distances between rows as the model predicts them"
        fix, got = "check `length` and `angle`, and the order of the columns", f"{ratio:.3g} times these"
        raise MeasurementError.of(f"the new rows {what}", expected=expected, got=got, fix=fix)
    rows, record = find_place(old, lever, largest, marker_std=marker_std, opens=opens)
    ratio = size_ratio(*(each.unflatten(1, (-1, 3)) for each in (rows.points, rows.given.shown(rows.y))))
    if abs(ratio - 1.0) > USUAL_RATIO:
        what = f"distances between the new rows are {ratio:.4f} times those that the model predicts"
        warn_user(sentence(what, fix="check the scale of the measuring device"))
    turn, T = float(record.frame_deviations[3:].max()), record.transform
    if turn > LARGEST_TURN_RAD:
        raise MeasurementError.of(
            "the new rows do not tell where the measuring device stands",
            expected="markers that are not all on one line or at one place",
            got=f"its turn is known to {degrees(turn):.2g} degrees only",
            fix="measure poses in which several joints move",
        )
    return rows, record, predicted(device) @ T[:3, :3].mT + T[:3, 3]


def with_ball(fitted: FittedMap, ball: Tensor, tip: str, deviation: float) -> FittedMap:
    """Add a ball as the last marker of a map.

    Args:
        fitted: the map. ball: (3,) where it roughly is in the frame of a tip, m.
        tip: name of the tip. deviation: of its prior around that place, m.
    """
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
    slopes = torch.nn.functional.pad(fitted.functionals, (0, 3))
    new_noise = torch.block_diag(fitted.new_noise, own_blocks(fitted.new_noise[None], markers)[0].mean(0))
    return replace(fitted, deformation=deformation, new_noise=new_noise, slopes=slopes, y=fitted.measured())


Marker = Literal["evidence", "same", "moved", "other"]
LARGEST_TURN_RAD = 0.1  # standard deviation of the turn of the measuring device from which its place is open
OTHER_UNIT = 0.5
"""Relative error of a thousand times the measured distances: markers that sit elsewhere lengthen and shorten them."""
USUAL_RATIO = 3e-3  # relative error of distances that no robot has
FARTHEST_PAIRS = 0.5  # of all pairs of rows, this part with the largest distances is compared


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


def size_ratio(predicted: Tensor, measured: Tensor) -> float:
    """Median ratio of measured and predicted distances between rows, which no place of the device changes.

    The middle of the markers that a row shows stands for the row.
    """
    expected, actual = (
        torch.pdist(points.masked_fill(measured.isnan(), nan).nanmean(1)) for points in (predicted, measured)
    )
    far = expected >= expected.quantile(FARTHEST_PAIRS) if len(expected) else expected.bool()
    return float((actual[far] / expected[far]).median()) if bool((expected[far] > 0).all()) and len(expected) else 1.0
