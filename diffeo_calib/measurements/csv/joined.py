"""Two tables as one, joined by a common column or time; stops of a robot in recordings with clocks of their own.

Joined lines have the numbers of those of the places. Numbers that mostly differ are times: the nearest belong together
if they are within half a step; of two recordings every stop becomes a line. The clocks differ by the shift with which
both stand still, within a window around each time, and move at the same times most often. A stop is the mean while both
stand still, without half a window at either end, or the image nearest to its middle.
"""

from __future__ import annotations

import os
import pathlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from diffeo_calib.common.errors import MeasurementError, few, shown
from diffeo_calib.measurements.csv.cells import csv_text, find_columns, number
from diffeo_calib.measurements.csv.lines import TextTable, read_cells

SEPARATORS = (",", ";", "\t", "|", " ")
MOVED = 1e-3  # part of the range of a column by which it moves at least, unless its noise is larger
CLOCKS_AGREE = 0.1
"""Spread of the differences of two clocks at most, relative to the pauses between rows, and to how these differ."""
Pairs = list[tuple[int, int]]  # numbers of lines with the same joint values: of the joints and of the places


class HeldFile(pathlib.WindowsPath if os.name == "nt" else pathlib.PosixPath):  # no subclass of Path before 3.12
    """Lines that are read as those of a file of this name would be.

    Attributes:
        content: the lines. words: files that were joined, for messages. sentence: how many lines are joined, and which
            have no partner.
    """

    words = sentence = ""
    content = b""

    def __str__(self) -> str:
        return self.words or super().__str__()

    def is_file(self) -> bool:
        """Whether it can be read."""
        return True

    def open(self, *_: Any, **__: Any) -> Any:
        """The lines, as a file of bytes."""
        return BytesIO(self.content)


class _Table(NamedTuple):
    """A file to be joined: its cells, the common column, and the texts of this."""

    path: Path
    sheet: TextTable
    by: str
    keys: list[str]

    @classmethod
    def read(cls, path: Path, by: str, sep: str) -> _Table:
        """The file, with the first usual separator with which it has the common column."""
        for mark in (sep, *SEPARATORS):
            with suppress(MeasurementError):
                sheet = read_cells(path, mark, (by,))
                if by in sheet.header:
                    return cls(path, sheet, by, sheet.column(by))
        find_columns(path, read_cells(path, sep, (by,)).header, [by], sep)  # says what is wrong
        raise AssertionError("a file without the column")

    def numbers(self, column: str, decimal: str) -> Array:
        """(N,) of a column, seconds for dates, NaN for other texts."""
        return np.array([_number_or_seconds(cell, decimal) for cell in self.sheet.column(column)])


def joined_file(
    joints: Path, places: Path, by: str, sep: str = ",", decimal: str = ".", *, several: bool = False
) -> HeldFile:
    """A file with the columns of the tables of joints and of places, joined by a common column.

    ``by`` is the common column, or "A=B" where the places have it under another name B. Another usual separator of one
    of the files is found by it. ``several``: whether lines of places may share their joint values, as those of markers
    do. MeasurementError for a file that cannot be read or lacks the column, several partners of a line, or no pair.
    """
    column, _, other = by.partition("=")
    tables = table, measured = _Table.read(joints, column, sep), _Table.read(places, other or column, sep)
    times, common = [file.numbers(file.by, decimal) for file in tables], {*table.keys} & {*measured.keys} - {""}
    timed = all(len(clock) > 1 and np.isfinite(clock).all() for clock in times)
    if timed and all((np.diff(clock) > 0).all() and np.median(np.diff(clock)) < LIMITS.window for clock in times):
        one, other = (_motion(file, at, decimal) for file, at in zip(tables, times, strict=True))  # of two clocks
        begin = one.times[0] - other.times[0]
        longest = max(float(np.ptp(clock)) for clock in times)
        seen = Recording(other.times + begin, other.values[:, :3])  # each clock may begin anywhere
        rests, offset = stops(one, seen, StopLimits(joints=1.0, seen=1.0, offset=longest))
        offset += begin
        pairs = [(_nearest(times[0], stop.time), _nearest(times[1], stop.time - offset)) for stop in rests]
        how = f"at the middle of every stop, {offset:+.2f} s added to the times of {places.name}"
    elif timed and 2 * len(common) < len({*measured.keys}):
        pairs, how = _by_time(*times)
    else:
        by_text = dict[str, list[int]]()
        for row, text in enumerate(table.keys):
            if text:
                by_text.setdefault(text, []).append(row)
        pairs, how = [(row, at) for at, text in enumerate(measured.keys) for row in by_text.get(text, ())], f"by {by}"
    without = [
        f"{len(rows)} of {file.path.name} ({few([file.keys[row] for row in rows])})"
        for k, file in enumerate(tables)
        if (rows := sorted({*range(len(file.keys))} - {pair[k] for pair in pairs}))
    ]
    if not pairs:
        fix, got = "name a column with the same texts in both files, or with times of one clock", " and ".join(without)
        raise MeasurementError.of(f"--by {shown(by)}", expected="values that both files have", got=got, fix=fix)
    _refuse_several(tables, pairs, several=several)
    joined = HeldFile(places)
    joined.content = _written(tables, pairs, sep)
    joined.words = f"{places}, joined with {joints}"
    joined.sentence = f"{len(pairs)} lines of {places.name} are joined with lines of {joints.name} {how}"
    joined.sentence += f"; lines without a partner: {' and '.join(without)}" * bool(without)
    return joined


