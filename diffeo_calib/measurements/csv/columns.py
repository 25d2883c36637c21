"""The columns of a table: which are wanted, their order, and their conversion between the file's units and SI."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written, listed
from diffeo_calib.measurements.checks import unlikely_units
from diffeo_calib.measurements.csv.cells import repeated
from diffeo_calib.measurements.table_format import Names, TableFormat, check_choice, column_names, flat_names
from diffeo_calib.robots.joint import KINDS


@runtime_checkable
class ChainLike(Protocol):
    """Names and kinds of a robot's joints, in order: all that tables need of it."""

    @property
    def joint_names(self) -> Sequence[str]:
        """Names of the joints."""
        ...

    @property
    def kinds(self) -> Sequence[str]:
        """``"revolute"``, ``"continuous"`` or ``"prismatic"`` for every joint."""
        ...


class Values(NamedTuple):
    """Rows of a table in SI, except for the rotations, whose k numbers each are as in the file."""

    q: Tensor  # (N, n) rad or m
    points: Tensor  # (N, P, 3) m
    rotations: Tensor  # (N, T k) of T frames
    std: Tensor | None  # (N, P, 3) m
    rotation_std: Tensor | None  # (N, T, 3) rad
    payload: Tensor | None  # (N,) in the unit of the file
    time: Tensor | None = None  # (N,) in the unit of the file
    temperature: Tensor | None = None  # (N,) in the unit of the file

    def beside(self, rows: Any) -> Any:
        """Rows with what the table tells of them besides joints and measured values."""
        return rows.with_payload(self.payload).with_covariates(time=self.time, temperature=self.temperature)


