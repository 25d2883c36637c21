"""`diffeo-calib evaluate`: the errors of a model on a table of measurements of any kinds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.judgement import accuracy, expected_rms, judge
from diffeo_calib.cli import models, printed
from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.declarations import EvaluateOptions
from diffeo_calib.cli.record import entries_by_kind, record
from diffeo_calib.cli.tables import MeasuredTable
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, warn_user
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import (
    check_rows,
    evaluate,
    place,
    placement_sentences,
    positions_of,
    residuals,
    rows_of_other_frames,
    rows_used_in_fit,
)
from diffeo_calib.kinematics.joint_ranges import repeated_lines, warn_outside_range
from diffeo_calib.measurements.csv.writing import write_rows
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.errors import READINGS, SPREAD, Evaluation, Evaluations
from diffeo_calib.sensors.set_ups import MeasuringFrames

COLUMNS = ("line", "used_in_fit", "kind", "device", "marker", "dx", "dy", "dz", "size", "unit")
"""Of the table of residuals."""


def run(options: EvaluateOptions) -> None:
    """Run the command."""
    model = models.load_kinematics(options.model)
    source = models.table_of(model, options.csv, options.rows, options.units)
    limit = printed.parsed_limit(options.tolerance)
    models.check_payload_column(model, source.table.payload)
    say(*models.provenance_lines(model))
    data = source.read(model.robot)
    say(*repeated_lines(model, data.q))
    if options.free is not None:
        return _registered(model, data, options)
    check_rows(model, data)
    places = place(model, data, every_session=source.table.session is not None)
    found, used = residuals(model, places, data), rows_used_in_fit(model, data.q)
    judged = judge(model, places, data, found)
    _show(model, found, used, positions_of(model, places, data), options.model.name)
    if options.residuals is not None:
        write_rows(options.residuals, COLUMNS, [list(_residuals(found, used, source))], source.table)
        record.add(files={"residuals": options.residuals})
        say(f"residuals: {options.residuals}")
    if isinstance(places.frames, MeasuringFrames):
        record.add(session_transforms=places.frames.entry())
    if places.numbers:
        record.add(found_from_rows={"numbers": places.numbers, "sentences": list(places.found)})
    say(*map(plain, places.found))
    say(*(line for errors in found.values() for line in printed.socket_lines(errors, "all rows")))
    say(*printed.expectation_lines(model, data))
    warn_outside_range(model, data.q)
    source.warn_of_other_frames(rows_of_other_frames(model, data.q))
    if judged.refusal is not None:
        raise MeasurementError(judged.refusal)
    positions = 0 if found.positions is None else len(found.positions.errors)
    which = "rows" if judged.rows == positions else f"rows, evenly chosen of {positions},"
    say(*printed.outlier_lines(judged.outliers, judged.rows, which))
    for text in judged.causes:
        warn_user(text)
    if limit is not None:
        new, which = (found, "") if bool(used.all()) else (found.rows(~used), " not used in the fit")
        printed.accept(accuracy(model, new.values(), limit.unit, which=which), limit)


def _show(model: CalibratedKinematics, found: Evaluations, used: Tensor, seen: Measurements | None, name: str) -> None:
    """Print and record errors of all rows, of the rows of the fit, of the others, and of set-ups and devices."""
    named = dict[str, dict[str, Any]]()
    for kind, errors in found.items():
        own, positions = used[found.index[kind]], errors is found.positions
        of_rows = {"in all": errors}
        if own.any() and not own.all():
            of_rows |= {"used in the fit": errors.rows(own), "not used in the fit": errors.rows(~own)}
        of_devices, what = _by_device(errors), "session" if positions else "device"
        expected = expected_rms(model, seen, errors.errors.shape[1]) if positions and seen is not None else None
        table = printed.ErrorTable(errors, f"of {plain(name)}", "rows")
        for label, some in of_rows.items():
            table.add(some, f"{some.count} {label}", expected=expected)
        for device, some in of_devices.items():
            table.add(some, f"{some.count} of {what} '{plain(device)}'", expected=expected)
        out.print(table)
        entries = {label.replace("in all", "all").replace(" ", "_"): some for label, some in of_rows.items()}
        named[kind] = entries | ({f"in_{what}s": of_devices} if of_devices else {})
    record.add(files={}, **entries_by_kind(named))


def _by_device(errors: Evaluation) -> dict[str, Evaluation]:
    """The errors of each set-up, or of each of several devices; sockets have no errors of their own."""
    present = [name for name in dict.fromkeys(errors.devices) if name] if errors.what != SPREAD else []
    if errors.what == READINGS and len(present) < 2:
        return {}
    masks = {name: [own == name for own in errors.devices] for name in present}
    return {name: errors.rows(torch.tensor(mask, dtype=torch.bool, device=HOST)) for name, mask in masks.items()}


def _residuals(found: Evaluations, used: Tensor, source: MeasuredTable) -> Iterator[list[float | str]]:
    """Rows of the table of residuals: lengths in the unit of the table, pixels, degrees."""
    for entry in found.lines():
        metres = entry["unit"] == "mm"
        values = [entry[name] * (source.table.per_metre / 1e3 if metres else 1.0) for name in COLUMNS[5:9]]
        cells = entry["line"], int(used[entry["row"]]), entry["kind"], entry["device"], entry["marker"]
        yield [*cells, *values, source.table.length if metres else entry["unit"]]


def _registered(model: CalibratedKinematics, data: Any, options: EvaluateOptions) -> None:
    """Find device and markers anew; print what was found and the errors before and after, and write the model."""
    output = options.output
    warn_outside_range(model, data.q)
    say(*models.another_date_lines(model))
    found = model.registered(data, free=options.free or "both", learn=False)
    if output is not None:
        save(found, output)  # before anything is printed: output may be cut off
    errors = evaluate(found, data)
    kinds = errors if isinstance(errors, Evaluations) else {errors.kind: errors}
    record.add(files={} if output is None else {"model": output})
    record.add(**entries_by_kind({kind: {"after": after} for kind, after in kinds.items()}))
    known = found.registration is not None and found.registration.rms_before is not None
    before = residuals(model, place(model, data), data) if known else None
    for kind, after in kinds.items():
        table = printed.ErrorTable(after, f"of {plain(options.model.name)}", "rows")
        if before is not None:
            table.add(before[kind], f"{after.count} with the places of the fit")
        table.add(after, f"{after.count} with places found anew")
        out.print(table)
    say(*map(plain, (*printed.registration_lines(found), *placement_sentences(found))))
    if output is not None:
        say(f"registered model: {output}")
