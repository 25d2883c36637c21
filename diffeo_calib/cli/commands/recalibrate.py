"""`diffeo-calib recalibrate`: an old model and a few new rows become one model."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

import typer

from diffeo_calib.calibration.recalibration.changes import Changes
from diffeo_calib.calibration.recalibration.offsets import HiddenOffset
from diffeo_calib.calibration.recalibration.recalibrate import Recalibration, recalibrate
from diffeo_calib.cli.commands.fit import EXIT_UNCONVERGED
from diffeo_calib.cli.console import exit_on_interrupt, progress_bar, say
from diffeo_calib.cli.models import another_date_lines, load_kinematics, made_by_command, provenance_lines, table_of
from diffeo_calib.cli.options import RecalibrateOptions
from diffeo_calib.cli.printed import frame_lines, placement_lines
from diffeo_calib.cli.record import entries_by_kind, record
from diffeo_calib.common.errors import few
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.joint_ranges import warn_outside_range


def run(given: RecalibrateOptions) -> None:
    """Recalibrate, write the model, say what has changed, and end with the exit code of the fit."""
    model, output = load_kinematics(given.old), given.output
    source = table_of(model, given.csv, given.rows, given.units)
    tests = given.tests
    how: Any = {"marker": tests.marker_freedom, "seed": tests.seed, "drift": given.drift, "note": given.note}
    say(*provenance_lines(model), *another_date_lines(model))
    with exit_on_interrupt(), progress_bar() as progress:
        data = source.read(model.robot)
        warn_outside_range(model, data.q)
        result = recalibrate(model, data, progress=progress, **how)
    save(made_by_command(result.model), output)  # before anything is printed: output may be cut off
    record.add(
        **change_entries(result.changes, result.hidden),
        rows_can_tell=result.changes.tested,
        markers=result.marker,
        **({} if result.moved is None else {"transform": result.moved.transform}),
        converged=result.fit.converged,
        status=result.status,
        files={"model": output},
        **entries_by_kind(
            {
                kind: {"before": one, "after": result.after[kind], "left_out": result.left_out[kind]}
                for kind, one in result.before.items()
            }
        ),
    )
    places = placement_lines(result.model.geometry, poses=result.model.lever is not None)
    frame = () if result.moved is None else frame_lines(result.moved)
    say(*frame, *_found(result), *places, *change_lines(result.changes), *map(str, result.hidden))
    say(result.fit.status)
    say(f"model: {output}")
    if not result.fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def _found(result: Recalibration) -> list[str]:
    """Errors of the new rows, and those that hardly count."""
    moved, known = "have moved", ""
    if result.moved is not None and result.shift is not None:
        moved = f"are {1e3 * float(result.shift.norm(dim=1).max()):.2g} mm from where they were"
        known = f" (these rows show that to {1e3 * result.moved.known_m:.2g} mm)"
    known *= result.changes.tested
    moved += known + doubt(result.changes, "in this")
    markers = {
        "same": f"are taken to be where they were{known}",
        "moved": moved,
        "other": f"{moved}, or are other ones",
    }
    placed = [] if any("markers" in one.instead for one in result.hidden) else [f"the markers {markers[result.marker]}"]
    lines = [
        *placed,
        f"new rows, RMS from the old model, device and markers found anew: {result.before.rms_text}",
        f"new rows, RMS if each is predicted by the old rows and the other new ones: {result.left_out.rms_text}",
    ]
    if result.outliers:
        lines.append(
            f"{len(result.outliers)} row(s) hardly count: row {few(result.outliers)}: measure these poses again"
        )
    return lines


def doubt(changes: Changes, where: str) -> str:
    """What a change of the robot does to places that were found without one."""
    if changes.found:
        return f": a part of the change below is {where}"
    return "" if changes.tested else f": a change of the robot, which was not tested, would be {where}"


def change_entries(changes: Changes, hidden: Sequence[HiddenOffset] = ()) -> dict[str, list[dict[str, object]]]:
    """For programs: changes, what offsets the rows would show (None where places hide it), and those they may hide."""
    return {
        "changes": [
            {"part": one.part, "size_rad_or_m": one.size, "probability": one.probability, "sentence": str(one)}
            for one in changes.found
        ],
        "smallest_offsets": [
            {"joint": one.joint, "size_rad_or_m": one.size if isfinite(one.size) else None} for one in changes.smallest
        ],
        "possible_offsets": [
            {"joint": one.joint, "size_rad_or_m": one.size, "deviation_rad_or_m": one.deviation} for one in hidden
        ],
    }


def change_lines(changes: Changes) -> list[str]:
    """Changes, one line each."""
    return [f"  {change}" for change in changes.found] or [str(changes), *smallest_lines(changes)]


def smallest_lines(changes: Changes) -> list[str]:
    """Which offsets the rows would have shown, where they show no change."""
    if not changes.smallest:
        return []
    listed = ", ".join(map(str, changes.smallest))
    return [f"smallest change of an offset that these rows would show in nine cases of ten: {listed}"]