@dataclass(frozen=True)
class Columns:
    """The wanted columns in this order: joints, positions, rotation, covariates, payload, deviations.

    Args:
        table: units, and the convention of the rotation.
        joints: names of n joints.
        prismatic: (n,) which of them are prismatic.
        triples: names of x, y and z of every marker.
        rotation: names of the columns of the rotations, as many for each of the triples.
        std: names of standard deviations of positions: one, one per marker, or three per marker.
        rotation_std: names of standard deviations of rotations: one, one per frame, or three per frame.
        payload: name of the column of masses, if there is one.
        kinds_known: whether the kinds of the joints were given; otherwise all are taken as revolute.
        covariates: names of the columns with which something may drift.
        all_hidden: whether rows may show no marker, because their ball rested in a socket.
    """

    table: TableFormat
    joints: tuple[str, ...]
    prismatic: Tensor
    triples: list[tuple[str, ...]]
    rotation: tuple[str, ...] = ()
    std: tuple[str, ...] = ()
    rotation_std: tuple[str, ...] = ()
    kinds_known: bool = True
    payload: tuple[str, ...] = ()
    all_hidden: bool = False
    covariates: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        table: TableFormat,
        joints: Sequence[str] | ChainLike,
        kinds: Sequence[str] | None,
        triples: list[tuple[str, ...]],
    ) -> Columns:
        """Check names and kinds of columns.

        Raises:
            MeasurementError: not names, another number of kinds than names or unknown ones, a unit of prismatic joints
                without kinds, other numbers of positions and rotations, or a column named twice.
        """
        names, prismatic, kinds_known = _joint_columns(joints, kinds)
        if table.joint_length is not None and not kinds_known:
            what, fix = "`joint_length` without the kinds of the joints", "pass the robot, or `kinds`"
            raise MeasurementError.of(what, got="joints that are all taken as revolute", fix=fix)
        rotation, rotation_std = flat_names(table.rotation), flat_names(table.rotation_std)
        _check_frames(table, len(triples))
        std = _std_names(table.std, len(triples))
        payload = (
            () if table.payload is None else column_names("payload", [table.payload], "the name of a column", (1,))
        )
        columns = cls(table, names, prismatic, triples, rotation, std, rotation_std, kinds_known, payload)
        columns = replace(columns, covariates=tuple(table.covariates.values()))
        twice = repeated(columns.names)
        if twice:
            plain = not rotation and not std and not payload and not columns.covariates
            what = "`joints`" + " and `position`" * bool(triples) if plain else "the named columns"
            fix = "name every column once"
            fix += ", and one that holds the deviations of all axes alone" * bool({*twice} & {*columns.deviations})
            raise MeasurementError.of(what, expected="distinct columns", got=f"{listed(twice)} twice", fix=fix)
        return columns

    @property
    def names(self) -> list[str]:
        """All columns, joints first."""
        return [name for group in self._groups for name in group]

    @property
    def deviations(self) -> tuple[str, ...]:
        """All columns of standard deviations: the last ones."""
        return self.std + self.rotation_std

    @property
    def hideable(self) -> list[tuple[list[int], list[int]]]:
        """Places of a marker's or frame's values among all columns, and of its deviations; none that is always seen."""
        count = len(self.triples)
        if count < 2 - self.all_hidden:
            return []
        place = {name: number for number, name in enumerate(self.names)}

        def own(names: Sequence[str], k: int) -> list[int]:
            each = len(names) // count  # of deviations 0, 1 or 3; one for all markers belongs to none
            return [place[name] for name in names[k * each : (k + 1) * each]]

        return [
            ([place[name] for name in triple] + own(self.rotation, k), own(self.std, k) + own(self.rotation_std, k))
            for k, triple in enumerate(self.triples)
        ]

    @property
    def rotation_unit(self) -> str:
        """Unit of the rotation's angles; "rad" where there are none."""
        return self.table.rotation_angle or "rad"

    def to_si(self, raw: Tensor) -> Values:
        """Convert rows (N, c) in the file's units, columns in the order of ``names``."""
        per_metre, count = self.table.per_metre, len(self.triples)
        q, points, rotations, drifting, payload, std, rotation_std = self._parts(raw)
        joints = torch.where(
            self.prismatic, q / self.table.joints_per_metre, q.deg2rad() if self.table.angle == "deg" else q
        )
        known, rotations_known = None, None
        if self.std:
            std = std.reshape(len(raw), -1, 3 if len(self.std) == 3 * count else 1)  # per coordinate or per marker
            known = (std / per_metre).expand(len(raw), count, 3)
        if self.rotation_std:
            rotations_known = rotation_std.deg2rad() if self.rotation_unit == "deg" else rotation_std
            each = 3 if len(self.rotation_std) == 3 * count else 1  # per axis or per frame
            rotations_known = rotations_known.reshape(len(raw), -1, each).expand(len(raw), count, 3)
        places, masses = (points / per_metre).reshape(len(raw), -1, 3), payload[:, 0] if self.payload else None
        covariates = dict(zip(self.table.covariates, drifting.T, strict=True))
        return Values(joints, places, rotations, known, rotations_known, masses, **covariates)

    def joints_from_si(self, q: Tensor) -> Tensor:
        """Joint values (N, n) in rad and m as rows in the file's units."""
        q, table = q.cpu(), self.table
        return torch.where(self.prismatic, q * table.joints_per_metre, q.rad2deg() if table.angle == "deg" else q)

    def lengths_from_si(self, values: Tensor) -> Tensor:
        """Lengths (N, ...) in m as rows in the file's unit."""
        return values.cpu().flatten(1) * self.table.per_metre

    def unlikely_units(self, raw: Tensor) -> list[str]:
        """Sentences about values (N, c), in the file's units, that look as if they were in another unit."""
        q, points, rotations, *_ = self._parts(raw)
        angle, known = _largest(q[:, ~self.prismatic]), self.kinds_known
        sentences = unlikely_units("angles", angle, self.table.angle, "angle", kinds_known=known)
        slides = _largest(q[:, self.prismatic])
        sentences += unlikely_units("prismatic joints", slides, self.table.joint_unit, "joint_length")
        sentences += unlikely_units("positions", _largest(points), self.table.length, "length")
        if self.rotation and len(self.rotation) == 3 * len(self.triples):
            sentences += unlikely_units("rotations", _largest(rotations), self.rotation_unit, "rotation_angle")
        return sentences

    def _parts(self, raw: Tensor) -> tuple[Tensor, ...]:
        """Split rows (N, c) into the groups of columns."""
        return raw.split([len(group) for group in self._groups], dim=1)

    @property
    def _groups(self) -> tuple[Sequence[str], ...]:
        positions = [name for triple in self.triples for name in triple]
        return self.joints, positions, self.rotation, self.covariates, self.payload, self.std, self.rotation_std


