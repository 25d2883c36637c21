"""How tables are written: units, columns and their order, conventions of rotations.

Units exist only here, where they must be named: they are never guessed, only doubted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, listed, sentence
from diffeo_calib.measurements.csv_cells import repeated
from diffeo_calib.measurements.poses import ANGLE_UNITS, CONVENTIONS, is_euler, numbers_of
from diffeo_calib.measurements.table import MANY_TURNS, Measurements

UNITS_PER_METRE = {"m": 1.0, "mm": 1000.0}  # a length in the file is divided by this
JOINT_KINDS = ("revolute", "continuous", "prismatic")

_FAR = 100.0  # m: no usual measurement volume is this large, so larger values are probably millimetres
_NEAR = 10.0  # mm: no usual measurement volume is this small, so smaller values are probably metres
_TURN = 2 * math.pi + 0.01  # rad, with rounding: no rotation is written with larger values


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


class Values(NamedTuple):
    """Rows of a table in SI, but for the rotations, whose N x k numbers are as in the file."""

    q: Tensor  # (N, n) rad or m
    points: Tensor  # (N, P, 3) m
    rotations: Tensor  # (N, k)
    std: Tensor | None  # (N, P, 3) m
    rotation_std: Tensor | None  # (N, 3) rad


@dataclass(frozen=True)
class Orientation:
    """How orientations are written: k columns, their convention, their unit, columns of standard deviations."""

    columns: tuple[str, ...]
    convention: str
    angle: str
    std: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        columns: Sequence[str] | None,
        convention: str | None,
        angle: str | None,
        std: Sequence[str] | None,
    ) -> Orientation | None:
        """Check what a user says about the columns of a rotation; None if there are none."""
        if columns is None:
            given = {"convention": convention, "rotation_angle": angle, "rotation_std": std}
            names = " and ".join(f"`{name}`" for name, value in given.items() if value is not None)
            if names:
                fix = "name the columns of the rotation too, or leave this out"
                raise MeasurementError(sentence(f"{names} without `rotation`", fix=fix))
            return None
        if convention is None:
            what = "`rotation` is given, but its `convention` is not"
            raise MeasurementError(sentence(what, expected=CONVENTIONS, fix="name it: it is never guessed"))
        count = _numbers(convention)
        names = _column_names("rotation", columns, f"{count} names of columns for {convention!r}", (count,))
        deviations = () if std is None else _column_names("rotation_std", std, "three names of columns", (3,))
        return cls(names, convention, _rotation_unit(convention, angle, deviations), deviations)

    @classmethod
    def default(
        cls,
        columns: Sequence[str] | None,
        convention: str,
        angle: str,
        std: Sequence[str] | None,
        *,
        known: bool,
    ) -> Orientation:
        """The same for a table that is to be written, whose columns have default names."""
        count = _numbers(convention)
        check_choice("rotation_angle", angle, ANGLE_UNITS)
        names = _column_names("rotation", columns or _rotation_names(convention), f"{count} names", (count,))
        std = _column_names("rotation_std", std or ("std_rx", "std_ry", "std_rz"), "three names", (3,)) if known else ()
        return cls(names, convention, angle, std)


@dataclass(frozen=True)
class Format:
    """How numbers are written in the file."""

    length: str
    angle: str
    sep: str
    decimal: str

    def __post_init__(self) -> None:
        check_choice("length", self.length, tuple(UNITS_PER_METRE))
        check_choice("angle", self.angle, ANGLE_UNITS)
        check_choice("decimal", self.decimal, (".", ","))
        sep = self.sep
        if not isinstance(sep, str) or len(sep) != 1 or sep in '"\r\n':
            fix = "pass ',' or ';' or '\\t'"
            raise MeasurementError(sentence("`sep`", expected="one character", got=repr(sep), fix=fix))
        if sep == self.decimal:
            what, fix = "`sep` and `decimal`", "pass sep=';' if the numbers have decimal commas"
            raise MeasurementError(sentence(what, expected="different characters", got=f"{sep!r} for both", fix=fix))

    def to_si(self, raw: Tensor, columns: Columns) -> Values:
        """Convert rows (N, c) in the file's units, the columns as in ``columns.names``."""
        per_metre, count = UNITS_PER_METRE[self.length], len(columns.triples)
        q, points, rotations, std, turns = columns.parts(raw)
        joints = torch.where(columns.prismatic, q / per_metre, q.deg2rad() if self.angle == "deg" else q)
        known, known_turns = None, None
        if columns.std:
            std = std.reshape(len(raw), -1, 3 if len(columns.std) == 3 * count else 1)  # per coordinate or per marker
            known = (std / per_metre).expand(len(raw), count, 3)
        if columns.orientation is not None and columns.orientation.std:
            known_turns = turns.deg2rad() if columns.orientation.angle == "deg" else turns
        return Values(joints, (points / per_metre).reshape(len(raw), -1, 3), rotations, known, known_turns)

    def from_si(self, q: Tensor, lengths: Tensor, columns: Columns) -> Tensor:
        """Joints (N, n) and lengths (N, ...) in m as rows in the file's units."""
        q, per_metre = q.cpu(), UNITS_PER_METRE[self.length]
        angles = q.rad2deg() if self.angle == "deg" else q
        return torch.cat([torch.where(columns.prismatic, q * per_metre, angles), self.lengths(lengths)], dim=1)

    def lengths(self, values: Tensor) -> Tensor:
        """Lengths (N, ...) in m as rows in the file's unit."""
        return values.cpu().flatten(1) * UNITS_PER_METRE[self.length]

    def doubts(self, raw: Tensor, columns: Columns) -> list[str]:
        """Sentences about values (in the file's units) that look as if they were in the other unit."""
        q, points, *_ = columns.parts(raw)
        length, angle = self.length, self.angle
        turns, reach = _largest(q[:, ~columns.prismatic]), _largest(points)
        degrees, radians = angle == "rad" and turns > MANY_TURNS, angle == "deg" and 0 < turns <= 2 * math.pi
        millimetres, metres = length == "m" and reach > _FAR, length == "mm" and 0 < reach < _NEAR
        slide = "" if columns.told else ", or like millimetres of a slide; pass the robot, which knows its slides, or"
        doubts = (
            (degrees, f"angles reach {turns:g} rad: they look like degrees{slide or '; pass'} angle='deg'"),
            (radians, f"angles reach only {turns:g} deg: they look like radians; pass angle='rad'"),
            (millimetres, f"positions reach {reach:g} m: they look like millimetres; pass length='mm'"),
            (metres, f"positions reach only {reach:g} mm: they look like metres; pass length='m'"),
            *_rotation_doubts(raw, columns),
        )
        return [f"{text} if they are." for doubtful, text in doubts if doubtful]


