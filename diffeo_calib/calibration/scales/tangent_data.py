"""Measurements and the tangent model of the robot around its geometric calibration, for any scales.

k0 is linearised once, at the parameters theta of the geometric calibration; scales only change the prior
covariance G and the noise R around it. The prior of theta stays centred at the registered nominal robot, hence

    k1 = k0 + Dk0 v + w + S theta,    target = y - k0(x; theta) + S theta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.kinematics.nominal import GeometryMap, PositionErrors, rigid_motions
from diffeo_calib.maps.deformation import ModelSpec
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity, Numbers
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.maps.observation import Observation
from diffeo_calib.measurements.poses import block_diagonal
from diffeo_calib.process.scales import Hyperparameters, Pairs
from diffeo_calib.regression.conditional import BeforeData, Features, Process
from diffeo_calib.regression.regions import region_factor
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots.placement import PLACES

T = TypeVar("T")
HELD_VARIANCE = 1e-18  # prior variance of parameters that stay zero, m^2 or rad^2: a nanometre
KEPT_COORDINATES = 1500
"""Measured coordinates up to which the last matrices are kept, for weights, gear lines and leave-one-out errors."""
LINEARISED = ("points", "slopes", "values", "jacobian", "sensitivities")
"""Cached properties that depend on the configurations and theta only."""


@dataclass(frozen=True, eq=False)
class TangentData:
    """Measurements around a geometric calibration. k0 and its derivatives are computed once, when first used."""

    nominal: GeometryMap  # k0
    theta: Tensor  # (K,) its parameters, where it is linearised
    x: Tensor  # (N, n) configurations
    # (N, m) measured coordinates, m; near k0 where the sensor hides them. With ``observe`` (N, r) what it reports: r
    # stands for m, and h(k0) for k0, in all that follows
    y: Tensor
    noise_model: NoiseModel  # how they were measured
    tails: Tails  # weights of the measurements
    place_deviation: float = PLACES.found_m_rad  # prior standard deviation of base and markers, m and rad
    # (N, m, c) effects of c shifts of unit variance that rows share, m; none by default
    shared: Tensor = None  # pyright: ignore[reportAssignmentType]  # a tensor once it is made
    held: tuple[int, ...] = ()  # numbers of the parameters theta that stay zero
    adrift: bool = False  # whether no device says where the robot stands
    observe: Observation | None = None  # what was measured of the markers; their coordinates by default
    # the rows among these that tell coordinates, by themselves; None where all or none do
    beside: TangentData | None = None

    def __post_init__(self) -> None:
        if self.shared is None:
            object.__setattr__(self, "shared", self.y.new_zeros(*self.y.shape, 0))

    @property
    def space(self) -> Space:
        """The joint space."""
        return Space(self.nominal.geometry.chain.periodic)

    @cached_property
    def points(self) -> Tensor:
        """(N, 3 P) coordinates of k0, m."""
        return self.nominal(self.x, self.theta)

    @property
    def places(self) -> Tensor:
        """(N, 3 P) of k0, m, which grows with the size of the robot, but the sockets where a ball rests in one.

        A socket is one place, with one effect of the size on all of its rows. Of k0 the differences within it are the
        negative residuals, which would look like another size.
        """
        return self.points if self.observe is None else self.observe.places(self.points)

    @cached_property
    def slopes(self) -> Tensor:
        """(N, r, 3 P) of the observation at k0."""
        if self.observe is not None:
            return self.observe.slope(self.points)
        N, m = self.points.shape
        return torch.eye(m, dtype=self.x.dtype, device=self.x.device).expand(N, m, m)

    @cached_property
    def values(self) -> Tensor:
        """(N, m) k0, m."""
        return self.points if self.observe is None else self.observe.value(self.points)

    @cached_property
    def jacobian(self) -> Tensor:
        """(N, m, n) Dk0, m/rad or m/m."""
        return self.slopes @ self.nominal.jacobian(self.x, self.theta)

    @cached_property
    def sensitivities(self) -> Tensor:
        """(N, m, K) S, derivatives by theta."""
        return self.slopes @ self.nominal.sensitivities(self.x, self.theta)

    @property
    def by_tool(self) -> Tensor:
        """(N, m, 3 P) derivatives by the places of the points on their tips."""
        return self.sensitivities[..., self.nominal.geometry.slices["tool"]]

    @cached_property
    def target(self) -> Tensor:
        """(N, r) of what rows tell, measured minus model at zero fields and zero theta, m."""
        away = (self.y - self.values)[:, :, None]
        return (self.in_numbers(away) + self.motions_in_numbers(self.sensitivities) @ self.theta[:, None])[:, :, 0]

    @property
    def visible(self) -> Tensor:
        """(N, m) boolean: the coordinates that were measured."""
        return self.noise_model.visible

    @property
    def coordinates(self) -> int:
        """Number of coordinates that were measured."""
        return int(self.visible.sum())

    # --- poses as six numbers ---

    @cached_property
    def basis(self) -> Tensor | None:
        """(N, m, r) orthonormal columns of the numbers that rows tell; None where these are those of the rows.

        Of every pose six numbers, m, for nine coordinates of its points. These are exactly rigid, and those of k0 are:
        errors of poses, and what moves them, are such motions.
        Only psi would bend them, by less than the slack of the noise model, so that the other three numbers hardly say
        anything; matrices are 2.25 times as large with them, and their factors 3.4 times as dear.
        """
        modes = self.noise_model.modes
        of_poses = modes.shape[1] == self.noise_model.bodies and modes.shape[2] > modes.shape[3]
        return block_diagonal(torch.linalg.qr(modes).Q) if of_poses and self.observe is None else None

    @property
    def size(self) -> int:
        """r."""
        return self.y.shape[1] if self.basis is None else self.basis.shape[2]

    def in_numbers(self, values: Tensor) -> Tensor:
        """Values of all coordinates (N, m, U) as those of the numbers: (N, r, U)."""
        return values if self.basis is None else self.basis.mT @ values

    def in_coordinates(self, values: Tensor) -> Tensor:
        """The inverse of :meth:`in_numbers`, for rigid motions: (N, r, U) -> (N, m, U)."""
        return values if self.basis is None else self.basis @ values

    def blocks_in_numbers(self, blocks: Tensor) -> Tensor:
        """Covariances of all coordinates (N, m, m) as those of the numbers: (N, r, r)."""
        return blocks if self.basis is None else self.basis.mT @ blocks @ self.basis

    def blocks_in_coordinates(self, blocks: Tensor) -> Tensor:
        """The inverse of :meth:`blocks_in_numbers`, for rigid motions: (N, r, r) -> (N, m, m)."""
        return blocks if self.basis is None else self.basis @ blocks @ self.basis.mT

    def motions_in_numbers(self, motions: Tensor) -> Tensor:
        """Derivatives of all coordinates (N, m, U) in those of the numbers (N, r, U), less what bends poses of k0.

        What bends it would look like a turn where the measured pose is turned against k0: by the very error of the row.
        """
        if self.basis is None:
            return motions
        rigid = rigid_motions(self.points)
        kept = rigid @ (rigid.mT @ motions.unflatten(1, (-1, rigid.shape[2])))
        return self.basis.mT @ kept.flatten(1, 2)

    # --- parts and variants, which share the linearisation ---

    def rows(self, index: Tensor) -> TangentData:
        """Some of the measurements."""
        sensor, tails = self.noise_model.rows(index), self.tails.rows(index)
        changes = {"x": self.x[index], "y": self.y[index], "noise_model": sensor, "tails": tails}
        changes["nominal"] = self.nominal.rows(index)
        changes["shared"] = self.shared[index]
        if self.observe is not None:
            changes["observe"] = self.observe.rows(index)
        return self._variant(lambda values: values[index], **changes)

    def sample(self, poses: int, coordinates: int, seed: int) -> tuple[Tensor, TangentData]:
        """A random subset of at most ``poses`` poses and ``coordinates`` coordinates, at least one pose.

        Rows of different kinds of devices are drawn in turn, while there are any.

        Returns:
            its sorted row numbers, and the subset.
        """
        count = min(len(self.x), poses, max(1, coordinates // self.y.shape[1]))
        if count == len(self.x):
            return torch.arange(count, device=self.x.device), self
        order = torch.randperm(len(self.x), generator=seeded(seed), device=HOST)
        kinds = torch.nn.functional.one_hot(self.noise_model.row_kinds.to(HOST)[order])
        turn = (kinds * kinds.cumsum(0)).sum(1)
        order = order[turn.argsort(stable=True)]
        rows = order[:count].sort().values.to(self.x.device)
        return rows, self.rows(rows)

    def trusted(self, least: float) -> TangentData:
        """Leave out what has smaller weights: by these it would hold the noise where it was."""
        small = (self.tails.weights < least).repeat_interleave(self.noise_model.size, 1)
        return self._variant(noise_model=replace(self.noise_model, visible=self.visible & ~small))

    def with_tails(self, tails: Tails) -> TangentData:
        """Change the weights."""
        other = self._variant(tails=tails)
        same = vars(self).keys() & {"basis", "pairs", "_numbers", "_expected"}
        vars(other).update({name: vars(self)[name] for name in same})
        return other

    def with_position_errors(self, scales: Hyperparameters) -> TangentData:
        """Add gear lines and axes to the map, which add nothing yet."""
        errors = PositionErrors(tuple((line.joint, line.frequency) for line in scales.lines), scales.axes)
        nominal = self.nominal.changed(own=errors)
        theta = self.theta.new_zeros(nominal.parameters)
        theta[: nominal.sag.stop] = self.theta[: nominal.sag.stop]
        other = self._variant(nominal=nominal, theta=theta)
        vars(other).pop("sensitivities", None)
        return other

    def _variant(self, share: Callable[[Tensor], Tensor] = lambda values: values, **changes: Any) -> TangentData:
        """A copy with changes, which takes over its share of the cached properties."""
        other = replace(self, **changes)
        names = (name for name in LINEARISED if vars(self).get(name) is not None)
        vars(other).update({name: share(vars(self)[name]) for name in names})
        return other

    # --- the model with given scales ---

    def linearisation(self, scales: Hyperparameters) -> Linearisation:
        """The prior of fields and theta with these scales."""
        kernels = scales.joint_kernel(self.space), scales.task_kernel()
        spec = ModelSpec(self.nominal, *kernels, self.prior_variance(scales), 3)
        points = self.points.reshape(-1, 3)
        eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
        effect = eye if self.observe is None else self.slopes
        joint, task = NodeSensitivity(1.0, self.x, self.jacobian), NodeSensitivity(1.0, points, effect)
        return Linearisation(spec, [joint], [task], self.sensitivities)

    def prior_variance(self, scales: Hyperparameters) -> Tensor:
        """Prior variances (K,) of theta."""
        variance = scales.prior_variance(self.nominal, self.place_deviation)
        if not self.held:
            return variance
        free = torch.ones_like(variance)
        free[list(self.held)] = 0.0
        return variance * free + HELD_VARIANCE * (1.0 - free)

    def noise(self, scales: Hyperparameters) -> Tensor:
        """R_i with all weights 1: (N, m, m), m^2."""
        return self.noise_model.covariance(scales, self.jacobian)

    def weighted_noise(self, scales: Hyperparameters) -> Tensor:
        """R_i with the weights of the tails: (N, m, m), m^2."""
        return self.noise_model.weighted(self.noise(scales), self.tails)

    def noise_of_numbers(self, scales: Hyperparameters) -> Tensor:
        """Noise of the numbers that rows tell: (N, r, r), m^2."""
        return self.blocks_in_numbers(self.weighted_noise(scales))

    def noise_of_any_row(self, scales: Hyperparameters) -> Tensor:
        """Covariance (m, m) of a new measurement of all coordinates, m^2, see :meth:`NoiseModel.typical`.

        Points of which only functionals were measured have the noise of these in each coordinate.
        """
        freedom = self.tails.freedom
        if self.observe is None:
            return self.noise_model.typical(scales, self.jacobian, freedom)
        whole = self.nominal.jacobian(self.x, self.theta)
        if self.beside is None:
            return NoiseModel.alike(len(whole), whole.shape[1] // 3).typical(scales, whole, freedom)
        # tails of the rows beside are those of the geometric calibration
        markers = replace(self.beside, tails=self.tails).noise_of_any_row(scales)
        ball = NoiseModel.alike(len(whole), 1).typical(scales, whole[:, -3:], freedom)
        return markers if len(markers) == whole.shape[1] else torch.block_diag(markers, ball)

    def noise_of_new_rows(self, scales: Hyperparameters) -> Tensor:
        """(N, m, m) covariance of new measurements like these rows, m^2, as predictions have it.

        Rows with known deviations keep their own: the mean over images, say, is the noise of none of them.
        """
        noise = self.noise(scales)
        if self.observe is not None or self.noise_model.stated:
            return noise * region_factor(self.tails.freedom, int(self.noise_model.freedom.max()))
        return without_hidden(self.noise_of_any_row(scales).expand_as(noise), self.visible)

    def numbers(self, scales: Hyperparameters) -> Numbers:
        """All that the rows tell; the shifts that they share are the last unknowns."""

        def computed() -> Numbers:
            S, at = self.motions_in_numbers(self.sensitivities), self.linearisation(scales)
            at = at if self.basis is None else replace(at.projected(self.basis.mT), sensitivity=S)
            shown = self.visible
            if self.basis is not None:
                shown = self.noise_model.seen.repeat_interleave(self.size // self.noise_model.bodies, 1)
            return Numbers.of(at.with_columns(self.in_numbers(self.shared), S.shape[2]), self.target, shown)

        return self._kept("_numbers", scales, computed)

    @cached_property
    def pairs(self) -> Pairs:
        """The covariance of the numbers by the fields, hidden ones too, for many scales."""
        return Pairs(self.x, self.points, self.in_numbers(self.jacobian), self.in_numbers(self.slopes), self.space)

    def unknowns_variance(self, scales: Hyperparameters) -> Tensor:
        """(K,) prior variances of theta and of the shifts."""
        return torch.cat([self.prior_variance(scales), self.x.new_ones(self.shared.shape[2])])

    def prior(self, scales: Hyperparameters) -> BeforeData:
        """What is known before these rows."""
        return BeforeData(self.unknowns_variance(scales).sqrt())

    def expected(self, scales: Hyperparameters) -> Features:
        """The numbers as they are expected before these rows: the same for all weights."""
        return self._kept("_expected", scales, lambda: self.prior(scales).features(self.numbers(scales).at))

    def process(self, scales: Hyperparameters) -> Process:
        """What is known by these rows with their weights."""

        def given() -> Process:
            noise, at = self.noise_of_numbers(scales), self.expected(scales)
            return self.prior(scales).given(self.numbers(scales), noise, at)

        return self._kept("_process", scales, given)

    def _kept(self, name: str, scales: Hyperparameters, compute: Callable[[], T]) -> T:
        """The last value for these very scales; computed if there is none."""
        last = vars(self).get(name)
        if last is not None and last[0] is scales:
            return last[1]
        vars(self)[name] = None  # before there are two
        value = compute()
        if len(self.x) * self.size <= KEPT_COORDINATES:
            vars(self)[name] = scales, value
        return value