def _check_frames(table: TableFormat, positions: int) -> None:
    """Raise MeasurementError unless every rotation has its position, and every deviation its rotation."""
    deviations = None if len(flat_names(table.rotation_std)) == 1 else table.rotation_std  # one for all frames
    for name, names in (("rotation", table.rotation), ("rotation_std", deviations)):
        count = 0 if not names else 1 if isinstance(names[0], str) else len(names)
        if count not in (0, positions):
            got = f"{positions} triples and {count} {'list' if count == 1 else 'lists'} of columns in `{name}`"
            fix = "name the position of every frame whose rotation is measured, or leave the rotations out"
            what, expected = f"`position` beside `{name}`", "one triple of columns for each"
            raise MeasurementError.of(what, expected=expected, got=got, fix=fix)


def position_triples(position: Names) -> list[tuple[str, ...]]:
    """Return one (x, y, z) triple of column names per marker.

    Raises:
        MeasurementError: not three names per marker.
    """
    groups = [position] if all(isinstance(name, str) for name in position) else position
    triples = [() if isinstance(group, str) else tuple(group) for group in groups]
    if not triples or not all(len(t) == 3 and all(isinstance(name, str) for name in t) for t in triples):
        expected, fix = "three names of columns", "pass ('x', 'y', 'z'), or one such triple per marker"
        raise MeasurementError.of("`position`", expected=expected, got=as_written(position), fix=fix)
    return [tuple(str(name).strip() for name in triple) for triple in triples]


def check_count(what: str, items: Sequence[object], count: int, each: str) -> None:
    """Raise MeasurementError unless there are ``count`` items."""
    if len(items) != count:
        got = f"{len(items)} ({listed([str(item) for item in items])})"
        raise MeasurementError.of(what, expected=count, got=got, fix=f"pass one per {each}")


def _joint_columns(
    joints: Sequence[str] | ChainLike, kinds: Sequence[str] | None
) -> tuple[tuple[str, ...], Tensor, bool]:
    """Names of the joints, which of them are prismatic, and whether that is known."""
    if isinstance(joints, ChainLike):
        joints, kinds = joints.joint_names, joints.kinds if kinds is None else kinds
    if isinstance(joints, str) or len(joints) == 0 or not all(isinstance(name, str) for name in joints):
        expected, fix = "names of columns, or a robot", "pass a list such as ['q1', 'q2'], in the robot's order"
        raise MeasurementError.of("`joints`", expected=expected, got=as_written(joints), fix=fix)
    known = kinds is not None
    kinds = list(kinds) if known else ["revolute"] * len(joints)
    if len(kinds) != len(joints):
        expected = f"{len(kinds)} columns of joints, one for each of `kinds`"
        fix = "name a column for every joint of the robot, in its order"
        raise MeasurementError.of("`joints`", expected=expected, got=f"{len(joints)} ({listed(joints)})", fix=fix)
    for kind in kinds:
        check_choice("kinds", kind, [known for known in KINDS if known != "fixed"])
    prismatic = torch.tensor([kind == "prismatic" for kind in kinds], dtype=torch.bool, device=HOST)
    return tuple(name.strip() for name in joints), prismatic, known


def _std_names(std: Names | None, markers: int) -> tuple[str, ...]:
    """One, ``markers`` or 3 x ``markers`` names, given flat or as one triple per marker."""
    if std is None:
        return ()
    names = std if isinstance(std, str) else flat_names(std) or std
    expected = "names of columns: one, one per marker or three per marker"
    return column_names("std", names, expected, (1, markers, 3 * markers))


def _largest(values: Tensor) -> float:
    return float(values.abs().max()) if values.numel() else 0.0
