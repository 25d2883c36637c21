"""The options of the commands that apply models and plan poses: correct, export, plan. Imports nothing slow."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from diffeo_calib.cli import options

DRAWN, FACING_HALF_ANGLE_DEG = 3000, 45.0


class DH(str, Enum):
    """Convention of Denavit-Hartenberg tables."""

    standard = "standard"
    craig = "craig"


@dataclass(frozen=True, kw_only=True)
class Correction:
    """Targets, tools and bounds of corrections."""

    position: Annotated[
        list[str] | None,
        typer.Option(
            "--position",
            metavar="X,Y,Z",
            help="Columns of the target positions of the tool, if the commands' own nominal poses are not the targets.",
        ),
    ] = None
    rotation: Annotated[
        list[str] | None,
        typer.Option(
            "--rotation", metavar="A,B,...", help="Columns of the target orientations: 3, 4 or 9, see --convention."
        ),
    ] = None
    convention: options.Convention = None
    rotation_angle: options.RotationAngle = None
    tip: Annotated[
        list[str] | None,
        typer.Option(
            "--tip",
            metavar="LINK",
            help="Link that carries the tool, for a model with several tips; repeat it where several tools have "
            "targets at the same time, with --tool, --position and --rotation once for each.",
        ),
    ] = None
    tool: Annotated[
        list[str] | None,
        typer.Option(
            "--tool",
            metavar="X,Y,Z[,...]",
            help="Tool centre point in the frame of the tip, in the unit of --length, and its rotation if the tool is "
            "turned: a rotation vector in the unit of --angle, or as --convention says. By default the tip itself, or "
            "the tool that the model was saved with.",
        ),
    ] = None
    tool_from: options.ToolFromOption = options.ToolFrom.tip
    frame: Annotated[
        options.Frame,
        typer.Option("--frame", help="Frame of the target columns: the robot's base, or the measuring device."),
    ] = options.Frame.base
    limit: Annotated[
        float | None,
        typer.Option(
            "--limit", metavar="DEG", help="Largest correction of a joint in degrees; 1 by default (slides: 20 mm)."
        ),
    ] = None
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="DEG",
            help="The rows are a path: the correction of a joint changes by at most so many degrees from row to row.",
        ),
    ] = None
    payload: options.Mass = None


@dataclass(frozen=True, kw_only=True)
class Export:
    """The files to write, and how."""

    urdf: Annotated[
        Path | None,
        typer.Option("--urdf", metavar="URDF", help="Write the robot's own URDF with corrected joint origins."),
    ] = None
    dh: Annotated[
        Path | None, typer.Option("--dh", metavar="CSV", help="Write a Denavit-Hartenberg table, with base and tool.")
    ] = None
    dh_convention: Annotated[
        DH, typer.Option("--dh-convention", help="Convention of --dh; craig is also called modified.")
    ] = DH.standard
    ur_kinematics: Annotated[
        Path | None,
        typer.Option(
            "--ur-kinematics", metavar="YAML", help="Write the kinematics file of Universal Robots' ROS packages."
        ),
    ] = None
    ur_hash: Annotated[
        str | None,
        typer.Option("--ur-hash", help="Entry hash of --ur-kinematics: that of the robot's own calibration file."),
    ] = None
    joint_offsets: Annotated[
        Path | None,
        typer.Option(
            "--joint-offsets", metavar="CSV", help="Write the best joint offsets, all other geometry nominal."
        ),
    ] = None
    correction_tables: Annotated[
        Path | None,
        typer.Option(
            "--correction-tables", metavar="CSV", help="Write transmission errors and their corrections by joint value."
        ),
    ] = None
    with_tables: Annotated[
        bool,
        typer.Option(
            "--with-tables", help="Fit --urdf, --dh and --ur-kinematics for use together with --correction-tables."
        ),
    ] = False
    c: Annotated[
        Path | None,
        typer.Option(
            "--c", metavar="C", help="The model as C99 source, and a header beside it; with --tool and --frame."
        ),
    ] = None
    torch: Annotated[
        Path | None,
        typer.Option(
            "--torch",
            metavar="PT2",
            help="The model as a program of torch: markers, or the poses of a tool with --tool.",
        ),
    ] = None
    onnx: Annotated[
        Path | None,
        typer.Option(
            "--onnx", metavar="ONNX", help="The same for onnxruntime; needs the packages onnx and onnxscript."
        ),
    ] = None
    tool: Annotated[
        str | None,
        typer.Option(
            "--tool",
            metavar="X,Y,Z[,...]",
            help="Tool centre point of programs, in the units of --length and --angle: place in the frame of the tip, "
            "and a rotation vector if it is turned. By default the tip itself, or the tool that the model was saved "
            "with.",
        ),
    ] = None
    tool_from: options.ToolFromOption = options.ToolFrom.tip
    frame: Annotated[
        options.Frame | None,
        typer.Option(
            "--frame",
            help="Frame of the tool's poses in programs, in C of the markers too: the robot's base (default), or the "
            "measuring device.",
        ),
    ] = None
    tip: Annotated[
        str | None,
        typer.Option("--tip", metavar="LINK", help="Tip at the end of --c and --dh, for a model with several tips."),
    ] = None
    robot: Annotated[
        Path | None,
        typer.Option(
            "--robot",
            metavar="URDF",
            help="The robot's description, if the model file does not hold it or it was edited.",
        ),
    ] = None
    payload: options.Mass = None
    length: Annotated[options.Length, typer.Option("--length", help="Unit of lengths in the CSV files written.")] = (
        options.Length.m
    )
    angle: Annotated[options.Angle, typer.Option("--angle", help="Unit of angles in the CSV files written.")] = (
        options.Angle.rad
    )

    @property
    def outputs(self) -> dict[str, Path | None]:
        """Option -> file to write, None where it is not wanted."""
        rigid = {"--urdf": self.urdf, "--dh": self.dh, "--ur-kinematics": self.ur_kinematics}
        tables = {"--joint-offsets": self.joint_offsets, "--correction-tables": self.correction_tables}
        return rigid | tables | {"--c": self.c, "--torch": self.torch, "--onnx": self.onnx}


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Configurations to choose from: a table, or random ones within what the cell allows."""

    candidates: Annotated[
        Path | None,
        typer.Option("--candidates", metavar="CSV", help="Choose from these configurations instead of random ones."),
    ] = None
    draw: Annotated[
        int | None,
        typer.Option("--draw", min=1, help=f"Number of random candidates to choose from, {DRAWN} by default."),
    ] = None
    limits: Annotated[
        list[str] | None,
        typer.Option(
            "--range",
            metavar="JOINT=A:B",
            help="Range of a joint within its limits; by default these, but one turn at most. Repeat for more joints.",
        ),
    ] = None
    tracker: Annotated[
        str | None,
        typer.Option(
            "--tracker",
            metavar="X,Y,Z",
            help="Place of the measuring device in the robot's base frame: plan only poses in which it sees the "
            "marker.",
        ),
    ] = None
    facing: Annotated[
        str | None,
        typer.Option(
            "--facing",
            metavar="X,Y,Z",
            help="With --tracker: direction in which the marker looks, in the frame of the tip; 0,0,1 by default.",
        ),
    ] = None
    cone: Annotated[
        float | None,
        typer.Option(
            "--cone",
            metavar="DEG",
            help="With --tracker: largest angle between that direction and the line to the device, "
            f"{FACING_HALF_ANGLE_DEG:g} by default.",
        ),
    ] = None
    floor: Annotated[
        float | None,
        typer.Option("--floor", metavar="Z", help="Height in the base frame below which no link and no marker may be."),
    ] = None
    column: Annotated[
        str | None,
        typer.Option(
            "--column",
            metavar="X,Y,R[,TOP]",
            help="Upright cylinder in the base frame that no link may enter: place, radius, and top if it ends.",
        ),
    ] = None
    collisions: Annotated[
        bool,
        typer.Option(
            "--collisions",
            help="Leave out poses in which the robot collides with itself, by its URDF; needs pinocchio.",
        ),
    ] = False
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=options.LARGEST_SEED, help="Seed of the random candidates.")
    ] = 0


