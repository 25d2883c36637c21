"""The command that writes reports. It imports its work when it runs."""

from __future__ import annotations

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import recalibrate as again
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import robot as robot_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.places import check_outputs
from diffeo_calib.common.errors import InputError


@app.command("report")
def report_command(
    model: options.ModelPath,
    output: report_options.ReportOutput,
    data: report_options.ShownTable = None,
    position: again.ComparedPosition = None,
    length: again.ComparedLength = None,
    angle: again.ComparedAngle = None,
    joint_length: options.JointLength = None,
    joints: options.Joints = None,
    sep: options.Sep = ",",
    decimal: options.Decimal = ".",
    rotation: options.Rotation = None,
    convention: options.Convention = None,
    rotation_angle: options.RotationAngle = None,
    lever: options.Lever = None,
    camera_on_tool: options.CameraOnTool = False,
    std: options.Std = None,
    rotation_std: options.RotationStd = None,
    payload: robot_options.Payload = None,
    title: report_options.Title = "",
    against: report_options.Against = None,
    _json: report_options.Json = None,
) -> None:
    """Write a report about a model, for a browser or a printer.

    One HTML file: how good the model is, where, why, whether it can be trusted, and what to do next. Rows of --data
    that were used in the fit are left out.
    """
    check_outputs({"-o": output}, {"MODEL": model} | ({} if data is None else {"--data": data}))
    from diffeo_calib.cli.commands import report  # noqa: PLC0415
    from diffeo_calib.cli.tables import positions as tables  # noqa: PLC0415

    if data is None:
        if not (position is None and length is None and angle is None and against is None):
            what = "--position, --length, --angle and --against belong to a table"
            raise InputError.of(what, fix="name the table with --data, or leave them out")
        report.run(model, None, output, title, [])
        return
    if position is None or length is None or angle is None:
        raise InputError.of(f"--data {data}", expected="--position, --length and --angle too")
    table = tables.table_format(length, angle, sep, decimal, joint_length)
    table = tables.with_rotation(table, rotation, convention, rotation_angle, lever, camera_on_tool=camera_on_tool)
    table = tables.with_columns(table, std, rotation_std, payload)
    report.run(model, tables.MeasuredTable(data, joints, position, table), output, title, against or [])
