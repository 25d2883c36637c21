"""Scales of the structured kernels and of the noise: defaults from the data, then maximal likelihood.

Every joint error field is, per joint l,

    K_V = diag_l( a_l^2 k_l(x_l, x'_l) + c_l^2 k_all(x, x') )

k_l sees joint l alone: its transmission (gear eccentricity, meshing); k_all sees all joints with one
length scale each: compliance, load, coupling. K_W is a Gaussian on R^3. The noise is

    R_i = sigma^2 I + Dk0(x_i) diag(s^2) Dk0(x_i)^T

where s is the repeatability of the joints; without it the likelihood calls repeatability "signal".

:func:`defaults` scales all of it by what geometry left over. :func:`select` starts there and
maximises the marginal likelihood of the tangent model on a subset of the poses, with a weak
log-normal prior around the defaults; a failed factorisation is a rejected step.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.problem import Problem
from diffeo_calib.calibration.result import Progress, silent
from diffeo_calib.deformation import Deformation, Linearisation, ModelSpec, Momenta
from diffeo_calib.errors import InputError
from diffeo_calib.flows.integrate import RK4
from diffeo_calib.kernels import Gaussian, Kernel, PerJoint, RadialKernel
from diffeo_calib.noise import Noise
from diffeo_calib.nominal import NominalMap
from diffeo_calib.profiles import GaussianProfile
from diffeo_calib.regression.dense import Dense
from diffeo_calib.spaces import Space

SUBSET_COORDINATES = 450
"""Measured coordinates that the likelihood looks at: 150 poses of one marker."""
ITERATIONS = 60
PRIOR_WIDTH = 2.0
"""Standard deviation of the log-normal prior: a factor of e^2 either way is unremarkable."""
BOUND = 9.0
"""Bound on the logarithm of a scale against its default."""
TRANSMISSION_STARTS = (0.22, 0.7)
"""Length scales (rad on a circle) of the transmission kernels from which the likelihood is climbed:
meshing of a reduction gear (tens of periods per turn) and eccentricity (one)."""
FINEST_NOISE = 1e-7
"""Part of the noise that no data remove, m: below it exact data would make G + R singular in float64."""
COMPARABLE = 3.0
"""Largest default error amplitude of a joint against the best-determined joint's: a joint with no lever
arm in the data would otherwise be granted any error."""


@dataclass(frozen=True)
class Hyperparameters:
    """Scales of the two kernels and of the noise; lengths in m, angles in rad.

    Args:
        transmission_lengthscale: (n,) of k_l; on a circle concentration = lengthscale^-2.
        transmission_amplitude: (n,) a_l, rad or m.
        coupled_lengthscale: (n,) of k_all, ARD.
        coupled_amplitude: (n,) c_l, rad or m.
        joint_noise: (n,) s_l, rad or m.
        task_lengthscale: scalar, m. task_amplitude: scalar, m, of K_W.
        sensor_noise: scalar sigma, m, per coordinate.
    """

    transmission_lengthscale: Tensor
    transmission_amplitude: Tensor
    coupled_lengthscale: Tensor
    coupled_amplitude: Tensor
    joint_noise: Tensor
    task_lengthscale: Tensor
    task_amplitude: Tensor
    sensor_noise: Tensor

    def joint_kernel(self, space: Space) -> Kernel:
        """K_V on the joint space."""
        coupled = RadialKernel(
            GaussianProfile(),
            lengthscale=self.coupled_lengthscale,
            variance=self.coupled_amplitude**2,
            periodic=space.periodic,
        )
        return PerJoint(self.transmission_lengthscale, self.transmission_amplitude**2, space) + coupled

    def task_kernel(self) -> Kernel:
        """K_W on R^3."""
        return Gaussian(self.task_lengthscale, self.task_amplitude**2)

    def noise_covariance(self, jacobian: Tensor) -> Tensor:
        """R_i: Jacobian of k0 (N, m, n) -> (N, m, m) in m^2."""
        eye = torch.eye(jacobian.shape[1], dtype=jacobian.dtype, device=jacobian.device)
        return (self.sensor_noise**2 + FINEST_NOISE**2) * eye + jacobian * self.joint_noise.square() @ jacobian.mT

    def logarithms(self) -> Tensor:
        """All scales as one vector of logarithms."""
        return torch.cat([getattr(self, f.name).reshape(-1) for f in fields(self)]).log()

    def from_logarithms(self, vector: Tensor) -> Hyperparameters:
        """The inverse of :meth:`logarithms`, shaped like this object."""
        shapes = [getattr(self, f.name).shape for f in fields(self)]
        parts = torch.split(vector.exp(), [s.numel() for s in shapes])
        return Hyperparameters(*(p.reshape(s) for p, s in zip(parts, shapes, strict=True)))


@dataclass(frozen=True)
class Selection:
    """Scales and where they come from.

    Args:
        scales: the scales.
        status: a sentence about the choice.
        interrupted: whether Ctrl-C ended the search.
    """

    scales: Hyperparameters
    status: str
    interrupted: bool = False


def defaults(nominal: NominalMap, x: Tensor, y: Tensor, noise: float, space: Space) -> Hyperparameters:
    """Scales from the data: what geometry left over, divided by the joints' lever arms.

    Args:
        nominal: k0 after the geometric calibration.
        x: (N, n) configurations. y: (N, m) measured coordinates, m.
        noise: standard deviation of the geometric calibration's residual per coordinate, m.
        space: which joints are circles.
    """
    theta = torch.zeros(nominal.parameters, dtype=x.dtype)
    lever = nominal.jacobian(x, theta).square().mean((0, 1)).sqrt()  # (n,) per coordinate
    amplitude = noise / lever.clamp(min=1e-12)
    amplitude = amplitude.clamp(max=COMPARABLE * float(amplitude.min()))
    # A line's unit is a metre, which says nothing: measure it in half-ranges, as a circle in radians.
    half_range = (0.5 * (x.amax(0) - x.amin(0))).clamp(min=1e-6)
    unit = torch.where(torch.tensor(space.periodic), torch.ones_like(half_range), half_range)
    spread = y.reshape(-1, 3).std(0).norm() if len(y) > 1 else torch.tensor(1.0, dtype=y.dtype)
    return Hyperparameters(
        transmission_lengthscale=TRANSMISSION_STARTS[0] * unit,
        transmission_amplitude=0.5 * amplitude,
        coupled_lengthscale=unit,
        coupled_amplitude=0.5 * amplitude,
        joint_noise=0.2 * amplitude,
        task_lengthscale=spread.clamp(min=1e-3),
        task_amplitude=torch.tensor(0.2 * noise, dtype=x.dtype),
        sensor_noise=torch.tensor(0.2 * noise, dtype=x.dtype),
    )


def select(
    start: Hyperparameters,
    problem: Problem,
    space: Space,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> Selection:
    """Maximise the tangent model's marginal likelihood, times the weak prior, over all scales.

    Args:
        start: centre of the prior, and first start.
        problem: measurements and geometry; its kernels and noise are ignored.
        space: the joint space.
        seed: draws the subset of poses.
        progress: called as ``progress(task, done, total)``.

    Returns:
        the best scales met; Ctrl-C ends the search early.
    """
    search = _Search(problem, space, start, seed, progress)
    try:
        for lengthscale in TRANSMISSION_STARTS:
            factor = lengthscale / TRANSMISSION_STARTS[0]
            search.climb(replace(start, transmission_lengthscale=start.transmission_lengthscale * factor))
    except KeyboardInterrupt:
        return Selection(search.best, "search interrupted, the best so far are kept", interrupted=True)
    return Selection(search.best, f"log marginal likelihood {search.best_likelihood:.1f} on {search.rows} poses")


class _Search:
    """Likelihood times prior as a function of the scales' logarithms, and the best point met."""

    def __init__(self, problem: Problem, space: Space, start: Hyperparameters, seed: int, progress: Progress) -> None:
        self.space, self.centre, self.progress = space, start, progress
        self.best, self.best_value, self.best_likelihood = start, -float("inf"), -float("inf")
        n, m = problem.y.shape
        rows = np.random.default_rng(seed).permutation(n)[: max(1, SUBSET_COORDINATES // m)]
        subset = torch.as_tensor(np.sort(rows))
        self.rows = len(subset)
        x, zero = problem.x[subset], problem.zero()
        rest = Momenta(zero.x[subset], zero.y[: self.rows * m // problem.model.task_dim], zero.theta)
        deformation = Deformation(problem.model, x, rest, RK4(1))
        self.linearisation = deformation.linearise()
        self.jacobian = self.linearisation.joint_to_start  # Dk0 at rest
        self.target = problem.y[subset] - deformation.z1
        self.evaluations = 0

    def climb(self, start: Hyperparameters) -> None:
        """Run the optimiser from one start."""
        from scipy.optimize import minimize  # noqa: PLC0415  # slow to import, not needed to use a model

        x0 = start.logarithms().numpy()
        centre = self.centre.logarithms().numpy()
        bounds = list(zip(centre - BOUND, centre + BOUND, strict=True))
        self.evaluations = 0
        minimize(self._objective, x0, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ITERATIONS})

    def _objective(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        self.evaluations += 1
        self.progress("hyper-parameters", min(self.evaluations, ITERATIONS), ITERATIONS)
        point = torch.tensor(vector, requires_grad=True)
        scales = self.centre.from_logarithms(point)
        try:
            factor, info = torch.linalg.cholesky_ex(self._covariance(scales))
        except InputError:  # the noise blocks alone are not positive definite in float64
            factor, info = point, 1
        if int(info):
            return 1e12, np.zeros_like(vector)  # rejected by the line search
        likelihood = Dense(self.linearisation, factor).log_marginal_likelihood(self.target)
        posterior = likelihood - 0.5 * ((point - self.centre.logarithms()) / PRIOR_WIDTH).square().sum()
        if float(posterior.detach()) > self.best_value:
            self.best_value, self.best_likelihood = float(posterior.detach()), float(likelihood.detach())
            self.best = self.centre.from_logarithms(point.detach())
        posterior.backward()
        gradient = point.grad
        return -float(posterior.detach()), np.zeros_like(vector) if gradient is None else -gradient.numpy()

    def _covariance(self, scales: Hyperparameters) -> Tensor:
        """G + R of the tangent model with these scales."""
        old = self.linearisation.model
        model = ModelSpec(
            old.nominal, scales.joint_kernel(self.space), scales.task_kernel(), old.prior_variance, old.task_dim
        )
        # At rest all nodes of the path coincide, so the first one with weight 1 stands for all.
        joint, task = (replace(pushes[0], weight=1.0) for pushes in (self.linearisation.joint, self.linearisation.task))
        lin = Linearisation(model, [joint], [task], self.linearisation.sensitivity)
        return Noise(scales.noise_covariance(self.jacobian)).add_to(lin.gram())
