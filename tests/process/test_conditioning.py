"""The process conditioned on rows: against formulas with the whole covariance, in any order, with priors of a metre."""

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
from diffeo_calib.maps.linearisation import Numbers
from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.regression.conditional import BeforeData, Estimated, Opened, Process, diagonal_blocks
from diffeo_calib.regression.linear_rows import Evidence


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


def test_rows_may_come_in_parts_and_in_any_order(case: Case) -> None:
    """The evidence of later rows is a difference."""
    first, second, new = cut(case)
    prior, rows = case.data.prior(case.scales), torch.arange(len(case.data.x))
    both, all_of = case.part(rows[rows % 3 != 2]), case.part(rows)
    whole = prior.given(both.numbers, both.noise)
    estimate, covariance = unknowns(whole)
    deviation = covariance.diagonal().sqrt()
    scale, expected = torch.outer(deviation, deviation), noiseless(whole, new)
    for a, b in ((first, second), (second, first)):
        before = prior.given(a.numbers, a.noise)
        at = before.features(b.numbers.at)
        found = before.given(b.numbers, b.noise, at)
        own = unknowns(found)
        close(own[0] / deviation[: len(estimate)], estimate / deviation[: len(estimate)], 1e-9)
        close(own[1] / scale, covariance / scale, 1e-9)
        assert found.evidence == pytest.approx(whole.evidence, rel=1e-9)
        for actual, wanted in zip(noiseless(found, new), expected, strict=True):
            close(actual, wanted, 1e-9)
        assert_close(found.inverse @ found.numbers.target, found.mu, rtol=0, atol=1e-8 * float(found.mu.abs().max()))
        again = found.given(new.numbers, new.noise)  # a factor of three parts
        close(noiseless(again, new)[0], noiseless(prior.given(all_of.numbers, all_of.noise), new)[0], 1e-9)
        plain = found.features(new.numbers.at)
        close(found.covariance(new.numbers.at), diagonal_blocks(plain.between(), len(new.data.x)), 1e-9)
        K, target = b.numbers.with_noise(at.between(), b.noise), b.numbers.there(before.mean(at))
        normal = torch.distributions.MultivariateNormal(target, (K + K.T) / 2)
        more = float(normal.log_prob(b.numbers.target))
        assert found.evidence - before.evidence == pytest.approx(more, rel=1e-7)


def test_unknowns_that_later_rows_open_are_as_if_they_had_been_there(case: Case) -> None:
    """Conditioning anew on what is known, twice, is conditioning once: for rows that depend on the new unknowns."""
    deviations, count = torch.tensor([1e-3, 2e-4], dtype=torch.float64), len(case.variance)

    def with_columns(part: Case, size: float, seed: int) -> Numbers:
        columns = size * normal(*part.numbers.shape, 2, seed=seed)
        return replace(part.numbers, at=part.numbers.at.with_columns(columns, count))

    first, *later = cut(case)
    known = case.data.prior(case.scales).given(first.numbers, first.noise)
    whole = BeforeData(torch.cat([case.variance.sqrt(), deviations])).given(with_columns(first, 0.0, 0), first.noise)
    found: Any = Opened(known, count, deviations)
    for seed, part in enumerate(later):
        numbers = with_columns(part, 1.0, seed)
        away = numbers.target - numbers.there(known.mean(known.features(numbers.at)))
        found, whole = found.given(replace(numbers, target=away), part.noise), whole.given(numbers, part.noise)
    at = with_columns(first, 1.0, 5).at
    one, other = found.features(at), whole.features(at)
    close(known.mean(known.features(at)) + found.mean(one), whole.mean(other), 1e-6)
    close(one.between(), other.between(), 1e-6)
    assert found.evidence == pytest.approx(whole.evidence - known.evidence, rel=1e-6)


