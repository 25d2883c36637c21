"""`diffeo-calib compare`: what has changed since a calibration."""

from __future__ import annotations

from math import degrees
from pathlib import Path

from diffeo_calib.calibration.recalibration.compare import Comparison, ModelComparison, compare
from diffeo_calib.cli.commands.recalibrate import change_entries, change_lines, doubt, smallest_lines
from diffeo_calib.cli.console import say
from diffeo_calib.cli.declarations import CompareOptions
from diffeo_calib.cli.models import another_date_lines, load_kinematics, provenance_lines, table_of
from diffeo_calib.cli.printed import motion_lines
from diffeo_calib.cli.record import entries_by_kind, record
from diffeo_calib.common.errors import InputError


def is_model(path: Path) -> bool:
    """Whether a file is a model rather than a table: its header is JSON after eight bytes."""
    try:
        with path.open("rb") as file:
            return path.is_file() and file.read(9)[8:] == b"{"
    except OSError:
        return path.suffix.lower() not in (".csv", ".txt")


def run(given: CompareOptions) -> None:
    """Compare a model with new measurements, or with another model."""
    if is_model(given.other):
        if given.rows.named or given.units.length or given.units.angle:
            fix = "leave out the options of tables, or name a table"
            raise InputError.of(f"{given.other} is a model, beside options of a table", fix=fix)
        return _models(given.old, given.other, given.tests.seed)
    model = load_kinematics(given.old)
    source = table_of(model, given.other, given.rows, given.units)
    say(*provenance_lines(model), *another_date_lines(model))
    how = {"marker": given.tests.marker_freedom, "seed": given.tests.seed}
    found = compare(model, source.read(model.robot), **how)
    if not isinstance(found, Comparison):
        return None
    record.add(
        **change_entries(found.changes, found.hidden),
        rows_can_tell=found.telling and found.changes.tested,
        **({} if found.moved is None else {"transform": found.moved.transform}),
        **entries_by_kind(
            {kind: {"found": one, "expected": found.expectations[kind]} for kind, one in found.errors.items()}
        ),
    )
    if found.moved is not None:
        say(*motion_lines(found.moved, model.on, doubt=doubt(found.changes, "in them")))
    say(f"RMS from the model, device and markers found anew: {found.errors.rms_text}")
    say(f"expected of it: {found.expectations.rms_text}")
    say(*(change_lines(found.changes) if found.changes.found else [str(found), *smallest_lines(found.changes)]))


def _models(old: Path, other: Path, seed: int) -> None:
    """Compare two models."""
    models = [load_kinematics(path) for path in (old, other)]
    for model in models:
        say(*provenance_lines(model))
    found = compare(models[0], models[1], seed=seed)
    if not isinstance(found, ModelComparison):
        return
    record.add(
        rms_m=found.rms,
        expected_m=found.expected,
        largest_m=found.largest,
        geodesic_length=found.geodesic_length,
        changes=change_entries(found.changes)["changes"],
        transmissions_rad_or_m=found.transmissions,
        files={},
    )
    say(str(found))
    for (name, change), kind in zip(found.transmissions.items(), models[0].robot.kinds, strict=True):
        size = (
            f"{1e3 * change:.3f} mm" if kind == "prismatic" else f"{1e3 * change:.3f} mrad ({degrees(change):.4f} deg)"
        )
        say(f"  transmission of {name}: {size} RMS")
