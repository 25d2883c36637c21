"""Tables that commands read in blocks: checked as a whole first, then worked on with a progress bar."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

import torch
from torch import Tensor

from diffeo_calib.cli.interrupts import Progress
from diffeo_calib.common.device import HOST
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import OutsideRange
from diffeo_calib.measurements.csv.tables import TableFile

Rows = TypeVar("Rows", bound=Sized)
PERCENT = 100
CHECKING = "checking, %"


def check(file: TableFile, model: CalibratedKinematics, progress: Progress) -> None:
    """Find all mistakes in a table, and warn of rows outside the joint ranges of the fit."""
    outside = OutsideRange(model)
    file.check(lambda values: outside.add(values.q), lambda part: progress(CHECKING, int(PERCENT * part), PERCENT))
    outside.warn()


def counted(blocks: Iterable[Rows], rows: int, progress: Progress) -> Iterator[Rows]:
    """The same blocks of rows; the bar moves when each has been used."""
    done = 0
    progress("rows", done, rows)
    for block in blocks:
        yield block
        done += len(block)
        progress("rows", done, rows)


class Gathered:
    """Rows (B, ...) of many blocks in one tensor. It is made once: kept blocks would scatter the memory between them.

    Args:
        rows: how many there will be.

    Attributes:
        whole: (rows, ...) the tensor; empty before the first block.
    """

    def __init__(self, rows: int) -> None:
        self.rows, self.filled = rows, 0
        self.whole = torch.empty(0, dtype=torch.float64, device=HOST)

    def add(self, block: Tensor) -> None:
        """Add the rows of the next block."""
        if not self.filled:
            self.whole = block.new_empty(self.rows, *block.shape[1:])
        self.whole[self.filled : self.filled + len(block)] = block
        self.filled += len(block)
