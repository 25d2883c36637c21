"""Matrices whose memory is used again: pairwise scalars of one tile, for sums that are not differentiated.

Fresh memory for every intermediate matrix of a tile costs more than the arithmetic on it (page faults);
here an intermediate gives its buffer back as soon as nothing refers to it. The symbols understand the
same operators as tensors and LazyTensors, so formulas need not know.
"""

from __future__ import annotations

import threading

import torch
from torch import Tensor

from diffeo_calib.reductions.pairs import distance_change_factors, distance_factors


class Pool:
    """Buffers of one size that are free at the moment."""

    def __init__(self, elements: int, like: Tensor) -> None:
        self.elements, self.dtype, self.device = elements, like.dtype, like.device
        self.free: list[Tensor] = []

    def take(self) -> Tensor:
        """A flat buffer with arbitrary contents."""
        return self.free.pop() if self.free else torch.empty(self.elements, dtype=self.dtype, device=self.device)


class PooledMatrix:
    """An (M, N) matrix in a buffer that goes back to its pool with the last reference."""

    __slots__ = ("_buffer", "matrix", "pool")

    def __init__(self, pool: Pool, m: int, n: int) -> None:
        self.pool, self._buffer = pool, pool.take()
        self.matrix = self._buffer[: m * n].view(m, n)

    def __del__(self) -> None:
        self.pool.free.append(self._buffer)

    def _new(self) -> PooledMatrix:
        return PooledMatrix(self.pool, *self.matrix.shape)

    def __mul__(self, other: PooledMatrix | float) -> PooledMatrix:
        out = self._new()
        torch.mul(self.matrix, other.matrix if isinstance(other, PooledMatrix) else other, out=out.matrix)
        return out

    def __add__(self, other: PooledMatrix | float) -> PooledMatrix:
        out = self._new()
        torch.add(self.matrix, other.matrix if isinstance(other, PooledMatrix) else other, out=out.matrix)
        return out

    def __truediv__(self, other: PooledMatrix | float) -> PooledMatrix:
        out = self._new()
        torch.div(self.matrix, other.matrix if isinstance(other, PooledMatrix) else other, out=out.matrix)
        return out

    def __rtruediv__(self, other: float) -> PooledMatrix:
        out = self._new()
        torch.reciprocal(self.matrix, out=out.matrix)
        if other != 1.0:
            out.matrix.mul_(other)
        return out

    __rmul__, __radd__ = __mul__, __add__

    def __neg__(self) -> PooledMatrix:
        return self * -1.0

    def exp(self) -> PooledMatrix:
        """Elementwise."""
        out = self._new()
        torch.exp(self.matrix, out=out.matrix)
        return out

    def sqrt(self) -> PooledMatrix:
        """Elementwise."""
        out = self._new()
        torch.sqrt(self.matrix, out=out.matrix)
        return out

    def relu(self) -> PooledMatrix:
        """max(x, 0), elementwise."""
        out = self._new()
        torch.clamp(self.matrix, min=0.0, out=out.matrix)
        return out


class PooledPairs:
    """Pairwise symbols as pooled matrices."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool

    def dot(self, a: Tensor, b: Tensor) -> PooledMatrix:
        """a_i . b_j: (M, k), (N, k) -> (M, N)."""
        out = PooledMatrix(self.pool, len(a), len(b))
        torch.mm(a, b.T, out=out.matrix)
        return out

    def squared_distance(self, e: Tensor, f: Tensor) -> PooledMatrix:
        """|e_i - f_j|^2 to rounding: (M, D), (N, D) -> (M, N)."""
        return self.dot(*distance_factors(e, f))

    def squared_distance_change(self, e: Tensor, de: Tensor, f: Tensor, df: Tensor) -> PooledMatrix:
        """2 (e_i - f_j) . (de_i - df_j): (M, N)."""
        return self.dot(*distance_change_factors(e, de, f, df))


class _Pools(threading.local):
    def __init__(self) -> None:
        self.pools: dict[tuple[int, torch.dtype, torch.device], Pool] = {}


_POOLS = _Pools()


def pool_for(elements: int, like: Tensor) -> Pool:
    """This thread's pool of buffers with so many elements."""
    return _POOLS.pools.setdefault((elements, like.dtype, like.device), Pool(elements, like))
