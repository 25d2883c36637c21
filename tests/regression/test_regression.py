"""Every way to condition on the data, against the formula written out with dense matrices and against each other."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from fit_bank import Offset, deformed, noise_blocks, shared_noise
from math_bank import normal, rr_problem, two_marker_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.problem import Problem, regress
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.regression import conditional, control_points
from diffeo_calib.regression import conjugate_gradients as iterative
from diffeo_calib.regression.conditional import Conditional, Process
from diffeo_calib.regression.conjugate_gradients import ConjugateGradientRegression
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


def poorly(problem: Problem, at: GeodesicDeformation, rank: int = 4) -> ConjugateGradientRegression:
    """With a preconditioner that explains little."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(iterative, "MAX_RANK", rank)
        return ConjugateGradientRegression(at.linearise(), problem.noise)


Way = Callable[[Problem, GeodesicDeformation], Any]
WAYS: dict[str, Way] = {
    "cholesky": lambda problem, at: Process.of_rows(at.linearise(), problem.noise),
    "iterative": lambda problem, at: ConjugateGradientRegression(at.linearise(), problem.noise),
    "iterative, poor preconditioner": poorly,
    "reduced": lambda problem, at: ControlPointRegression(at, problem.x, problem.noise, residual=problem.residual),
}


every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


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

FULL = ("cholesky", "iterative", "reduced")
full_ways = pytest.mark.parametrize("way", [WAYS[name] for name in FULL], ids=FULL)


@pytest.fixture(autouse=True)
def fields_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    """The factor of conjugate gradients explains all of the fields."""
    monkeypatch.setattr(iterative, "NEGLIGIBLE_VARIANCE_RATIO", 1e-12)


def naive_gram(a: Linearisation, b: Linearisation) -> Tensor:
    """Prior covariance (M m, N m): block-diagonal effects around the kernels' matrices at all points."""
    total = a.sensitivity.flatten(0, 1) @ torch.diag(a.spec.prior_variance) @ b.sensitivity.flatten(0, 1).T
    for kernel, mine, theirs in ((a.spec.joint_kernel, a.joint, b.joint), (a.spec.task_kernel, a.task, b.task)):
        for one, two in zip(mine, theirs, strict=True):
            left, right = torch.block_diag(*one.effect), torch.block_diag(*two.effect)
            total = total + one.weight * left @ kernel.matrix(one.points, two.points) @ right.T
    return total


def matrix_of(problem: Problem) -> Tensor:
    """R."""
    flat = problem.noise.shared.flatten(0, 1)
    return torch.block_diag(*problem.noise.covariance) + flat @ flat.T


def naive_covariance(problem: Problem, data: Linearisation, at: Linearisation) -> Tensor:
    """The blocks (M, m, m) of G(x, x) - G(x, data) (G + R)^-1 G(data, x)."""
    cross, total = naive_gram(data, at), naive_gram(data, data) + matrix_of(problem)
    whole = naive_gram(at, at) - cross.T @ torch.linalg.solve(total, cross)
    count, m, _ = at.sensitivity.shape
    return torch.stack([whole[i * m : i * m + m, i * m : i * m + m] for i in range(count)])


def close(found: Tensor, expected: Tensor, prior: float, rtol: float = 1e-12) -> None:
    """Equal up to rounding of the prior covariances, whose difference they are."""
    torch.testing.assert_close(found, expected, rtol=0, atol=rtol * prior)


