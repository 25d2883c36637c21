"""What is known before the first planned pose: of a robot by its description, or by a fitted model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior, held_parameters
from diffeo_calib.calibration.planning.sensors import Scene
from diffeo_calib.calibration.scales.defaults import defaults
from diffeo_calib.calibration.scales.hyperparameters import PLACE_DEVIATION, Hyperparameters
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import InputError, as_written, few
from diffeo_calib.fitting.fitted_map import PREDICT_ROWS, FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap, frame_slopes, marker_slopes
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.bodies import origins, table_of_points
from diffeo_calib.measurements.pose_frames import POINTS
from diffeo_calib.measurements.poses import LEVER, mark_points
from diffeo_calib.regression.conditional import Conditional, Features
from diffeo_calib.regression.rigid_motions import WithoutRigidMotions
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.tables import device_coordinates

USUAL_RESIDUAL = 3e-4
"""What the geometric calibration of an industrial robot leaves per coordinate, relative to the markers' spread."""
MARKER = (0.1, 0.0, 0.1)
"""Default marker in the tip's frame, m: off the axis of the last joint, so that this joint moves it."""
FREE = ("base", "marker", "both")


@dataclass(frozen=True)
class Start:
    """What is known at some configurations.

    Args:
        at: first-order response of the markers, whose fields are unknown.
        features: parameters, earlier data, and what may have moved, for one group of configurations after the other.
        scene: the markers there.
        shifts: (k, c0) features of the shifts that rows of the fit shared.
    """

    at: Linearisation
    features: Iterable[Features]
    scene: Scene
    shifts: Tensor


def of_robot(
    robot: Tree, tool: Tool, q: Tensor, near: Tensor, scales: Hyperparameters | None, *, adrift: bool
) -> Start:
    """The tangent model around the nominal robot; base and markers are known to 0.1 m and 0.1 rad.

    Args:
        robot: nominal chain.
        tool: what is measured of it.
        q: (M, n) configurations. near: (T, n) those from which default scales follow.
        scales: of the errors; defaults for an industrial robot if not given.
        adrift: whether nothing will say where the robot stands: then its base is where the errors are judged.
    """
    points, on, lever = tool
    if float(points.norm(dim=1).max()) > robot.reach:
        expected, got = f"within the robot's reach of {robot.reach:.3g} m", f"{float(points.norm(dim=1).max()):.3g} m"
        raise InputError.of("`marker` in the tip's frame", expected=expected, got=got, fix="check the unit, m")
    geometry = Geometry.nominal(robot).with_tool(points, on)
    spread = geometry.points(near).reshape(-1, 3)
    residual = USUAL_RESIDUAL * float(spread.std(0).norm()) if len(near) > 1 else USUAL_RESIDUAL
    data = _tangent_data(geometry, lever, q, residual)
    if scales is None:
        scales = defaults(_tangent_data(geometry, lever, near, residual), residual, Prior())
    data = replace(data, held=held_parameters(geometry) if adrift else ())
    features = Features.of(((data.sensitivities * data.prior_variance(scales).sqrt()).flatten(0, 1).T, 1))
    noise = data.noise(scales)
    scene = Scene(data.points, noise, geometry.base, origins(lever, noise), 3 * len(tool.points), free=adrift)
    return Start(data.linearisation(scales), [features], scene, noise.new_zeros(len(features.signs), 0))


class Tool(NamedTuple):
    """What is measured of a robot: points (P, 3) in the frames of tips, m, and these; the lever of measured frames."""

    points: Tensor
    on: tuple[str, ...]
    lever: float | None


def tool_of(robot: Tree, marker: object) -> Tool:
    """What is measured.

    Args:
        robot: the chain.
        marker: of every tip: (3,) or (P, 3) markers in its frame, m, or the (4, 4) pose of a measured frame there; or a
            dictionary tip -> one of these.
    """
    by_tip = marker if isinstance(marker, Mapping) else dict.fromkeys(robot.tips, marker)
    if not by_tip or not set(by_tip) <= set(robot.tips):
        raise InputError.of("`marker`", expected=f"markers on {few(robot.tips)}", got=as_written(marker))
    points, on, levers = list[Tensor](), tuple[str, ...](), set[float | None]()
    for tip, given in by_tip.items():
        value = as_tensor(MARKER if given is None else given, "marker", (3,), also=(("P", 3), (4, 4)))
        framed = value.shape == (4, 4)
        own = mark_points(rigid(value, "marker")[None], LEVER)[0] if framed else value.reshape(-1, 3)
        points.append(own)
        on += (tip,) * len(own)
        levers.add(LEVER if framed else None)
    if len(levers) > 1:
        fix = "give markers on all tips, or frames on all"
        raise InputError.of("`marker` has points and frames", expected="one kind", fix=fix)
    return Tool(torch.cat(points), on, *levers)


