"""The commands of a robot that is measured again: recalibrate, compare. Each imports its work when it runs."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import readings as reading_options
from diffeo_calib.cli.options import recalibrate as again
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import robot as robot_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.options import sockets as socket_options
from diffeo_calib.cli.places import check_outputs
from diffeo_calib.common.errors import InputError


@app.command("recalibrate")
def recalibrate_command(
    old: again.OldModel,
    csv: options.CsvPath,
    length: options.LengthOption,
    angle: options.AngleOption,
    output: options.ModelOutput,
    position: socket_options.Position = None,
    socket: socket_options.Socket = None,
    distance: socket_options.Distance = None,
    distance_std: socket_options.DistanceStd = None,
    reading: reading_options.Reading = None,
    session: robot_options.Session = None,
    payload: robot_options.Payload = None,
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
    marker: again.MarkerOption = again.MarkerFreedom.evidence,
    drift: again.DriftOption = again.Drift.tested,
    seed: options.Seed = 0,
    note: options.Note = "",
    _json: report_options.Json = None,
) -> None:
    """Calibrate a robot anew, starting from an old model.

    The measuring device may stand anywhere. Twenty rows do what about a hundred do without the old model. Says where
    device and markers are now and what has changed in the robot, and writes a model that knows old rows and new ones.
    """
    given = locals()
    check_outputs({"-o": output}, {"OLD": old, "CSV": csv})
    from diffeo_calib.cli.commands import recalibrate  # noqa: PLC0415
    from diffeo_calib.cli.tables.measured import measured_table  # noqa: PLC0415

    source = measured_table(given)
    recalibrate.run(old, source, output, recalibrate.Options(marker.value, drift.value, seed, note))


@app.command("compare")
def compare_command(
    old: again.OldModel,
    other: again.Compared,
    position: again.ComparedPosition = None,
    socket: socket_options.Socket = None,
    distance: socket_options.Distance = None,
    distance_std: socket_options.DistanceStd = None,
    reading: reading_options.Reading = None,
    session: robot_options.Session = None,
    payload: robot_options.Payload = None,
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
    marker: again.MarkerOption = again.MarkerFreedom.evidence,
    level: again.Level = 0.01,
    seed: options.Seed = 0,
    figure: again.ComparisonFigure = None,
    _json: report_options.Json = None,
) -> None:
    """Say what has changed since a calibration.

    With a table: a test for every joint, the load and the geometry. With a model: how far the two differ over the joint
    ranges that both know, beside what their uncertainties explain.
    """
    given = locals() | {"csv": other}
    check_outputs({"--figure": figure}, {"OLD": old, "OTHER": other})
    from diffeo_calib.cli.commands import compare  # noqa: PLC0415
    from diffeo_calib.cli.tables.measured import measured_table  # noqa: PLC0415

    if position is None and socket is None and reading is None:
        _check_model(other, units=not (length is None and angle is None))
        compare.run_models(old, other, seed, figure)
        return
    if length is None or angle is None or figure is not None:
        raise InputError.of("a table of measurements", expected="--position, --length and --angle, no --figure")
    compare.run(old, measured_table(given), marker.value, level, seed)


def _check_model(other: Path, *, units: bool) -> None:
    """Raise InputError for options of a table, or for a table, where a model file is expected."""
    if units:
        fix = "name the columns of the positions too, or --socket or --reading"
        raise InputError.of("--length and --angle without --position", fix=fix)
    if other.suffix.lower() in (".csv", ".txt"):
        raise InputError.of(f"{other} is a table of measurements", expected="--position, --length and --angle too")
