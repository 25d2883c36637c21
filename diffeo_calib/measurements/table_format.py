"""How a table is written: units, separators, and the columns of rotations and standard deviations.

Units exist only in files. They must always be named and are never guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from diffeo_calib.common.errors import MeasurementError, as_written, listed
from diffeo_calib.measurements.checks import of_measurements
from diffeo_calib.measurements.poses import ANGLE_UNITS, CONVENTIONS, LEVER, numbers_of

Names = Sequence[str] | Sequence[Sequence[str]]
"""Names of columns: a list, or one for each marker or frame."""
UNITS_PER_METRE = {"m": 1.0, "mm": 1000.0, "cm": 100.0, "inch": 1 / 0.0254}
"""A length in a file is divided by this."""
ROTATION_NAMES = {
    "rotvec": ("rx", "ry", "rz"),
    "quat_xyzw": ("qx", "qy", "qz", "qw"),
    "quat_wxyz": ("qw", "qx", "qy", "qz"),
    "matrix": tuple(f"r{i}{j}" for i in "123" for j in "123"),
}
"""Default names of the columns of a rotation that is written; euler1, ... for Euler angles."""
BESIDE = ("time", "temperature", "payload")
"""Columns with one number a row beside joints and what was measured, which any table may have."""


@dataclass(frozen=True)
class TableFormat:
    """What a table of measurements or predictions holds, and how it is written.

    Args:
        length: unit of the positions in the file. angle: of its revolute joints.
        sep: one character between cells. decimal: ``"."`` or ``","``.
        rotation: names of the columns of the tool's rotation, for measured poses, or one such list for each frame on
            several tips, whose origins are the positions. Rotation and position map from the tool's frame to the
            measuring frame.
        convention: how all rotations are written: ``"rotvec"``, ``"quat_xyzw"``, ``"quat_wxyz"``, ``"matrix"`` (nine
            columns row by row) or an order of Euler angles: extrinsic as ``"xyz"``, intrinsic as ``"XYZ"``.
        rotation_angle: unit of Euler angles, rotation vectors and ``rotation_std``, ``"rad"`` or ``"deg"``.
        lever: see :meth:`Measurements.from_poses`; in m, whatever the unit of length in the file.
        std: names of columns with standard deviations of the positions, in the unit of length: one for all, one
            per marker or three per marker.
        rotation_std: names of columns with standard deviations of the rotation about the axes of the measuring frame,
            which are not the axes of Euler angles: one for all, or one or three for each frame.
        joint_length: unit of the prismatic joints in the file; that of the positions by default.
        payload: name of a column with the known mass that the robot carried at its tip, in any unit; 0 without load.
            For another link see :meth:`Measurements.with_payload`.
        time, temperature: names of columns with which something may drift, see :meth:`Measurements.with_covariates`.
        camera_on_tool: the poses are those of a fixed board in the frame of a camera on the tool, and standard
            deviations are along its axes; see :meth:`Measurements.from_poses`.
        remounted: whether the markers were mounted anew between the set-ups, see :meth:`Measurements.with_sessions`.
        joints: names of the joint columns in the robot's order, or the robot, or expressions of columns. kinds: of each
            joint; by default those of the robot, or all revolute.
        position: names of the x, y and z columns of the marker, or one such triple per marker; None without positions.
        sockets: columns of a ball in sockets. readings: of each kind of reading, and of images (csv/sensors.py).
        session: name of a column whose texts tell the set-ups of the device apart that measures positions or poses, see
            :meth:`Measurements.with_sessions`.
        on: names of the tips that carry the markers or frames, one for each, for a robot with several tips.
        marker: name of a column that names the marker of every line, where each has the position of one. Lines with the
            same joint values that follow each other are one row. Markers are in the order in which they appear, or, for
            rows of a model, in the one that ``"COLUMN=A,B,C"`` gives.

    Raises:
        MeasurementError: an unknown unit, a separator that is not one character, or one that is also the decimal mark.
    """

    length: str
    angle: str
    sep: str = ","
    decimal: str = "."
    rotation: Names | None = None
    convention: str | None = None
    rotation_angle: str | None = None
    lever: float = LEVER
    std: Names | None = None
    rotation_std: Names | None = None
    joint_length: str | None = None
    payload: str | None = None
    time: str | None = None
    temperature: str | None = None
    camera_on_tool: bool = False
    remounted: bool = False
    joints: Any = ()
    kinds: Sequence[str] | None = None
    position: Names | None = None
    sockets: Any = None
    readings: tuple[Any, ...] = ()
    session: str | None = None
    on: Sequence[str] | None = None
    marker: str | None = None

    def __post_init__(self) -> None:
        check_choice("length", self.length, tuple(UNITS_PER_METRE))
        check_choice("angle", self.angle, ANGLE_UNITS)
        check_choice("joint_length", self.joint_unit, tuple(UNITS_PER_METRE))
        check_choice("decimal", self.decimal, (".", ","))
        sep = self.sep
        if not isinstance(sep, str) or len(sep) != 1 or sep in '"\r\n':
            fix = "pass ',' or ';' or '\\t'"
            raise MeasurementError.of("`sep`", expected="one character", got=as_written(sep), fix=fix)
        if sep == self.decimal:
            fix = "pass sep=';' if the numbers have decimal commas"
            got = f"{sep!r} for both"
            raise MeasurementError.of("`sep` and `decimal`", expected="different characters", got=got, fix=fix)

    @property
    def beside(self) -> dict[str, str]:
        """Names of the columns of :data:`BESIDE`, by what they hold."""
        return {name: column for name in BESIDE if (column := getattr(self, name)) is not None}

    @property
    def per_metre(self) -> float:
        """Units of length per metre."""
        return UNITS_PER_METRE[self.length]

    @property
    def joint_unit(self) -> str:
        """Unit of the prismatic joints."""
        return self.joint_length or self.length

    @property
    def joints_per_metre(self) -> float:
        """Units of the prismatic joints per metre."""
        return UNITS_PER_METRE[self.joint_unit]

    def joints_only(self, joints: Any, kinds: Sequence[str] | None = None) -> TableFormat:
        """The same units, marks and columns beside them, for a table of the values of these joints."""
        kept = "length", "angle", "sep", "decimal", "joint_length", *BESIDE
        return TableFormat(**{name: getattr(self, name) for name in kept}, joints=joints, kinds=kinds)

    @property
    def triples(self) -> list[tuple[str, ...]]:
        """Names of x, y and z of every marker; MeasurementError for other numbers of names."""
        if self.position is None:
            return []
        return list(by_frame("position", self.position, "three names of columns for each marker", 3))

    def for_reading(self) -> TableFormat:
        """The same format with checked options of the rotation.

        Raises:
            MeasurementError: a convention or unit that is missing, unknown or not needed, or a wrong number of names.
        """
        if self.rotation is None:
            options = ("convention", "rotation_angle", "rotation_std")
            names = " and ".join(f"`{name}`" for name in options if getattr(self, name) is not None)
            if names or self.camera_on_tool:
                fix = "name the columns of the rotation too, or leave this out"
                raise MeasurementError.of(f"{names or '`camera_on_tool`'} without `rotation`", fix=fix)
            return self
        if self.convention is None:
            what = "`rotation` is given, but its `convention` is not"
            raise MeasurementError.of(what, expected=CONVENTIONS, fix="name it: it is never guessed")
        with of_measurements():
            count = numbers_of(self.convention)
        expected = f"{count} names of columns for {self.convention!r}"
        rotation = by_frame("rotation", self.rotation, expected, count)
        std, unit = self.rotation_std, self.rotation_angle
        if std is not None:
            std = by_frame("rotation_std", std, "names of columns: three, or one for all three axes", 1, 3)
        if unit is None and (count == 3 or std is not None):
            what = "`rotation_angle` is missing: the unit of " + ("the rotation" if count == 3 else "`rotation_std`")
            fix = "name it, for it may differ from the unit of the joints"
            raise MeasurementError.of(what, expected="'rad' or 'deg'", fix=fix)
        if unit is not None and count != 3 and std is None:
            what = f"`rotation_angle` beside convention {self.convention!r}, which has no angles"
            raise MeasurementError.of(what, got=as_written(unit), fix="leave it out")
        check_choice("rotation_angle", unit or "rad", ANGLE_UNITS)
        return replace(self, rotation=rotation, rotation_std=std)

    def for_writing(self, *, rotation_std: bool, prefixes: Sequence[str] = ("",)) -> TableFormat:
        """The same format with defaults for the columns, the convention and the unit of rotations that are written.

        ``rotation_std``: whether their standard deviations are written, too. ``prefixes``: what the default names of
        the columns of each frame begin with. MeasurementError for an unknown convention, unit or number of names.
        """
        convention, unit = self.convention or "rotvec", self.rotation_angle or self.angle
        with of_measurements():
            count = numbers_of(convention)
        check_choice("rotation_angle", unit, ANGLE_UNITS)
        plain = ROTATION_NAMES.get(convention, ("euler1", "euler2", "euler3"))
        names = by_frame("rotation", self.rotation or _prefixed(prefixes, plain), f"{count} names", count)
        std = self.rotation_std  # of which the writer says that there are no values
        if rotation_std:
            given = std or _prefixed(prefixes, ("rx", "ry", "rz"), "std_")
            std = by_frame("rotation_std", given, "three names", 3)
        angle = unit if count == 3 or rotation_std else None
        return replace(self, rotation=names, convention=convention, rotation_angle=angle, rotation_std=std)


def options_of(table: TableFormat) -> list[str]:
    """The options with which the command line reads positions or poses that are written so, word by word."""
    lever = f"{table.lever * table.per_metre:.17g}" if table.rotation and table.lever != LEVER else None
    texts = {field.name: getattr(table, field.name) for field in fields(table)}
    texts |= {"position": table.triples, "lever": lever, "joints": ",".join(table.joints)}
    texts |= {"std": ",".join(flat_names(table.std))}
    words = list[str]()
    for name, value in texts.items():
        if value and name not in ("kinds", "on", "sockets", "readings"):
            option = f"--{name.replace('_', '-')}"
            each = [value] if isinstance(value, str) else [] if value is True else map(",".join, value)
            words += [option] if value is True else [word for text in each for word in (option, text)]
    return words


def flat_names(names: Names | None) -> tuple[str, ...]:
    """Names of columns in one row, those of each frame after another."""
    return tuple(name for group in names or () for name in ([group] if isinstance(group, str) else group))


def by_frame(what: str, names: object, expected: str, *counts: int) -> tuple[tuple[str, ...], ...]:
    """Checked names of so many columns of each marker or frame; a list of names is that of the only one."""
    given = list(names) if isinstance(names, Sequence) and not isinstance(names, str) else []
    several = given and not any(isinstance(group, str) or not isinstance(group, Sequence) for group in given)
    groups = tuple(column_names(what, group, expected, counts) for group in (given if several else [names]))
    if len({len(group) for group in groups}) > 1:
        got = " and ".join(str(len(group)) for group in groups)
        raise MeasurementError.of(f"`{what}`", expected="as many names for every frame", got=got)
    return groups


def _prefixed(prefixes: Sequence[str], names: Sequence[str], before: str = "") -> Names:
    """The same names for each prefix."""
    return [[f"{before}{prefix}{name}" for name in names] for prefix in prefixes]


def column_names(what: str, names: object, expected: str, counts: Sequence[int]) -> tuple[str, ...]:
    """A checked list of names of columns, of which there are as many as one of ``counts``."""
    given = () if isinstance(names, str) or not isinstance(names, Sequence) else tuple(names)
    strings = all(isinstance(name, str) for name in given)
    if len(given) not in counts or not strings:
        got = listed(given) if given and strings else repr(names)
        raise MeasurementError.of(f"`{what}`", expected=expected, got=got, fix="pass a list such as ['a', 'b', 'c']")
    return tuple(str(name).strip() for name in given)


def check_choice(name: str, value: object, allowed: Sequence[str]) -> None:
    """Raise MeasurementError unless a value is one of the allowed ones."""
    if value not in allowed:
        expected = " or ".join(repr(choice) for choice in allowed)
        raise MeasurementError.of(f"`{name}`", expected=expected, got=as_written(value), fix="pass one of these")
