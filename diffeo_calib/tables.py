"""Tables as CSV files: any separator, decimal mark and unit in the file, SI inside.

Units exist only at these doors, where they must be named: they are never guessed, only doubted with a
warning. Every mistake in a file is one error that names the file, the line and the column.
"""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.csv_files import few, read_columns, repeated
from diffeo_calib.errors import DiffeoCalibWarning, MeasurementError, sentence
from diffeo_calib.measurements import MANY_TURNS, Measurements

UNITS_PER_METRE = {"m": 1.0, "mm": 1000.0}  # a length in the file is divided by this
ANGLE_UNITS = ("rad", "deg")
JOINT_KINDS = ("revolute", "continuous", "prismatic")

_FAR = 100.0  # m: no usual measurement volume is this large, so larger values are probably millimetres
_NEAR = 10.0  # mm: no usual measurement volume is this small, so smaller values are probably metres


@runtime_checkable
class ChainLike(Protocol):
    """What tables ask of a robot: the names and kinds of its joints, in order."""

    @property
    def joint_names(self) -> Sequence[str]:
        """Names of the joints."""
        ...

    @property
    def kinds(self) -> Sequence[str]:
        """``"revolute"``, ``"continuous"`` or ``"prismatic"`` for every joint."""
        ...


def read_measurements(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    position: Sequence[str] | Sequence[Sequence[str]],
    *,
    length: str,
    angle: str,
    sep: str = ",",
    decimal: str = ".",
    duplicates: str = "error",
    kinds: Sequence[str] | None = None,
) -> Measurements:
    """Read a table of measurements from a CSV file (UTF-8, one header line) and convert it to SI.

    Only the named columns are read as numbers; the others may hold anything. Blank lines are skipped.

    Args:
        path: the file.
        joints: names of the joint columns in the robot's order, or the robot (``joint_names``, ``kinds``).
        position: names of the x, y and z columns of the marker, or one such triple per marker.
        length: unit of the positions **and of the prismatic joints** in the file, ``"m"`` or ``"mm"``.
        angle: unit of the revolute joints in the file, ``"rad"`` or ``"deg"``.
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        duplicates: what to do with rows that copy an earlier row exactly: ``"error"`` refuses them, ``"keep"``
            keeps them, ``"drop"`` drops them with a warning. Real repeats differ by noise.
        kinds: kind of every joint; without it, those of the robot, or all revolute.

    Returns:
        Measurements in rad and m, rows in the order of the file.

    Raises:
        MeasurementError: anything unreadable, missing, ragged, not finite or repeated (file, line and column named).

    Warns:
        DiffeoCalibWarning: values that look as if they were in the other unit; rows dropped.
    """
    _check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    columns = _Columns.of(joints, kinds, _triples(position))
    q, points, lines = _read(Path(path), columns, _Format(length, angle, sep, decimal))
    data = Measurements(q, points, columns.joints, doubt=False)
    return data if duplicates == "keep" else _without_copies(Path(path), data, lines, drop=duplicates == "drop")


def read_joints(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    *,
    angle: str,
    length: str = "m",
    sep: str = ",",
    decimal: str = ".",
    kinds: Sequence[str] | None = None,
) -> Tensor:
    """Read joint configurations alone from a CSV file, such as those to predict at.

    Args, errors and warnings are those of :func:`read_measurements`; ``length`` is the unit of prismatic joints.

    Returns:
        (N, n) in rad (revolute) and m (prismatic), rows in the order of the file.
    """
    q, _, _ = _read(Path(path), _Columns.of(joints, kinds, []), _Format(length, angle, sep, decimal))
    return q


def write_measurements(
    path: str | PathLike[str],
    data: Measurements,
    *,
    length: str,
    angle: str,
    joints: Sequence[str] | ChainLike | None = None,
    position: Sequence[str] | Sequence[Sequence[str]] | None = None,
    sep: str = ",",
    decimal: str = ".",
    kinds: Sequence[str] | None = None,
) -> None:
    """Write a CSV file that :func:`read_measurements` reads back with the same options; overwrites.

    In rad and m the round trip is exact; in deg and mm it is exact to the last digits of float64.

    Args:
        path: the file.
        data: measurements, rad and m.
        length: unit of positions and prismatic joints in the file, ``"m"`` or ``"mm"``.
        angle: unit of revolute joints in the file, ``"rad"`` or ``"deg"``.
        joints: names of the joint columns, or the robot; default ``data.joint_names`` or q1, q2, ...
        position: x, y, z columns of every marker; default x, y, z for one marker, else ``NAME_x``, ... with
            ``data.marker_names`` or marker1, marker2, ...
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        kinds: kind of every joint; without it, those of the robot, or all revolute.

    Raises:
        MeasurementError: unknown unit, a number of names that does not match, or a place that cannot be written.
    """
    layout = _Format(length, angle, sep, decimal)
    names = joints or data.joint_names or [f"q{i + 1}" for i in range(data.n)]
    columns = _Columns.of(names, kinds, _triples(position or _default_triples(data)))
    _check_count("joint columns", columns.joints, data.n, "joint")
    _check_count("position triples", columns.triples, data.markers, "marker")
    _write(Path(path), columns.names, layout.from_si(data.q, data.points, columns.prismatic), layout)


