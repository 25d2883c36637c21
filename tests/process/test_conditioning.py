"""The process conditioned on rows: against formulas with the whole covariance, in any order, with priors of a metre."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mpmath
import pytest
import torch
from process_bank import Case, case
from tangent_bank import normal
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.regression.conditional import Process


def close(found: Tensor, expected: Tensor, relative: float) -> None:
    """Relative to the largest entry."""
    assert_close(found, expected, rtol=0, atol=relative * float(expected.abs().max()))


def cut(case: Case) -> tuple[Case, Case, Case]:
    """Two thirds of the rows in two parts, and the rest."""
    rows = torch.arange(len(case.data.x))
    return tuple(case.part(rows[rows % 3 == k]) for k in range(3))  # pyright: ignore


def noiseless(process: Process, part: Case) -> tuple[Tensor, Tensor]:
    """Mean and covariance of the numbers of rows."""
    numbers, at = part.numbers, process.features(part.numbers.at)
    return numbers.there(process.mean(at)), numbers.there(numbers.there(at.between()).T)


def unknowns(process: Process) -> tuple[Tensor, Tensor]:
    """Mean, of those of the nominal map, and covariance of the unknowns."""
    at, K = process.numbers.at, process.factor.W.shape[1]
    nothing = torch.zeros(1, K, at.sensitivity.shape[1], dtype=torch.float64)
    alone = replace(at.rows(torch.tensor([0])).projected(nothing), sensitivity=torch.eye(K, dtype=torch.float64)[None])
    return process.estimate, process.posterior(alone)[0]


# --- the posterior ------------------------------------------------------------------------------------------------


def test_posterior_is_that_of_the_whole_covariance(case: Case) -> None:
    at, found, y = case.numbers.cells, case.posterior, case.numbers.target
    S, P = case.unknowns[at], torch.diag(case.variance)
    R = torch.block_diag(*case.noise)[at][:, at]
    K = case.fields[at][:, at] + R + S @ P @ S.T
    inverse = torch.linalg.inv(K)
    close(found.inverse, inverse, 1e-6)
    close(found.mu, inverse @ y, 1e-5)
    close(found.factor.solve(S), inverse @ S, 1e-6)
    deviation = case.variance.sqrt()
    (estimate, covariance), count = unknowns(found), len(found.estimate)
    close(estimate / deviation[:count], (P @ S.T @ inverse @ y / deviation)[:count], 1e-5)
    explained = P @ S.T @ inverse @ S @ P
    scale = torch.outer(deviation, deviation)
    close(covariance / scale, (P - explained) / scale, 1e-5)
    normal = torch.distributions.MultivariateNormal(torch.zeros_like(y), K)
    assert found.evidence == pytest.approx(float(normal.log_prob(y)), rel=1e-6)


def test_predictions_are_those_of_the_whole_covariance(case: Case) -> None:
    """Of rows that are new."""
    first, second, new = cut(case)
    known = first.data.process(case.scales).given(second.numbers, second.noise)
    mean, covariance = noiseless(known, new)
    count, R = len(case.data.x), case.data.size
    K = case.fields + case.unknowns @ torch.diag(case.variance) @ case.unknowns.T
    noise = torch.block_diag(*case.noise)

    def cells(part: Case, k: int) -> Tensor:
        return torch.arange(k, count, 3)[part.numbers.owner] * R + part.numbers.cells % R

    at, to = torch.cat([cells(first, 0), cells(second, 1)]), cells(new, 2)
    gain = torch.linalg.solve((K + noise)[at][:, at], K[at][:, to]).T
    target = case.data.target.flatten()
    close(mean, gain @ target[at], 1e-6)
    close(covariance, K[to][:, to] - gain @ K[at][:, to], 1e-6)


def test_before_any_row(case: Case) -> None:
    found = case.data.prior(case.scales).covariance_between(case.numbers.at)
    close(found, case.fields + case.unknowns @ torch.diag(case.variance) @ case.unknowns.T, 1e-12)


def test_estimates_are_spread_as_their_covariance_says() -> None:
    """Measurements that are drawn from the prior: errors of the unknowns, whitened by the posterior, are N(0, 1)."""
    one = case("one marker")
    numbers, K = one.numbers, len(one.variance)
    F = torch.linalg.cholesky(numbers.with_noise(one.fields, one.noise))
    root, squares = torch.linalg.cholesky(unknowns(one.posterior)[1]), []
    for seed in range(60):
        u = one.variance.sqrt() * normal(K, seed=seed)
        y = numbers.S @ u + F @ normal(len(numbers.target), seed=1000 + seed)
        drawn = replace(one.data, y=one.data.y + y.view_as(one.data.y) - one.data.target)
        error = drawn.process(one.scales).estimate - u
        squares.append(torch.linalg.solve_triangular(root, error[:, None], upper=False).square().mean())
    assert float(torch.stack(squares).mean()) == pytest.approx(1.0, abs=4.0 * (2.0 / (60 * K)) ** 0.5)


# --- one block after the other ------------------------------------------------------------------------------------


def test_rows_may_come_in_parts_and_in_any_order(case: Case) -> None:
    first, second, new = cut(case)
    prior = case.data.prior(case.scales)
    both = case.part(torch.arange(len(case.data.x))[torch.arange(len(case.data.x)) % 3 != 2])
    whole = prior.given(both.numbers, both.noise)
    estimate, covariance = unknowns(whole)
    deviation = covariance.diagonal().sqrt()
    scale, expected = torch.outer(deviation, deviation), noiseless(whole, new)
    for a, b in ((first, second), (second, first)):
        found = prior.given(a.numbers, a.noise).given(b.numbers, b.noise)
        own = unknowns(found)
        close(own[0] / deviation[: len(estimate)], estimate / deviation[: len(estimate)], 1e-9)
        close(own[1] / scale, covariance / scale, 1e-9)
        assert found.evidence == pytest.approx(whole.evidence, rel=1e-9)
        for actual, wanted in zip(noiseless(found, new), expected, strict=True):
            close(actual, wanted, 1e-9)
        other = found.inverse
        assert_close(other @ found.numbers.target, found.mu, rtol=0, atol=1e-8 * float(found.mu.abs().max()))


def test_what_was_expected_before_goes_on_with_later_rows(case: Case) -> None:
    first, second, new = cut(case)
    known = first.data.process(case.scales)
    whole = known.given(second.numbers, second.noise)
    at = new.numbers.at
    expected, found = whole.features(at), whole.features(at, known.features(at))
    close(whole.mean(found), whole.mean(expected), 1e-9)
    close(found.between(), expected.between(), 1e-9)
    close(found.between(expected), expected.between(), 1e-9)


def test_evidence_of_later_rows_is_a_difference(case: Case) -> None:
    first, second, _ = cut(case)
    before = first.data.process(case.scales)
    at = before.features(second.numbers.at)
    after = before.given(second.numbers, second.noise, at)
    K = second.numbers.with_noise(at.between(), second.noise)
    normal = torch.distributions.MultivariateNormal(second.numbers.there(before.mean(at)), (K + K.T) / 2)
    assert after.evidence - before.evidence == pytest.approx(float(normal.log_prob(second.numbers.target)), rel=1e-7)


def test_left_out_is_conditioning_without(case: Case) -> None:
    """Rows, and groups of rows."""
    rows = torch.arange(len(case.data.x))
    for own in (rows[:1], rows[4:5], rows[1::4]):
        kept, gone = case.part(rows[~torch.isin(rows, own)]), case.part(own)
        known = kept.data.process(case.scales)
        at = known.features(gone.numbers.at)
        group = torch.isin(case.numbers.owner, own)
        errors, covariance = case.posterior.left_out(group.to(torch.int64) - 1)
        assert bool(errors[~group].isnan().all())
        close(errors[group], gone.numbers.target - gone.numbers.there(known.mean(at)), 1e-6)
        close(covariance[group][:, group], gone.numbers.with_noise(at.between(), gone.noise), 1e-6)


@pytest.mark.parametrize("size", [2.0, None])
def test_opened_unknowns_are_those_of_another_factor(case: Case, size: float | None) -> None:
    E = 1e-4 * normal(len(case.posterior.mu), 3, seed=8)
    found = case.posterior.opened(E, size)
    W = found.factor.W
    again = Factor(found.factor.L, W, W.T @ W)
    more = 2.0 * E if size else E / E.norm(dim=0)
    close(again.matrix, case.posterior.factor.matrix + more @ more.T, 1e-9)
    close(found.inverse, again.inverse, 1e-7)
    close(found.mu, again.solve(found.numbers.target[:, None])[:, 0], 1e-7)


def test_rows_without_noise_that_are_there_twice_are_refused() -> None:
    one = case("poses")
    twice = one.part(torch.tensor([0, 0]))
    with pytest.raises(NumericalError, match="the covariance of the rows is not positive definite"):
        twice.data.prior(one.scales).given(twice.numbers, 0.0 * twice.noise)


# --- digits -------------------------------------------------------------------------------------------------------


def exactly(F: Tensor, S: Tensor, variance: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """K^-1 y and the estimate P S^T K^-1 y with sixty digits."""
    with mpmath.workdps(60):
        matrix: Any = mpmath.matrix
        S_, P = matrix(S.tolist()), mpmath.diag(variance.tolist())
        mu = mpmath.lu_solve(matrix(F.tolist()) + S_ * P * S_.T, matrix(y.tolist()))
        estimate = P * S_.T * mu
        found = [torch.tensor([float(value) for value in values], dtype=torch.float64) for values in (mu, estimate)]
    return found[0], found[1]


def test_priors_of_a_metre_cost_no_digits() -> None:
    """Beside noise of micrometres; with the whole covariance in float64 half of them would be lost."""
    one = case("one marker")
    some = Case(replace(one.data, place_deviation=1.0), one.scales).part(torch.arange(9))
    numbers, found = some.numbers, some.posterior
    F = numbers.with_noise(some.fields, some.noise)
    mu, estimate = exactly(F, numbers.S, some.variance, numbers.target)
    close(found.mu, mu, 1e-9)
    deviation = unknowns(found)[1].diagonal().sqrt()
    close(found.estimate / deviation, estimate / deviation, 1e-9)
    naive = torch.linalg.solve(F + numbers.S @ torch.diag(some.variance) @ numbers.S.T, numbers.target)
    assert float((naive - mu).abs().max()) > 1e2 * float((found.mu - mu).abs().max())


@pytest.mark.parametrize("name", ["one marker", "poses", "mixture"])
def test_where_the_device_is_thought_does_not_matter(name: str) -> None:
    """Unknowns with a prior of a metre take up half a metre, and errors of left-out rows stay."""
    wide = Case(replace(case(name).data, place_deviation=1.0), case(name).scales)
    numbers, step = wide.numbers, torch.zeros_like(wide.variance)
    step[:3] = torch.tensor([0.5, -0.3, 0.2])
    before = wide.posterior
    moved = replace(numbers, target=numbers.target + numbers.S @ step)
    after = wide.data.prior(wide.scales).given(moved, wide.noise)
    one, other = before.left_out(numbers.owner)[0], after.left_out(numbers.owner)[0]
    assert_close(other, one, rtol=0, atol=1e-7)
    assert_close((after.estimate - before.estimate)[:3], step[:3], rtol=1e-4, atol=1e-6)
