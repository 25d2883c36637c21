"""`fit`: the common entry point for all formulations, solvers and integrators."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral
from typing import Literal, Protocol, get_args

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_finite
from diffeo_calib.common.device import HOST, outside_inference_mode, seeded
from diffeo_calib.common.errors import InputError, NumericalError, as_written
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.lbfgs import LBFGS
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import MAX_END_RESIDUAL, Fit, Progress, Solution, Stepped, certify, silent, stepped
from diffeo_calib.flows.integrators import RK4, RK8, Integrator
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.regression.conjugate_gradients import pivots

LOG = logging.getLogger(__name__)
Formulation = Literal["exact", "eulerian"]

MAX_STEP_ERROR_RATIO = 0.01
"""Largest accepted time-stepping error, as a fraction of the noise, when time steps are chosen."""
FINEST_INTEGRATOR = RK8(8)  # the finest time stepping that is chosen
MAX_EXCESS_FOR_TWO_STEPS = 8.0
"""Largest error of one RK4 step, relative to the accepted one, at which two steps (16 times less error) are tried."""
TRIAL_ITERATIONS = 4  # iterations of Gauss-Newton after which the momenta are accurate enough to choose the time steps
COARSE_START_INTEGRATOR = RK4(2)  # time stepping of the fit that starts a coarse model


class Solver(Protocol):
    """A minimiser of a problem's energy."""

    @property
    def integrator(self) -> Integrator | None:
        """Time stepping, unless it is passed to :func:`fit`."""
        ...

    def solve(
        self, problem: Problem, integrator: Integrator, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Minimise the energy from ``start``."""
        ...


@small_work()
@outside_inference_mode
def fit(
    problem: Problem,
    solver: Solver | None = None,
    integrator: Integrator | None = None,
    *,
    controls: object = None,
    backend: Backend = "auto",
    accuracy: float | None = None,
    start: Momenta | None = None,
    progress: Progress = silent,
    formulation: Formulation = "exact",
    **errata: object,
) -> Fit:
    """Fit k1 = psi o k0 o phi^-1 to a problem's measurements.

    Args:
        problem: data, kernels, noise.
        solver: :class:`GaussNewton` by default, :class:`LBFGS` of the Eulerian formulation.
        integrator: time stepping. By default the solver's own, else one step of RK4, refined (two steps, then RK8)
            until its error at the data is below 1 % of the noise and the end residual below 5 %.
        controls: for a coarse model of many measurements, the number of configurations that carry momenta (chosen from
            x by pivoted Cholesky factorisation of the prior covariance), or the configurations (M, n). Default: all.
        backend: of the kernel sums, see :meth:`Kernel.using`; with "distributed" all processes must make this call
            with the same data, and later the same queries to the model.
        accuracy: allows large kernel sums an error of this size, relative to the sum of the momenta's absolute values:
            for smooth kernels of few coordinates they then go by plane waves, in a time that grows with the number of
            points, not of pairs. Default: all pairs.
        start: initial momenta; the solver's own start by default.
        progress: called as ``progress(task, done, total)``.
        formulation: "exact", or "eulerian" for the paper's own equations (16)-(20), which follow k, P and Dk at fixed
            points and remain approximate with any number of time steps; kept for comparison.
        errata: for the Eulerian formulation, the errata to keep as printed: ``printed_sign``, ``printed_jacobian``,
            ``printed_divergence``; see :class:`diffeo_calib.paper.eulerian.Eulerian`.

    Returns:
        a :class:`Fit`; check ``status``, ``coupling_residual`` and ``end_residual``.

    Raises:
        InputError: unknown backend, formulation or erratum, invalid accuracy or controls, two different integrators, a
            solver that does not support the formulation, or not enough free memory.
        NumericalError: the linear algebra broke down (noise too small for the kernels).
    """
    solver = solver if solver is not None else (LBFGS() if formulation == "eulerian" else GaussNewton())
    _check_arguments(problem, solver, integrator, start)
    of_solver = solver.integrator
    if integrator is not None and of_solver is not None and integrator != of_solver:
        got = f"{integrator} and {of_solver}"
        raise InputError.of("`integrator`", expected="the same for `fit` and its solver", got=got, fix="pass one")
    integrator = of_solver if integrator is None else integrator
    problem = problem.using(backend, accuracy)
    begin = time.perf_counter()
    if isinstance(controls, Integral) and not isinstance(controls, bool):
        rows = choose_controls(problem, int(controls))
        whole, problem = problem, problem.with_controls(problem.x[rows])
        if start is None and problem.reduced and formulation == "exact":
            first, used, integrator = _start_of_coarse(whole, rows, solver, integrator, progress)
            start = first.momenta
            if first.interrupted:
                return certify(problem, problem, first, used, time.perf_counter() - begin)
    elif controls is not None:
        problem = problem.with_controls(controls)
    objective = formulate(problem, formulation, errata)
    if start is not None:
        _check_start(start, objective)
    run = None
    if integrator is not None:
        solution = solver.solve(objective, integrator, start, progress)
    else:
        solution, integrator, run = _with_chosen_steps(objective, solver, start, progress)
    result = certify(problem, objective, solution, integrator, time.perf_counter() - begin, known=run)
    LOG.info("fit of %d rows: %s, %.1f s", len(problem.x), result.status, result.seconds)
    return result


def formulate(problem: Problem, formulation: str, errata: Mapping[str, object]) -> Problem:
    """The problem in the named formulation.

    Raises:
        InputError: an unknown formulation or erratum, errata for the exact formulation, or fewer control points than
            data for the Eulerian one.
    """
    if formulation not in get_args(Formulation):
        raise InputError.of("`formulation`", expected='"exact" or "eulerian"', got=as_written(formulation))
    if formulation == "eulerian":
        # The only import from a folder that builds on this one.
        from diffeo_calib.paper.eulerian import EulerianProblem  # noqa: PLC0415

        return EulerianProblem.with_errata(problem, errata)
    if errata:
        fix = 'leave them out, or pass formulation="eulerian"'
        raise InputError.of("errata of the exact formulation", expected="none", got=", ".join(errata), fix=fix)
    return problem


def _start_of_coarse(
    problem: Problem, rows: Tensor, solver: Solver, integrator: Integrator | None, progress: Progress
) -> tuple[Solution, Integrator, Integrator | None]:
    """A solution to start a coarse model from whose controls are some rows.

    First that of the exact model of these rows, then, of many rows, that of the coarse model of a sample of them: an
    iteration over all rows is expensive then.

    Returns:
        the solution, its time stepping, and that for all rows; None if it is still to be chosen.
    """
    used, some = integrator or COARSE_START_INTEGRATOR, sample(problem)
    solution = solver.solve(problem.subset(rows), used, None, progress)
    if solution.interrupted or some is None or len(some) <= len(rows):
        return solution, used, integrator
    coarse = problem.subset(some).with_controls(problem.x[rows])
    if integrator is not None:
        return solver.solve(coarse, used, solution.momenta, progress), used, integrator
    solution, used, _ = _with_chosen_steps(coarse, solver, solution.momenta, progress)
    return solution, used, used


def _check_arguments(problem: object, solver: object, integrator: object, start: object) -> None:
    """Raise InputError for arguments of the wrong type, including a class instead of an object."""
    if not isinstance(problem, Problem):
        raise InputError.of("`problem`", expected="a dc.Problem", got=type(problem).__name__)
    if isinstance(solver, type) or not hasattr(solver, "solve"):
        raise InputError.of(
            "`solver`", expected="dc.GaussNewton(), dc.LBFGS() or dc.GradientDescent(step)", got=as_written(solver)
        )
    for given in (integrator, getattr(solver, "integrator", None)):
        if given is not None and not isinstance(given, Integrator):
            expected = "dc.RK4(2), dc.RK8(1) or dc.TorchDiffEq(...)"
            raise InputError.of("`integrator`", expected=expected, got=as_written(given))
    if start is not None and not isinstance(start, Momenta):
        fix = "pass `fit.momenta`"
        raise InputError.of("`start`", expected="momenta", got=type(start).__name__, fix=fix)


def _check_start(start: Momenta, problem: Problem) -> None:
    for tensor in start.tensors:
        if not isinstance(tensor, Tensor) or tensor.dtype != torch.float64:
            raise InputError.of("the momenta of `start`", expected="float64 tensors", got=as_written(tensor)[:60])
    got, expected = ([tuple(t.shape) for t in momenta.tensors] for momenta in (start, problem.zero()))
    if got != expected:
        fix = "start from a fit with the same control points and formulation"
        raise InputError.of("the momenta of `start`", expected=f"shapes {expected}", got=got, fix=fix)
    for tensor in start.tensors:
        check_finite(tensor, "start")


def _with_chosen_steps(
    problem: Problem, solver: Solver, start: Momenta | None, progress: Progress
) -> tuple[Solution, Integrator, Stepped | None]:
    """The solution with time steps that are fine enough, and its run with them, if the flows do not overflow."""
    integrator: Integrator = RK4(2) if problem.reduced else RK4(1)
    if start is not None:
        integrator, _ = _enough_steps(problem, start, integrator, at_optimum=False)
    first, trial = solver, False
    if start is None and isinstance(solver, GaussNewton) and solver.max_iterations > TRIAL_ITERATIONS:
        first, trial = replace(solver, max_iterations=TRIAL_ITERATIONS), True
    solution = first.solve(problem, integrator, start, progress)
    while True:
        # Before the optimum is reached the end condition is violated anyway, whatever the time steps.
        wanted, run = _enough_steps(problem, solution.momenta, integrator, at_optimum=not solution.exhausted)
        if solution.interrupted or (wanted == integrator and not (trial and solution.exhausted)):
            return solution, integrator, run
        trial, integrator = False, wanted
        # Coarse time steps may reach momenta whose flows overflow with finer ones: start nearer to the beginning then.
        origin, far = problem.zero() if start is None else start, solution.momenta
        for share in (*(0.5**halvings for halvings in range(MOST_HALVINGS)), 0.0):
            try:
                solution = solver.solve(problem, integrator, origin.towards(far, share), progress)
                break
            except NumericalError:
                if share == 0.0:
                    raise


def _enough_steps(
    problem: Problem, momenta: Momenta, integrator: Integrator, *, at_optimum: bool
) -> tuple[Integrator, Stepped | None]:
    """The given integrator if its errors at these momenta are small enough, else a finer one; and its own run."""
    try:
        run = stepped(problem, momenta, integrator)
    except NumericalError:  # the steps are so long that the flows overflow
        return FINEST_INTEGRATOR, None
    sigma = float(problem.noise.covariance.diagonal(dim1=-2, dim2=-1).min().sqrt())
    meaningful = at_optimum and problem.certified and not problem.reduced
    end_residual = problem.end_residual(run.deformation) if meaningful else 0.0
    excess = max(run.error / (MAX_STEP_ERROR_RATIO * sigma), end_residual / MAX_END_RESIDUAL)
    if excess <= 1.0 or integrator == FINEST_INTEGRATOR:
        return integrator, run
    if integrator == RK4(1) and excess <= MAX_EXCESS_FOR_TWO_STEPS:
        return RK4(2), run
    return integrator.refined() if isinstance(integrator, RK8) else RK8(1), run


MOST_HALVINGS = 6  # of the way from the start of a fit to momenta whose flows overflow with finer time steps
SAMPLE_COORDINATES = 8000
"""Measured coordinates of the random rows that stand for all rows where these are many: in the choice of control
points, and in the fit that starts the fit of all rows."""


def sample(problem: Problem) -> Tensor | None:
    """Sorted numbers of random rows that stand for all rows of a problem; None if there are fewer."""
    count = max(1, SAMPLE_COORDINATES // problem.y.shape[1])
    if len(problem.x) <= count:
        return None
    drawn = torch.randperm(len(problem.x), generator=seeded(0), device=HOST)[:count]
    return drawn.sort().values.to(problem.x.device)


def choose_controls(problem: Problem, count: int) -> Tensor:
    """Row numbers of the measured configurations that carry momenta, in increasing order: (M,).

    The rows are the pivots of a randomly pivoted Cholesky factorisation of the tangent model's covariance G, of a
    sample of the rows if there are many and the sample is larger than ``count``.

    Args:
        problem: a problem with N data.
        count: M, from 1 to N.

    Raises:
        InputError: ``count`` is out of range.
    """
    if not 1 <= count <= len(problem.x):
        expected = f"1 to {len(problem.x)}, the number of measured configurations"
        raise InputError.of("`controls`", expected=expected, got=count)
    at_rest = problem.with_controls(problem.x[:1])  # one control without momentum, so that flows are the identity
    rows = sample(problem)
    if rows is None or len(rows) <= count:
        rows = torch.arange(len(problem.x), device=problem.x.device)
    tangent = at_rest.deform(at_rest.zero(), RK4(1)).linearise(problem.x[rows])
    return rows[pivots(tangent, count)].sort().values
