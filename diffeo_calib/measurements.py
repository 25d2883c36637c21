"""Measured pairs (joint configuration, marker positions): the table, its splits, CSV in and out.

Inside the package everything is SI and float64: radians for revolute joints, metres for prismatic
joints and for points. Units exist only at the two doors, :func:`read_measurements` and
:func:`write_measurements`, where they must be named: they are never guessed, only doubted with a
warning. Nothing here knows a robot or a kernel.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from diffeo_calib.errors import DiffeoCalibWarning, MeasurementError, sentence

REPEAT_TOLERANCE = 1e-3
"""Configurations closer than this in every joint (rad or m) are repeats of one another."""

METRES_PER = {"m": 1.0, "mm": 1000.0}  # a length in the file is divided by this
ANGLE_UNITS = ("rad", "deg")
JOINT_KINDS = ("revolute", "continuous", "prismatic")

_MANY_TURNS = 4 * math.pi  # rad: no usual axis turns this far, so larger values are probably degrees
_FAR = 100.0  # m: no usual measurement volume is this large, so larger values are probably millimetres
_NEAR = 10.0  # mm: no usual measurement volume is this small, so smaller values are probably metres
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MISSING = re.compile(r"|[+-]?(nan|inf|infinity)|n/?a|null|none", re.IGNORECASE)


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Measurements:
    """N joint configurations and the measured positions of P markers fixed on the tool.

    Args:
        q: (N, n) joint configurations, rad (revolute) or m (prismatic).
        points: (N, P, 3) measured positions of the P markers, m; (N, 3) means one marker.
        joint_names: n names, in the order of the columns of ``q``.
        marker_names: P names.

    The tensors are detached float64 copies: later changes of the arguments do not reach them.

    Raises:
        MeasurementError: wrong shape, no row, different numbers of rows, NaN or infinite values
            (row and column named), a number of names that does not match.

    Warns:
        DiffeoCalibWarning: exact repeats of a row; joint values so large that they look like degrees.
            Nothing is dropped.
    """

    q: Tensor
    points: Tensor
    joint_names: tuple[str, ...] | None
    marker_names: tuple[str, ...] | None

    def __init__(
        self,
        q: object,
        points: object,
        joint_names: Sequence[str] | None = None,
        marker_names: Sequence[str] | None = None,
    ) -> None:
        self._set(q, points, joint_names, marker_names)
        _warn_duplicates(self)
        _warn_degrees(self.q.abs().amax(dim=0), self.joint_names)

    def _set(self, q: object, points: object, joints: Sequence[str] | None, markers: Sequence[str] | None) -> None:
        angles, places = _numeric(q, "q", "(N, n)", (2,)), _numeric(points, "points", "(N, P, 3) or (N, 3)", (2, 3))
        if places.shape[-1] != 3:
            fix = "pass x, y and z of every marker, in metres"
            raise _error("`points`", expected="shape (N, P, 3) or (N, 3)", got=tuple(places.shape), fix=fix)
        if len(angles) != len(places):
            what, fix = "`q` and `points` differ in their number of rows", "pass one row of each per measurement"
            raise _error(what, expected=f"{len(angles)} rows of `points`", got=len(places), fix=fix)
        places = places.reshape(len(places), -1, 3).to(angles.device)  # (N, 3) -> (N, 1, 3)
        joint_names = _unique_names(joints, "joint_names", angles.shape[1], "column of `q`")
        marker_names = _unique_names(markers, "marker_names", places.shape[1], "marker in `points`")
        _check_finite(angles, "q", joint_names or [f"joint {j}" for j in range(angles.shape[1])])
        marks = marker_names or [f"marker {k}" for k in range(places.shape[1])]
        _check_finite(places.flatten(1), "points", [f"{mark}, {axis}" for mark in marks for axis in "xyz"])
        self._store(angles, places, joint_names, marker_names)

    def _store(
        self, q: Tensor, points: Tensor, joints: tuple[str, ...] | None, markers: tuple[str, ...] | None
    ) -> None:
        for name, value in (("q", q), ("points", points), ("joint_names", joints), ("marker_names", markers)):
            object.__setattr__(self, name, value)  # the class is frozen

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def markers(self) -> int:
        """Number of markers P."""
        return self.points.shape[1]

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        counts = (len(self), "row"), (self.n, "joint"), (self.markers, "marker")
        return f"Measurements({', '.join(f'{count} {thing}' + 's' * (count != 1) for count, thing in counts)})"

    def __getitem__(self, index: object) -> Measurements:
        return self.rows(index)

    def __iter__(self) -> Iterator[Measurements]:
        return (self.rows(i) for i in range(len(self)))

    def rows(self, index: object) -> Measurements:
        """Return the rows chosen by an integer, slice, list of integers or boolean mask, in that order.

        Raises:
            IndexError: an index out of range, or a mask of the wrong length.
            MeasurementError: no row is left.
        """
        if isinstance(index, Tensor):
            index = index.numpy(force=True)
        key = index if isinstance(index, slice) else np.asarray(index)
        chosen = np.arange(len(self))[key] if isinstance(key, slice) or key.size else np.arange(0)
        chosen = torch.as_tensor(np.atleast_1d(chosen), device=self.q.device)
        if len(chosen) == 0:
            fix = "choose other rows"
            raise _error("the selection holds no row", expected="at least one", got=0, fix=fix)
        subset = object.__new__(Measurements)  # checked already: no second round of checks and warnings
        subset._store(self.q[chosen], self.points[chosen], self.joint_names, self.marker_names)
        return subset

    def groups(self, tolerance: float = REPEAT_TOLERANCE) -> Tensor:
        """Label repeated configurations: rows with the same label are repeats of one another.

        Rows within ``tolerance`` of each other in every joint are linked; the groups are the connected
        components, so a chain of close rows is one group. Angles are compared as they are, without
        wrapping: q and q + 2 pi are different configurations.

        Args:
            tolerance: largest difference in any joint, rad or m.

        Returns:
            (N,) int64 labels 0, 1, ... in the order of first appearance.
        """
        q, rows = self.q.cpu().numpy(), len(self)
        pairs = KDTree(q).query_pairs(tolerance, p=math.inf, output_type="ndarray")  # (K, 2)
        links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(rows, rows))
        _, labels = connected_components(links, directed=False)
        _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
        return torch.as_tensor(np.argsort(np.argsort(first))[inverse.reshape(-1)], dtype=torch.int64)

    def split(self, fraction: float = 0.7, seed: int = 0) -> tuple[Measurements, Measurements]:
        """Split at random into (train, test), keeping repeated configurations together.

        Groups of repeats are shuffled; each in turn goes to ``train`` if that brings it nearer to
        ``round(fraction * N)`` rows. Both parts keep the order of the rows. Same seed, same split.

        Args:
            fraction: wanted share of rows in ``train``, between 0 and 1.
            seed: of the shuffle.

        Raises:
            MeasurementError: fraction outside (0, 1), or all rows repeat one configuration, so that one
                part would be empty.
        """
        if not 0.0 < fraction < 1.0:
            fix = "pass the share of rows to train on, such as 0.7"
            raise _error("`fraction`", expected="a number between 0 and 1", got=fraction, fix=fix)
        labels, sizes, order = self._shuffled_groups(seed, wanted=2, what="cannot split into train and test")
        target, have, taken = round(fraction * len(self)), 0, []
        for group in order:
            after = have + sizes[group]
            nearer = abs(after - target) < abs(have - target)
            if after < len(self) and (nearer or not taken):  # neither part may end up empty
                have, taken = after, [*taken, group]
        in_train = np.isin(labels, taken)
        return self.rows(in_train), self.rows(~in_train)

    def folds(self, k: int = 5, seed: int = 0) -> list[tuple[Measurements, Measurements]]:
        """Return ``k`` pairs (train, test) whose test parts cover every row once; repeats stay together.

        Args:
            k: number of folds, at least 2.
            seed: of the shuffle of the groups of repeats.

        Raises:
            MeasurementError: k below 2, or fewer distinct configurations than folds.
        """
        if k < 2:
            raise _error("`k`", expected="at least 2 folds", got=k, fix="pass 5 or 10")
        labels, sizes, order = self._shuffled_groups(seed, wanted=k, what=f"cannot make {k} folds")
        largest_first = order[np.argsort(-sizes[order], kind="stable")]
        load, fold_of = np.zeros(k, dtype=np.int64), np.zeros(len(sizes), dtype=np.int64)
        for group in largest_first:
            fold_of[group] = load.argmin()
            load[fold_of[group]] += sizes[group]
        fold = fold_of[labels]
        return [(self.rows(fold != i), self.rows(fold == i)) for i in range(k)]

    def _shuffled_groups(self, seed: int, wanted: int, what: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return labels (N,), group sizes (G,) and a random order of the groups (G,)."""
        labels = self.groups().numpy()
        sizes = np.bincount(labels)
        if len(sizes) < wanted:
            got = f"{len(sizes)} (in {len(self)} rows; rows within {REPEAT_TOLERANCE} rad or m stay together)"
            fix = "measure more configurations, or ask for fewer parts"
            raise _error(what, expected=f"at least {wanted} distinct configurations", got=got, fix=fix)
        return labels, sizes, np.random.default_rng(seed).permutation(len(sizes))


