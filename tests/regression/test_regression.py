"""Every way to condition on the data against the formula written out; heavy tails, gross errors, 95 % regions."""

from collections.abc import Callable
from dataclasses import replace
from math import inf, log
from typing import Any

import numpy as np
import pytest
import torch
from fit_bank import Offset, deformed, noise_blocks, shared_noise
from math_bank import normal, rr_problem, two_marker_problem, uniform
from scipy import stats
from scipy.stats import chi2, f
from torch import Tensor
from torch.testing import assert_close

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
from diffeo_calib.regression.regions import OTHER_DATE, SCALE_EFOLDS, region_scale
from diffeo_calib.regression.tails import (
    FREEDOM_CENTRE,
    FREEDOM_EFOLDS,
    GAUSSIAN_FREEDOM,
    SMALLEST_FREEDOM,
    gross_weights,
    reweight,
)
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


def simulated(count: int, dim: int, freedom: float, scale: float = 1.0, seed: int = 0) -> Tensor:
    """Errors (count, dim) with Student's t, Gaussian for infinite freedom."""
    rng = np.random.default_rng(seed)
    mixing = np.ones(count) if freedom == inf else rng.chisquare(freedom, count) / freedom
    return torch.from_numpy(scale * rng.standard_normal((count, dim)) / np.sqrt(mixing)[:, None])


def expectation_maximisation(errors: Tensor) -> tuple[float, float]:
    """Freedom and scale, from a scale that is three times too large."""
    freedom, scale = inf, 3.0 * float(errors.square().median().sqrt())
    for _ in range(30):
        tails = reweight((errors.square().sum(1, keepdim=True)) / scale**2, errors.shape[1])
        freedom, scale = tails.freedom, float((tails.weights * errors.square()).mean().sqrt())
    return freedom, scale


def log_posterior(errors: Tensor, freedom: float, scale: float) -> float:
    """Of Student's t by scipy, and the log-normal prior of its freedom."""
    k = errors.shape[1]
    distribution: Any = stats.multivariate_t  # scipy's stubs want whole degrees of freedom
    each = distribution.logpdf(errors.numpy(), np.zeros(k), scale**2 * np.eye(k), df=freedom)
    return float(np.sum(each)) - 0.5 * (log(freedom / FREEDOM_CENTRE) / FREEDOM_EFOLDS) ** 2


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize("count", [6, 80])
def test_no_other_freedom_is_more_likely(dim: int, count: int) -> None:
    """And the weights are those of the formula."""
    errors = simulated(count, dim, 4.0, seed=dim)
    squares = errors.square().sum(1, keepdim=True)
    found = reweight(squares, dim)
    best = log_posterior(errors, found.freedom, 1.0)
    for other in np.geomspace(SMALLEST_FREEDOM, GAUSSIAN_FREEDOM, 57):
        assert log_posterior(errors, other, 1.0) <= best + 1e-3  # the grid is one percent wide
    assert_close(found.weights, (found.freedom + dim) / (found.freedom + squares), rtol=1e-14, atol=0)


@pytest.mark.parametrize(("freedom", "scale"), [(2.5, 1.0), (5.0, 3e-5), (12.0, 40.0)])
def test_freedom_and_scale_are_those_that_scipy_finds(freedom: float, scale: float) -> None:
    errors = simulated(3000, 1, freedom, scale, seed=1)
    expected, _, expected_scale = stats.t.fit(errors.numpy().ravel() / scale, floc=0.0)
    found, own = expectation_maximisation(errors)
    assert found == pytest.approx(expected, rel=0.03)
    assert own / scale == pytest.approx(expected_scale, rel=0.01)
    assert expectation_maximisation(simulated(4000, 3, inf, scale, seed=3))[0] == inf, "clean data have no tails"


def test_errors_of_no_size_or_of_any_size_do_no_harm() -> None:
    for size in (0.0, 1e-300, 1e300):
        tails = reweight(torch.full((5, 2), size, dtype=torch.float64), 3)
        assert tails.freedom >= SMALLEST_FREEDOM * (1 - 1e-12)
        assert bool(torch.isfinite(tails.weights).all())
        assert bool((tails.weights >= 0).all())


