"""Posterior covariances against the formula written out with dense matrices, in every way to condition on the data.

The reference adds up G from the kernels' full matrices, for every node and marker.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from fit_bank import deformed, noise_blocks
from math_bank import normal, rr_problem, two_marker_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.device import HOST
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.regression import conditional, conjugate_gradients
from diffeo_calib.regression.cholesky import CholeskyRegression
from diffeo_calib.regression.conditional import Conditional
from diffeo_calib.regression.conjugate_gradients import ConjugateGradientRegression
from diffeo_calib.regression.control_points import ControlPointRegression


class MatrixOnly(Kernel):
    """A user's kernel with correlated components: exp(-|x - y|^2 / (2 s^2)) A, given by its matrix alone."""

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        kappa = (-(x[:, None] - y[None]).square().sum(-1) / (2 * 0.8**2)).exp()
        A = torch.tensor([[1.0, 0.4], [0.4, 0.7]], dtype=x.dtype, device=x.device)
        return torch.kron(kappa.contiguous(), A)


KERNELS: dict[str, Kernel] = {
    "one": dc.Gaussian(0.7, 0.01),
    "sum": dc.Gaussian(0.7, [0.01, 0.02]) + dc.Matern(0.9, 2.5, 0.03),
    "own": MatrixOnly(),
    "own and closed": MatrixOnly() + dc.Gaussian(0.7, 0.01) + dc.Matern(0.9, 2.5, 0.03),
    "vanishing": dc.Gaussian(0.7, 0.0),
    "vanishing sum": dc.Gaussian(0.7, 0.0) + dc.Matern(0.9, 2.5, 0.0),
}
every_kernel = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS.keys())

PROBLEMS = {
    "rr": rr_problem(5, noise=1e-3),
    "two markers": two_marker_problem(uniform(15, 2, seed=3)),
    "noise blocks": two_marker_problem(uniform(15, 2, seed=3), noise_blocks(15, 4, 1e-4)),
}
every_problem = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS.keys())

WAYS: dict[str, Callable[[Problem, GeodesicDeformation], Conditional]] = {
    "cholesky": lambda problem, at: CholeskyRegression(at.linearise(), problem.noise),
    "iterative": lambda problem, at: ConjugateGradientRegression(at.linearise(), problem.noise),
    "reduced": lambda problem, at: ControlPointRegression(at, problem.x, problem.noise),
}


@pytest.fixture(autouse=True)
def fields_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    """The factor of conjugate gradients explains all of the fields."""
    monkeypatch.setattr(conjugate_gradients, "NEGLIGIBLE_VARIANCE_RATIO", 1e-12)


every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


def naive_gram(a: Linearisation, b: Linearisation) -> Tensor:
    """Prior covariance (M m, N m): block-diagonal effects around the kernels' matrices at all points."""
    total = a.sensitivity.flatten(0, 1) @ torch.diag(a.spec.prior_variance) @ b.sensitivity.flatten(0, 1).T
    for kernel, mine, theirs in ((a.spec.joint_kernel, a.joint, b.joint), (a.spec.task_kernel, a.task, b.task)):
        for one, two in zip(mine, theirs, strict=True):
            left, right = torch.block_diag(*one.effect), torch.block_diag(*two.effect)
            total = total + one.weight * left @ kernel.matrix(one.points, two.points) @ right.T
    return total


def naive_covariance(problem: Problem, data: Linearisation, at: Linearisation) -> Tensor:
    """The blocks (M, m, m) of G(x, x) - G(x, data) (G + R)^-1 G(data, x)."""
    cross, total = naive_gram(data, at), naive_gram(data, data) + torch.block_diag(*problem.noise.covariance)
    whole = naive_gram(at, at) - cross.T @ torch.linalg.solve(total, cross)
    count, m, _ = at.sensitivity.shape
    return torch.stack([whole[i * m : i * m + m, i * m : i * m + m] for i in range(count)])


def close(found: Tensor, expected: Tensor, prior: float, rtol: float = 1e-12) -> None:
    """Equal up to rounding of the prior covariances, whose difference they are."""
    torch.testing.assert_close(found, expected, rtol=0, atol=rtol * prior)