@runtime_checkable
class ChainLike(Protocol):
    """What reading and writing ask of a robot: the names and kinds of its joints, in order."""

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
    duplicates: Literal["error", "keep", "drop"] = "error",
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
        duplicates: rows with the same configuration and the same positions as an earlier row are an error
            (``"error"``), are kept (``"keep"``), or dropped with a warning (``"drop"``). Real repeats differ by noise.
        kinds: kind of every joint; without it, those of the robot, or all revolute.

    Returns:
        Measurements in rad and m, rows in the order of the file.

    Raises:
        MeasurementError: anything unreadable, missing, ragged, not finite or repeated (file, line and column named).

    Warns:
        DiffeoCalibWarning: values that look as if they were in the other unit; rows dropped.
    """
    _check_units(length, angle, sep, decimal)
    _check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    names, prismatic = _joints(joints, kinds)
    wanted = _distinct_columns(names, _triples(position))
    path = Path(path)
    raw, lines = _read_numbers(path, wanted, sep, decimal)  # (N, n + 3 P), units of the file
    _doubt_units(path, raw, prismatic, length, angle)
    q, points = _to_si(raw, prismatic, length, angle)
    keep = _without_duplicates(path, q, points, lines, duplicates)
    data = object.__new__(Measurements)
    data._set(q[keep], points[keep], names, None)
    return data


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
    _check_units(length, angle, sep, decimal)
    names, prismatic = _joints(joints or data.joint_names or [f"q{i + 1}" for i in range(data.n)], kinds)
    triples = _triples(position or _default_triples(data))
    columns = _distinct_columns(names, triples)
    _check_count("joint columns", names, data.n, "joint")
    _check_count("position triples", triples, data.markers, "marker")
    q = data.q.cpu().numpy()
    angles = np.rad2deg(q) if angle == "deg" else q
    q = np.where(prismatic, q * METRES_PER[length], angles)  # (N, n)
    table = np.concatenate([q, data.points.flatten(1).cpu().numpy() * METRES_PER[length]], axis=1)
    try:
        with Path(path).open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, delimiter=sep)
            writer.writerow(columns)
            writer.writerows([repr(value).replace(".", decimal) for value in row] for row in table.tolist())
    except OSError as error:
        what = f"file '{path}' cannot be written ({error.strerror})"
        raise _error(what, fix="choose an existing, writable folder") from error


# --- checks of arguments --------------------------------------------------------------------------


def _error(what: str, *, expected: object = None, got: object = None, fix: str = "") -> MeasurementError:
    return MeasurementError(sentence(what, expected=expected, got=got, fix=fix))


def _numeric(value: object, name: str, shape: str, ndims: tuple[int, ...]) -> Tensor:
    """Return a detached float64 copy with at least one row and one column."""
    try:
        tensor = value if isinstance(value, Tensor) else torch.as_tensor(np.array(value, dtype=np.float64))
        tensor = tensor.detach().to(torch.float64, copy=True)
    except (TypeError, ValueError, RuntimeError) as error:
        what = f"`{name}` cannot be read as numbers ({error})"
        raise _error(what, expected=f"an array {shape}", fix="pass rows of equal length") from error
    if tensor.ndim not in ndims or tensor.numel() == 0:
        got, fix = tuple(tensor.shape), "pass at least one row, one measurement per row"
        raise _error(f"`{name}`", expected=f"shape {shape}", got=got, fix=fix)
    return tensor


def _check_finite(table: Tensor, name: str, columns: Sequence[str]) -> None:
    """Raise if the table (N, c) holds NaN or infinity, naming the first row and column."""
    bad = (~torch.isfinite(table)).nonzero()
    if len(bad):
        row, column = (int(i) for i in bad[0])
        more = f" ({len(bad)} such values)" if len(bad) > 1 else ""
        what = f"`{name}`, row {row}, column {column} ({columns[column]}){more}"
        fix = "remove or repair these rows"
        raise _error(what, expected="finite numbers", got=float(table[row, column]), fix=fix)


def _unique_names(names: Sequence[str] | None, what: str, count: int, each: str) -> tuple[str, ...] | None:
    if names is None:
        return None
    names = (names,) if isinstance(names, str) else tuple(names)
    _check_count(f"`{what}`", names, count, each)
    if len(set(names)) < len(names):
        raise _error(f"`{what}`", expected="distinct names", got=list(names), fix="rename the repeated ones")
    return names


def _check_count(what: str, items: Sequence[object], count: int, each: str) -> None:
    if len(items) != count:
        got, fix = f"{len(items)} ({items})", f"pass one per {each}"
        raise _error(what, expected=count, got=got, fix=fix)


def _check_choice(name: str, value: object, allowed: Sequence[str]) -> None:
    if value not in allowed:
        choices = " or ".join(repr(choice) for choice in allowed)
        raise _error(f"`{name}`", expected=choices, got=repr(value), fix="pass one of these")


def _check_units(length: str, angle: str, sep: str, decimal: str) -> None:
    _check_choice("length", length, tuple(METRES_PER))
    _check_choice("angle", angle, ANGLE_UNITS)
    _check_choice("decimal", decimal, (".", ","))
    if not isinstance(sep, str) or len(sep) != 1 or sep in '"\r\n':
        raise _error("`sep`", expected="one character", got=repr(sep), fix="pass ',' or ';' or '\\t'")
    if sep == decimal:
        fix = "pass sep=';' if the numbers have decimal commas"
        raise _error("`sep` and `decimal`", expected="different characters", got=f"{sep!r} for both", fix=fix)


def _joints(joints: Sequence[str] | ChainLike, kinds: Sequence[str] | None) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of the joint columns and which of them are prismatic, (n,) bool."""
    if isinstance(joints, ChainLike):
        joints, kinds = joints.joint_names, joints.kinds if kinds is None else kinds
    joints = joints if isinstance(joints, str) else tuple(joints)
    if isinstance(joints, str) or len(joints) == 0 or not all(isinstance(name, str) for name in joints):
        fix = "pass a list such as ['q1', 'q2'], in the robot's order"
        raise _error("`joints`", expected="names of columns, or a robot", got=repr(joints), fix=fix)
    kinds = ["revolute"] * len(joints) if kinds is None else list(kinds)
    _check_count("`kinds`", kinds, len(joints), "joint")
    for kind in kinds:
        _check_choice("kinds", kind, JOINT_KINDS)
    return tuple(name.strip() for name in joints), np.array([kind == "prismatic" for kind in kinds])


