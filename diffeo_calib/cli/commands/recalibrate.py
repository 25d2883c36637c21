"""`diffeo-calib recalibrate`: what has changed since a calibration; old and new rows as one model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite
from typing import Any

import typer

from diffeo_calib.calibration.recalibration.find_changes import Changes, Offset
from diffeo_calib.calibration.recalibration.recalibrate import Recalibration, compare, recalibrate
from diffeo_calib.cli import console, models
from diffeo_calib.cli.commands.fit import EXIT_UNCONVERGED
from diffeo_calib.cli.declarations import RecalibrateOptions
from diffeo_calib.common.errors import InputError, few
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.evaluation import repeated_lines, warn_outside_range
from diffeo_calib.measurements.bodies import placement_lines

MARKERS: dict[str | None, Any] = {None: "evidence", "base": "same", "remounted": "moved", "both": "other"}
"""Value of --free -> what is assumed of the markers."""


def run(given: RecalibrateOptions) -> None:
    """Recalibrate, write the model, say what has changed, and end with the exit code of the fit."""
    if given.output is None:
        return _compare(given)
    model = models.load_kinematics(given.old)
    source = models.table_of(model, given.other, given)
    how = {"marker": MARKERS[given.free], "seed": given.seed, "note": given.note}
    console.say(*models.provenance_lines(model), *models.another_date_lines(model))
    with console.progress_bar() as progress:
        data = source.read(model.robot)
        console.say(*repeated_lines(model, data.q))
        warn_outside_range(model, data.q)
        result = recalibrate(model, data, progress=progress, **how)
    save(models.made_by_command(result.model), given.output)  # before anything is printed: output may be cut off
    after, left_out = result.after, result.left_out
    kinds = {k: {"before": errors, "after": after[k], "left_out": left_out[k]} for k, errors in result.before.items()}
    entries = {} if result.moved is None else {"transform": result.moved.transform}
    entries |= {"rows_can_tell": result.changes.tested, "markers": result.marker, "files": {"model": given.output}}
    entries |= {"converged": result.fit.converged, "status": result.status}
    console.record.add(**change_entries(result.changes, result.hidden), **entries, **console.entries_by_kind(kinds))
    frame = () if result.moved is None else models.frame_lines(result.moved, doubt(result.changes, "in this"))
    places = placement_lines(result.model.geometry, poses=result.model.lever is not None)
    console.say(*frame, *_found(result), *places, *change_lines(result.changes), *map(str, result.hidden))
    console.say(result.fit.status, f"model: {given.output}")
    if not result.fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def _found(result: Recalibration) -> Iterator[str]:
    moved, precision = "have moved", ""
    if result.moved is not None and result.shift is not None:
        moved = f"are {1e3 * float(result.shift.norm(dim=1).max()):.2g} mm from where they were"
        precision = f" (these rows show that to {1e3 * result.moved.known_m:.2g} mm)" * result.changes.tested
    moved += precision + doubt(result.changes, "in this")
    if not any("markers" in offset.instead for offset in result.hidden):
        words = {"same": f"are taken to be where they were{precision}", "moved": moved}
        yield f"the markers {words.get(result.marker, f'{moved}, or are other ones')}"
    yield f"new rows, RMS from the old model, device and markers found anew: {result.before.rms_text}"
    yield f"new rows, RMS if each is predicted by the old rows and the other new ones: {result.left_out.rms_text}"
    if rows := result.outliers:
        yield f"{len(rows)} row(s) hardly count: row {few(rows)}: measure these poses again"


def doubt(changes: Changes, where: str) -> str:
    """What a change of the robot does to places that were found without one."""
    if changes.found:
        return f": a part of the change below is {where}"
    return "" if changes.tested else f": a change of the robot, which was not tested, would be {where}"


def change_entries(changes: Changes, hidden: Sequence[Offset] = ()) -> dict[str, list[dict[str, object]]]:
    """For programs: changes, what offsets the rows would show (None where places hide it), and those they may hide."""
    smallest = [(offset.joint, offset.size if isfinite(offset.size) else None) for offset in changes.smallest]
    return {
        "changes": [
            {"part": part.part, "size_rad_or_m": part.size, "probability": part.probability, "sentence": str(part)}
            for part in changes.found
        ],
        "smallest_offsets": [{"joint": joint, "size_rad_or_m": size} for joint, size in smallest],
        "possible_offsets": [
            {"joint": one.joint, "size_rad_or_m": one.size, "deviation_rad_or_m": one.deviation} for one in hidden
        ],
    }


def change_lines(changes: Changes, none: object = None) -> list[str]:
    """Changes, one line each; without one ``none``, and which offsets the rows would have shown."""
    listed = ", ".join(map(str, changes.smallest))
    smallest = [f"smallest change of an offset that these rows would show in nine cases of ten: {listed}"]
    return [f"  {change}" for change in changes.found] or [str(none or changes), *smallest[: len(changes.smallest)]]


def _compare(given: RecalibrateOptions) -> None:
    model, other = models.load_kinematics(given.old), given.other
    try:
        with other.open("rb") as file:  # the header of a model is JSON after eight bytes
            is_model = other.is_file() and file.read(9)[8:] == b"{"
    except OSError:
        is_model = other.suffix.lower() not in (".csv", ".txt")
    if is_model:
        if given.named or given.length or given.angle:
            fix = "leave out the options of tables, or name a table"
            raise InputError.of(f"{other} is a model, beside options of a table", fix=fix)
        rows: Any = models.load_kinematics(other)
        console.say(*models.provenance_lines(model), *models.provenance_lines(rows))
    else:
        source = models.table_of(model, other, given)
        console.say(*models.provenance_lines(model), *models.another_date_lines(model))
        rows = source.read(model.robot)
    compared = compare(model, rows, marker=MARKERS[given.free], seed=given.seed)
    kinds = {kind: {"found": error, "expected": compared.expectations[kind]} for kind, error in compared.errors.items()}
    moved = {} if compared.moved is None else {"transform": compared.moved.transform}
    console.record.add(**change_entries(compared.changes, compared.hidden), **moved, **console.entries_by_kind(kinds))
    console.record.add(rows_can_tell=compared.telling and compared.changes.tested)
    if compared.moved is not None:
        console.say(*models.motion_lines(compared.moved, model.on, doubt=doubt(compared.changes, "in them")))
    console.say(f"RMS from the model, device and markers found anew: {compared.errors.rms_text}")
    console.say(f"expected of it: {compared.expectations.rms_text}", *change_lines(compared.changes, compared))
