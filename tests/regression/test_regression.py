"""The three ways to condition on the data agree; the choice between them, and the memory that they need."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from fit_bank import Offset, deformed, noise_blocks, shared_noise
from math_bank import normal, rr_problem, two_marker_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.problem import Problem, regress
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.regression import choose, control_points
from diffeo_calib.regression import conjugate_gradients as iterative
from diffeo_calib.regression.cholesky import CholeskyRegression
from diffeo_calib.regression.conjugate_gradients import ConjugateGradientRegression, partial_cholesky, pivots
from diffeo_calib.regression.control_points import ControlPointRegression
from diffeo_calib.robots import elastic_rr


def hidden_blocks() -> Tensor:
    """Blocks of noise in which one of two markers was not measured in some rows."""
    visible = torch.ones(15, 4, dtype=torch.bool)
    visible[2:6, :2], visible[9:, 2:] = False, False
    return without_hidden(noise_blocks(15, 4, 1e-4), visible)


PROBLEMS = {
    "rr": rr_problem(5),
    "two markers": two_marker_problem(uniform(15, 2, seed=3)),
    "noise blocks": two_marker_problem(uniform(15, 2, seed=3), noise_blocks(15, 4, 1e-4)),
    "hidden": two_marker_problem(uniform(15, 2, seed=3), hidden_blocks()),
    "shared shifts": two_marker_problem(uniform(15, 2, seed=3), shared_noise(15, 4)),
}


every_problem = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS.keys())


Way = Callable[[Problem, GeodesicDeformation], Any]
WAYS: dict[str, Way] = {
    "iterative": lambda problem, at: ConjugateGradientRegression(at.linearise(), problem.noise),
    "iterative, poor preconditioner": lambda problem, at: ConjugateGradientRegression(
        at.linearise(), problem.noise, rank=4
    ),
    "reduced": lambda problem, at: ControlPointRegression(at, problem.x, problem.noise),
}


every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


@every_problem
def test_product_with_parameters(problem: Problem) -> None:
    """For a nominal map with theta, the product includes the finite-rank part."""
    lin = deformed(problem).linearise()
    m = problem.y.shape[1]
    sensitivity = normal(len(problem.x), m, 3, seed=5)
    model = replace(problem.spec, prior_variance=torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64))
    lin = replace(lin, spec=model, sensitivity=sensitivity)
    mu = normal(*problem.y.shape, 2, seed=6)
    torch.testing.assert_close(lin.product(mu).flatten(0, 1), lin.gram() @ mu.flatten(0, 1), rtol=1e-11, atol=1e-11)


@pytest.mark.slow
@every_way
@every_problem
def test_same_momenta_as_the_cholesky_factor(problem: Problem, way: Way) -> None:
    """Compared by their effect at the data, since flat directions of the momenta are rounding errors."""
    at = deformed(problem)
    expected = regress(problem, at, "cholesky")
    actual = way(problem, at).momenta(expected.target)
    reduced = ControlPointRegression(at, problem.x, problem.noise)
    wanted = reduced.response(expected.momenta())
    torch.testing.assert_close(reduced.response(actual), wanted, rtol=1e-5, atol=1e-6 * float(wanted.abs().max()))


@pytest.mark.parametrize("wide", [1.0, 100.0])
@every_problem
def test_covariance_of_a_large_problem(problem: Problem, wide: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the factor alone: exact if F explains all of G, without cancellation beside a parameter with a wide prior."""
    at, model = deformed(problem), replace(problem.spec, prior_variance=torch.tensor([wide], dtype=torch.float64))
    data, queries = (
        replace(lin, spec=model, sensitivity=torch.ones(*lin.sensitivity.shape[:2], 1, dtype=torch.float64))
        for lin in (at.linearise(), at.linearise(uniform(6, 2, seed=20)))
    )
    expected = CholeskyRegression(data, problem.noise).covariance(queries)
    monkeypatch.setattr(iterative, "NEGLIGIBLE_VARIANCE_RATIO", 1e-9)
    scale = float(expected.abs().max())
    actual = ConjugateGradientRegression(data, problem.noise).covariance(queries)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5 * scale)
    monkeypatch.setattr(iterative, "NEGLIGIBLE_VARIANCE_RATIO", 0.03)
    noise = float(problem.noise.covariance.diagonal(dim1=1, dim2=2).mean())
    rough = ConjugateGradientRegression(data, problem.noise).covariance(queries)
    assert float((rough - expected).diagonal(dim1=1, dim2=2).abs().max()) < noise


