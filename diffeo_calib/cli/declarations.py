"""The commands: their options, as fields of a class, and their help, as its docstring. Imports nothing slow."""

from __future__ import annotations

from dataclasses import MISSING
from pathlib import Path
from typing import Literal

from diffeo_calib.cli.options import (
    MASS,
    ROBOT,
    SEED,
    Angle,
    Candidates,
    Convention,
    Length,
    Links,
    Options,
    Places,
    Robot,
    Rows,
    Targets,
    Units,
    argument,
    option,
    written,
)

Frame = Literal["base", "measuring"]
Free = Literal["both", "base", "marker"]  # parts of the set-up that may have moved
CSV = "Table with a header, one configuration per row."
NOTE = "Text to keep in the model file, such as a serial number."
MODEL = "Model file written by `fit`."
MEASURED_TOOL = "; behind measured: in the measured frame of a model of poses, which is better known"
OLD = "Model file of an earlier calibration."
REASONS = {
    **dict.fromkeys(("angle", "rotation_angle", "decimal"), "the same"),
    "joint_length": "the same: the slides are in another unit",
    "camera_on_tool": "as of length; else the board is on the tool",
    "rotation": "by their names; without these three lines positions alone are calibrated",
    "dh_convention": "the convention with which it explains the rows",
    "base": "root of the URDF",
    "tip": "leaves after which the columns are named",
    "places": "the measured places",
    "output": "the model",
    "report": "the report",
}
"""Of options of `fit` that `init` proposes, by default; "the same" as of the option before."""


class Command(Options):
    """The options of a command; its work is ``run`` of the module of its name in ``commands``, which takes them."""


class FitOptions(Command, Rows, Robot):
    """Calibrate a robot, test it on held-out rows, save the model.

    Rows may hold anything that was measured: positions, poses, a ball in sockets, readings of devices. The model is
    fitted to the rows that are not held out: its held-out errors are those in the table.

    A campaign file (`diffeo-calib fit campaign.toml`, see `init`) may take the place of CSV: it can hold all
    options, the required ones too; those that are typed as well win.
    """

    csv: Path = argument(CSV, "CSV")
    output: Path = written("Model file to write.", "MODEL", MISSING)
    holdout: float = option(
        "Fraction of the rows that are not fitted but test the model; 0 for none.", default=0.3, min=0.0, max=0.9
    )
    seed: int = option("Seed of the split.", **SEED)
    controls: int | None = option(
        "Number of rows that carry the deformation; by default all, or 200 of a large table.", min=10
    )
    report: Path | None = written("Also write the report: one page that needs neither a network nor a server.", "HTML")
    note: str = option(NOTE, "TEXT", "")
    scales_of: list[Path] | None = option(
        "For few rows: take the size of every kind of error, and of the noise, from the model of another robot of the "
        "same type instead of estimating it. May be repeated.",
        "MODEL",
    )
    duplicates: str = option("Exactly repeated rows: error, keep or drop.", default="error")


class CampaignOptions(Command, Rows, Robot):
    """Judge rows while they are measured.

    Follows a table that another program appends to: every row gets a verdict, the expected error of the robot and
    the best poses to measure next. A journal beside the table keeps what was decided: after a crash the same
    command goes on where it stopped. Ends with exit code 0 when --tolerance is reached, 4 if the rows end before.

    A campaign file (`diffeo-calib campaign campaign.toml`, see `init`) may take the place of CSV, as of `fit`.
    """

    csv: Path = argument(CSV, "CSV", kind="later")
    tolerance: str | None = option("End when the error is below this with 95 % probability: 0.15mm.", "LENGTH")
    stdin: bool = option(
        "Append rows from standard input to CSV, one JSON object a line, and print verdicts, expected errors and next "
        "poses so: see campaign/feeds.py.",
        default=False,
    )
    once: bool = option("Judge the rows that are there, and do not wait for more.", default=False)
    candidates: Path | None = option("Table of poses that can be measured; within the joint limits by default.", "CSV")
    page: str | None = option("Show the campaign to this machine's browser at this port; 0 for any.", "[HOST:]PORT")
    count: int = option("Number of poses that are proposed after each row.", default=1, min=0)
    accepted: Path | None = written("Table of the accepted rows to write when the campaign ends, for `fit`.", "CSV")


