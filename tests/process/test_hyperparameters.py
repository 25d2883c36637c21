"""Scales of kernels, priors and noise: what they do to covariances, scales derived from them, and slopes by them."""

from dataclasses import replace

import pytest
import torch
from process_bank import Case
from tangent_bank import Setting, normal
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.process.scales import NEGLIGIBLE_DISPLACEMENT, SCALES, GearLine, Hyperparameters, Pairs


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
