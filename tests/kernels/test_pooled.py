"""Pooled matrices: symbols calculate like tensors, and buffers are recycled safely."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch
from math_bank import normal
from sum_bank import COLUMNS, ROWS, apart, assert_same, every_formula, every_profile
from torch import Tensor

from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, MatrixPairs
from diffeo_calib.kernels.reductions.tiled import Pool, PooledPairs, Symbol, pool_for

M, N = 3, 4


class Counting(Pool):
    """A pool that counts the buffers it has allocated."""

    made = 0

    def take(self) -> Tensor:
        self.made += not self.free
        return super().take()


def value(symbol: Symbol) -> Tensor:
    return symbol.scale * symbol.matrix


OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "x + y": lambda x, y: x + y,
    "3 x + 2 y": lambda x, y: 3.0 * x + 2.0 * y,
    "x + 2": lambda x, y: x + 2.0,
    "2 - 4 x": lambda x, y: 2.0 + -4.0 * x,
    "x + x": lambda x, y: x + x,
    "x y": lambda x, y: x * y,
    "x x": lambda x, y: x * x,
    "3 x 2 y": lambda x, y: (3.0 * x) * (y * 2.0),
    "x / y": lambda x, y: x / y,
    "x / 3": lambda x, y: x / 3.0,
    "1 / x": lambda x, y: 1.0 / x,
    "5 / 2 x": lambda x, y: 5.0 / (2.0 * x),
    "-x": lambda x, y: -x,
    "0 x": lambda x, y: x * 0.0,
    "0 x + 3": lambda x, y: x * 0.0 + 3.0,
    "0 x + 2 y": lambda x, y: x * 0.0 + y * 2.0,
    "exp": lambda x, y: x.exp(),
    "exp -x/2": lambda x, y: (x * -0.5).exp(),
    "relu": lambda x, y: (2.0 * x).relu(),
    "sqrt": lambda x, y: (x * x * 4.0).sqrt(),
    "nested": lambda x, y: 1.0 / (1.0 + (x * x + y * (x + y)).exp()) * y + (3.0 * x).relu(),
}


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS.keys())
@pytest.mark.parametrize("evaluated", [(), (0,), (1,), (0, 1)])
def test_symbols_calculate_like_tensors(operation: Callable[[Any, Any], Any], evaluated: tuple[int, ...]) -> None:
    """With and without matrices evaluated before; twice, since no operation may overwrite its operands."""
    pool = Counting(M * N + 5, normal(1))
    factors = [(normal(M, 2, seed=k), normal(N, 2, seed=k + 1)) for k in (1, 3)]
    symbols, tensors = [PooledPairs(pool).dot(a, b) for a, b in factors], [a @ b.T for a, b in factors]
    for k in evaluated:
        assert_same([value(symbols[k])], [tensors[k]], 1e-14)
    results = [operation(*symbols), operation(*symbols)]
    assert_same(map(value, (*results, *symbols)), (*(2 * [operation(*tensors)]), *tensors), 1e-14)


@every_profile
@every_formula
def test_buffers_return_to_the_pool_and_live_ones_are_never_overwritten(formula: Formula, profile: Profile) -> None:
    pool = Counting(ROWS * COLUMNS, normal(1))
    i, j = apart()
    kept = [formula.weights(PooledPairs(pool), profile, i, j) for _ in range(3)]
    tiles = [{w.matrix.data_ptr() for w in weights} for weights in kept]
    assert len(set().union(*tiles)) == 3 * len(tiles[0])
    assert set().union(*tiles).isdisjoint(b.data_ptr() for b in pool.free)
    expected = formula.weights(MatrixPairs(), profile, i, j)
    for weights in kept:
        assert_same(map(value, weights), expected, 1e-12)
    del weights
    kept.clear()
    assert len({b.data_ptr() for b in pool.free}) == len(pool.free) == pool.made
    for w in formula.weights(PooledPairs(pool), profile, i, j):
        assert w.matrix.shape == (ROWS, COLUMNS)
    del w
    assert len(pool.free) == pool.made  # one more tile needs no new buffer


def test_every_size_type_and_thread_has_its_own_pool() -> None:
    found = [pool_for(8, normal(1)), pool_for(9, normal(1)), pool_for(8, normal(1).float())]
    thread = threading.Thread(target=lambda: found.append(pool_for(8, normal(1))))
    thread.start()
    thread.join()
    assert len({id(pool) for pool in found}) == 4
    assert pool_for(8, normal(3)) is found[0]
    assert found[2].take().dtype is torch.float32
