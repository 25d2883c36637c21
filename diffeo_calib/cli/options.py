"""What an option is, and the groups of options that several commands share. Imports nothing slow: help appears at once.

A group is a subclass of :class:`Options`: a frozen dataclass whose fields are options. Commands inherit groups.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args, get_origin, get_type_hints

from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.table_format import described

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:  # what type checkers alone understand, and Python 3.10 does not have

    def dataclass_transform(**_: object) -> Any:
        """Nothing at run time."""
        return lambda kind: kind


Kind = Literal["read", "write", "source", "later", "folder"]
"""A file must exist, is written, is written with a header beside it, may come later; or is a folder that is made."""
Length = Literal["m", "mm", "cm", "um", "inch"]
Angle = Literal["rad", "deg"]
Convention = Literal["standard", "craig"]
SHORT = {"output": "-o", "count": "-n"}
SEED: dict[str, Any] = {"default": 0, "min": 0, "max": 2**63 - 1}
"""The largest as in common/checks.py, which loads torch."""
DRAWN = 3000
CORNERS = "corners="


def option(
    text: str = "",
    metavar: str | None = None,
    default: Any = None,
    kind: Kind = "read",
    *,
    named: bool = True,
    **how: Any,
) -> Any:
    """A field that is an option of its name, or, if it is not ``named``, an argument.

    Args:
        text: its help, by default what :class:`TableFormat` says of its name. metavar: what its value is called.
        default: MISSING for one that is required.
        kind: what happens to its file. how: limits of its value, as of :func:`typer.Option`.
    """
    how = {"help": text, "metavar": metavar, **how}
    return field(default=default, metadata={"named": named, "kind": kind, "how": how})


def argument(text: str, metavar: str, default: Any = MISSING, kind: Kind = "read") -> Any:
    """A field that is an argument, as :func:`option`."""
    return option(text, metavar, default, kind, named=False)


def written(text: str, metavar: str, default: Any = None) -> Any:
    """A field that is an option for a file to write, as :func:`option`."""
    return option(text, metavar, default, "write")


class Option(NamedTuple):
    """An option, or an argument, as typer takes it."""

    field: str  # its name in Python
    hint: Any  # type of its value
    default: Any  # MISSING where one is required
    names: tuple[str, ...]  # as typed, none of an argument
    shown: str  # in messages
    kind: Kind  # what happens to its file
    how: dict[str, Any]  # its help and limits

    @classmethod
    def of(cls, entry: Field[Any], hint: Any) -> Option:
        """The option of a field."""
        kind, how = entry.metadata["kind"], dict(entry.metadata["how"])
        if not how["help"]:
            how["help"] = described().get(entry.name, "") + " Repeatable." * has(hint, list)
        long = f"--{entry.name.replace('_', '-')}"
        names = tuple(filter(None, (SHORT.get(entry.name), long))) if entry.metadata["named"] else ()
        return cls(entry.name, hint, entry.default, names, (*names, how["metavar"])[0], kind, how)


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Options:
    """A group of options."""

    needs: ClassVar[tuple[tuple[str, str], ...]] = ()  # options, and others of which each of them needs one
    excludes: ClassVar[tuple[tuple[str, str], ...]] = ()  # and others that it cannot stand beside
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    @classmethod
    @cache
    def all(cls) -> tuple[Option, ...]:
        """Its options."""
        hints = get_type_hints(cls)
        return tuple(Option.of(entry, hints[entry.name]) for entry in fields(cls))

    @classmethod
    def names(cls) -> set[str]:
        """Names of its fields."""
        return {entry.name for entry in fields(cls)}

    @classmethod
    def check_together(cls, given: Mapping[str, Any]) -> None:
        """Refuse options without those of which they need one, or beside those that they exclude."""
        typed = {entry.shown for entry in cls.all() if given[entry.field] not in (None, [], entry.default)}
        for options, others in cls.needs:
            for name in options.split():
                if name in typed and typed.isdisjoint(others.split()):
                    what = f"{name} without {' or '.join(others.split())}"
                    raise InputError.of(what, fix="name this too, or leave the option out")
        for options, others in cls.excludes:
            for name in options.split():
                if name in typed and (clashes := typed.intersection(others.split())):
                    raise InputError.of(f"{name} beside {min(clashes)}", fix="leave one of them out")


def has(hint: Any, part: Any) -> bool:
    """Whether a type, or a part of it, is this one."""
    return part in {hint, get_origin(hint)} or any(has(inner, part) for inner in get_args(hint))


# --- groups of several commands -----------------------------------------------------------------------------------

MASS = "Mass that the robot carries, for a model with payloads."
ROBOT = "The robot's description: a URDF, or a table of its Denavit-Hartenberg parameters, one line per joint."


class Units(Options):
    """How tables are written; a model knows that of the table of its fit."""

    length: Length | None = option()
    angle: Angle | None = option()
    joint_length: Length | None = option()
    joints: str | None = option(metavar="A,B,...")
    robot_pose: str | None = option(
        "Columns of the commanded place or pose, as the controller writes it, in place of joint values and a robot's "
        "description: X,Y,Z, or X,Y,Z,A,B,C=CONVENTION as of --convention, angles in the unit of --angle; or "
        "A,B,...=FILE.py:NAME, a function of yours that makes places or poses of these columns.",
        "X,Y,Z[,...]",
    )
    sep: str | None = option()
    decimal: str | None = option()

    def left_open(self) -> set[str]:
        """Names of options that are taken from the fit of a model unless they are typed: none beside both units."""
        return set() if self.length and self.angle else Units.names()


class Places(Options):
    """Measured places in a file of their own."""

    places: Path | None = option(
        "File with the measured places where CSV has the joint values alone; --by joins both.", "FILE"
    )
    by: str | None = option(
        "Column of both files: texts that are the same in both, such as names of poses; or times, of which the nearest "
        "within half a step belong together. Of two recordings the clocks may differ, and every stop becomes a row. "
        "COLUMN=OTHER where it has another name in the file of the places.",
        "COLUMN",
    )


class Rows(Places, Units):
    """Columns of the measurements in a table, of any kinds."""

    position: list[str] | None = option(metavar="X,Y,Z")
    socket: str | None = option(
        "Columns that name the socket in which a ball on the tool rested, in rows without a position.", "PLACE,SOCKET"
    )
    distance: list[str] | None = option(
        "Known distance between two sockets, in the unit of --length; repeat for more.", "A,B=LENGTH"
    )
    distance_std: float | None = option("Standard deviation of these distances, in the unit of --length.")
    reading: list[str] | None = option(
        "What a device reported of a ball on the tool; repeat for more kinds: distance=COLUMN (ball bar), "
        "displacement=COLUMN (distance with an unknown zero: wire, interferometer), height=COLUMN (dial gauge, touched "
        "plane; a number in place of the column holds for all rows), image=U,V,FX,FY,CX,CY (pixels, focal lengths and "
        "principal point of a camera), or corners=CAMERA.yaml (=WIDTH,HEIGHT of an unknown camera) for corners of a "
        "printed board. --session names the fixed point, plane or camera of each row.",
        "KIND=COLUMN",
    )
    marker: str | None = option(metavar="COLUMN")
    session: str | None = option(metavar="COLUMN")
    remounted: bool = option(default=False)
    payload: str | None = option(metavar="COLUMN")
    time: str | None = option(metavar="COLUMN")
    temperature: str | None = option(metavar="COLUMN")
    rotation: list[str] | None = option(metavar="A,B,...")
    convention: str | None = option()
    rotation_angle: Angle | None = option()
    lever: float | None = option()
    camera_on_tool: bool = option(default=False)
    std: str | None = option(metavar="A,B,...")
    rotation_std: list[str] | None = option(metavar="A,B,C")
    needs = (
        ("--lever", "--rotation"),
        ("--camera-on-tool", "--rotation --reading"),
        ("--places", "--by"),
        ("--by", "--places"),
        ("--distance-std", "--socket"),
        ("--distance", "--distance-std"),
    )

    @property
    def named(self) -> bool:
        """Whether columns of some kind of rows are named."""
        return bool(self.position or self.socket or self.reading)

    def left_open(self) -> set[str]:
        """Columns too, unless some are named; not the file of the places of the fit."""
        joining = {"places", "by"} if self.places is None else {"places"}
        return super().left_open() | (set() if self.named else Rows.names() - Units.names() - joining)

    @property
    def images(self) -> bool:
        """Whether rows are images of a printed board."""
        return any(text.startswith(CORNERS) for text in self.reading or ())


class Links(Options):
    """Which part of the robot in a file."""

    base: str | None = option("First link of the chain; by default that of the file.", "LINK")
    tip: list[str] | None = option(
        "Last link of the chain, to which the markers are fixed, by default that of the file; for several tips once "
        "per --position. Of a DH table the last joint.",
        "LINK",
    )
    load: list[str] | None = option("End of a branch without markers whose weight bends the robot; repeatable.", "LINK")
    dh_convention: Convention | None = option(
        "Convention of a DH table that does not say its own; craig is also called modified."
    )


class Robot(Links):
    """Which robot was measured; none where --robot-pose names commanded poses."""

    robot: Path | None = option(ROBOT, "FILE")


class Targets(Options):
    """Columns of the poses that a tool shall have."""

    position: list[str] | None = option(
        "Columns of the target positions of the tool, if the commands' own nominal poses are not the targets.", "X,Y,Z"
    )
    rotation: list[str] | None = option("Columns of the target orientations: 3, 4 or 9, see --convention.", "A,B,...")
    convention: str | None = option()
    rotation_angle: Angle | None = option()


class Candidates(Options):
    """Configurations to choose from: a table, or random ones within what the cell allows."""

    candidates: Path | None = option("Choose from these configurations instead of random ones.", "CSV")
    draw: int | None = option(f"Number of random candidates to choose from, {DRAWN} by default.", min=1)
    range: list[str] | None = option(
        "Range of a joint within its limits; by default these, but one turn at most. Repeat for more joints.",
        "JOINT=A:B",
    )
    tracker: str | None = option(
        "Place of the measuring device in the robot's base frame: plan only poses in which it sees the marker. Behind "
        "it the direction in which the marker looks, in the frame of the tip (0,0,1), and the largest angle in degrees "
        "between that and the line to the device (45).",
        "X,Y,Z[,DX,DY,DZ[,DEG]]",
    )
    floor: float | None = option("Height in the base frame below which no link and no marker may be.", "Z")
    column: str | None = option(
        "Upright cylinder in the base frame that no link may enter: place, radius, and top if it ends.", "X,Y,R[,TOP]"
    )
    collisions: bool = option(
        "Leave out poses in which the robot collides with itself, by its URDF; needs the extra `collisions`.",
        default=False,
    )
    seed: int = option("Seed of the random candidates.", **SEED)