def write_predictions(
    path: str | PathLike[str],
    q: Tensor,
    points: Tensor,
    deviations: Tensor,
    *,
    joints: Sequence[str],
    length: str,
    angle: str,
    sep: str = ",",
    decimal: str = ".",
    kinds: Sequence[str] | None = None,
) -> None:
    """Write configurations, predicted markers and their standard deviations; overwrites.

    Columns: the joints, then x, y, z, std_x, std_y, std_z, for several markers each with the prefix marker1_, ...

    Args:
        path: the file.
        q: (N, n) configurations, rad and m.
        points: (N, P, 3) markers, m.
        deviations: (N, P, 3) standard deviations, m.
        joints: names of the joint columns.
        length: unit of lengths in the file, ``"m"`` or ``"mm"``.
        angle: unit of revolute joints in the file, ``"rad"`` or ``"deg"``.
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        kinds: kind of every joint; all revolute without it.

    Raises:
        MeasurementError: unknown unit, or a place that cannot be written.
    """
    layout, columns = _Format(length, angle, sep, decimal), _Columns.of(joints, kinds, [])
    markers = points.shape[1]
    prefixes = [f"marker{k + 1}_" for k in range(markers)] if markers > 1 else [""]
    names = [f"{prefix}{kind}{axis}" for prefix in prefixes for kind in ("", "std_") for axis in "xyz"]
    table = layout.from_si(q, torch.cat([points, deviations], -1), columns.prismatic)
    _write(Path(path), [*columns.joints, *names], table, layout)


def _write(path: Path, names: Sequence[str], table: Tensor, layout: _Format) -> None:
    """Write a table (N, columns) whose numbers are already in the units of the file."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, delimiter=layout.sep)
            writer.writerow(names)
            writer.writerows([repr(value).replace(".", layout.decimal) for value in row] for row in table.tolist())
    except OSError as error:
        what = f"file '{path}' cannot be written ({error.strerror})"
        raise MeasurementError(sentence(what, fix="choose an existing, writable folder")) from error


def _read(path: Path, columns: _Columns, layout: _Format) -> tuple[Tensor, Tensor, list[int]]:
    """Return q (N, n) in rad or m, points (N, P, 3) in m and the line number of every row."""
    raw, lines = read_columns(path, columns.names, layout.sep, layout.decimal)  # (N, n + 3 P), units of the file
    for doubt in layout.doubts(raw, columns.prismatic):
        warnings.warn(f"file '{path}': {doubt}", DiffeoCalibWarning, stacklevel=3)
    return *layout.to_si(raw, columns.prismatic), lines


def _without_copies(path: Path, data: Measurements, lines: Sequence[int], drop: bool) -> Measurements:
    """Drop or refuse the rows that copy an earlier one."""
    copies = data.copies()
    if copies and not drop:
        listed = few([f"{lines[row]} repeats {lines[earlier]}" for earlier, row in copies])
        what = f"file '{path}': {len(copies)} line(s) repeat an earlier line exactly: line {listed}"
        fix = "real repeats differ by noise: remove them, or pass duplicates='drop' or duplicates='keep'"
        raise MeasurementError(sentence(what, fix=fix))
    dropped = [row for _, row in copies]
    if dropped:
        text = f"file '{path}': dropped {len(dropped)} line(s) that repeat an earlier one exactly"
        text = f"{text} (line {few([lines[row] for row in dropped])}); pass duplicates='keep' to keep them."
        warnings.warn(text, DiffeoCalibWarning, stacklevel=3)
    return data.rows(np.setdiff1d(np.arange(len(data)), dropped))


# --- what the user says about the file ------------------------------------------------------------


@dataclass(frozen=True)
class _Format:
    """How numbers are written in the file."""

    length: str
    angle: str
    sep: str
    decimal: str

    def __post_init__(self) -> None:
        _check_choice("length", self.length, tuple(UNITS_PER_METRE))
        _check_choice("angle", self.angle, ANGLE_UNITS)
        _check_choice("decimal", self.decimal, (".", ","))
        sep = self.sep
        if not isinstance(sep, str) or len(sep) != 1 or sep in '"\r\n':
            fix = "pass ',' or ';' or '\\t'"
            raise MeasurementError(sentence("`sep`", expected="one character", got=repr(sep), fix=fix))
        if sep == self.decimal:
            what, fix = "`sep` and `decimal`", "pass sep=';' if the numbers have decimal commas"
            raise MeasurementError(sentence(what, expected="different characters", got=f"{sep!r} for both", fix=fix))

    def to_si(self, raw: Tensor, prismatic: Tensor) -> tuple[Tensor, Tensor]:
        """Convert rows (N, n + 3 P) in the file's units to q (N, n), rad or m, and points (N, P, 3), m."""
        q, points = raw[:, : len(prismatic)], raw[:, len(prismatic) :] / UNITS_PER_METRE[self.length]
        angles = q.deg2rad() if self.angle == "deg" else q
        return torch.where(prismatic, q / UNITS_PER_METRE[self.length], angles), points.reshape(len(raw), -1, 3)

    def from_si(self, q: Tensor, points: Tensor, prismatic: Tensor) -> Tensor:
        """The inverse of :meth:`to_si`."""
        q, per_metre = q.cpu(), UNITS_PER_METRE[self.length]
        angles = q.rad2deg() if self.angle == "deg" else q
        return torch.cat([torch.where(prismatic, q * per_metre, angles), points.cpu().flatten(1) * per_metre], dim=1)

    def doubts(self, raw: Tensor, prismatic: Tensor) -> list[str]:
        """Sentences about values (in the file's units) that look as if they were in the other unit."""
        n, length, angle = len(prismatic), self.length, self.angle
        turns, reach = _largest(raw[:, :n][:, ~prismatic]), _largest(raw[:, n:])
        degrees, radians = angle == "rad" and turns > MANY_TURNS, angle == "deg" and 0 < turns <= 2 * math.pi
        millimetres, metres = length == "m" and reach > _FAR, length == "mm" and 0 < reach < _NEAR
        doubts = (
            (degrees, f"angles reach {turns:g} rad: they look like degrees; pass angle='deg'"),
            (radians, f"angles reach only {turns:g} deg: they look like radians; pass angle='rad'"),
            (millimetres, f"positions reach {reach:g} m: they look like millimetres; pass length='mm'"),
            (metres, f"positions reach only {reach:g} mm: they look like metres; pass length='m'"),
        )
        return [f"{text} if they are." for doubtful, text in doubts if doubtful]


