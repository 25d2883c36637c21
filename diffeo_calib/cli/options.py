"""The options that several commands share: their types and their help. Imports nothing slow: help appears at once.

A group of options is a frozen dataclass: a command with a field of this type has all of its options.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import typer

LARGEST_SEED = 2**63 - 1
"""As in common/checks.py, which loads torch."""
DRAWN = 3000
CORNERS = "corners="
"""Begin of --reading for images of a board."""


def option(
    text: str,
    metavar: str | None = None,
    *,
    names: tuple[str, ...] = (),
    default: Any = None,
    file: File = "read",
    **limits: Any,
) -> Any:
    """A field of a group: an option of the name of the field, unless ``names`` are given.

    Args:
        text: its help. metavar: what its value is called. default: of the field; ... for an option that is required.
        file: what happens to the file that a path names. limits: of its value, as of :func:`typer.Option`.
    """
    return _field(typer.Option, names, default, file, help=text, metavar=metavar, **limits)


def argument(metavar: str, text: str, *, default: Any = ..., file: File = "read") -> Any:
    """A field that is an argument, under the name ``metavar``; arguments as of :func:`option`."""
    return _field(typer.Argument, (), default, file, help=text, metavar=metavar)


def _field(made: Any, names: tuple[str, ...], default: Any, file: File, **how: Any) -> Any:
    """A field of what typer makes with these names and options, such as its help."""
    metadata = {"made": made, "names": names, "file": file, "how": how}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


def written(text: str, metavar: str) -> Any:
    """A file that the command writes if it is wanted."""
    return option(text, metavar, file="write")


def output(text: str, metavar: str, default: Any = ...) -> Any:
    """The option -o, a file that the command writes."""
    return option(text, metavar, names=("-o", "--output"), default=default, file="write")


File = Literal["read", "write", "appended", "folder"]
"""What happens to a file: it must exist, is written, may come later, or is a folder that is made."""
Length = Literal["m", "mm", "cm", "inch"]
"""As in measurements/table_format.py, which loads torch."""
Angle = Literal["rad", "deg"]
Frame = Literal["base", "measuring"]

CONVENTION = (
    "How rotations are written: rotvec, quat_xyzw, quat_wxyz, matrix, or an order of Euler angles, extrinsic (such as "
    "xyz) or intrinsic (such as XYZ)."
)
ROTATION_ANGLE = "Unit of Euler angles and rotation vectors."
PAYLOAD = "Column with the known mass that the robot carried, in any unit."

# --- how a table is written ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Units:
    """How tables are written; a model knows that of the table of its fit."""

    length: Length | None = option(
        "Unit of positions in the table, and of prismatic joints; needed where no model knows it."
    )
    angle: Angle | None = option("Unit of revolute joints in the table; needed where no model knows it.")
    joint_length: Length | None = option("Unit of prismatic joints, if not that of --length.")
    joints: str | None = option(
        "Joint columns in the robot's order, if not named after its joints, or expressions of columns in the units of "
        "the table, such as -{J2}+90 or {J3}+{J2}.",
        "A,B,...",
    )
    robot_pose: str | None = option(
        "Columns of the commanded place or pose, as the controller writes it, in place of "
        "joint values and a robot's description: X,Y,Z, or X,Y,Z,A,B,C=CONVENTION as of --convention, angles in the "
        "unit of --angle; or A,B,...=FILE.py:NAME, a function of yours that makes places or poses of these columns.",
        "X,Y,Z[,...]",
    )
    sep: str | None = option("Column separator ('\\t' for a tab), by default that of the model, or a comma.")
    decimal: str | None = option("Decimal mark, by default that of the model, or a point.")


@dataclass(frozen=True, kw_only=True)
class Places:
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


@dataclass(frozen=True, kw_only=True)
class Rows(Places):
    """Columns of the measurements in a table, of any kinds."""

    position: list[str] | None = option(
        "The three position columns of a marker; repeat for more markers. Empty cells: hidden in that row.", "X,Y,Z"
    )
    socket: str | None = option(
        "Columns that name the socket in which a ball on the tool rested, in rows without a position.", "PLACE,SOCKET"
    )
    distance: list[str] | None = option(
        "Known distance between two sockets, in the unit of --length; repeat for more.", "A,B=LENGTH"
    )
    distance_std: float | None = option("Standard deviation of these distances, in the unit of --length.")
    reading: list[str] | None = option(
        "What a device reported of a ball on the tool; repeat for more kinds: distance=COLUMN (ball bar), "
        "displacement=COLUMN (distance with an unknown zero: wire, interferometer), height=COLUMN (dial gauge, "
        "touched plane; a number in place of the column holds for all rows), image=U,V,FX,FY,CX,CY (pixels, focal "
        "lengths and principal point of a camera), or corners=CAMERA.yaml (=WIDTH,HEIGHT of an unknown camera) for "
        "corners of a printed board. --session names the fixed point, plane or camera of each row.",
        "KIND=COLUMN",
    )
    marker: str | None = option(
        "Column that names which marker a line holds, where each has the position of one (not with --rotation or "
        "several --position, nor for readings and images). Lines with the same joint values that follow each other are "
        "one row. With names in order where a model has them: COLUMN=A,B,...",
        "COLUMN",
    )
    session: str | None = option("Column that names the set-up of the device for every row.", "COLUMN")
    remounted: bool = option("For each --session the markers were mounted anew; the device stayed.", default=False)
    payload: str | None = option(PAYLOAD, "COLUMN")
    time: str | None = option("Column of times, in any unit: device or arm may drift with it.", "COLUMN")
    temperature: str | None = option("Column of temperatures, in any unit; likewise.", "COLUMN")
    rotation: list[str] | None = option(
        "Columns of the rotation, if poses were measured: 3, 4 or 9, depending on --convention; for frames on "
        "several tips once per --position.",
        "A,B,...",
    )
    convention: str | None = option(CONVENTION)
    rotation_angle: Angle | None = option(ROTATION_ANGLE)
    lever: float | None = option(
        "Distance from a pose's origin to the three points that represent the pose, in the unit of --length: "
        "it weighs orientation against position. 0.1 m by default."
    )
    camera_on_tool: bool = option(
        "The poses, or corners, are those of a fixed board in the frame of a camera on the tool, as detectors "
        "of boards give them; standard deviations are along the camera's axes.",
        default=False,
    )
    std: str | None = option(
        "Columns with standard deviations of the positions: one for all, one per marker or three per marker.", "A,B,..."
    )
    rotation_std: list[str] | None = option(
        "Columns with standard deviations of the rotation about the measuring frame's axes, or one for all "
        "three, in the unit of --rotation-angle; once per --rotation.",
        "A,B,C",
    )

    @property
    def named(self) -> bool:
        """Whether columns of some kind of rows are named."""
        return bool(self.position or self.socket or self.reading)

    @property
    def images(self) -> bool:
        """Whether rows are images of a printed board."""
        return any(text.startswith(CORNERS) for text in self.reading or ())


ROBOT = "The robot's description: a URDF, or a table of its Denavit-Hartenberg parameters, one line per joint."
Convention = Literal["standard", "craig"]


@dataclass(frozen=True, kw_only=True)
class Links:
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


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Which robot was measured; none where --robot-pose names commanded poses."""

    robot: Path | None = option(ROBOT, "FILE")
    links: Links


