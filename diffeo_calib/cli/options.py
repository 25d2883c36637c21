"""The options that several commands share: their types and their help. Imports nothing slow: help appears at once.

A group of options is a frozen dataclass: a command that has a parameter of this type has all of its options, see
:func:`diffeo_calib.cli.app.command`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

LARGEST_SEED = 2**63 - 1
"""As in common/checks.py, which loads torch."""
DRAWN, FACING_HALF_ANGLE_DEG = 3000, 45.0
CORNERS = "corners="
"""Begin of --reading for images of a board."""
AS_STORED = "by default as at the fit"


def option(
    text: str, metavar: str | None = None, *, names: tuple[str, ...] = (), default: Any = None, **limits: Any
) -> Any:
    """A field of a group: an option of the name of the field, unless ``names`` are given.

    Args:
        text: its help. metavar: what its value is called. default: of the field; ... for an option that is required.
        limits: of its value, as of :func:`typer.Option`.
    """
    said = {"names": names, "help": text, "metavar": metavar, **limits}
    return field(metadata=said) if default is ... else field(default=default, metadata=said)


Length = Literal["m", "mm"]
Angle = Literal["rad", "deg"]
DH = Literal["standard", "craig"]
Frame = Literal["base", "measuring"]
ToolFrom = Literal["tip", "measured"]
Free = Literal["both", "base", "marker"]
"""Parts of the set-up that may have moved."""
MarkerFreedom = Literal["evidence", "same", "moved", "other"]
Drift = Literal["tested", "none"]

# --- files, seeds, masses -----------------------------------------------------------------------------------------

CsvPath = Annotated[Path, typer.Argument(metavar="CSV", help="Table with a header, one configuration per row.")]
ModelPath = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file written by `fit`.")]
OldModel = Annotated[Path, typer.Argument(metavar="OLD", help="Model file of an earlier calibration.")]
ModelOutput = Annotated[Path, typer.Option("-o", "--output", metavar="MODEL", help="Model file to write.")]
TestSeed = Annotated[int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of the tests for changes.")]
Note = Annotated[
    str, typer.Option("--note", metavar="TEXT", help="Text to keep in the model file, such as a serial number.")
]
Mass = Annotated[
    float | None,
    typer.Option("--payload-mass", metavar="MASS", help="Mass that the robot carries, for a model with payloads."),
]
Marker = Annotated[
    MarkerFreedom,
    typer.Option(
        "--marker-freedom",
        help="Whether the markers are the same (0.05 mm: nobody touched them), have moved a little (1 mm: remounted) "
        "or are other ones (anywhere); by default the rows decide.",
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
    Angle | None, typer.Option("--rotation-angle", help="Unit of Euler angles and rotation vectors.")
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

    joint_length: Length | None = option("Unit of prismatic joints, if not that of --length.")
    joints: str | None = option("Joint columns in the robot's order, if not named after its joints.", "A,B,...")


@dataclass(frozen=True, kw_only=True)
class Units(Format):
    """The same with units, which must be stated, and marks."""

    length: Length = option(f"{LENGTH}.", default=...)
    angle: Angle = option(f"{ANGLE}.", default=...)
    sep: str = option(f"{SEP}.", default=",")
    decimal: str = option(f"{DECIMAL}.", default=".")


@dataclass(frozen=True, kw_only=True)
class StoredUnits(Format):
    """The same for commands with a model, which may know them."""

    length: Length | None = option(f"{LENGTH}, {AS_STORED}.")
    angle: Angle | None = option(f"{ANGLE}, {AS_STORED}.")
    sep: str | None = option(f"{SEP}, {AS_STORED}.")
    decimal: str | None = option(f"{DECIMAL}, {AS_STORED}.")


@dataclass(frozen=True, kw_only=True)
class Rows:
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
    session: str | None = option("Column that names the set-up of the device for every row.", "COLUMN")
    remounted: bool = option("For each --session the markers were mounted anew; the device stayed.", default=False)
    payload: PayloadColumn = None
    time: str | None = option("Column of times, in any unit: device or arm may drift with it.", "COLUMN")
    temperature: str | None = option("Column of temperatures, in any unit; likewise.", "COLUMN")
    rotation: list[str] | None = option(
        "Columns of the rotation, if poses were measured: 3, 4 or 9, depending on --convention; for frames on "
        "several tips once per --position.",
        "A,B,...",
    )
    convention: Convention = None
    rotation_angle: RotationAngle = None
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


@dataclass(frozen=True)
class TableOptions:
    """A table as a command with a model names it: the file, what its rows hold, how it is written."""

    csv: Path
    rows: Rows
    units: StoredUnits


# --- the commands that measure ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Which robot was measured."""

    robot: Path = option("The robot's description.", "URDF", default=...)
    base: str = option("First link of the chain.", "LINK", default=...)
    tip: list[str] = option(
        "Last link of the chain, to which the markers are fixed; for several tips once per --position.",
        "LINK",
        default=...,
    )
    load: list[str] | None = option("End of a branch without markers whose weight bends the robot; repeatable.", "LINK")


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How to calibrate, and what to write beside the model."""

    holdout: float = option(
        "Fraction of the rows that are not fitted but test the model; 0 for none.", min=0.0, max=0.9, default=0.3
    )
    seed: int = option("Seed of the split.", min=0, max=LARGEST_SEED, default=0)
    controls: int | None = option(
        "Number of rows that carry the deformation; by default all, or 200 of a large table.", min=10
    )
    figure: Path | None = option("Also draw the errors (of the held-out rows, if any).", "IMAGE")
    report: Path | None = option("Also write the report: one page that needs neither a network nor a server.", "HTML")
    note: Note = ""
    scales_of: list[Path] | None = option(
        "For few rows: take the size of every kind of error, and of the noise, from the model of another robot of the "
        "same type instead of estimating it. May be repeated.",
        "MODEL",
    )


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Uses of the errors of a model."""

    register: bool = option("First find the measuring device and the markers anew from these rows.", default=False)
    free: Free | None = option("With --register: what may have moved; base is the device's or the robot's.")
    output: Path | None = option(
        "With --register: write the registered model to this file.",
        "MODEL",
        names=("-o", "--output"),
    )
    fail_above: str | None = option(
        "Exit with code 4 if the RMS error of the rows that were not used in the fit is larger, such as 0.15mm.", "RMS"
    )
    residuals: Path | None = option("Write the error of every row to this file: measured minus predicted.", "TABLE")


