"""`diffeo-calib evaluate`: errors of a model, as tables or a page; `predict`: markers or poses for joint values.

`plan`: choose poses, write them, and say what to expect of how many.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite, pi, radians
from pathlib import Path
from typing import Any

import torch
import typer
from torch import Tensor

from diffeo_calib.calibration.diagnostics.judged_rows import evaluate, expected_rms, judge, outlier_lines
from diffeo_calib.calibration.expected_errors import accuracy
from diffeo_calib.calibration.planning.candidates import Tracker, collision_free
from diffeo_calib.calibration.planning.plan import Plan, drawn, plan
from diffeo_calib.calibration.planning.scene import MARKER
from diffeo_calib.calibration.planning.sensors import Sensor, sensors_for
from diffeo_calib.cli import models
from diffeo_calib.cli.console import entries_by_kind, out, plain, progress_bar, record, say, text_table
from diffeo_calib.cli.declarations import EvaluateOptions, PlanOptions, PredictOptions
from diffeo_calib.cli.models import as_fitted, expectation_lines, load_kinematics, load_robot, planned
from diffeo_calib.cli.options import DRAWN, Candidates, Rows, Units
from diffeo_calib.cli.tables import MeasuredTable, as_written, of_robot, stated_numbers, table_format, with_rows
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
from diffeo_calib.measurements.csv.columns import Columns, PoseColumns
from diffeo_calib.measurements.csv.files import Predictions, read_configurations, read_joints, write_predictions
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import BESIDE, TableFormat, options_of
from diffeo_calib.robots.cartesian import SLIDES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.errors import READINGS, SPREAD, Evaluation, Evaluations
from diffeo_calib.sensors.range import UNKNOWN_ZERO_M
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


SENSORS = {
    "distance": Sensor.distances,
    "displacement": partial(Sensor.distances, offset_std=UNKNOWN_ZERO_M),
    "height": Sensor.heights,
    "image": Sensor.images,
    "socket": Sensor.sockets,
}
"""Devices, by the words of --sensor."""
TRACKERS = {"tracker": Sensor.positions, "poses": Sensor.poses}


def sensors_of(words: list[str] | None, table: TableFormat) -> list[Sensor]:
    """The sensors of --sensor; none if it was not given."""
    numbers: dict[str, list[list[float]]] = {}
    sensors = []
    for text in words or ():
        kind, _, values = text.partition("=")
        if text in TRACKERS:
            sensors.append(TRACKERS[text]())
        elif kind in SENSORS and values:
            each = stated_numbers("--sensor", values, (3, 4, 6))
            numbers.setdefault(kind, []).append([x / table.per_metre for x in each])
        else:
            expected = f"{', '.join(TRACKERS)}, or {', '.join(f'{kind}=NUMBERS' for kind in SENSORS)}"
            raise InputError.of(f"--sensor {text}", expected=expected)
    return [*sensors, *(SENSORS[kind](places) for kind, places in numbers.items())]


def run_plan(given: PlanOptions) -> None:
    """Plan, write the poses, and print what to expect of them."""
    count, output, begin = given.count, given.output, given.model or given.robot
    if begin is None:
        raise InputError.of("what to plan for", expected="a MODEL, or --robot", got="neither")
    with progress_bar() as progress:
        model = None if given.model is None else load_kinematics(given.model)
        table = table_format(given if model is None else as_fitted(model, given))
        numbers = [stated_numbers("--marker", text, (3,)) for text in given.marker or ()]
        markers = torch.tensor(numbers or [MARKER], dtype=torch.float64, device=HOST)
        markers = markers / table.per_metre if numbers else markers
        source = model or load_robot(begin, given)
        if model is not None:
            source, markers = planned(model, given.payload)
        robot = source.robot if isinstance(source, CalibratedKinematics) else source
        table = of_robot(table, robot)

        def configurations(table_of: Path | None) -> Tensor | None:
            return None if table_of is None else read_joints(table_of, table)

        sensors = sensors_of(given.sensor, table) or sensors_for(source)
        progress("candidates", 0, 1)
        q = configurations(given.candidates)
        if q is None:
            q = drawn(source, sensors, max(given.draw or DRAWN, count), markers, **_cell(given, robot, table))
        progress("candidates", 1, 1)
        progress("plan", 0, 1)
        framed = model is not None or any(sensor.of_frames for sensor in sensors)
        target, measured = configurations(given.target_poses), configurations(given.measured)
        how: dict[str, Any] = {"marker": None if framed else markers, "free": given.free, "sensor": sensors}
        proposal = plan(source, q, count, target=target, measured=measured, **how)
    proposal.write(output, as_written(table))
    entries = {"expected_rms_m": proposal.expected_rms, "noise_rms_m": proposal.noise_rms, "assumed": proposal.assumed}
    record.add(rows=count, **entries, files={"poses": output})
    _show_expected(
        proposal, of_positions=all(sensor.of_positions for sensor in sensors), free=MOVED.get(given.free or "")
    )
    if isinstance(source, CalibratedKinematics):
        say("the table averages over the poses that were drawn or given; they may lie beyond those of the fit")
        say(*expectation_lines(source, None))
    if isinstance(table.joints, PoseColumns) and given.candidates is None:
        say("poses are drawn around those of the fit: pass --candidates where the machine, or the view, is smaller")
    say(f"{count} of {len(q)} configurations written to {output}, in an order of short moves")
    say("its column `rank`: the poses of ranks 1 to k are the plan for k poses")
    if proposal.devices:
        say("its column `device`: what measures the pose")
        say(*(line for sensor in sensors for line in sensor.sentences()))


def _cell(cell: Candidates, robot: Tree, table: TableFormat) -> dict[str, Any]:
    """What random configurations have to respect, in m and rad: arguments of :func:`drawn`."""
    scale = table.per_metre
    options: dict[str, Any] = {"ranges": _ranges(cell, robot, table), "seed": cell.seed}
    if cell.tracker is not None:
        x, y, z, *view = stated_numbers("--tracker", cell.tracker, (3, 6, 7))
        looks = (view[:3], *map(radians, view[3:])) if view else ()
        how: dict[str, Any] = dict(zip(("direction", "half_angle"), looks, strict=False))
        options["tracker"] = Tracker((x / scale, y / scale, z / scale), **how)
    if cell.column is not None:
        options["column"] = [x / scale for x in stated_numbers("--column", cell.column, (3, 4))]
    if cell.floor is not None:
        options["floor"] = cell.floor / scale
    if cell.collisions:
        options["keep"] = collision_free(robot)
    return options


def _ranges(cell: Candidates, robot: Tree, table: TableFormat) -> dict[str, list[float]]:
    """Name of a joint -> its range, rad or m; a column of a commanded place stands for the slide that goes there."""
    turns, columns = dict(zip(robot.joint_names, robot.periodic, strict=True)), as_written(table).joints
    slides = dict(zip(columns.columns, SLIDES, strict=False)) if isinstance(columns, PoseColumns) else {}
    ranges = {}
    for text in cell.range or ():
        name, _, ends = text.rpartition("=")
        name = slides.get(name, name)
        if not name or ends.count(":") != 1:
            raise InputError.of(f"--range {text}", expected="JOINT=A:B, such as joint_1=-90:90")
        numbers = stated_numbers("--range", ends.replace(":", ","), (2,))
        unit = 1 / table.joints_per_metre if not turns.get(name, True) else 1.0
        ranges[name] = [x * (pi / 180 if turns.get(name) and table.angle == "deg" else unit) for x in numbers]
    return ranges


MOVED = {"base": "the measuring device is", "marker": "the markers are", "both": "device and markers are"}
"""What --free names, in words."""
OPEN_M = 0.01  # expected error from which it is the place of what has moved


def _show_expected(proposal: Plan, *, of_positions: bool, free: str | None) -> None:
    """Print the expected errors by number of poses, also as held-out errors of positions.

    ``free`` has moved since the fit: without poses only its place would be expected to be wrong.
    """
    more = "" if proposal.assumed else " more"
    title = f"Expected RMS error in mm by number of{more} poses"
    fewest, rows = 0 if free is None else int((proposal.expected_rms > OPEN_M).sum()), list[list[str]]()
    for count in (*[0] * (not proposal.assumed and not fewest), *proposal.counts):
        rms = 1e3 * float(proposal.expected_rms[count])
        with_noise = (rms**2 + (1e3 * proposal.noise_rms) ** 2) ** 0.5
        rows.append([str(count), f"{rms:.3f}", *[f"{with_noise:.3f}"] * of_positions])
    header = [f"{more} poses".strip(), "model", *["held out"] * of_positions]
    out.print(text_table(title, header, rows, labels=0, min_width=len(title)))
    if of_positions:
        say("held out: with the noise of one measurement, as `fit` and `evaluate` show it")
    if fewest:
        say(f"fewer than {fewest} poses do not show where {free} now")
    if free is not None:
        say("these errors are expected if nothing else has changed since the fit: test that by `recalibrate`")
    if proposal.assumed:
        say(f"{proposal.caution}: measure the first 20 poses, fit them, and plan the next with the model")