@dataclass(frozen=True)
class Columns:
    """Which columns are wanted, in this order.

    Args:
        joints: names of n joints.
        prismatic: (n,) which of them are.
        triples: names of x, y and z of every marker.
        orientation: the columns of a rotation.
        std: names of standard deviations of positions: one, one per marker, or three per marker.
        told: whether the kinds of the joints were given; otherwise all are taken to turn.
    """

    joints: tuple[str, ...]
    prismatic: Tensor
    triples: list[tuple[str, ...]]
    orientation: Orientation | None = None
    std: tuple[str, ...] = ()
    told: bool = True

    @classmethod
    def of(
        cls,
        joints: Sequence[str] | ChainLike,
        kinds: Sequence[str] | None,
        triples: list[tuple[str, ...]],
        *,
        orientation: Orientation | None = None,
        std: Sequence[str] | Sequence[Sequence[str]] | None = None,
    ) -> Columns:
        """Check names and kinds of columns."""
        if isinstance(joints, ChainLike):
            joints, kinds = joints.joint_names, joints.kinds if kinds is None else kinds
        if isinstance(joints, str) or len(joints) == 0 or not all(isinstance(name, str) for name in joints):
            what, fix = "`joints`", "pass a list such as ['q1', 'q2'], in the robot's order"
            raise MeasurementError(sentence(what, expected="names of columns, or a robot", got=repr(joints), fix=fix))
        told = kinds is not None
        kinds = list(kinds) if told else ["revolute"] * len(joints)
        check_count("`kinds`", kinds, len(joints), "joint")
        for kind in kinds:
            check_choice("kinds", kind, JOINT_KINDS)
        prismatic = torch.tensor([kind == "prismatic" for kind in kinds])
        if orientation is not None and len(triples) != 1:
            what, got = "`position` beside `rotation`", f"{len(triples)} triples"
            fix = "name the position of the frame whose rotation is measured, or leave the rotation out"
            raise MeasurementError(sentence(what, expected="one triple of columns", got=got, fix=fix))
        deviations = _std_names(std, len(triples))
        columns = cls(tuple(name.strip() for name in joints), prismatic, triples, orientation, deviations, told)
        twice = repeated(columns.names)
        if twice:
            what, got = "`joints`" + " and `position`" * bool(triples), f"{listed(twice)} twice"
            what = what if orientation is None and not deviations else "the named columns"
            raise MeasurementError(sentence(what, expected="distinct columns", got=got, fix="name every column once"))
        return columns

    @property
    def names(self) -> list[str]:
        """All columns, joints first."""
        return [name for group in self._groups for name in group]

    def parts(self, raw: Tensor) -> tuple[Tensor, ...]:
        """Split rows (N, c) into joints, positions, rotations, deviations of positions, and of rotations."""
        return raw.split([len(group) for group in self._groups], dim=1)

    @property
    def deviations(self) -> tuple[str, ...]:
        """All columns of standard deviations: the last ones."""
        return self.std + (() if self.orientation is None else self.orientation.std)

    @property
    def _groups(self) -> tuple[Sequence[str], ...]:
        positions = [name for triple in self.triples for name in triple]
        turn = self.orientation
        return self.joints, positions, () if turn is None else turn.columns, self.std, () if turn is None else turn.std


