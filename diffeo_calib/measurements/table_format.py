"""How a table is written: units, separators, and its columns. Imports nothing slow: help shows what is said here.

Units exist only in files. They must always be named and are never guessed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import product
from math import pi
from textwrap import dedent
from typing import Any

from diffeo_calib.common.errors import InputError, MeasurementError, as_written, listed

Names = Sequence[str] | Sequence[Sequence[str]]  # names of columns: a list, or one for each marker or frame
ANGLE_UNITS = ("rad", "deg")
NUMBERS = {"rotvec": 3, "quat_xyzw": 4, "quat_wxyz": 4, "matrix": 9}
"""How many numbers write a rotation in each convention; an order of Euler angles takes three."""
MAKERS = {"ur_rotvec": "rotvec", "abb_quaternion": "quat_wxyz", "kuka_abc": "ZYX", "fanuc_wpr": "xyz"}
"""Conventions by the names of controllers."""
CONVENTIONS = "'rotvec', 'quat_xyzw', 'quat_wxyz', 'matrix', or three letters as 'xyz' (extrinsic) or 'XYZ' (intrinsic)"
LEVER = 0.1  # default distance [m] from a pose's origin to the three points that represent it: the size of usual tools
ZERO = "0"  # in place of a column of z: all that was measured is in the plane of x and y
UNITS_PER_METRE = {
    "m": 1.0,
    "mm": 1e3,
    "cm": 100.0,
    "um": 1e6,
    "inch": 1 / 0.0254,
}  # a length in a file is divided by this
ROTATION_NAMES = {
    "rotvec": ("rx", "ry", "rz"),
    "quat_xyzw": ("qx", "qy", "qz", "qw"),
    "quat_wxyz": ("qw", "qx", "qy", "qz"),
    "matrix": tuple(f"r{i}{j}" for i in "123" for j in "123"),
}
"""Default names of the columns of a rotation that is written; euler1, ... for Euler angles."""
SPHERICAL_UNITS = {"rad": 1.0, "deg": 180.0 / pi, "gon": 200.0 / pi}  # units of the angles of devices, per rad
SPHERICAL = tuple(map("".join, product(("elevation", "zenith"), ("_", "_clockwise_"), SPHERICAL_UNITS)))
"""How a place is written as a distance, a horizontal angle, and one above the horizon, or from the zenith."""
BESIDE = ("time", "temperature", "payload")
"""Columns with one number a row beside joints and what was measured, which any table may have."""


@dataclass(frozen=True)
class TableFormat:
    """What a table of measurements or predictions holds, and how it is written.

    Args:
        length: unit of positions in the table, and of prismatic joints; needed where no model knows it.
        angle: unit of revolute joints in the table; needed where no model knows it.
        sep: one character between cells (on the command line also: tab), by default a comma, or that of the model.
        decimal: decimal mark, a point or a comma; by default a point, or that of the model.
        rotation: columns of the rotation, if poses were measured: 3, 4 or 9, depending on `convention`; for frames on
            several tips, whose origins are the positions, a list for each. Rotation and position map from the tool's
            frame to the measuring frame.
        convention: how all rotations are written: rotvec, quat_xyzw, quat_wxyz, matrix (nine columns row by row), or an
            order of Euler angles, extrinsic (such as xyz) or intrinsic (such as XYZ); or ur_rotvec, abb_quaternion,
            kuka_abc, fanuc_wpr.
        rotation_angle: unit of Euler angles, rotation vectors and `rotation_std`.
        lever: distance from a pose's origin to the three points that represent the pose: it weighs orientation against
            position. 0.1 m by default. On the command line it is in the unit of `length`. In Python it is in m.
        std: columns with standard deviations of the positions, in the unit of `length`: one for all, one per marker or,
            of x, y and z, three per marker.
        rotation_std: columns with standard deviations of the rotation about the measuring frame's axes, which are not
            the axes of Euler angles: one for all, or one or three for each frame.
        joint_length: unit of prismatic joints, if not that of `length`.
        payload: column with the known mass that the robot carried at its tip, in any unit; 0 without load.
        time: column of times, in any unit: device or arm may drift with it.
        temperature: column of temperatures, in any unit: device or arm may drift with it.
        camera_on_tool: the poses, or corners, are those of a fixed board in the frame of a camera on the tool, as
            detectors of boards give them; standard deviations are along the camera's axes.
        remounted: for each `session` the markers were mounted anew; the device stayed.
        joints: joint columns in the robot's order, if not named after its joints, or expressions of columns in the
            units of the table, such as -{J2}+90 or {J3}+{J2}. In Python also the robot.
        kinds: of each joint; by default those of the robot, or all revolute.
        position: the three position columns of a marker; several of them for more markers. Empty cells: hidden in that
            row. On the command line elevation_deg=R,AZ,EL or zenith_clockwise_gon=... for a distance and two angles. A
            third name "0" that is no column: all are in the plane of x and y. None in Python without positions.
        spherical: positions are a distance, a horizontal angle and one above the horizon, or from the zenith, as
            trackers and total stations report them: elevation_deg, zenith_gon, elevation_clockwise_rad, ...
        sockets: columns of a ball in sockets. readings: of each kind of reading, and of images (csv/sensors.py).
        session: column that names the set-up of the device for every row.
        on: names of the tips that carry the markers or frames, one for each, for a robot with several tips.
        marker: column that names which marker a line holds, where each has the position of one (not with `rotation` or
            several markers, nor for readings and images). Lines with the same joint values that follow each other are
            one row. Markers are in the order in which they appear, or in that of COLUMN=A,B,...

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
    spherical: str | None = None
    sockets: Any = None
    readings: tuple[Any, ...] = ()
    session: str | None = None
    on: Sequence[str] | None = None
    marker: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.convention, str):
            object.__setattr__(self, "convention", MAKERS.get(self.convention, self.convention))
        check_choice("length", self.length, tuple(UNITS_PER_METRE))
        check_choice("angle", self.angle, ANGLE_UNITS)
        check_choice("joint_length", self.joint_unit, tuple(UNITS_PER_METRE))
        check_choice("decimal", self.decimal, (".", ","))
        check_choice("spherical", self.spherical or SPHERICAL[0], SPHERICAL)
        if not isinstance(self.sep, str) or len(self.sep) != 1 or self.sep in '"\r\n':
            fix = "pass ',' or ';' or '\\t'"
            raise MeasurementError.of("`sep`", expected="one character", got=as_written(self.sep), fix=fix)
        if self.sep == self.decimal:
            fix = "pass sep=';' if the numbers have decimal commas"
            raise MeasurementError.of("`sep` and `decimal`", expected="different characters", got=self.sep, fix=fix)

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

    def joints_only(self) -> TableFormat:
        """Return the units, marks, joints and columns beside them, without what was measured."""
        kept = "length", "angle", "sep", "decimal", "joint_length", "joints", "kinds", *BESIDE
        return TableFormat(**{name: getattr(self, name) for name in kept})

    @property
    def triples(self) -> list[tuple[str, ...]]:
        """Names of x, y and z of every marker; MeasurementError for other numbers of names."""
        if self.position is None:
            return []
        return list(by_frame("position", self.position, "three names of columns for each marker", 3))

    def for_reading(self) -> TableFormat:
        """Return the format with checked options of the rotation.

        Raises:
            MeasurementError: a convention or unit that is missing, unknown or not needed, or a wrong number of names.
        """
        std, unit = self.rotation_std, self.rotation_angle
        if self.rotation is None:
            given = {"convention": self.convention, "rotation_angle": unit, "rotation_std": std}
            given |= {"camera_on_tool": self.camera_on_tool or None}
            if names := " and ".join(f"`{name}`" for name, value in given.items() if value is not None):
                fix = "name the columns of the rotation too, or leave this out"
                raise MeasurementError.of(f"{names} without `rotation`", fix=fix)
            return self
        if self.convention is None:
            what = "`rotation` is given, but its `convention` is not"
            raise MeasurementError.of(what, expected=CONVENTIONS, fix="name it: it is never guessed")
        count = numbers_of(self.convention, error=MeasurementError)
        rotation = by_frame("rotation", self.rotation, f"{count} names of columns for {self.convention!r}", count)
        if std is not None:
            std = by_frame("rotation_std", std, "names of columns: three, or one for all three axes", 1, 3)
        angles = count == 3 or std is not None
        if angles and unit is None:
            what, fix = "`rotation_angle` is missing", "name it, for it may differ from the unit of the joints"
            raise MeasurementError.of(what, expected="'rad' or 'deg'", fix=fix)
        if unit is not None and not angles:
            what = f"`rotation_angle` beside convention {self.convention!r}, which has no angles"
            raise MeasurementError.of(what, got=as_written(unit), fix="leave it out")
        check_choice("rotation_angle", unit or "rad", ANGLE_UNITS)
        return replace(self, rotation=rotation, rotation_std=std)

    def for_writing(self, *, rotation_std: bool, prefixes: Sequence[str] = ("",)) -> TableFormat:
        """Return the format with defaults for the columns, the convention and the unit of rotations that are written.

        ``rotation_std``: whether their standard deviations are written, too. ``prefixes``: what the default names of
        the columns of each frame begin with. MeasurementError for an unknown convention, unit or number of names.
        """
        convention = self.convention or "rotvec"
        angles = rotation_std or numbers_of(convention, error=MeasurementError) == 3
        plain = ROTATION_NAMES.get(convention, ("euler1", "euler2", "euler3"))
        std = self.rotation_std or ([[f"std_{each}r{k}" for k in "xyz"] for each in prefixes] if rotation_std else None)
        return replace(
            self,
            convention=convention,
            rotation=self.rotation or [[f"{each}{name}" for name in plain] for each in prefixes],
            rotation_angle=(self.rotation_angle or self.angle) if angles else None,
            rotation_std=std if std is None else by_frame("rotation_std", std, "three names", 3),
        ).for_reading()