def _triples(position: Sequence[str] | Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return one (x, y, z) triple of column names per marker."""
    groups = [position] if all(isinstance(name, str) for name in position) else position
    triples = [() if isinstance(group, str) else tuple(group) for group in groups]
    if not triples or not all(len(t) == 3 and all(isinstance(name, str) for name in t) for t in triples):
        fix = "pass ('x', 'y', 'z'), or one such triple per marker"
        raise _error("`position`", expected="three names of columns", got=repr(position), fix=fix)
    return [tuple(str(name).strip() for name in triple) for triple in triples]


def _default_triples(data: Measurements) -> list[tuple[str, str, str]]:
    if data.markers == 1 and data.marker_names is None:
        return [("x", "y", "z")]
    marks = data.marker_names or [f"marker{k + 1}" for k in range(data.markers)]
    return [(f"{mark}_x", f"{mark}_y", f"{mark}_z") for mark in marks]


def _distinct_columns(names: Sequence[str], triples: Sequence[Sequence[str]]) -> list[str]:
    wanted = [*names, *(name for triple in triples for name in triple)]
    twice = _repeated(wanted)
    if twice:
        fix = "name every column once"
        raise _error("`joints` and `position`", expected="distinct columns", got=f"{twice} twice", fix=fix)
    return wanted


def _repeated(names: Sequence[str]) -> list[str]:
    return [name for name, count in Counter(names).items() if count > 1]


# --- reading the file -----------------------------------------------------------------------------

Lines = list[tuple[int, list[str]]]  # (line number in the file, its cells)


def _read_numbers(path: Path, wanted: Sequence[str], sep: str, decimal: str) -> tuple[np.ndarray, list[int]]:
    """Return the wanted columns (N, columns) and the line number of every row."""
    header, lines = _read_table(path, sep)
    columns = _find_columns(path, header, wanted, sep)
    _check_rows(path, header, lines)
    return _parse(path, lines, wanted, columns, decimal), [line for line, _ in lines]


def _read_table(path: Path, sep: str) -> tuple[list[str], Lines]:
    """Return the header's cells and the other lines that are not blank."""
    lines: Lines = []
    line = 0
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, delimiter=sep, strict=True, skipinitialspace=sep != " ")
            for cells in reader:
                first, line = line + 1, reader.line_num  # a quoted cell may span lines
                if any(cell.strip() for cell in cells) or len(cells) > 1:
                    lines.append((first, [cell.strip() for cell in cells]))
    except FileNotFoundError as error:
        fix = f"check the name and the folder (searched from '{Path.cwd()}')"
        raise _error(f"file '{path}' does not exist", fix=fix) from error
    except OSError as error:
        fix = "pass the name of a readable file"
        raise _error(f"file '{path}' cannot be opened ({error.strerror})", fix=fix) from error
    except UnicodeDecodeError as error:
        fix = "save the table as CSV with UTF-8 encoding (a spreadsheet file cannot be read)"
        raise _error(f"file '{path}' is not UTF-8 text", expected="a CSV file", fix=fix) from error
    except csv.Error as error:
        what = f"file '{path}', line {line + 1}: not valid CSV ({error})"
        raise _error(what, fix="repair the quotes of this line") from error
    if not lines:
        fix = "check that it was exported completely"
        raise _error(f"file '{path}' is empty", expected="a header and rows of numbers", fix=fix)
    return lines[0][1], lines[1:]