def _by_time(joints: Array, places: Array) -> tuple[Pairs, str]:
    """Times (N,) and (M,) that are the nearest to each other, within half a step; and in words."""
    step = min(float(np.median(np.diff(np.sort(times)))) for times in (joints, places))
    if len(joints) == len(places):
        away = joints - places
        offset, spread = float(np.median(away)), float(np.ptp(away))
        # Two clocks, one row each of the same stops: pauses that differ from each other agree.
        if abs(offset) > 0.5 * step and spread < CLOCKS_AGREE * min(step, float(np.ptp(np.diff(joints)))):
            every = range(len(joints))
            return list(zip(every, every, strict=True)), f"by time, {offset:+.2f} added to those of the places"
    nearest = [(_nearest(joints, at), place) for place, at in enumerate(places)]
    apart = {pair: float(abs(joints[pair[0]] - places[pair[1]])) for pair in nearest}
    pairs = [match for match in nearest if apart[match] < 0.5 * step and _nearest(places, joints[match[0]]) == match[1]]
    return pairs, f"by the nearest time, at most {max((apart[pair] for pair in pairs), default=0.0):.3g} apart"


def _number_or_seconds(text: str, decimal: str) -> float:
    """A number, or a date with a time as of ISO 8601 in seconds; NaN for other texts."""
    value = number(text, decimal)
    if value is None and ":" in text:
        with suppress(ValueError):
            date = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
            return (date if date.tzinfo else date.replace(tzinfo=timezone.utc)).timestamp()
    return np.nan if value is None else value


def _nearest(times: Array, time: float) -> int:
    return int(np.abs(times - time).argmin())


def _motion(table: _Table, times: Array, decimal: str) -> Recording:
    """The columns of numbers that do not always grow, in units of what is no motion; the clearest ones first."""
    columns = [table.numbers(name, decimal) for name in table.sheet.header if name != table.by]
    moving = [v for v in columns if np.isfinite(v).all() and np.ptp(v) > 0.0 and not (np.diff(v) > 0).all()]
    if not moving:
        fix = "join the files by names, or remove the lines with empty cells"
        raise MeasurementError.of(f"file '{table.path}'", expected="columns of numbers that move and rest", fix=fix)
    scaled = [v / max(MOVED * np.ptp(v), NOISE_FACTOR * Recording(times, v[:, None]).noise) for v in moving]
    return Recording(times, np.stack(sorted(scaled, key=np.ptp, reverse=True), axis=1))


def _refuse_several(tables: Sequence[_Table], pairs: Pairs, *, several: bool) -> None:
    """MeasurementError for a line that has several partners; ``several``: lines of joints may."""
    for k in (1,) if several else (0, 1):
        row, count = Counter(pair[k] for pair in pairs).most_common(1)[0]
        if count > 1:
            table, other = tables[k], tables[1 - k]
            lines = [other.sheet.rows[pair[1 - k]][0] for pair in pairs if pair[k] == row]
            fix = "remove those that do not belong there, or name the column of markers (--marker)"
            what = f"file '{table.path}', line {table.sheet.rows[row][0]}, {table.by} {shown(table.keys[row])}"
            got = f"lines {few(lines)} of '{other.path}'"
            raise MeasurementError.of(what, expected="one partner", got=got, fix=fix)


