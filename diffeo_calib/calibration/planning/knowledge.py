"""Covariance of the markers at many configurations before the next measurement, and the best one to make.

What is known before the first one is that of a robot by its description, or of a fitted model.

What may have moved since, and what is not known about the devices, c ~ N(0, I), are more unknowns of the conditional. A
measurement reports A z(x) + D c + noise.

Measurements are chosen greedily: each is the one that lowers the mean variance over the targets most. With
C_i = K(targets, measurement i), this lowers their variance by

    gain_i = tr[(K_ii + R_i)^-1 C_i^T C_i],

where K is the covariance after those chosen before (Cohn, Ghahramani, Jordan, "Active learning with statistical
models", 1996; sequential A-optimal design for predictions). Taking one costs one row of K and an update of rank r.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior, held_parameters
from diffeo_calib.calibration.planning.sensors import Options, Scene
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import InputError, as_written, few
from diffeo_calib.common.threads import large_work
from diffeo_calib.fitting.fitted_map import PREDICT_ROWS
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.registered_map import robot_map
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.process.tails import Tails
from diffeo_calib.regression.conditional import (
    Conditional,
    Fields,
    Opened,
    diagonal_blocks,
    lower_root,
)
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tables import device_coordinates


def greedy(
    C: Tensor, own: Tensor, between: Callable[[int], Tensor], *, place: Tensor, open_: Tensor, count: int
) -> tuple[list[int], Tensor]:
    """Options that lower the variance of k numbers most, one after the other, see the module.

    Args:
        C: (k, M r) covariance of the numbers with the M options. own: (M, r, r) that of each, with noise.
        between: covariance (r, M r) of an option with all, without noise.
        place: (M,) where each is measured: at one place one is taken. open_: (M,) boolean: those that can be taken.

    Returns:
        the options, and (count, r, k) whose squares, summed over r, are what each takes from the variances.

    Raises:
        NumericalError: the covariance of the measurements is not positive definite.
    """
    M, r, _ = own.shape
    order, taken, lowered = list[int](), C.new_zeros(0, M * r), list[Tensor]()
    each = C.T.contiguous().view(M, r, -1)
    for _ in range(count):
        gains = torch.linalg.solve(own, each @ each.mT).diagonal(dim1=1, dim2=2).sum(1)
        best = int(torch.where(open_, gains, -torch.inf).argmax())
        mine = slice(best * r, best * r + r)
        with large_work(taken.numel()):
            both = torch.cat([between(best) - taken[:, mine].T @ taken, each[best]], 1)
            both = torch.linalg.solve_triangular(lower_root(own[best]), both, upper=False)
            row, by = both[:, : M * r], both[:, M * r :]
            each.flatten(0, 1).addmm_(row.T, by, alpha=-1.0)
            taken, less = torch.cat([taken, row]), row.T.reshape(M, r, r)
        own, open_ = own - less @ less.mT, open_ & (place != place[best])
        order.append(best)
        lowered.append(by)
    return order, torch.stack(lowered) if lowered else each.new_zeros(0, r, len(C))


def choose(known: Conditional, options: Options, scene: Scene, targets: Tensor, count: int) -> tuple[list[int], Tensor]:
    """Choose ``count`` of the options, at most one at every configuration.

    Args:
        known: before the first. targets: (T,) numbers of the configurations where the robot shall be known.

    Returns:
        numbers of the options in the order in which they were taken, and the mean variance (count + 1,) of the targets'
        coordinates after 0, 1, ... of them, m^2.
    """
    at = known.features(scene.at.rows(targets))
    P = torch.eye(at.values.shape[1], dtype=at.values.dtype, device=at.values.device)
    if scene.free:
        B = at.at.sensitivity[..., scene.motions].flatten(0, 1)
        P = P - B @ torch.linalg.pinv(B)
    own = P @ at.between() @ P
    seen = known.features(options.linearised(scene))

    def between(number: int) -> Tensor:
        return seen.rows(torch.tensor([number], dtype=torch.int64, device=P.device)).between(seen)

    how = {"place": options.rows, "open_": torch.ones_like(options.rows, dtype=torch.bool), "count": count}
    order, by = greedy(P @ at.between(seen), seen.blocks() + options.noise, between, **how)
    variance = scene.along(diagonal_blocks(own, len(targets))).diagonal(dim1=1, dim2=2).mean()
    lowered = (by.unflatten(2, (len(targets), -1)) @ scene.averaged.mT).square().sum(1).mean((1, 2))
    return order, torch.cat([variance[None], -lowered]).cumsum(0).clamp(min=0)


USUAL_RESIDUAL = 3e-4
"""Residual of the geometric calibration of an industrial robot per coordinate, relative to the markers' spread."""
MARKER = (0.1, 0.0, 0.1)
"""Default marker in the tip's frame, m: off the axis of the last joint, so that this joint moves it."""
FREE = ("base", "marker", "both")


