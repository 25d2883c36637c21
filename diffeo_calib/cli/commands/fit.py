"""`diffeo-calib fit`: calibrate, show errors, write the model; `demo`: an arm for it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import typer

from diffeo_calib.calibration.calibrate import CalibrationResult, calibrate
from diffeo_calib.calibration.diagnostics.judged_rows import Outlier, check_errors, contradicted, outlier_lines
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.result import CALIBRATED, GEOMETRIC
from diffeo_calib.calibration.scales.leave_one_out import motions
from diffeo_calib.cli import console, models
from diffeo_calib.cli.declarations import DemoOptions, FitOptions
from diffeo_calib.cli.main import app
from diffeo_calib.cli.tables import measured_table
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.evaluation import positions_of
from diffeo_calib.kinematics.hand_eye import HandEye, hand_eye_sentences
from diffeo_calib.measurements.bodies import placement_lines
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.report import write_report
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.sensors.errors import ERRORS, Evaluation
from diffeo_calib.sensors.kinds import divided

EXIT_UNCONVERGED = 3
LARGE_SHARE = 0.5  # of the expected error, from which the robot's size is said to be worth measuring
FLATTERED, ROWS_EACH = 2.0, 3
"""Times the held-out error that is expected elsewhere, and poses of a motion, from which held-out rows flatter."""

Errors = dict[str, dict[str, Evaluation]]  # errors by the kind of rows and by stage


def run(given: FitOptions) -> None:
    """Calibrate with the rows that are not held out, write the model, and end with the exit code of the fit."""
    source = measured_table(given.csv, given, given.duplicates)
    with console.progress_bar() as progress:
        chain = models.robot_of(given, source)
        others = [models.load_kinematics(path) for path in given.scales_of or ()]
        data = source.read(chain, given.tip or chain.tips)
        try:
            train, test = data.split(1.0 - given.holdout, given.seed) if given.holdout else (data, None)
        except MeasurementError:
            for positions in filter(None, divided(data)[:1]):
                refuse_mistakes(chain, positions.table)  # in a wrong unit all rows are one configuration
            raise
        how = {"controls": given.controls or "auto", "seed": given.seed, "note": given.note, "scales_of": others}
        result = calibrate(chain, train, **how, progress=console.interrupts.watching(progress, console.err.print))
        result = replace(result, model=models.made_by_command(result.model, source))
    hand_eye = HandEye.of_fit(result.model)
    save(result.model, given.output)  # before anything is printed: output may be cut off
    in_train, held_out = result.errors(train), {} if test is None else result.errors(test)
    each = {name: solved.entry() for name, solved in hand_eye.items()}
    if each:
        console.record.add(**({"hand_eyes": each} if len(each) > 1 else {"hand_eye": each.popitem()[1]}))
    _record(result, in_train, held_out, given)
    judged = _of_positions(held_out)
    console.say(*_verdict(result, judged, data), *(() if test is None else train.place_lines(test)))
    _show_errors(result, in_train, None if test is None else held_out)
    waves, outliers = (wave.sentence for wave in result.gear_lines), outlier_lines(result.outliers, len(train))
    console.say(*waves, *outliers, result.status)
    wrong: Sequence[Outlier] = ()
    if test is not None:
        measured = positions_of(result.model, result.places(), test)
        wrong = [] if measured is None else contradicted(result.model, measured)
        console.say(*outlier_lines(wrong, len(test), "held-out rows"))
    console.say(*_lines_about_places(result, data, held_out, hand_eye))
    console.say(*_advice(judged, wrong=bool(wrong), partial=result.partial), f"model: {given.output}")
    if given.report is not None:
        with console.progress_bar() as progress:
            how = {"stages": result.stages, "places": {stage: result.places(stage) for stage in result.stages}}
            shown = train if test is None else test
            write_report(result.model, given.report, shown, **how, warnings=console.record.warnings, progress=progress)
        console.say(f"report: {given.report} (open it in a browser)")
    _end(result, in_train, held_out or in_train)


def _of_positions(errors: Errors) -> list[dict[str, Evaluation]]:
    """Errors of measured positions by stage, in a list; an empty one without any."""
    return [stages for stages in errors.values() if stages[CALIBRATED].what == ERRORS]


def _verdict(result: CalibrationResult, judged: list[Any], data: Any) -> Iterator[str]:
    """How accurate the robot is now, first of all: by measured positions, or by what the model expects."""
    for stage in judged:
        geometry, model = stage[GEOMETRIC], stage[CALIBRATED]
        rms, most, before = (f"{1e3 * value:.3f}" for value in (model.rms, model.p95, geometry.rms))
        yield f"held out: {rms} mm RMS, 95 % below {most} ({model.count} rows; geometry alone {before} mm RMS)"
        groups, expected = data.groups(), result.expected.workspace
        count = int(motions(data.q, groups).max()) + 1
        if expected > FLATTERED * model.rms and ROWS_EACH * count <= int(groups.max()) + 1:
            words = f"these lie along {count} motions, beside fitted rows"
            yield f"{words}: over the joint ranges expect {1e3 * expected:.3f} mm RMS"
    if not judged:
        yield models.stage_line(result.model, result.stages, result.expected)


def _end(result: CalibrationResult, in_train: Errors, judged: Errors) -> None:
    """Exit with the code of the fit, or with errors of ``judged`` rows that no calibrated robot has."""
    if result.interrupted or console.interrupts.asked:
        raise typer.Exit(console.EXIT_INTERRUPTED)
    for stages, fitted in zip(_of_positions(judged), _of_positions(in_train), strict=False):
        check_errors(result.model, stages[CALIBRATED], fitted[GEOMETRIC].median)
    if not result.fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def _lines_about_places(
    result: CalibrationResult, data: Any, held_out: Errors, hand_eye: dict[str, HandEye]
) -> Iterator[str]:
    """Hidden markers, and where devices, base and markers, or camera and board, were found."""
    placed = result.placed
    placement = list(hand_eye_sentences(hand_eye)) or list(
        placement_lines(result.model.geometry, poses=placed.lever is not None, ball=placed.ball)
    )
    for stages in held_out.values():
        yield from models.socket_lines(stages[CALIBRATED], "held out")
    positions, _ = divided(data)
    if positions is not None:
        measured = positions.table
        hidden = zip(measured.body_names, (~measured.seen_bodies).sum(0).tolist(), strict=True)
        if counts := [f"{name} in {count}" for name, count in hidden if count]:
            yield f"hidden in some of {len(measured)} rows: {few(counts)} of them"
    yield from (*result.placement.sentences(), *map(str, result.lengths[:1]))
    if (mass := result.model.payload) is not None:
        yield f"the model carries a payload of {mass:g}, the median of the rows, until it is told another"
    if _of_positions(held_out):  # else they are the verdict
        yield models.stage_line(result.model, result.stages, result.expected)
    yield from models.expectation_lines(result.model, data, result.expected)
    advice = next(filter(None, (device.size_advice for device in result.placement)), None)
    share, whole = result.expected.size_share, 1e3 * result.expected.workspace
    if advice is not None and share > LARGE_SHARE:
        yield f"  {share * whole:.3f} mm of it is the robot's size: {advice}"
    yield from placement[1:] if placed.free else placement  # without a device the robot's base is the measuring frame


def _record(result: CalibrationResult, in_train: Errors, held_out: Errors, given: FitOptions) -> None:
    both = {"training": in_train, "held_out": held_out}
    kinds = {kind: {rows: errors[kind] for rows, errors in both.items() if kind in errors} for kind in in_train}
    files = {"model": given.output, "report": given.report}
    console.record.add(
        **result.placement.entry(),
        **console.entries_by_kind(kinds),
        lengths={length.cause.name: [length.value, length.deviation] for length in result.lengths},
        leave_one_out={kind: console.kind_entry(left) for kind, left in result.left_out.items()},
        leave_one_out_rms_m=result.left_out.positions_rms,
        parts=[{"name": p.name, "displacement_m": p.displacement, "angle_rad_or_m": p.angle} for p in result.parts],
        outliers=[
            {"row": row.number, "marker": row.marker, "reason": row.reason}
            | dict(zip(("distance", "unit"), row.shown, strict=True))
            for row in result.outliers
        ],
        base=result.model.geometry.base,
        markers_m=result.model.geometry.tool,
        converged=result.fit.converged,
        status=result.status,
        files={name: path for name, path in files.items() if path is not None},
    )


def _show_errors(result: CalibrationResult, in_train: Errors, held_out: Errors | None) -> None:
    fitted = "was held out: these are errors on rows that were fitted"
    none = [f"no row {fitted}, those of new rows are larger (leave-one-out RMS: {result.left_out.rms_text})"]
    for kind, stages in in_train.items():
        other, rows = (held_out or {}).get(kind), dict[tuple[str, ...], Evaluation]()
        for name, errors in stages.items():
            rows[name, f"{errors.count} training"] = errors
            if other is not None:
                rows[name, f"{other[name].count} held out"] = other[name]
        console.out.print(models.ErrorTable(rows, "by stage", "stage", "rows"))
        console.say(*none if held_out is None else [f"no row of this kind {fitted}"] * (other is None))
        none = []


def _advice(judged: list[Any], *, wrong: bool, partial: bool) -> Iterator[str]:
    if partial:
        yield "these errors are of all rows, also of those for which the model does not hold: see the warning"
        return
    for stage in judged:
        geometry, model = stage[GEOMETRIC], stage[CALIBRATED]
        if wrong:
            median = f"the median is {1e3 * model.median:.4f} mm, with geometry alone {1e3 * geometry.median:.4f} mm"
            yield f"the rows that look wrong dominate the held-out RMS: repair or remove them; {median}"
        if model.rms >= geometry.rms and not (wrong and model.median < geometry.median):
            yield "the deformation does not improve on geometry for the held-out rows: measure more poses"


POSITION = ("measurement_x", "measurement_y", "measurement_z")


def run_demo(given: DemoOptions) -> None:
    """Write an arm and its measurements, and calibrate it by a command that is printed."""
    console.make_folder(folder := given.output)
    arm = SimulatedArm(seed=given.seed)
    urdf, csv = folder / "arm.urdf", folder / "measurements.csv"
    arm.write_urdf(urdf)
    data = Measurements(*arm.measure(given.count, seed=given.seed), arm.nominal.joint_names)
    write_measurements(csv, data, TableFormat("mm", "deg"), position=POSITION)
    lines = [
        ["fit", csv, "--robot", urdf, "--base", arm.nominal.base, "--tip", arm.nominal.tip],
        ["--position", ",".join(POSITION), "--length", "mm", "--angle", "deg"],
        ["-o", folder / "model.safetensors", "--report", folder / "report.html"],
    ]
    command = [list(map(str, line)) for line in lines]
    console.say(f"{given.count} simulated measurements written to {csv}. Now running:\n")
    console.say("  diffeo-calib " + " \\\n      ".join(map(shlex.join, command)) + "\n")
    app([word for line in command for word in line])