def _written(tables: Sequence[_Table], pairs: Pairs, sep: str) -> bytes:
    """The joined lines under the numbers of those of the places; a name in both files says of which it is."""
    table, measured = tables[0].sheet, tables[1].sheet.without([tables[1].by])
    twice = {*table.header} & {*measured.header}
    names = [
        f"{of}.{name}" if name in twice else name
        for of, sheet in zip(("joints", "places"), (table, measured), strict=True)
        for name in sheet.header
    ]
    lines = {1: names}
    for row, place in pairs:
        line, cells = measured.rows[place]
        lines[line] = [" ".join(cell.split()) for cell in (*table.rows[row][1], *cells)]
    return csv_text((lines.get(line, []) for line in range(1, max(lines) + 1)), sep).encode()


# --- stops

Array = np.ndarray
PLACE, TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")  # columns of a place and a rotation
NOISE_FACTOR = 8.0  # range of the noise within a window, in standard deviations, that is no motion
STEP_S = 0.01  # of the grid on which both recordings are compared
SAME_TURN = 1e-9  # range of a quaternion's numbers at all stops that is rounding
FEWEST_CHANGES = 4  # beginnings and ends of motions that tell how far the clocks differ


@dataclass(frozen=True)
class StopLimits:
    """Definition of a stop."""

    joints: float = 1e-3  # largest motion of a joint, rad or m
    seen: float = 1e-4  # of what is seen, m, unless its noise is larger
    window: float = 0.2  # within which they hold, s
    shortest: float = 0.5  # stop, s
    offset: float = 5.0  # largest difference of the clocks, s


LIMITS = StopLimits()


@dataclass(frozen=True)
class Recording:
    """Values (T, d) at times (T,) that increase, s."""

    times: Array
    values: Array

    def still(self, tolerance: float, window: float) -> Array:
        """(T,) whether no value changes by more than the tolerance within a window around each time."""
        first = np.searchsorted(self.times, self.times - 0.5 * window, "left")
        last = np.searchsorted(self.times, self.times + 0.5 * window, "right")
        ranges = [np.ptp(self.values[a:b], axis=0).max() for a, b in zip(first, last, strict=True)]
        return np.array(ranges) <= tolerance

    def at(self, times: Array) -> Array:
        """Values (T, d) at other times, s."""
        return np.stack([np.interp(times, self.times, values) for values in self.values.T], 1)

    @property
    def noise(self) -> float:
        """Standard deviation of a value by second differences, most of which belong to stops."""
        return float(np.median(np.abs(np.diff(self.values, 2, axis=0)))) / (0.6745 * 6**0.5)


@dataclass(frozen=True)
class Stop:
    """A stop: its time, s, means of both recordings, standard deviations (d,) of what was seen, and their number."""

    time: float
    joints: Array
    seen: Array
    deviations: Array
    count: int


def stops(
    joints: Recording, measured: Recording, limits: StopLimits = LIMITS, offset: float | None = None
) -> tuple[list[Stop], float]:
    """Stops in two recordings, in order, and the seconds to add to the times of ``measured``, estimated by default.

    The first three columns of ``measured`` are places, which tell whether it moves.
    Raises MeasurementError: recordings of different times, too few motions to tell the offset, or no stop.
    """
    _check_times(joints, measured.times + (offset or 0.0), limits.offset if offset is None else 0.0)
    places = Recording(measured.times, measured.values[:, :3])
    rests = joints.still(limits.joints, limits.window)
    tolerance = max(limits.seen, NOISE_FACTOR * places.noise)
    resting = places.still(tolerance, limits.window)
    if offset is None:
        offset = _offset((joints.times, rests), (measured.times, resting), limits.offset)
    times = measured.times + offset
    at_stops = []
    for begin, end in _both(joints.times, rests, times, resting, limits):
        here, there = (joints.times >= begin) & (joints.times <= end), (times >= begin) & (times <= end)
        if here.any() and there.sum() > 1:
            values = measured.values[there]
            middle = 0.5 * (begin + end), joints.values[here].mean(0), values.mean(0)
            at_stops.append(Stop(*middle, values.std(0, ddof=1), len(values)))
    if not at_stops:
        fix = "record for longer, allow larger motions, or leave out joints that never rest"
        raise MeasurementError.of("stops", expected="some", got="none in which both recordings stand still", fix=fix)
    return at_stops, offset


