"""`diffeo-calib fit`: calibrate, show the errors of every stage, write the model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer

from diffeo_calib.calibration.calibrate import CalibrationResult, calibrate
from diffeo_calib.calibration.contradicted_in_sockets import contradicted_in_sockets
from diffeo_calib.calibration.contradicted_rows import contradicted
from diffeo_calib.calibration.findings import Outlier
from diffeo_calib.calibration.stage_errors import KindErrors, errors_by_kind
from diffeo_calib.cli.console import err, exit_on_interrupt, out, progress_bar, say
from diffeo_calib.cli.error_tables import add_errors, error_table, outlier_lines, parts_table, placement_lines
from diffeo_calib.cli.interrupts import EXIT_INTERRUPTED, interrupts
from diffeo_calib.cli.models import made_by_command
from diffeo_calib.cli.record import errors_entry, record
from diffeo_calib.cli.tables.measured import measured_table
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.cli.tables.readings import reading_entry
from diffeo_calib.cli.tables.sockets import expectation_lines, socket_lines, stage_line
from diffeo_calib.common.errors import printable
from diffeo_calib.common.files import write_figure
from diffeo_calib.common.hidden_values import known
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.kinematics.hand_eye import HandEye
from diffeo_calib.measurements.visibility import hidden_lines
from diffeo_calib.reports.analysis.stages import CALIBRATED, GEOMETRIC, NOMINAL, Kinematics
from diffeo_calib.reports.plots.errors import stages
from diffeo_calib.reports.report import write_report
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import load_urdf
from diffeo_calib.sensors.tables import divided

EXIT_UNCONVERGED = 3

Errors = list[KindErrors]
"""Errors of every stage on rows of each kind."""


@dataclass(frozen=True)
class RobotFile:
    """A robot in a URDF.

    Args:
        urdf: the file. base: its first link.
        tips: the last link, or that of every marker. loads: links of other branches whose weight bends the robot.
    """

    urdf: Path
    base: str
    tips: Sequence[str]
    loads: Sequence[str] = ()

    def read(self) -> Tree:
        """Read the file."""
        return load_urdf(self.urdf, self.base, list(dict.fromkeys(self.tips)), self.loads)


@dataclass(frozen=True)
class Outputs:
    """Files to write: the model, a figure of its errors and a report, if they are wanted."""

    model: Path
    figure: Path | None = None
    report: Path | None = None


def inputs(options: Mapping[str, Any]) -> tuple[RobotFile, MeasuredTable]:
    """The robot and the table that the options of `fit` describe."""
    links = options["base"], options["tip"], options["load"] or ()
    return RobotFile(options["robot"], *links), measured_table(options)


def run(
    robot: RobotFile,
    source: MeasuredTable,
    outputs: Outputs,
    *,
    holdout: float,
    seed: int,
    controls: int | None,
    note: str = "",
) -> None:
    """Calibrate with the rows that are not held out, write the model, and end with the exit code of the fit."""
    with exit_on_interrupt(), progress_bar() as progress:
        chain = robot.read()
        data = source.read(chain, robot.tips)
        train, test = data.split(1.0 - holdout, seed) if holdout else (data, None)
        number = "auto" if controls is None else controls
        watched = interrupts.watching(progress, err.print)
        result = calibrate(chain, train, controls=number, seed=seed, progress=watched, note=note)
        result = replace(result, model=made_by_command(result.model))
    hand_eye = HandEye.of(result.model) if placed_camera(result) else None
    save(result.model, outputs.model)  # before anything is printed: output may be cut off
    in_train, held_out = errors_by_kind(result, train), None if test is None else errors_by_kind(result, test)
    record.add(**({} if hand_eye is None else {"hand_eye": hand_eye.entry()}))
    _record(result, in_train, held_out, vars(outputs))
    _show_errors(result, in_train, held_out)
    _show_findings(result, len(train))
    wrong = [] if held_out is None else _contradicted(result.model, held_out)
    for line in outlier_lines(wrong, 0 if test is None else len(test), "held-out rows"):
        say(line)
    for line in _lines_about_places(result, data, held_out, hand_eye):
        say(line)
    for one in held_out or ():
        if one.error:
            _show_verdict(one.stages["geometry"], one.stages["diffeomorphic"], wrong=bool(wrong))
    say(f"model: {outputs.model}")
    _write_pictures(result, outputs, source.csv.name, held_out or in_train, "training" if test is None else "held-out")
    if result.interrupted or interrupts.asked:
        raise typer.Exit(EXIT_INTERRUPTED)
    if not result.fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def placed_camera(result: CalibrationResult) -> bool:
    """Whether the rows are poses of a board that a camera on the tool saw."""
    own = result.placed.coordinates
    return own is not None and own.table.board is not None


def _contradicted(model: CalibratedKinematics, errors: list[KindErrors]) -> list[Outlier]:
    """Rows of any kind that took no part in the fit and that look wrong, the worst first."""
    found: list[Outlier] = []
    for one in errors:
        found += contradicted(model, one.rows) if one.error else []
        found += contradicted_in_sockets(model, one.rows) if one.rows.places is not None else []
    return sorted(found, key=lambda outlier: -outlier.distance)


def _lines_about_places(
    result: CalibrationResult, data: Any, held_out: Errors | None, hand_eye: HandEye | None
) -> Iterator[str]:
    """What was hidden, and where devices, base and markers, or camera and board, were found."""
    placed = result.placed
    several = placed.ball and result.model.markers > 1
    placement = list(placement_lines(result.model.geometry, poses=placed.lever is not None, ball=placed.ball))
    placement = placement if hand_eye is None else list(hand_eye.sentences())
    for one in held_out or ():
        yield from socket_lines(one.stages["diffeomorphic"], "held out")
    own, _ = divided(data)
    if own is not None and not placed.free:
        yield from hidden_lines(own.table.device_rows())
    yield from result.placement.sentences()
    if placed.ball:
        yield from [stage_line(result.model, result.stages)]
        yield from [] if several else expectation_lines(result.model)
    yield from placement[1:] if placed.free else placement  # without a device the robot's base is the measuring frame


def _write_pictures(result: CalibrationResult, outputs: Outputs, name: str, errors: Errors, rows: str) -> None:
    """Draw the figure and write the report, if they are wanted.

    Args:
        name: of the table. errors: of each stage on the rows to show. rows: what these are.
    """
    if outputs.figure is not None:
        shown = f"{sum(len(one.rows) for one in errors)} {rows} rows"
        shown += ", no row was held out" * (rows == "training")
        write_figure(stages(errors[0].stages, f"{printable(name)}: errors on {shown}"), outputs.figure)
        say(f"figure: {outputs.figure}")
    if outputs.report is not None:
        with progress_bar() as progress:
            stages_of_fit = _report_stages(result)
            data = errors[0].rows
            write_report(result.model, outputs.report, data, title=name, stages=stages_of_fit, progress=progress)
        say(f"report: {outputs.report} (open it in a browser)")


def _record(
    result: CalibrationResult, in_train: Errors, held_out: Errors | None, files: Mapping[str, Path | None]
) -> None:
    """Add the results for programs."""
    both = {"training": in_train} | ({} if held_out is None else {"held_out": held_out})
    metres = {rows: [one for one in found if one.per_unit != 1.0] for rows, found in both.items()}
    others = {rows: [one for one in found if one.per_unit == 1.0] for rows, found in both.items()}
    record.add(**result.placement.entry())
    record.add(
        errors={
            rows: {name: errors_entry(errors) for one in found for name, errors in one.stages.items()}
            for rows, found in metres.items()
        },
        reading_errors={
            rows: {one.rows.kind: {name: reading_entry(e, one.unit) for name, e in one.stages.items()} for one in found}
            for rows, found in others.items()
        },
        expected_error=result.expected.entry(),
        leave_one_out_rms_m=result.left_out_rms,
        parts=[{"name": p.name, "displacement_m": p.displacement, "angle_rad_or_m": p.angle} for p in result.parts],
        outliers=[
            {"row": one.number, "marker": one.marker, "distance_m": one.distance, "reason": one.reason}
            for one in result.outliers
        ],
        base=result.model.geometry.base,
        markers_m=result.model.geometry.tool,
        converged=result.fit.converged,
        status=result.status,
        files={name: path for name, path in files.items() if path is not None},
    )


def _report_stages(result: CalibrationResult) -> dict[str, Kinematics]:
    """The stages of a calibration under the names of reports."""
    return dict(zip((NOMINAL, GEOMETRIC, CALIBRATED), result.stages.values(), strict=True))


def _show_errors(result: CalibrationResult, in_train: Errors, held_out: Errors | None) -> None:
    """Print the errors of every stage on the training rows and on the held-out rows, if any, kind by kind."""
    for place, one in enumerate(in_train):
        with_angles = next(iter(one.stages.values())).angles is not None
        table = error_table(f"{one.what} in {one.unit} by stage", "stage", "rows", angles=with_angles)
        for name, errors in one.stages.items():
            add_errors(table, errors, name, f"{errors.count} training", per_unit=one.per_unit)
            for other in [] if held_out is None else [that for that in held_out if that.what == one.what]:
                new = other.stages[name]
                add_errors(table, new, name, f"{new.count} held out", per_unit=one.per_unit)
        out.print(table)
        if held_out is None and place == 0:
            left_out = 1e3 * result.left_out_rms
            estimate = f" (leave-one-out RMS {left_out:.4f} mm)" * (one.error and not with_angles)
            new = "poses" if one.error else "rows"
            what = f"these are errors on rows that were fitted, those of new {new} are larger{estimate}"
            say(f"no row was held out: {what}")


def _show_verdict(geometry: Evaluation, model: Evaluation, *, wrong: bool) -> None:
    """Say what the errors on held-out rows mean where rows are wrong, or the model no better than geometry."""
    if wrong:
        median = f"the median is {1e3 * model.median:.4f} mm, with geometry alone {1e3 * geometry.median:.4f} mm"
        say(f"the rows that look wrong dominate the held-out RMS: repair or remove them; {median}")
    if model.rms < geometry.rms or (wrong and model.median < geometry.median):
        return
    if model.median < geometry.median:
        say("most held-out rows improve on geometry, but a few are far off: these rows are probably wrong")
    else:
        say("the deformation does not improve on geometry for the held-out rows: measure more poses")


def _show_findings(result: CalibrationResult, rows: int) -> None:
    """Print what each part explains, the rows that look wrong, and how the fit ended."""
    out.print(parts_table(result.parts))
    for wave in result.gear_lines:
        say(wave.sentence)
    for line in outlier_lines(result.outliers, rows):
        say(line)
    left_out, fitted = result.leave_one_out, result.fit
    if left_out.effective is not None:
        say(f"effective number of parameters: {left_out.effective:.0f} of {len(known(left_out.errors))} coordinates")
    say(result.status)
    say(
        f"coupling residual {fitted.coupling_residual:.1e}, end residual {fitted.end_residual:.1e}, "
        f"time-stepping error {1e3 * fitted.step_error:.1e} mm with {fitted.integrator.intervals} step(s)"
    )
