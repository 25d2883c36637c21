"""Models of the RR arm from interchangeable parts, linearised, and their scales by a criterion.

All models share one arm (rr_arm.py), one prior on scales and one search, so that two models differ in their parts only.
A residual Gaussian process is a field on the arm's base alone: peers and our models run the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import log, pi

import numpy as np
import torch
from rr_arm import COORDINATES, JOINTS, LOADED, LOADS, ExtendedArm, extended
from torch import Tensor

from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.kernels.profiles import GaussianProfile, Profile
from diffeo_calib.kernels.radial import Gaussian, RadialKernel
from diffeo_calib.maps.deformation import ModelSpec
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity
from diffeo_calib.regression.conditional import diagonal_blocks

Criterion = Callable[[Tensor, Tensor], tuple[float, Tensor | None]]
"""Covariance (2 N, 2 N) of the data, data (2 N,) -> the criterion to maximise, its slope by the covariance."""

SHORTEST, LONGEST, LONGEST_FLOW, LONGEST_FLOW_TASK = 0.2, 30.0, 3.0, 1.0
"""Bounds of length scales. Very long ones make nearly flat kernels, polynomials in effect, whose momenta are too large
for a flow in floating point; a tangent model may use them."""
FINEST_NOISE = 1e-7
"""Smallest standard deviation [length units] of the noise."""
WIDTHS = {"length": 1.5, "task length": 1.5, "noise": 1e3}
"""Standard deviations of the log-normal prior of scales, e-folds."""
WIDTH = 2.0
PERIODIC = tuple(c in JOINTS for c in range(COORDINATES))


@dataclass(frozen=True)
class Recipe:
    """The parts of a model.

    Args:
        fields: groups of coordinates (rr_arm.py) on which a field acts: one amplitude each, common length scales.
        task: whether the model has a psi.
        geometry: whether it has geometric parameters.
        gravity: whether it has coefficients of gravity.
        longest: upper bound of the fields' length scales.
        longest_task: upper bound of psi's length scale [length units].
        profile: profile of the fields' kernels.
    """

    fields: tuple[tuple[int, ...], ...] = ()
    task: bool = False
    geometry: bool = False
    gravity: bool = False
    longest: float = LONGEST
    longest_task: float = LONGEST
    profile: Profile = field(default_factory=GaussianProfile)

    @property
    def arm(self) -> ExtendedArm:
        """k0."""
        return ExtendedArm(geometry=self.geometry, gravity=self.gravity)

    @property
    def sizes(self) -> dict[str, int]:
        """Number of scales by name: noise, prior of angles, lengths and base, and so on."""
        sizes = {"noise": 1, "prior": 3 * self.geometry, "gravity": 2 * self.gravity}
        for k, group in enumerate(self.fields):
            sizes |= {f"amplitude {k}": len(group), f"length {k}": len(JOINTS)}
        return sizes | {"task amplitude": int(self.task), "task length": int(self.task)}

    def scales(self, vector: Tensor) -> dict[str, Tensor]:
        """Logarithms as scales by name."""
        return dict(zip(self.sizes, torch.split(vector.exp(), list(self.sizes.values())), strict=True))

    def logarithms(self, **values: float) -> Tensor:
        """Logarithms of scales: an argument sets all scales whose name begins with the argument's name."""
        each: list[float] = []
        for name, size in self.sizes.items():
            kind = name.split(" ")[0] if name[-1].isdigit() else name.replace(" ", "_")
            each += [values[kind]] * size if size else []
        return torch.tensor(each, dtype=torch.float64).log()

    def spec(self, vector: Tensor) -> ModelSpec:
        """Kernels and prior with these scales."""
        scales = self.scales(vector)
        like = {"periodic": PERIODIC, "columns": JOINTS}
        terms = [RadialKernel(self.profile, variance=vector.new_zeros(COORDINATES), **like)]
        for k, group in enumerate(self.fields):
            places = (torch.tensor(group),)
            variance = vector.new_zeros(COORDINATES).index_put(places, scales[f"amplitude {k}"].square())
            terms.append(RadialKernel(self.profile, lengthscale=scales[f"length {k}"], variance=variance, **like))
        task = Gaussian(1.0, 0.0)
        if self.task:
            task = Gaussian(scales["task length"][0], scales["task amplitude"][0].square())
        prior = scales["prior"].repeat_interleave(2)  # joints, lengths, base
        gravity = scales["gravity"].repeat_interleave(LOADED * LOADS // 2)  # joints, lengths
        return ModelSpec(self.arm, SumKernel(terms[1:] or terms), task, torch.cat([prior, gravity]).square(), 2)


@dataclass(frozen=True)
class Linearised:
    """A model around parameters theta, at the data: its response to fields and theta, and the data minus k0."""

    lin: Linearisation
    theta: Tensor
    target: Tensor

    def matrix(self, recipe: Recipe, vector: Tensor) -> Tensor:
        """Covariance of the data: (2 N, 2 N)."""
        gram = replace(self.lin, spec=recipe.spec(vector)).gram()
        gram.diagonal().add_(recipe.scales(vector)["noise"] ** 2)
        return gram

    def inner(self, recipe: Recipe, vector: Tensor, weights: Tensor) -> Tensor:
        """sum(weights * matrix), differentiable in the scales."""
        fields = (weights * replace(self.lin, spec=recipe.spec(vector)).gram()).sum()
        return fields + recipe.scales(vector)["noise"][0] ** 2 * weights.trace()

    def take(self, rows: Tensor) -> Linearised:
        """Some of the data."""
        return Linearised(self.lin.rows(rows), self.theta, self.target[rows])


def linearise(recipe: Recipe, vector: Tensor, theta: Tensor, x: Tensor) -> Linearisation:
    """Response of the model at joint angles x (M, 2)."""
    spec, at = recipe.spec(vector), extended(x)
    joint = NodeSensitivity(1.0, at, spec.nominal.jacobian(at, theta))
    task = NodeSensitivity(1.0, spec.nominal(at, theta), torch.eye(2, dtype=x.dtype).expand(len(x), 2, 2))
    return Linearisation(spec, [joint], [task], spec.nominal.sensitivities(at, theta))


def around(recipe: Recipe, vector: Tensor, theta: Tensor, x: Tensor, y: Tensor) -> Linearised:
    """The model around theta, at the data."""
    lin = linearise(recipe, vector, theta, x)
    return Linearised(lin, theta, y - recipe.arm(extended(x), theta) + lin.sensitivity @ theta)


def log_likelihood(matrix: Tensor, target: Tensor) -> tuple[float, Tensor | None]:
    """log N(target; 0, matrix), and its derivative by the matrix; None if that is not positive definite in float64."""
    factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        return -float("inf"), None
    mu = torch.cholesky_solve(target[:, None], factor)[:, 0]
    value = -0.5 * float(target @ mu) - float(factor.diagonal().log().sum()) - 0.5 * len(target) * log(2 * pi)
    return value, torch.cholesky_inverse(factor).addr_(mu, mu, beta=-0.5, alpha=0.5)


def leave_one_out(matrix: Tensor, target: Tensor) -> tuple[float, Tensor | None]:
    """-N times the logarithm of the mean square leave-one-out error over the N configurations."""
    leaf = matrix.clone().requires_grad_()
    factor, info = torch.linalg.cholesky_ex(leaf)
    if int(info):
        return -float("inf"), None
    rows = len(target) // 2
    mu = torch.cholesky_solve(target[:, None], factor).view(rows, 2, 1)
    errors = torch.linalg.solve(diagonal_blocks(torch.cholesky_inverse(factor), rows), mu)
    value = -rows * errors.square().mean().log()
    (slope,) = torch.autograd.grad(value, leaf)
    return float(value.detach()), 0.5 * (slope + slope.mT)


def search(
    recipe: Recipe,
    data: Linearised,
    starts: Sequence[Tensor],
    iterations: int,
    criterion: Criterion = log_likelihood,
    *,
    centre: Tensor | None = None,
) -> Tensor:
    """Maximise a criterion times the prior of the scales; a failed factorisation is a rejected step.

    Args:
        recipe: the model.
        data: the data that it explains.
        starts: logarithms of scales, the starts of the search.
        iterations: number of iterations from each start.
        criterion: the function to maximise.
        centre: centre of the prior; the first start by default.

    Returns:
        logarithms of the best scales found.
    """
    from scipy.optimize import minimize  # noqa: PLC0415  # slow to import

    names = [name for name, size in recipe.sizes.items() for _ in range(size)]
    width = torch.tensor([WIDTHS.get(_kind(name), WIDTH) for name in names], dtype=torch.float64)
    limits = {"length": (SHORTEST, recipe.longest), "task length": (SHORTEST, recipe.longest_task)}
    limits["noise"] = (FINEST_NOISE, 1.0)
    bounds = np.log([limits.get(_kind(name), (1e-7, 10.0)) for name in names])
    middle = starts[0] if centre is None else centre
    best, best_value = starts[0], -float("inf")

    def objective(point: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best, best_value
        vector = torch.tensor(point, requires_grad=True)
        value, slope = criterion(data.matrix(recipe, vector.detach()), data.target.flatten())
        if slope is None:
            return 1e12, np.zeros_like(point)
        prior = -0.5 * ((vector - middle) / width).square().sum()
        (gradient,) = torch.autograd.grad(data.inner(recipe, vector, slope) + prior, vector)
        value += float(prior.detach())
        if value > best_value:
            best, best_value = vector.detach(), value
        return -value, -gradient.numpy()

    for start in starts:
        inside = start.numpy().clip(bounds[:, 0], bounds[:, 1])
        minimize(objective, inside, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations})
    return best


def _kind(name: str) -> str:
    return "length" if name.startswith("length") else name
