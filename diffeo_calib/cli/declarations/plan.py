"""The command that plans measurements: plan. It imports its work when it runs."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import plan as plan_options
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import robot as robot_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.places import check_outputs
from diffeo_calib.common.errors import InputError


@app.command("plan")
def plan_command(
    count: plan_options.Count,
    length: options.LengthOption,
    angle: options.AngleOption,
    output: plan_options.PlanOutput,
    model: plan_options.PlannedModel = None,
    robot: plan_options.PlannedRobot = None,
    base: plan_options.PlannedBase = None,
    tip: plan_options.PlannedTip = None,
    marker: plan_options.Markers = None,
    candidates: plan_options.CandidatesTable = None,
    draw: plan_options.Draw = None,
    limits: plan_options.Ranges = None,
    tracker: plan_options.TrackerPlace = None,
    facing: plan_options.Facing = None,
    cone: plan_options.Cone = None,
    floor: plan_options.Floor = None,
    column: plan_options.Column = None,
    collisions: plan_options.Collisions = False,
    target: plan_options.TargetTable = None,
    measured: plan_options.MeasuredRows = None,
    free: plan_options.PlannedFree = None,
    seed: plan_options.PlanSeed = 0,
    sensor: plan_options.SensorOption = None,
    payload: robot_options.Mass = None,
    joint_length: options.JointLength = None,
    joints: options.Joints = None,
    sep: options.Sep = ",",
    decimal: options.Decimal = ".",
    _json: report_options.Json = None,
) -> None:
    """Plan which poses to measure, and say how many are needed.

    With --robot the first poses of a calibration, with a MODEL the next ones, and with --free those to measure again
    later. Lengths are in the unit of --length, angles in that of --angle; tables have the columns that `fit` reads.
    """
    inputs = {"MODEL": model, "--robot": robot, "--candidates": candidates, "--target": target, "--measured": measured}
    check_outputs({"-o": output}, {name: path for name, path in inputs.items() if path is not None})
    _check_belonging(model, {"--robot": robot, "--base": base, "--tip": tip, "--marker": marker}, free, payload)
    _check_draw(candidates, draw=draw, range=limits, tracker=tracker, floor=floor, column=column, collisions=collisions)
    from diffeo_calib.cli.commands import plan  # noqa: PLC0415

    rows = plan.Rows.of((length, angle, sep, decimal, joint_length), candidates, target, measured, joints)
    source = plan.Source(model, robot, base or "", tip or [], marker, payload)
    cell = plan.Cell(limits, tracker, facing, cone, floor, column, collisions=collisions)
    plan.run(source, cell, rows, plan.Wanted(output, count, draw or plan_options.DRAWN, seed, free, sensor))


def _check_belonging(model: Path | None, of_robot: dict[str, object], free: object, payload: object) -> None:
    """Either a model, or a robot with its links."""
    given = [name for name, value in of_robot.items() if value is not None]
    if model is not None and given:
        fix = "leave them out: the model knows its robot and its markers"
        raise InputError.of(f"{', '.join(given)} beside a MODEL", fix=fix)
    if model is None:
        missing = [name for name in ("--robot", "--base", "--tip") if of_robot[name] is None]
        if missing:
            expected = "a MODEL, or --robot with --base and --tip"
            raise InputError.of("what to plan for", expected=expected, got=f"no {', '.join(missing)}")
        if payload is not None:
            raise InputError.of("--payload without a MODEL", fix="leave it out: no sag under a payload is known yet")
        if free is not None:
            raise InputError.of("--free without a MODEL", fix="name the model that was fitted before, or leave it out")


def _check_draw(candidates: Path | None, **drawing: object) -> None:
    """Options of random configurations mean nothing beside a table of candidates."""
    given = [f"--{name}" for name, value in drawing.items() if value is not None and value is not False]
    if candidates is not None and given:
        what = f"{', '.join(given)} beside --candidates: these options are about random configurations"
        raise InputError.of(what, fix="leave them out, or leave --candidates out")