def _find_columns(path: Path, header: list[str], wanted: Sequence[str], sep: str) -> list[int]:
    """Return the place of every wanted column."""
    missing = [name for name in wanted if name not in header]
    if missing and len(header) == 1:
        raise _one_column(path, header[0], sep)
    if "" in header:
        blank = _few([place + 1 for place, name in enumerate(header) if not name])
        fix = "name every column, or remove the extra separators"
        raise _error(f"file '{path}', header: column {blank} has no name", fix=fix)
    twice = _repeated(header)
    if twice:
        fix = "give every column its own name"
        raise _error(f"file '{path}', header: {twice} named more than once", fix=fix)
    if missing:
        what, got = f"file '{path}', header: no column {missing}", f"the columns {header}"
        raise _error(what, got=got, fix=_near(missing, header))
    return [header.index(name) for name in wanted]


def _one_column(path: Path, text: str, sep: str) -> MeasurementError:
    """Error for a header that came out as a single column: the wrong separator, most likely."""
    counts = {other: text.count(other) for other in ";,\t| " if other != sep}
    likely = max(counts, key=lambda other: counts[other])
    fix = f"pass sep={likely!r}" if counts[likely] else "check the file"
    got = "a single column " + repr(text if len(text) < 80 else text[:77] + "...")
    return _error(f"file '{path}', header", expected=f"columns separated by {sep!r}", got=got, fix=fix)