@dataclass(frozen=True, kw_only=True)
class Planned:
    """What is planned for."""

    robot: Annotated[
        Path | None, typer.Option("--robot", metavar="URDF", help="The robot's description, to plan the first poses.")
    ] = None
    base: Annotated[
        str | None, typer.Option("--base", metavar="LINK", help="With --robot: first link of the chain.")
    ] = None
    tip: Annotated[
        list[str] | None,
        typer.Option(
            "--tip",
            metavar="LINK",
            help="With --robot: last link of the chain; the markers are fixed to it. Repeat for more: each has them.",
        ),
    ] = None
    marker: Annotated[
        list[str] | None,
        typer.Option(
            "--marker",
            metavar="X,Y,Z",
            help="With --robot: place of a marker in the frame of the tip, in the unit of --length; repeat for more. "
            "By default 0.1 m beside and 0.1 m in front of the tip.",
        ),
    ] = None
    target: Annotated[
        Path | None,
        typer.Option(
            "--target",
            metavar="CSV",
            help="Configurations at which the robot shall be accurate; by default everywhere.",
        ),
    ] = None
    measured: Annotated[
        Path | None,
        typer.Option(
            "--measured", metavar="CSV", help="Configurations that are measured already but not in the model."
        ),
    ] = None
    free: Annotated[
        options.Free | None,
        typer.Option("--free", help="With MODEL: what has moved since its fit; base is the device's or the robot's."),
    ] = None
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            "--sensor",
            metavar="KIND[=NUMBERS]",
            help="What will measure; by default what the rows of MODEL were measured with, or a tracker. `tracker`, "
            "`poses`, or a device, roughly where it will stand in the base frame: `distance=X,Y,Z` from this point "
            "(`displacement=`: with an unknown zero), `height=NX,NY,NZ,D` above the plane of this normal at this "
            "distance from the base, "
            "`image=X,Y,Z,TX,TY,TZ` of a camera there that looks at the second point, `socket=X,Y,Z`. Repeat for more.",
        ),
    ] = None
    payload: options.Mass = None
