"""Checks and copies of the arrays that make a table of measurements, and what identifies a table."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import Shape, as_tensor
from diffeo_calib.common.data_frames import column_names, is_data_frame, named_columns
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, few, warn_user
from diffeo_calib.measurements.pose_frames import block_diagonal
from diffeo_calib.measurements.row_names import row_names
from diffeo_calib.measurements.sockets import socket_texts
from diffeo_calib.measurements.tool_camera import pose_jacobian
from diffeo_calib.measurements.unit_checks import unlikely_si_joints

LARGEST_SI = 1e9
"""Larger joint values or positions, rad or m, are no measurements."""


def warn_if_suspicious(data: Any) -> None:
    """Warn about exact copies of rows, and about joint values that look like degrees."""
    pairs = data.copies()
    if pairs:
        where = f"first row {pairs[0][1]}, of row {pairs[0][0]}"
        text = f"{len(pairs)} of {len(data)} rows repeat an earlier row exactly: {where}"
        warn_user(f"{text}; real repeats differ by noise: remove these rows if they are copies.")
    for text in unlikely_si_joints(data.q, data.joint_names):
        warn_user(text)


def joint_table(q: object, names: Sequence[str] | None) -> tuple[Tensor, tuple[str, ...] | None]:
    """A copy (N, n) of joint values, and the names of their columns if they have any.

    Of a data frame the columns named ``names``, or all columns under their own names.
    """
    if is_data_frame(q):
        chosen = column_names(q) if names is None else [names] if isinstance(names, str) else list(names)
        try:
            q = named_columns(q, chosen, "q")
        except InputError as error:
            raise MeasurementError(str(error)) from None
        names = [str(name) for name in chosen]
    angles = copied(q, "q", ("N", "n"), fix="pass one row per measurement")
    check_size(angles, "q")
    return angles, unique_names(names, "joint_names", angles.shape[1], "column of `q`")


def check_size(values: Tensor, name: str) -> None:
    """Raise MeasurementError for values in SI units that are no measurements: marks of missing readings, or damage."""
    bad = (values.abs() >= LARGEST_SI).nonzero()
    if len(bad):
        where = [int(i) for i in bad[0]]
        what = f"`{name}` has {len(bad)} value(s) that cannot be measured, the first at index {where}"
        expected, got = f"less than {LARGEST_SI:g} m or rad", f"{float(values[tuple(where)]):g}"
        raise MeasurementError.of(what, expected=expected, got=got, fix="remove or repair these rows")


def file_sha256(path: Path) -> str | None:
    """SHA-256 of a file; None for what can be read only once, such as a pipe."""
    if not path.is_file():
        return None
    sha = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            sha.update(block)
    return sha.hexdigest()


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
    """Row numbers (M,) that an integer, a slice, a list of integers or a boolean mask chooses of ``count`` rows.

    Raises:
        IndexError: an index out of range, or a mask of the wrong length.
        MeasurementError: no row, or nothing that chooses rows.
    """
    rows = np.arange(count)
    try:
        index = index.numpy(force=True) if isinstance(index, Tensor) else index
        key = index if isinstance(index, slice) else np.asarray(index)
        if not isinstance(key, slice) and key.dtype.kind not in "iub" and key.size:
            raise TypeError(f"{key.dtype} values")
        chosen = np.atleast_1d(rows[key] if isinstance(key, slice) or key.size else rows[:0])
    except (TypeError, ValueError, RuntimeError) as error:
        expected, got = "an integer, a slice, integers or a boolean mask", f"{type(index).__name__} ({error})"
        raise MeasurementError.of("the selection of rows", expected=expected, got=got) from None
    if chosen.ndim != 1:
        raise MeasurementError.of("the selection of rows", expected="one axis", got=f"{chosen.ndim} axes")
    if len(chosen) == 0:
        fix = "choose other rows"
        raise MeasurementError.of("the selection holds no row", expected="at least one", got=0, fix=fix)
    return torch.as_tensor(chosen, dtype=torch.int64, device=HOST)


def check_rows(q: Tensor, other: Tensor, name: str) -> None:
    """Raise MeasurementError unless both have the same number of rows."""
    if len(q) != len(other):
        what, fix = f"`q` and `{name}` differ in their number of rows", "pass one row of each per measurement"
        raise MeasurementError.of(what, expected=f"{len(q)} rows of `{name}`", got=len(other), fix=fix)


def deviations(value: object, name: str, like: Tensor) -> Tensor | None:
    """Standard deviations of the shape of ``like``, given as one for all, one per row, or finer."""
    if value is None:
        return None
    shapes = [tuple(like.shape[:axes]) for axes in range(like.ndim + 1)]
    fix = "pass one standard deviation for all, one per row, or finer"
    given = copied(value, name, *shapes, fix=fix).to(like.device)
    bad = (given <= 0).nonzero()
    if len(bad):
        where, got = [int(i) for i in bad[0]], float(given[tuple(bad[0])])
        what = f"`{name}`" + f", first at index {where}" * bool(where)
        raise MeasurementError.of(what, expected="positive numbers", got=got, fix="leave it out if it is not known")
    return given.reshape(*given.shape, *[1] * (like.ndim - given.ndim)).expand(like.shape).clone()


def payloads(value: object, q: Tensor) -> Tensor:
    """Masses (N,), one for each of the rows q (N, n), given so or as one for all."""
    fix = "pass one mass for all rows, or one for each"
    given = copied(value, "payload", (), (len(q),), fix=fix).to(q.device)
    negative = (given.reshape(-1) < 0).nonzero().flatten().tolist()
    if negative:
        what = f"`payload`, row {negative[0]}" if given.ndim else "`payload`"
        got = f"{float(given.reshape(-1)[negative[0]]):g}"
        raise MeasurementError.of(what, expected="a mass of 0 or more", got=got, fix="correct it")
    return given.expand(len(q)).clone()


def check_alike(parts: Sequence[Any], by_row: Sequence[str], alike: Sequence[str]) -> None:
    """Refuse tables that cannot be joined.

    Args:
        parts: the tables. by_row: columns that all of them have, or none. alike: other attributes that agree.
    """
    for part in parts:
        other = [name for name in alike if getattr(part, name, None) != getattr(parts[0], name, None)]
        other += [name for name in by_row if (getattr(part, name) is None) != (getattr(parts[0], name) is None)]
        if other:
            fix = "join rows that were measured in the same way, under the same names"
            raise MeasurementError.of(f"the tables differ in {', '.join(other)}", fix=fix)


def copied(value: object, name: str, shape: Shape, *also: Shape, fix: str) -> Tensor:
    """Return a checked, detached float64 copy."""
    try:
        return as_tensor(value, name, shape, also=also, fix=fix).detach().clone()
    except InputError as error:
        raise MeasurementError(str(error)) from None


def tip_names(names: Sequence[str] | None, bodies: int, points: int = 1) -> tuple[str, ...] | None:
    """Return the names of the tips that carry the points: one for each body, several of which may share a tip.

    Args:
        names: of the bodies' tips. bodies: number of markers or measured frames. points: of each body.
    """
    if names is None:
        return None
    names = (names,) if isinstance(names, str) else tuple(names)
    if len(names) != bodies or not all(isinstance(name, str) for name in names):
        fix = f"pass the name of a tip for every {'marker' if points == 1 else 'measured frame'}"
        raise MeasurementError.of("`on`", expected=f"{bodies} names", got=f"{len(names)} ({names})", fix=fix)
    return tuple(name for name in names for _ in range(points))


def session_numbers(names: Sequence[str] | None, rows: int) -> tuple[Tensor | None, tuple[str, ...]]:
    """Numbers (N,) of the sessions of rows in order of first appearance, and their names; None for no names."""
    if names is None:
        return None, ()
    texts = row_names(names, rows, "the names of sessions")
    known = tuple(dict.fromkeys(texts))
    return torch.tensor([known.index(text) for text in texts], dtype=torch.int64, device=HOST), known


def known_covariance(data: Any) -> Tensor | None:
    """See :attr:`Measurements.covariance`."""
    frames, std, rotation_std = data.frames, data.std, data.rotation_std
    if frames is None:
        return None if std is None else torch.diag_embed(std.nan_to_num(0.0).flatten(1).square())
    if data.pose_covariance is not None:
        slopes = pose_jacobian(frames, data.lever, data.board)[:, 0]
        return slopes @ data.pose_covariance @ slopes.mT
    if std is None and rotation_std is None:
        return None
    zero = torch.zeros_like(frames[..., :3, 3])
    position = zero if std is None else std
    rotation = zero if rotation_std is None else rotation_std.view_as(zero)
    factor = pose_jacobian(frames, data.lever, data.board) * torch.cat([position, rotation], dim=-1)[..., None, :]
    factor = factor.nan_to_num(0.0)  # hidden frames
    return block_diagonal(factor @ factor.mT)


def measured_sha256(data: Any) -> str:
    """See :attr:`Measurements.sha256`."""
    measured = {"points": data.points} if data.poses is None else {"poses": data.poses}
    measured = {} if data.without_device else measured
    arrays = {"q": data.q, **measured, "std": data.std, "rotation_std": data.rotation_std, "corners": data.corners}
    return arrays_sha256(arrays | {"payload": data.payload, "board": data.board}, socket_texts(data))


def unique_names(names: Sequence[str] | None, what: str, count: int, each: str) -> tuple[str, ...] | None:
    """Return distinct names, one for each of ``count`` things."""
    if names is None:
        return None
    try:
        names = (names,) if isinstance(names, str) else tuple(names)
    except (TypeError, RuntimeError):
        names = ()
    if not all(isinstance(name, str) for name in names):
        got = few([type(name).__name__ for name in names])
        raise MeasurementError.of(f"`{what}`", expected="texts", got=got, fix=f"pass one name per {each}")
    if len(names) != count:
        raise MeasurementError.of(
            f"`{what}`", expected=count, got=f"{len(names)} ({names})", fix=f"pass one per {each}"
        )
    if len(set(names)) < len(names):
        raise MeasurementError.of(
            f"`{what}`", expected="distinct names", got=list(names), fix="rename the repeated ones"
        )
    return names