def _tangent_data(geometry: Geometry, lever: float | None, q: Tensor, residual: float) -> TangentData:
    """Configurations around the nominal geometry, to be measured with the usual noise."""
    on = geometry.on[::POINTS] if len(set(geometry.on)) > 1 else None
    data = table_of_points(q, geometry.points(q), lever, on)
    nominal, sensor = GeometryMap(geometry, elastic=True), NoiseModel.of(data, residual)
    theta = q.new_zeros(nominal.parameters)
    return TangentData(nominal, theta, q, data.points.flatten(1), sensor, Tails.none(len(q), sensor.bodies))


def of_model(model: CalibratedKinematics, q: Tensor, free: str | None) -> Start:
    """The posterior of a fitted model.

    Args:
        model: fitted, or registered anew.
        q: (M, n) configurations.
        free: what may have moved since the fit, besides what a registration has left free.
    """
    fitted = model.map
    groups = q.split(PREDICT_ROWS)
    points, parts = zip(*(fitted.geodesic.linearised_value(rows) for rows in groups), strict=True)
    features = (_features(fitted, at, rows, free) for at, rows in zip(parts, groups, strict=True))
    noise, adrift = fitted.new_noise, fitted.workspace is not None
    known = noise.expand(len(q), -1, -1), model.geometry.base.to(noise), origins(model.lever, noise)
    seen = device_coordinates(fitted.m, ball=model.ball, free=adrift)
    shifts = noise.new_zeros(0, 0)
    if fitted.noise.shared.shape[2] and not isinstance(fitted, RegisteredMap):
        shifts = _conditional(fitted).shift_features()
    scene = Scene(torch.cat(points), *known, seen, adrift, shifts.shape[1])
    return Start(Linearisation.joined(parts), features, scene, shifts)


def _conditional(fitted: FittedMap) -> Conditional:
    """That of the fit, with the rigid motions that no device shows: devices and robot have them in common."""
    found = fitted.conditional
    return found.conditional if isinstance(found, WithoutRigidMotions) else found


def registered_rows(model: CalibratedKinematics, free: str | None) -> Tensor:
    """Rows (M, n) of a registration, which tell where the device stands; none if it has moved again."""
    fitted = model.map
    if isinstance(fitted, RegisteredMap) and free is None:
        return fitted.registration.q
    return fitted.x[:0]


def _features(fitted: FittedMap, at: Linearisation, q: Tensor, free: str | None) -> Features:
    """Features of a linearisation at q, and of what may have moved."""
    known = _conditional(fitted).features(at)
    added = []
    if isinstance(fitted, RegisteredMap):
        free = _either(free, fitted.registration.free)
    else:
        sensitivity = fitted.open_sensitivity(fitted.geodesic.spec.nominal, q)
        if sensitivity is not None:
            added.append(sensitivity @ fitted.open_directions)
    if free in ("base", "both"):
        points = at.task[-1].points.view(len(q), -1, 3)
        added.append(PLACE_DEVIATION * frame_slopes(points, fitted.deformation.z1.view(-1, 3).mean(0)))
    if free in ("marker", "both"):
        added.append(PLACE_DEVIATION * _by_marker(fitted, at, q))
    more = Features.of(*[(root.flatten(0, 1).T, 1) for root in added]) if added else Features.of((known.values[:0], 1))
    return Features(torch.cat([known.values, more.values]), torch.cat([known.signs, more.signs]))


def _either(first: str | None, second: str) -> str:
    """What is free if either leaves it free."""
    return second if first is None or first == second else "both"


def _by_marker(fitted: FittedMap, at: Linearisation, q: Tensor) -> Tensor:
    """Derivatives of the markers by their places on the flange: (M, m, m)."""
    if isinstance(fitted, RegisteredMap):
        return marker_slopes(fitted.geodesic, fitted.points, q)
    nominal = fitted.geodesic.spec.nominal
    if not isinstance(nominal, GeometryMap):
        raise InputError.of("the map of a robot model", expected="a GeometryMap", got=type(nominal).__name__)
    return at.sensitivity[..., nominal.geometry.slices["tool"]]