@dataclass(frozen=True, kw_only=True)
class Targets:
    """Columns of the poses that a tool shall have."""

    position: list[str] | None = option(
        "Columns of the target positions of the tool, if the commands' own nominal poses are not the targets.", "X,Y,Z"
    )
    rotation: list[str] | None = option("Columns of the target orientations: 3, 4 or 9, see --convention.", "A,B,...")
    convention: str | None = option(CONVENTION)
    rotation_angle: Angle | None = option(ROTATION_ANGLE)


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Configurations to choose from: a table, or random ones within what the cell allows."""

    candidates: Path | None = option("Choose from these configurations instead of random ones.", "CSV")
    draw: int | None = option(f"Number of random candidates to choose from, {DRAWN} by default.", min=1)
    limits: list[str] | None = option(
        "Range of a joint within its limits; by default these, but one turn at most. Repeat for more joints.",
        "JOINT=A:B",
        names=("--range",),
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
    seed: int = option("Seed of the random candidates.", min=0, max=LARGEST_SEED, default=0)


@dataclass(frozen=True, kw_only=True)
class ChangeTests:
    """How changes since an old fit are tested."""

    marker_freedom: Literal["evidence", "same", "moved", "other"] = option(
        "Whether the markers are the same (0.05 mm: nobody touched them), have moved a little (1 mm: remounted) or are "
        "other ones (anywhere); by default the rows decide.",
        default="evidence",
    )
    seed: int = option("Seed of the tests for changes.", min=0, max=LARGEST_SEED, default=0)
