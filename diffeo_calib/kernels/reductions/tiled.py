"""Sums over tiles that stay in the processor's cache: O(M + N) memory, in plain torch.

Where rows and columns are the same points, weights are symmetric and each tile is used for both triangles
of the matrix, which halves the number of exponentials.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, Points
from diffeo_calib.kernels.reductions.pairs import MatrixPairs, weighted_sums
from diffeo_calib.kernels.reductions.pooled import PooledPairs, Symbol, pool_for

CPU_ELEMENTS = 1 << 16
"""Pairs in a tile: 512 KiB in float64, so that the few matrices of a formula stay in the cache."""
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

    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> list[Tensor]:
        """The sums of a formula, (M, k) each; rows None for the columns themselves.

        Differentiable by autograd, which stores all tiles.
        """
        symmetric, rows = rows is None, columns if rows is None else rows
        on_cpu = rows.features.device.type == "cpu"
        elements = self.elements or (CPU_ELEMENTS if on_cpu else GPU_ELEMENTS)
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        if torch.is_grad_enabled() and any(t.requires_grad for t in rows.tensors + columns.tensors):
            return _rectangular(_Sum(formula, profile, MatrixPairs()), rows, columns, summands, elements)
        pairs = PooledPairs(pool_for(elements, rows.features))
        if symmetric:
            return _symmetric(_Sum(formula, profile, pairs), rows, summands, max(1, int(elements**0.5)))
        return _rectangular(_Sum(formula, profile, pairs), rows, columns, summands, elements)


@dataclass(frozen=True)
class _Sum:
    """A formula with its profile, and the kind of symbols it is evaluated on."""

    formula: Formula
    profile: Profile
    pairs: Any

    def weights(self, rows: Points, columns: Points) -> list[Any]:
        """The symbols w_ij of one tile; a pooled one holds its buffer while it is referenced."""
        return self.formula.weights(self.pairs, self.profile, rows, columns)


def _symmetric(what: _Sum, points: Points, summands: list[Tensor], size: int) -> list[Tensor]:
    """Sums over the points themselves; visits each unordered pair of tiles once."""
    tiles = _slices(len(points.features), size)
    if len(tiles) == 1:
        return [t.T for t in _sums(what.weights(points, points), summands)]
    totals = [torch.zeros_like(b) for b in summands]  # (k, N)
    for a, i in enumerate(tiles):
        row_points = points.rows(i)
        for j in tiles[a:]:
            for total, w, b in zip(totals, what.weights(row_points, points.rows(j)), summands, strict=True):
                total[:, i].add_(b[:, j] @ w.matrix.T, alpha=w.scale)
                if i != j:
                    total[:, j].add_(b[:, i] @ w.matrix, alpha=w.scale)
    return [t.T for t in totals]


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
    """Sums over one tile of tensors or pooled symbols: (k, M) each."""
    matrices = [w.matrix if isinstance(w, Symbol) else w for w in weights]
    scales = [w.scale if isinstance(w, Symbol) else 1.0 for w in weights]
    return [s if c == 1.0 else s * c for s, c in zip(weighted_sums(matrices, summands), scales, strict=True)]


def _slices(count: int, size: int) -> list[slice]:
    return [slice(k, min(k + size, count)) for k in range(0, count, size)] or [slice(0, 0)]