def numbers_of(convention: object, angle: object = "rad", error: type[InputError] = InputError) -> int:
    """How many numbers one rotation takes: 3, 4 or 9; an error for an unknown convention, or unit of angles."""
    if angle not in ANGLE_UNITS:
        fix = "pass the unit of the rotations"
        raise error.of("`angle`", expected="'rad' or 'deg'", got=as_written(angle), fix=fix)
    if isinstance(convention, str) and convention in NUMBERS:
        return NUMBERS[convention]
    if not isinstance(convention, str) or convention not in EULER:
        fix = "name the convention in which the rotations are written"
        raise error.of("`convention`", expected=CONVENTIONS, got=as_written(convention), fix=fix)
    return 3


EULER = tuple(a + b + c for letters in ("xyz", "XYZ") for a, b, c in product(letters, repeat=3) if a != b != c)
"""The 24 orders of Euler angles: three axes of one case, none twice in a row."""
ALL_CONVENTIONS = (*NUMBERS, *EULER)


@cache
def described() -> dict[str, str]:
    """What every field of a table is, by the docstring of :class:`TableFormat`, with keywords as options.

    Sentences that speak of Python are left out.
    """
    text = dedent("        " + (TableFormat.__doc__ or "").partition("Args:")[2].partition("Raises:")[0].strip())
    pairs = re.findall(r"^(\w+): (.*(?:\n +.*)*)", text, re.MULTILINE)
    words = {name: re.sub(r"`(\w+)`", lambda match: f"--{match[1].replace('_', '-')}", said) for name, said in pairs}
    whole = {name: " ".join(f"{said[0].upper()}{said[1:]}".split()) for name, said in words.items()}
    return {name: re.sub(r"(?<=\.) [^.]*\bPython\b[^.]*\.", "", said) for name, said in whole.items()}


def options_of(table: TableFormat) -> list[str]:
    """The options with which the command line reads positions or poses that are written so, word by word."""
    texts = {field.name: getattr(table, field.name) for field in fields(table)}
    way = f"{table.spherical}=" * (table.spherical is not None)
    texts |= {"position": [[way + ",".join(names)] for names in table.triples]}
    texts |= {"joints": ",".join(table.joints), "std": ",".join(flat_names(table.std))}
    texts |= {"lever": f"{table.lever * table.per_metre:.17g}" if table.rotation and table.lever != LEVER else None}
    words = list[str]()
    for name, value in texts.items():
        if value and name not in ("kinds", "on", "sockets", "readings", "spherical"):
            each = [value] if isinstance(value, str) else [] if value is True else map(",".join, value)
            option = f"--{name.replace('_', '-')}"
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