def test_errors_beside_unknowns_that_were_estimated_from_them(case: Case) -> None:
    """Covariance of e(x) - B(x) A e(X), written out."""
    first, _, new = cut(case)
    known, at, reference = case.posterior, new.numbers.at, first.numbers.at
    A = 1e-3 * normal(2, len(reference.sensitivity.flatten(0, 1)), seed=3)
    C, cross = known.covariance_between(at), known.covariance_between(reference, at)
    BA = at.sensitivity[..., [1, 4]].flatten(0, 1) @ A
    expected = C - BA @ cross - (BA @ cross).T + BA @ known.covariance_between(reference) @ BA.T
    close(Estimated(known, reference, A, [1, 4]).covariance_between(at), expected, 1e-9)


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
    again = Factor(found.factor.L, W)
    more = 2.0 * E if size else E / E.norm(dim=0)
    close(again.matrix, case.posterior.factor.matrix + more @ more.T, 1e-9)
    close(found.inverse, again.inverse, 1e-7)
    close(found.mu, again.solve(found.numbers.target[:, None])[:, 0], 1e-7)


def test_evidence_of_unknowns_is_that_of_their_covariance(case: Case) -> None:
    """By a process and by the factor of its covariance; what unknowns explain is the fall of least squares."""
    E, y = 1e-4 * normal(len(case.posterior.mu), 2, seed=9), case.numbers.target
    K, found = case.posterior.factor.matrix, Evidence.of(E, case.posterior)
    root, variances = torch.linalg.cholesky(K), torch.tensor([0.5, 30.0], dtype=torch.float64)
    white = torch.linalg.solve(root, torch.cat([E, y[:, None]], 1))
    W, r = white[:, :2], white[:, 2]
    plain = W.T @ r, W.T @ W, float(r @ r), len(r)
    for one, other in zip(found, plain, strict=True):
        assert_close(torch.as_tensor(one), torch.as_tensor(other), rtol=1e-6, atol=1e-6)
    left = r - W @ torch.linalg.lstsq(W, r[:, None]).solution[:, 0]
    assert float(found.gain) == pytest.approx(float(r @ r - left @ left), rel=1e-6)
    for scale in (1e-3, 1e3):  # errors as large as K says, or smaller, are no excess
        own = Evidence(scale * found.g, found.H, scale**2 * found.total, found.count)
        assert float(own.excess) == pytest.approx(max(1.0, scale**2 * float(left.square().mean())), rel=1e-6)
    odds = Evidence(torch.stack([found.g, 2.0 * found.g]), found.H).log_odds(variances)
    for row, variance in enumerate(variances):
        for column, target in enumerate((y, 2.0 * y)):
            before, after = (
                torch.distributions.MultivariateNormal(torch.zeros_like(y), scale_tril=torch.linalg.cholesky(each))
                for each in (K, K + variance * E @ E.T)
            )
            expected = float(after.log_prob(target) - before.log_prob(target))
            assert float(odds[row, column]) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    ratio, both = variances.sqrt(), torch.tensor([[1.0, 1.0], [0.5, 30.0]], dtype=torch.float64)
    scaled = Evidence(ratio * found.g, ratio[:, None] * found.H * ratio).log_odds(both[0, :1])
    assert_close(found.log_odds_of(both), torch.cat([odds.new_tensor([float(found.log_odds(both[0, :1]))]), scaled]))


def test_rows_without_noise_that_are_there_twice_are_refused() -> None:
    one = case("poses")
    twice = one.part(torch.tensor([0, 0]))
    with pytest.raises(NumericalError, match="the covariance of the rows is not positive definite"):
        twice.data.prior(one.scales).given(twice.numbers, 0.0 * twice.noise)


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
    some = Case(replace(one.data, place_deviation=1.0), one.scales).part(torch.arange(5))
    numbers, found = some.numbers, some.posterior
    F = numbers.with_noise(some.fields, some.noise)
    mu, estimate = exactly(F, numbers.S, some.variance, numbers.target)
    close(found.mu, mu, 1e-9)
    deviation = unknowns(found)[1].diagonal().sqrt()
    close(found.estimate / deviation, estimate / deviation, 1e-9)
    naive = torch.linalg.solve(F + numbers.S @ torch.diag(some.variance) @ numbers.S.T, numbers.target)
    assert float((naive - mu).abs().max()) > 1e2 * float((found.mu - mu).abs().max())
