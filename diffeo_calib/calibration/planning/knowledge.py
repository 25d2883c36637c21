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

from collections.abc import Callable, Iterator, Mapping
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
from diffeo_calib.common.errors import InputError, NumericalError, as_written, few
from diffeo_calib.common.threads import large_work
from diffeo_calib.fitting.fitted_map import PREDICT_ROWS, FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.re_registration.registered_map import marker_slopes
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.process.tails import Tails
from diffeo_calib.regression.conditional import NOISE_ADVICE, diagonal_blocks
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tables import device_coordinates


class Known(NamedTuple):
    """Covariances F + V^T diag(signs) V of the markers at M configurations and of c shifts that measurements share.

    Args:
        at: first-order response of the markers, M of m coordinates; of its fields is F.
        values: V (k, M m + c). signs: (k,) 1 or -1.
    """

    at: Linearisation
    values: Tensor
    signs: Tensor

    @property
    def m(self) -> int:
        """Coordinates of a configuration."""
        return self.at.sensitivity.shape[1]

    @property
    def shifts(self) -> int:
        """Number c of the shifts."""
        return self.values.shape[1] - self.at.sensitivity.shape[:2].numel()

    def with_shifts(self, count: int) -> Known:
        """The same with new shifts, ``count`` in all."""
        values, new = torch.nn.functional.pad(self.values, (0, count - self.shifts)), count - self.shifts
        own = values.new_zeros(new, values.shape[1])
        own[:, values.shape[1] - new :] = torch.eye(new, dtype=own.dtype, device=own.device)
        return self._replace(values=torch.cat([values, own]), signs=torch.cat([self.signs, self.signs.new_ones(new)]))

    def coordinates(self, rows: Tensor) -> Tensor:
        """Numbers of the coordinates of some configurations: (B,) -> (B m,)."""
        return (rows[:, None] * self.m + torch.arange(self.m, device=rows.device)).flatten()

    def between(self, rows: Tensor) -> Tensor:
        """Covariance (B m, M m + c) of some configurations (B,) with everything, m^2 and m."""
        fields = self.fields(rows)
        with large_work(fields.numel()):
            return fields.addmm_(self.values[:, self.coordinates(rows)].T * self.signs, self.values)

    def fields(self, rows: Tensor) -> Tensor:
        """The same of the fields alone."""
        fields = self.at.fields
        return torch.nn.functional.pad(fields.rows(rows).gram(fields), (0, self.shifts))

    def blocks(self, rows: Tensor) -> Tensor:
        """(B, m, m) that of some configurations, m^2."""
        each = self.values[:, self.coordinates(rows)].view(len(self.signs), len(rows), self.m).movedim(0, 1)
        return self.field_blocks(rows) + (each.mT * self.signs) @ each

    def field_blocks(self, rows: Tensor) -> Tensor:
        """The same of the fields alone."""
        eye = torch.eye(self.m, dtype=self.values.dtype, device=rows.device).expand(len(rows), self.m, self.m)
        return self.at.fields.rows(rows).projected(eye).own_blocks()

    def given(self, options: Options) -> Known:
        """After some measurements.

        Raises:
            NumericalError: their covariance is not positive definite.
        """
        fields = self.fields(options.rows).unflatten(0, (-1, self.m))  # (O, m, M m + c)
        cross = (options.slopes @ fields).flatten(0, 1) + (options.of(self.values).T * self.signs) @ self.values
        low = factor(options.of(cross) + torch.block_diag(*options.noise))
        added = torch.linalg.solve_triangular(low, cross, upper=False)
        values, signs = torch.cat([self.values, added]), torch.cat([self.signs, added.new_full((len(added),), -1.0)])
        return self._replace(values=values, signs=signs)


def factor(matrix: Tensor) -> Tensor:
    """The lower Cholesky factor of the covariance of measurements; NumericalError unless it is positive definite."""
    low, info = torch.linalg.cholesky_ex(0.5 * (matrix + matrix.mT))
    if int(info):
        raise NumericalError.of("the covariance of the planned measurements is singular", fix=NOISE_ADVICE)
    return low


