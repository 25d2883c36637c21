"""The fitted map k1 that users work with, in any formulation: value, Jacobian, prediction, inverse."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.data_frames import refuse_data_frame
from diffeo_calib.common.device import HOST, methods_outside_inference_mode, seeded, usable
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.threads import small_work
from diffeo_calib.maps.deformation import Deformation, Momenta, inverse_of
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.maps.observation import single_coordinates
from diffeo_calib.regression.conditional import Conditional, Opened, without_rigid_motions
from diffeo_calib.regression.conjugate_gradients import condition
from diffeo_calib.regression.control_points import ControlPointRegression

PREDICT_ROWS, WORKSPACE_ROWS = 1024, 100  # number of configurations that are linearised together for their covariances
OPEN_TURN_RAD = 1.0
"""Prior standard deviation from which a turn of all points is open: between that of a base that was found, 0.1, which a
changed robot widens by up to ten, and that of an open one, 2."""
NEGLIGIBLE_TURN_RAD = 0.01
"""Standard deviation of the turn of all points below which errors of second order are left out, if nothing is open."""
TENSORS = "data", "new_noise", "workspace", "slopes", "y", "unresolved"  # of a map, or None
T = TypeVar("T")


class of_origin(cached_property[T]):  # used like cached_property
    """Computed once, by the map of the fit, for all its copies around other nominal maps."""

    def __get__(self, instance: Any, owner: type[Any] | None = None) -> Any:
        return super().__get__(instance if instance is None else instance._origin or instance, owner)


@methods_outside_inference_mode
@dataclass(eq=False, repr=False)
class FittedMap:
    """k1 = psi o k0 o phi^-1 with fitted momenta.

    Args:
        deformation: k1 for the fitted momenta, exact or in the paper's Eulerian formulation.
        noise: covariance of the fitted measurements.
        data: (N, n) configurations of these measurements; None if they are the deformation's control points.
        new_noise: (m, m) covariance of a new measurement, m^2; by default the mean of ``noise``.
        workspace: (M, n) configurations over which covariances leave rigid motions out; None if places were measured.
        slopes: (N, r, m) linear functionals of k1 that were measured; None for all m coordinates.
        y: (N, r) what was measured, or (N, m), m; None where it is not known (:meth:`measured` then derives it).
        unresolved: (n,) variances, rad^2 or m^2, of errors of k1 in each joint that are too short for its fields. A new
            measurement has them in its noise; None where there are none.
    """

    deformation: Deformation
    noise: Noise
    data: Tensor | None = None
    new_noise: Tensor = None  # pyright: ignore[reportAssignmentType]  # a tensor once it is made
    workspace: Tensor | None = None
    slopes: Tensor | None = field(default=None, kw_only=True)
    y: Tensor | None = field(default=None, kw_only=True)
    unresolved: Tensor | None = field(default=None, kw_only=True)
    registration: Any = field(default=None, init=False)
    """Result of a registration, where the map has been placed anew."""
    _origin: FittedMap | None = field(default=None, init=False)
    """The map with the nominal map of the fit, whose rows all covariances follow from."""

    def __post_init__(self) -> None:
        if self.new_noise is None:
            self.new_noise = self.noise.covariance.mean(0)

    @property
    def x(self) -> Tensor:
        """(N, n) configurations of the fitted measurements."""
        return self.deformation.x if self.data is None else self.data

    @property
    def stands_free(self) -> bool:
        """Whether no device measured places: rigid motions count for nothing in covariances."""
        return self.workspace is not None

    @property
    def everywhere(self) -> Tensor:
        """(M, n) random configurations in the joint ranges of the rows: its workspace if it has one."""
        if self.workspace is not None:
            return self.workspace
        low, high = self.x.amin(0), self.x.amax(0)
        shape = WORKSPACE_ROWS, len(low)
        draws = torch.rand(shape, dtype=torch.float64, generator=seeded(0), device=HOST).to(low)
        return low + (high - low) * draws

    def without_rigid_motions(self) -> FittedMap:
        """Return the map whose covariances leave out rigid motions over the joint ranges of its rows."""
        return replace(self, workspace=self.everywhere)

    @property
    def unregistered(self) -> FittedMap:
        """The map of the fit itself, without a registration that followed."""
        return self

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.deformation.x.shape[1]

    @property
    def m(self) -> int:
        """Number of task coordinates."""
        return self.new_noise.shape[0]

    @property
    def functionals(self) -> Tensor:
        """(N, r, m) linear functionals of k1 that were measured; of coordinates the identity."""
        if self.slopes is not None:
            return self.slopes
        return torch.eye(self.m, dtype=self.x.dtype, device=self.x.device).expand(len(self.x), -1, -1)

    @property
    def shows_points(self) -> bool:
        """Whether every number is a single coordinate, but for places that rows share."""
        return single_coordinates(self.functionals)

    def with_nominal(self, nominal: NominalMap) -> FittedMap:
        """Return the map around another nominal map with the same parameters, with what it knows of its covariances."""
        other = copy(self)
        other.deformation, other._origin = self.geodesic.with_nominal(nominal), self._origin or self
        return other

    @property
    def formulation(self) -> str:
        """ "exact" or "eulerian"."""
        return self.deformation.formulation

    def __repr__(self) -> str:
        kind = "" if self.formulation == "exact" else f"{self.formulation}, "
        return f"FittedMap({kind}{self.n} -> {self.m} coordinates, {len(self.deformation.x)} controls)"

    def to(self, device: torch.device | str) -> FittedMap:
        """Return the map on a device, where its inputs must be too."""
        device = usable(device)
        if device == self.x.device:
            return self  # with what it has computed for its covariances
        moved = {name: part.to(device) for name in TENSORS if (part := getattr(self, name)) is not None}
        return replace(self, deformation=self.deformation.to(device), noise=self.noise.to(device), **moved)

    def __call__(self, x: object) -> Tensor:
        """Calibrated task coordinates.

        Args:
            x: (M, n) configurations, rad or m.

        Returns:
            (M, m) in m, differentiable by autograd in x.

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        return self.deformation(self._configurations(x))

    def jacobian(self, x: object) -> Tensor:
        """Dk1 = Dpsi Dk0 Dphi^-1: (M, n) -> (M, m, n), m/rad or m/m.

        The exact derivative of the call. Only in the Eulerian formulation the transported Jacobian differs from the
        derivative of k1; see :class:`diffeo_calib.paper.eulerian.EulerianDeformation`.
        """
        return self.deformation.jacobian(self._configurations(x))

    def predict(self, x: object, *, noise: bool = True) -> tuple[Tensor, Tensor]:
        """Mean and posterior covariance (Laplace approximation around the fitted flows).

        Args:
            x: (M, n) configurations.
            noise: whether to add the covariance of a new measurement, so that the result predicts a tracker's reading.

        Returns:
            mean (M, m) in m, covariance (M, m, m) in m^2.

        Raises:
            InputError: as for the call, or a map in the Eulerian formulation, which has no linearisation.
        """
        return self.posterior(self._configurations(x).detach(), noise=noise)

    @small_work()
    def posterior(
        self, x: Tensor, *, noise: bool = True, directions: Callable[[Tensor], Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Like :meth:`predict`, for configurations that have been checked already.

        Args:
            x, noise: as there.
            directions: from means (M, m), linear functions (M, r, m) whose covariance (M, r, r) is wanted instead.
        """
        means, blocks = [], []
        for first in range(0, max(len(x), 1), PREDICT_ROWS):
            some = slice(first, first + PREDICT_ROWS)
            mean, at = self.linearised_value(x[some], self.geodesic.at_rows(some))
            wanted = None if directions is None else directions(mean)
            means.append(mean)
            if noise:
                own = self.new_noise if wanted is None else wanted @ self.new_noise @ wanted.mT
                blocks.append(self._of_fields(at, wanted) + own)
            else:
                blocks.append(self.covariance(at, wanted))
        return torch.cat(means), torch.cat(blocks)

    def linearised_value(
        self, x: Tensor, geodesic: GeodesicDeformation | None = None, held: slice = slice(0)
    ) -> tuple[Tensor, Linearisation]:
        """k1 at x (M, n), m, and its linearisation with columns by all that the model does not know.

        Args:
            x: configurations. geodesic: k1 of other points of the body, or of rows under their payloads.
            held: numbers of parameters that count as known.
        """
        around, root = geodesic or self.geodesic, self.open_directions
        points, at = around.linearised_value(x)
        kept = root.new_ones(len(root))
        kept[held] = 0.0
        at = replace(at, sensitivity=at.sensitivity * kept)
        if root.shape[1]:
            opened = around.spec.nominal.sensitivities(x, 0.0 * kept) @ (kept[:, None] * root)
            at = at.with_columns(opened, self.columns - root.shape[1])
        return points, at

    @property
    def columns(self) -> int:
        """Parameters, shifts that rows of the fit share, and directions that they leave open."""
        return len(self.geodesic.spec.prior_variance) + self.noise.shared.shape[2] + self.open_directions.shape[1]

    def covariance(self, at: Linearisation, directions: Tensor | None = None) -> Tensor:
        """Posterior covariance (M, m', m') of the points of :meth:`linearised_value`.

        Args:
            at: the linearisation.
            directions: (M, r, m') linear functions of the points whose covariance (M, r, r) is wanted instead.
        """
        return self._of_fields(at, directions) + self.short_errors(at, directions)

    def short_errors(self, at: Linearisation, directions: Tensor | None = None) -> Tensor:
        """Covariance (M, r, r) of what the fields do not resolve: independent at every configuration."""
        variances = 0.0 if self.unregistered.unresolved is None else self.unregistered.unresolved
        by_joints = sum((node.weight * node.effect for node in at.joint), torch.zeros_like(at.joint_to_start))
        by_joints = by_joints if directions is None else directions @ by_joints
        return by_joints * variances @ by_joints.mT

    def _of_fields(self, at: Linearisation, directions: Tensor | None) -> Tensor:
        """:meth:`covariance` without what the fields do not resolve."""
        return self.with_second_order(self.conditional.covariance(at, directions))

    def with_shifts(self, at: Linearisation, effects: Tensor, columns: Tensor) -> Tensor:
        """Posterior covariance (M, r, r) of points together with shifts that rows of the fit shared.

        Rigid motions that no device shows move the points and the shifts alike, and are no errors of their sum.

        Args:
            at: linearisation of the points. effects: (M, r, k) of k shifts of unit prior variance on them.
            columns: (c,) boolean, which of the shifts of the fit these are.
        """
        shifts = effects.new_zeros(*effects.shape[:2], len(columns))
        shifts[..., columns] = effects
        return self.with_motions.posterior(at.with_columns(shifts, len(self.geodesic.spec.prior_variance)))

    @of_origin
    def fitted_points(self) -> Tensor:
        """(N, m) the map at the rows of the fit, each under its own payload, m."""
        at_rows = self.geodesic.z1.view(-1, self.m) if self.data is None else self.geodesic(self.x)
        return at_rows.detach()

    @of_origin
    def open_directions(self) -> Tensor:
        """Square root (K, k) of the prior covariance of theta in the k directions that the data leave open.

        They are combinations of base and points on the last link whose prior deviation moves the nominal rows by less
        than the noise. The linear model around the fit finds them all the same: the errors of the joints change with
        the turn of the base, and at the optimum by more than the noise. That is no knowledge, because the errors that
        belong to another optimum are others. What is open is therefore judged, and added, at theta = 0.
        """
        spec = self.geodesic.spec
        places = torch.tensor(spec.nominal.places, dtype=torch.int64, device=self.x.device)
        root = spec.prior_variance.new_zeros(spec.nominal.parameters, len(places))
        if not len(places):
            return root
        deviations = spec.prior_variance[places].sqrt()
        every, visible = spec.nominal.sensitivities(self.x, torch.zeros_like(spec.prior_variance)), self.noise.visible
        every = self.functionals @ every
        slopes = every[visible] if every.shape[:2] == visible.shape else every.flatten(0, 1)  # registered: other points
        white = slopes[:, places] * deviations / len(slopes) ** 0.5
        _, s, Vt = torch.linalg.svd(torch.cat([white, white.new_zeros(len(places), len(places))]), full_matrices=False)
        noise = float(self.new_noise.diagonal().mean().sqrt())
        root[places] = deviations[:, None] * Vt.mT
        return root[:, s < noise]

    def with_second_order(self, covariance: Tensor) -> Tensor:
        """The covariance (M, r, r) of points that may be turned by many degrees, with their errors of second order.

        A turn by an angle w about an unknown axis displaces a point by w x d, and to second order by w x (w x d) / 2,
        in another direction, which the first order leaves out. Its second moment is at most 3/4 of the variance of w
        times that of the displacement. Unless the data leave a turn open this is negligible, and left out.
        """
        if self._turn_variance == 0.0:
            return covariance
        displaced = covariance.diagonal(dim1=1, dim2=2).unflatten(1, (-1, 3)).sum(2)
        return covariance + torch.diag_embed(0.75 * self._turn_variance * displaced.repeat_interleave(3, dim=1))

    @of_origin
    def _turn_variance(self) -> float:
        """Posterior variance, rad^2, of the turn of all points; 0 if the nominal map has none.

        A posterior around one of several optima is too narrow. Turns that the prior leaves open keep its variance.
        Displacements in open directions are of decimetres: then turns of milliradians count, too.
        """
        spec = self.geodesic.spec
        turns = torch.tensor(spec.nominal.turns, dtype=torch.int64, device=self.x.device)
        if not len(turns):
            return 0.0
        prior, posterior = spec.prior_variance[turns], self.parameter_covariance(turns).diagonal()
        total = float(torch.where(prior > OPEN_TURN_RAD**2, prior, posterior).sum())
        return total if total > NEGLIGIBLE_TURN_RAD**2 or self.open_directions.shape[1] else 0.0

    def inflated(self, factor: float) -> FittedMap:
        """Return the map with all variances multiplied by a factor."""
        old, spec = self.geodesic, self.geodesic.spec
        kernels = {name: getattr(spec, name).scaled(factor) for name in ("joint_kernel", "task_kernel")}
        b, p, theta = old.momenta.tensors
        momenta = Momenta(b / factor, p / factor, theta)
        spec = replace(spec, **kernels, prior_variance=factor * spec.prior_variance)
        noise = Noise(factor * self.noise.covariance, factor**0.5 * self.noise.shared)
        deformation = GeodesicDeformation(spec, old.x, momenta, old.integrator)
        unresolved = None if self.unresolved is None else factor * self.unresolved
        changes = {"noise": noise, "new_noise": factor * self.new_noise, "unresolved": unresolved}
        return replace(self, deformation=deformation, **changes)

    def parameter_covariance(self, which: Tensor) -> Tensor:
        """Posterior covariance of the parameters theta with these numbers: (k,) -> (k, k) in m^2, m rad or rad^2."""
        return self.conditional.posterior(self.parameters_as_points(which))[0]

    def parameters_as_points(self, which: Tensor) -> Linearisation:
        """The parameters with these numbers as if they were the coordinates of one configuration.

        After those of the nominal map come the shifts that rows of the fit share, in units of their deviations.
        """
        at, shifts = self.geodesic.linearise(self.x[:1]), self.noise.shared.shape[2]
        nothing = at.sensitivity.new_zeros(1, len(which), at.sensitivity.shape[1])
        chosen = torch.eye(at.sensitivity.shape[2] + shifts, dtype=nothing.dtype, device=nothing.device)[which]
        return replace(at.projected(nothing), sensitivity=chosen[None])

    def joint_covariance(self, x: Tensor) -> Tensor:
        """Posterior covariance of all coordinates of k1 at x (M, n) together: (M m, M m), m^2."""
        return self.covariance_between(self.linearised_value(x)[1])

    def covariance_between(self, at: Linearisation) -> Tensor:
        """Posterior covariance of all points of a linearisation together: (M m', M m')."""
        return self.conditional.covariance_between(at) + torch.block_diag(*self.short_errors(at))

    def measured(self) -> Tensor:
        """(N, m) the measurements that lead to this map and its posterior, m, or (N, r) with slopes.

        What the noise says was hidden is as predicted.

        A map that does not know them derives coordinates: at the optimum the momentum at the end of the task-space flow
        is p_end = R^-1 (y - k1(x)) (12). With fewer control points than data many tables lead to the same map: the one
        with the smallest residuals.
        """
        if self.slopes is not None:
            if self.y is None:
                fix = "calibrate again: files of this version keep what was measured"
                raise InputError.of("the file of this model does not say what was measured", fix=fix)
            return self.y
        values, visible = self.fitted_points, self.noise.visible
        if self.y is not None:
            return torch.where(visible, self.y, values)
        residual = self.noise.multiply(self.weighted_residual()[:, :, None])[:, :, 0]
        return torch.where(visible, values + residual, values)

    def linearised_rows(self) -> tuple[Tensor, Tensor]:
        """A (N, r, m) and what was measured of A k1 (N, r), around the fit; of coordinates A is the identity."""
        y = self.measured()
        if self.slopes is None:
            return self.functionals, y
        residual = self.noise.multiply(self.weighted_residual()[:, :, None])[:, :, 0]
        return self.slopes, (self.slopes @ self.fitted_points[:, :, None])[:, :, 0] + residual

    def weighted_residual(self) -> Tensor:
        """R^-1 (y - h(k1)) at the optimum: (N, r), zero where nothing was measured."""
        deformation = self.geodesic
        if self.data is not None and isinstance(self.by_data, ControlPointRegression):
            return self.by_data.weighted_residual()
        pull = deformation.end_momenta.reshape(deformation.z1.shape)
        return pull if self.slopes is None else (torch.linalg.pinv(self.slopes.mT) @ pull[:, :, None])[:, :, 0]

    @property
    def geodesic(self) -> GeodesicDeformation:
        """The exact deformation.

        Raises:
            InputError: the map is the Eulerian one.
        """
        if isinstance(self.deformation, GeodesicDeformation):
            return self.deformation
        what = "`predict` needs the exact formulation, but this map is in the Eulerian one"
        raise InputError.of(what, fix='fit with formulation="exact"')

    @small_work()
    def inverse(self, y: object, start: object) -> Tensor:
        """Configurations x with k1(x) = y, by Newton steps from ``start``; see :func:`inverse_of`.

        Args:
            y: (M, m) targets in m. start: (M, n) initial configurations, e.g. from nominal inverse kinematics.

        Returns:
            (M, n).

        Raises:
            NumericalError: some target is out of reach from its start, or the search did not settle.
        """
        x = self._configurations(start)
        return inverse_of(self.deformation, as_tensor(y, "y", (len(x), self.m), empty=True), x)

    @of_origin
    def by_data(self) -> Conditional:
        """The fields around the fitted flows, conditioned on the data."""
        around, slopes = self.geodesic, self.slopes
        if self.data is not None:
            return ControlPointRegression(around, self.data, self.noise, slopes)
        at = around.linearise()
        return condition(at if slopes is None else at.projected(slopes), self.noise)

    @of_origin
    def with_motions(self) -> Conditional:
        """Add what the data leave open to the covariances."""
        root = self.open_directions
        many = root.shape[1]
        return Opened(self.by_data, self.columns - many, root.new_ones(many)) if many else self.by_data

    @of_origin
    def conditional(self) -> Conditional:
        """The conditional, without rigid motions where no device saw them."""
        if self.workspace is None:
            return self.with_motions
        at, base = self.geodesic.linearise(self.workspace), self.geodesic.spec.nominal.places[:6]
        return without_rigid_motions(self.with_motions, at, base)

    def _configurations(self, x: object) -> Tensor:
        refuse_data_frame(x, "x")
        fix = f"pass one row of {self.n} joint values per configuration"
        return as_tensor(x, "x", ("M", self.n), fix=fix, empty=True)
