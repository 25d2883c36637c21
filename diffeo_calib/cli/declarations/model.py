"""The commands that apply models: predict, correct, export. Each imports its work when it runs."""

from __future__ import annotations

from pathlib import Path

import typer

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import robot as robot_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.places import check_outputs


@app.command("predict")
def predict_command(
    model: options.ModelPath,
    csv: options.CsvPath,
    angle: options.AngleOption,
    length: options.LengthOption,
    output: options.CsvOutput,
    joint_length: options.JointLength = None,
    joints: options.Joints = None,
    sep: options.Sep = ",",
    decimal: options.Decimal = ".",
    convention: options.Convention = None,
    rotation_angle: options.RotationAngle = None,
    payload: robot_options.Payload = None,
    _json: report_options.Json = None,
) -> None:
    """Predict positions or poses for a table of joint values.

    Writes the joints, the positions, and the standard deviations that a new measurement would have. For a model that
    was calibrated with poses it adds the rotation, by default as a rotation vector in the unit of --angle.
    """
    check_outputs({"-o": output}, {"MODEL": model, "CSV": csv})
    from diffeo_calib.cli.commands import predict  # noqa: PLC0415
    from diffeo_calib.cli.tables import positions as tables  # noqa: PLC0415

    table = tables.table_format(length, angle, sep, decimal, joint_length)
    table = tables.with_columns(
        tables.with_rotation(table, None, convention, rotation_angle, None), None, None, payload
    )
    predict.run(model, csv, joints, table, output)


@app.command("correct")
def correct_command(
    model: options.ModelPath,
    program: options.ProgramPath,
    length: options.LengthOption,
    angle: options.AngleOption,
    output: options.ProgramOutput,
    joint_length: options.JointLength = None,
    joints: options.Joints = None,
    position: options.TargetPosition = None,
    rotation: options.TargetRotation = None,
    convention: options.Convention = None,
    rotation_angle: options.RotationAngle = None,
    sep: options.Sep = ",",
    decimal: options.Decimal = ".",
    tip: robot_options.ToolTips = None,
    tool: options.Tool = None,
    tool_from: options.ToolFromOption = options.ToolFrom.tip,
    frame: options.FrameOption = options.Frame.base,
    limit: options.Limit = None,
    rate: options.Rate = None,
    payload: robot_options.Mass = None,
    _json: report_options.Json = None,
) -> None:
    """Correct a program, so that the robot goes where it is told.

    The target of a row is the pose in which the nominal robot holds the tool at the row's joint values. With
    --position (and --rotation) it is read from the table, and the joint values are where the search starts.

    Writes the program with corrected joint values, and adds the pose (command_x, ...) to send to a controller that does
    its own nominal inverse kinematics, the status of each row and its miss. Rows that cannot reach their targets get
    the nearest command that is allowed, and are listed; the exit code is 0 then, too. Joint cells stay empty where no
    command is allowed.

    With several tips the added columns carry their names (command_left_x, ...), and a tip whose target cells are empty
    may be anywhere in that row.
    """
    check_outputs({"-o": output}, {"MODEL": model, "PROGRAM": program})
    from diffeo_calib.cli.commands import correct  # noqa: PLC0415
    from diffeo_calib.cli.tables import positions as tables  # noqa: PLC0415

    table = tables.table_format(length, angle, sep, decimal, joint_length)
    source = tables.ProgramTable(program, joints, position or [], rotation or [], table, convention, rotation_angle)
    tools = correct.Tools(tuple(tip or ()), tuple(tool or ()), tool_from.value)
    correct.run(model, source, correct.Options(tools, frame.value, limit, rate, payload), output)


@app.command("export")
def export_command(
    model: options.ModelPath,
    urdf: options.UrdfOutput = None,
    dh: options.DhOutput = None,
    dh_convention: options.DhConvention = options.DH.standard,
    ur_kinematics: options.UrOutput = None,
    ur_hash: options.UrHash = None,
    joint_offsets: options.OffsetsOutput = None,
    correction_tables: options.TablesOutput = None,
    with_tables: options.WithTables = False,
    c: options.COutput = None,
    torch: options.TorchOutput = None,
    onnx: options.OnnxOutput = None,
    tool: options.ProgramTool = None,
    tool_from: options.ToolFromOption = options.ToolFrom.tip,
    frame: options.ProgramFrame = None,
    tip: robot_options.ExportTip = None,
    robot: options.OtherRobot = None,
    payload: robot_options.Mass = None,
    length: options.ExportLength = options.Length.m,
    angle: options.ExportAngle = options.Angle.rad,
    _json: report_options.Json = None,
) -> None:
    """Write a model in the formats of other programs.

    Name at least one file. A table says how far each is from the model: rigid kinematics hold neither gravity sag nor
    transmission errors, correction tables hold transmission errors only. Programs (--c, --torch, --onnx) hold the whole
    model.
    """
    outputs: dict[str, Path | None] = {
        "--urdf": urdf,
        "--dh": dh,
        "--ur-kinematics": ur_kinematics,
        "--joint-offsets": joint_offsets,
        "--correction-tables": correction_tables,
        "--c": c,
        "--torch": torch,
        "--onnx": onnx,
    }
    others = {"ur_hash": ur_hash is not None, "tool": bool(tool or frame), "tip": bool(tip)}
    _check_belonging(outputs, with_tables=with_tables, **others)
    header = {"--c (its header)": None if c is None else c.with_suffix(".h")}
    check_outputs(outputs | header, {"MODEL": model} | ({} if robot is None else {"--robot": robot}))
    from diffeo_calib.cli.commands import export  # noqa: PLC0415

    texts = dh_convention.value, length.value, angle.value, ur_hash, tool, tool_from.value, frame and frame.value, tip
    export.run(model, outputs, export.Formats(*texts), robot, with_tables=with_tables, payload=payload)


def _check_belonging(
    outputs: dict[str, Path | None], *, with_tables: bool, ur_hash: bool, tool: bool, tip: bool
) -> None:
    """Refuse options without the files that they belong to."""
    wanted = {option for option, target in outputs.items() if target is not None}
    if not wanted:
        raise typer.BadParameter(f"name at least one file to write: {', '.join(outputs)}")
    if with_tables and not ("--correction-tables" in wanted and wanted & {"--urdf", "--dh", "--ur-kinematics"}):
        raise typer.BadParameter("--with-tables needs --correction-tables, and --urdf, --dh or --ur-kinematics")
    if ur_hash and "--ur-kinematics" not in wanted:
        raise typer.BadParameter("--ur-hash belongs to --ur-kinematics")
    if tip and not wanted & {"--c", "--dh"}:
        raise typer.BadParameter("--tip belongs to --c and --dh: the other files hold all tips")
    if tool and not wanted & {"--c", "--torch", "--onnx"}:
        raise typer.BadParameter("--tool and --frame belong to --c, --torch and --onnx")
