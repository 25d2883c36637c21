"""The commands that make and judge models: fit, evaluate. Each imports its work when it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import readings as reading_options
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import robot as robot_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.options import sockets as socket_options
from diffeo_calib.cli.places import check_outputs
from diffeo_calib.common.errors import InputError


@app.command("fit")
def fit_command(
    csv: options.CsvPath,
    robot: robot_options.Robot,
    base: robot_options.Base,
    tip: robot_options.Tip,
    length: options.LengthOption,
    angle: options.AngleOption,
    output: options.ModelOutput,
    position: socket_options.Position = None,
    socket: socket_options.Socket = None,
    distance: socket_options.Distance = None,
    distance_std: socket_options.DistanceStd = None,
    reading: reading_options.Reading = None,
    load: robot_options.Load = None,
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
    holdout: options.Holdout = 0.3,
    seed: options.Seed = 0,
    controls: options.Controls = None,
    duplicates: options.Duplicates = "error",
    figure: options.Figure = None,
    report: report_options.FitReport = None,
    note: options.Note = "",
    _jobs: options.Jobs = None,
    _json: report_options.Json = None,
) -> None:
    """Calibrate a robot, test it on held-out rows, save the model.

    The model is fitted to the rows that are not held out: its held-out errors are those in the table.
    """
    check_outputs({"-o": output, "--figure": figure, "--report": report}, {"CSV": csv, "--robot": robot})
    from diffeo_calib.cli.commands import fit  # noqa: PLC0415

    fit.run_options(locals())


@app.command("evaluate")
def evaluate_command(
    model: options.ModelPath,
    csv: options.CsvPath,
    length: options.LengthOption,
    angle: options.AngleOption,
    position: socket_options.Position = None,
    socket: socket_options.Socket = None,
    distance: socket_options.Distance = None,
    distance_std: socket_options.DistanceStd = None,
    reading: reading_options.Reading = None,
    session: robot_options.Session = None,
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
    register: options.Register = False,
    free: options.FreeOption = None,
    output: options.RegisteredOutput = None,
    fail_above: options.FailAbove = None,
    residuals: options.Residuals = None,
    _json: report_options.Json = None,
) -> None:
    """Measure the errors of a model on a table of measurements.

    --register first finds where the measuring device and the markers are now, and keeps everything else.
    """
    _check_register(locals())
    check_outputs({"-o": output, "--residuals": residuals}, {"MODEL": model, "CSV": csv})
    from diffeo_calib.cli.commands import evaluate  # noqa: PLC0415

    evaluate.run(locals())


def _check_register(given: Mapping[str, Any]) -> None:
    """Raise InputError for options, by name, that do not go with --register or do so only."""
    if not given["register"] and not (given["free"] is None and given["output"] is None):
        raise InputError.of("--free and -o belong to --register", fix="add --register, or leave them out")
    if given["register"] and not (given["fail_above"] is None and given["residuals"] is None):
        fix = "write the registered model with -o, and evaluate that"
        raise InputError.of("--fail-above and --residuals judge a model where it was fitted", fix=fix)
