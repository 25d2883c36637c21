"""Checks and copies of the arrays that make a table, sentences about values that look wrong, and checksums."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from math import inf, isnan

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import Shape, as_tensor, real_tensor
from diffeo_calib.common.data_frames import column_names, is_data_frame, named_columns
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, few

LARGEST_JOINT_ANGLE_RAD = 4 * math.pi  # few axes turn further, so larger values are probably degrees
SURVEYED = 2e-3  # share of their size, below which positions move far from zero, as those of a survey
USUAL_SIZES = {
    "angles": (LARGEST_JOINT_ANGLE_RAD, 2 * math.pi),
    "rotations": (2 * math.pi + 0.01, 2 * math.pi),
    "positions": (100.0, 10.0),
    "prismatic joints": (100.0, 2.0),
}
"""Larger values in rad or m, and smaller ones in deg or mm, are probably in the other unit."""
OTHER_UNITS = {"rad": ("deg", "degrees"), "deg": ("rad", "radians"), "m": ("mm", "millimetres"), "mm": ("m", "metres")}

ANGLE_MISTAKES = (
    (math.pi / 180, "the joint values seem to be degrees: convert them to radians; check the angle unit"),
    (180 / math.pi, "the joint values seem to be radians that were converted; check the angle unit"),
)
"""Factor that undoes a wrong unit of joint values, and what to do."""


@contextmanager
def of_measurements() -> Iterator[None]:
    """Errors of input within are those of measurements."""
    try:
        yield
    except InputError as error:
        raise error if isinstance(error, MeasurementError) else MeasurementError(str(error)) from None


@contextmanager
def quiet(kind: type[Warning] = Warning) -> Iterator[None]:
    """Nothing within is warned of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kind)
        yield


def in_other_unit(ratio: float, tolerance: float) -> bool:
    """Whether lengths that differ by this ratio, within a relative tolerance, are the same in mm and in m."""
    return any(abs(ratio * factor - 1.0) < tolerance for factor in (1e-3, 1e3))


def unlikely_units(what: str, values: Tensor, unit: str, option: str, *, kinds_known: bool = True) -> list[str]:
    """A sentence about values in ``unit`` whose largest is unusual; none if it is not.

    Args:
        what: of USUAL_SIZES. option: argument that names their unit.
        kinds_known: whether the kinds of the joints are; otherwise angles may be lengths.
    """
    most, least = USUAL_SIZES[what]
    small, largest = unit in ("deg", "mm"), float(values.nan_to_num(0.0).abs().max()) if values.numel() else 0.0
    if what == "positions" and not small and len(values) > 1:  # those of a survey are far from zero
        moved = float((values.nan_to_num(-inf).amax(0) - values.nan_to_num(inf).amin(0)).max())
        largest = moved if 0.0 < moved < SURVEYED * largest else largest
    if unit not in OTHER_UNITS or not (0 < largest <= least if small else largest > most):
        return []
    other, words = OTHER_UNITS[unit]
    slide = "" if small or kinds_known else ", or pass the robot, which knows its prismatic joints"
    text = f"{what} reach {'only ' * small}{largest:g} {unit}: they look like {words}"
    return [f"{text}; pass {option}='{other}' if they are{slide}."]


def numbered(names: object, rows: int, what: str = "the names of sessions") -> tuple[Tensor, tuple[str, ...]]:
    """Numbers (N,) of the names of rows in order of first appearance, and these names.

    MeasurementError if there is not one per row, or for None, NaN or an empty text.
    """
    try:
        names = names.tolist() if isinstance(names, Tensor) else names
        given = list(names) if isinstance(names, Iterable) and not isinstance(names, str) else []
    except (RuntimeError, TypeError):  # of a tensor that is sparse, quantized, on the meta device or without axes
        given = []
    if len(given) != rows:
        raise MeasurementError.of(what, expected=f"{rows} names, one per row", got=len(given) or as_written(names))
    empty = [name is None or (isinstance(name, float) and isnan(name)) for name in given]  # NaN in data frames
    texts = ["" if none else str(name).strip() for none, name in zip(empty, given, strict=True)]
    if unnamed := [row for row, text in enumerate(texts) if not text]:
        text = f"{what}: {len(unnamed)} row(s) have no name, the first is row {unnamed[0]}"
        raise MeasurementError.of(text, fix="name every row")
    distinct = tuple(dict.fromkeys(texts))
    return numbers_of(texts, distinct), distinct


LARGEST_SI = 1e9  # larger joint values or positions, rad or m, are no measurements


