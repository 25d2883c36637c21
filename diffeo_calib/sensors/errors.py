"""Errors of kinematics on rows of one kind, in the unit of their device, and on tables of several kinds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.data_frames import data_frame
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, listed
from diffeo_calib.common.quantiles import known, quantile
from diffeo_calib.measurements.readings import SocketReadings

NAMES = ("rms", "median", "p95", "max")
SIZES = ("RMS", "median", "95 %", "max")  # the same in heads of tables
BY_ROW = ("errors", "angles", "away", "turns", "line_numbers")  # attributes of an evaluation with a value for each row
ERRORS, SPREAD, READINGS, ORIENTATION = "errors", "spread", "readings", "orientation"
WORDS = {
    ERRORS: "distances",
    SPREAD: "distances from the middles of sockets, a spread,",
    READINGS: "errors of readings",
    ORIENTATION: "angles",
}
COMPONENTS = ("dx", "dy", "dz")


def shown_unit(unit: str) -> tuple[str, float]:
    """Unit in which numbers are shown, and how many of it are one of ``unit``."""
    return ("mm", 1e3) if unit == "m" else (unit, 1.0)


@dataclass(frozen=True)
class DistanceError:
    """A known distance between two sockets, and the distance between the middles of predicted positions.

    Args:
        first, second: names of the sockets. known, found: distances, m.
    """

    first: str
    second: str
    known: float
    found: float

    @property
    def error(self) -> float:
        """Found minus known, m."""
        return self.found - self.known


def socket_errors(
    predicted: Tensor, socket: Tensor, sockets: SocketReadings
) -> tuple[Tensor, tuple[DistanceError, ...]]:
    """Compare predicted positions (N, 3), m, of rows in sockets (N,) with one another: the middle is their mean.

    Returns:
        (N, 3) from the predicted position of each row to the middle of its socket, m; NaN of a row that is alone in its
        socket, whose middle it is. Known distances between sockets that both have rows.
    """
    count = torch.bincount(socket, minlength=len(sockets.names)).to(predicted)
    middles = predicted.new_zeros(len(sockets.names), 3).index_add(0, socket, predicted) / count[:, None]
    used = (count > 0).tolist()
    distances = tuple(
        DistanceError(sockets.names[a], sockets.names[b], length, float((middles[a] - middles[b]).norm()))
        for a, b, length in sockets.lengths
        if used[a] and used[b]
    )
    alone = (count == 1)[socket]
    return (middles[socket] - predicted).masked_fill(alone[:, None], torch.nan), distances


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Differences between predicted and measured values of one kind: a size for every row and body.

    Args:
        errors: (N, P) distances between predicted and measured markers, m, NaN for hidden markers; for poses (N, T)
            distances of the T frames' origins. In sockets (N, 1) distances from the mean of the positions predicted in
            the socket: a spread, which is 2 to 6 times smaller than errors; NaN for a row alone in its socket, which
            shows none. Of readings (N, 1), in ``unit``.
        angles: (N,) angles in rad between predicted and measured orientations, (N, T) of poses on several tips; None if
            only points were measured.
        away: (N, P, r) measured minus predicted numbers, in ``unit``. line_numbers: (N,) of the measurements.
        turns: (N, T, 3) rotation vectors from predicted to measured orientations about the measuring axes, rad.
        distances: known distances between sockets.
        what: "errors" of measured positions or poses, "spread" within sockets, or "readings": errors of readings, which
            do not show everything that is wrong with positions.
        kind: of the rows: "position", "pose", "socket", "distance", "height" or "image".
        unit: of ``errors`` and ``away``: m, or px of images. devices: (N,) names of devices, sockets or set-ups.
        placed: what was found from these rows because the model does not know it, in sentences. numbers: how many.
    """

    errors: Tensor
    angles: Tensor | None = None
    away: Tensor | None = None
    line_numbers: Tensor | None = None
    distances: tuple[DistanceError, ...] = ()
    turns: Tensor | None = None
    what: str = ERRORS
    kind: str = "position"
    unit: str = "m"
    devices: Sequence[str] = ()
    placed: tuple[str, ...] = ()
    numbers: int = 0

    def rows(self, chosen: Tensor) -> Evaluation:
        """The errors of some rows, chosen by a mask (N,) or by their numbers."""
        values = {name: getattr(self, name) for name in BY_ROW}
        some = {name: value[chosen.to(value.device)] for name, value in values.items() if value is not None}
        rows = torch.arange(len(self.errors), device=HOST)[chosen.cpu()].tolist()
        return replace(self, **some, devices=[self.devices[row] for row in rows] if self.devices else (), distances=())

    def to_frame(self) -> Any:
        """The errors of every row and marker as a pandas.DataFrame.

        Columns: row (the line number), marker, x, y, z (measured minus predicted; x alone of distances and heights, x
        and y of images) and error in the unit of the evaluation, and angle in rad for poses.

        Raises:
            ImportError: pandas is not installed.
        """
        N, P = self.errors.shape
        rows = torch.arange(N, device=HOST) if self.line_numbers is None else self.line_numbers
        columns = {"row": rows.repeat_interleave(P), "marker": torch.arange(P, device=HOST).repeat(N)}
        if self.away is not None:
            columns |= dict(zip("xyz", self.away.flatten(0, 1).T, strict=False))
        columns["error"] = self.errors.flatten()
        return data_frame(columns if self.angles is None else columns | {"angle": self.angles.flatten()})

    @property
    def title(self) -> str:
        """What the numbers are, for the head of a table."""
        kinds = {ERRORS: "Position errors", SPREAD: "Spread within sockets", ORIENTATION: "Orientation errors"}
        return kinds.get(self.what, f"Errors of {self.kind}s")

    @property
    def label(self) -> str:
        """What one number is, for axes."""
        return self.title.lower().replace("errors", "error", 1)

    @property
    def shown(self) -> tuple[str, float]:
        """Unit in which the numbers are shown, and how many of it are one of ``unit``."""
        return shown_unit(self.unit)

    @property
    def rms_text(self) -> str:
        """Root mean square with its unit."""
        unit, per_unit = self.shown
        return f"{per_unit * self.rms:.4f} {unit}"

    @property
    def sizes(self) -> list[float]:
        """Numbers under :data:`SIZES` in the unit in which they are shown."""
        return [self.shown[1] * getattr(self, name) for name in NAMES]

    @property
    def orientation(self) -> Evaluation | None:
        """Angles between predicted and measured orientations, **degrees**; None if only points were measured."""
        if self.angles is None:
            return None
        angles, turns = self.angles.rad2deg().view(len(self.errors), -1), None
        if self.turns is not None:
            turns = self.turns.rad2deg()
        labels = {"line_numbers": self.line_numbers, "devices": self.devices, "unit": "deg"}
        return Evaluation(angles, away=turns, what=ORIENTATION, kind=ORIENTATION, **labels)

    @property
    def each(self) -> list[Evaluation]:
        """Errors of positions, and of orientations if there are any."""
        return [self] if self.orientation is None else [self, self.orientation]

    def __repr__(self) -> str:
        sizes = [
            f"{len(known(part.errors))} {WORDS[part.what]} in {part.unit}: "
            + ", ".join(f"{n}={getattr(part, n):.4g}" for n in NAMES)
            for part in self.each
        ]
        text = f"; {self.numbers} numbers found from these rows" * (self.numbers > 0)
        return f"Evaluation({'; '.join(sizes)}{text})"

    def lines(self) -> Iterator[dict[str, Any]]:
        """One entry for every row and body, as :meth:`Evaluations.to_frame` writes them: mm, px, deg."""
        return (line for part in self.each for line in part._lines())

    def _lines(self) -> Iterator[dict[str, Any]]:
        unit, per_unit = self.shown
        sizes = per_unit * self.errors
        lines = range(len(sizes)) if self.line_numbers is None else self.line_numbers.tolist()
        numbers = [[[]] * sizes.shape[1]] * len(sizes) if self.away is None else (per_unit * self.away).tolist()
        devices = self.devices or [""] * len(sizes)
        for row, (line, device, bodies, parts) in enumerate(zip(lines, devices, sizes.tolist(), numbers, strict=True)):
            for marker, (size, components) in enumerate(zip(bodies, parts, strict=True)):
                padded = [*components, *[torch.nan] * (3 - len(components))]
                entry = {"row": row, "line": line, "kind": self.kind, "device": device, "marker": marker}
                yield entry | dict(zip(COMPONENTS, padded, strict=True)) | {"size": size, "unit": unit}

    @property
    def count(self) -> int:
        """Number of rows with errors."""
        return int((~self.errors.isnan().all(1)).sum())

    @property
    def rms(self) -> float:
        """Root mean square of the sizes, in ``unit``: of a spread no error of positions."""
        return float(self.errors.square().nanmean().sqrt())

    @property
    def mean(self) -> float:
        """Mean size, in ``unit``."""
        return float(self.errors.nanmean())

    @property
    def median(self) -> float:
        """Median size, in ``unit``."""
        return self.quantile(0.5)

    @property
    def p95(self) -> float:
        """95th percentile of the sizes, in ``unit``."""
        return self.quantile(0.95)

    @property
    def max(self) -> float:
        """Largest size, in ``unit``; NaN without any."""
        return self.quantile(1.0)

    def quantile(self, fraction: float) -> float:
        """The size, in ``unit``, that the given fraction of markers does not exceed; NaN without any."""
        return quantile(known(self.errors), fraction)


