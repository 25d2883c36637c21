"""Covariance of the markers at many configurations before the next measurement, and the best one to make.

What is known before the first one is that of a robot by its description, or of a fitted model. Both are a conditional
and a linearisation, whose columns are all that is not known: parameters, shifts that rows of a fit shared, places that
may have changed since, and then unknowns c ~ N(0, I) of devices. A measurement reports A z(x) + D c + noise.

Measurements are chosen greedily: each is the one that lowers the mean variance over the targets most. With
C_i = K(targets, measurement i), this lowers their variance by

    gain_i = tr[(K_ii + R_i)^-1 C_i^T C_i],

where K is the covariance after those chosen before (Cohn, Ghahramani, Jordan, "Active learning with statistical
models", 1996; sequential A-optimal design for predictions). Taking one costs one row of K and an update of rank r.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior, held_parameters
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.cameras.images import UNKNOWNS
from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, as_written, few
from diffeo_calib.common.threads import large_work
from diffeo_calib.fitting.fitted_map import PREDICT_ROWS
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.cholesky import lower_root
from diffeo_calib.regression.conditional import BeforeData, Conditional, Opened, diagonal_blocks
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tables import device_coordinates

USUAL_RESIDUAL = 3e-4
"""Residual of the geometric calibration of an industrial robot per coordinate, relative to the markers' spread."""
MARKER = (0.1, 0.0, 0.1)
"""Default marker in the tip's frame, m: off the axis of the last joint, so that this joint moves it."""
FREE = ("base", "marker", "both")


TARGET_COORDINATES = 900
"""Coordinates of the targets that are followed: more make no difference to the choice."""


