"""Sums over tiles that stay in the processor's cache: O(M + N) memory, in plain torch.

Where rows and columns are the same points, weights are symmetric and each tile is used for both triangles
of the matrix, which halves the number of exponentials.

Without autograd, tiles are matrices in recycled memory: allocating every intermediate matrix of a tile costs more than
the arithmetic on it (page faults), so intermediates return their buffers to a pool as soon as nothing refers to them.
Products with numbers are free: a symbol is a matrix times a scale, and dot products are computed only when they are
needed. Symbols support the operators of tensors and LazyTensors, so the same formulas run on them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from math import inf, log
from time import perf_counter
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.threads import in_parallel, small_work
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, MatrixPairs, Points, Unknown, weighted_sums

CPU_ELEMENTS = 1 << 18
"""Pairs in a tile: 2 MiB in float64. Its operations last so long that Python's own time is small, and that threads wait
rarely for its lock; the few matrices of a formula stay in a usual cache."""
LARGE_PAIRS = 1 << 22
"""Pairs from which a sum on a CPU runs in several threads."""
PARTS = 16
"""Parts of a sum that runs in several threads. Their number does not depend on that of the threads, so that the result
is the same to the last digit; they are many, so that a thread that loses its core to another process does fewer."""
SHARED_PARTS = 64
"""Slices of rows that several processes share."""
TIMED_NUMBERS, TIMINGS = 1 << 13, 20
"""Exponentials of a measurement, a tenth of a millisecond of each function, and its repetitions."""
CLEARLY_LESS = 0.85
"""Ratio of times that counts: a smaller difference could be decided otherwise in the next process."""
GPU_ELEMENTS = 1 << 26
"""Pairs in a tile on an accelerator, enough work for one launch: 512 MiB in float64."""


@dataclass(frozen=True)
class Tiled:
    """Evaluates one tile after the other.

    Args:
        elements: pairs in a tile; by default a number that suits the device.
    """

    elements: int | None = None
    differentiable: ClassVar[bool] = True

    def usable(self) -> bool:
        """Always."""
        return True

    @small_work()
    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
        """The results of a formula, M rows each; rows None for the columns themselves.

        Differentiable by autograd, which stores all tiles.
        """
        at = columns if rows is None else rows
        if torch.is_grad_enabled() and any(t.requires_grad for t in at.tensors + columns.tensors):
            summands = [b.T.contiguous() for b in formula.summands(columns)]
            sums = _rectangular(_Sum(formula, profile), at, columns, summands, self._elements(at.features.device))
        else:
            sums = self.share(formula, profile, rows, columns)
        return formula.finish(sums, at)

    @small_work()
    def share(
        self,
        formula: Formula,
        profile: Profile,
        rows: Points | None,
        columns: Points,
        mine: Callable[[Sequence[Any]], list[Any]] | None = None,
    ) -> list[Tensor]:
        """The sums of a formula before :meth:`Formula.finish`, or a share of them; the shares of all processes add up.

        Not differentiable by autograd.

        Args:
            mine: chooses from rows of tiles, or from slices of rows, those of this process; None for all of them.
        """
        at = columns if rows is None else rows
        elements, parts = self._elements(at.features.device), PARTS if _large(at, columns) else 1
        what = _Sum(formula, profile, elements)
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        if rows is None:
            side, chosen = max(1, int(elements**0.5)), mine or list
            return _symmetric(what, at, summands, side, lambda tiles: dealt(chosen(tiles), parts))
        slices = _slices(len(at.features), -(-len(at.features) // (parts if mine is None else SHARED_PARTS)))
        slices = slices if mine is None else mine(slices)
        sums = list(in_parallel(lambda i: _rectangular(what, at.rows(i), columns, summands, elements), slices))
        if mine is None:
            return [torch.cat(part) for part in zip(*sums, strict=True)]
        totals = [what.zeros(b, len(b), len(at.features)).T for b in summands]
        for i, found in zip(slices, sums, strict=True):
            for total, own in zip(totals, found, strict=True):
                total[i] = own
        return totals

    def _elements(self, device: torch.device) -> int:
        """Pairs in a tile."""
        return self.elements or (CPU_ELEMENTS if device.type == "cpu" else GPU_ELEMENTS)


def _large(rows: Points, columns: Points) -> bool:
    """Whether a sum runs in several threads."""
    return rows.features.device.type == "cpu" and len(rows.features) * len(columns.features) >= LARGE_PAIRS


@dataclass(frozen=True)
class _Sum:
    """A formula with its profile.

    Args:
        elements: size of the buffers that intermediate matrices recycle; None where autograd needs all of them.
    """

    formula: Formula
    profile: Profile
    elements: int | None = None

    def zeros(self, like: Tensor, *shape: int) -> Tensor:
        """Where tiles are added up."""
        return torch.zeros(shape, dtype=like.dtype, device=like.device)

    def weights(self, rows: Points, columns: Points) -> list[Any]:
        """The weights w_ij of one tile, matrices with a scale; a pooled one holds its buffer while it is referenced."""
        if self.elements is not None:
            pool = pool_for(self.elements, rows.features)
            with suppress(Exception):  # a profile of the user may need operations that symbols lack, and raise anything
                return self.formula.weights(PooledPairs(pool), self.profile, rows, columns)
        return [_Plain(w) for w in self.formula.weights(MatrixPairs(), self.profile, rows, columns)]


class _Plain(NamedTuple):
    """A weight that is a tensor."""

    matrix: Tensor
    scale: float = 1.0


def _symmetric(
    what: _Sum, points: Points, summands: list[Tensor], size: int, own: Callable[[Sequence[Any]], list[list[int]]]
) -> list[Tensor]:
    """Sums over the points themselves; visits each unordered pair of tiles once.

    Args:
        size: points on a side of a tile.
        own: chooses from rows of tiles those to compute, in parts that run in parallel.
    """
    tiles = _slices(len(points.features), size)
    chosen = own(range(len(tiles)))
    if len(tiles) == 1 and chosen:
        return [t.T for t in _sums(what.weights(points, points), summands)]

    def part(tile_rows: list[int]) -> list[Tensor]:
        """Some rows of tiles, from the diagonal on, and their mirror images: (k, N) each."""
        totals = [what.zeros(b, *b.shape) for b in summands]
        for a in tile_rows:
            i = tiles[a]
            row_points = points.rows(i)
            for j in tiles[a:]:
                for total, w, b in zip(totals, what.weights(row_points, points.rows(j)), summands, strict=True):
                    total[:, i].add_(b[:, j] @ w.matrix.T, alpha=w.scale)
                    if i != j:
                        total[:, j].add_(b[:, i] @ w.matrix, alpha=w.scale)
        return totals

    totals: list[Tensor] | None = None
    for sums in in_parallel(part, chosen):
        totals = sums if totals is None else [total.add_(more) for total, more in zip(totals, sums, strict=True)]
    return [t.T for t in (totals or [what.zeros(b, *b.shape) for b in summands])]


def dealt(tile_rows: list[int], parts: int) -> list[list[int]]:
    """Rows of a triangle of tiles in parts of about equal area: dealt there and back, since later rows are shorter."""
    found: list[list[int]] = [[] for _ in range(parts)]
    for k, row in enumerate(tile_rows):
        found[min(k % (2 * parts), 2 * parts - 1 - k % (2 * parts))].append(row)
    return [part for part in found if part]


def _rectangular(what: _Sum, rows: Points, columns: Points, summands: list[Tensor], elements: int) -> list[Tensor]:
    """Row tiles of the result, each summed over column tiles, without in-place operations (for autograd)."""
    m, n = len(rows.features), len(columns.features)
    height = max(1, min(m, max(int(elements**0.5), elements // max(n, 1))))
    widths = _slices(n, max(1, elements // height))
    parts = []
    for i in _slices(m, height):
        total: list[Tensor] | None = None
        for j in widths:
            part = _sums(what.weights(rows.rows(i), columns.rows(j)), [b[:, j] for b in summands])
            total = part if total is None else [t + p for t, p in zip(total, part, strict=True)]
        parts.append(total)
    return [torch.cat(column, dim=1).T for column in zip(*parts, strict=True)]


def _sums(weights: list[Any], summands: list[Tensor]) -> list[Tensor]:
    """Sums over one tile: (k, M) each."""
    sums = weighted_sums([w.matrix for w in weights], summands)
    return [s if w.scale == 1.0 else s * w.scale for s, w in zip(sums, weights, strict=True)]


def _slices(count: int, size: int) -> list[slice]:
    return [slice(k, min(k + size, count)) for k in range(0, count, size)] or [slice(0, 0)]


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


class Symbol(Unknown):
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
            return Symbol(self.pool, self.scale * float(other), self._matrix, self._factors)
        a = self._evaluated().values
        b, out = other._fresh()
        torch.mul(a, b, out=out.values)
        return Symbol(self.pool, self.scale * other.scale, out)

    def __add__(self, other: Symbol | float) -> Symbol:
        if self.scale == 0.0:
            if isinstance(other, Symbol):
                return other
            out = Matrix(self.pool, *self.matrix.shape)
            out.values.fill_(other)
            return Symbol(self.pool, 1.0, out)
        a, out = self._fresh()
        if isinstance(other, Symbol):
            torch.add(a, other.matrix, alpha=other.scale / self.scale, out=out.values)
        else:
            torch.add(a, float(other) / self.scale, out=out.values)
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
        """Elementwise, by the faster of two functions: the factor between them costs nothing."""
        power = powers_of_two_are_faster(self.pool.device.type, self.pool.dtype)
        factor = self.scale / log(2.0) if power else self.scale
        if self._matrix is None:
            out = self._product(factor)
        else:
            out = Matrix(self.pool, *self.matrix.shape)
            torch.mul(self.matrix, factor, out=out.values)
        (torch.exp2 if power else torch.exp)(out.values, out=out.values)
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


@cache
def powers_of_two_are_faster(device: str, dtype: torch.dtype) -> bool:
    """Whether exp2 takes clearly less time here than exp: half on some processors, twice on others. Takes 1 ms."""
    if device != "cpu":
        return False
    numbers = torch.linspace(-20.0, 0.0, TIMED_NUMBERS, dtype=dtype, device=device)
    out, seconds = torch.empty_like(numbers), {torch.exp: inf, torch.exp2: inf}
    for _ in range(TIMINGS):
        for function, least in seconds.items():
            begin = perf_counter()
            function(numbers, out=out)
            seconds[function] = min(least, perf_counter() - begin)
    return seconds[torch.exp2] < CLEARLY_LESS * seconds[torch.exp]


class PooledPairs(MatrixPairs):
    """Pairwise symbols as pooled matrices."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool

    def dot(self, a: Tensor, b: Tensor) -> Symbol:
        """a_i . b_j: (M, k), (N, k) -> (M, N)."""
        return Symbol(self.pool, 1.0, factors=(a, b))


class _Pools(threading.local):
    def __init__(self) -> None:
        self.pools: dict[tuple[int, torch.dtype, torch.device], Pool] = {}


_POOLS = _Pools()


def pool_for(elements: int, like: Tensor) -> Pool:
    """This thread's pool of buffers with ``elements`` numbers of the type and device of ``like``."""
    return _POOLS.pools.setdefault((elements, like.dtype, like.device), Pool(elements, like))