def _near(missing: Sequence[str], header: Sequence[str]) -> str:
    lowered = {name.lower(): name for name in header}
    near = {name: difflib.get_close_matches(name.lower(), lowered, n=2) for name in missing}
    hints = [
        f"for '{name}', did you mean {' or '.join(lowered[m] for m in found)}" for name, found in near.items() if found
    ]
    return "; ".join(hints) if hints else "pass the names as they stand in the header"


def _check_rows(path: Path, header: list[str], lines: Lines) -> None:
    if not lines:
        what, fix = f"file '{path}' has a header but no rows", "check that it was exported completely"
        raise _error(what, expected="at least one row of numbers", fix=fix)
    ragged = [(line, len(cells)) for line, cells in lines if len(cells) != len(header)]
    if ragged:
        what = f"file '{path}', line {_few([line for line, _ in ragged])}"
        fix = "repair these lines (a cell that holds the separator must be quoted)"
        raise _error(what, expected=f"{len(header)} cells as in the header", got=ragged[0][1], fix=fix)


def _parse(path: Path, lines: Lines, names: Sequence[str], columns: Sequence[int], decimal: str) -> np.ndarray:
    """Return the numbers of the chosen columns, (N, columns), in the file's units."""
    table = np.empty((len(lines), len(columns)))
    unreadable, missing = [], []
    for row, (line, cells) in enumerate(lines):
        for place, column in enumerate(columns):
            value = _number(cells[column], decimal)
            table[row, place] = math.nan if value is None else value
            if value is None:
                unreadable.append((line, names[place], cells[column]))
            elif not math.isfinite(value):
                missing.append((line, names[place], cells[column]))
    if unreadable:
        fix = _number_hint(unreadable[0][2], decimal)
        raise _bad_cells(path, unreadable, "a number", fix)
    if missing:
        raise _bad_cells(path, missing, "a finite number", "remove or repair these lines")
    return table