@dataclass(frozen=True, kw_only=True)
class Page:
    """Contents of a report."""

    data: Path | None = option(
        "Measurements to judge the model by; by default the rows of its fit, each predicted by all others.", "TABLE"
    )
    title: str = option("Title of the page; the robot by default.", "TEXT", default="")
    against: list[str] | None = option(
        "Further column of the table to show errors against; repeat for more. Time and temperature are found by their "
        "names.",
        "COLUMN",
    )
    tolerance: str | None = option(
        "Largest RMS error that is good enough, such as 0.15mm: the page says whether it is.", "RMS"
    )


@dataclass(frozen=True, kw_only=True)
class BoardImages:
    """A printed board in images, and the tables of joint values and corners."""

    board: str = option(
        "Its lengths are in m, whatever --length is: charuco:5x7:SQUARE:MARKER:DICT, chessboard:7x5:SQUARE (inner "
        "corners), aruco:4x5:SIDE:GAP:DICT or tag:SIDE:DICT:NUMBER.",
        "BOARD",
        default=...,
    )
    length: Length = option("Unit of places on the board in the output.", default=...)
    board_std: float = option(
        "Standard deviation of the board's size, as a share: 0.001 as printed, 0.0002 measured.", default=1e-3
    )
    overview: Path | None = option("Write a page with all images and their corners.", "HTML")
    sep: str = option("Separator of both tables.", default=",")
    decimal: str = option("Decimal mark of both tables.", default=".")


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """How to follow a campaign."""

    target: str | None = option("End when the error is below this with 95 % probability: 0.15mm.", "LENGTH")
    stdin: bool = option(
        "Append rows from standard input to CSV, one JSON object a line: see campaign/feeds.py.",
        default=False,
    )
    json_lines: bool = option(
        "Print verdicts, expected errors and next poses as JSON, one object a line.", default=False
    )
    bag: Path | None = option("Append the stops of a ROS 2 bag to CSV, at their times; see `record`.", "BAG")
    seen: str | None = option("Topic of --bag: stamped points, poses or transforms that a device measured.", "TOPIC")
    joint_states: str = option("Topic of --bag: joint states.", "TOPIC", default="/joint_states")
    speed: float = option("How many times faster --bag is played than it was recorded.", min=1e-3, default=1.0)
    once: bool = option("Judge the rows that are there, and do not wait for more.", default=False)
    candidates: Path | None = option("Table of poses that can be measured; within the joint limits by default.", "CSV")
    page: str | None = option("Show the campaign to this machine's browser at this port; 0 for any.", "[HOST:]PORT")
    next: int = option("Number of poses that are proposed after each row.", min=0, default=1)
    accepted: Path | None = option("Table of the accepted rows to write when the campaign ends, for `fit`.", "CSV")


