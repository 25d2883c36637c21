"""The fitting problem: measured pairs, kernels, noise, and the energy (16) of Orozco & Ratajczak (2025).

    E = 1/2 b^T K_V b + 1/2 p^T K_W p + 1/2 theta^T Lambda theta + 1/2 sum_i r_i^T R_i^-1 r_i,   r_i = k1(x_i) - y_i

with the initial momenta as unknowns; R_i = sigma^2 I gives the weight 1 / (2 sigma^2).

Linearised around a deformation it is one Gaussian regression, a Gauss-Newton step. At zero deformation that is the
tangent model k1 = k0 + Dk0 K_V b + K_W p + S theta, a Gaussian process with the prior covariance

    G(x, x') = Dk0(x) K_V(x, x') Dk0(x')^T + K_W(k0(x), k0(x')) + S(x) Lambda^-1 S(x')^T
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from math import nan
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_count, check_covariance, check_finite, positive, real_tensor
from diffeo_calib.common.data_frames import refuse_data_frame
from diffeo_calib.common.device import methods_outside_inference_mode, usable
from diffeo_calib.common.errors import InputError, NumericalError, sentence, warn_user
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.flows.integrators import RK4, Integrator
from diffeo_calib.kernels.base import Kernel, check_kernel
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.maps.deformation import Deformation, ModelSpec, Momenta, relative
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.nominal import NominalMap, as_nominal
from diffeo_calib.maps.observation import Observation, coordinate_noise, observed_dim
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.conjugate_gradients import (
    CG_TOLERANCE,
    ConjugateGradientRegression,
    LinearSolver,
    condition,
)
from diffeo_calib.regression.control_points import ControlPointRegression

SMALLEST_NOISE = 1e-100  # smallest standard deviation in m: its square must not underflow
NEGLIGIBLE_VARIANCE = 1e-18  # noise in m^2 of new coordinates where none were measured: a nanometre


class EnergyParts(NamedTuple):
    """The terms of the energy, dimensionless; fits minimise ``total``."""

    field_x: Tensor
    field_y: Tensor
    prior: Tensor
    data: Tensor

    @property
    def total(self) -> Tensor:
        """E."""
        return self.field_x + self.field_y + self.prior + self.data


@methods_outside_inference_mode
class Problem:
    """Measured pairs (x_i, y_i) with the nominal map, kernels and noise of their fit.

    Args:
        nominal: k0, a torch function (N, n) -> (N, m) or a :class:`NominalMap`.
        x: (N, n) joint configurations, rad or m.
        y: (N, m) measured task coordinates, m = d * markers, in m; with ``observe`` (N, r), in its units.
        joint_kernel: K_V on the n joints. task_kernel: K_W on R^d.
        noise: standard deviation sigma in m (R = sigma^2 I), covariance blocks (N, m, m) in m^2, or a :class:`Noise`;
            with ``observe`` of what was measured, r for m.
        markers: P, the number of points per configuration; coordinates of one marker are adjacent.
        prior_variance: (K,) variances of the nominal map's parameters theta, if it has any.
        new_noise: (m, m) covariance of a new measurement, m^2, which :meth:`FittedMap.predict` adds; the mean of
            ``noise`` by default; with ``observe`` negligible, since no coordinates were measured.
        observe: what was measured of k1(x_i), such as a distance; all its coordinates by default.

    Attributes:
        controls: (M, n) configurations that carry momenta; the data's own x unless :meth:`with_controls`.
        reduced: whether they differ from the data's. spec: k0, kernels, prior.
        whole: the problem whose maps the fit leads to, by default its own; see :meth:`standing_for`.
        certified: whether a minimum of the energy satisfies the end condition (12), up to the time steps: not in the
            paper's Eulerian formulation, which replaces some methods.

    Raises:
        InputError: wrong shapes or kernels, values that are not finite, or a nominal map that is not
            defined at the data.
    """

    certified = True
    reduced = False
    whole: Problem | None = None

    def __init__(
        self,
        nominal: NominalMap | Callable[[Tensor], Tensor],
        x: object,
        y: object,
        *,
        joint_kernel: Kernel,
        task_kernel: Kernel,
        noise: object,
        markers: int = 1,
        prior_variance: object = (),
        new_noise: object = None,
        observe: Observation | None = None,
    ) -> None:
        refuse_data_frame(x, "x")
        given = {"x": x, "y": y, "noise": noise, "prior_variance": prior_variance}
        if live := [name for name, value in given.items() if isinstance(value, Tensor) and value.requires_grad]:
            what = f"no gradient leads from a fit back to `{'`, `'.join(live)}`"
            warn_user(sentence(what, fix="detach them, and use `fit.gradients`"))
        self.x = self.controls = as_tensor(x, "x", ("N", "n")).detach()
        self.y = as_tensor(y, "y", (len(self.x), "m"), fix="pass one measured point per configuration").detach()
        nominal, self.observe = as_nominal(nominal), observe
        m = self.y.shape[1] if observe is None else observed_dim(observe, self.y, markers)
        check_count(markers, "`markers`")
        if m % markers:
            raise InputError.of("`markers`", expected=f"a divisor of the {m} columns of `y`", got=markers)
        check_kernel(joint_kernel, self.x.shape[1], "joint_kernel")
        check_kernel(task_kernel, m // markers, "task_kernel")
        variance = self.x.new_zeros(0)
        if nominal.parameters:
            variance = positive(prior_variance, "prior_variance", (nominal.parameters,)).to(self.x.device)
        self.spec = ModelSpec(nominal, joint_kernel, task_kernel, variance, m // markers)
        self.noise, self.new_noise = self._noise(noise), self._new_noise(new_noise, m)
        value = nominal(self.x, variance * 0.0)
        if value.shape != (len(self.y), m):
            raise InputError.of(
                "`nominal(x)` has the wrong shape",
                expected=(len(self.y), m),
                got=tuple(value.shape),
                fix="k0 must map (N, n) to the shape of `y`",
            )
        check_finite(value, "nominal(x)")

    def _noise(self, noise: object) -> Noise:
        n, m = self.y.shape
        if noise is None:
            raise InputError.of("`noise`", expected="sigma in m or one covariance block per row", got="None")
        if isinstance(noise, Noise):
            as_tensor(noise.covariance, "noise", (n, m, m))
            return noise.to(self.y.device)
        noise = real_tensor(noise, "noise")
        if noise.ndim == 0:
            sigma = positive(noise, "noise")
            if float(sigma) < SMALLEST_NOISE:
                raise InputError.of("`noise`", expected=f"at least {SMALLEST_NOISE:g} m", got=float(sigma))
            return Noise((sigma**2 * torch.eye(m, dtype=self.y.dtype, device=self.y.device)).repeat(n, 1, 1))
        return Noise(as_tensor(noise, "noise", (n, m, m), fix="pass sigma in m or one covariance block per row"))

    def _new_noise(self, covariance: object, m: int) -> Tensor | None:
        if covariance is None:
            eye = torch.eye(m, dtype=self.y.dtype, device=self.y.device)
            return None if self.observe is None else NEGLIGIBLE_VARIANCE * eye
        checked = as_tensor(covariance, "new_noise", (m, m), fix="pass the covariance of one measurement, m^2").detach()
        check_covariance(checked, "`new_noise`")
        return checked.to(self.y.device)

    def _with(self, **changes: object) -> Problem:
        other = copy(self)
        vars(other).update(changes)
        return other

    def using(self, backend: Backend, accuracy: float | None = None) -> Problem:
        """Return the problem with its kernel sums evaluated by this backend; ``accuracy`` as :meth:`Kernel.using`."""
        return self._with(spec=self.spec.using(backend, accuracy))

    def to(self, device: torch.device | str) -> Problem:
        """Return the problem on a device, where its fits and their models then run."""
        device = usable(device, numbers=False)
        parts = {name: value for name, value in vars(self).items() if hasattr(value, "to")}
        return self._with(**{name: value.to(device) for name, value in parts.items()})

    def with_controls(self, controls: object) -> Problem:
        """A coarse version: only these configurations (M, n) carry momenta; the N data are passive points.

        With controls equal to the data's configurations the problem is not coarse.

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        n = self.x.shape[1]
        points = as_tensor(controls, "controls", ("M", n), fix=f"pass configurations of {n} joints").detach()
        whole = None if self.whole is None else self.whole.with_controls(controls)
        return self._with(controls=points, reduced=not torch.equal(points, self.x), whole=whole)

    def with_nominal_of_rows(self, nominal: NominalMap) -> Problem:
        """Return the problem with another k0 at its own rows than elsewhere, see :class:`ModelSpec`."""
        return self if nominal is self.spec.nominal else self._with(spec=replace(self.spec, at_controls=nominal))

    def standing_for(self, whole: Problem) -> Problem:
        """Let fits lead to the maps of another problem with the same unknowns.

        It has the same optimum, and fewer numbers: functionals of the coordinates that the other one has, which tell
        all there is to know.
        """
        return self._with(whole=whole)

    def subset(self, rows: Tensor) -> Problem:
        """Return the problem with only the measurements of these row numbers."""
        x = self.x[rows]
        observe = None if self.observe is None else self.observe.rows(rows)
        whole = None if self.whole is None else self.whole.subset(rows)
        measured = {"x": x, "y": self.y[rows], "noise": self.noise.rows(rows), "observe": observe}
        return self._with(controls=x, reduced=False, whole=whole, **measured)

    def zero(self) -> Momenta:
        """The unknowns of no deformation, k1 = k0."""
        m = self.y.shape[1] if self.observe is None else self.observe.dim
        points = len(self.controls) * (m // self.spec.task_dim)
        task = self.y.new_zeros(points, self.spec.task_dim)
        return Momenta(torch.zeros_like(self.controls), task, torch.zeros_like(self.spec.prior_variance))

    def deform(self, momenta: Momenta, integrator: Integrator, *, variational: bool = False) -> GeodesicDeformation:
        """Run both flows for these momenta; pass ``variational`` if the result will be linearised."""
        return GeodesicDeformation(self.spec, self.controls, momenta, integrator, variational=variational)

    def start(self, integrator: Integrator) -> tuple[Momenta, int]:
        """The default start of L-BFGS, which makes no progress from zero: the tangent solution.

        Returns:
            its momenta; runs of the flows that were needed to find them.
        """
        return linear_optimum(self, self.deform(self.zero(), RK4(1)))[0], 0

    def unknowns(self, momenta: Momenta) -> Momenta:
        """The free ones of all momenta (b, p, theta); the rest is implied by them, and empty."""
        return momenta

    def preconditioner(self, momenta: Momenta, integrator: Integrator) -> Process:
        """G + R of a Gauss-Newton step; with fewer controls than data, each control represents N / M measurements."""
        deformation = self.deform(momenta, integrator)
        slopes, at = self.slopes(deformation), deformation.linearise()
        if self.reduced:
            count = len(self.controls)
            mean = self.noise.mean if slopes is None else coordinate_noise(self.noise, slopes)
            return Process.of_rows(at, Noise((count / len(self.x) * mean).repeat(count, 1, 1)))
        return Process.of_rows(at if slopes is None else at.projected(slopes), self.noise)

    def calibrated(self, deformation: Deformation) -> FittedMap:
        """A deformation of this problem as the map that users work with."""
        if self.whole is not None:
            return self.whole.calibrated(self.whole.deform(deformation.momenta, deformation.integrator))
        slopes = self.slopes(deformation)
        data = self.x if self.reduced else None
        return FittedMap(deformation, self.noise, data, self.new_noise, slopes=slopes, y=self.y)

    def coordinates(self, deformation: Deformation) -> Tensor:
        """k1 at the data: (N, m)."""
        return deformation(self.x) if self.reduced else deformation.z1

    def values(self, deformation: Deformation) -> Tensor:
        """Predicted measurements: k1 (N, m), or h(k1) (N, r)."""
        points = self.coordinates(deformation)
        return points if self.observe is None else self.observe.value(points)

    def residual(self, rows: Tensor, points: Tensor) -> Tensor:
        """Measured minus predicted, (M, m) or (M, r), at the rows with these numbers, from k1 there, (M, m)."""
        predicted = points if self.observe is None else self.observe.rows(rows).value(points)
        return self.y[rows] - predicted

    def slopes(self, deformation: Deformation) -> Tensor | None:
        """A = Dh at k1 of the data: (N, r, m); None if all coordinates were measured."""
        return None if self.observe is None else self.observe.slope(self.coordinates(deformation))

    def energy(self, deformation: Deformation, values: Tensor | None = None) -> EnergyParts:
        """The energy of a deformation of this problem; differentiable once in its momenta.

        Args:
            deformation: of this problem. values: :meth:`values` of it, if they are known.
        """
        residual = (self.values(deformation) if values is None else values) - self.y
        return EnergyParts(
            *deformation.field_energies(),
            0.5 * (deformation.momenta.theta**2 / self.spec.prior_variance).sum(),
            0.5 * (residual * self.noise.solve(residual)).sum(),
        )

    def coupling_residual(self, deformation: Deformation) -> float:
        """|b_end - Dk0(xi)^T p| / |b_end|, zero at the optimum.

        NaN with fewer control points than data, since the paper's momentum lives at the data, and in the Eulerian
        formulation, in which the coupling holds by construction.
        """
        return float("nan") if self.reduced else deformation.coupling_residual()

    def end_residual(self, deformation: Deformation) -> float:
        """|p_end - A^T R^-1 (y - h(z1))| / |p_end|: the end condition (12); NaN with fewer control points than data.

        Without ``observe`` h is the identity.
        """
        if self.reduced:
            return float("nan")
        p_end = deformation.end_momenta.reshape(deformation.z1.shape)
        pull, slopes = self.noise.solve(self.y - self.values(deformation)), self.slopes(deformation)
        pull = pull if slopes is None else (slopes.mT @ pull[:, :, None])[:, :, 0]
        return relative(p_end - pull, p_end)


def slope(
    problem: Problem, integrator: Integrator, momenta: Momenta, variables: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Energy and its gradient by ``variables``, of which the momenta are made; None where they are not finite."""
    with torch.enable_grad():
        try:
            total = problem.energy(problem.deform(momenta, integrator)).total
            (gradient,) = torch.autograd.grad(total, variables)
        except (NumericalError, AssertionError):  # the latter if steps of torchdiffeq's adjoint underflow
            return None
    total = total.detach()
    return (total, gradient) if bool(torch.isfinite(total)) and bool(torch.isfinite(gradient).all()) else None


class Regression(NamedTuple):
    """A linearisation conditioned on its data; ``target`` (N, m) is measured minus linearised at zero fields, m."""

    conditional: Process | ConjugateGradientRegression
    target: Tensor

    def momenta(self) -> Momenta:
        """Posterior mode of b, p, theta."""
        return self.conditional.momenta(self.target)


def regress(
    problem: Problem, deformation: GeodesicDeformation, linear: LinearSolver = "auto", tolerance: float = CG_TOLERANCE
) -> Regression:
    """Linearise a problem around a deformation of it and condition it on its data, which are its control points.

    Args:
        linear: "cholesky" of G + R, conjugate gradients "cg", or "auto" by size.
        tolerance: of conjugate gradients, relative residual.

    Raises:
        InputError: the method needs more memory than is free.
        NumericalError: G + R is not positive definite in float64.
    """
    slopes = problem.slopes(deformation)
    lin = deformation.linearise()
    response = deformation.linear_response(lin)
    if slopes is not None:
        lin, response = lin.projected(slopes), (slopes @ response[:, :, None])[:, :, 0]
    target = problem.y - problem.values(deformation) + response
    return Regression(condition(lin, problem.noise, linear, tolerance), target)


def linear_optimum(
    problem: Problem, deformation: GeodesicDeformation, linear: LinearSolver = "auto", tolerance: float = CG_TOLERANCE
) -> tuple[Momenta, float]:
    """The momenta that minimise the energy of a problem linearised around a deformation; arguments as of `regress`.

    Problems with fewer control points than data are solved by their normal equations.

    Returns:
        the momenta; how far the energy of the linearised problem falls to them, NaN if the data are the controls.
    """
    if not problem.reduced:
        return regress(problem, deformation, linear, tolerance).momenta(), nan
    slopes = problem.slopes(deformation)
    return ControlPointRegression(deformation, problem.x, problem.noise, slopes, problem.residual).mode()


def tangent(problem: Problem, linear: LinearSolver = "auto") -> Regression:
    """The tangent model at zero deformation."""
    return regress(problem, problem.deform(problem.zero(), RK4(1)), linear)
