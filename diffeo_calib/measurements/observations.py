"""Rows of several kinds in one table: positions, poses, a ball in sockets, and readings of other devices.

The ball is one target: that of the rows in sockets and of the readings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, methods_outside_inference_mode, outside_inference_mode
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.measurements.checks import chosen_rows, numbers_of
from diffeo_calib.measurements.rows import RowGroups, check_alike, common, set_attributes

WITH_POSITION = ("position", "pose")  # kinds of rows of which a device measures positions


def _in_order(values: Sequence[Any], index: Sequence[Tensor]) -> Any:
    """Values (N_i, ...) or texts (N_i,) of parts with these row numbers (N_i,), in the order of the rows: (N, ...)."""
    order = torch.cat(tuple(index)).argsort()
    if isinstance(values[0], Tensor):
        return torch.cat(list(values))[order.to(values[0].device)]
    every = [text for part in values for text in part]
    return [every[place] for place in order.tolist()]


def _column(name: str) -> Any:
    return property(lambda data: _in_order([getattr(part, name) for part in data.parts], data.index))


NUMBERED = "device_names", "row_names", "places", "socket_numbers"


@methods_outside_inference_mode
@dataclass(frozen=True, init=False, repr=False, eq=False)
class Observations(RowGroups):
    """N rows of several kinds, made by :meth:`joined`.

    Args:
        parts: tables of one kind each: :class:`Measurements` of positions or of poses, and :class:`Readings`, in the
            order of their first rows.
        index: (N_i,) int64 for each part, its row numbers here.

    Other attributes are those that all parts have, see :class:`Measurements`; q, line_numbers, payload, covariates,
    device_names, places and socket_numbers hold the values of all rows. A line of a file that holds observations of
    several kinds is several rows.
    """

    parts: Any = ()
    index: Any = ()

    def __init__(self, parts: Sequence[Any], index: Sequence[Tensor]) -> None:
        order = sorted(range(len(index)), key=lambda k: int(index[k].min()))
        tables = [parts[k] for k in order]
        _check_joinable(tables)
        set_attributes(self, parts=tuple(tables), index=tuple(index[k] for k in order))
        alike = {name: getattr(tables[0], name) for name in ("joint_names", "payload_at", "covariate_names")}
        alike |= {name: common([getattr(part, name) for part in tables]) for name in ("file_sha256", "origin")}
        for name in ("q", "line_numbers", "payload", "covariates"):
            columns = [getattr(part, name) for part in tables]
            alike[name] = None if columns[0] is None else _in_order(columns, self.index)
        set_attributes(self, **alike)

    @classmethod
    def joined(cls, parts: Sequence[Any]) -> Observations:
        """The rows of several tables in order, see :meth:`Measurements.joined`."""
        return joined_tables(parts, apart=True)

    device_names, row_names, places, socket_numbers = map(_column, NUMBERED)

    @property
    def kinds(self) -> tuple[str, ...]:
        """(N,) "position", "pose", "socket", or the kind of readings."""
        return tuple(_in_order([[part.kind] * len(part) for part in self.parts], self.index))

    @property
    def session_names(self) -> tuple[str, ...]:
        """Names of the devices and set-ups, in order of first appearance; kinds have devices of their own."""
        return tuple(dict.fromkeys(name for name in self.device_names if name))

    @property
    def session(self) -> Tensor | None:
        """(N,) int64, number of each row's device or set-up in ``session_names``, -1 for none; None without any."""
        names = self.session_names
        return numbers_of(self.device_names, names) if names else None

    @property
    def without_device(self) -> bool:
        """Whether neither a position nor a pose was measured."""
        return not any(part.kind in WITH_POSITION for part in self.parts)

    def to_frame(self) -> Any:
        """See :meth:`RowGroups.to_frame`; the first column is kind, and cells of other kinds are NaN."""
        frames = [part.to_frame() for part in self.parts]
        import pandas  # noqa: PLC0415  # optional; the line before has found it

        whole = pandas.concat(frames).iloc[torch.cat(self.index).argsort().numpy()]
        whole.insert(0, "kind", self.kinds)
        return whole

    def rows(self, index: object) -> Observations:
        chosen = chosen_rows(index, len(self))
        parts, numbers = [], []
        for part, whole in zip(self.parts, self.index, strict=True):
            place = torch.full((len(self),), -1, dtype=torch.int64, device=HOST)
            place[whole] = torch.arange(len(part), device=HOST)
            here = (place[chosen] >= 0).nonzero()[:, 0]
            if len(here):
                parts.append(part.rows(place[chosen][here]))
                numbers.append(here)
        return Observations(parts, numbers)

    def of_each(self, change: Callable[[Any, Tensor], Any]) -> Observations:
        pairs = zip(self.parts, self.index, strict=True)
        return Observations([change(part, rows) for part, rows in pairs], self.index)