def rows_of(names: Sequence[str], at_stops: Sequence[Stop]) -> list[dict[str, float]]:
    """The rows of stops: column -> value, in s, m and rad; without rotations that never change: none were measured."""
    rows, changes = [], (np.ptp([stop.seen[3:] for stop in at_stops], axis=0) > SAME_TURN).any()
    for stop in at_stops:
        turn = stop.seen[3:] / np.linalg.norm(stop.seen[3:]) if changes else stop.seen[:0]
        columns = ["time", *names, *PLACE, *TURN[: len(turn)], *(f"std_{axis}" for axis in PLACE), "readings"]
        numbers = [stop.time, *stop.joints, *stop.seen[:3], *turn, *stop.deviations[:3]]
        rows.append(dict(zip(columns, [*map(float, numbers), stop.count], strict=True)))
    return rows


def pictured(
    joints: Recording, times: Array, limits: StopLimits = LIMITS, offset: float = 0.0
) -> tuple[list[tuple[Array, float]], int]:
    """Joint values (n,), means over each stop, and the time of its image as given; and how many stops have none.

    ``times`` (T,), s, are those of the images, to which ``offset`` is added.
    Raises MeasurementError: recordings of different times, or no stop with an image.
    """
    _check_times(joints, times + offset, 0.0)
    rests, pictures, without = joints.still(limits.joints, limits.window), [], 0
    for begin, end in _both(joints.times, rests, joints.times, rests, limits):
        nearest = np.abs(times + offset - 0.5 * (begin + end)).argmin()
        if begin <= times[nearest] + offset <= end:
            here = (joints.times >= begin) & (joints.times <= end)
            pictures.append((joints.values[here].mean(0), float(times[nearest])))
        else:
            without += 1
    if not pictures:
        got = f"{without} stops, all without an image"
        raise MeasurementError.of("stops with an image", expected="some", got=got, fix="check the offset of the clocks")
    return pictures, without


def _check_times(joints: Recording, times: Array, tolerance: float) -> None:
    if times.max() + tolerance < joints.times[0] or times.min() - tolerance > joints.times[-1]:
        expected, fix = (
            f"{joints.times[0]:.3f} to {joints.times[-1]:.3f} s, as of the joints",
            "give the clocks' offset",
        )
        got = f"{times.min():.3f} to {times.max():.3f} s"
        raise MeasurementError.of("the times of what was seen", expected=expected, got=got, fix=fix)


def _offset(joints: tuple[Array, Array], measured: tuple[Array, Array], largest: float) -> float:
    """Seconds to add to the times of the second recording so that both rest together."""
    begin = min(joints[0][0], measured[0][0]) - largest
    grid = np.arange(begin, max(joints[0][-1], measured[0][-1]) + largest, STEP_S)
    one, other = (_on(grid, *part) for part in (joints, measured))
    if min(np.count_nonzero(np.diff(part)) for part in (one, other)) < FEWEST_CHANGES:
        fix = "let the robot move between stops while both are recorded, or give the offset"
        raise MeasurementError.of("the offset between the clocks", expected="several motions and stops", fix=fix)
    most = round(largest / STEP_S)
    shifts = np.arange(-most, most + 1)
    scores = np.fft.irfft(np.fft.rfft(one) * np.fft.rfft(other).conj(), len(grid))[shifts]  # of each shift around
    best = np.flatnonzero(scores >= scores.max() - 0.5)  # the middle of those that are as good
    return float(STEP_S * shifts[best].mean())


def _on(grid: Array, times: Array, still: Array) -> Array:
    """1 where a recording rests, -1 where it moves, 0 outside of it."""
    nearest = np.interp(grid, times, np.where(still, 1.0, -1.0), left=0.0, right=0.0)
    return np.sign(nearest)


def _both(
    times: Array, rests: Array, other: Array, resting: Array, limits: StopLimits
) -> Iterator[tuple[float, float]]:
    """Begins and ends of intervals in which both rest, s."""
    grid = np.arange(max(times[0], other[0]), min(times[-1], other[-1]), STEP_S)
    both = (_on(grid, times, rests) > 0) & (_on(grid, other, resting) > 0)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], both.astype(int), [0]])))
    for first, last in edges.reshape(-1, 2):
        begin, end = grid[first] + 0.5 * limits.window, grid[last - 1] - 0.5 * limits.window
        if end - begin >= limits.shortest:
            yield float(begin), float(end)