def _largest(values: Tensor) -> float:
    return float(values.abs().max()) if values.numel() else 0.0


def _rotation_doubts(raw: Tensor, columns: Columns) -> list[tuple[bool, str]]:
    """The same for a rotation that is written in angles."""
    turn = columns.orientation
    if turn is None or len(turn.columns) != 3:
        return []
    largest = _largest(columns.parts(raw)[2])
    degrees, radians = turn.angle == "rad" and largest > _TURN, turn.angle == "deg" and 0 < largest <= 2 * math.pi
    return [
        (degrees, f"rotations reach {largest:g} rad: they look like degrees; pass rotation_angle='deg'"),
        (radians, f"rotations reach only {largest:g} deg: they look like radians; pass rotation_angle='rad'"),
    ]


def _numbers(convention: object) -> int:
    try:
        return numbers_of(convention)
    except InputError as error:
        raise MeasurementError(str(error)) from None


def _rotation_unit(convention: str, angle: str | None, std: Sequence[str]) -> str:
    """The unit of angles of a rotation, which must be named where there are angles and only there."""
    angular = _numbers(convention) == 3
    if angle is None and (angular or std):
        what = "`rotation_angle` is missing: the unit of " + ("the rotation" if angular else "`rotation_std`")
        fix = "name it, for it may differ from the unit of the joints"
        raise MeasurementError(sentence(what, expected="'rad' or 'deg'", fix=fix))
    if angle is not None and not angular and not std:
        what, fix = f"`rotation_angle` beside convention {convention!r}, which has no angles", "leave it out"
        raise MeasurementError(sentence(what, got=repr(angle), fix=fix))
    if angle is not None:
        check_choice("rotation_angle", angle, ANGLE_UNITS)
    return angle or "rad"


def _rotation_names(convention: str) -> tuple[str, ...]:
    """Names of columns for a rotation that is written."""
    if is_euler(convention):
        return ("euler1", "euler2", "euler3")
    names = {"rotvec": ("rx", "ry", "rz"), "matrix": tuple(f"r{i}{j}" for i in "123" for j in "123")}
    return names.get(convention) or tuple(f"q{letter}" for letter in convention.removeprefix("quat_"))


def _column_names(what: str, names: object, expected: str, counts: Sequence[int]) -> tuple[str, ...]:
    """Check a list of names of columns."""
    given = () if isinstance(names, str) or not isinstance(names, Sequence) else tuple(names)
    if len(given) not in counts or not all(isinstance(name, str) for name in given):
        fix = "pass a list such as ['a', 'b', 'c']"
        got = listed(given) if given and all(isinstance(name, str) for name in given) else repr(names)
        raise MeasurementError(sentence(f"`{what}`", expected=expected, got=got, fix=fix))
    return tuple(str(name).strip() for name in given)


def _std_names(std: Sequence[str] | Sequence[Sequence[str]] | None, markers: int) -> tuple[str, ...]:
    """One, ``markers`` or 3 x ``markers`` names, given flat or as one triple per marker."""
    if std is None:
        return ()
    nested = not isinstance(std, str) and len(std) > 0 and not any(isinstance(name, str) for name in std)
    names = [name for group in std for name in group] if nested else std
    return _column_names(
        "std", names, "names of columns: one, one per marker or three per marker", (1, markers, 3 * markers)
    )


def position_triples(position: Sequence[str] | Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return one (x, y, z) triple of column names per marker."""
    groups = [position] if all(isinstance(name, str) for name in position) else position
    triples = [() if isinstance(group, str) else tuple(group) for group in groups]
    if not triples or not all(len(t) == 3 and all(isinstance(name, str) for name in t) for t in triples):
        what, fix = "`position`", "pass ('x', 'y', 'z'), or one such triple per marker"
        raise MeasurementError(sentence(what, expected="three names of columns", got=repr(position), fix=fix))
    return [tuple(str(name).strip() for name in triple) for triple in triples]


def default_triples(data: Measurements) -> list[tuple[str, str, str]]:
    """Names of position columns for measurements that are written."""
    if data.poses is not None or (data.markers == 1 and data.marker_names is None):
        return [("x", "y", "z")]
    marks = data.marker_names or [f"marker{k + 1}" for k in range(data.markers)]
    return [(f"{mark}_x", f"{mark}_y", f"{mark}_z") for mark in marks]


def check_count(what: str, items: Sequence[object], count: int, each: str) -> None:
    """Raise MeasurementError unless there are ``count`` items."""
    if len(items) != count:
        got, fix = f"{len(items)} ({listed([str(item) for item in items])})", f"pass one per {each}"
        raise MeasurementError(sentence(what, expected=count, got=got, fix=fix))


def check_choice(name: str, value: object, allowed: Sequence[str]) -> None:
    """Raise MeasurementError unless a value is one of the allowed ones."""
    if value not in allowed:
        expected = " or ".join(repr(choice) for choice in allowed)
        raise MeasurementError(sentence(f"`{name}`", expected=expected, got=repr(value), fix="pass one of these"))
