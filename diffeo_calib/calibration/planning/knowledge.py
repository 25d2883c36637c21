"""Covariance of the markers at many configurations before the next measurement, and the best one to make.

What is known before the first one is that of a robot by its description, or of a fitted model.

    K(x, x') = F(x, x') + sum_k sign_k f_k(x) f_k(x')^T

F is the covariance of the fields. The features f hold the parameters with their priors, what earlier data tell, and
what may have moved since. What is not known about the devices, c ~ N(0, I), is one more group of numbers. A measurement
A z(x) + D c + noise adds r features with sign -1, the rows of L^-1 (A K(x, .) + D K(c, .)) with L L^T its covariance.

Measurements are chosen greedily: each is the one that lowers the mean variance over the targets most. With V the main
directions of the targets' covariance and C_i = V^T K(targets, measurement i), this lowers their variance by

    gain_i = tr[(K_ii + R_i)^-1 C_i^T C_i],

where K is the covariance after those chosen before (Cohn, Ghahramani, Jordan, "Active learning with statistical
models", 1996; sequential A-optimal design for predictions). Taking one costs one row of K and an update of rank r.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior, held_parameters
from diffeo_calib.calibration.planning.sensors import Options, Scene
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import InputError, NumericalError, as_written, few
from diffeo_calib.common.threads import large_work
from diffeo_calib.fitting.fitted_map import PREDICT_ROWS, FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.re_registration.registered_map import marker_slopes
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.bodies import bodies_of
from diffeo_calib.measurements.poses import LEVER, mark_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.process.tails import Tails
from diffeo_calib.regression.choose import BYTES_PER_FLOAT, BYTES_PER_GIB, free_memory
from diffeo_calib.regression.conditional import NOISE_ADVICE, Conditional, Features, diagonal_blocks
from diffeo_calib.regression.rigid_motions import WithoutRigidMotions
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tables import device_coordinates


class Knowledge:
    """Covariances of the markers at M configurations, and how measurements there change them.

    Args:
        at: first-order response of the markers there; only its fields are used.
        features: everything else, see the module, for one group of configurations after the other.
        options: the measurements that can be made there.
        shifts: (k, c0) the features of the first shifts; the other ones are new.
        room: how many measurements will be made; memory is set aside for them.

    Attributes:
        blocks: (M, m, m) covariance of each configuration, m^2.

    Raises:
        InputError: the features need more memory than is free.
    """

    def __init__(
        self, at: Linearisation, features: Iterable[Features], options: Options, shifts: Tensor, room: int
    ) -> None:
        self.options, self._fields, self._known = options, at.fields, 0
        self._values = self._signs = options.slopes.new_empty(0)
        M, self.m, _ = at.sensitivity.shape
        self._shifts = slice(M * self.m, M * self.m + options.shared.shape[2])
        eye = torch.eye(self.m, dtype=at.sensitivity.dtype, device=at.sensitivity.device).expand(M, self.m, self.m)
        self.blocks = self._fields.projected(eye).own_blocks()
        filled = 0
        for values, signs in features:
            if not filled:
                self._make_room(signs, shifts, room)
            count = values.shape[1] // self.m
            self._values[: len(signs), filled * self.m : (filled + count) * self.m] = values
            each = values.view(len(signs), count, self.m).movedim(0, 1)  # (count, k, m)
            self.blocks[filled : filled + count] += (each.mT * signs) @ each
            filled += count
        values, signs = self._values[: self._known], self._signs[: self._known, None]
        self._with_shifts = values.T @ (signs * values[:, self._shifts])  # (M m + c, c) covariance with the shifts

    def _make_room(self, signs: Tensor, known: Tensor, room: int) -> None:
        """Memory for the features with these signs, those of the shifts, and those of ``room`` measurements."""
        shifts = self._shifts.stop - self._shifts.start - known.shape[1]
        self._known, numbers = len(signs) + shifts, self._shifts.stop
        total = self._known + room * self.options.slopes.shape[1]
        needed, free = BYTES_PER_FLOAT * total * numbers, free_memory()
        if free is not None and needed > free:
            what = f"{total} features of {len(self.blocks)} configurations need more memory than is free"
            expected, got = (f"{count / BYTES_PER_GIB:.1f} GiB" for count in (needed, free))
            raise InputError.of(what, expected=expected, got=got, fix="pass fewer candidates")
        self._values = signs.new_empty(total, numbers)
        self._values[: self._known, self._shifts] = 0.0
        own, first = self._values[len(signs) : self._known], self._shifts.start + known.shape[1]
        own.zero_()
        own[:, first:] = torch.eye(shifts, dtype=own.dtype, device=own.device)
        self._values[: len(known), self._shifts.start : first] = known
        self._signs = signs.new_full((total,), -1.0)
        self._signs[: len(signs)], self._signs[len(signs) : self._known] = signs, 1.0

    def coordinates(self, rows: Tensor) -> Tensor:
        """Numbers of the coordinates of some configurations: (B,) -> (B m,)."""
        return (rows[:, None] * self.m + torch.arange(self.m, device=rows.device)).flatten()

    def between(self, rows: Tensor, directions: Tensor | None = None) -> Tensor:
        """K between some configurations and everything, or between linear functions of these and everything.

        Args:
            rows: (B,) row numbers. directions: (k, B m) linear functions.

        Returns:
            (B m, M m + c), or (k, M m + c), in m^2 and m.
        """
        values, signs = self._values[: self._known], self._signs[: self._known]
        own = values[:, self.coordinates(rows)].T * signs  # (B m, features)
        fields = self._fields.rows(rows).gram(self._fields)
        with large_work(fields.numel()):
            if directions is not None:
                own, fields = directions @ own, directions @ fields
            found = own @ values
            found[:, : fields.shape[1]] += fields
            return found

    def covariances(self) -> Tensor:
        """Covariance of every measurement that can be made, its noise included: (O, r, r), m^2."""
        rows, A, D, R = self.options[:4]
        with_shifts = self._with_shifts[: self._shifts.start].view(len(self.blocks), self.m, -1)  # (M, m, c)
        cross = A @ with_shifts[rows] @ D.mT
        return A @ self.blocks[rows] @ A.mT + cross + cross.mT + D @ self._with_shifts[self._shifts] @ D.mT + R

    def without_motions(self, rows: Tensor, reference: Tensor, slopes: Tensor) -> Tensor:
        """Covariances (B, m, m) of some configurations without the rigid motion that fits the errors at others best.

        Args:
            rows: (B,) row numbers. reference: (T,) those of the others. slopes: (M, m, 6) by the rigid motion.
        """
        fit = torch.linalg.pinv(slopes[reference].flatten(0, 1))  # (6, T m)
        between = self.between(reference, fit)
        own = between[:, self.coordinates(reference)] @ fit.mT
        cross = between[:, self.coordinates(rows)].T.reshape(len(rows), self.m, 6) @ slopes[rows].mT
        return self.blocks[rows] - cross - cross.mT + slopes[rows] @ own @ slopes[rows].mT

    def with_options(self, values: Tensor) -> Tensor:
        """Covariances (k, M m + c) with everything as those with all measurements: (O, r, k)."""
        at, shifts = values[:, : self._shifts.start].T.reshape(len(self.blocks), self.m, -1), values[:, self._shifts].T
        return self.options.slopes @ at[self.options.rows] + self.options.shared @ shifts

    def measure(self, number: int) -> Tensor:
        """Make one of the measurements: the features (r, M m + c) that it adds.

        Raises:
            NumericalError: K + R is not positive definite.
        """
        rows, A, D, R = (part[number : number + 1] for part in self.options[:4])
        cross = A[0] @ self.between(rows) + D[0] @ self._with_shifts.T
        inner = cross[:, self.coordinates(rows)] @ A[0].T + cross[:, self._shifts] @ D[0].T + R[0]
        factor, info = torch.linalg.cholesky_ex(0.5 * (inner + inner.T))
        if int(info):
            raise NumericalError.of("the covariance of the planned measurements is singular", fix=NOISE_ADVICE)
        with large_work(cross.numel()):
            added = torch.linalg.solve_triangular(factor, cross, upper=False)
        self._values[self._known : self._known + len(added)] = added
        self._known += len(added)
        each = added[:, : self._shifts.start].view(len(added), -1, self.m).movedim(0, 1)  # (M, r, m)
        self.blocks = self.blocks - each.mT @ each
        self._with_shifts = self._with_shifts - added.T @ added[:, self._shifts]
        return added


class Chosen(NamedTuple):
    """Options in the order in which they were taken, and by what (r, k) each lowers the covariance of k directions."""

    order: list[int]
    lowered: list[Tensor]


def greedy(
    C: Tensor, own: Tensor, between: Callable[[int], Tensor], *, place: Tensor, open_: Tensor, count: int
) -> Chosen:
    """Options that lower the variance in k directions most, one after the other, see the module.

    Args:
        C: (k, M r) covariance of the directions with the M options. own: (M, r, r) that of each, with noise.
        between: covariance (r, M r) of an option with all, without noise.
        place: (M,) where each is measured: at one place one is taken. open_: (M,) boolean: those that can be taken.

    Raises:
        NumericalError: the covariance of an option is not positive definite.
    """
    M, r, _ = own.shape
    found, taken = Chosen([], []), C.new_zeros(0, M * r)
    for _ in range(count):
        each = C.T.reshape(M, r, -1)
        gains = torch.linalg.solve(own, each @ each.mT).diagonal(dim1=1, dim2=2).sum(1)
        best = int(torch.where(open_, gains, -torch.inf).argmax())
        mine = slice(best * r, best * r + r)
        factor, info = torch.linalg.cholesky_ex(0.5 * (own[best] + own[best].T))
        if int(info):
            raise NumericalError.of("the covariance of the planned measurements is singular", fix=NOISE_ADVICE)
        with large_work(taken.numel()):
            both = torch.cat([between(best) - taken[:, mine].T @ taken, C[:, mine].T], 1)
            both = torch.linalg.solve_triangular(factor, both, upper=False)
            row, by = both[:, : M * r], both[:, M * r :]
            C, taken, each = C - by.T @ row, torch.cat([taken, row]), row.T.reshape(M, r, r)
        own, open_ = own - each @ each.mT, open_ & (place != place[best])
        found.order.append(best)
        found.lowered.append(by)
    return found


MAIN_DIRECTIONS = 150
"""Directions of the targets whose variance is followed; the rest of it is far below the noise."""


class Choice(NamedTuple):
    """Chosen measurements in the order in which they were taken, and what they leave unknown.

    Args:
        order: (count,) numbers of the options. variance: (count + 1,) mean variance of the targets' coordinates after
            0, 1, ... of them, m^2.
    """

    order: Tensor
    variance: Tensor


def choose(knowledge: Knowledge, targets: Tensor, open_: Tensor, count: int, scene: Scene) -> Choice:
    """Choose ``count`` of the options, at most one at every configuration.

    Args:
        knowledge: before the first measurement; it takes those that are chosen.
        targets: (T,) row numbers of the configurations where the robot shall be known.
        open_: (O,) boolean: the options that can be chosen, at ``count`` configurations or more.
        scene: the configurations; it says of which errors the variance is reported.
    """
    m, rows, of_option = knowledge.m, knowledge.coordinates(targets), knowledge.options.rows
    motions = scene.motions(targets)
    P = torch.eye(len(rows), dtype=knowledge.blocks.dtype, device=rows.device)
    if motions is not None:
        B = motions[targets].flatten(0, 1)
        P = P - B @ torch.linalg.pinv(B)
    own = P @ knowledge.between(targets)[:, rows] @ P
    _, V = torch.linalg.eigh(0.5 * (own + own.T))
    main = V[:, -MAIN_DIRECTIONS:].T  # (k, T m)
    C = knowledge.with_options(knowledge.between(targets, main))  # (O, r, k)
    variance = [scene.along(diagonal_blocks(own, len(targets))).diagonal(dim1=1, dim2=2).mean()]
    open_, order = open_.clone(), []
    for _ in range(count):
        gains = torch.linalg.solve(knowledge.covariances(), C @ C.mT).diagonal(dim1=1, dim2=2).sum(1)
        best = int(torch.where(open_, gains, -torch.inf).argmax())
        order.append(best)
        open_ &= of_option != of_option[best]
        added = knowledge.measure(best)  # (r, M m + c)
        C -= knowledge.with_options(added) @ (added[:, rows] @ main.T)
        seen = scene.averaged @ (added[:, rows] @ P).view(len(added), len(targets), m, 1)  # (r, T, ., 1)
        variance.append(variance[-1] - seen.square().sum(0).mean())
    return Choice(torch.tensor(order, dtype=torch.int64, device=C.device), torch.stack(variance).clamp(min=0))


USUAL_RESIDUAL = 3e-4
"""Residual of the geometric calibration of an industrial robot per coordinate, relative to the markers' spread."""
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
    scene = Scene(
        data.points, noise, geometry.base, bodies_of(lever).averaging(noise), 3 * len(tool.points), free=adrift
    )
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
    on = geometry.on if len(set(geometry.on)) > 1 else None
    data = Measurements.of_points(q, geometry.points(q), on, lever)
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
    noise, adrift = fitted.new_noise, fitted.workspace is not None
    seen = device_coordinates(fitted.m, ball=model.ball, free=adrift)
    features = (_features(fitted, at, rows, free, seen) for at, rows in zip(parts, groups, strict=True))
    known = noise.expand(len(q), -1, -1), model.geometry.base.to(noise), model.bodies.averaging(noise)
    shifts = noise.new_zeros(0, 0)
    if fitted.noise.shared.shape[2] and fitted.registration is None:
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
    if fitted.registration is not None and free is None:
        return fitted.registration.q
    return fitted.x[:0]