class RecordOptions(Command):
    """Turn a ROS bag into a table, one row for each stop.

    A stop lasts as long as joints and measured places stand still; a row is the mean over it, in m and rad, with
    the standard deviations of what was seen (std_x, ...), its time and the number of readings. The clocks of both
    may differ. Needs the extra `ros`.

    Of images, the one nearest to the middle of each stop is written beside the table, which then has its name and
    the joint values for `images`.
    """

    bag: Path = argument("Folder of a ROS 2 bag, or file of a ROS 1 bag.", "BAG")
    seen: str = argument("Stamped points or poses, /tf:CHILD or '/tf:PARENT>CHILD'; or images.", "TOPIC")
    output: Path = written("Table to write.", "CSV", MISSING)
    joints: str = option("Joint states; TOPIC:NAME,NAME takes some joints.", "TOPIC", "/joint_states")
    still: str = option("Largest motion of a joint at a stop; shortest stop in s.", "MOTION[,SECONDS]", "0.001,0.5")
    offset: float | None = option(
        "Seconds to add to the times of TOPIC; by default estimated from all motions, 0 for images."
    )


class EvaluateOptions(Command, Rows):
    """Measure the errors of a model on a table of measurements.

    The table is read as that of the model's fit, unless options say otherwise. --free first finds where the
    measuring device and the markers are now, and keeps everything else.

    --report writes one HTML page for a browser or a printer: how good the model is, where, why, whether it can be
    trusted, and what to do next. Rows that were used in the fit are left out.
    """

    model: Path = argument(MODEL, "MODEL")
    csv: Path | None = argument(
        f"{CSV} With --report by default the rows of the fit, each predicted by all others.", "CSV", None
    )
    free: Free | None = option("First find anew what may have moved; base is the device's or the robot's.")
    output: Path | None = written(
        "Write the error of every row to this file, measured minus predicted; with --free the registered model.", "FILE"
    )
    tolerance: str | None = option(
        "Exit with code 4 if the RMS error of the rows that were not used in the fit is larger, such as 0.15mm. With "
        "--report the page says whether it is.",
        "RMS",
    )
    report: Path | None = written("Write the page, in place of tables of errors.", "HTML")
    against: list[str] | None = option(
        "Further column of the table to show errors against in the page; repeat for more. Time and temperature are "
        "found by their names.",
        "COLUMN",
    )
    needs = (("--against", "--report"), ("--position --socket --reading --length --angle --against", "CSV"))
    excludes = (("--tolerance", "--free"), ("--report", "--free -o"))


class InitOptions(Command, Places):
    """Propose the options of `fit` for a table and a robot.

    Without ROBOT the table has commanded poses or places in place of joint values. Looks at names, numbers and
    plausible units, and writes a campaign file with a reason for every line. Check it, then run
    `diffeo-calib fit campaign.toml`.
    """

    csv: Path = argument(CSV, "CSV")
    robot: Path | None = argument(ROBOT, "ROBOT", None)
    output: Path = written("Campaign file to write.", "TOML", Path("campaign.toml"))
    force: bool = option("Replace a campaign file that was edited.", default=False)


class ImagesOptions(Command):
    """Find a printed board in a folder of images.

    Writes a line for each corner, and beside the table a file .yaml of the camera, for
    `fit --reading corners=FILE`. Several fixed cameras that see the same board: a folder and a file for each, named
    after it. Images that do not show the board are named with the reason and left out.
    """

    folders: list[Path] = argument("Folder of the images, or one of each camera.", "FOLDER")
    joints: Path = argument(
        "Table of joint values, with a column of file names unless rows are in the order of the numbers in these.",
        "JOINTS",
    )
    board: str = option(
        "Its lengths are in m, whatever --length is: charuco:5x7:SQUARE:MARKER:DICT, chessboard:7x5:SQUARE (inner "
        "corners), aruco:4x5:SIDE:GAP:DICT (with :right-up if its numbers run upwards) or tag:SIDE:DICT:NUMBER.",
        "BOARD",
        MISSING,
    )
    length: Length = option("Unit of places on the board in the output.", default=MISSING)
    output: Path = written("Table of corners to write.", "CSV", MISSING)
    board_std: float = option(
        "Standard deviation of the board's size, as a share: 0.001 as printed, 0.0002 measured.", default=0.001
    )
    report: Path | None = written("Write a page with all images and their corners.", "HTML")
    sep: str = option("Separator of both tables.", default=",")
    decimal: str = option("Decimal mark of both tables.", default=".")


class PredictOptions(Command, Units):
    """Predict positions or poses for a table of joint values.

    Writes the joints, the positions, and the standard deviations that a new measurement would have. For a model
    that was calibrated with poses it adds the rotation, by default as a rotation vector in the unit of --angle.
    """

    model: Path = argument(MODEL, "MODEL")
    csv: Path = argument(CSV, "CSV")
    output: Path = written("Table of predictions to write.", "CSV", MISSING)
    convention: str | None = option()
    rotation_angle: Angle | None = option()
    payload: str | None = option(metavar="COLUMN")


