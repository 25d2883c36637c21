"""Sums over tiles that stay in the processor's cache: O(M + N) memory, in plain torch.

Where rows and columns are the same points, weights are symmetric and each tile is used for both triangles
of the matrix, which halves the number of exponentials.

Without autograd, the operations of :class:`Weights` run in recycled memory: allocating every intermediate matrix of a
tile costs more than the arithmetic on it (page faults).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial, reduce
from math import inf, log
from time import perf_counter
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.threads import in_parallel, small_work
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import (
    LEAVES,
    Formula,
    Points,
    SumBackend,
    factors,
    matrices,
    weighted_sums,
)
from diffeo_calib.kernels.reductions.symbols import Weights, recorded

CPU_ELEMENTS = 1 << 18
"""Pairs in a tile: 2 MiB in float64. Its operations last so long that Python's own time is small, and that threads wait
rarely for its lock; the few matrices of a formula stay in a usual cache."""
LARGE_PAIRS = 1 << 22  # pairs from which a sum on a CPU runs in several threads
PARTS = 16
"""Parts of a sum that runs in several threads. Their number does not depend on that of the threads, so that the result
is the same to the last digit; they are many, so that a thread that loses its core to another process does fewer."""
SHARED_PARTS = 64  # slices of rows that several processes share
TIMED_NUMBERS, TIMINGS = 1 << 13, 20
"""Exponentials of a measurement, a tenth of a millisecond of each function, and its repetitions."""
CLEARLY_LESS = 0.85  # ratio of times that counts: a smaller difference could be decided otherwise in the next process
GPU_ELEMENTS = 1 << 26  # pairs in a tile on an accelerator, enough work for one launch: 512 MiB in float64
Weighing = Callable[[Points, Points], tuple[list[Tensor], list[float]]]
"""The weights of one tile, matrices (M, N) and their scales; they hold until its next call in the same thread."""
Chosen = Callable[[Sequence[Any]], list[Any]]
"""Chooses from rows of tiles, or from slices of rows, those of this process."""


@dataclass(frozen=True)
class Tiled(SumBackend):
    """Evaluates one tile after the other."""

    elements: int | None = None  # pairs in a tile; by default a number that suits the device
    differentiable: ClassVar[bool] = True

    @small_work()
    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
        """As :meth:`SumBackend.reduce`. Differentiable by autograd, which stores all tiles."""
        at = columns if rows is None else rows
        if torch.is_grad_enabled() and any(t.requires_grad for t in at.tensors + columns.tensors):
            summands = [b.T.contiguous() for b in formula.summands(columns)]
            weigh = partial(_plain, formula, profile)
            return formula.finish(_rectangular(weigh, at, columns, summands, self._elements(columns)), at)
        return formula.finish(self.share(formula, profile, rows, columns), at)

    @small_work()
    def share(
        self, formula: Formula, profile: Profile, rows: Points | None, columns: Points, mine: Chosen | None = None
    ) -> list[Tensor]:
        """The sums of a formula before :meth:`Formula.finish`, or a share of them; the shares of all processes add up.

        Not differentiable by autograd.

        Args:
            mine: chooses from rows of tiles, or from slices of rows, those of this process; None for all of them.
        """
        at, elements = columns if rows is None else rows, self._elements(columns)
        pairs = len(at.features) * len(columns.features)
        parts = PARTS if at.features.device.type == "cpu" and pairs >= LARGE_PAIRS else 1
        weights = recorded(formula, profile)
        weigh: Weighing = partial(_plain, formula, profile)
        if weights is not None:
            weigh = partial(_recycled, weights, elements)
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        if rows is None:
            chosen = mine or list
            return _symmetric(weigh, at, summands, max(1, int(elements**0.5)), lambda t: dealt(chosen(t), parts))
        slices = _slices(len(at.features), -(-len(at.features) // (parts if mine is None else SHARED_PARTS)))
        slices = slices if mine is None else mine(slices)
        totals = [b.new_zeros(len(at.features), len(b)) for b in summands]
        for i, sums in zip(
            slices,
            in_parallel(lambda i: _rectangular(weigh, at.rows(i), columns, summands, elements), slices),
            strict=True,
        ):
            for total, part in zip(totals, sums, strict=True):
                total[i] = part
        return totals

    def _elements(self, points: Points) -> int:
        return self.elements or (CPU_ELEMENTS if points.features.device.type == "cpu" else GPU_ELEMENTS)


def _symmetric(
    weigh: Weighing, points: Points, summands: list[Tensor], size: int, own: Callable[[Sequence[Any]], list[list[int]]]
) -> list[Tensor]:
    """Sums over the points themselves; visits each unordered pair of tiles once.

    Args:
        size: points on a side of a tile.
        own: chooses from rows of tiles those to compute, in parts that run in parallel.
    """
    tiles = _slices(len(points.features), size)
    chosen = own(range(len(tiles)))
    if len(tiles) == 1 and chosen:
        return [t.T for t in _sums(weigh(points, points), summands)]

    def part(tile_rows: list[int]) -> list[Tensor]:
        """Some rows of tiles, from the diagonal on, and their mirror images: (k, N) each."""
        totals = [torch.zeros_like(b) for b in summands]
        for a in tile_rows:
            i = tiles[a]
            row_points = points.rows(i)
            for j in tiles[a:]:
                for total, w, scale, b in zip(totals, *weigh(row_points, points.rows(j)), summands, strict=True):
                    total[:, i].add_(b[:, j] @ w.T, alpha=scale)
                    if i != j:
                        total[:, j].add_(b[:, i] @ w, alpha=scale)
        return totals

    parts = in_parallel(part, chosen) if chosen else [[torch.zeros_like(b) for b in summands]]
    totals = reduce(lambda total, more: [t.add_(m) for t, m in zip(total, more, strict=True)], parts)
    return [t.T for t in totals]


def dealt(tile_rows: list[int], parts: int) -> list[list[int]]:
    """Rows of a triangle of tiles in parts of about equal area: dealt there and back, since later rows are shorter."""
    hands: list[list[int]] = [[] for _ in range(parts)]
    for k, row in enumerate(tile_rows):
        hands[min(k % (2 * parts), 2 * parts - 1 - k % (2 * parts))].append(row)
    return [part for part in hands if part]


def _rectangular(weigh: Weighing, rows: Points, columns: Points, summands: list[Tensor], elements: int) -> list[Tensor]:
    """Row tiles of the result, each summed over column tiles, without in-place operations (for autograd)."""
    m, n = len(rows.features), len(columns.features)
    height = max(1, min(m, max(int(elements**0.5), elements // max(n, 1))))
    widths = _slices(n, max(1, elements // height))
    parts = []
    for i in _slices(m, height):
        sums = (_sums(weigh(rows.rows(i), columns.rows(j)), [b[:, j] for b in summands]) for j in widths)
        parts.append(reduce(lambda total, part: [t + p for t, p in zip(total, part, strict=True)], sums))
    return [torch.cat(column, dim=1).T for column in zip(*parts, strict=True)]


def _sums(weights: tuple[list[Tensor], list[float]], summands: list[Tensor]) -> list[Tensor]:
    """Sums over one tile: (k, M) each."""
    results, scales = weighted_sums(weights[0], summands), weights[1]
    return [s if scale == 1.0 else s * scale for s, scale in zip(results, scales, strict=True)]


def _slices(count: int, size: int) -> list[slice]:
    return [slice(k, min(k + size, count)) for k in range(0, count, size)] or [slice(0, 0)]


def _plain(formula: Formula, profile: Profile, i: Points, j: Points) -> tuple[list[Tensor], list[float]]:
    """Weights by operations of tensors: what autograd follows, and any profile of a user."""
    weights = formula.weigh(matrices(i, j), profile)
    return weights, [1.0] * len(weights)


class _Buffers(threading.local):
    """Flat buffers of this thread, by size, type and device: free ones, and those of the last tile's weights."""

    def __init__(self) -> None:
        self.free: dict[tuple[int, torch.dtype, torch.device], list[Tensor]] = {}
        self.lent: list[tuple[list[Tensor], Tensor]] = []

    def of(self, elements: int, like: Tensor) -> list[Tensor]:
        """Free buffers with ``elements`` numbers of the type and device of ``like``, those that were lent too."""
        while self.lent:
            free, buffer = self.lent.pop()
            free.append(buffer)
        return self.free.setdefault((elements, like.dtype, like.device), [])


