"""Stops of a robot in two recordings that have clocks of their own: its joint values, and what a device saw.

A recording stands still where no value changes by more than a tolerance within a window around it. The clocks differ by
the shift with which both stand still and move at the same times most often. A stop lasts as long as both stand still,
without half a window at either end; its row is the mean over it. Of images, whose motion nobody looks at, a stop of the
joints takes the one nearest to its middle: clocks that differ by less than half a stop do no harm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from diffeo_calib.common.errors import MeasurementError

Array = np.ndarray
PLACE, TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
"""Columns of a place and a rotation."""
NOISE_FACTOR = 8.0
"""Range of the noise within a window, in standard deviations, that is no motion."""
STEP_S = 0.01
"""Of the grid on which both recordings are compared."""
SAME_TURN = 1e-9
"""Range of a quaternion's numbers at all stops that is rounding."""
FEWEST_CHANGES = 4
"""Beginnings and ends of motions that tell how far the clocks differ."""


@dataclass(frozen=True)
class StopLimits:
    """Definition of a stop.

    Args:
        joints: largest motion of a joint, rad or m. seen: of what is seen, m, unless its noise is larger.
        window: within which they hold, s. shortest: stop, s. offset: largest difference of the clocks, s.
    """

    joints: float = 1e-3
    seen: float = 1e-4
    window: float = 0.2
    shortest: float = 0.5
    offset: float = 5.0


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
        found = [np.ptp(self.values[a:b], axis=0).max() for a, b in zip(first, last, strict=True)]
        return np.array(found) <= tolerance

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
    joints: Recording, seen: Recording, limits: StopLimits = LIMITS, offset: float | None = None
) -> tuple[list[Stop], float]:
    """Stops in two recordings, in order, and the seconds to add to the times of ``seen``, estimated by default.

    The first three columns of ``seen`` are places, which tell whether it moves.

    Raises:
        MeasurementError: recordings of different times, too few motions to tell the offset, or no stop.
    """
    _check_times(joints, seen.times + (offset or 0.0), limits.offset if offset is None else 0.0)
    places = Recording(seen.times, seen.values[:, :3])
    rests = joints.still(limits.joints, limits.window)
    tolerance = max(limits.seen, NOISE_FACTOR * places.noise)
    resting = places.still(tolerance, limits.window)
    if offset is None:
        offset = _offset((joints.times, rests), (seen.times, resting), limits.offset)
    times = seen.times + offset
    found = []
    for begin, end in _both(joints.times, rests, times, resting, limits):
        here, there = (joints.times >= begin) & (joints.times <= end), (times >= begin) & (times <= end)
        if here.any() and there.sum() > 1:
            values = seen.values[there]
            middle = 0.5 * (begin + end), joints.values[here].mean(0), values.mean(0)
            found.append(Stop(*middle, values.std(0, ddof=1), len(values)))
    if not found:
        fix = "record for longer, allow larger motions, or leave out joints that never rest"
        raise MeasurementError.of("stops", expected="some", got="none in which both recordings stand still", fix=fix)
    return found, offset


def rows_of(names: Sequence[str], found: Sequence[Stop]) -> list[dict[str, float]]:
    """The rows of stops: column -> value, in s, m and rad; without rotations that never change: none were measured."""
    rows, changes = [], (np.ptp([one.seen[3:] for one in found], axis=0) > SAME_TURN).any()
    for one in found:
        turn = one.seen[3:] / np.linalg.norm(one.seen[3:]) if changes else one.seen[:0]
        columns = ["time", *names, *PLACE, *TURN[: len(turn)], *(f"std_{axis}" for axis in PLACE), "readings"]
        numbers = [one.time, *one.joints, *one.seen[:3], *turn, *one.deviations[:3]]
        rows.append(dict(zip(columns, [*map(float, numbers), one.count], strict=True)))
    return rows


def pictured(
    joints: Recording, times: Array, limits: StopLimits = LIMITS, offset: float = 0.0
) -> tuple[list[tuple[Array, float]], int]:
    """Joint values (n,), means over each stop, and the time of its image as given; and how many stops have none.

    ``times`` (T,), s, are those of the images, to which ``offset`` is added.

    Raises:
        MeasurementError: recordings of different times, or no stop with an image.
    """
    _check_times(joints, times + offset, 0.0)
    rests, found, without = joints.still(limits.joints, limits.window), [], 0
    for begin, end in _both(joints.times, rests, joints.times, rests, limits):
        nearest = np.abs(times + offset - 0.5 * (begin + end)).argmin()
        if begin <= times[nearest] + offset <= end:
            here = (joints.times >= begin) & (joints.times <= end)
            found.append((joints.values[here].mean(0), float(times[nearest])))
        else:
            without += 1
    if not found:
        got = f"{without} stops, all without an image"
        raise MeasurementError.of("stops with an image", expected="some", got=got, fix="check the offset of the clocks")
    return found, without


def _check_times(joints: Recording, times: Array, tolerance: float) -> None:
    """MeasurementError unless two recordings belong to the same time."""
    if times.max() + tolerance < joints.times[0] or times.min() - tolerance > joints.times[-1]:
        expected = f"those of the joint states, {joints.times[0]:.3f} to {joints.times[-1]:.3f} s"
        got = f"{times.min():.3f} to {times.max():.3f} s"
        fix = "let both use one clock, or give the offset"
        raise MeasurementError.of("the times of what was seen", expected=expected, got=got, fix=fix)


def _offset(joints: tuple[Array, Array], seen: tuple[Array, Array], largest: float) -> float:
    """Seconds to add to the times of the second recording so that both rest together."""
    begin = min(joints[0][0], seen[0][0]) - largest
    grid = np.arange(begin, max(joints[0][-1], seen[0][-1]) + largest, STEP_S)
    one, other = (_on(grid, *part) for part in (joints, seen))
    if min(np.count_nonzero(np.diff(part)) for part in (one, other)) < FEWEST_CHANGES:
        fix = "let the robot move between stops while both are recorded, or give the offset"
        raise MeasurementError.of("the offset between the clocks", expected="several motions and stops", fix=fix)
    most = round(largest / STEP_S)
    shifts = np.arange(-most, most + 1)
    scores = np.array([float((one * np.roll(other, shift)).sum()) for shift in shifts])
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