def of_robot(
    robot: Tree, tool: Tool, q: Tensor, near: Tensor, scales: Hyperparameters | None, *, adrift: bool
) -> Scene:
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
    data = replace(data, held=held_parameters(geometry, adrift=adrift), adrift=adrift)
    deviations, noise = data.prior_variance(scales).sqrt(), data.noise(scales)
    known = Opened(Fields(), 0, deviations), data.linearisation(scales), len(deviations)
    averaged = Bodies(lever).averaging(noise)
    return Scene(*known, data.points, noise, geometry.base, averaged, 3 * len(tool.points), free=adrift)


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
    on = geometry.on if len(set(geometry.on)) > 1 else None
    data = Measurements.of_points(q, geometry.points(q), on, lever)
    nominal, sensor = GeometryMap(geometry, elastic=not is_cartesian(geometry.chain)), NoiseModel.of(data, residual)
    theta = q.new_zeros(nominal.parameters)
    return TangentData(nominal, theta, q, data.points.flatten(1), sensor, Tails.none(len(q), sensor.bodies))


def of_model(model: CalibratedKinematics, q: Tensor, free: str | None) -> Scene:
    """The posterior of a fitted model.

    A ball beside markers stays on its tool: no row of the device would say where it is now.

    Args:
        model: fitted, or registered anew. q: (M, n) configurations.
        free: what may have moved since the fit, besides what a registration has left free.
    """
    fitted, fit, registration = model.map, model.map.unregistered, model.map.registration
    if registration is not None and free != registration.free:
        free = registration.free if free is None else "both"
    adrift, tool = fitted.stands_free, robot_map(fit).geometry.slices["tool"]
    seen, middle = device_coordinates(fitted.m, ball=model.ball, free=adrift), fitted.deformation.z1.view(-1, 3).mean(0)
    points, parts = [], []
    for rows in q.split(PREDICT_ROWS):
        z, at = fitted.linearised_value(rows)
        if registration is None:
            columns = frame_slopes(z.unflatten(1, (-1, 3)), middle), at.sensitivity[..., tool]
            at = at.with_columns(torch.cat(columns, 2), fit.columns)
        points.append(z)
        parts.append(at)
    moved = fitted.new_noise.new_zeros(6 + fitted.m)
    moved[:6] = PLACES.found_m_rad * (free in ("base", "both"))
    moved[6 : 6 + seen] = PLACES.found_m_rad * (free in ("marker", "both"))
    base, averaged = model.geometry.base.to(moved), model.bodies.averaging(fitted.new_noise)
    shifts = 0 if registration is not None else fitted.noise.shared.shape[2]
    noise = fitted.new_noise.expand(len(q), -1, -1)
    known = Opened(fit.with_motions, fit.columns, moved), Linearisation.joined(parts), fit.columns + len(moved)
    return Scene(*known, torch.cat(points), noise, base, averaged, seen, adrift, shifts)
