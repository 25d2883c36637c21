"""Sums that several processes share, started by ``torchrun``: one program, the same data in every process.

    torchrun --nproc-per-node 2 program.py          # in program.py: dc.fit(problem, backend="distributed")

Every process (rank) runs the whole program. A large sum is cut into parts, each rank computes some of them, and all
get the total: of sums over the points themselves the tiles of a triangle, so that each pair is still visited once, of
other sums some rows. Small sums, and all other work, are done by every rank for itself. Messages go through
torch.distributed: gloo between CPUs, NCCL between GPUs.

Ranks must make the same calls with the same data; with every sum they compare a summary of theirs. The result depends
on the number of ranks only in its last digits, and not at all on which of them is faster.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as messages
from torch import Tensor

from diffeo_calib.common.errors import DiffeoCalibError, InputError
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, Points, SumBackend
from diffeo_calib.kernels.reductions.fused import FUSED
from diffeo_calib.kernels.reductions.tiled import Tiled

T = TypeVar("T")

SMALLEST_SHARED_PAIRS = 1 << 26
"""Pairs from which a sum is shared: smaller ones take less time than a few messages, and every rank does all of them.
Compiled loops take 15 ms for so many on one thread."""
PATIENCE_SECONDS = 300.0
"""How long a rank waits for others that are alive but late. A rank that has ended is noticed at once."""
AGREEMENT = 1e-9  # relative difference between summaries of the ranks' data that counts as rounding


class LostRankError(DiffeoCalibError):
    """Another process of a distributed program has ended, hangs, or does something else.

    It is no numerical error: solvers try shorter steps after those.
    """


@dataclass(frozen=True)
class Ranks:
    """The processes of this program."""

    own: int = 0  # number of this one, from 0
    count: int = 1  # of all

    def mine(self, items: Sequence[T]) -> list[T]:
        """The items that this rank works on: dealt there and back, since costs often rise or fall steadily."""
        turn = 2 * self.count
        place = [min(k % turn, turn - 1 - k % turn) for k in range(len(items))]
        return [item for item, at in zip(items, place, strict=True) if at == self.own]

    def total(self, parts: list[Tensor]) -> list[Tensor]:
        """The sums over all ranks of tensors that have the same shapes in each; the same numbers in every rank.

        Raises:
            LostRankError: another rank has ended or hangs.
        """
        if self.count == 1:
            return parts
        flat = torch.cat([part.flatten() for part in parts])
        self._exchange(messages.all_reduce, flat)
        pieces = flat.split([part.numel() for part in parts])
        return [piece.view(part.shape) for piece, part in zip(pieces, parts, strict=True)]

    def check_agreement(self, what: str, numbers: Tensor) -> None:
        """Compare a few numbers (k,) that must be the same in every rank.

        Raises:
            LostRankError: they differ, or another rank has ended or hangs.
        """
        received = [torch.empty_like(numbers) for _ in range(self.count)]
        self._exchange(messages.all_gather, received, numbers)
        every = torch.stack(received)
        apart = (every - every[0]).abs() > AGREEMENT * every.abs().amax(0)
        if bool(apart.any()):
            others = ", ".join(str(k) for k in apart.any(1).nonzero()[:, 0].tolist())
            fix = "read the same files and use the same seeds in every process"
            raise LostRankError.of(f"{what} of rank {others} differ from those of rank 0", fix=fix)

    def _exchange(self, message: Callable[..., Any], *tensors: Any) -> None:
        try:
            message(*tensors)
        except RuntimeError as error:
            what = f"rank {self.own} of {self.count} waited for another process"
            what += " that has ended, hangs or does other work"
            fix = "look at the first error of the others, and start all again"
            raise LostRankError.of(f"{what} ({_first_line(error)})", fix=fix) from error


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]


def ranks() -> Ranks:
    """The processes of this program, connected on first use.

    Raises:
        InputError: the program was not started by torchrun, or torch has no distributed package.
        LostRankError: the others cannot be reached.
    """
    if not messages.is_available():
        what = "the backend 'distributed' needs torch.distributed, which this build of torch lacks"
        raise InputError.of(what, fix="use the backend 'tiled'")
    if messages.is_initialized():
        return Ranks(messages.get_rank(), messages.get_world_size())
    missing = [name for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT") if name not in os.environ]
    if missing:
        what = "the backend 'distributed' needs a program that runs in several processes"
        fix = "start it with `torchrun --nproc-per-node 2 program.py`, or call torch.distributed.init_process_group"
        raise InputError.of(what, got=f"no {', '.join(missing)} in the environment", fix=fix)
    kind = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and messages.is_nccl_available() else "gloo"
    try:
        messages.init_process_group(kind, timeout=timedelta(seconds=PATIENCE_SECONDS))
    except (RuntimeError, ValueError) as error:
        what = f"the processes of this program do not find each other ({_first_line(error)})"
        raise LostRankError.of(what) from error
    atexit.register(lambda: messages.destroy_process_group() if messages.is_initialized() else None)
    return Ranks(messages.get_rank(), messages.get_world_size())


class Distributed(SumBackend):
    """Evaluates the parts of this rank in compiled loops, or by tiles, and adds those of all ranks.

    It is always usable: a program that runs in one process only gets an error, no fallback.
    """

    def __init__(self, smallest: int = SMALLEST_SHARED_PAIRS) -> None:
        self.smallest = smallest
        self.tiles = Tiled()

    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
        """As :meth:`SumBackend.reduce`; InputError in a single process, LostRankError if ranks are lost or differ."""
        together, at = ranks(), columns if rows is None else rows
        if together.count == 1 or len(at.features) * len(columns.features) < self.smallest:
            return FUSED.reduce(formula, profile, rows, columns) or self.tiles.reduce(formula, profile, rows, columns)
        norms = torch.stack([torch.linalg.vector_norm(t.detach()) for t in (*at.tensors, *columns.tensors)])
        sizes = norms.new_tensor([len(at.features), len(columns.features)])
        together.check_agreement(f"the points of a kernel sum ({formula.name})", torch.cat([norms, sizes]))
        with torch.no_grad():
            compiled = FUSED.program(formula, profile, rows, columns)
            if compiled is not None:
                (totals,) = together.total([compiled.totals(rows, columns, together.mine)])
                return compiled.results(totals, len(at.features))
            return formula.finish(together.total(self.tiles.share(formula, profile, rows, columns, together.mine)), at)