class CorrectOptions(Command, Targets, Units):
    """Correct a program, so that the robot goes where it is told.

    The target of a row is the pose in which the nominal robot holds the tool at the row's joint values. With
    --position (and --rotation) it is read from the table, and the joint values are where the search starts.

    Writes the program with corrected joint values, and adds the pose (command_x, ...) of the tool in the URDF's
    base link, for a controller that does its own nominal inverse kinematics, the status of each row, its miss and
    how well the model knows the tool there (std_mm). Rows that cannot reach their targets get the nearest command
    that is allowed, and are listed; the exit code is 0 then, too. Joint cells stay empty where no command is
    allowed.

    With several tips the added columns carry their names (command_left_x, ...), and a tip whose target cells are
    empty may be anywhere in that row.
    """

    model: Path = argument(MODEL, "MODEL")
    program: Path = argument("Table with a header, one command per row; other columns are kept.", "PROGRAM")
    output: Path = written("Corrected program to write.", "CSV", MISSING)
    tip: list[str] | None = option(
        "Link that carries the tool, for a model with several tips; repeat it where several tools have targets at the "
        "same time, with --tool, --position and --rotation once for each.",
        "LINK",
    )
    tool: list[str] | None = option(
        "Tool centre point in the frame of the tip, in the unit of --length, and its rotation if the tool is turned: a "
        f"rotation vector in the unit of --angle, or as --convention says{MEASURED_TOOL}. By default the tip itself, "
        "or the tool that the model was saved with.",
        "[measured:]X,Y,Z[,...]",
    )
    frame: Frame = option("Frame of the target columns: the robot's base, or the measuring device.", default="base")
    limit: float | None = option(
        "Largest correction of a joint in degrees; 1 by default (prismatic joints: 20 mm).", "DEG"
    )
    rate: float | None = option(
        "The rows are a path: the correction of a joint changes by at most this many degrees from row to row.", "DEG"
    )
    payload: float | None = option(MASS, "MASS")


class ExportOptions(Command):
    """Write a model in the formats of other programs.

    Name at least one file. A table says how far each is from the model: rigid kinematics hold neither gravity sag
    nor transmission errors, correction tables hold transmission errors only. Programs (--c, --torch, --onnx) hold
    the whole model.
    """

    model: Path = argument(MODEL, "MODEL")
    urdf: Path | None = written("Write the robot's own URDF with corrected joint origins.", "URDF")
    mjcf: Path | None = written("Write the same kinematics for MuJoCo: bodies, joints, inertias, sites at tips.", "XML")
    dh: Path | None = written("Write a Denavit-Hartenberg table, with base and tool.", "CSV")
    dh_convention: Convention = option("Convention of --dh; craig is also called modified.", default="standard")
    ur_kinematics: Path | None = written(
        "Write the kinematics file of Universal Robots' ROS packages; over a copy of the robot's own calibration file "
        "it keeps the hash of this.",
        "YAML",
    )
    joint_offsets: Path | None = written("Write the best joint offsets, all other geometry nominal.", "CSV")
    correction_tables: Path | None = written(
        "Write transmission errors and their corrections by joint value; --urdf, --mjcf, --dh and --ur-kinematics that "
        "are written beside them are fitted for use together with them.",
        "CSV",
    )
    c: Path | None = option(
        "The model as C99 source, and a header beside it; with --tool and --frame.", "C", kind="source"
    )
    torch: Path | None = written("The model as a program of torch: markers, or the poses of a tool with --tool.", "PT2")
    onnx: Path | None = written("The same for onnxruntime; needs the packages onnx and onnxscript.", "ONNX")
    field: Path | None = written(
        "Of a machine with commanded places: what to add to its commands at the places of --grid.", "CSV"
    )
    grid: str = option("Points of --field along each axis.", "NXxNYxNZ", "5x5x5")
    camera: Path | None = option(
        "Write the camera of a model of images, or of poses of a board: intrinsics (OpenCV, ROS camera_info), hand-eye "
        "transform (OpenCV, easy_handeye2), URDF joint, static transform; its place belongs to --urdf, --dh or "
        "--ur-kinematics if these are written too.",
        "FOLDER",
        kind="folder",
    )
    tool: str | None = option(
        "Tool centre point of programs, in the units of --length and --angle: place in the frame of the tip, and a "
        f"rotation vector if it is turned{MEASURED_TOOL}. By default the tip itself, or the tool that the model was "
        "saved with.",
        "[measured:]X,Y,Z[,...]",
    )
    frame: Frame | None = option(
        "Frame of the tool's poses in programs, in C of the markers too: the robot's base (default), or the measuring "
        "device."
    )
    tip: str | None = option("Tip at the end of --c and --dh, for a model with several tips.", "LINK")
    robot: Path | None = option("The robot's description, if the model file does not hold it or it was edited.", "URDF")
    payload: float | None = option(MASS, "MASS")
    length: Length = option("Unit of lengths in the CSV files written.", default="m")
    angle: Angle = option("Unit of angles in the CSV files written.", default="rad")
    needs = (("--tool --frame", "--c --torch --onnx"), ("--tip", "--c --dh"))


