"""Recorded weights: every lowering calculates like tensors, and buffers are recycled safely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from sum_bank import apart, assert_same, needs_llvmlite

from diffeo_calib.kernels.profiles import GaussianProfile, Profile
from diffeo_calib.kernels.reductions.formulas import GRADIENT, Dense, Formula
from diffeo_calib.kernels.reductions.fused import Fused
from diffeo_calib.kernels.reductions.symbols import recorded
from diffeo_calib.kernels.reductions.tiled import Tiled

OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "x + y": lambda x, y: x + y,
    "3 x + 2 y": lambda x, y: 3.0 * x + 2.0 * y,
    "x - y": lambda x, y: x - y,
    "x + 2": lambda x, y: x + 2.0,
    "2 - 4 x": lambda x, y: 2.0 - 4.0 * x,
    "x + x": lambda x, y: x + x,
    "x y": lambda x, y: x * y,
    "3 x 2 y": lambda x, y: (3.0 * x) * (y * 2.0),
    "y / (1 + x)": lambda x, y: y / (1.0 + x),
    "x / 3": lambda x, y: x / 3.0,
    "5 / (2 + 2 x)": lambda x, y: 5.0 / (2.0 + 2.0 * x),
    "(1 + x)^3": lambda x, y: (1.0 + x) ** 3,
    "(1 + x)^-2": lambda x, y: (1.0 + x) ** -2,
    "0 x": lambda x, y: x * 0.0,
    "0 x + 3": lambda x, y: x * 0.0 + 3.0,
    "0 x + 2 y": lambda x, y: x * 0.0 + y * 2.0,
    "exp y": lambda x, y: y.exp(),
    "exp -x/2": lambda x, y: (x * -0.5).exp(),
    "relu y": lambda x, y: (2.0 * y).relu(),
    "relu -y": lambda x, y: (-2.0 * y).relu(),
    "sqrt x": lambda x, y: (x * 4.0).relu().sqrt(),
    "constant": lambda x, y: ((x * 0.0 + 4.0).sqrt() + (x * 0.0).exp()).relu().square(),
    "nested": lambda x, y: 1.0 / (1.0 + (x * x - y * (x + y)).exp()) * y + (3.0 * y).relu(),
}


def formulated(function: Callable[[Any, Any], Any]) -> Formula:
    """A field whose weight is any function of r2 and s, and the gradient's."""

    def weigh(leaf: Callable[[str], Any], profile: Profile) -> list[Any]:
        # the last summand is for matrices, where a constant is no matrix
        return [function(leaf("r2"), leaf("s")) + 0.0 * leaf("s"), GRADIENT.weigh(leaf, profile)[1]]

    return replace(GRADIENT, weigh=weigh)


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS.keys())
@pytest.mark.parametrize("backend", [Tiled(), Tiled(6), pytest.param(Fused(), marks=needs_llvmlite)])
def test_symbols_calculate_like_tensors(operation: Callable[[Any, Any], Any], backend: Any) -> None:
    i, j = apart()
    formula = formulated(operation)
    assert recorded(formula, GaussianProfile()) is not None
    found = backend.reduce(formula, GaussianProfile(), i, j)
    assert_same(found, Dense().reduce(formula, GaussianProfile(), i, j), 1e-11)
