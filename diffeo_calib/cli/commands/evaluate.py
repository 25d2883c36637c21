"""`diffeo-calib evaluate`: errors of a model, as tables or a page; `predict`: markers or poses for joint values."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import torch
import typer
from torch import Tensor

from diffeo_calib.calibration.diagnostics.judged_rows import evaluate, expected_rms, judge, outlier_lines
from diffeo_calib.calibration.expected_errors import accuracy
from diffeo_calib.cli import models
from diffeo_calib.cli.console import entries_by_kind, out, plain, progress_bar, record, say
from diffeo_calib.cli.declarations import EvaluateOptions, PredictOptions
from diffeo_calib.cli.options import Rows, Units
from diffeo_calib.cli.tables import MeasuredTable, as_written, of_robot, table_format, with_rows
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, warn_user
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics import evaluation
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.device_readings import PredictedReadings
from diffeo_calib.kinematics.evaluation import refuse_other_angles, repeated_lines, warn_outside_range
from diffeo_calib.kinematics.hand_eye import IN_TIP, HandEye
from diffeo_calib.measurements.csv.cells import number
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.files import Predictions, read_configurations, write_predictions
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import BESIDE, TableFormat, options_of
from diffeo_calib.sensors.errors import READINGS, SPREAD, Evaluation, Evaluations
from diffeo_calib.sensors.set_ups import SESSION

COLUMNS = ("line", "used_in_fit", "kind", "device", "marker", "dx", "dy", "dz", "size", "unit")


def run(options: EvaluateOptions) -> None:
    """Run the command."""
    if options.output is not None and options.output.suffix == ".safetensors" and not options.free:
        fix, got = "name --free too to write the registered model", str(options.output)
        raise InputError.of("-o without --free", expected="a table of errors", got=got, fix=fix)
    model = models.load_kinematics(options.model)
    if options.report is not None:
        return _reported(model, options.report, options)
    if options.csv is None:
        fix = "name it, or write a page about the rows of the fit by --report"
        raise InputError.of("the table of measurements", expected="CSV", got="none", fix=fix)
    source = models.table_of(model, options.csv, options)
    limit = models.parsed_limit(options.tolerance)
    models.check_payload_column(model, source.table.payload)
    say(*models.provenance_lines(model))
    data = source.read(model.robot)
    say(*repeated_lines(model, data.q))
    if options.free is not None:
        return _registered(model, data, options)
    evaluation.check_rows(model, data)
    places = evaluation.place(model, data, every_session=source.table.session is not None)
    by_kind, used = evaluation.residuals(model, places, data), evaluation.rows_used_in_fit(model, data.q)
    judged = judge(model, places, data, by_kind)
    _show(model, by_kind, used, evaluation.positions_of(model, places, data), options.model.name)
    if options.output is not None:
        write_rows(options.output, COLUMNS, [list(_residuals(by_kind, used, source))], source.table)
        record.add(files={"residuals": options.output})
        say(f"residuals: {options.output}")
    if SESSION in places.devices:
        record.add(session_transforms=places.devices[SESSION].entry())
    if places.numbers:
        record.add(found_from_rows={"numbers": places.numbers, "sentences": list(places.found)})
    say(*map(plain, places.found))
    say(*(line for errors in by_kind.values() for line in models.socket_lines(errors, "all rows")))
    say(*models.expectation_lines(model, data))
    warn_outside_range(model, data.q)
    source.warn_of_other_frames(evaluation.rows_of_other_frames(model, data.q))
    if judged.refusal is not None:
        raise MeasurementError(judged.refusal)
    positions = 0 if by_kind.positions is None else len(by_kind.positions.errors)
    which = "rows" if judged.rows == positions else f"rows, evenly chosen of {positions},"
    say(*outlier_lines(judged.outliers, judged.rows, which))
    for text in judged.causes:
        warn_user(text)
    if limit is not None:
        new, which = (by_kind, "") if bool(used.all()) else (by_kind.rows(~used), " not used in the fit")
        models.accept(accuracy(model, new.values(), limit.unit, which=which), limit)


def _show(model: CalibratedKinematics, kinds: Evaluations, used: Tensor, data: Measurements | None, name: str) -> None:
    named = dict[str, dict[str, Any]]()
    for kind, errors in kinds.items():
        fitted, positions = used[kinds.index[kind]], errors is kinds.positions
        of_rows = {"in all": errors}
        if fitted.any() and not fitted.all():
            of_rows |= {"used in the fit": errors.rows(fitted), "not used in the fit": errors.rows(~fitted)}
        of_devices, what = dict[str, Evaluation](), "session" if positions else "device"
        present = [sensor for sensor in dict.fromkeys(errors.devices) if sensor and errors.what != SPREAD]
        if errors.what != READINGS or len(present) > 1:
            for sensor in present:  # sockets have no errors of their own
                mask = torch.tensor([device == sensor for device in errors.devices], dtype=torch.bool, device=HOST)
                of_devices[sensor] = errors.rows(mask)
        expected = expected_rms(model, data, errors.errors.shape[1]) if positions and data is not None else None
        labels = of_rows | {f"of {what} '{plain(device)}'": some for device, some in of_devices.items()}
        rows = {(f"{some.count} {label}",): some for label, some in labels.items()}
        out.print(models.ErrorTable(rows, f"of {plain(name)}", "rows", expected=expected))
        entries = {label.replace("in all", "all").replace(" ", "_"): some for label, some in of_rows.items()}
        named[kind] = entries | ({f"in_{what}s": of_devices} if of_devices else {})
    record.add(files={}, **entries_by_kind(named))


def _residuals(by_kind: Evaluations, used: Tensor, source: MeasuredTable) -> Iterator[list[float | str]]:
    for entry in by_kind.lines():
        metres = entry["unit"] == "mm"
        values = [entry[name] * (source.table.per_metre / 1e3 if metres else 1.0) for name in COLUMNS[5:9]]
        cells = entry["line"], int(used[entry["row"]]), entry["kind"], entry["device"], entry["marker"]
        yield [*cells, *values, source.table.length if metres else entry["unit"]]


def _registered(model: CalibratedKinematics, data: Any, options: EvaluateOptions) -> None:
    output = options.output
    warn_outside_range(model, data.q)
    say(*models.another_date_lines(model))
    registered = model.registered(data, free=options.free or "both", learn=False)
    if output is not None:
        save(registered, output)  # before anything is printed: output may be cut off
    errors = evaluate(registered, data)
    kinds = errors if isinstance(errors, Evaluations) else {errors.kind: errors}
    record.add(files={} if output is None else {"model": output})
    record.add(**entries_by_kind({kind: {"after": after} for kind, after in kinds.items()}))
    has_before = registered.registration is not None and registered.registration.rms_before is not None
    before = evaluation.residuals(model, evaluation.place(model, data), data) if has_before else None
    for kind, after in kinds.items():
        rows = {} if before is None else {(f"{after.count} with the places of the fit",): before[kind]}
        rows |= {(f"{after.count} with places found anew",): after}
        out.print(models.ErrorTable(rows, f"of {plain(options.model.name)}", "rows"))
    say(*map(plain, (*models.registration_lines(registered), *evaluation.placement_sentences(registered))))
    if output is not None:
        say(f"registered model: {output}")


def _reported(model: CalibratedKinematics, page: Path, options: EvaluateOptions) -> None:
    from diffeo_calib.reports.html.sections import advice, verdict  # noqa: PLC0415  # slow to import, they draw
    from diffeo_calib.reports.report import write_report  # noqa: PLC0415

    data, tolerance = None, models.parsed_length(options.tolerance)
    if options.csv is not None:
        data = models.table_of(model, options.csv, options).read(model.robot)
    if tolerance is not None and data is not None and not bool(evaluation.unseen(model, data.q).any()):
        expected, fix = "rows that took no part in fit and registration", "measure more rows, or leave the table out"
        raise InputError.of("rows to hold against --tolerance", expected=expected, got=f"{len(data)} that did", fix=fix)
    with progress_bar() as progress:
        against = options.against or []
        findings = write_report(model, page, data, against=against, tolerance=tolerance, progress=progress)
    say(*models.provenance_lines(model))
    words, stages = verdict(findings, tolerance), dict(findings.expected)
    kinds = {kind: rows.stages for kind, rows in findings.kinds.items()}
    record.add(**entries_by_kind(kinds), expected_error_by_stage_m=stages, left_out=not findings.new)
    record.add(verdict=words, advice=list(advice(findings)), files={"report": page})
    if findings.predictions is not None:
        record.add(coverage_95=findings.predictions.coverage())
    if data is not None and not findings.new:
        each = "as fitted" if not findings.errors else "each predicted by all others"
        say(f"all rows of the table were used before: the rows of the fit are shown, {each}")
    say(words, *models.expectation_lines(model, None, findings.deviations.error), f"report: {page}")
    if tolerance is not None and findings.judged.value > tolerance:
        raise typer.Exit(models.EXIT_ABOVE)


# --- predictions

ROWS_AT_ONCE = 2048
"""A multiple of the rows that predictions linearise together: blocks do not change their last digits."""
OWN_FRAME = (
    "no device measured positions: they are in the model's own frame, and 95 % regions hold true points only after one "
    "rigid motion of all of them; `evaluate --free both` with measured positions finds it"
)


def run_predict(given: PredictOptions) -> None:
    """Read joint values, and write them with predictions and their standard deviations, block by block.

    A payload that is a number is the mass of all rows.
    """
    kinematics, output = models.load_kinematics(given.model), given.output
    say(*models.provenance_lines(kinematics))
    units = {name: getattr(given, name) for name in Units.names()}
    typed = Rows(**units, convention=given.convention, rotation_angle=given.rotation_angle, payload=given.payload)
    read = models.as_fitted(kinematics, typed, given.csv)
    layout = typed if given.length and given.angle else read  # the predictions are by default written as the rows were
    rows = Rows(convention=layout.convention, rotation_angle=layout.rotation_angle, payload=layout.payload)
    table = of_robot(with_rows(table_format(read), rows), kinematics.robot)
    with_poses = kinematics.lever is not None
    if not with_poses and (table.convention or table.rotation_angle):
        what = "--convention and --rotation-angle say how orientations are written, but this model has none"
        raise InputError.of(what, fix="leave them out, or calibrate with measured poses")
    mass = number(given.payload or "", ".")  # what the model's fit named is a column
    if mass is not None and isfinite(mass):
        kinematics, table = kinematics.with_payload(mass), replace(table, payload=None)
    else:
        models.check_payload_column(kinematics, table.payload)
    prefixes, written = kinematics.bodies.prefixes(kinematics), as_written(table)
    added = {f"{prefix}{axis}" for prefix in prefixes for axis in "xyz"}
    if added & {*Columns.of(written.joints_only()).names}:  # commanded places have these names
        prefixes = tuple(f"predicted_{prefix}" for prefix in prefixes)
    readings = _Readings(table, kinematics.predict_readings(kinematics.configurations[:1]))
    values = read_configurations(given.csv, table)
    q, masses = values["q"], values.get("payload")
    refuse_other_angles(kinematics, q)
    warn_outside_range(kinematics, q)

    def blocks() -> Iterator[Predictions]:
        for first in range(0, len(q), ROWS_AT_ONCE):
            progress("rows", first, len(q))
            block = slice(first, first + ROWS_AT_ONCE)
            model = kinematics if masses is None else kinematics.at_payloads(masses[block])
            mean, covariance = model.bodies.written(model, q[block])
            deviations = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
            yield q[block], mean, deviations, readings.cells(model, q[block])

    with progress_bar() as progress:
        write_predictions(output, blocks(), written, prefixes=prefixes, more=readings.names, poses=with_poses)
    record.add(rows=len(q), files={"table": output})
    what, eye = "poses" if with_poses else "positions", next(iter(HandEye.of_fit(kinematics).values()), None)
    say(f"{len(q)} predictions written to {output}: joints, {what} and standard deviations of a new measurement")
    if eye is not None:
        on_tool, stands = ("camera", "board") if eye.camera.key == IN_TIP else ("board", "camera")
        say(f"the poses are those of the {on_tool} on the tool, in the frame of the {stands} that stands")
    if kinematics.own_frame:
        say(OWN_FRAME)
    say(*readings.sentences())
    if with_poses:
        turned = table.for_writing(rotation_std=False, prefixes=prefixes)
        layout = replace(turned, joints=(), position=[[prefix + axis for axis in "xyz"] for prefix in prefixes])
        layout = replace(layout, rotation_std=None, **dict.fromkeys(BESIDE))
        say(f"`evaluate` and `fit` read these poses with {shlex.join(options_of(layout))}")


@dataclass(frozen=True)
class _Readings:
    """Columns of what ``devices`` will read, and of standard deviations; lengths in the unit of the table."""

    table: TableFormat
    devices: Sequence[PredictedReadings]

    def _unit(self, unit: str) -> tuple[str, float]:
        metres = {"mm": 1e-3, "m": 1.0}.get(unit)
        return (unit, 1.0) if metres is None else (self.table.length, metres * self.table.per_metre)

    @property
    def names(self) -> list[str]:
        """KIND_DEVICE and std_KIND_DEVICE, of several numbers with _1, _2."""
        counts = [(part, range(1, 1 + part.mean.shape[1])) for part in self.devices]
        ends = [(f"{part.kind}_{part.device}", [f"_{k}" if len(ks) > 1 else "" for k in ks]) for part, ks in counts]
        return [f"{std}{name}{end}" for name, each in ends for std in ("", "std_") for end in each]

    def cells(self, model: CalibratedKinematics, q: Tensor) -> Tensor:
        """(B, k) means and standard deviations of every device."""
        parts = [q[:, :0]]
        for reading in model.predict_readings(q) if self.devices else ():
            parts += [self._unit(reading.unit)[1] * values for values in (reading.mean, reading.deviations)]
        return torch.cat(parts, 1)

    def sentences(self) -> Iterator[str]:
        """Meaning of the columns, and the width of 95 % regions."""
        for part in self.devices:
            numbers = part.mean.shape[1]
            widths = f"within {chi2_above(0.05, numbers) ** 0.5:.2f} standard deviations"
            unit = self._unit(part.unit)[0]
            yield f"{part.kind}_{part.device}: what this device will read, in {unit}; 95 % of new readings are {widths}"
