"""The process conditioned on rows, against formulas with the whole covariance; slopes of covariances by scales."""

from dataclasses import replace
from typing import Any

import mpmath
import process_bank
import pytest
import torch
from process_bank import Case
from tangent_bank import SETTINGS, Setting, built, normal
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.maps.linearisation import Numbers
from diffeo_calib.process.scales import NEGLIGIBLE_DISPLACEMENT, SCALES, GearLine, Hyperparameters, Pairs
from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.regression.conditional import BeforeData, Estimated, Opened, Process, diagonal_blocks
from diffeo_calib.regression.linear_rows import Evidence


@pytest.fixture(params=list(process_bank.ROWS))
def case(request: pytest.FixtureRequest) -> Case:
    return process_bank.case(request.param)


@pytest.fixture(params=list(SETTINGS))
def setting(request: pytest.FixtureRequest) -> Setting:
    """Measurements after the geometric calibration."""
    return built(request.param)


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
    one = process_bank.case("poses")
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
    one = process_bank.case("one marker")
    some = Case(replace(one.data, place_deviation=1.0), one.scales).part(torch.arange(5))
    numbers, found = some.numbers, some.posterior
    F = numbers.with_noise(some.fields, some.noise)
    mu, estimate = exactly(F, numbers.S, some.variance, numbers.target)
    close(found.mu, mu, 1e-9)
    deviation = unknowns(found)[1].diagonal().sqrt()
    close(found.estimate / deviation, estimate / deviation, 1e-9)
    naive = torch.linalg.solve(F + numbers.S @ torch.diag(some.variance) @ numbers.S.T, numbers.target)
    assert float((naive - mu).abs().max()) > 1e2 * float((found.mu - mu).abs().max())


def test_fields_without_support_vanish(setting: Setting) -> None:
    """Fields whose displacement is far below the noise are zero exactly; all other scales stay."""
    scales, data = setting.scales, setting.tangent_data
    noise = data.noise(scales)
    level = NEGLIGIBLE_DISPLACEMENT * float(noise.diagonal(dim1=1, dim2=2).mean().sqrt())
    lever = data.jacobian.square().mean((0, 1)).sqrt()
    assert scales.supported(data.jacobian, noise).logarithms().isfinite().all()
    last = scales.transmission_amplitude.clone()
    last[-1] = 0.99 * level / lever[-1]
    first = scales.coupled_amplitude.clone()
    first[0] = 0.99 * level / lever[0]
    first[1] = 1.01 * level / lever[1]
    weak = replace(
        scales,
        transmission_amplitude=last,
        coupled_amplitude=first,
        task_amplitude=torch.tensor(0.99 * level, dtype=torch.float64),
    )
    found = weak.supported(data.jacobian, noise)
    assert found.transmission_amplitude.tolist() == [*scales.transmission_amplitude[:-1].tolist(), 0.0]
    assert found.coupled_amplitude.tolist() == [0.0, *first[1:].tolist()]
    assert float(found.task_amplitude) == 0.0
    for name in set(SCALES) - {"transmission_amplitude", "coupled_amplitude", "task_amplitude"}:
        assert torch.equal(getattr(found, name), getattr(scales, name))
    before, after = data.linearisation(weak).gram(), data.linearisation(found).gram()
    change = (before - after).diagonal().clamp(min=0).mean().sqrt()
    assert float(change) < 3 * level


def test_inflated_scales_scale_the_covariance(setting: Setting) -> None:
    """Except the parts that do not depend on them: prior of the places, known noise, slack, the smallest noise."""
    data = setting.tangent_data
    sensor = replace(data.noise_model.without_known, slack=0.0, smallest_noise=0.0)
    data = replace(data, noise_model=sensor, place_deviation=1e-9)
    scales = setting.scales
    inflated = scales.inflated(1.7)
    before, after = (data.linearisation(s).gram() for s in (scales, inflated))
    assert_close(after, 1.7**2 * before, rtol=0, atol=1e-9 * float(after.abs().max()))
    assert_close(data.noise(inflated), 1.7**2 * data.noise(scales), rtol=1e-9, atol=0)


def test_gear_lines_are_parameters_of_the_nominal_map(setting: Setting) -> None:
    """Their columns are J_l cos and J_l sin, their prior b^2; they are no scales of the search."""
    lines = (GearLine(0, 101.3, 5e-5), GearLine(setting.data.n - 1, 40.2, 2e-5))
    scales, data = replace(setting.scales, lines=lines), setting.tangent_data
    with_lines = data.with_position_errors(scales)
    assert torch.equal(scales.logarithms(), setting.scales.logarithms())
    assert scales.from_logarithms(scales.logarithms()).lines == lines
    assert scales.inflated(2.0).lines[1] == GearLine(setting.data.n - 1, 40.2, 4e-5)
    expected = data.linearisation(setting.scales).gram()
    for line in lines:
        wave = line.frequency * (data.x[:, None, line.joint] - data.x[:, line.joint])
        J = data.jacobian[..., line.joint]
        added = line.amplitude**2 * torch.einsum("im,ij,jk->imjk", J, wave.cos(), J)
        expected = expected + added.reshape(expected.shape)
    assert_close(with_lines.linearisation(scales).gram(), expected, rtol=1e-12, atol=1e-16)
    assert torch.equal(with_lines.target, data.target)
    again = with_lines.with_position_errors(setting.scales)
    assert_close(again.sensitivities, data.sensitivities, rtol=0, atol=0)


def matrix(pairs: Pairs, scales: Hyperparameters) -> Tensor:
    return pairs.matrix(pairs.values(scales))


def test_matrix_is_that_of_the_linearised_model(case: Case) -> None:
    """Of both fields, and of each by itself, where the other would hide it."""
    names = {"transmission_amplitude", "coupled_amplitude", "task_amplitude"}
    for kept in (names, *({name} for name in names)):
        without = {name: torch.zeros_like(getattr(case.scales, name)) for name in names - kept}
        alone = replace(case.scales, **without)
        found, expected = matrix(case.data.pairs, alone), Case(case.data, alone).fields
        assert float(expected.abs().max()) > 0.0
        assert_close(found, expected, rtol=0, atol=1e-13 * float(expected.abs().max()))
        assert_close(found, found.T, rtol=0, atol=1e-14 * float(expected.abs().max()))


def test_inner_is_the_sum_with_the_matrix_and_so_is_its_slope(case: Case) -> None:
    """Of each kind of scale, by central differences."""
    pairs = case.data.pairs
    weights = normal(*case.fields.shape, seed=4)
    point = case.scales.logarithms().requires_grad_()
    inner = pairs.inner(pairs.values(case.scales.from_logarithms(point)), weights)
    size = float((weights * matrix(pairs, case.scales)).abs().sum())
    assert float(inner.detach()) == pytest.approx(float((weights * matrix(pairs, case.scales)).sum()), abs=1e-12 * size)
    (gradient,) = torch.autograd.grad(inner, point)
    where = point.detach()
    for number, of_scale in enumerate(gradient):
        step = torch.zeros_like(where)
        step[number] = 1e-3

        def at(times: float, step: Tensor = step) -> float:
            return float((weights * matrix(pairs, case.scales.from_logarithms(where + times * step))).sum())

        expected = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / 12e-3
        assert float(of_scale) == pytest.approx(expected, rel=1e-6, abs=1e-9 * size)
