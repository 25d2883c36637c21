"""Matrices in recycled memory: pairwise scalars of one tile, for sums without autograd.

Allocating every intermediate matrix of a tile costs more than the arithmetic on it (page faults), so
intermediates return their buffers to a pool as soon as nothing refers to them. Products with numbers are
free: a symbol is a matrix times a scale, and dot products are computed only when they are needed. Symbols
support the operators of tensors and LazyTensors, so the same formulas run on them.
"""

from __future__ import annotations

import threading
from math import log

import torch
from torch import Tensor

from diffeo_calib.kernels.reductions.pairs import distance_change_factors, distance_factors


class Pool:
    """A pool of free buffers of one size."""

    def __init__(self, elements: int, like: Tensor) -> None:
        self.elements, self.dtype, self.device = elements, like.dtype, like.device
        self.free: list[Tensor] = []

    def take(self) -> Tensor:
        """A flat buffer with arbitrary contents."""
        return self.free.pop() if self.free else torch.empty(self.elements, dtype=self.dtype, device=self.device)


class Matrix:
    """An (M, N) matrix whose buffer returns to the pool with the last reference."""

    __slots__ = ("_buffer", "pool", "values")

    def __init__(self, pool: Pool, m: int, n: int) -> None:
        self.pool, self._buffer = pool, pool.take()
        self.values = self._buffer[: m * n].view(m, n)

    def __del__(self) -> None:
        self.pool.free.append(self._buffer)


class Symbol:
    """scale * matrix, or scale * (left_i . right_j), not yet computed.

    Args:
        pool: source of new matrices.
        scale: a factor that is applied to the sums, not to the matrix.
        matrix: the values.
        factors: vectors (M, k), (N, k) whose dot products are the values, where no matrix exists yet.
    """

    __slots__ = ("_factors", "_matrix", "pool", "scale")

    def __init__(
        self, pool: Pool, scale: float, matrix: Matrix | None = None, factors: tuple[Tensor, Tensor] | None = None
    ) -> None:
        self.pool, self.scale, self._matrix, self._factors = pool, scale, matrix, factors

    @property
    def matrix(self) -> Tensor:
        """The values without the scale."""
        return self._evaluated().values

    def _evaluated(self) -> Matrix:
        if self._matrix is None:
            self._matrix = self._product(1.0)
        return self._matrix

    def _product(self, scale: float) -> Matrix:
        """The dot products times a number, in a new matrix."""
        if self._factors is None:
            raise RuntimeError("a symbol needs a matrix or factors")
        left, right = self._factors
        out = Matrix(self.pool, len(left), len(right))
        # Reading the right factors along their rows saves a third of this product's time.
        torch.mm(left if scale == 1.0 else left * scale, right.T.contiguous(), out=out.values)
        return out

    def _fresh(self) -> tuple[Tensor, Matrix]:
        """The values, and a matrix for a result: the same one if nothing else will read it."""
        if self._matrix is None:
            own = self._product(1.0)
            return own.values, own
        values = self._matrix.values
        return values, Matrix(self.pool, *values.shape)

    def __mul__(self, other: Symbol | float) -> Symbol:
        if not isinstance(other, Symbol):
            return Symbol(self.pool, self.scale * other, self._matrix, self._factors)
        a = self._evaluated().values
        b, out = other._fresh()
        torch.mul(a, b, out=out.values)
        return Symbol(self.pool, self.scale * other.scale, out)

    def __add__(self, other: Symbol | float) -> Symbol:
        if self.scale == 0.0:
            return self._constant(other) if not isinstance(other, Symbol) else other
        a, out = self._fresh()
        if isinstance(other, Symbol):
            torch.add(a, other.matrix, alpha=other.scale / self.scale, out=out.values)
        else:
            torch.add(a, other / self.scale, out=out.values)
        return Symbol(self.pool, self.scale, out)

    def __truediv__(self, other: Symbol | float) -> Symbol:
        return self * (1.0 / other)

    def __rtruediv__(self, other: float) -> Symbol:
        a, out = self._fresh()
        torch.reciprocal(a, out=out.values)
        return Symbol(self.pool, other / self.scale, out)

    __rmul__, __radd__ = __mul__, __add__

    def __neg__(self) -> Symbol:
        return self * -1.0

    def exp(self) -> Symbol:
        """Elementwise, as a power of 2: torch takes four fifths of the time for those, and the factor costs nothing."""
        factor = self.scale / log(2.0)
        if self._matrix is None:
            out = self._product(factor)
            out.values.exp2_()
        else:
            out = Matrix(self.pool, *self.matrix.shape)
            torch.mul(self.matrix, factor, out=out.values).exp2_()
        return Symbol(self.pool, 1.0, out)

    def sqrt(self) -> Symbol:
        """Elementwise, of a positive multiple of a matrix."""
        self._check_positive()
        a, out = self._fresh()
        torch.sqrt(a, out=out.values)
        return Symbol(self.pool, self.scale**0.5, out)

    def relu(self) -> Symbol:
        """max(x, 0), elementwise, of a positive multiple of a matrix."""
        self._check_positive()
        a, out = self._fresh()
        torch.clamp(a, min=0.0, out=out.values)
        return Symbol(self.pool, self.scale, out)

    def _check_positive(self) -> None:
        if self.scale <= 0.0:
            raise RuntimeError("sqrt and relu of a negative multiple are not implemented: no profile needs them")

    def _constant(self, value: float) -> Symbol:
        out = Matrix(self.pool, *self.matrix.shape)
        out.values.fill_(value)
        return Symbol(self.pool, 1.0, out)


class PooledPairs:
    """Pairwise symbols as pooled matrices."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool

    def dot(self, a: Tensor, b: Tensor) -> Symbol:
        """a_i . b_j: (M, k), (N, k) -> (M, N)."""
        return Symbol(self.pool, 1.0, factors=(a, b))

    def squared_distance(self, e: Tensor, f: Tensor) -> Symbol:
        """|e_i - f_j|^2 to rounding: (M, D), (N, D) -> (M, N)."""
        return self.dot(*distance_factors(e, f))

    def squared_distance_change(self, e: Tensor, de: Tensor, f: Tensor, df: Tensor) -> Symbol:
        """2 (e_i - f_j) . (de_i - df_j): (M, N)."""
        return self.dot(*distance_change_factors(e, de, f, df))


class _Pools(threading.local):
    def __init__(self) -> None:
        self.pools: dict[tuple[int, torch.dtype, torch.device], Pool] = {}


_POOLS = _Pools()


def pool_for(elements: int, like: Tensor) -> Pool:
    """This thread's pool of buffers with ``elements`` numbers of the type and device of ``like``."""
    return _POOLS.pools.setdefault((elements, like.dtype, like.device), Pool(elements, like))