@every_problem
@every_way
def test_covariance_is_the_formula(
    problem: Problem, way: Callable[[Problem, GeodesicDeformation], Conditional], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in several blocks of rows, and of linear functions of the coordinates."""
    at = deformed(problem)
    data, queries = at.linearise(), at.linearise(uniform(7, 2, seed=20))
    expected, prior = naive_covariance(problem, data, queries), float(naive_gram(queries, queries).diagonal().max())
    found, tolerance = way(problem, at), 1e-7 if way in (WAYS["iterative"], WAYS["reduced"]) else 1e-10
    close(found.covariance(queries), expected, prior, tolerance)
    directions = normal(7, 3, problem.y.shape[1], seed=2)
    wanted = directions @ expected @ directions.mT
    for entries in (conditional.BLOCK_ENTRIES, 3 * found.size * 3, 1):
        monkeypatch.setattr(conditional, "BLOCK_ENTRIES", entries)
        close(found.covariance(queries, directions), wanted, 9 * prior, tolerance)


@every_problem
@every_way
def test_covariance_between_queries(
    problem: Problem, way: Callable[[Problem, GeodesicDeformation], Conditional]
) -> None:
    """The formula's block outside of the diagonal, and within one set of queries its whole matrix."""
    at = deformed(problem)
    data, one, two = at.linearise(), at.linearise(uniform(4, 2, seed=20)), at.linearise(uniform(3, 2, seed=21))
    total = naive_gram(data, data) + torch.block_diag(*problem.noise.covariance)
    prior = float(naive_gram(one, one).diagonal().max())
    found, tolerance = way(problem, at), 1e-7 if way in (WAYS["iterative"], WAYS["reduced"]) else 1e-10
    for other in (two, None):
        left, right = naive_gram(data, one), naive_gram(data, other or one)
        expected = naive_gram(one, other or one) - left.T @ torch.linalg.solve(total, right)
        close(found.covariance_between(one, other), expected, prior, tolerance)


@every_kernel
def test_any_kernel_in_both_flows(kernel: Kernel) -> None:
    problem = PROBLEMS["two markers"]
    spec = replace(problem.spec, joint_kernel=kernel, task_kernel=kernel)
    at = deformed(problem)
    data, queries = (replace(lin, spec=spec) for lin in (at.linearise(), at.linearise(uniform(5, 2, seed=20))))
    torch.testing.assert_close(data.gram(queries), naive_gram(data, queries), rtol=1e-12, atol=1e-13)
    directions = normal(5, 3, 4, seed=2)
    each = torch.block_diag(*directions)
    projected = queries.projected(directions)
    torch.testing.assert_close(data.gram(projected), naive_gram(data, queries) @ each.T, rtol=1e-12, atol=1e-13)
    own = (each @ naive_gram(queries, queries) @ each.T).view(5, 3, 5, 3)
    blocks = torch.stack([own[i, :, i] for i in range(5)])
    torch.testing.assert_close(projected.own_blocks(), blocks, rtol=1e-12, atol=1e-13)
    some = torch.tensor([4, 0], device=HOST)
    torch.testing.assert_close(projected.rows(some).own_blocks(), blocks[some], rtol=1e-12, atol=1e-13)
    expected = naive_covariance(problem, data, queries)
    prior = float(naive_gram(queries, queries).diagonal().max())
    close(CholeskyRegression(data, problem.noise).covariance(queries), expected, prior, 1e-10)


@every_problem
def test_prediction_is_the_formula(problem: Problem) -> None:
    at, x = deformed(problem), uniform(9, 2, seed=21)
    fitted = FittedMap(at, problem.noise)
    expected = naive_covariance(problem, at.linearise(), at.linearise(x))
    mean, covariance = fitted.predict(x, noise=False)
    prior = float(naive_gram(at.linearise(x), at.linearise(x)).diagonal().max())
    torch.testing.assert_close(mean, fitted(x), rtol=0, atol=1e-14)
    close(covariance, expected, prior, 1e-10)
    close(fitted.predict(x)[1], expected + problem.noise.covariance.mean(0), prior, 1e-10)
    directions = normal(9, 2, problem.y.shape[1], seed=4)
    wanted = directions @ (expected + problem.noise.covariance.mean(0)) @ directions.mT
    close(fitted.posterior(x, directions=lambda _: directions)[1], wanted, 9 * prior, 1e-10)
    none = fitted.predict(x[:0])
    assert [t.shape for t in none] == [(0, problem.y.shape[1]), (0, *problem.y.shape[1:] * 2)]


def with_parameters(problem: Problem, at: GeodesicDeformation, x: Tensor, wide: float) -> Linearisation:
    """A linearisation with three parameters, the last of them fixed."""
    spec = replace(problem.spec, prior_variance=torch.tensor([wide, 0.5, 0.0], dtype=torch.float64))
    lin = at.linearise(x)
    slopes = torch.stack(
        [(x.sum(1, keepdim=True) * (k + 1) + torch.arange(problem.y.shape[1])).sin() for k in range(3)]
    )
    return replace(lin, spec=spec, sensitivity=slopes.movedim(0, -1))


@every_problem
def test_parameters_apart_are_the_formula(problem: Problem) -> None:
    at, x = deformed(problem), uniform(7, 2, seed=20)
    data, queries = (with_parameters(problem, at, points, 2.0) for points in (problem.x, x))
    expected, prior = naive_covariance(problem, data, queries), float(naive_gram(queries, queries).diagonal().max())
    regression = CholeskyRegression(data, problem.noise)
    close(regression.covariance(queries), expected, prior, 1e-10)
    values, K = normal(len(data.gram()), 3, seed=8), data.gram() + torch.block_diag(*problem.noise.covariance)
    solved = regression.solve(values.view(*problem.y.shape, 3)).flatten(0, 1)
    torch.testing.assert_close(solved, torch.linalg.solve(K, values), rtol=1e-6, atol=1e-6)
    C = torch.stack([regression.of_white(column) for column in torch.eye(len(K), dtype=torch.float64)], 1)
    torch.testing.assert_close(C.T @ K @ C, torch.eye(len(K), dtype=torch.float64), rtol=0, atol=1e-6)


def test_wide_priors_do_not_cancel() -> None:
    """The covariance tends to a limit as one prior gets wider; the plain difference would lose all digits."""
    problem = PROBLEMS["two markers"]
    at, x = deformed(problem), uniform(7, 2, seed=20)
    found = []
    for wide in (1e8, 1e16):
        data, queries = (with_parameters(problem, at, points, wide) for points in (problem.x, x))
        found.append(CholeskyRegression(data, problem.noise).covariance(queries))
    torch.testing.assert_close(found[0], found[1], rtol=1e-6, atol=1e-9 * float(found[1].abs().max()))