# --- the commands that apply models -------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Correction:
    """Targets, tools and bounds of corrections."""

    position: list[str] | None = option(
        "Columns of the target positions of the tool, if the commands' own nominal poses are not the targets.", "X,Y,Z"
    )
    rotation: list[str] | None = option("Columns of the target orientations: 3, 4 or 9, see --convention.", "A,B,...")
    convention: Convention = None
    rotation_angle: RotationAngle = None
    tip: list[str] | None = option(
        "Link that carries the tool, for a model with several tips; repeat it where several tools have "
        "targets at the same time, with --tool, --position and --rotation once for each.",
        "LINK",
    )
    tool: list[str] | None = option(
        "Tool centre point in the frame of the tip, in the unit of --length, and its rotation if the tool is "
        "turned: a rotation vector in the unit of --angle, or as --convention says. By default the tip itself, or "
        "the tool that the model was saved with.",
        "X,Y,Z[,...]",
    )
    tool_from: ToolFromOption = "tip"
    frame: Frame = option("Frame of the target columns: the robot's base, or the measuring device.", default="base")
    limit: float | None = option(
        "Largest correction of a joint in degrees; 1 by default (prismatic joints: 20 mm).", "DEG"
    )
    rate: float | None = option(
        "The rows are a path: the correction of a joint changes by at most this many degrees from row to row.", "DEG"
    )
    payload_mass: Mass = None


