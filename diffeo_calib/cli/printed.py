"""Tables and lines about a calibration: errors, parts, rows that look wrong, places, expected errors, limits kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, isnan
from typing import Any, NamedTuple

import torch
import typer
from rich.console import Console, ConsoleOptions
from rich.table import Table
from torch import Tensor

from diffeo_calib.calibration.expected_errors import Accuracy, ExpectedError, expected_errors
from diffeo_calib.cli.console import plain, say, text_table
from diffeo_calib.cli.record import record
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.registered_map import Registration
from diffeo_calib.measurements.bodies import marker_lines, transform_words, triple
from diffeo_calib.measurements.csv.cells import number
from diffeo_calib.sensors.errors import SIZES, Evaluation, shown_unit
from diffeo_calib.sensors.kinds import known_kinds

WIDEST = 1000  # characters of the widest table
EXIT_ABOVE = 4  # the errors are larger than --tolerance
UNITS = {"mm": ("m", 1e3), "um": ("m", 1e6), "m": ("m", 1.0), "px": ("px", 1.0)}
"""Unit of a limit -> unit in which it is compared, and how many are one of these; own kinds of readings have others."""


class ErrorTable:
    """Errors in their own unit, and of orientations in degrees if there are any; in two tables where one is too wide.

    Args:
        rows: what each row is called -> its errors, all of one kind. of: whose they are, the end of the title.
        columns: names of the leading columns. expected: RMS, m, in a column of its own.
    """

    def __init__(
        self, rows: Mapping[tuple[str, ...], Evaluation], of: str, *columns: str, expected: float | None = None
    ) -> None:
        self.rows, self.of, self.columns, self.expected = rows, of, columns, expected

    def _table(self, title: str, *, errors: bool = True, angles: bool) -> Table:
        """A table of errors, those of orientations, or both."""
        last = [self.expected] if self.expected is not None and errors else []
        header = [*self.columns, *SIZES * errors, *[f"{size} deg" for size in SIZES] * angles]
        lines = list[list[str]]()
        for labels, row in self.rows.items():
            each = row.each[not errors : 1 + angles]
            numbers = [*(size for part in each for size in part.sizes), *(row.shown[1] * value for value in last)]
            lines.append([*labels, *("-" if isnan(value) else f"{value:.4f}" for value in numbers)])
        return text_table(title, [*header, *["expected RMS"] * len(last)], lines, len(self.columns))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        first = next(iter(self.rows.values()))
        title, turned = f"{first.title} in {first.shown[0]} {self.of}", first.orientation is not None
        whole = self._table(title + ", orientation errors in deg" * turned, angles=turned)
        wide = options.update(max_width=WIDEST)
        if not turned or console.measure(whole, options=wide).maximum <= options.max_width:
            yield whole
        else:
            yield self._table(title, angles=False)
            yield self._table(f"Orientation errors in deg {self.of}", errors=False, angles=True)


def registration_lines(model: CalibratedKinematics) -> Iterator[str]:
    """Where measuring frame and markers were found, how well, and from how many rows."""
    motion = model.registration
    if motion is None:
        return
    yield from motion_lines(motion, model.on, doubt=": what else has changed is in them" * motion.doubtful)
    fitted = f"RMS {1e3 * motion.rms_after:.4f} mm on these rows, to which device and markers were fitted"
    left_out = f"{1e3 * motion.left_out_rms:.4f} mm with each row left out in turn"
    yield f"{motion.rows} rows took part: {fitted}; {left_out}"


def motion_lines(motion: Registration, tips: Sequence[str], *, doubt: str = "") -> Iterator[str]:
    """Where measuring frame and markers are now, and how far from where they were, as if the robot had not changed.

    With ``doubt``, what its change does to these places, no probability is stated: it would hold without one alone.
    """
    if motion.free != "marker":
        yield from frame_lines(motion)
    if motion.free != "base":
        tips = tips if len(tips) == len(motion.markers) else [tips[0]] * len(motion.markers)
        rigid = motion.lever is not None
        yield from marker_lines(motion.markers, tips, poses=rigid, std=None if rigid else motion.marker_deviations)
        if motion.shift is not None:
            largest = 1e3 * float(motion.shift.norm(dim=1).max())
            sure = f" (unmoved with probability {motion.same_place:.2f})" if motion.same_place is not None else ""
            yield f"  that is {largest:.3f} mm from where it was{sure * (not doubt)}"
    if doubt:
        yield f"  these places were found as if the robot had not changed{doubt}"


def frame_lines(motion: Registration) -> Iterator[str]:
    """Where the measuring frame is now."""
    yield f"the measuring frame of the model, seen from the new one: {transform_words(motion.transform)}"
    shift, turn = 1e3 * motion.frame_deviations[:3], torch.rad2deg(motion.frame_deviations[3:])
    yield f"  known to {triple(shift, '.2g')} mm at the middle of the rows, and to {triple(turn, '.2g')} deg"


def socket_lines(errors: Evaluation, rows: str) -> Iterator[str]:
    """Known distances and those found, for some rows."""
    for pair in errors.distances:
        between = f"distance of '{pair.first}' and '{pair.second}' ({rows})"
        yield f"{between}: {1e3 * pair.found:.3f} mm, known {1e3 * pair.known:.3f}, error {1e3 * pair.error:+.3f}"


def stage_line(
    model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]], expected: ExpectedError
) -> str:
    """The absolute errors that a model expects of every stage; they go into the record too."""
    by_stage = expected_errors(model, stages, expected)
    record.add(expected_error_by_stage_m=by_stage)
    listed = ", ".join(f"{name} {1e3 * value:.3f}" for name, value in by_stage.items())
    return f"expected absolute error by stage, in mm: {listed}"


def expectation_lines(model: CalibratedKinematics, data: Any, expected: ExpectedError | None = None) -> Iterator[str]:
    """The absolute error that a model expects, and which errors of the rows do not show it without a device."""
    alone, expected = model.map.workspace is not None, expected or ExpectedError.of(model)
    record.add(expected_error=expected.entry())
    fitted = ", after a rigid fit" * alone
    yield f"expected absolute error over the joint ranges of the fit{fitted}: {plain(expected.sentence)}"
    yield from dict.fromkeys(part.flattery for part in (() if data is None else data.parts) * alone)


class Limit(NamedTuple):
    """Largest error that is good enough, in ``unit``: m, px, or that of a kind of readings."""

    value: float
    unit: str


def parsed_limit(text: str | None) -> Limit | None:
    """A length with its unit, such as 0.15mm, or pixels; None without one."""
    if text is None:
        return None
    units = {kind.unit[0]: (kind.unit[0], 1.0) for kind in known_kinds().values()} | UNITS
    name = max((name for name in units if text.endswith(name)), key=len, default="")
    value = number(text.removesuffix(name).strip(), ".") if name else None
    if value is None or not 0.0 < value < inf:
        expected = "a length above zero with its unit, such as 0.15mm, or pixels, such as 0.5px"
        raise InputError.of(f"--tolerance {text}", expected=expected)
    unit, per_unit = units[name]
    return Limit(value / per_unit, unit)


def parsed_length(text: str | None) -> float | None:
    """A length with its unit in m; None without one."""
    limit = parsed_limit(text)
    if limit is not None and limit.unit != "m":
        raise InputError.of(f"--tolerance {text}", expected="a length, such as 0.15mm")
    return None if limit is None else limit.value


def accept(error: Accuracy, limit: Limit) -> None:
    """Say whether errors are within the limit; exit with a code of its own if they are not."""
    good = error.value <= limit.value
    record.add(**{f"rms_{error.unit}": error.value, f"limit_{error.unit}": limit.value}, accepted=good)
    unit, per_unit = shown_unit(error.unit)
    within = "within" if good else "above"
    say(f"RMS {per_unit * error.value:.4f} {unit} {error.of}: {within} the limit of {per_unit * limit.value:g} {unit}")
    if not good:
        raise typer.Exit(EXIT_ABOVE)
