"""What is known before the next measurement, and the greedy choice of the best ones.

What is known before the first one is that of a robot by its description, or of a fitted model. Both are a conditional
and a linearisation, whose columns are all that is not known: parameters, shifts that rows of a fit shared, places that
may have changed since, and then unknowns c ~ N(0, I) of devices. A measurement reports A z(x) + D c + noise.

Each measurement is the one that lowers the mean variance over the targets most. With C_i = K(targets, option i), this
lowers their variance by

    gain_i = tr[(K_ii + R_i)^-1 C_i^T C_i],

where K is the covariance after those chosen before (Cohn, Ghahramani, Jordan, "Active learning with statistical
models", 1996; sequential A-optimal design for predictions). Taking one costs one row of K and an update of rank r.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
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
from diffeo_calib.maps.linearisation import Linearisation, Numbers
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.cholesky import lower_root
from diffeo_calib.regression.conditional import BeforeData, Conditional, Features, Opened, diagonal_blocks
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.kinds import device_coordinates
from diffeo_calib.sensors.set_ups import frame_slopes

USUAL_RESIDUAL = 3e-4
"""Residual of the geometric calibration of an industrial robot per coordinate, relative to the markers' spread."""
MARKER = (0.1, 0.0, 0.1)
"""Default marker in the tip's frame, m: off the axis of the last joint, so that this joint moves it."""
TARGET_COORDINATES = 900  # coordinates of the targets that are followed: more make no difference to the choice


