"""Sums over tiles that stay in the processor's cache: O(M + N) memory, in plain torch.

Where rows and columns are the same points, weights are symmetric and each tile is used for both triangles
of the matrix, which halves the number of exponentials.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.threads import in_parallel, small_work
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, Points
from diffeo_calib.kernels.reductions.pairs import MatrixPairs, weighted_sums
from diffeo_calib.kernels.reductions.pooled import PooledPairs, Symbol, pool_for

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
GPU_ELEMENTS = 1 << 26
"""Pairs in a tile on an accelerator, enough work for one launch: 512 MiB in float64."""


@dataclass(frozen=True)
class Tiled:
    """Evaluates one tile after the other.

    Args:
        elements: pairs in a tile; by default a number that suits the device.
        totals: precision in which tiles are added up; by default that of the points.
    """

    elements: int | None = None
    totals: torch.dtype | None = None
    differentiable: ClassVar[bool] = True

    def usable(self) -> bool:
        """Always."""
        return True

    @small_work()
    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> list[Tensor]:
        """The sums of a formula, (M, k) each; rows None for the columns themselves.

        Differentiable by autograd, which stores all tiles.
        """
        at = columns if rows is None else rows
        if torch.is_grad_enabled() and any(t.requires_grad for t in at.tensors + columns.tensors):
            summands = [b.T.contiguous() for b in formula.summands(columns)]
            return _rectangular(_Sum(formula, profile), at, columns, summands, self._elements(at.features.device))
        return self.share(formula, profile, rows, columns)

    @small_work()
    def share(
        self,
        formula: Formula,
        profile: Profile,
        rows: Points | None,
        columns: Points,
        mine: Callable[[Sequence[Any]], list[Any]] | None = None,
    ) -> list[Tensor]:
        """A share of the sums of a formula, full size: the shares of all processes add up to :meth:`reduce`.

        Not differentiable by autograd.

        Args:
            mine: chooses from rows of tiles, or from slices of rows, those of this process; None for all of them.
        """
        at = columns if rows is None else rows
        elements, parts = self._elements(at.features.device), PARTS if _large(at, columns) else 1
        what = _Sum(formula, profile, elements, self.totals)
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        if rows is None:
            side, chosen = max(1, int(elements**0.5)), mine or list
            return _symmetric(what, at, summands, side, lambda tiles: _dealt(chosen(tiles), parts))
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
        totals: precision of the sum over tiles, if not that of the points.
    """

    formula: Formula
    profile: Profile
    elements: int | None = None
    totals: torch.dtype | None = None

    def zeros(self, like: Tensor, *shape: int) -> Tensor:
        """Where tiles are added up."""
        return torch.zeros(shape, dtype=self.totals or like.dtype, device=like.device)

    def weights(self, rows: Points, columns: Points) -> list[Any]:
        """The symbols w_ij of one tile; a pooled one holds its buffer while it is referenced."""
        pairs = MatrixPairs() if self.elements is None else PooledPairs(pool_for(self.elements, rows.features))
        return self.formula.weights(pairs, self.profile, rows, columns)


def _symmetric(
    what: _Sum, points: Points, summands: list[Tensor], size: int, own: Callable[[Sequence[Any]], list[list[int]]]
) -> list[Tensor]:
    """Sums over the points themselves; visits each unordered pair of tiles once.

    Args:
        size: points on a side of a tile.
        own: chooses from rows of tiles those to compute, in parts that run in parallel.
    """
    tiles = _slices(len(points.features), size)
    dealt = own(range(len(tiles)))
    if len(tiles) == 1 and dealt:
        return [
            t.T if what.totals is None else t.T.to(what.totals) for t in _sums(what.weights(points, points), summands)
        ]

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
    for sums in in_parallel(part, dealt):
        totals = sums if totals is None else [total.add_(more) for total, more in zip(totals, sums, strict=True)]
    return [t.T for t in (totals or [what.zeros(b, *b.shape) for b in summands])]


def _dealt(tile_rows: list[int], parts: int) -> list[list[int]]:
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
            part = part if what.totals is None else [p.to(what.totals) for p in part]
            total = part if total is None else [t + p for t, p in zip(total, part, strict=True)]
        parts.append(total)
    return [torch.cat(column, dim=1).T for column in zip(*parts, strict=True)]


def _sums(weights: list[Any], summands: list[Tensor]) -> list[Tensor]:
    """Sums over one tile of tensors or pooled symbols: (k, M) each."""
    matrices = [w.matrix if isinstance(w, Symbol) else w for w in weights]
    scales = [w.scale if isinstance(w, Symbol) else 1.0 for w in weights]
    return [s if c == 1.0 else s * c for s, c in zip(weighted_sums(matrices, summands), scales, strict=True)]


def _slices(count: int, size: int) -> list[slice]:
    return [slice(k, min(k + size, count)) for k in range(0, count, size)] or [slice(0, 0)]