@dataclass(frozen=True, kw_only=True)
class Export:
    """The files to write, and how."""

    urdf: Path | None = option("Write the robot's own URDF with corrected joint origins.", "URDF")
    mjcf: Path | None = option("Write the same kinematics for MuJoCo: bodies, joints, inertias, sites at tips.", "XML")
    dh: Path | None = option("Write a Denavit-Hartenberg table, with base and tool.", "CSV")
    dh_convention: DH = option("Convention of --dh; craig is also called modified.", default="standard")
    ur_kinematics: Path | None = option("Write the kinematics file of Universal Robots' ROS packages.", "YAML")
    ur_hash: str | None = option("Entry hash of --ur-kinematics: that of the robot's own calibration file.")
    joint_offsets: Path | None = option("Write the best joint offsets, all other geometry nominal.", "CSV")
    correction_tables: Path | None = option("Write transmission errors and their corrections by joint value.", "CSV")
    with_tables: bool = option(
        "Fit --urdf, --mjcf, --dh and --ur-kinematics for use together with --correction-tables.", default=False
    )
    c: Path | None = option("The model as C99 source, and a header beside it; with --tool and --frame.", "C")
    torch: Path | None = option("The model as a program of torch: markers, or the poses of a tool with --tool.", "PT2")
    onnx: Path | None = option("The same for onnxruntime; needs the packages onnx and onnxscript.", "ONNX")
    camera: Path | None = option(
        "Write the camera of a model of images: intrinsics (OpenCV, ROS camera_info), hand-eye transform, URDF joint, "
        "static transform; its place belongs to --urdf, --dh or --ur-kinematics if these are written too.",
        "FOLDER",
    )
    tool: str | None = option(
        "Tool centre point of programs, in the units of --length and --angle: place in the frame of the tip, and a "
        "rotation vector if it is turned. By default the tip itself, or the tool that the model was saved with.",
        "X,Y,Z[,...]",
    )
    tool_from: ToolFromOption = "tip"
    frame: Frame | None = option(
        "Frame of the tool's poses in programs, in C of the markers too: the robot's base (default), or the "
        "measuring device."
    )
    tip: str | None = option("Tip at the end of --c and --dh, for a model with several tips.", "LINK")
    robot: Path | None = option("The robot's description, if the model file does not hold it or it was edited.", "URDF")
    payload_mass: Mass = None
    length: Length = option("Unit of lengths in the CSV files written.", default="m")
    angle: Angle = option("Unit of angles in the CSV files written.", default="rad")

    @property
    def outputs(self) -> dict[str, Path | None]:
        """Option -> file to write, None where it is not wanted."""
        rigid = {"--urdf": self.urdf, "--mjcf": self.mjcf, "--dh": self.dh, "--ur-kinematics": self.ur_kinematics}
        tables = {"--joint-offsets": self.joint_offsets, "--correction-tables": self.correction_tables}
        return rigid | tables | {"--c": self.c, "--torch": self.torch, "--onnx": self.onnx, "--camera": self.camera}


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
        "Place of the measuring device in the robot's base frame: plan only poses in which it sees the marker.", "X,Y,Z"
    )
    facing: str | None = option(
        "With --tracker: direction in which the marker looks, in the frame of the tip; 0,0,1 by default.", "X,Y,Z"
    )
    cone: float | None = option(
        "With --tracker: largest angle in degrees between that direction and the line to the device, "
        f"{FACING_HALF_ANGLE_DEG:g} by default.",
        "DEG",
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
class Planned:
    """Purpose of a plan."""

    robot: Path | None = option("The robot's description, to plan the first poses.", "URDF")
    base: str | None = option("With --robot: first link of the chain.", "LINK")
    tip: list[str] | None = option(
        "With --robot: last link of the chain; the markers are fixed to it. Repeat for more: each has them.", "LINK"
    )
    marker: list[str] | None = option(
        "With --robot: place of a marker in the frame of the tip, in the unit of --length; repeat for more. "
        "By default 0.1 m beside and 0.1 m in front of the tip.",
        "X,Y,Z",
    )
    target_poses: Path | None = option("Configurations where the robot shall be accurate; by default all.", "CSV")
    measured: Path | None = option("Configurations that are measured already but not in the model.", "CSV")
    free: Free | None = option("With MODEL: what has moved since its fit; base is the device's or the robot's.")
    sensor: list[str] | None = option(
        "What will measure; by default what the rows of MODEL were measured with, or a tracker. `tracker`, "
        "`poses`, or a device, roughly where it will stand in the base frame: `distance=X,Y,Z` from this point "
        "(`displacement=`: with an unknown zero), `height=NX,NY,NZ,D` above the plane of this normal at this "
        "distance from the base, "
        "`image=X,Y,Z,TX,TY,TZ` of a camera there that looks at the second point, `socket=X,Y,Z`. Repeat for more. "
        "Noise is as that of the rows of MODEL.",
        "KIND[=NUMBERS]",
    )
    payload_mass: Mass = None
