"""Calibrations of the RR arm: parameters theta, scales, then tangent model or flow."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import torch
from rr_arm import COORDINATES, ExtendedArm, extended
from rr_models import Criterion, Linearised, Recipe, around, linearise, log_likelihood, search
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import Process

Predict = Callable[[Tensor], Tensor]
"""Joint angles (M, 2) [rad] -> tip (M, 2) [length units]."""

MOST_SELECTED = 80
"""Largest number of measurements on which scales are chosen; all measurements are fitted."""
ITERATIONS, AGAIN = 80, 25
"""Iterations of the search: from each start, and after the second linearisation."""
START_LENGTHS = (0.7, 2.0)
"""Start values of the fields' length scales."""
LADDER = (1e-3, 1e-4, 1e-5, 2e-6)
"""Noise levels [length units]: a flow is fitted with the largest one, then from that solution with smaller ones, down
to the model's own noise. Without these steps Gauss-Newton often fails at large deformations of exact data."""
JITTERS = (0.0, 3e-7, 1e-6, 1e-5)
"""Lower bounds of the noise [length units], tried until the tangent model's matrix can be factorised."""
STEPS, MOST_ITERATIONS = dc.RK8(1), 20
"""Time stepping of flows (error 1e-10), and Gauss-Newton iterations for each noise level."""
TOLERANCE = 1e-5
"""Tolerance of the flow's coupling and end residuals."""
GEOMETRIC_PRIOR, GEOMETRIC_ROUNDS = 0.3, 30
"""Prior standard deviation [rad, length units], far larger than the true errors; Gauss-Newton iterations."""
SMALLEST = 1e-4
"""Smallest size [length units] of the residual from which start scales are derived."""


def geometric_fit(x: Tensor, y: Tensor) -> Tensor:
    """The six geometric parameters by least squares, with a wide prior: (6,)."""
    arm, theta = ExtendedArm(geometry=True), x.new_zeros(COORDINATES)
    for _ in range(GEOMETRIC_ROUNDS):
        residual = (y - arm(extended(x), theta)).flatten()
        S = arm.sensitivities(extended(x), theta).flatten(0, 1)
        ridge = residual.square().mean() / GEOMETRIC_PRIOR**2
        step = torch.linalg.solve(S.T @ S + ridge * torch.eye(len(theta)).to(S), S.T @ residual - ridge * theta)
        theta = theta + step
        if float(step.norm()) < 1e-13:
            break
    return theta


def calibrate(recipe: Recipe, x: Tensor, y: Tensor, seed: int, criterion: Criterion = log_likelihood) -> Calibrated:
    """Fit the geometry, choose scales around it, then repeat both around the geometry that these scales imply."""
    theta = x.new_zeros(recipe.arm.parameters)
    if recipe.geometry:
        theta[:COORDINATES] = geometric_fit(x, y)
    starts = first_scales(recipe, theta, x, y)
    rows = torch.randperm(len(x), generator=torch.Generator().manual_seed(seed))[:MOST_SELECTED]
    data = around(recipe, starts[0], theta, x, y)
    vector = search(recipe, data.take(rows), starts, ITERATIONS, criterion)
    if recipe.geometry:
        theta = Calibrated(recipe, vector, data, x, y).momenta().theta
        data = around(recipe, vector, theta, x, y)
        vector = search(recipe, data.take(rows), [vector], AGAIN, criterion, centre=starts[0])
    return Calibrated(recipe, vector, data, x, y)


def first_scales(recipe: Recipe, theta: Tensor, x: Tensor, y: Tensor) -> list[Tensor]:
    """Start values of the scales, in proportion to the residual; the first start is the centre of the prior."""
    size = max(float((y - recipe.arm(extended(x), theta)).square().mean().sqrt()), SMALLEST)
    parts = {"amplitude": 0.5 * size, "task_amplitude": 0.3 * size, "task_length": 1.0}
    parts |= {"noise": 0.03 * size, "prior": size, "gravity": 0.3 * size}
    return [recipe.logarithms(length=min(length, recipe.longest), **parts) for length in START_LENGTHS]


@dataclass(frozen=True)
class Calibrated:
    """A model with its scales: predictions by its tangent and by its flow."""

    recipe: Recipe
    vector: Tensor
    data: Linearised
    x: Tensor
    y: Tensor

    def momenta(self) -> Momenta:
        """Momenta of the tangent model."""
        return self._conditional().momenta(self.data.target)

    def tangent(self) -> Predict:
        """k0 + S (theta - theta0) + Dk0 v + w."""
        recipe, theta = self.recipe, self.data.theta
        conditional = self._conditional()
        lin, mu = conditional.numbers.at, conditional.about(self.data.target).mu

        def predict(x: Tensor) -> Tensor:
            at = linearise(recipe, self.vector, theta, x)
            return recipe.arm(extended(x), theta) - at.sensitivity @ theta + (at.gram(lin) @ mu).view(-1, 2)

        return predict

    def flow(self) -> tuple[Predict, str | None]:
        """The exact model, and a remark unless it converged; the tangent model's solution is a second start."""
        sigma = self._sigma(LADDER[-1])
        gradual = self._problem(sigma).zero()
        gradual = Momenta(gradual.joint, gradual.task, self.data.theta)
        for floor in LADDER[:-1]:
            if floor > sigma:
                gradual = self._fit(floor, gradual).momenta
        fits = [self._fit(sigma, gradual)]
        if not fits[0].converged:
            with suppress(NumericalError):  # the flow of the tangent model's momenta may overflow
                fits.append(self._fit(sigma, self.momenta()))
        fit = min(fits, key=lambda fit: fit.energy)
        return (lambda x: fit.model(extended(x))), None if fit.converged else fit.status

    def _fit(self, sigma: float, start: Momenta) -> dc.Fit:
        solver = dc.GaussNewton(max_iterations=MOST_ITERATIONS, tolerance=TOLERANCE)
        return dc.fit(self._problem(sigma), solver, STEPS, start=start)

    def _conditional(self) -> Process:
        lin = replace(self.data.lin, spec=self.recipe.spec(self.vector))
        for floor in JITTERS[:-1]:
            try:
                return Process.of_rows(lin, self._noise(floor))
            except NumericalError:  # noise-free, with more rows than the scales were chosen on
                continue
        return Process.of_rows(lin, self._noise(JITTERS[-1]))

    def _sigma(self, floor: float) -> float:
        return max(float(self.recipe.scales(self.vector)["noise"]), floor)

    def _noise(self, floor: float) -> Noise:
        return Noise(self._sigma(floor) ** 2 * torch.eye(2, dtype=torch.float64).repeat(len(self.x), 1, 1))

    def _problem(self, noise: float) -> dc.Problem:
        spec = self.recipe.spec(self.vector)
        return dc.Problem(
            spec.nominal,
            extended(self.x),
            self.y,
            joint_kernel=spec.joint_kernel,
            task_kernel=spec.task_kernel,
            noise=noise,
            prior_variance=spec.prior_variance,
        )
