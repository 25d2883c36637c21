"""Covariance of numbers by the fields: that of the linearised model, and derivatives by the scales."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from process_bank import Case
from tangent_bank import normal
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.process.scales import Hyperparameters, Pairs


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
