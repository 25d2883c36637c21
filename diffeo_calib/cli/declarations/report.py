"""The command that writes reports. It imports its work when it runs."""

from __future__ import annotations

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import readings as reading_options
from diffeo_calib.cli.options import recalibrate as again
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import robot as robot_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.options import sockets as socket_options
from diffeo_calib.cli.places import check_outputs
from diffeo_calib.common.errors import InputError


@app.command("report")
def report_command(
    model: options.ModelPath,
    output: report_options.ReportOutput,
    data: report_options.ShownTable = None,
    position: again.ComparedPosition = None,
    socket: socket_options.Socket = None,
    distance: socket_options.Distance = None,
    distance_std: socket_options.DistanceStd = None,
    reading: reading_options.Reading = None,
    session: robot_options.Session = None,
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

    if data is None and not all(value is None for value in (position, socket, reading, length, angle, against)):
        what = "--position, --socket, --reading, --length, --angle and --against belong to a table"
        raise InputError.of(what, fix="name the table with --data, or leave them out")
    if data is not None and (length is None or angle is None or not (position or socket or reading)):
        raise InputError.of(f"--data {data}", expected="--position, --length and --angle too")
    report.run(locals())