def contaminated(share: float, size: float, dim: int, scale: float = 1.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Squares (200, 1) of errors whose good ones have the variance ``scale``, and which of them are gross."""
    errors, gross = simulated(200, dim, inf, scale**0.5, seed), torch.zeros(200, dtype=torch.bool)
    gross[np.random.default_rng(seed).permutation(200)[: round(200 * share)]] = True
    errors[gross] += size * simulated(int(gross.sum()), dim, inf, 1.0, seed + 1)
    return errors.square().sum(1, keepdim=True), gross


@pytest.mark.parametrize("scale", [1.0, 0.1])
@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize(("share", "size"), [(0.02, 1e3), (0.05, 40.0), (0.2, 100.0), (0.3, 1e3)])
def test_gross_errors_lose_their_weight_and_good_ones_gain_none(
    share: float, size: float, dim: int, scale: float
) -> None:
    """Also where the noise is said to be ten times too large, as scales are that were chosen with gross errors."""
    squares, gross = contaminated(share, size, dim, scale, seed=dim)
    weights = gross_weights(squares, dim)
    assert weights is not None
    assert float(weights.max()) <= 1.0
    clear = gross[:, None] & (squares > 25 * scale * dim)
    assert float(weights[clear].max()) < 0.05
    assert float(weights[~gross].min()) > 0.5


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize("freedom", [3.0, 8.0, inf])
def test_heavy_tails_and_clean_errors_are_not_gross(freedom: float, dim: int) -> None:
    for seed in range(10):
        squares = simulated(120, dim, freedom, seed=seed).square().sum(1, keepdim=True)
        assert gross_weights(squares, dim) is None
        assert gross_weights(10.0 * squares, dim) is None, "noise that is said to be too small"


def test_hidden_markers_and_bodies_of_several_dimensions() -> None:
    squares, gross = contaminated(0.05, 100.0, 3)
    squares, dim = torch.cat([squares, torch.full_like(squares, torch.nan)], 1), torch.tensor([[3, 6]]).expand(200, 2)
    weights = gross_weights(squares, dim)
    assert weights is not None
    assert bool((weights[:, 1] == 1.0).all())
    assert torch.equal(weights[:, 0] < 0.5, gross)


def share(factor: float, squares: np.ndarray, k: int) -> float:
    return float((squares < factor * chi2.ppf(0.95, k)).mean())


@pytest.mark.parametrize("k", [1, 3, 6])
@pytest.mark.parametrize("size", [0.3, 1.0, 4.0])
def test_gaussian_errors_of_any_size(k: int, size: float) -> None:
    rng = np.random.default_rng(k)
    held = [
        share(region_scale(torch.from_numpy(size * rng.chisquare(k, 200)), k), size * rng.chisquare(k, 20_000), k)
        for _ in range(5)
    ]
    assert np.mean(held) == pytest.approx(0.955, abs=0.015)


def test_tails_and_outliers_are_held() -> None:
    rng, new = np.random.default_rng(0), 3 * f.rvs(3, 3.0, size=20_000, random_state=1)
    heavy = [
        share(region_scale(torch.from_numpy(3 * rng.f(3, 3.0, size=400)), 3), np.asarray(new), 3) for _ in range(10)
    ]
    assert np.mean(heavy) == pytest.approx(0.95, abs=0.015)
    clean, held = np.asarray(rng.chisquare(3, 20_000)), list[float]()
    for _ in range(5):
        mixed = rng.chisquare(3, 400) * np.where(rng.random(400) < 0.02, 1e4, 1.0)
        held.append(share(region_scale(torch.from_numpy(mixed), 3), clean, 3))
    assert np.mean(held) == pytest.approx(0.975, abs=0.02)


def test_few_errors_widen_regions_and_none_leave_them() -> None:
    rng = np.random.default_rng(0)
    few, many = (np.mean([region_scale(torch.from_numpy(rng.chisquare(3, n)), 3) for _ in range(6)]) for n in (8, 800))
    assert 1.05 * many < few < 1.6
    assert region_scale(torch.full((3, 1), torch.nan), 3) == 1.0


def test_few_errors_of_another_date_may_have_any_size() -> None:
    """Ten errors of 50 times the variance: the prior of a calibration's own scales leaves new ones outside."""
    rng, new = np.random.default_rng(4), 50 * np.random.default_rng(5).chisquare(3, 20_000)
    few = [torch.from_numpy(50 * rng.chisquare(3, 10)) for _ in range(12)]
    own, other = (
        np.mean([share(region_scale(each, 3, efolds=p), new, 3) for each in few]) for p in (SCALE_EFOLDS, OTHER_DATE)
    )
    assert own < 0.93
    assert 0.94 < other < 0.985


def test_repeats_with_shares_count_as_one() -> None:
    once = torch.from_numpy(np.random.default_rng(0).chisquare(3, 30))
    often, dims = once.repeat_interleave(4), torch.full((120,), 3)
    assert region_scale(often, dims, torch.full((120,), 0.25)) == pytest.approx(region_scale(once, 3), rel=0.05)
    hidden = torch.cat([once, torch.full((5,), torch.nan)])
    assert region_scale(hidden, 3) == region_scale(once, 3)