def _bad_cells(path: Path, cells: Sequence[tuple[int, str, str]], expected: str, fix: str) -> MeasurementError:
    """Error naming the first of the cells (line, column, text) and the lines of the next ones."""
    line, name, text = cells[0]
    others = list(dict.fromkeys(other for other, _, _ in cells if other != line))
    where = f" (and {len(cells) - 1} more, on line {_few(others or [line])})" if len(cells) > 1 else ""
    got = repr(text) if text else "an empty cell"
    return _error(f"file '{path}', line {line}, column '{name}'{where}", expected=expected, got=got, fix=fix)


def _number(text: str, decimal: str) -> float | None:
    """Return the number, NaN for an empty cell or a word for "missing", None for anything else."""
    if _MISSING.fullmatch(text):
        return math.nan
    if decimal != ".":
        text = text.replace(".", "?").replace(decimal, ".")  # a point is not a number's here
    return float(text) if _NUMBER.fullmatch(text) else None


def _number_hint(text: str, decimal: str) -> str:
    other, word = (",", "comma") if decimal == "." else (".", "point")
    if _number(text, other) is not None:
        return f"looks like a decimal {word}: pass decimal={other!r}"
    if "." in text and "," in text:
        return "export without thousands separators"
    return "repair this cell, or name another column"


def _few(items: Sequence[object], limit: int = 5) -> str:
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(str(item) for item in items[:limit]) + more


# --- units and doubts -----------------------------------------------------------------------------