def greedy(
    C: Tensor, own: Tensor, between: Callable[[int], Tensor], *, place: Tensor, open_: Tensor, count: int
) -> list[int]:
    """Options that lower the variance in k directions most, one after the other, see the module.

    Args:
        C: (k, M r) covariance of the directions with the M options. own: (M, r, r) that of each, with noise.
        between: covariance (r, M r) of an option with all, without noise.
        place: (M,) where each is measured: at one place one is taken. open_: (M,) boolean: those that can be taken.
    """
    M, r, _ = own.shape
    order, taken = list[int](), C.new_zeros(0, M * r)
    for _ in range(count):
        each = C.T.reshape(M, r, -1)
        gains = torch.linalg.solve(own, each @ each.mT).diagonal(dim1=1, dim2=2).sum(1)
        best = int(torch.where(open_, gains, -torch.inf).argmax())
        mine = slice(best * r, best * r + r)
        with large_work(taken.numel()):
            both = torch.cat([between(best) - taken[:, mine].T @ taken, C[:, mine].T], 1)
            both = torch.linalg.solve_triangular(factor(own[best]), both, upper=False)
            row, by = both[:, : M * r], both[:, M * r :]
            C, taken, each = C - by.T @ row, torch.cat([taken, row]), row.T.reshape(M, r, r)
        own, open_ = own - each @ each.mT, open_ & (place != place[best])
        order.append(best)
    return order


MAIN_DIRECTIONS = 150
"""Directions of the targets whose variance is followed; the rest of it is far below the noise."""


def choose(known: Known, options: Options, targets: Tensor, scene: Scene, count: int) -> tuple[list[int], Tensor]:
    """Choose ``count`` of the options, at most one at every configuration.

    Args:
        known: before the first. targets: (T,) numbers of the configurations where the robot shall be known.
        scene: the configurations; it says of which errors the variance is reported.

    Returns:
        numbers of the options in the order in which they were taken, and the mean variance (count + 1,) of the targets'
        coordinates after 0, 1, ... of them, m^2.
    """
    rows = known.coordinates(targets)
    P, motions = torch.eye(len(rows), dtype=known.values.dtype, device=rows.device), scene.motions(targets)
    if motions is not None:
        B = motions[targets].flatten(0, 1)
        P = P - B @ torch.linalg.pinv(B)
    whole = P @ known.between(targets)  # (T m, M m + c)
    own = whole[:, rows] @ P
    V = torch.linalg.eigh(0.5 * (own + own.T)).eigenvectors[:, -MAIN_DIRECTIONS:]  # (T m, k)
    features, A, place = options.of(known.values), options.slopes, options.rows
    each = features.T.reshape(*A.shape[:2], -1)  # (O, r, f)
    blocks = A @ known.field_blocks(place) @ A.mT + (each * known.signs) @ each.mT + options.noise

    def between(number: int) -> Tensor:
        fields = options.of(A[number] @ known.fields(place[number : number + 1]))
        return fields.addmm_(each[number] * known.signs, features)

    open_ = torch.ones_like(place, dtype=torch.bool)
    order = greedy(options.of(V.T @ whole), blocks, between, place=place, open_=open_, count=count)
    start = scene.along(diagonal_blocks(own, len(targets))).diagonal(dim1=1, dim2=2).mean()
    added = (
        known.given(options.some(torch.tensor(order, dtype=torch.int64, device=rows.device))).values[
            len(known.values) :, rows
        ]
        @ P
    )
    seen = (added.view(-1, len(targets), known.m) @ scene.averaged.mT).view(count, A.shape[1], -1)
    lowered = seen.square().sum(1).mean(1)
    return order, (start - torch.cat([lowered.new_zeros(1), lowered.cumsum(0)])).clamp(min=0)


def without_motions(known: Known, rows: Tensor, reference: Tensor, slopes: Tensor) -> Tensor:
    """Covariances (B, m, m) of some configurations without the rigid motion that fits the errors at others best.

    Args:
        rows: (B,) row numbers. reference: (T,) those of the others. slopes: (M, m, 6) by the rigid motion.
    """
    fit = torch.linalg.pinv(slopes[reference].flatten(0, 1))  # (6, T m)
    between = fit @ known.between(reference)
    own = between[:, known.coordinates(reference)] @ fit.mT
    cross = between[:, known.coordinates(rows)].T.reshape(len(rows), known.m, 6) @ slopes[rows].mT
    return known.blocks(rows) - cross - cross.mT + slopes[rows] @ own @ slopes[rows].mT