@every_problem
def test_the_rest_of_a_partial_cholesky_factor_is_its_residual(problem: Problem) -> None:
    lin = deformed(problem).linearise()
    gram = lin.gram()
    for rank in (4, 12, gram.shape[0]):
        factor, rest, _ = partial_cholesky(lin, 0.0, -(-rank // problem.y.shape[1]))
        assert factor.shape[1] <= rank + problem.y.shape[1]
        gap = gram - factor @ factor.T
        torch.testing.assert_close(gap.diagonal().clamp(min=0), rest, rtol=0, atol=1e-8 * float(gram.diagonal().max()))
        assert float(torch.linalg.eigvalsh(gap).min()) >= -1e-9 * float(gram.diagonal().max())


def test_partial_cholesky_stops_when_enough_is_explained() -> None:
    lin = deformed(PROBLEMS["rr"]).linearise()
    total = float(lin.gram().diagonal().sum())
    ranks = [partial_cholesky(lin, fraction * total, 1000)[0].shape[1] for fraction in (2.0, 1e-1, 1e-6)]
    assert ranks[0] == 0
    assert ranks == sorted(ranks)


def test_pivots_are_different_configurations_and_repeatable() -> None:
    lin = deformed(PROBLEMS["rr"]).linearise()
    for count in (1, 10, 25):
        chosen = pivots(lin, count)
        assert len(set(chosen.tolist())) == count
        assert bool((chosen == pivots(lin, count)).all())


@every_way
def test_parameters_of_the_nominal_map(way: Way, monkeypatch: pytest.MonkeyPatch) -> None:
    """theta and its covariance by every method, for prior variances that differ from each other and from 1."""
    monkeypatch.setattr(iterative, "NEGLIGIBLE_VARIANCE_RATIO", 1e-9)
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
    if way is not WAYS["iterative, poor preconditioner"]:  # whose covariances are larger
        torch.testing.assert_close(conditional.covariance(queries), expected, rtol=1e-5, atol=1e-10)


def test_conjugate_gradients_that_cannot_converge_say_so() -> None:
    problem = rr_problem(5, noise=1e-9)
    at = deformed(problem)
    with pytest.raises(NumericalError, match="conjugate gradients did not converge"):
        ConjugateGradientRegression(at.linearise(), problem.noise, rank=2).solve(normal(25, 2, 1, seed=1))


def test_unknown_free_memory_refuses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose, "free_memory", lambda: None)
    choose.check_memory(10**18, "nothing")


def test_auto_takes_conjugate_gradients_for_large_problems() -> None:
    assert choose.choose("auto", choose.MAX_DENSE) == "cholesky"
    assert choose.choose("auto", choose.MAX_DENSE + 1) == "cg"
    assert choose.predicted_memory("cg", 100_000) < choose.predicted_memory("cholesky", 100_000) / 30
    with pytest.raises(InputError, match="`linear`: expected auto, cholesky, cg, got 'lu'"):
        dc.fit(PROBLEMS["rr"], dc.GaussNewton(linear="lu"), dc.RK4(1))  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
@every_problem
def test_control_points_in_many_blocks_of_data(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """One row per block or all rows at once, one pass over the data or two: the same optimum."""
    at = deformed(problem)
    whole = ControlPointRegression(at, problem.x, problem.noise)
    target = problem.y - at.z1 + whole.response(at.momenta)
    monkeypatch.setattr(control_points, "BLOCK_ENTRIES", 1)
    each = ControlPointRegression(at, problem.x, problem.noise, residual=problem.residual)
    torch.testing.assert_close(each.core, whole.core, rtol=1e-8, atol=1e-9)
    wanted = whole.response(whole.momenta(target))
    for found in (each.mode()[0], each.momenta(target)):
        torch.testing.assert_close(whole.response(found), wanted, rtol=1e-6, atol=1e-8 * float(wanted.abs().max()))


def test_the_mode_needs_a_residual() -> None:
    problem = PROBLEMS["rr"]
    with pytest.raises(InputError, match="the mode of control points: expected their data's residual"):
        ControlPointRegression(deformed(problem), problem.x, problem.noise).mode()


@pytest.mark.parametrize("way", ["iterative", "reduced", "cholesky"])
def test_shifts_that_rows_share_are_parameters(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """cov(c) = (1 + Z^T (G + R)^-1 Z)^-1, with R the noise of the rows alone, and none with what knows nothing of c."""
    monkeypatch.setattr(iterative, "NEGLIGIBLE_VARIANCE_RATIO", 1e-9)
    problem = PROBLEMS["shared shifts"]
    at, Z = deformed(problem), problem.noise.shared.flatten(0, 1)
    lin, (m, c) = at.linearise(), problem.noise.shared.shape[1:]
    conditional = CholeskyRegression(lin, problem.noise) if way == "cholesky" else WAYS[way](problem, at)
    nothing = lin.rows(torch.tensor([0])).projected(torch.zeros(1, c, m, dtype=torch.float64))
    K = lin.sensitivity.shape[2]
    shifts = replace(nothing, sensitivity=torch.eye(K + c, dtype=torch.float64)[None, K:])
    alone = lin.gram() + torch.block_diag(*problem.noise.covariance)
    expected = torch.linalg.inv(torch.eye(c, dtype=torch.float64) + Z.T @ torch.linalg.solve(alone, Z))
    torch.testing.assert_close(conditional.posterior(shifts)[0], expected, rtol=1e-3, atol=1e-9)