BUFFERS = _Buffers()


def _recycled(weights: Weights, elements: int, i: Points, j: Points) -> tuple[list[Tensor], list[float]]:
    """Weights by operations in recycled buffers; a result takes that of an operand which is not read again."""
    free, shape = BUFFERS.of(elements, i.features), (len(i.features), len(j.features))
    held: dict[int, Tensor] = {}
    reads = list(weights.uses)

    def view(buffer: Tensor) -> Tensor:
        return buffer[: shape[0] * shape[1]].view(shape)

    def taken() -> Tensor:
        return free.pop() if free else outside_inference_mode(i.features.new_empty)(elements)

    def dots(k: int, scale: float = 1.0) -> Tensor:
        """A leaf times a number, in a new buffer."""
        left, right = factors(weights.nodes[k].name, i, j)
        buffer = taken()
        # Reading the right factors along their rows saves a third of this product's time.
        torch.mm(left if scale == 1.0 else left * scale, right.T.contiguous(), out=view(buffer))
        return buffer

    for k, (name, operands, number) in weights.steps():
        if name in LEAVES:
            continue  # computed where it is read
        for o in operands:
            reads[o] -= 1
            if o not in held and name != "exp":
                held[o] = dots(o)
        if name == "exp" and operands[0] not in held:  # the factor of an exponent costs no operation on the matrix
            held[k] = dots(operands[0], _exponent(number, i.features))
            _power(view(held[k]))
            continue
        values = [view(held[o]) for o in operands]
        over = [o for o in dict.fromkeys(operands) if reads[o] == 0]
        buffer = held.pop(over[0]) if over else taken()
        free.extend(held.pop(o) for o in over[1:])
        OPERATIONS[name](*values, number, view(buffer))
        held[k] = buffer
    buffers = []
    for place, (node, _) in enumerate(weights.results):
        key = -1 - place if node is None else node
        if key not in held:
            held[key] = taken() if node is None else dots(node)
        buffers.append(view(held[key]).fill_(1.0) if node is None else view(held[key]))
    BUFFERS.lent += [(free, buffer) for buffer in held.values()]
    return buffers, [scale for _, scale in weights.results]


