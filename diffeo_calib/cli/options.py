"""The options that several commands share: their types and their help. Imports nothing slow: help appears at once.

A group of options is a frozen dataclass: a command that has a parameter of this type has all of its options, see
:func:`diffeo_calib.cli.app.command`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

LARGEST_SEED = 2**63 - 1
"""As in common/checks.py, which loads torch."""
AS_STORED = "by default as at the fit"


class Length(str, Enum):
    """Unit of positions and prismatic joints."""

    m = "m"
    mm = "mm"


class Angle(str, Enum):
    """Unit of angles."""

    rad = "rad"
    deg = "deg"


class Frame(str, Enum):
    """Frame of targets."""

    base = "base"
    measuring = "measuring"


class ToolFrom(str, Enum):
    """Frame in which a tool centre point is given."""

    tip = "tip"
    measured = "measured"


class Free(str, Enum):
    """What may have moved."""

    both = "both"
    base = "base"
    marker = "marker"


class MarkerFreedom(str, Enum):
    """How far the markers may have moved on the tool."""

    evidence = "evidence"
    same = "same"
    moved = "moved"
    other = "other"


class Drift(str, Enum):
    """What may have changed in the robot itself."""

    tested = "tested"
    none = "none"


# --- files, seeds, masses -----------------------------------------------------------------------------------------

CsvPath = Annotated[Path, typer.Argument(metavar="CSV", help="Table with a header, one configuration per row.")]
ModelPath = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file written by `fit`.")]
OldModel = Annotated[Path, typer.Argument(metavar="OLD", help="Model file of an earlier calibration.")]
ModelOutput = Annotated[Path, typer.Option("-o", "--output", metavar="MODEL", help="Model file to write.")]
Seed = Annotated[int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of the split.")]
Note = Annotated[
    str, typer.Option("--note", metavar="TEXT", help="Text to keep in the model file, such as a serial number.")
]
Mass = Annotated[
    float | None,
    typer.Option("--payload", metavar="MASS", help="Mass that the robot carries, for a model with payloads."),
]
Marker = Annotated[
    MarkerFreedom,
    typer.Option(
        "--marker",
        help="Whether the markers are the same (0.05 mm), have moved a little (1 mm) or are other ones; by default the "
        "rows decide.",
    ),
]
Convention = Annotated[
    str | None,
    typer.Option(
        "--convention",
        help="How rotations are written: rotvec, quat_xyzw, quat_wxyz, matrix, "
        "or an order of Euler angles, extrinsic (such as xyz) or intrinsic (such as XYZ).",
    ),
]
RotationAngle = Annotated[
    Angle | None, typer.Option("--rotation-angle", help="Unit of Euler angles, rotation vectors and --rotation-std.")
]
Tip = Annotated[
    list[str],
    typer.Option(
        "--tip",
        metavar="LINK",
        help="Last link of the chain, to which the markers are fixed; for several tips once per --position.",
    ),
]
PayloadColumn = Annotated[
    str | None,
    typer.Option("--payload", metavar="COLUMN", help="Column with the known mass that the robot carried, in any unit."),
]
ToolFromOption = Annotated[
    ToolFrom,
    typer.Option(
        "--tool-from",
        help="Frame of --tool: the tip of the robot, or the measured frame of a model of poses, which is better known.",
    ),
]

# --- how a table is written ---------------------------------------------------------------------------------------

SEP, DECIMAL = "Column separator of the table ('\\t' for a tab)", "Decimal mark of the table"
LENGTH, ANGLE = "Unit of positions in the table, and of prismatic joints", "Unit of revolute joints in the table"


@dataclass(frozen=True, kw_only=True)
class Format:
    """How tables are written, but for their units and marks."""

    joint_length: Annotated[
        Length | None, typer.Option("--joint-length", help="Unit of prismatic joints, if not that of --length.")
    ] = None
    joints: Annotated[
        str | None,
        typer.Option(
            "--joints", metavar="A,B,...", help="Joint columns in the robot's order, if not named after its joints."
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class Units(Format):
    """The same with units, which must be stated, and marks."""

    length: Annotated[Length, typer.Option("--length", help=f"{LENGTH}.")]
    angle: Annotated[Angle, typer.Option("--angle", help=f"{ANGLE}.")]
    sep: Annotated[str, typer.Option("--sep", help=f"{SEP}.")] = ","
    decimal: Annotated[str, typer.Option("--decimal", help=f"{DECIMAL}.")] = "."


@dataclass(frozen=True, kw_only=True)
class StoredUnits(Format):
    """The same for commands with a model, which may know them."""

    length: Annotated[Length | None, typer.Option("--length", help=f"{LENGTH}, {AS_STORED}.")] = None
    angle: Annotated[Angle | None, typer.Option("--angle", help=f"{ANGLE}, {AS_STORED}.")] = None
    sep: Annotated[str | None, typer.Option("--sep", help=f"{SEP}, {AS_STORED}.")] = None
    decimal: Annotated[str | None, typer.Option("--decimal", help=f"{DECIMAL}, {AS_STORED}.")] = None


@dataclass(frozen=True, kw_only=True)
class Rows:
    """What was measured in the rows of a table, of whatever kinds they are."""

    position: Annotated[
        list[str] | None,
        typer.Option(
            "--position",
            metavar="X,Y,Z",
            help="The three position columns of a marker; repeat for more markers. Empty cells: hidden in that row.",
        ),
    ] = None
    socket: Annotated[
        str | None,
        typer.Option(
            "--socket",
            metavar="PLACE,SOCKET",
            help="Columns that name the socket in which a ball on the tool rested, in rows without a position.",
        ),
    ] = None
    distance: Annotated[
        list[str] | None,
        typer.Option(
            "--distance",
            metavar="A,B=LENGTH",
            help="Known distance between two sockets, in the unit of --length; repeat for more.",
        ),
    ] = None
    distance_std: Annotated[
        float | None,
        typer.Option("--distance-std", help="Standard deviation of these distances, in the unit of --length."),
    ] = None
    reading: Annotated[
        list[str] | None,
        typer.Option(
            "--reading",
            metavar="KIND=COLUMN",
            help="What a device reported of a ball on the tool; repeat for more kinds: distance=COLUMN (ball bar), "
            "displacement=COLUMN (distance with an unknown zero: wire, interferometer), height=COLUMN (dial gauge, "
            "touched plane; a number in place of the column holds for all rows), or image=U,V,FX,FY,CX,CY (pixels, "
            "focal lengths and principal point of a camera). --session names the fixed point, plane or camera of each "
            "row.",
        ),
    ] = None
    session: Annotated[
        str | None,
        typer.Option("--session", metavar="COLUMN", help="Column that names the set-up of the device for every row."),
    ] = None
    payload: PayloadColumn = None
    rotation: Annotated[
        list[str] | None,
        typer.Option(
            "--rotation",
            metavar="A,B,...",
            help="Columns of the rotation, if poses were measured: 3, 4 or 9, depending on --convention; for frames on "
            "several tips once per --position.",
        ),
    ] = None
    convention: Convention = None
    rotation_angle: RotationAngle = None
    lever: Annotated[
        float | None,
        typer.Option(
            "--lever",
            help="Distance from a pose's origin to the three points that represent the pose, in the unit of --length: "
            "it weighs orientation against position. 0.1 m by default.",
        ),
    ] = None
    camera_on_tool: Annotated[
        bool,
        typer.Option(
            "--camera-on-tool",
            help="The poses are those of a fixed board in the frame of a camera on the tool, as detectors of boards "
            "give them; standard deviations are along the camera's axes.",
        ),
    ] = False
    std: Annotated[
        str | None,
        typer.Option(
            "--std",
            metavar="A,B,...",
            help="Columns with standard deviations of the positions: one for all, one per marker or three per marker.",
        ),
    ] = None
    rotation_std: Annotated[
        list[str] | None,
        typer.Option(
            "--rotation-std",
            metavar="A,B,C",
            help="Columns with standard deviations of the rotation about the measuring frame's axes, or one for all "
            "three; once per --rotation.",
        ),
    ] = None

    @property
    def named(self) -> bool:
        """Whether columns of some kind of rows are named."""
        return bool(self.position or self.socket or self.reading)


# --- the commands that measure ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Which robot was measured."""

    robot: Annotated[Path, typer.Option("--robot", metavar="URDF", help="The robot's description.")]
    base: Annotated[str, typer.Option("--base", metavar="LINK", help="First link of the chain.")]
    tip: Tip
    load: Annotated[
        list[str] | None,
        typer.Option(
            "--load", metavar="LINK", help="Link of another branch, whose weight bends the robot; repeat for more."
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How to calibrate, and what to write beside the model."""

    holdout: Annotated[
        float,
        typer.Option(
            "--holdout",
            min=0.0,
            max=0.9,
            help="Fraction of the rows that are not fitted but test the model; 0 for none.",
        ),
    ] = 0.3
    seed: Seed = 0
    controls: Annotated[
        int | None,
        typer.Option(
            "--controls",
            min=10,
            help="Number of rows that carry the deformation; by default all, or 200 of a large table.",
        ),
    ] = None
    figure: Annotated[
        Path | None,
        typer.Option("--figure", metavar="IMAGE", help="Also draw the errors (of the held-out rows, if any)."),
    ] = None
    report: Annotated[
        Path | None,
        typer.Option(
            "--report",
            metavar="HTML",
            help="Also write the report: one page that needs neither a network nor a server.",
        ),
    ] = None
    note: Note = ""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What to do with the errors of a model."""

    register: Annotated[
        bool,
        typer.Option("--register", help="First find the measuring device and the markers anew from these rows."),
    ] = False
    free: Annotated[
        Free | None,
        typer.Option("--free", help="With --register: what may have moved; base is the device's or the robot's."),
    ] = None
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="MODEL", help="With --register: write the registered model to this file."
        ),
    ] = None
    fail_above: Annotated[
        str | None,
        typer.Option(
            "--fail-above",
            metavar="RMS",
            help="Exit with code 4 if the RMS error of the rows that were not used in the fit is larger, such as "
            "0.15mm.",
        ),
    ] = None
    residuals: Annotated[
        Path | None,
        typer.Option(
            "--residuals", metavar="TABLE", help="Write the error of every row to this file: measured minus predicted."
        ),
    ] = None
