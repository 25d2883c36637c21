"""Scales of a problem of one's own by marginal likelihood.

In the tangent model the measurements are Gaussian, y - h(k0) ~ N(0, G + R), see :mod:`problem`. Length scales,
amplitudes, prior deviations and noise are those given times exp(t), t ~ N(0, SPREAD^2), at the maximum of the posterior
density of t (C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, section 5.4).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_count, check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode, seeded
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.maps.deformation import ModelSpec
from diffeo_calib.maps.noise import Noise, without_hidden

SPREAD = 3.0  # of the logarithms around the scales given: a factor of 20
FAILED = 1e30  # value of the objective where it has none: finite, so that the line search turns back
NUMBERS = 1500  # measured numbers of the random rows that stand for all rows where there are more


@small_work()
@outside_inference_mode
def choose_scales(problem: Problem, *, iterations: int = 100, seed: int = 0) -> Problem:
    """Set the likeliest scales of kernels, parameters theta and noise, near those given.

    Every length scale and variance of a radial kernel, or of a sum of these, is chosen by itself; a kernel of another
    class keeps its own. One factor is common to the prior deviations of theta, and one to the noise. Variances
    of zero stay zero.

    Args:
        problem: with scales of the right order of magnitude. iterations: of L-BFGS.
        seed: draws the rows that are used where there are more than :data:`NUMBERS` numbers.

    Raises:
        InputError: no problem, or one with fewer control points than data. NumericalError: the covariance of the
            measurements is not positive definite in float64 with the scales given.
    """
    if not isinstance(problem, Problem):
        raise InputError.of("`problem`", expected="a dc.Problem", got=type(problem).__name__)
    check_count(iterations, "`iterations`")
    check_seed(seed)
    if problem.reduced:
        raise InputError.of("`problem`", expected="all data as control points", got=f"{len(problem.controls)} controls")
    count = max(1, NUMBERS // problem.y.shape[1])
    rows = torch.randperm(len(problem.x), generator=seeded(seed), device=HOST)[:count].sort().values
    some = problem.subset(rows.to(problem.x.device))
    at_rest = some.deform(some.zero(), RK4(1))
    lin, slopes, target = at_rest.linearise(), some.slopes(at_rest), (some.y - some.values(at_rest)).flatten()
    lin, R = lin if slopes is None else lin.projected(slopes), some.noise
    shared = R.shared.flatten(0, 1)
    logs = target.new_zeros(2 + sum(kernel.scales for kernel, _ in lin.sides), requires_grad=True)
    search = torch.optim.LBFGS([logs], max_iter=iterations, line_search_fn="strong_wolfe")

    def objective() -> Tensor:
        search.zero_grad()
        spec, factor = _scaled(some.spec, logs)
        G = (
            replace(lin, spec=spec).gram(replace(lin))
            + torch.block_diag(*without_hidden(factor * R.covariance, R.visible))
            + shared @ shared.mT
        )
        L, info = torch.linalg.cholesky_ex(G)
        if int(info):
            return target.new_full((), FAILED)
        white = torch.linalg.solve_triangular(L, target[:, None], upper=False)
        loss = 0.5 * white.square().sum() + L.diagonal().log().sum() + 0.5 * (logs / SPREAD).square().sum()
        loss.backward()
        return loss.detach()

    with torch.enable_grad():
        if float(search.step(objective)) == FAILED:
            raise NumericalError.of(
                "the covariance of the measurements", expected="positive definite", fix="raise `noise`"
            )
    spec, factor = _scaled(problem.spec, logs.detach())
    new_noise = None if problem.new_noise is None else factor * problem.new_noise
    noise = Noise(without_hidden(factor * problem.noise.covariance, problem.noise.visible), problem.noise.shared)
    return problem._with(spec=spec, noise=noise, new_noise=new_noise)


def _scaled(spec: ModelSpec, logs: Tensor) -> tuple[ModelSpec, Tensor]:
    """Kernels and prior with their scales times exp(logs), and the factor of the noise's variance."""
    sizes = [1, 1, spec.joint_kernel.scales, spec.task_kernel.scales]
    prior, noise, joint, task = logs.split(sizes)
    kernels = {"joint_kernel": spec.joint_kernel.rescaled(joint), "task_kernel": spec.task_kernel.rescaled(task)}
    return replace(spec, prior_variance=(2 * prior).exp() * spec.prior_variance, **kernels), (2 * noise).exp()
