"""`diffeo-calib fit --reading`: calibrate by devices that measure no position."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import typer

from diffeo_calib.calibration.calibrate import calibrate
from diffeo_calib.calibration.findings import parts
from diffeo_calib.calibration.reading_result import ReadingsResult
from diffeo_calib.cli.commands.fit import EXIT_UNCONVERGED, RobotFile
from diffeo_calib.cli.console import err, exit_on_interrupt, out, progress_bar, say
from diffeo_calib.cli.error_tables import parts_table
from diffeo_calib.cli.interrupts import EXIT_INTERRUPTED, interrupts
from diffeo_calib.cli.models import made_by_command
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.cli.tables.readings import (
    add_reading_errors,
    errors_in_unit,
    reading_entry,
    reading_table,
)
from diffeo_calib.cli.tables.sockets import stage_line
from diffeo_calib.common.errors import few
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.measurements.readings import Readings

Errors = dict[str, Evaluation]
"""Stage of the calibration -> its errors in the unit of the readings."""


def run(robot: RobotFile, source: MeasuredTable, output: Path, *, holdout: float, seed: int, note: str = "") -> None:
    """Calibrate with the rows that are not held out, write the model, and end with the exit code of the fit."""
    with exit_on_interrupt(), progress_bar() as progress:
        chain = robot.read()
        data = source.read(chain)
        train, test = data.split(1.0 - holdout, seed) if holdout else (data, None)
        watched = interrupts.watching(progress, err.print)
        result = calibrate(chain, train, seed=seed, progress=watched, note=note)
        result = replace(result, model=made_by_command(result.model))
    save(result.model, output)  # before anything is printed: output may be cut off
    errors = {"training": _errors(result, train)}
    if test is not None:
        errors["held_out"] = _errors(result, test)
    _record(result, errors, data.unit[0], output)
    _show(result, train, errors)
    say(f"model: {output}")
    if result.interrupted or interrupts.asked:
        raise typer.Exit(EXIT_INTERRUPTED)
    if not result.fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def _errors(result: ReadingsResult, data: Readings) -> Errors:
    """Errors of every stage on rows of the devices that it has found."""
    return {
        name: errors_in_unit(devices, data, result.errors(data, name)) for name, (_, devices) in result.stages.items()
    }


def _record(result: ReadingsResult, errors: dict[str, Errors], unit: str, output: Path) -> None:
    """Add the results for programs."""
    record.add(
        reading_errors={
            rows: {name: reading_entry(one, unit) for name, one in its.items()} for rows, its in errors.items()
        },
        devices=result.found.entry(),
        markers_m=result.model.geometry.tool,
        converged=result.fit.converged,
        status=result.status,
        files={"model": output},
    )


def _show(result: ReadingsResult, train: Readings, errors: dict[str, Errors]) -> None:
    """Print errors by stage, what explains how much, outliers, the status, and where the devices are."""
    table = reading_table("by stage", train, "stage", "rows")
    for name in result.stages:
        for rows, its in errors.items():
            add_reading_errors(table, its[name], name, f"{len(its[name].errors)} {rows.replace('_', ' ')}")
    out.print(table)
    if "held_out" not in errors:
        say("no row was held out: these are errors on rows that were fitted, those of new rows are larger")
    out.print(parts_table(parts(result.model)))
    if result.outliers:
        lines = few(train.lines[result.outliers].tolist(), 10)
        say(f"{len(result.outliers)} of {len(train)} training rows look wrong and hardly count: lines {lines}")
    say(result.status)
    for line in result.found.sentences():
        say(line)
    say(stage_line(result.model, {name: kinematics for name, (kinematics, _) in result.stages.items()}))
    ball = ", ".join(f"{1e3 * value:.3f}" for value in result.model.geometry.tool[0].tolist())
    say(f"ball in the frame of '{result.model.robot.tips[0]}': {ball} mm")