USUAL_RESIDUAL = 3e-4
"""Residual of the geometric calibration of an industrial robot per coordinate, relative to the markers' spread."""
MARKER = (0.1, 0.0, 0.1)
"""Default marker in the tip's frame, m: off the axis of the last joint, so that this joint moves it."""
FREE = ("base", "marker", "both")


class Start(NamedTuple):
    """What is known at some configurations, shifts of the rows of a fit among it, and the markers there."""

    known: Known
    scene: Scene


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
    data = replace(data, held=held_parameters(geometry, adrift=adrift), adrift=adrift)
    values = (data.sensitivities * data.prior_variance(scales).sqrt()).flatten(0, 1).T
    known, noise = Known(data.linearisation(scales), values, torch.ones_like(values[:, 0])), data.noise(scales)
    scene = Scene(data.points, noise, geometry.base, Bodies(lever).averaging(noise), 3 * len(tool.points), free=adrift)
    return Start(known, scene)


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


def of_model(model: CalibratedKinematics, q: Tensor, free: str | None) -> Start:
    """The posterior of a fitted model.

    A ball beside markers stays on its tool: no row of the device would say where it is now.

    Args:
        model: fitted, or registered anew. q: (M, n) configurations.
        free: what may have moved since the fit, besides what a registration has left free.
    """
    fitted, registration, conditional = model.map, model.map.registration, model.map.conditional.inner
    if registration is not None and free != registration.free:
        free = registration.free if free is None else "both"
    noise, nominal, adrift = fitted.new_noise, fitted.geodesic.spec.nominal, fitted.workspace is not None
    seen = device_coordinates(fitted.m, ball=model.ball, free=adrift)

    def moved(at: Linearisation, rows: Tensor) -> Iterator[Tensor]:
        """(M, m, k) what is open of the markers, or may have moved them."""
        open_ = fitted.open_sensitivity(nominal, rows) if registration is None else None
        if open_ is not None:
            yield open_ @ fitted.open_directions
        if free in ("base", "both"):
            points = at.task[-1].points.view(len(rows), -1, 3)
            yield PLACES.found_m_rad * frame_slopes(points, fitted.deformation.z1.view(-1, 3).mean(0))
        if free in ("marker", "both"):
            yield PLACES.found_m_rad * _by_marker(fitted, at)[..., :seen]

    points, parts, values = [], [], []
    for rows in q.split(PREDICT_ROWS):
        z, at = fitted.geodesic.linearised_value(rows)
        known, signs = conditional.features(at)
        added = [each.flatten(0, 1).T for each in moved(at, rows)]
        points.append(z)
        parts.append(at)
        values.append(torch.cat([known, *added]))
    whole = torch.cat(values, 1)
    new = len(whole) - len(signs)
    if fitted.noise.shared.shape[2] and registration is None:
        K, c = len(fitted.geodesic.spec.prior_variance), fitted.noise.shared.shape[2]
        shifts = conditional.features(fitted.parameters_as_points(K + torch.arange(c, device=whole.device))).values
        whole = torch.cat([whole, torch.nn.functional.pad(shifts, (0, 0, 0, new))], 1)
    own = Known(Linearisation.joined(parts), whole, torch.cat([signs, signs.new_ones(new)]))
    along = noise.expand(len(q), -1, -1), model.geometry.base.to(noise), model.bodies.averaging(noise)
    return Start(own, Scene(torch.cat(points), *along, seen, adrift, own.shifts))


def _by_marker(fitted: FittedMap, at: Linearisation) -> Tensor:
    """Derivatives of the markers by their places on the flange: (M, m, m)."""
    nominal = fitted.geodesic.spec.nominal
    if isinstance(nominal, FlangePoints):
        return marker_slopes(fitted.geodesic, nominal, at)
    if not isinstance(nominal, GeometryMap):
        raise InputError.of("the map of a robot model", expected="a GeometryMap", got=type(nominal).__name__)
    return at.sensitivity[..., nominal.geometry.slices["tool"]]
