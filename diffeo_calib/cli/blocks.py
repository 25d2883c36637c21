"""Tables that commands read in blocks: checked as a whole first, then worked on with a progress bar."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from diffeo_calib.cli.interrupts import Progress
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import OutsideRange
from diffeo_calib.measurements.csv_tables import TableFile

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