def _exp(a: Tensor, c: float, out: Tensor) -> None:
    torch.mul(a, _exponent(c, a), out=out)
    _power(out)


def _exponent(c: float, like: Tensor) -> float:
    """The factor of an exponent for :func:`_power`."""
    return c / log(2.0) if powers_of_two_are_faster(like.device.type, like.dtype) else c


def _power(out: Tensor) -> None:
    """exp or 2^x in place, whichever is faster here."""
    (torch.exp2 if powers_of_two_are_faster(out.device.type, out.dtype) else torch.exp)(out, out=out)


OPERATIONS: dict[str, Callable[..., object]] = {
    "product": lambda a, b, _, out: torch.mul(a, b, out=out),
    "ratio": lambda a, b, _, out: torch.div(a, b, out=out),
    "sum": lambda a, b, c, out: torch.add(a, b, alpha=c, out=out),
    "shift": lambda a, c, out: torch.add(a, c, out=out),
    "scale": lambda a, c, out: torch.mul(a, c, out=out),
    "inverse": lambda a, _, out: torch.reciprocal(a, out=out),
    "exp": _exp,
    "sqrt": lambda a, _, out: torch.sqrt(a, out=out),
    "relu": lambda a, _, out: torch.clamp(a, min=0.0, out=out),
}
"""Operations of :class:`Node` on matrices."""


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