@every_problem
@full_ways
def test_covariance_is_the_formula(
    problem: Problem, way: Callable[[Problem, GeodesicDeformation], Conditional], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in several blocks of rows, of linear functions of the coordinates, and between configurations."""
    at = deformed(problem)
    data, queries, other = at.linearise(), at.linearise(uniform(7, 2, seed=20)), at.linearise(uniform(3, 2, seed=21))
    expected, prior = naive_covariance(problem, data, queries), float(naive_gram(queries, queries).diagonal().max())
    found, tolerance = way(problem, at), 1e-7 if way in (WAYS["iterative"], WAYS["reduced"]) else 1e-10
    close(found.covariance(queries), expected, prior, tolerance)
    directions = normal(7, 3, problem.y.shape[1], seed=2)
    wanted = directions @ expected @ directions.mT
    for entries in (conditional.BLOCK_ENTRIES, 3 * found.size * 3, 1):
        monkeypatch.setattr(conditional, "BLOCK_ENTRIES", entries)
        close(found.covariance(queries, directions), wanted, 9 * prior, tolerance)
    total = naive_gram(data, data) + matrix_of(problem)
    for beside in (other, None):
        left, right = naive_gram(data, queries), naive_gram(data, beside or queries)
        expected = naive_gram(queries, beside or queries) - left.T @ torch.linalg.solve(total, right)
        close(found.covariance_between(queries, beside), expected, prior, tolerance)


@every_kernel
def test_any_kernel_in_both_flows(kernel: Kernel) -> None:
    problem = PROBLEMS["two markers"]
    spec = replace(problem.spec, joint_kernel=kernel, task_kernel=kernel)
    at = deformed(problem)
    data, queries = (replace(lin, spec=spec) for lin in (at.linearise(), at.linearise(uniform(5, 2, seed=20))))
    directions = normal(5, 3, 4, seed=2)
    each, projected = torch.block_diag(*directions), queries.projected(directions)
    torch.testing.assert_close(data.gram(projected), naive_gram(data, queries) @ each.T, rtol=1e-12, atol=1e-13)
    own = (each @ naive_gram(queries, queries) @ each.T).view(5, 3, 5, 3)
    blocks = torch.stack([own[i, :, i] for i in range(5)])
    some = torch.tensor([4, 0], device=HOST)
    torch.testing.assert_close(projected.rows(some).own_blocks(), blocks[some], rtol=1e-12, atol=1e-13)
    expected, prior = naive_covariance(problem, data, queries), float(naive_gram(queries, queries).diagonal().max())
    close(Process.of_rows(data, problem.noise).covariance(queries), expected, prior, 1e-10)


def mode(found: Any, target: Tensor) -> Momenta:
    """Of the problem that was linearised."""
    return found.mode()[0] if isinstance(found, ControlPointRegression) else found.momenta(target)


@every_way
@pytest.mark.parametrize("name", ["hidden", "shared shifts"])
def test_same_momenta_as_the_cholesky_factor(name: str, way: Way, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared by their effect at the data, since flat directions of the momenta are rounding errors."""
    problem = PROBLEMS[name]
    at = deformed(problem)
    expected = regress(problem, at, "cholesky")
    reduced = ControlPointRegression(at, problem.x, problem.noise)
    wanted = reduced.response(expected.momenta())
    for entries in (control_points.BLOCK_ENTRIES, 1):  # of control points all rows at once, and each by itself
        monkeypatch.setattr(control_points, "BLOCK_ENTRIES", entries)
        actual = reduced.response(mode(way(problem, at), expected.target))
        torch.testing.assert_close(actual, wanted, rtol=1e-5, atol=1e-5 * float(wanted.abs().max()))


@pytest.mark.parametrize("wide", [1.0, 100.0])
@pytest.mark.parametrize("name", ["noise blocks", "shared shifts"])
def test_covariance_of_a_large_problem(name: str, wide: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the factor alone: exact if F explains all of G, without cancellation beside a parameter with a wide prior."""
    problem = PROBLEMS[name]
    at, model = deformed(problem), replace(problem.spec, prior_variance=torch.tensor([wide], dtype=torch.float64))
    data, queries = (
        replace(lin, spec=model, sensitivity=torch.ones(*lin.sensitivity.shape[:2], 1, dtype=torch.float64))
        for lin in (at.linearise(), at.linearise(uniform(6, 2, seed=20)))
    )
    expected = Process.of_rows(data, problem.noise).covariance(queries)
    actual = ConjugateGradientRegression(data, problem.noise).covariance(queries)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))
    monkeypatch.setattr(iterative, "NEGLIGIBLE_VARIANCE_RATIO", 0.03)
    noise = float(problem.noise.covariance.diagonal(dim1=1, dim2=2).mean())
    rough = ConjugateGradientRegression(data, problem.noise)
    assert 0.0 < float((rough.covariance(queries) - expected).diagonal(dim1=1, dim2=2).abs().max()) < noise
    rest = (rough.preconditioner.covariance - problem.noise.covariance).diagonal(dim1=1, dim2=2).flatten()
    left = (data.fields.gram() - rough.P @ rough.P.T).diagonal()
    torch.testing.assert_close(rest, left, rtol=0, atol=1e-8 * float(data.fields.gram().diagonal().max()))


@every_way
def test_parameters_of_the_nominal_map(way: Way) -> None:
    """theta and its covariance by every method, for prior variances that differ from each other and from 1."""
    x = uniform(20, 2, seed=3)
    kernels = {"joint_kernel": dc.VonMises(1.0, 0.01), "task_kernel": dc.Gaussian(0.7, 0.01)}
    y = elastic_rr.real(x)
    problem = Problem(Offset(), x, y, noise=0.01, prior_variance=(0.04, 0.0009), **kernels)  # pyright: ignore[reportArgumentType]
    at = problem.deform(problem.zero(), dc.RK4(1))
    exact = regress(problem, at, "cholesky")
    conditional = way(problem, at)
    torch.testing.assert_close(mode(conditional, exact.target).theta, exact.momenta().theta, rtol=1e-6, atol=1e-9)
    queries = at.linearise(uniform(4, 2, seed=5))
    expected = exact.conditional.covariance(queries)
    if way is not WAYS["iterative, poor preconditioner"]:  # whose covariances are larger
        torch.testing.assert_close(conditional.covariance(queries), expected, rtol=1e-5, atol=1e-10)


def test_conjugate_gradients_that_cannot_converge_say_so() -> None:
    problem = rr_problem(5, noise=1e-9)
    at = deformed(problem)
    with pytest.raises(NumericalError, match="conjugate gradients did not converge"):
        poorly(problem, at, 2).solve(normal(25, 2, 1, seed=1))
    model = replace(problem.spec, prior_variance=torch.ones(2, dtype=torch.float64))
    alike = replace(at.linearise(), spec=model, sensitivity=torch.ones(25, 2, 2, dtype=torch.float64))
    with pytest.raises(NumericalError, match="too large beside their noise"):
        ConjugateGradientRegression(alike, problem.noise).solve(normal(25, 2, 1, seed=1))


def test_auto_takes_conjugate_gradients_for_large_problems() -> None:
    assert iterative.choose("auto", iterative.MAX_DENSE) == "cholesky"
    assert iterative.choose("auto", iterative.MAX_DENSE + 1) == "cg"
    with pytest.raises(InputError, match="`linear`: expected auto, cholesky, cg, got 'lu'"):
        dc.fit(PROBLEMS["rr"], dc.GaussNewton(linear="lu"), dc.RK4(1))  # pyright: ignore[reportArgumentType]


@full_ways
def test_shifts_that_rows_share_are_parameters(way: Way) -> None:
    """cov(c) = (1 + Z^T (G + R)^-1 Z)^-1, with R the noise of the rows alone, and none with what knows nothing of c."""
    problem = PROBLEMS["shared shifts"]
    at, Z = deformed(problem), problem.noise.shared.flatten(0, 1)
    lin, (m, c) = at.linearise(), problem.noise.shared.shape[1:]
    conditional = way(problem, at)
    nothing = lin.rows(torch.tensor([0])).projected(torch.zeros(1, c, m, dtype=torch.float64))
    K = lin.sensitivity.shape[2]
    shifts = replace(nothing, sensitivity=torch.eye(K + c, dtype=torch.float64)[None, K:])
    alone = lin.gram() + torch.block_diag(*problem.noise.covariance)
    expected = torch.linalg.inv(torch.eye(c, dtype=torch.float64) + Z.T @ torch.linalg.solve(alone, Z))
    torch.testing.assert_close(conditional.posterior(shifts)[0], expected, rtol=1e-3, atol=1e-9)
