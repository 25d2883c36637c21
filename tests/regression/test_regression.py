"""Three ways to condition on the data agree; control points; memory is predicted before it is taken."""

from collections.abc import Callable
from dataclasses import replace
from math import nan, pi
from typing import Any

import numpy as np
import pytest
import torch
from math_bank import few_points, normal, rr_problem, spatial_markers, two_marker_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.control_points import choose_controls
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.tangent import regress
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.nominal import SmoothMap
from diffeo_calib.regression import choose
from diffeo_calib.regression import conjugate_gradients as iterative
from diffeo_calib.regression.cholesky import factorise
from diffeo_calib.regression.conditional import Conditional
from diffeo_calib.regression.conjugate_gradients import ConjugateGradientRegression, partial_cholesky, pivots
from diffeo_calib.regression.control_points import ControlPointRegression
from diffeo_calib.robots import elastic_rr


def noise_blocks(count: int, m: int) -> Tensor:
    root = 0.01 * normal(count, m, m, seed=11)
    return root @ root.mT + 1e-4 * torch.eye(m, dtype=torch.float64)


PROBLEMS = {
    "rr": rr_problem(5),
    "two markers": two_marker_problem(uniform(15, 2, seed=3)),
    "noise blocks": two_marker_problem(uniform(15, 2, seed=3), noise_blocks(15, 4)),
}
every_problem = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS.keys())
WAYS: dict[str, Callable[[Problem, GeodesicDeformation], Conditional]] = {
    "iterative": lambda problem, at: ConjugateGradientRegression(at.linearise(), problem.noise),
    "iterative, poor preconditioner": lambda problem, at: ConjugateGradientRegression(
        at.linearise(), problem.noise, rank=4
    ),
    "reduced": lambda problem, at: ControlPointRegression(at, at.linearise(problem.x), problem.noise),
}
every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


def around(problem: Problem) -> GeodesicDeformation:
    """A deformation of a few percent."""
    zero = problem.zero()
    return problem.deform(zero.unflatten(0.02 * normal(zero.flatten().numel(), seed=12)), dc.RK4(2))


@every_problem
def test_product_is_the_matrix_times_vectors(problem: Problem) -> None:
    lin = around(problem).linearise()
    mu = normal(*problem.y.shape, 3, seed=4)
    torch.testing.assert_close(lin.product(mu).flatten(0, 1), lin.gram() @ mu.flatten(0, 1), rtol=1e-11, atol=1e-11)


@every_problem
def test_product_with_parameters(problem: Problem) -> None:
    """A nominal map with theta: the finite-rank part is in the product too."""
    lin = around(problem).linearise()
    m = problem.y.shape[1]
    sensitivity = normal(len(problem.x), m, 3, seed=5)
    model = replace(problem.spec, prior_variance=torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64))
    lin = replace(lin, spec=model, sensitivity=sensitivity)
    mu = normal(*problem.y.shape, 2, seed=6)
    torch.testing.assert_close(lin.product(mu).flatten(0, 1), lin.gram() @ mu.flatten(0, 1), rtol=1e-11, atol=1e-11)


@every_problem
def test_linearisation_of_some_rows(problem: Problem) -> None:
    lin, rows, m = around(problem).linearise(), torch.tensor([3, 1, 7]), problem.y.shape[1]
    index = (rows[:, None] * m + torch.arange(m)).flatten()
    torch.testing.assert_close(lin.rows(rows).gram(lin), lin.gram()[index], rtol=0, atol=1e-13)


@pytest.mark.slow
@every_way
@every_problem
def test_same_momenta_as_the_cholesky_factor(
    problem: Problem, way: Callable[[Problem, GeodesicDeformation], Conditional]
) -> None:
    """Compared by what they do to the data: flat directions of the momenta are rounding errors."""
    at = around(problem)
    expected = regress(problem, at, "cholesky")
    actual = way(problem, at).momenta(expected.target)
    reduced = ControlPointRegression(at, at.linearise(problem.x), problem.noise)
    wanted = reduced.response(expected.momenta())
    torch.testing.assert_close(reduced.response(actual), wanted, rtol=1e-5, atol=1e-6 * float(wanted.abs().max()))