def joint_table(q: object, names: Sequence[str] | None) -> tuple[Tensor, tuple[str, ...] | None]:
    """A copy (N, n) of joint values, and the names of their columns if they have any.

    Of a data frame the columns named ``names``, or all columns under their own names.
    """
    if is_data_frame(q):
        chosen = column_names(q) if names is None else [names] if isinstance(names, str) else list(names)
        with of_measurements():
            q = named_columns(q, chosen, "q")
        names = [str(name) for name in chosen]
    angles = copied(q, "q", ("N", "n"), fix="pass one row per measurement")
    check_size(angles, "q")
    return angles, checked_names(names, "joint_names", angles.shape[1], "column of `q`")


def check_size(values: Tensor, name: str) -> None:
    """Raise MeasurementError for values in SI units that are no measurements: marks of missing readings, or damage."""
    if len(bad := (values.abs() >= LARGEST_SI).nonzero()):
        what = f"`{name}` has {len(bad)} value(s) that cannot be measured, the first at index {bad[0].tolist()}"
        expected, got = f"less than {LARGEST_SI:g} m or rad", f"{float(values[tuple(bad[0])]):g}"
        raise MeasurementError.of(what, expected=expected, got=got, fix="remove or repair these rows")


def arrays_sha256(arrays: Mapping[str, Tensor | None], others: Mapping[str, bytes] | None = None) -> str:
    """SHA-256 over the names, shapes and values of arrays, and over other contents by name."""
    sha = hashlib.sha256()
    for name, array in arrays.items():
        if array is not None:
            sha.update(f"{name} {tuple(array.shape)}".encode())
            sha.update(array.detach().cpu().contiguous().numpy().tobytes())
    for name, content in (others or {}).items():
        sha.update(name.encode() + content)
    return sha.hexdigest()


def chosen_rows(index: object, count: int) -> Tensor:
    """Row numbers (M,) that an index chooses of ``count`` rows; see :meth:`RowGroups.rows`."""
    rows, what = np.arange(count), "the selection of rows"
    try:
        key = index.numpy(force=True) if isinstance(index, Tensor) else index
        key = key if isinstance(key, slice) else np.asarray(key)
        if not isinstance(key, slice) and key.dtype.kind not in "iub" and key.size:
            raise TypeError(f"{key.dtype} values")
        chosen = np.atleast_1d(rows[key] if isinstance(key, slice) or key.size else rows[:0])
    except (TypeError, ValueError, RuntimeError) as error:
        expected, got = "an integer, a slice, integers or a boolean mask", f"{type(index).__name__} ({error})"
        raise MeasurementError.of(what, expected=expected, got=got) from None
    if chosen.ndim != 1:
        raise MeasurementError.of(what, expected="one axis", got=f"{chosen.ndim} axes")
    if len(chosen) == 0:
        raise MeasurementError.of("the selection holds no row", expected="at least one", got=0, fix="choose other rows")
    return torch.as_tensor(chosen, dtype=torch.int64, device=HOST)


def check_rows(q: Tensor, other: Tensor, name: str) -> None:
    """Raise MeasurementError unless both have the same number of rows."""
    if len(q) != len(other):
        what, fix = f"`q` and `{name}` differ in their number of rows", "pass one row of each per measurement"
        raise MeasurementError.of(what, expected=f"{len(q)} rows of `{name}`", got=len(other), fix=fix)


def deviations(value: object, name: str, like: Tensor) -> Tensor | None:
    """Standard deviations of the shape of ``like``, given as one for all, one per row, or finer; None if not known.

    They are NaN where ``like`` is hidden, and given ones may be missing there.
    """
    if value is None:
        return None
    shapes, empty = [tuple(like.shape[:axes]) for axes in range(like.ndim + 1)], like.isnan()
    fix = "pass one standard deviation for all, one per row, or finer"
    if bool(empty.any()):
        value = real_tensor(value, name).detach().to(like.device)
        if value.ndim >= 2 and value.shape == like.shape[: value.ndim]:
            value = value.masked_fill(empty if value.ndim == like.ndim else empty.flatten(value.ndim).all(-1), 1.0)
    given = copied(value, name, *shapes, fix=fix).to(like.device)
    if len(bad := (given <= 0).nonzero()):
        what, got = f"`{name}`" + f", first at index {bad[0].tolist()}" * bool(given.ndim), float(given[tuple(bad[0])])
        raise MeasurementError.of(what, expected="positive numbers", got=got, fix="leave it out if it is not known")
    spread = given.reshape(*given.shape, *[1] * (like.ndim - given.ndim)).expand(like.shape)
    return spread.masked_fill(empty, torch.nan)


