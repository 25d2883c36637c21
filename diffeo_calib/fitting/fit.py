"""`fit`: one entry for every formulation, solver and integrator."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral
from typing import Literal, Protocol, get_args

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_finite
from diffeo_calib.common.errors import InputError, NumericalError, sentence
from diffeo_calib.fitting.control_points import choose_controls
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.lbfgs import LBFGS
from diffeo_calib.fitting.objective import Objective
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import END_RESIDUAL, Fit, Progress, Solution, certify, silent, step_error
from diffeo_calib.flows.integrators import RK4, RK8, Integrator
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.maps.deformation import Momenta

Formulation = Literal["exact", "eulerian"]

STEP_ERROR = 0.01
"""Largest time-stepping error that is accepted when steps are chosen, in units of the noise."""
FINEST = RK8(8)
"""The finest time stepping that is chosen."""
TWO_STEPS = 8.0
"""Largest error of one RK4 step, in units of what is accepted, that two steps are trusted to cure (order 4: 16)."""
LOOK = 4
"""Iterations of Gauss-Newton after which the momenta are good enough to choose the steps for the others."""
START_STEPS = RK4(2)
"""For the start of a coarse model."""


class Solver(Protocol):
    """A minimiser of a problem's energy."""

    @property
    def integrator(self) -> Integrator | None:
        """Time stepping, where :func:`fit` is not given any."""
        ...

    def solve(
        self, problem: Objective, integrator: Integrator, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Minimise the energy from ``start``."""
        ...


def fit(
    problem: Problem,
    solver: Solver | None = None,
    integrator: Integrator | None = None,
    *,
    controls: object = None,
    backend: Backend = "auto",
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
        controls: a coarse model for many measurements: how many configurations carry momenta (chosen among x by
            pivoted Cholesky factorisation of the prior covariance), or which (M, n). All by default.
        backend: of the kernel sums: "dense", "tiled", "keops", or "auto" by size and device.
        start: initial momenta; the solver's own start by default.
        progress: called as ``progress(task, done, total)``.
        formulation: "exact", or "eulerian": the paper's own equations (16)-(20), which follow k, P and Dk at fixed
            points and are approximate however small the time steps; kept for comparison.
        errata: of the Eulerian formulation, what stays as printed: ``printed_sign=True``, ``printed_jacobian``,
            ``printed_divergence``, see :class:`diffeo_calib.paper.eulerian_flow.Eulerian`.

    Returns:
        a :class:`Fit`; look at ``status``, ``coupling_residual`` and ``end_residual``.

    Raises:
        InputError: unknown backend, formulation or erratum, controls that do not fit, two different integrators, a
            solver that does not know the formulation, or more memory needed than is free.
        NumericalError: the linear algebra broke down (noise too small for the kernels).
    """
    solver = solver if solver is not None else (LBFGS() if formulation == "eulerian" else GaussNewton())
    _check_arguments(problem, solver, integrator, start)
    integrator = _one_integrator(integrator, solver.integrator)
    problem = problem.using(backend)
    begin = time.perf_counter()
    if isinstance(controls, Integral) and not isinstance(controls, bool):
        rows = choose_controls(problem, int(controls))
        few = problem.subset(rows)
        problem = problem.with_controls(problem.x[rows])
        if start is None and problem.reduced and formulation == "exact":
            # The exact model of the control points' own data is a start from which the coarse model converges.
            own = solver.solve(few, integrator or START_STEPS, None, progress)
            if own.interrupted:
                return certify(problem, problem, own, integrator or START_STEPS, time.perf_counter() - begin)
            start = own.momenta
    elif controls is not None:
        problem = problem.with_controls(controls)
    objective = formulate(problem, formulation, errata)
    if start is not None:
        _check_start(start, objective)
    if integrator is not None:
        solution = solver.solve(objective, integrator, start, progress)
    else:
        solution, integrator = _with_chosen_steps(objective, solver, start, progress)
    return certify(problem, objective, solution, integrator, time.perf_counter() - begin)


def formulate(problem: Problem, formulation: str, errata: Mapping[str, object]) -> Objective:
    """The problem in a formulation by name.

    Raises:
        InputError: an unknown name, unknown errata, errata of the exact formulation, or fewer control points than data
            in the Eulerian one.
    """
    if formulation not in get_args(Formulation):
        raise InputError(sentence("`formulation`", expected='"exact" or "eulerian"', got=repr(formulation)))
    if formulation == "eulerian":
        from diffeo_calib.paper.eulerian_problem import EulerianProblem  # noqa: PLC0415  # the one way up, see README

        return EulerianProblem.with_errata(problem, errata)
    if errata:
        fix = 'leave them out, or pass formulation="eulerian"'
        raise InputError(sentence("errata of the exact formulation", expected="none", got=", ".join(errata), fix=fix))
    return problem


def _one_integrator(given: Integrator | None, own: Integrator | None) -> Integrator | None:
    if given is not None and own is not None and given != own:
        raise InputError(
            sentence(
                "`integrator`", expected="the same for `fit` and its solver", got=f"{given} and {own}", fix="pass one"
            )
        )
    return own if given is None else given


def _check_arguments(problem: object, solver: object, integrator: object, start: object) -> None:
    """Raise InputError for arguments of the wrong kind, a class in place of an object among them."""
    if not isinstance(problem, Problem):
        raise InputError(sentence("`problem`", expected="a dc.Problem", got=type(problem).__name__))
    if isinstance(solver, type) or not hasattr(solver, "solve"):
        raise InputError(
            sentence("`solver`", expected="dc.GaussNewton(), dc.LBFGS() or dc.GradientDescent(step)", got=repr(solver))
        )
    for given in (integrator, getattr(solver, "integrator", None)):
        if given is not None and not isinstance(given, Integrator):
            expected = "dc.RK4(2), dc.RK8(1) or dc.TorchDiffEq(...)"
            raise InputError(sentence("`integrator`", expected=expected, got=repr(given)))
    if start is not None and not isinstance(start, Momenta):
        fix = "pass `fit.momenta`"
        raise InputError(sentence("`start`", expected="momenta", got=type(start).__name__, fix=fix))


def _check_start(start: Momenta, problem: Objective) -> None:
    for tensor in start.tensors:
        if not isinstance(tensor, Tensor) or tensor.dtype != torch.float64:
            raise InputError(sentence("the momenta of `start`", expected="float64 tensors", got=repr(tensor)[:60]))
    got, expected = ([tuple(t.shape) for t in momenta.tensors] for momenta in (start, problem.zero()))
    if got != expected:
        fix = "start from a fit with the same control points and formulation"
        raise InputError(sentence("the momenta of `start`", expected=f"shapes {expected}", got=got, fix=fix))
    for tensor in start.tensors:
        check_finite(tensor, "start")


def _with_chosen_steps(
    problem: Objective, solver: Solver, start: Momenta | None, progress: Progress
) -> tuple[Solution, Integrator]:
    integrator: Integrator = RK4(2) if problem.reduced else RK4(1)
    if start is not None:
        integrator = _enough_steps(problem, start, integrator, at_optimum=False)
    first, looking = solver, False
    if start is None and isinstance(solver, GaussNewton) and solver.max_iterations > LOOK:
        first, looking = replace(solver, max_iterations=LOOK), True
    solution = first.solve(problem, integrator, start, progress)
    while True:
        # Short of the optimum the end condition is violated anyway: that says nothing about the steps.
        wanted = _enough_steps(problem, solution.momenta, integrator, at_optimum=not solution.exhausted)
        if solution.interrupted or (wanted == integrator and not (looking and solution.exhausted)):
            return solution, integrator
        looking, integrator = False, wanted
        solution = solver.solve(problem, integrator, solution.momenta, progress)


def _enough_steps(problem: Objective, momenta: Momenta, integrator: Integrator, *, at_optimum: bool) -> Integrator:
    """The same method if its errors at these momenta are small enough, else a finer one."""
    try:
        deformation = problem.deform(momenta, integrator)
    except NumericalError:  # these steps are so long that the flows overflow
        return FINEST
    sigma = float(problem.noise.covariance.diagonal(dim1=-2, dim2=-1).min().sqrt())
    proves = at_optimum and problem.certified and not problem.reduced
    end_residual = problem.end_residual(deformation) if proves else 0.0
    excess = max(step_error(problem, deformation) / (STEP_ERROR * sigma), end_residual / END_RESIDUAL)
    if excess <= 1.0 or integrator == FINEST:
        return integrator
    if integrator == RK4(1) and excess <= TWO_STEPS:
        return RK4(2)
    return integrator.refined() if isinstance(integrator, RK8) else RK8(1)
