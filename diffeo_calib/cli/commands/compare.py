"""`diffeo-calib compare`: what has changed since a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diffeo_calib.calibration.recalibration.compare import compare
from diffeo_calib.cli.commands.recalibrate import change_entries, change_lines, doubt
from diffeo_calib.cli.console import say
from diffeo_calib.cli.models import another_date_lines, load_kinematics, provenance_lines, table_of
from diffeo_calib.cli.options import Command
from diffeo_calib.cli.printed import motion_lines
from diffeo_calib.cli.record import entries_by_kind, record
from diffeo_calib.common.errors import InputError


def run(given: Command) -> None:
    """Compare a model with new measurements, or with another model."""
    model, other = load_kinematics(given.old), given.other
    if _is_model(other):
        if given.rows.named or given.units.length or given.units.angle:
            fix = "leave out the options of tables, or name a table"
            raise InputError.of(f"{other} is a model, beside options of a table", fix=fix)
        rows: Any = load_kinematics(other)
        say(*provenance_lines(model), *provenance_lines(rows))
    else:
        source = table_of(model, other, given.rows, given.units)
        say(*provenance_lines(model), *another_date_lines(model))
        rows = source.read(model.robot)
    found = compare(model, rows, marker=given.tests.marker_freedom, seed=given.tests.seed)
    kinds = {kind: {"found": one, "expected": found.expectations[kind]} for kind, one in found.errors.items()}
    moved = {} if found.moved is None else {"transform": found.moved.transform}
    record.add(**change_entries(found.changes, found.hidden), **moved, **entries_by_kind(kinds))
    record.add(rows_can_tell=found.telling and found.changes.tested)
    if found.moved is not None:
        say(*motion_lines(found.moved, model.on, doubt=doubt(found.changes, "in them")))
    say(f"RMS from the model, device and markers found anew: {found.errors.rms_text}")
    say(f"expected of it: {found.expectations.rms_text}", *change_lines(found.changes, found))


def _is_model(path: Path) -> bool:
    """Whether a file is a model rather than a table: its header is JSON after eight bytes."""
    try:
        with path.open("rb") as file:
            return path.is_file() and file.read(9)[8:] == b"{"
    except OSError:
        return path.suffix.lower() not in (".csv", ".txt")