def copied(value: object, name: str, shape: Shape, *also: Shape, fix: str) -> Tensor:
    """Return a checked, detached float64 copy."""
    with of_measurements():
        return as_tensor(value, name, shape, also=also, fix=fix).detach().clone()


def tip_names(names: Sequence[str] | None, bodies: int, points: int = 1) -> tuple[str, ...] | None:
    """The tip of each point, of names of the tips of bodies, markers or frames, with so many points each."""
    each = "marker" if points == 1 else "measured frame"
    tips = checked_names(names, "on", bodies, each, distinct=False)
    return tips and tuple(name for name in tips for _ in range(points))


def texts_of(numbers: Tensor | None, names: Sequence[str], rows: int) -> list[str]:
    """(N,) names of numbered things, "" for the number -1, and for all of ``rows`` without numbers."""
    return [""] * rows if numbers is None else [names[number] if number >= 0 else "" for number in numbers.tolist()]


def numbers_of(names: Sequence[str], among: Sequence[str]) -> Tensor:
    """(N,) int64, numbers of names among the known ones, -1 for "": the inverse of :func:`texts_of`."""
    numbers = {"": -1} | {name: number for number, name in enumerate(among)}
    return torch.tensor([numbers[name] for name in names], dtype=torch.int64, device=HOST)


def checked_names(
    names: Sequence[str] | None, what: str, count: int, each: str, *, distinct: bool = True
) -> tuple[str, ...] | None:
    """Return names, one for each of ``count`` things, of which none has two unless ``distinct`` is False."""
    if names is None:
        return None
    try:
        names = (names,) if isinstance(names, str) else tuple(names)
    except (TypeError, RuntimeError):
        names = ()
    texts, repeats = all(isinstance(name, str) for name in names), distinct and len({*names}) < len(names)
    expected = f"{count} names" if texts and not repeats else "distinct names" if texts else "texts"
    if len(names) != count or not texts or repeats:
        got = f"{len(names)} ({few([*map(str, names)])})"
        raise MeasurementError.of(f"`{what}`", expected=expected, got=got, fix=f"pass one per {each}")
    return names


def seen_markers(points: Tensor) -> Tensor:
    """Which markers were seen: (N, P, 3) -> (N, P) boolean."""
    return ~points.isnan().any(2)


def marker_places(points: object) -> Tensor:
    """A checked copy (N, P, 3) of positions (N, P, 3) or (N, 3), NaN where a marker is hidden.

    Raises:
        MeasurementError: wrong shape, infinite values, a marker with some of its coordinates, a row without markers.
    """
    shapes, fix = (("N", "P", 3), ("N", 3)), "pass x, y and z of every marker, in metres"
    with of_measurements():
        raw = real_tensor(points, "points").detach()
    empty = raw.isnan() & (raw.ndim == 3 and raw.shape[1] > 1)  # a single marker is in every row
    places = copied(raw.masked_fill(empty, 0.0), "points", *shapes, fix=fix)
    if not bool(empty.any()):
        return places.reshape(len(places), -1, 3)  # (N, 3) -> (N, 1, 3)
    if len(half := (empty.any(2) & ~empty.all(2)).nonzero()):
        row, marker = half[0].tolist()
        what = f"`points`, row {row}, marker {marker}" + f" (and {len(half) - 1} more)" * (len(half) > 1)
        expected = "three finite numbers, or NaN for all three of a hidden marker"
        raise MeasurementError.of(what, expected=expected, got=raw[row, marker].tolist(), fix="repair these rows")
    if rows := empty.all(2).all(1).nonzero()[:, 0].tolist():
        what = f"`points`, row {few(rows)}: no marker was seen"
        raise MeasurementError.of(what, expected="at least one in every row", fix="leave these rows out")
    return places.masked_fill(empty, torch.nan)


def rare_names(names: Sequence[str], lines: Sequence[int], fewest: int) -> list[str]:
    """Names (N,), "" for none, with fewer rows, in words: with their lines, and the frequent name that they resemble.

    Most of them are spelling mistakes of another name. Names that differ in digits, such as "0/0" and "0/1", are not.
    """
    counts, texts = Counter(name for name in names if name), []
    digits = {name: "".join(filter(str.isdigit, name)) for name in counts}
    for name in (name for name in counts if counts[name] < fewest):
        numbers = [line for line, other in zip(lines, names, strict=True) if other == name]
        usual = [other for other, rows in counts.items() if rows >= fewest and digits[other] == digits[name]]
        meant = "".join(f", perhaps meant as '{other}'" for other in get_close_matches(name, usual, n=1))
        texts.append(f"'{name}' in {len(numbers)} row{'s' * (len(numbers) > 1)} ({few(numbers)}){meant}")
    return texts