def _features(fitted: FittedMap, at: Linearisation, q: Tensor, free: str | None, seen: int) -> Features:
    """Features of a linearisation at q, and of what may have moved: of the markers the first ``seen`` coordinates.

    A ball beside them stays on its tool: no row of the device would say where it is now.
    """
    known = _conditional(fitted).features(at)
    added = []
    if fitted.registration is not None:
        free = _either(free, fitted.registration.free)
    else:
        sensitivity = fitted.open_sensitivity(fitted.geodesic.spec.nominal, q)
        if sensitivity is not None:
            added.append(sensitivity @ fitted.open_directions)
    if free in ("base", "both"):
        points = at.task[-1].points.view(len(q), -1, 3)
        added.append(PLACES.found_m_rad * frame_slopes(points, fitted.deformation.z1.view(-1, 3).mean(0)))
    if free in ("marker", "both"):
        added.append(PLACES.found_m_rad * _by_marker(fitted, at)[..., :seen])
    more = Features.of(*[(root.flatten(0, 1).T, 1) for root in added]) if added else Features.of((known.values[:0], 1))
    return Features(torch.cat([known.values, more.values]), torch.cat([known.signs, more.signs]))


def _either(first: str | None, second: str) -> str:
    """What is free if either leaves it free."""
    return second if first is None or first == second else "both"


def _by_marker(fitted: FittedMap, at: Linearisation) -> Tensor:
    """Derivatives of the markers by their places on the flange: (M, m, m)."""
    nominal = fitted.geodesic.spec.nominal
    if isinstance(nominal, FlangePoints):
        return marker_slopes(fitted.geodesic, nominal, at)
    if not isinstance(nominal, GeometryMap):
        raise InputError.of("the map of a robot model", expected="a GeometryMap", got=type(nominal).__name__)
    return at.sensitivity[..., nominal.geometry.slices["tool"]]
