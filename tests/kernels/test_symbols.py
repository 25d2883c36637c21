"""Recorded weights: every lowering calculates like tensors, and buffers are recycled safely."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from math_bank import normal
from sum_bank import COLUMNS, ROWS, apart, assert_same, every_formula, every_profile, needs_llvmlite, points

from diffeo_calib.kernels.profiles import GaussianProfile, Profile
from diffeo_calib.kernels.reductions import tiled
from diffeo_calib.kernels.reductions.formulas import GRADIENT, Dense, Formula, matrices
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


@every_profile
@every_formula
def test_buffers_are_recycled_and_weights_hold_until_the_next_tile(formula: Formula, profile: Profile) -> None:
    i, j = apart()
    weights, elements = recorded(formula, profile), ROWS * COLUMNS + 5
    assert weights is not None
    tiled.BUFFERS.free.clear()
    made: set[int] = set()
    for k in range(3):
        found, scales = tiled._recycled(weights, elements, i, j)
        expected = formula.weigh(matrices(i, j), profile)
        assert_same([w * c for w, c in zip(found, scales, strict=True)], expected, 1e-12)
        free = tiled.BUFFERS.free[elements, torch.float64, i.features.device]
        now = {b.data_ptr() for b in (*free, *found)}
        assert not {w.data_ptr() for w in found} & {b.data_ptr() for b in free}
        assert k == 0 or now == made  # one more tile needs no new buffer
        made = now


def test_every_size_type_and_thread_has_its_own_buffers() -> None:
    one = normal(1)
    found = [tiled.BUFFERS.of(8, one), tiled.BUFFERS.of(9, one), tiled.BUFFERS.of(8, one.float())]
    thread = threading.Thread(target=lambda: found.append(tiled.BUFFERS.of(8, one)))
    thread.start()
    thread.join()
    assert len({id(free) for free in found}) == 4
    assert tiled.BUFFERS.of(8, normal(3)) is found[0]
    assert points(3, 1).features.dtype is torch.float64