@dataclass(frozen=True)
class _Columns:
    """Which columns are wanted: names of n joints, which of them are prismatic (n,), (x, y, z) of every marker."""

    joints: tuple[str, ...]
    prismatic: Tensor
    triples: list[tuple[str, ...]]

    @classmethod
    def of(
        cls, joints: Sequence[str] | ChainLike, kinds: Sequence[str] | None, triples: list[tuple[str, ...]]
    ) -> _Columns:
        """Check names and kinds of columns."""
        if isinstance(joints, ChainLike):
            joints, kinds = joints.joint_names, joints.kinds if kinds is None else kinds
        if isinstance(joints, str) or len(joints) == 0 or not all(isinstance(name, str) for name in joints):
            what, fix = "`joints`", "pass a list such as ['q1', 'q2'], in the robot's order"
            raise MeasurementError(sentence(what, expected="names of columns, or a robot", got=repr(joints), fix=fix))
        kinds = ["revolute"] * len(joints) if kinds is None else list(kinds)
        _check_count("`kinds`", kinds, len(joints), "joint")
        for kind in kinds:
            _check_choice("kinds", kind, JOINT_KINDS)
        prismatic = torch.tensor([kind == "prismatic" for kind in kinds])
        columns = cls(tuple(name.strip() for name in joints), prismatic, triples)
        twice = repeated(columns.names)
        if twice:
            what, got = "`joints`" + " and `position`" * bool(triples), f"{twice} twice"
            raise MeasurementError(sentence(what, expected="distinct columns", got=got, fix="name every column once"))
        return columns

    @property
    def names(self) -> list[str]:
        """All columns, joints first."""
        return [*self.joints, *(name for triple in self.triples for name in triple)]


def _largest(values: Tensor) -> float:
    return float(values.abs().max()) if values.numel() else 0.0


def _triples(position: Sequence[str] | Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return one (x, y, z) triple of column names per marker."""
    groups = [position] if all(isinstance(name, str) for name in position) else position
    triples = [() if isinstance(group, str) else tuple(group) for group in groups]
    if not triples or not all(len(t) == 3 and all(isinstance(name, str) for name in t) for t in triples):
        what, fix = "`position`", "pass ('x', 'y', 'z'), or one such triple per marker"
        raise MeasurementError(sentence(what, expected="three names of columns", got=repr(position), fix=fix))
    return [tuple(str(name).strip() for name in triple) for triple in triples]


def _default_triples(data: Measurements) -> list[tuple[str, str, str]]:
    if data.markers == 1 and data.marker_names is None:
        return [("x", "y", "z")]
    marks = data.marker_names or [f"marker{k + 1}" for k in range(data.markers)]
    return [(f"{mark}_x", f"{mark}_y", f"{mark}_z") for mark in marks]


def _check_count(what: str, items: Sequence[object], count: int, each: str) -> None:
    if len(items) != count:
        got, fix = f"{len(items)} ({items})", f"pass one per {each}"
        raise MeasurementError(sentence(what, expected=count, got=got, fix=fix))


def _check_choice(name: str, value: object, allowed: Sequence[str]) -> None:
    if value not in allowed:
        expected = " or ".join(repr(choice) for choice in allowed)
        raise MeasurementError(sentence(f"`{name}`", expected=expected, got=repr(value), fix="pass one of these"))