class PlanOptions(Command, Candidates, Links, Units):
    """Plan which poses to measure, and say how many are needed.

    With --robot the first poses of a calibration, with a MODEL the next ones, and with --free those to measure
    again later. Lengths are in the unit of --length, angles in that of --angle; tables have the columns that `fit`
    reads.
    """

    count: int = option("Number of poses to plan.", default=MISSING, min=1)
    output: Path = written("Table of poses to write: the joints, and a rank.", "CSV", MISSING)
    model: Path | None = argument(
        "Model file written by `fit`, to plan the next poses; or name a --robot.", "MODEL", None
    )
    robot: Path | None = option(f"To plan the first poses. {ROBOT}", "FILE")
    marker: list[str] | None = option(
        "With --robot: place of a marker in the frame of the tip, in the unit of --length; repeat for more. By default "
        "0.1 m beside and 0.1 m in front of the tip.",
        "X,Y,Z",
    )
    target_poses: Path | None = option("Configurations where the robot shall be accurate; by default all.", "CSV")
    measured: Path | None = option("Configurations that are measured already but not in the model.", "CSV")
    free: Free | None = option("With MODEL: what has moved since its fit; base is the device's or the robot's.")
    sensor: list[str] | None = option(
        "What will measure; by default what the rows of MODEL were measured with, or a tracker. `tracker`, `poses`, or "
        "a device, roughly where it will stand in the base frame: `distance=X,Y,Z` from this point (`displacement=`: "
        "with an unknown zero), `height=NX,NY,NZ,D` above the plane of this normal at this distance from the base, "
        "`image=X,Y,Z,TX,TY,TZ` of a camera there that looks at the second point, `socket=X,Y,Z`. Repeat for more. "
        "Noise is as that of the rows of MODEL.",
        "KIND[=NUMBERS]",
    )
    payload: float | None = option(MASS, "MASS")
    needs = (("--payload --free", "MODEL"),)
    excludes = (
        ("--robot --base --tip --load --dh-convention --marker", "MODEL"),
        ("--draw --range --tracker --floor --column --collisions", "--candidates"),
    )


class RecalibrateOptions(Command, Rows):
    """Say what has changed since a fit, or calibrate anew.

    The measuring device may stand anywhere. Twenty rows do what about a hundred do without the old model. A table is
    read as that of the old fit, unless options say otherwise. Says where device and markers are now, and tests every
    joint, the load and the geometry. With -o the robot is calibrated anew, from old rows and new ones. Without, OTHER
    may be a model: the same test of what it predicts at rows of the fits, with its uncertainty.

    An offset is added to what the joint reads: after a change by +0.5 mrad the joint stands 0.5 mrad farther in its
    positive direction than the old model has it at the same reading. The exit code is 0 whether or not something has
    changed: with --json, programs read `changes` and `rows_can_tell`.
    """

    old: Path = argument(OLD, "OLD")
    other: Path = argument("Table of new measurements, or another model file of the same robot.", "OTHER")
    output: Path | None = written("Calibrate anew, and write the model to this file.", "MODEL")
    free: Literal["base", "remounted", "both"] | None = option(
        "What else may have moved: the device alone (base: nobody touched the markers, 0.05 mm), remounted markers too "
        "(1 mm), or both anywhere (other markers); by default the rows decide."
    )
    seed: int = option("Seed of the tests for changes.", **SEED)
    note: str = option(NOTE, "TEXT", "")
    needs = (("--note", "-o"),)


class DemoOptions(Command):
    """Simulate a robot and calibrate it as a user would.

    The robot is an elastic six-axis arm, measured by a laser tracker.
    """

    output: Path = option("Folder to write everything to.", "FOLDER", Path("demo_output"), kind="folder")
    count: int = option("Number of simulated measurements.", default=300, min=20, max=1_000_000)
    seed: int = option("Seed of the arm and the noise.", **SEED)


COMMANDS = {kind.__name__.removesuffix("Options").lower(): kind for kind in Command.__subclasses__()}
"""By name, in the order of the help."""
