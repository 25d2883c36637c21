"""`diffeo-calib recalibrate`: an old model and a few new rows become one model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import typer

from diffeo_calib.calibration.recalibration.changes import Changes
from diffeo_calib.calibration.recalibration.offsets import HiddenOffset
from diffeo_calib.calibration.recalibration.recalibrate import Recalibration, recalibrate
from diffeo_calib.cli.commands.fit import EXIT_UNCONVERGED
from diffeo_calib.cli.console import exit_on_interrupt, progress_bar, say
from diffeo_calib.cli.models import another_date_lines, load_kinematics, made_by_command, provenance_lines, table_of
from diffeo_calib.cli.printed import frame_lines, placement_lines
from diffeo_calib.cli.record import entries_by_kind, record
from diffeo_calib.cli.tables import TableOptions
from diffeo_calib.common.errors import few
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.evaluation import warn_outside_range


@dataclass(frozen=True)
class Options:
    """Assumptions about the set-up, and the note that is kept with the model."""

    marker: str
    drift: str
    seed: int
    note: str


def run(old: Path, table: TableOptions, output: Path, options: Options) -> None:
    """Recalibrate, write the model, say what has changed, and end with the exit code of the fit."""
    model = load_kinematics(old)
    source = table_of(model, table)
    for line in provenance_lines(model):
        say(line)
    for line in another_date_lines(model):
        say(line)
    with exit_on_interrupt(), progress_bar() as progress:
        data = source.read(model.robot)
        warn_outside_range(model, data.q)
        named = {"marker": options.marker, "drift": options.drift, "seed": options.seed, "note": options.note}
        result = recalibrate(model, data, progress=progress, **named)
    save(made_by_command(result.model), output)  # before anything is printed: output may be cut off
    record.add(
        changes=changes_entry(result.changes),
        possible_offsets=offsets_entry(result.hidden),
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
    for line in (*frame, *_found(result), *places, *change_lines(result.changes), *map(str, result.hidden)):
        say(line)
    say(result.fit.status)
    say(f"model: {output}")
    if not result.fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def _found(result: Recalibration) -> list[str]:
    """Errors of the new rows, and those that hardly count."""
    shift = None if result.moved is None else result.moved.shift
    moved = "have moved" if shift is None else f"have moved by {1e3 * float(shift.norm(dim=1).max()):.2g} mm"
    moved += ", or the change below is in this" * bool(result.changes.found)
    markers = {"same": "are where they were", "moved": moved, "other": f"{moved}, or are other ones"}
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


def changes_entry(changes: Changes) -> list[dict[str, object]]:
    """Changes for programs."""
    return [
        {"part": one.part, "size_rad_or_m": one.size, "probability": one.probability, "sentence": str(one)}
        for one in changes.found
    ]


def offsets_entry(hidden: Sequence[HiddenOffset]) -> list[dict[str, object]]:
    """Offsets that explain new places of device or markers as well, for programs."""
    return [{"joint": one.joint, "size_rad_or_m": one.size, "deviation_rad_or_m": one.deviation} for one in hidden]


def change_lines(changes: Changes) -> list[str]:
    """Changes, one line each."""
    return [f"  {change}" for change in changes.found] or [str(changes)]