class Evaluations(Mapping[str, Evaluation]):
    """Errors of a table of several kinds, each in its own unit: kind of the rows -> its :class:`Evaluation`.

    Args:
        kinds: the evaluations. index: row numbers (M,) of each kind in the table.
        placed: what was found from the judged rows, in sentences, because the model does not know it.
        numbers: how many numbers that took.
    """

    def __init__(
        self, kinds: Mapping[str, Evaluation], index: Mapping[str, Tensor], placed: Sequence[str] = (), numbers: int = 0
    ) -> None:
        self._kinds, self.index = dict(kinds), dict(index)
        self.placed, self.numbers = tuple(placed), numbers

    @classmethod
    def of(cls, each: Iterable[tuple[Evaluation, Tensor]], placed: Sequence[str] = (), numbers: int = 0) -> Evaluations:
        """Errors of rows of one kind each, with their row numbers (M,); of several of one kind: distance, distance 2.

        A kind whose rows all show no error, alone in their sockets, is left out.
        """
        kinds, index = dict[str, Evaluation](), dict[str, Tensor]()
        for part, rows in ((part, rows) for part, rows in each if part.count):
            taken = sum(other.kind == part.kind for other in kinds.values())
            name = f"{part.kind} {taken + 1}" if taken else part.kind
            kinds[name], index[name] = part, rows
        return cls(kinds, index, placed, numbers)

    def __getitem__(self, kind: str) -> Evaluation:
        return self._kinds[kind]

    def __iter__(self) -> Iterator[str]:
        return iter(self._kinds)

    def __len__(self) -> int:
        return len(self._kinds)

    def __repr__(self) -> str:
        kinds = ", ".join(f"{kind}: {errors!r}" for kind, errors in self.items())
        return f"Evaluations({kinds}; {self.numbers} numbers found from these rows)"

    def rows(self, mask: Tensor) -> Evaluations:
        """The errors of some rows, chosen by a mask (N,); kinds without an error are left out."""
        mask = mask.cpu()
        some = {kind: part.rows(mask[self.index[kind]]) for kind, part in self.items() if mask[self.index[kind]].any()}
        some = {kind: part for kind, part in some.items() if part.count}
        place = mask.cumsum(0) - 1
        index = {kind: place[self.index[kind][mask[self.index[kind]]]] for kind in some}
        return Evaluations(some, index, self.placed, self.numbers)

    @property
    def positions(self) -> Evaluation | None:
        """Errors of measured positions or poses; None if none was measured."""
        return next((part for part in self.values() if part.what == ERRORS), None)

    @property
    def main(self) -> Evaluation:
        """Errors of measured positions or poses where there are any, else those of the first kind."""
        return self.positions or next(iter(self.values()))

    def _measured(self) -> Evaluation:
        if self.positions is None and len(self) > 1:
            fix = f"name the kind, one of {listed(list(self))}: no position was measured, and units differ"
            raise InputError.of("one error of rows of several kinds", fix=fix)
        return self.main

    @property
    def positions_rms(self) -> float | None:
        """Root mean square error of measured positions, m; None where none was measured."""
        return None if self.positions is None else self.positions.rms

    @property
    def rms_text(self) -> str:
        """Root mean square of every kind with its unit."""
        what = {SPREAD: " (spread)", READINGS: " (readings)"}
        return ", ".join(f"{kind} {part.rms_text}{what.get(part.what, '')}" for kind, part in self.items())

    @property
    def rms(self) -> float:
        """Root mean square error of measured positions, m; else of the only kind in its unit, of several InputError."""
        return self._measured().rms

    @property
    def median(self) -> float:
        """Median error, as :attr:`rms`."""
        return self._measured().median

    @property
    def p95(self) -> float:
        """95th percentile of the errors, as :attr:`rms`."""
        return self._measured().p95

    @property
    def max(self) -> float:
        """Largest error, as :attr:`rms`."""
        return self._measured().max

    def lines(self) -> Iterator[dict[str, Any]]:
        """One entry for every measured value, in the order of the table; see :meth:`to_frame`."""
        entries = [
            entry | {"row": int(self.index[kind][entry["row"]])} for kind, one in self.items() for entry in one.lines()
        ]
        return iter(sorted(entries, key=lambda entry: entry["row"]))

    def to_frame(self) -> Any:
        """All errors as a pandas.DataFrame, one line for every measured value.

        Columns: row, line, kind, device, marker, dx, dy, dz (measured minus predicted; du, dv of images in the first
        two, one number of distances and heights in the first), size and unit.

        Raises:
            ImportError: pandas is not installed.
        """
        entries = list(self.lines())
        return data_frame({name: [entry[name] for entry in entries] for name in entries[0]})
