"""The options of the commands: their types and their help. Imports nothing slow, so that help appears at once."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

DEMO_ROWS = 300
LARGEST_SEED = 2**63 - 1
"""As in common/checks.py, which loads torch."""


class Length(str, Enum):
    """Unit of positions and prismatic joints."""

    m = "m"
    mm = "mm"


class Frame(str, Enum):
    """Frame of targets."""

    base = "base"
    measuring = "measuring"


class ToolFrom(str, Enum):
    """Frame in which a tool centre point is given."""

    tip = "tip"
    measured = "measured"


class Angle(str, Enum):
    """Unit of angles."""

    rad = "rad"
    deg = "deg"


class DH(str, Enum):
    """Convention of Denavit-Hartenberg tables."""

    standard = "standard"
    craig = "craig"


# --- files --------------------------------------------------------------------------------------------------------

CsvPath = Annotated[Path, typer.Argument(metavar="CSV", help="Table with a header, one configuration per row.")]
ModelPath = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file written by `fit`.")]
ModelOutput = Annotated[Path, typer.Option("-o", "--output", metavar="MODEL", help="Model file to write.")]
CsvOutput = Annotated[Path, typer.Option("-o", "--output", metavar="CSV", help="Table of predictions to write.")]
FolderOutput = Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder to write everything to.")]
Figure = Annotated[
    Path | None,
    typer.Option("--figure", metavar="IMAGE", help="Also draw the errors (of the held-out rows, if any)."),
]

# --- the table ----------------------------------------------------------------------------------------------------

Position = Annotated[
    list[str],
    typer.Option(
        "--position",
        metavar="X,Y,Z",
        help="The three position columns of a marker; repeat for more markers. Empty cells: hidden in that row.",
    ),
]
LengthOption = Annotated[
    Length, typer.Option("--length", help="Unit of positions in the table, and of prismatic joints.")
]
JointLength = Annotated[
    Length | None,
    typer.Option("--joint-length", help="Unit of prismatic joints, if not that of --length."),
]
AngleOption = Annotated[Angle, typer.Option("--angle", help="Unit of revolute joints in the table.")]
Joints = Annotated[
    str | None,
    typer.Option(
        "--joints", metavar="A,B,...", help="Joint columns in the robot's order, if not named after its joints."
    ),
]
Sep = Annotated[str, typer.Option("--sep", help="Column separator of the table ('\\t' for a tab).")]
Decimal = Annotated[str, typer.Option("--decimal", help="Decimal mark of the table.")]
Rotation = Annotated[
    list[str] | None,
    typer.Option(
        "--rotation",
        metavar="A,B,...",
        help="Columns of the rotation, if poses were measured: 3, 4 or 9, depending on --convention; for frames on "
        "several tips once per --position.",
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
CameraOnTool = Annotated[
    bool,
    typer.Option(
        "--camera-on-tool",
        help="The poses, or the corners of --reading, are those of a fixed board seen by a camera on the tool, as "
        "detectors of boards give them; standard deviations are along the camera's axes.",
    ),
]
Lever = Annotated[
    float | None,
    typer.Option(
        "--lever",
        help="Distance from a pose's origin to the three points that represent the pose, in the unit of --length: it "
        "weighs orientation against position. 0.1 m by default.",
    ),
]
Std = Annotated[
    str | None,
    typer.Option(
        "--std",
        metavar="A,B,...",
        help="Columns with standard deviations of the positions: one for all, one per marker or three per marker.",
    ),
]
RotationStd = Annotated[
    list[str] | None,
    typer.Option(
        "--rotation-std",
        metavar="A,B,C",
        help="Columns with standard deviations of the rotation about the measuring frame's axes, or one for all three; "
        "once per --rotation.",
    ),
]
Duplicates = Annotated[str, typer.Option("--duplicates", help="Exactly repeated rows: error, keep or drop.")]

# --- the fit ------------------------------------------------------------------------------------------------------

Holdout = Annotated[
    float,
    typer.Option(
        "--holdout", min=0.0, max=0.9, help="Fraction of the rows that are not fitted but test the model; 0 for none."
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of the split.")]
Controls = Annotated[
    int | None,
    typer.Option(
        "--controls",
        min=10,
        help="Number of rows that carry the deformation; by default all, or 200 of a large table.",
    ),
]

Note = Annotated[
    str, typer.Option("--note", metavar="TEXT", help="Text to keep in the model file, such as a serial number.")
]

JOBS_HELP = "With several campaign files: how many run at a time; the exit code counts those that failed."
Jobs = Annotated[int | None, typer.Option("--jobs", metavar="N", help=JOBS_HELP)]

# --- exports ------------------------------------------------------------------------------------------------------

UrdfOutput = Annotated[
    Path | None,
    typer.Option("--urdf", metavar="URDF", help="Write the robot's own URDF with corrected joint origins."),
]
DhOutput = Annotated[
    Path | None, typer.Option("--dh", metavar="CSV", help="Write a Denavit-Hartenberg table, with base and tool.")
]
DhConvention = Annotated[DH, typer.Option("--dh-convention", help="Convention of --dh; craig is also called modified.")]
UrOutput = Annotated[
    Path | None,
    typer.Option(
        "--ur-kinematics", metavar="YAML", help="Write the kinematics file of Universal Robots' ROS packages."
    ),
]
UrHash = Annotated[
    str | None,
    typer.Option("--ur-hash", help="Entry hash of --ur-kinematics: that of the robot's own calibration file."),
]
OffsetsOutput = Annotated[
    Path | None,
    typer.Option("--joint-offsets", metavar="CSV", help="Write the best joint offsets, all other geometry nominal."),
]
TablesOutput = Annotated[
    Path | None,
    typer.Option(
        "--correction-tables", metavar="CSV", help="Write transmission errors and their corrections by joint value."
    ),
]
WithTables = Annotated[
    bool,
    typer.Option(
        "--with-tables", help="Fit --urdf, --dh and --ur-kinematics for use together with --correction-tables."
    ),
]
ExportLength = Annotated[Length, typer.Option("--length", help="Unit of lengths in the CSV files written.")]
ExportAngle = Annotated[Angle, typer.Option("--angle", help="Unit of angles in the CSV files written.")]
OtherRobot = Annotated[
    Path | None,
    typer.Option(
        "--robot", metavar="URDF", help="The robot's description, if the model file does not hold it or it was edited."
    ),
]

COutput = Annotated[
    Path | None,
    typer.Option("--c", metavar="C", help="The model as C99 source, and a header beside it; with --tool and --frame."),
]
TorchOutput = Annotated[
    Path | None,
    typer.Option(
        "--torch", metavar="PT2", help="The model as a program of torch: markers, or the poses of a tool with --tool."
    ),
]
OnnxOutput = Annotated[
    Path | None,
    typer.Option("--onnx", metavar="ONNX", help="The same for onnxruntime; needs the packages onnx and onnxscript."),
]
ProgramFrame = Annotated[
    Frame | None,
    typer.Option(
        "--frame",
        help="Frame of the tool's poses in programs, in C of the markers too: the robot's base (default), or the "
        "measuring device.",
    ),
]
ProgramTool = Annotated[
    str | None,
    typer.Option(
        "--tool",
        metavar="X,Y,Z[,...]",
        help="Tool centre point of programs, in the units of --length and --angle: place in the frame of the tip, and "
        "a rotation vector if it is turned. By default the tip itself, or the tool that the model was saved with.",
    ),
]

# --- the correction -----------------------------------------------------------------------------------------------

ProgramPath = Annotated[
    Path, typer.Argument(metavar="PROGRAM", help="Table with a header, one command per row; other columns are kept.")
]
ProgramOutput = Annotated[Path, typer.Option("-o", "--output", metavar="CSV", help="Corrected program to write.")]
TargetPosition = Annotated[
    list[str] | None,
    typer.Option(
        "--position",
        metavar="X,Y,Z",
        help="Columns of the target positions of the tool, if the commands' own nominal poses are not the targets.",
    ),
]
TargetRotation = Annotated[
    list[str] | None,
    typer.Option(
        "--rotation", metavar="A,B,...", help="Columns of the target orientations: 3, 4 or 9, see --convention."
    ),
]
Tool = Annotated[
    list[str] | None,
    typer.Option(
        "--tool",
        metavar="X,Y,Z[,...]",
        help="Tool centre point in the frame of the tip, in the unit of --length, and its rotation if the tool is "
        "turned: a rotation vector in the unit of --angle, or as --convention says. By default the tip itself, or the "
        "tool that the model was saved with.",
    ),
]
ToolFromOption = Annotated[
    ToolFrom,
    typer.Option(
        "--tool-from",
        help="Frame of --tool: the tip of the robot, or the measured frame of a model of poses, which is better known.",
    ),
]
FrameOption = Annotated[
    Frame, typer.Option("--frame", help="Frame of the target columns: the robot's base, or the measuring device.")
]
Limit = Annotated[
    float | None,
    typer.Option(
        "--limit", metavar="DEG", help="Largest correction of a joint in degrees; 1 by default (slides: 20 mm)."
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(
        "--rate",
        metavar="DEG",
        help="The rows are a path: the correction of a joint changes by at most so many degrees from row to row.",
    ),
]

# --- the registration ---------------------------------------------------------------------------------------------


class Free(str, Enum):
    """What may have moved."""

    both = "both"
    base = "base"
    marker = "marker"


Register = Annotated[
    bool,
    typer.Option("--register", help="First find the measuring device and the markers anew from these rows."),
]
FreeOption = Annotated[
    Free | None,
    typer.Option("--free", help="With --register: what may have moved; base is the device's or the robot's."),
]
RegisteredOutput = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="MODEL", help="With --register: write the registered model to this file."),
]
FailAbove = Annotated[
    str | None,
    typer.Option(
        "--fail-above",
        metavar="RMS",
        help="Exit with code 4 if the RMS error of the rows that were not used in the fit is larger, such as 0.15mm.",
    ),
]
Residuals = Annotated[
    Path | None,
    typer.Option(
        "--residuals", metavar="TABLE", help="Write the error of every row to this file: measured minus predicted."
    ),
]

# --- the demonstration --------------------------------------------------------------------------------------------

DemoRows = Annotated[
    int | None, typer.Option("--rows", min=20, help=f"Number of simulated measurements, {DEMO_ROWS} by default.")
]
DemoSeed = Annotated[
    int | None, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of the arm and the noise, 0 by default.")
]
Paper = Annotated[
    bool, typer.Option("--paper", help="The elastic RR arm of the paper's section 5 instead, and its figures.")
]