def _pieces(tables: Sequence[Any]) -> list[tuple[Any, Tensor]]:
    """The parts of all tables, each with its row numbers (M,), one table after another."""
    given: list[Any] = [tables] if isinstance(tables, RowGroups) else list(tables)
    if not given or not all(isinstance(table, RowGroups) for table in given):
        got = few([type(table).__name__ for table in given if not isinstance(table, RowGroups)])
        raise MeasurementError.of("tables to join", expected="at least one of dc.Measurements or dc.Readings", got=got)
    pieces, start = [], 0
    for table in given:
        pieces += [(part, start + rows) for part, rows in zip(table.parts, table.index, strict=True)]
        start += len(table)
    return pieces


@outside_inference_mode
def joined_tables(tables: Sequence[Any], *, apart: bool = False) -> Any:
    """The rows of several tables in order: :class:`Measurements` or :class:`Readings` if one table can hold them.

    These are rows with the same columns; rows of several kinds, and all with ``apart``, become :class:`Observations`.
    Beside images of a board positions and rows in sockets become readings of points of the same tool, see
    sensors/tool_frames.py.
    Raises MeasurementError: no table; tables that differ in joints, payloads, markers, tips, sockets or deviations.
    """
    pieces = _pieces(tables)
    if any("corners" in table.columns for table, _ in pieces):
        pieces = [(part, rows[here]) for table, rows in pieces for part, here in table.beside_images()]
    groups: dict[object, list[tuple[Any, Tensor]]] = {}
    for table, rows in pieces:
        groups.setdefault(table.column_kind, []).append((table, rows))
    parts = [type(group[0][0]).in_one([table for table, _ in group]) for group in groups.values()]
    numbers = [torch.cat([rows for _, rows in group]) for group in groups.values()]
    return Observations(parts, numbers) if apart or len(parts) > 1 else parts[0].rows(numbers[0].argsort())


def _check_joinable(tables: Sequence[Any]) -> None:
    """MeasurementError for tables that differ in joints, payloads, the ball's tip, or ways in which a device reads."""
    check_alike(tables, ("payload", "covariates"), ("n", "joint_names", "payload_at", "covariate_names"))
    tips = {tip for table in tables if (tip := table.ball_tip) is not None}
    if len(tips) > 1:
        fix = "the ball in sockets and that of readings is one: pass the rows of one ball"
        raise MeasurementError.of("the ball of the tables", expected="one tip", got=few(sorted(tips)), fix=fix)
    ways = dict[tuple[str, str], set[object]]()  # in which devices of a kind and name read: which one is meant?
    for table in (part for part in tables if part.kind not in WITH_POSITION):
        for name in set(table.device_names):
            ways.setdefault((table.kind, name), set()).add(table.column_kind)
    several = [f"{kind}s of '{name}'" for (kind, name), each in ways.items() if len(each) > 1]
    if several:
        fix = "name different devices differently, and give the deviations of all readings of a device, or of none"
        raise MeasurementError.of(few(sorted(several)), expected="one zero, lens and unit of a device", fix=fix)
