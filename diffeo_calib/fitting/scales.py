"""Scales of a problem of one's own by marginal likelihood.

In the tangent model the measurements are Gaussian, y - h(k0) ~ N(0, G + R), see :mod:`problem`. Length scales,
amplitudes, prior deviations and noise are those given times exp(t), t ~ N(0, SPREAD^2), at the maximum of the posterior
density of t (C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, section 5.4).
"""

from __future__ import annotations

from dataclasses import replace
from math import inf

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_count, check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode, seeded
from diffeo_calib.common.errors import InputError, NumericalError, few, sentence, warn_user
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.maps.deformation import ModelSpec
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.tails import Tails, gross_weights, reweight

SPREAD = 3.0  # of the logarithms around the scales given: a factor of 20
FAILED = 1e30  # value of the objective where it has none: finite, so that the line search turns back
ROUNDS, GROSS_WEIGHT = 8, 0.5  # most rounds of weights, and the weight below which a row is gross rather than good
NUMBERS = 1500  # measured numbers of the random rows that stand for all rows where there are more


@small_work()
@outside_inference_mode
def choose_scales(problem: Problem, *, robust: bool = False, iterations: int = 100, seed: int = 0) -> Problem:
    """Set the likeliest scales of kernels, parameters theta and noise, near those given.

    Every length scale and variance of a radial kernel, or of a sum of these, is chosen by itself; a kernel of another
    class keeps its own. One factor is common to the prior deviations of theta, and one to the noise. Variances
    of zero stay zero.

    Args:
        problem: with scales of the right order of magnitude.
        robust: whether rows with gross errors, which regression/tails.py tells from the left-out errors of all, get a
            larger noise, so that a fit hardly follows them. A warning names those that are more likely gross than good.
        iterations: of L-BFGS.
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
    order = torch.randperm(len(problem.x), generator=seeded(seed), device=HOST).to(problem.x.device)
    parts = [rows.sort().values for rows in order.split(max(1, NUMBERS // problem.y.shape[1]))]
    visible, tails = problem.noise.visible.sum(1, keepdim=True), Tails.none(len(order), 1, device=order.device)
    chosen = plain = _likeliest(problem, parts[0], iterations)
    for _ in range(ROUNDS if robust else 0):
        squares = problem.y.new_empty(len(order), 1)
        for rows in parts:
            squares[rows] = _left_out_squares(chosen.subset(rows), tails.weights[rows])
        # Scales chosen among gross rows hide some of these: Student's t, which gives them less weight, leads there.
        gross, before = gross_weights(squares, visible), tails
        tails = reweight(squares, visible) if gross is None else Tails(inf, gross, gross=True)
        if tails.settled(before):
            break
        chosen = _likeliest(_weighted(problem, tails.weights), parts[0], iterations)
    if not tails.gross:
        return plain
    if rows := (tails.weights[:, 0] < GROSS_WEIGHT).nonzero()[:, 0].tolist():
        what = f"the errors of rows {few(rows)} are gross, and their noise was raised"
        warn_user(sentence(what, fix="check these rows"))
    return chosen


def _weighted(problem: Problem, weights: Tensor) -> Problem:
    """The problem with the noise of its rows over weights (N, 1)."""
    noise = problem.noise
    covariance = without_hidden(noise.covariance / weights[:, :, None], noise.visible)
    new_noise = noise.mean if problem.new_noise is None else problem.new_noise  # no gross error is expected of new rows
    return problem._with(noise=Noise(covariance, noise.shared), new_noise=new_noise)


def _tangent(problem: Problem) -> tuple[Linearisation, Tensor]:
    """Linearisation of what was measured without deformation, and measured minus nominal (N, r)."""
    at_rest = problem.deform(problem.zero(), RK4(1))
    lin, slopes = at_rest.linearise(), problem.slopes(at_rest)
    return lin if slopes is None else lin.projected(slopes), problem.y - problem.values(at_rest)


def _left_out_squares(problem: Problem, weights: Tensor) -> Tensor:
    """(N, 1) squares of the rows' left-out errors in units of their covariance, with the noise of rows of weight 1."""
    at, target = _tangent(problem)
    noise, process = problem.noise, Process.of_rows(at, problem.noise).about(target)
    errors, C = process.rows_left_out()
    C, e = C + (weights[:, :, None] - 1.0) * noise.covariance, errors[:, :, None]
    return (e * torch.linalg.solve(without_hidden(C, noise.visible), e)).sum(1)


def _likeliest(problem: Problem, rows: Tensor, iterations: int) -> Problem:
    """The problem with the likeliest scales by some of its rows."""
    some = problem.subset(rows)
    (lin, target), R = _tangent(some), some.noise
    target, shared = target.flatten(), R.shared.flatten(0, 1)
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
    return rescaled(problem, logs.detach())


def rescaled(problem: Problem, logs: Tensor) -> Problem:
    """The problem with its scales times exp(logs): of the prior, the noise, the joint kernel and the task kernel."""
    spec, factor = _scaled(problem.spec, logs)
    new_noise = None if problem.new_noise is None else factor * problem.new_noise
    noise = Noise(without_hidden(factor * problem.noise.covariance, problem.noise.visible), problem.noise.shared)
    return problem._with(spec=spec, noise=noise, new_noise=new_noise)


def _scaled(spec: ModelSpec, logs: Tensor) -> tuple[ModelSpec, Tensor]:
    """Kernels and prior with their scales times exp(logs), and the factor of the noise's variance."""
    sizes = [1, 1, spec.joint_kernel.scales, spec.task_kernel.scales]
    prior, noise, joint, task = logs.split(sizes)
    kernels = {"joint_kernel": spec.joint_kernel.rescaled(joint), "task_kernel": spec.task_kernel.rescaled(task)}
    return replace(spec, prior_variance=(2 * prior).exp() * spec.prior_variance, **kernels), (2 * noise).exp()