def greedy(
    C: Tensor, options: Features, blocks: Tensor, *, place: Tensor, open_: Tensor, count: int
) -> tuple[list[int], Tensor]:
    """Options that lower the variance of k numbers most, one after the other, see the module.

    Args:
        C: (k, M r) covariance of the numbers with the M options. blocks: (M, r, r) that of each, with noise, m^2.
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
            row = options.rows(torch.tensor([best], dtype=torch.int64, device=C.device)).between(options)
            both = torch.cat([row - taken[:, mine].T @ taken, each[best]], 1)
            both = torch.linalg.solve_triangular(lower_root(blocks[best]), both, upper=False)
            row, by = both[:, : M * r], both[:, M * r :]
            each.flatten(0, 1).addmm_(row.T, by, alpha=-1.0)
            taken, less = torch.cat([taken, row]), row.T.reshape(M, r, r)
        blocks, open_ = blocks - less @ less.mT, open_ & (place != place[best])
        order.append(best)
        lowered.append(by)
    return order, torch.stack(lowered) if lowered else each.new_zeros(0, r, len(C))


class View(NamedTuple):
    """M configurations as a robot or model has them."""

    points: Tensor  # (M, m) coordinates of the markers, m
    at: Linearisation
    noise: Tensor  # (M, m, m) covariance of one measurement of them, m^2


@dataclass(frozen=True, eq=False)
class Scene:
    """What is known of a robot or model before the first measurement."""

    known: Conditional
    columns: int  # what it knows of unknowns: later ones are new
    view: Callable[[Tensor], View]  # of configurations (M, n)
    base: Tensor  # (4, 4) the robot's base in the frame of the points, m
    averaged: Tensor  # (r, m) the markers, or the origins of measured poses
    seen: int  # the first coordinates, of points that a device of positions sees
    free: bool = False  # whether nothing says where the robot stands in the frame of a measuring device
    unplaced: bool = False  # whether a device of positions stands anywhere

    def variance(self, blocks: Tensor) -> Tensor:
        """Mean variance of the markers, or of the origins of poses, by covariances (M, m, m) of the points, m^2."""
        return (self.averaged @ blocks @ self.averaged.mT).diagonal(dim1=1, dim2=2).mean()

    @property
    def framed(self) -> bool:
        """Whether the points represent frames."""
        return len(self.averaged) < self.averaged.shape[1]

    def chosen(
        self, posterior: Conditional, options: tuple[Linearisation, Tensor, Tensor], targets: Linearisation, count: int
    ) -> tuple[list[int], Tensor]:
        """Choose measurements, at most one at every configuration.

        Args:
            posterior: before the first. options: what O of them report, its noise (O, r, r), m^2, and the numbers (O,)
                of their configurations. targets: where the robot shall be known.

        Returns:
            numbers of the measurements in the order in which they were taken, and the mean variance (count + 1,) of the
            targets' coordinates after 0, 1, ... of them, m^2.
        """
        at, (measured, noise, place), T = posterior.features(targets), options, len(targets.sensitivity)
        P = torch.eye(at.known.shape[1], dtype=at.known.dtype, device=at.known.device)
        if self.free:
            B = targets.sensitivity[..., list(targets.spec.nominal.places[:6])].flatten(0, 1)  # by motions of the base
            P = P - B @ torch.linalg.pinv(B)
        features, open_ = posterior.features(measured), torch.ones_like(place, dtype=torch.bool)
        C, blocks = P @ at.between(features), features.blocks() + noise
        order, by = greedy(C, features, blocks, place=place, open_=open_, count=count)
        lowered = (by.unflatten(2, (T, -1)) @ self.averaged.mT).square().sum(1).mean((1, 2))
        variance = self.variance(diagonal_blocks(P @ at.between() @ P, T))
        return order, torch.cat([variance[None], -lowered]).cumsum(0).clamp(min=0)


def followed(targets: Tensor, coordinates: int) -> Tensor:
    """Choose the configurations of (T, n), of so many coordinates each, that are followed."""
    most = max(2, TARGET_COORDINATES // coordinates)
    if len(targets) <= most:
        return targets
    return targets[torch.linspace(0, len(targets) - 1, most, dtype=torch.float64, device=targets.device).round().long()]


def of_robot(
    robot: Tree, marker: object, scales: Hyperparameters | None, targets: Tensor, *, frames: bool, free: bool
) -> Scene:
    """The tangent model around the nominal robot; base and markers are known to 0.1 m and 0.1 rad.

    Args:
        robot: nominal chain.
        marker: of every tip: (3,) or (P, 3) in its frame, m, or the (4, 4) pose of a measured frame there; or a
            dictionary tip -> one of these.
        scales: of the errors; by default those of an industrial robot, which follow from the ``targets`` (T, n).
        frames: whether frames are measured, by default those of the tips.
        free: whether nothing will say where the robot stands: then its base is where the errors are judged.
    """
    points, on, lever = _measured_points(
        robot, marker, torch.eye(4, dtype=torch.float64, device=HOST) if frames else MARKER
    )
    geometry, residual, near = Geometry.nominal(robot).with_tool(points, on), USUAL_RESIDUAL, targets
    near = followed(targets, points.numel())
    if len(near) > 1:
        residual *= float(geometry.points(near).reshape(-1, 3).std(0).norm())
    nominal = GeometryMap(geometry, elastic=not is_cartesian(geometry.chain))

    def around(q: Tensor) -> TangentData:
        """To be measured with the usual noise."""
        tips = geometry.on if len(set(geometry.on)) > 1 else None
        data = Measurements.of_points(q, geometry.points(q), tips, lever)
        noise, theta = NoiseModel.of(data, residual), q.new_zeros(nominal.parameters)
        tails = Tails.none(len(q), noise.bodies)
        return TangentData(nominal, theta, q, data.points.flatten(1), noise, tails)

    chosen = defaults(around(near), residual, Prior()) if scales is None else scales
    held = held_parameters(geometry, adrift=free)

    def view(q: Tensor) -> View:
        data = replace(around(q), held=held, adrift=free)
        return View(data.points, data.linearisation(chosen), data.noise(chosen))

    before = BeforeData(view(near[:1]).at.spec.prior_variance.sqrt())
    averaged = Bodies(lever).averaging(points.new_zeros(points.numel(), points.numel()))
    return Scene(before, len(before.deviations), view, geometry.base, averaged, points.numel(), free)


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
        expected, got = f"within the robot's reach of {robot.reach:.3g} m", f"{away:.3g} m"
        raise InputError.of("`marker` in the tip's frame", expected=expected, got=got, fix="check the unit, m")
    return points, on, levers.pop()


def of_model(model: CalibratedKinematics, free: str | None) -> Scene:
    """The posterior of a fitted model, or of one registered anew, whose rows tell where the device stands.

    A ball beside markers stays on its tool: no row of the device would say where it is now.

    Args:
        free: what may have moved since the fit, besides what a registration has left free.
    """
    fitted, fit, tool = model.map, model.map.unregistered, model.nominal.geometry.slices["tool"]
    registration, middle, same_place = fitted.registration, fitted.deformation.z1.view(-1, 3).mean(0), free is None
    if registration is not None:
        free = registration.free if free in (None, registration.free) else "both"

    def view(q: Tensor) -> View:
        points, parts = [], []
        for rows in q.split(PREDICT_ROWS):
            z, at = fitted.linearised_value(rows)
            if registration is None:
                columns = frame_slopes(z.unflatten(1, (-1, 3)), middle), at.sensitivity[..., tool]
                at = at.with_columns(torch.cat(columns, 2), fit.columns)
            points.append(z)
            parts.append(at)
        return View(torch.cat(points), Linearisation.joined(parts), fitted.new_noise.expand(len(q), -1, -1))

    shown = device_coordinates(fitted.m, ball=model.ball, free=fitted.stands_free)
    moved = fitted.new_noise.new_zeros(6 + fitted.m)
    moved[:6] = PLACES.found_m_rad * (free in ("base", "both"))
    moved[6 : 6 + shown] = PLACES.found_m_rad * (free in ("marker", "both"))
    known: Conditional = Opened(fit.with_motions, fit.columns, moved)
    averaged, flags = model.bodies.averaging(fitted.new_noise), (fitted.stands_free, without_positions(model))
    if registration is not None and same_place:  # its rows measured positions or poses
        rows, every = view(registration.q.to(HOST)), torch.eye(fitted.m, dtype=moved.dtype, device=moved.device)
        A = averaged[:shown] if len(averaged) == fitted.m else every
        at = rows.at.projected(A.expand(len(rows.points), -1, -1))
        known = known.given(Numbers.of(at), A @ rows.noise @ A.mT)
    return Scene(known, fit.columns + len(moved), view, model.geometry.base.to(moved), averaged, shown, *flags)


def without_positions(model: CalibratedKinematics) -> bool:
    """Whether no device of positions or poses measured rows of a model, where its devices say which rows they did.

    The device of rows that a recalibration added is not known: images among them share the errors of lens and board.
    """
    shared = model.map.noise.shared
    other = torch.zeros(len(shared), dtype=torch.bool, device=shared.device)
    for devices in model.placement:
        if devices.seen_points or devices.cameras:
            other[devices.rows] = True
        if devices.cameras:
            other |= (shared != 0).any(1).sum(1) >= len(UNKNOWNS)
    return model.own_frame or bool(other.all())