def gathered(groups: Sequence[Tensor], coordinates: int) -> tuple[Tensor, Sequence[Tensor]]:
    """Configurations (M, n) of several groups, the targets first, and the row numbers of each group.

    Of targets, of so many coordinates each, no more are kept than are followed.
    """
    near, most = groups[0], max(2, TARGET_COORDINATES // coordinates)
    if len(near) > most:
        near = near[torch.linspace(0, len(near) - 1, most, dtype=torch.float64, device=near.device).round().long()]
    sizes = [len(near), *map(len, groups[1:])]
    return torch.cat([near, *groups[1:]]), torch.arange(sum(sizes), device=near.device).split(sizes)


class Scene(NamedTuple):
    """M configurations as a robot or model has them, and what is known there before the first measurement."""

    known: Conditional  # the conditional
    at: Linearisation  # the configurations
    columns: int  # what it knows of unknowns: later ones are new
    points: Tensor  # (M, m) coordinates of the markers, m
    noise: Tensor  # (M, m, m) covariance of one measurement of them, m^2
    base: Tensor  # (4, 4) the robot's base in their frame, m
    averaged: Tensor  # (r, m) the markers, or the origins of measured poses
    seen: int  # the first coordinates, of points that a device of positions sees
    free: bool  # whether nothing says where the robot stands in the frame of a measuring device
    unplaced: bool  # whether a device of positions stands anywhere

    def along(self, blocks: Tensor) -> Tensor:
        """Covariances of the markers, or of the origins of poses, from those of the points: (M, m, m) -> (M, r, r)."""
        return self.averaged @ blocks @ self.averaged.mT

    @property
    def framed(self) -> bool:
        """Whether the points represent frames."""
        return len(self.averaged) < self.points.shape[1]

    def choose(
        self, posterior: Conditional, rows: tuple[Linearisation, Tensor, Tensor], targets: Tensor, count: int
    ) -> tuple[list[int], Tensor]:
        """Choose ``count`` of O measurements, at most one at every configuration.

        Args:
            posterior: before the first. rows: what they report, its noise (O, r, r), m^2, their configurations (O,).
            targets: (T,) numbers of the configurations where the robot shall be known.

        Returns:
            numbers of the measurements in the order in which they were taken, and the mean variance (count + 1,) of the
            targets' coordinates after 0, 1, ... of them, m^2.
        """
        measured, noise, place = rows
        at, features = posterior.features(self.at.rows(targets)), posterior.features(measured)
        P = torch.eye(at.known.shape[1], dtype=at.known.dtype, device=at.known.device)
        if self.free:
            B = at.at.sensitivity[..., list(self.at.spec.nominal.places[:6])].flatten(0, 1)  # by motions of the base
            P = P - B @ torch.linalg.pinv(B)
        blocks = diagonal_blocks(P @ at.between() @ P, len(targets))

        def between(number: int) -> Tensor:
            return features.rows(torch.tensor([number], dtype=torch.int64, device=P.device)).between(features)

        how = {"place": place, "open_": torch.ones_like(place, dtype=torch.bool), "count": count}
        order, by = greedy(P @ at.between(features), features.blocks() + noise, between, **how)
        variance = self.along(blocks).diagonal(dim1=1, dim2=2).mean()
        lowered = (by.unflatten(2, (len(targets), -1)) @ self.averaged.mT).square().sum(1).mean((1, 2))
        return order, torch.cat([variance[None], -lowered]).cumsum(0).clamp(min=0)


def greedy(
    C: Tensor, blocks: Tensor, between: Callable[[int], Tensor], *, place: Tensor, open_: Tensor, count: int
) -> tuple[list[int], Tensor]:
    """Options that lower the variance of k numbers most, one after the other, see the module.

    Args:
        C: (k, M r) covariance of the numbers with the M options. blocks: (M, r, r) that of each, with noise.
        between: covariance (r, M r) of an option with all, without noise.
        place: (M,) where each is measured: at one place one is taken. open_: (M,) boolean: those that can be taken.

    Returns:
        the options, and (count, r, k) whose squares, summed over r, are what each takes from the variances.

    Raises:
        NumericalError: the covariance of the measurements is not positive definite.
    """
    M, r, _ = blocks.shape
    order, taken, lowered = list[int](), C.new_zeros(0, M * r), list[Tensor]()
    each = C.T.contiguous().view(M, r, -1)
    for _ in range(count):
        gains = torch.linalg.solve(blocks, each @ each.mT).diagonal(dim1=1, dim2=2).sum(1)
        best = int(torch.where(open_, gains, -torch.inf).argmax())
        mine = slice(best * r, best * r + r)
        with large_work(taken.numel()):
            both = torch.cat([between(best) - taken[:, mine].T @ taken, each[best]], 1)
            both = torch.linalg.solve_triangular(lower_root(blocks[best]), both, upper=False)
            row, by = both[:, : M * r], both[:, M * r :]
            each.flatten(0, 1).addmm_(row.T, by, alpha=-1.0)
            taken, less = torch.cat([taken, row]), row.T.reshape(M, r, r)
        blocks, open_ = blocks - less @ less.mT, open_ & (place != place[best])
        order.append(best)
        lowered.append(by)
    return order, torch.stack(lowered) if lowered else each.new_zeros(0, r, len(C))


def of_robot(
    robot: Tree, asked: tuple[object, Hyperparameters | None], groups: Sequence[Tensor], *, frames: bool, free: bool
) -> tuple[Scene, Sequence[Tensor]]:
    """The tangent model around the nominal robot; base and markers are known to 0.1 m and 0.1 rad.

    Args:
        robot: nominal chain.
        asked: markers of every tip: (3,) or (P, 3) in its frame, m, or the (4, 4) pose of a measured frame there; or a
            dictionary tip -> one of these. Scales of the errors; by default those of an industrial robot, which follow
            from the targets.
        groups: configurations: targets, those that were measured already, candidates.
        frames: whether frames are measured, by default those of the tips.
        free: whether nothing will say where the robot stands: then its base is where the errors are judged.

    Returns:
        the scene, and the row numbers of targets, measured ones, those of a registration, and candidates.
    """
    marker, scales = asked
    usual = torch.eye(4, dtype=torch.float64, device=HOST) if frames else MARKER
    points, on, lever = _measured_points(robot, marker, usual)
    near, before, wanted = groups
    q, numbers = gathered((near, before, before[:0], wanted), points.numel())
    geometry, near, residual = Geometry.nominal(robot).with_tool(points, on), q[numbers[0]], USUAL_RESIDUAL
    if len(near) > 1:
        residual *= float(geometry.points(near).reshape(-1, 3).std(0).norm())

    def around(configurations: Tensor) -> TangentData:
        """To be measured with the usual noise."""
        tips = geometry.on if len(set(geometry.on)) > 1 else None
        data = Measurements.of_points(configurations, geometry.points(configurations), tips, lever)
        nominal = GeometryMap(geometry, elastic=not is_cartesian(geometry.chain))
        how, theta = NoiseModel.of(data, residual), q.new_zeros(nominal.parameters)
        tails = Tails.none(len(configurations), how.bodies)
        return TangentData(nominal, theta, configurations, data.points.flatten(1), how, tails)

    scales = defaults(around(near), residual, Prior()) if scales is None else scales
    data = replace(around(q), held=held_parameters(geometry, adrift=free), adrift=free)
    deviations, noise = data.prior_variance(scales).sqrt(), data.noise(scales)
    before = BeforeData(deviations), data.linearisation(scales), len(deviations)
    averaged = Bodies(lever).averaging(noise)
    scene = Scene(*before, data.points, noise, geometry.base, averaged, points.numel(), free, unplaced=False)
    return scene, numbers


def _measured_points(robot: Tree, marker: object, usual: object) -> tuple[Tensor, tuple[str, ...], float | None]:
    """Points (P, 3) in the frames of tips, m, and these; the lever of measured frames, m. See :func:`of_robot`."""
    by_tip = marker if isinstance(marker, Mapping) else dict.fromkeys(robot.tips, marker)
    if not by_tip or not set(by_tip) <= set(robot.tips):
        raise InputError.of("`marker`", expected=f"markers on {few(robot.tips)}", got=as_written(marker))
    marks, on, levers = list[Tensor](), tuple[str, ...](), set[float | None]()
    for tip, given in by_tip.items():
        value = as_tensor(usual if given is None else given, "marker", (3,), also=(("P", 3), (4, 4)))
        framed = value.shape == (4, 4)
        marks.append(mark_points(rigid(value, "marker")[None], LEVER)[0] if framed else value.reshape(-1, 3))
        on += (tip,) * len(marks[-1])
        levers.add(LEVER if framed else None)
    if len(levers) > 1:
        fix = "give markers on all tips, or frames on all"
        raise InputError.of("`marker` has points and frames", expected="one kind", fix=fix)
    points = torch.cat(marks)
    if (away := float(points.norm(dim=1).max())) > robot.reach:
        expected = f"within the robot's reach of {robot.reach:.3g} m"
        raise InputError.of(
            "`marker` in the tip's frame", expected=expected, got=f"{away:.3g} m", fix="check the unit, m"
        )
    return points, on, levers.pop()


def of_model(model: CalibratedKinematics, free: str | None, groups: Sequence[Tensor]) -> tuple[Scene, Sequence[Tensor]]:
    """The posterior of a fitted model, or of one registered anew, whose rows tell where the device stands.

    A ball beside markers stays on its tool: no row of the device would say where it is now.

    Args:
        free: what may have moved since the fit, besides what a registration has left free.
        groups: see :func:`of_robot`, so is what is returned.
    """
    fitted, fit, tool = model.map, model.map.unregistered, model.nominal.geometry.slices["tool"]
    (near, before, wanted), registration = groups, fitted.registration
    registered = before[:0] if registration is None or free is not None else registration.q.to(before)
    q, numbers = gathered((near, before, registered, wanted), fitted.m)
    if registration is not None and free != registration.free:
        free = registration.free if free is None else "both"
    shown = device_coordinates(fitted.m, ball=model.ball, free=fitted.stands_free)
    middle = fitted.deformation.z1.view(-1, 3).mean(0)
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
    moved[6 : 6 + shown] = PLACES.found_m_rad * (free in ("marker", "both"))
    before = Opened(fit.with_motions, fit.columns, moved), Linearisation.joined(parts), fit.columns + len(moved)
    noise = fitted.new_noise.expand(len(q), -1, -1)
    where = torch.cat(points), noise, model.geometry.base.to(moved), model.bodies.averaging(noise), shown
    return Scene(*before, *where, fitted.stands_free, without_positions(model)), numbers


def without_positions(model: CalibratedKinematics) -> bool:
    """Whether no device of positions or poses measured rows of a model, where its devices say which rows they did.

    The device of rows that a recalibration added is not known: images among them share the errors of lens and board.
    """
    if model.own_frame:
        return True
    shared = model.map.noise.shared
    other = torch.zeros(len(shared), dtype=torch.bool, device=shared.device)
    for devices in model.placement:
        if devices.seen_points or devices.cameras:
            other[devices.rows] = True
        if devices.cameras:
            other |= (shared != 0).any(1).sum(1) >= len(UNKNOWNS)
    return bool(other.all())