@every_way
@every_problem
def test_same_covariance_as_the_cholesky_factor(
    problem: Problem, way: Callable[[Problem, GeodesicDeformation], Conditional]
) -> None:
    at = around(problem)
    queries = at.linearise(uniform(6, 2, seed=20))
    expected = factorise(at.linearise(), problem.noise).covariance(queries)
    actual = way(problem, at).covariance(queries)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-6 * float(expected.abs().max()) + 1e-9)


@pytest.mark.parametrize("wide", [1.0, 100.0])
@every_problem
def test_covariance_of_a_large_problem(problem: Problem, wide: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the factor alone: exact if it explains all, and nothing cancels beside a parameter with a wide prior."""
    at, model = around(problem), replace(problem.spec, prior_variance=torch.tensor([wide], dtype=torch.float64))
    data, queries = (
        replace(lin, spec=model, sensitivity=torch.ones(*lin.sensitivity.shape[:2], 1, dtype=torch.float64))
        for lin in (at.linearise(), at.linearise(uniform(6, 2, seed=20)))
    )
    expected = factorise(data, problem.noise).covariance(queries)
    monkeypatch.setattr(iterative, "MOST_EXACT", 0)
    monkeypatch.setattr(iterative, "NEGLIGIBLE", 1e-9)
    scale = float(expected.abs().max())
    actual = ConjugateGradientRegression(data, problem.noise).covariance(queries)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5 * scale)
    monkeypatch.setattr(iterative, "NEGLIGIBLE", 0.03)
    noise = float(problem.noise.covariance.diagonal(dim1=1, dim2=2).mean())
    rough = ConjugateGradientRegression(data, problem.noise).covariance(queries)
    assert float((rough - expected).diagonal(dim1=1, dim2=2).abs().max()) < noise


@every_problem
def test_partial_cholesky_explains_all_that_it_says(problem: Problem) -> None:
    lin = around(problem).linearise()
    gram = lin.gram()
    for rank in (4, 12, gram.shape[0]):
        factor, rest = partial_cholesky(lin, 0.0, rank)
        assert factor.shape[1] <= rank + problem.y.shape[1]
        gap = gram - factor @ factor.T
        torch.testing.assert_close(gap.diagonal().clamp(min=0), rest, rtol=0, atol=1e-8 * float(gram.diagonal().max()))
        assert float(torch.linalg.eigvalsh(gap).min()) >= -1e-9 * float(gram.diagonal().max())


def test_partial_cholesky_stops_when_enough_is_explained() -> None:
    lin = around(PROBLEMS["rr"]).linearise()
    total = float(lin.gram().diagonal().sum())
    ranks = [partial_cholesky(lin, fraction * total, 1000)[0].shape[1] for fraction in (2.0, 1e-1, 1e-6)]
    assert ranks[0] == 0
    assert ranks == sorted(ranks)


def test_pivots_are_different_configurations_and_repeatable() -> None:
    lin = around(PROBLEMS["rr"]).linearise()
    for count in (1, 10, 25):
        chosen = pivots(lin, count)
        assert len(set(chosen.tolist())) == count
        assert bool((chosen == pivots(lin, count)).all())


class Offset(SmoothMap):
    """The RR arm with two unknown offsets of its tip."""

    parameters = 2

    def __init__(self) -> None:
        super().__init__(elastic_rr.nominal)

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        return super().__call__(x, theta) + theta

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        return torch.eye(2, dtype=x.dtype).expand(len(x), 2, 2)


@every_way
def test_parameters_of_the_nominal_map(way: Callable[[Problem, GeodesicDeformation], Conditional]) -> None:
    """theta and the covariance with it, in every way; its prior variances are neither equal nor 1."""
    x = uniform(20, 2, seed=3)
    kernels = {"joint_kernel": dc.VonMises(1.0, 0.01), "task_kernel": dc.Gaussian(0.7, 0.01)}
    y = elastic_rr.real(x)
    problem = Problem(Offset(), x, y, noise=0.01, prior_variance=(0.04, 0.0009), **kernels)  # pyright: ignore[reportArgumentType]
    at = problem.deform(problem.zero(), dc.RK4(1))
    exact = regress(problem, at, "cholesky")
    conditional = way(problem, at)
    torch.testing.assert_close(conditional.momenta(exact.target).theta, exact.momenta().theta, rtol=1e-6, atol=1e-9)
    queries = at.linearise(uniform(4, 2, seed=5))
    expected = exact.conditional.covariance(queries)
    torch.testing.assert_close(conditional.covariance(queries), expected, rtol=1e-5, atol=1e-10)


# --- fits ------------------------------------------------------------------------------------------


def test_conjugate_gradients_find_the_same_optimum() -> None:
    problem = rr_problem(6)
    fits = [dc.fit(problem, dc.GaussNewton(linear=linear), dc.RK4(4)) for linear in ("cholesky", "cg")]
    assert fits[1].converged
    assert fits[1].coupling_residual <= 1e-6
    assert fits[1].energy == pytest.approx(fits[0].energy, rel=1e-9)
    x = uniform(50, 2, seed=1)
    torch.testing.assert_close(fits[1].model(x), fits[0].model(x), rtol=0, atol=1e-7)


def test_control_points_that_are_the_data_change_nothing() -> None:
    problem = rr_problem(6)
    full, same = (dc.fit(problem, integrator=dc.RK4(4), controls=c) for c in (None, problem.x.clone()))
    assert same.energy == pytest.approx(full.energy, rel=1e-7)


@pytest.mark.slow
def test_few_control_points_fit_many_data() -> None:
    """100 of 256 controls: held-out error between that of 100 and that of 256 measurements, and L-BFGS agrees."""
    problem = rr_problem(16)
    x = uniform(300, 2, seed=2)
    fit = dc.fit(problem, integrator=dc.RK4(2), controls=100)
    assert fit.converged
    assert len(fit.model.deformation.x) == 100
    assert fit.model.x is problem.x
    nominal, fitted = ((y - elastic_rr.real(x)).norm(dim=1).mean() for y in (elastic_rr.nominal(x), fit.model(x)))
    assert float(fitted) <= 1e-4 * float(nominal)
    solver = dc.LBFGS(max_iterations=20)
    after = dc.fit(problem, solver, dc.RK4(2), controls=fit.problem.controls, start=fit.momenta)
    assert fit.energy * (1 - 1e-6) <= after.energy <= fit.energy


def test_the_covariance_of_a_coarse_model_is_no_smaller_than_that_of_the_full_one() -> None:
    problem = rr_problem(8)
    x = uniform(10, 2, seed=5)
    full, coarse = (dc.fit(problem, integrator=dc.RK4(2), controls=c).model for c in (None, 40))
    wide, narrow = (torch.diagonal(m.predict(x, noise=False)[1], dim1=1, dim2=2) for m in (coarse, full))
    assert bool((wide >= -1e-9).all())
    assert float((wide - narrow).min()) >= -0.2 * float(narrow.max())


def test_interrupting_the_start_of_a_coarse_fit_keeps_it() -> None:
    def stop(task: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    fit = dc.fit(rr_problem(6), integrator=dc.RK4(1), controls=20, progress=stop)
    assert fit.solution.interrupted
    assert len(fit.model.deformation.x) == 20
    assert "interrupted after 2 iterations" in fit.status


def test_a_start_of_another_size_is_refused() -> None:
    problem = rr_problem(5)
    with pytest.raises(InputError, match=r"the momenta of `start`: expected shapes .*\(20, 2\).*got .*\(25, 2\)"):
        dc.fit(problem, controls=20, start=problem.zero())


def test_conjugate_gradients_that_cannot_converge_say_so() -> None:
    problem = rr_problem(5, noise=1e-9)
    at = around(problem)
    with pytest.raises(NumericalError, match="conjugate gradients did not converge"):
        ConjugateGradientRegression(at.linearise(), problem.noise, rank=2).solve(normal(25, 2, 1, seed=1))


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        (0, "`controls`: expected 1 to 25"),
        (26, "`controls`: expected 1 to 25"),
        (torch.zeros(3, 3), r"`controls` has the wrong shape.*pass configurations of 2 joints"),
        (torch.full((3, 2), float("nan")), "`controls` has 6 value"),
        ("all", "`controls` cannot be read as numbers"),
        (True, r"`controls` has the wrong shape"),
    ],
)
def test_control_points_that_cannot_be(controls: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        dc.fit(PROBLEMS["rr"], controls=controls)


def test_choice_of_control_points_covers_the_workspace() -> None:
    problem = rr_problem(10)
    rows = choose_controls(problem, 30)
    assert len(set(rows.tolist())) == 30
    turn = problem.x[:, None, :] - problem.x[rows][None]
    gap = (2 - 2 * turn.cos()).sum(-1).amin(1).sqrt()
    assert float(gap.max()) <= 1.6  # chord to the nearest control; the grid's own spacing is 0.62


# --- memory ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("linear", "controls"), [("cholesky", None), ("cg", None), ("auto", 5)])
def test_memory_that_is_not_there_is_refused(
    monkeypatch: pytest.MonkeyPatch, linear: choose.LinearSolver, controls: int | None
) -> None:
    monkeypatch.setattr(choose, "free_memory", lambda: 2**10)
    with pytest.raises(InputError, match=r"more memory than is free: expected [\d.]+ GiB, got 0\.0 GiB free"):
        dc.fit(PROBLEMS["rr"], dc.GaussNewton(linear=linear), dc.RK4(1), controls=controls)


def test_unknown_free_memory_refuses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose, "free_memory", lambda: None)
    choose.check_memory(10**18, "nothing")


def test_auto_takes_conjugate_gradients_for_large_problems() -> None:
    assert choose.choose("auto", choose.MAX_DENSE) == "cholesky"
    assert choose.choose("auto", choose.MAX_DENSE + 1) == "cg"
    assert choose.predicted_memory("cg", 100_000) < choose.predicted_memory("cholesky", 100_000) / 30
    with pytest.raises(InputError, match="`linear`: expected auto, cholesky, cg, got 'lu'"):
        dc.fit(PROBLEMS["rr"], dc.GaussNewton(linear="lu"), dc.RK4(1))  # pyright: ignore[reportArgumentType]


def test_free_memory_is_a_plausible_number() -> None:
    free = choose.free_memory()
    assert free is None or 2**20 < free < 2**50


# --- what a fit says about how it was run ------------------------------------------------------------


def test_backend_is_an_argument_and_shown() -> None:
    problem = rr_problem(4)
    fits = {name: dc.fit(problem, integrator=dc.RK4(1), backend=name) for name in ("dense", "tiled", "auto")}
    assert fits["dense"].backend == ("dense", "dense")
    assert fits["tiled"].backend == ("tiled", "tiled")
    assert fits["auto"].backend == ("dense", "dense")
    torch.testing.assert_close(fits["tiled"].energy, fits["dense"].energy, rtol=1e-8, atol=0)
    with pytest.raises(InputError, match="`backend`: expected auto, dense, tiled, keops, got 'gpu'"):
        dc.fit(problem, backend="gpu")  # pyright: ignore[reportArgumentType]


def test_integrator_of_the_solver() -> None:
    problem = rr_problem(4)
    own = dc.TorchDiffEq("rk4", step_size=0.5)
    assert dc.fit(problem, dc.GaussNewton(integrator=own)).integrator == own
    assert dc.fit(problem, dc.GaussNewton(integrator=own), own).integrator == own
    with pytest.raises(InputError, match="`integrator`: expected the same for `fit` and its solver"):
        dc.fit(problem, dc.GaussNewton(integrator=own), dc.RK4(2))


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator",
    [
        dc.TorchDiffEq("rk4", step_size=0.25),
        dc.TorchDiffEq("rk4", adjoint=True, step_size=0.25),
        dc.TorchDiffEq("dopri5", step_size=0.5, rtol=1e-6, atol=1e-9),
        dc.TorchDiffEq("dopri5", adjoint=True, step_size=0.5, rtol=1e-6, atol=1e-9),
    ],
    ids=lambda i: f"{i.method}-{i.adjoint}",
)
def test_every_solver_with_every_integrator_finds_the_optimum(integrator: dc.TorchDiffEq) -> None:
    problem = few_points()
    best = dc.fit(problem, integrator=dc.RK4(8)).energy
    for solver in (dc.GaussNewton(tolerance=1e-5), dc.LBFGS(tolerance=1e-6)):
        fit = dc.fit(problem, solver, integrator)
        assert fit.converged
        assert fit.energy == pytest.approx(best, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("preconditioned", [False, True])
def test_overflowing_steps_of_lbfgs_are_shortened(monkeypatch: pytest.MonkeyPatch, preconditioned: bool) -> None:
    """An evaluation whose flows overflow makes the line search turn back, and the descent goes on."""
    calls, deform = [0], Problem.deform

    def overflowing(problem: Problem, *arguments: Any, **options: Any) -> GeodesicDeformation:
        calls[0] += 1
        if calls[0] in (5, 6):
            raise NumericalError("too far")
        return deform(problem, *arguments, **options)

    problem, solver = few_points(), dc.LBFGS(preconditioned=preconditioned)
    start = problem.zero()
    start = start.unflatten(0.05 * normal(start.flatten().numel(), seed=9))
    expected = dc.fit(problem, solver, dc.RK4(2), start=start).energy
    monkeypatch.setattr(Problem, "deform", overflowing)
    fit = dc.fit(problem, solver, dc.RK4(2), start=start)
    assert calls[0] > 6
    assert fit.energy == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_preconditioning_of_lbfgs_pays() -> None:
    problem = rr_problem(8)
    plain, better = (
        dc.fit(problem, dc.LBFGS(max_iterations=40, preconditioned=p), dc.RK4(2)).energy for p in (False, True)
    )
    assert better < plain


@pytest.mark.slow
def test_a_coarse_fit_that_stops_short_of_the_optimum_says_how_to_go_on() -> None:
    """Large deformations and few control points: Gauss-Newton's step is approximate, descent goes on from there."""
    x = pi * uniform(100, 3, seed=0)

    def links(x: Tensor, lengths: tuple[float, float, float]) -> Tensor:
        angles, scale = x.cumsum(1), torch.tensor(lengths, dtype=x.dtype)
        return torch.stack([(scale * angles.cos()).sum(1), (scale * angles.sin()).sum(1)], 1)

    y = links(x + 0.02 * x.sin() + 0.01 * (2 * x).cos(), (1.02, 0.69, 0.31)) + 0.01
    kernels = {"joint_kernel": dc.VonMises((1.0,) * 3, variance=0.5), "task_kernel": dc.Gaussian(0.7)}
    problem = Problem(lambda x: links(x, (1.0, 0.7, 0.3)), x, y, noise=1e-3, **kernels)  # pyright: ignore[reportArgumentType]
    stopped = dc.fit(problem, integrator=dc.RK4(2), controls=x[::2])
    assert not stopped.converged
    assert "no step in the approximate Gauss-Newton direction" in stopped.status
    assert "dc.LBFGS() from `start=fit.momenta`" in stopped.status
    better = dc.fit(problem, dc.LBFGS(max_iterations=20), dc.RK4(2), controls=x[::2], start=stopped.momenta)
    assert better.energy < 0.9 * stopped.energy


def test_three_dimensional_markers_with_few_controls() -> None:
    x = uniform(30, 3, seed=7)
    problem = Problem(
        spatial_markers,
        x,
        spatial_markers(x) + 0.01 * normal(*spatial_markers(x).shape, seed=8),
        joint_kernel=dc.VonMises(1.0, 0.01),
        task_kernel=dc.Gaussian(1.0, 0.01),
        noise=0.01,
        markers=spatial_markers(x).shape[1] // 3,
    )
    fit = dc.fit(problem, integrator=dc.RK4(1), controls=12)
    assert fit.converged
    assert fit.model.predict(x)[1].shape == (30, problem.y.shape[1], problem.y.shape[1])


# --- arguments of the wrong kind ------------------------------------------------------------------------

WRONG: dict[str, tuple[Callable[[Problem], object], str]] = {
    "problem": (lambda p: dc.fit(p.x), "`problem`: expected a dc.Problem, got Tensor"),  # pyright: ignore[reportArgumentType]
    "solver class": (
        lambda p: dc.fit(p, dc.LBFGS),  # pyright: ignore[reportArgumentType]
        r"`solver`: expected dc.GaussNewton\(\), dc.LBFGS\(\) or dc.GradientDescent\(step\)",
    ),
    "solver name": (lambda p: dc.fit(p, "lbfgs"), "`solver`: expected .*got 'lbfgs'"),  # pyright: ignore[reportArgumentType]
    "integrator name": (lambda p: dc.fit(p, integrator="rk4"), "`integrator`: expected .*got 'rk4'"),  # pyright: ignore[reportArgumentType]
    "integrator class": (lambda p: dc.fit(p, dc.LBFGS(integrator=dc.RK4)), "`integrator`: expected"),  # pyright: ignore[reportArgumentType]
    "start": (lambda p: dc.fit(p, start=p), "`start`: expected momenta, got Problem; pass `fit.momenta`"),  # pyright: ignore[reportArgumentType]
    "start not finite": (
        lambda p: dc.fit(p, start=p.zero().unflatten(p.zero().flatten() * nan)),
        "`start` has 50 value",
    ),
    "iterations": (lambda p: dc.GaussNewton(max_iterations=-1), "`max_iterations`: expected an integer of at least 1"),
    "broken iterations": (lambda p: dc.LBFGS(max_iterations=1.5), "`max_iterations`: expected an integer"),  # pyright: ignore[reportArgumentType]
    "tolerance": (lambda p: dc.GaussNewton(tolerance=nan), "`tolerance`: expected a number above"),
    "no history": (lambda p: dc.LBFGS(history_size=0), "`history_size`: expected an integer of at least 1"),
    "preconditioned": (lambda p: dc.LBFGS(preconditioned="x"), "`preconditioned`: expected True or False"),  # pyright: ignore[reportArgumentType]
    "steps": (lambda p: dc.RK8(10**9), "`steps` of RK8: expected an integer of at least 1 and at most 1024"),
    "noise": (lambda p: two_marker_problem(p.x, 1e-160), "`noise`: expected at least 1e-100 m, got 1e-160"),
}


@pytest.mark.parametrize(("call", "message"), WRONG.values(), ids=WRONG.keys())
def test_arguments_of_the_wrong_kind_are_one_sentence(call: Callable[[Problem], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(PROBLEMS["rr"])


def test_numbers_of_controls_of_numpy_are_numbers() -> None:
    assert len(dc.fit(PROBLEMS["rr"], integrator=dc.RK4(1), controls=np.int64(20)).model.deformation.x) == 20


def test_a_solver_at_its_limit_is_not_run_again_with_finer_steps() -> None:
    """Short of the optimum the end residual says nothing about the time steps."""
    fit = dc.fit(rr_problem(4, noise=0.1), dc.LBFGS(max_iterations=5))
    assert fit.integrator.intervals <= 2
    assert "limit of 5 iterations" in fit.status