def _to_si(raw: np.ndarray, prismatic: np.ndarray, length: str, angle: str) -> tuple[np.ndarray, np.ndarray]:
    """Convert rows (N, n + 3 P) from the file's units to q (N, n), rad or m, and points (N, P, 3), m."""
    lengths = raw / METRES_PER[length]
    angles = np.deg2rad(raw) if angle == "deg" else raw
    n = len(prismatic)
    return np.where(prismatic, lengths[:, :n], angles[:, :n]), lengths[:, n:].reshape(len(raw), -1, 3)


def _doubt_units(path: Path, raw: np.ndarray, prismatic: np.ndarray, length: str, angle: str) -> None:
    """Warn about values (in the file's units) that look as if they were in the other unit."""
    turns = np.abs(raw[:, : len(prismatic)][:, ~prismatic]).max(initial=0.0)
    reach = np.abs(raw[:, len(prismatic) :]).max(initial=0.0)
    low_turns, low_reach = 0 < turns <= 2 * math.pi, 0 < reach < _NEAR
    doubts = (
        (angle == "rad" and turns > _MANY_TURNS, f"angles reach {turns:g} rad: they look like degrees", "angle='deg'"),
        (angle == "deg" and low_turns, f"angles reach only {turns:g} deg: they look like radians", "angle='rad'"),
        (length == "m" and reach > _FAR, f"positions reach {reach:g} m: they look like millimetres", "length='mm'"),
        (length == "mm" and low_reach, f"positions reach only {reach:g} mm: they look like metres", "length='m'"),
    )
    for doubtful, what, instead in doubts:
        if doubtful:
            _warn(f"file '{path}': {what}; pass {instead} if they are.")


def _warn(text: str) -> None:
    """Warn at the line of the user: called by a check, called by a public function."""
    warnings.warn(text, DiffeoCalibWarning, stacklevel=4)


def _warn_degrees(largest: Tensor, names: Sequence[str] | None) -> None:
    joint = int(largest.argmax())
    if float(largest[joint]) > _MANY_TURNS:
        name = f" ('{names[joint]}')" if names else ""
        text = f"`q`, column {joint}{name} reaches {float(largest[joint]):g} rad: values look like degrees"
        _warn(f"{text}; convert them to radians if they are.")


def _duplicates(q: np.ndarray, points: np.ndarray) -> list[tuple[int, int]]:
    """Return (first row, later row) for every row that repeats an earlier one exactly."""
    table = np.concatenate([q, points.reshape(len(points), -1)], axis=1) + 0.0  # -0.0 becomes 0.0
    first: dict[bytes, int] = {}
    pairs = ((first.setdefault(values.tobytes(), row), row) for row, values in enumerate(table))
    return [(earlier, row) for earlier, row in pairs if earlier != row]


def _warn_duplicates(data: Measurements) -> None:
    pairs = _duplicates(data.q.cpu().numpy(), data.points.cpu().numpy())
    if pairs:
        where = f"first row {pairs[0][1]}, of row {pairs[0][0]}"
        text = f"{len(pairs)} of {len(data)} rows repeat an earlier row exactly: {where}"
        _warn(f"{text}; real repeats differ by noise: remove them if they are copies.")


def _without_duplicates(path: Path, q: np.ndarray, points: np.ndarray, lines: Sequence[int], rule: str) -> np.ndarray:
    """Return the rows to keep, (N',) int, after applying the rule for exact repeats."""
    pairs = [] if rule == "keep" else _duplicates(q, points)
    if pairs and rule == "error":
        what = f"file '{path}': {len(pairs)} line(s) repeat an earlier line exactly: "
        listed = _few([f"{lines[row]} repeats {lines[earlier]}" for earlier, row in pairs])
        fix = "real repeats differ by noise: remove them, or pass duplicates='drop' or duplicates='keep'"
        raise _error(f"{what}line {listed}", fix=fix)
    if pairs:
        listed = _few([lines[row] for _, row in pairs])
        text = f"file '{path}': dropped {len(pairs)} line(s) that repeat an earlier one exactly (line {listed})"
        _warn(f"{text}; pass duplicates='keep' to keep them.")
    return np.setdiff1d(np.arange(len(q)), [row for _, row in pairs])
