"""`diffeo-calib evaluate`: the errors of a model on a table of measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.contradicted_rows import block_text, contradicted, step_text, steps_of
from diffeo_calib.cli.blocks import Gathered, check, counted
from diffeo_calib.cli.commands.acceptance import accept
from diffeo_calib.cli.console import out, plain, progress_bar, say
from diffeo_calib.cli.error_tables import add_errors, error_table, outlier_lines
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.record import errors_entry, record
from diffeo_calib.cli.registration_lines import registration_lines
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import (
    Evaluation,
    evaluate,
    implausible,
    impossible,
    rows_used_in_fit,
    warn_outside_range,
)
from diffeo_calib.kinematics.laden_rows import laden, of_one_payload
from diffeo_calib.kinematics.re_registration.motions import MOST_ROWS, motions
from diffeo_calib.kinematics.session_places import rows_of_other_frames
from diffeo_calib.kinematics.socket_errors import with_markers_of
from diffeo_calib.measurements.csv.rows import write_rows
from diffeo_calib.measurements.pose_frames import by_frame
from diffeo_calib.measurements.table import Measurements

RESIDUALS = ("line", "used_in_fit", "marker", "dx", "dy", "dz", "distance")
OF_OTHER_FRAMES = "rows of the fit were measured in another set-up than that of the model, and are judged in its frame"
NAME_SESSIONS = "name the column of the set-ups (--session), or leave these rows out"


def run(model: Path, source: MeasuredTable, *, limit: float | None = None, residuals: Path | None = None) -> None:
    """Print errors on all rows, on the rows of the fit and on the other rows; judge suspicious rows and errors.

    Args:
        model: its file. source: the table. limit: largest RMS error of new rows, m, that is good enough.
        residuals: file for the error of every row.

    Raises:
        MeasurementError: see :func:`judge`; the errors have been printed by then.
    """
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    errors, used, some = _evaluated(kinematics, source, residuals)
    show(errors, used, model, residuals)
    judge(kinematics, some, errors)
    if limit is not None:
        accept_new(errors, used, limit)


def show(
    errors: Evaluation, used: Tensor, model: Path, residuals: Path | None, sessions: Mapping[str, Tensor] | None = None
) -> None:
    """Print and record errors of all rows, of the rows of the fit, of the other rows, and of sessions.

    Args:
        errors: of N rows. used: (N,) whether they were used in the fit. model, residuals: files.
        sessions: (N,) masks of the rows of each session, by its name; none if there is one.
    """
    table = error_table(f"Position errors of {plain(model.name)} in mm", "rows", angles=errors.angles is not None)
    add_errors(table, errors, f"{len(used)} in all")
    entries: dict[str, Any] = {"all": errors_entry(errors)}
    for mask, label in ((used, "used in the fit"), (~used, "not used in the fit")):
        if used.any() and mask.any():
            add_errors(table, errors.rows(mask), f"{int(mask.sum())} {label}")
            entries[label.replace(" ", "_")] = errors_entry(errors.rows(mask))
    for name, mask in (sessions or {}).items():
        add_errors(table, errors.rows(mask), f"{int(mask.sum())} of session '{plain(name)}'")
        entries.setdefault("in_sessions", {})[name] = errors_entry(errors.rows(mask))
    record.add(errors=entries, files={} if residuals is None else {"residuals": residuals})
    out.print(table)
    if residuals is not None:
        say(f"residuals: {residuals}")


def accept_new(errors: Evaluation, used: Tensor, limit: float) -> None:
    """End with its own exit code if the RMS error of new rows, of all if none is new, is above a limit, m."""
    new = ~used if not used.all() else used
    accept(errors.rows(new).rms, limit, f"{int(new.sum())} rows{' not used in the fit' * bool((~used).any())}")


def judge(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> None:
    """Name rows that look wrong, and warn of a likely cause of large errors.

    Args:
        data: rows of the table, evenly chosen of many. errors: of all rows.

    Raises:
        MeasurementError: rows out of step with their joints, or errors that say nothing about the robot.
    """
    steps = steps_of(model, data)
    if steps:
        raise MeasurementError(step_text(steps[0]))
    seen, same = of_one_payload(model, data)
    named = motions(seen.map, seen.nominal, seen.lever, same)
    causes = [sentence(motion.sentence, fix="evaluate with --register") for motion in named]
    causes = causes or [text for text in [implausible(model, data, errors)] if text is not None]
    if impossible(model, errors):
        raise MeasurementError(" ".join(causes))
    if not causes:
        wrong = contradicted(model, data)
        which = "rows" if len(data) == len(errors.errors) else f"rows, evenly chosen of {len(errors.errors)},"
        for line in outlier_lines(wrong, len(data), which):
            say(line)
        causes = [text for text in [block_text(model, data, wrong)] if text is not None]
    for text in causes:
        warn_user(text)


def _evaluated(
    model: CalibratedKinematics, source: MeasuredTable, residuals: Path | None
) -> tuple[Evaluation, Tensor, Measurements]:
    """Errors of all rows of a table, which of them (N,) were used in the fit, and evenly chosen rows of the table."""
    some, first, lines, elsewhere = [], 0, [], 0
    with source.open(model.robot) as file, progress_bar() as progress:
        check(file, model, progress)
        errors, angles, used = (Gathered(file.rows) for _ in range(3))
        step = -(-file.rows // MOST_ROWS)
        for block in counted(file.measurements(), file.rows, progress):
            data = with_markers_of(model, block.with_joint_names(model.robot.joint_names))
            found = evaluate(model, data)
            errors.add(found.errors)
            if found.angles is not None:
                angles.add(found.angles)
            inside = rows_used_in_fit(model, data.q)
            used.add(inside)
            elsewhere += rows_of_other_frames(model, data.q)
            if residuals is not None:
                lines.append(residual_rows(model, data, inside, source.table.per_metre, markers=block.markers))
            if -first % step < len(data):
                some.append(data.rows(slice(-first % step, None, step)))
            first += len(data)
    if residuals is not None:
        write_residuals(residuals, lines, source)
    if elsewhere:
        warn_user(sentence(f"{elsewhere} {OF_OTHER_FRAMES}", fix=NAME_SESSIONS))
    found = Evaluation(errors.whole, angles.whole if angles.filled else None)
    return found, used.whole, Measurements.joined(some)


def residual_rows(
    model: CalibratedKinematics, data: Measurements, used: Tensor, per_metre: float, *, markers: int
) -> Tensor:
    """Rows (N P, 7) of the table of residuals: of the first markers, or of the origins alone of measured poses."""
    if data.frames is None:
        away = (data.points - laden(model, data)(data.q).detach())[:, :markers]
    else:
        away = data.frames[..., :3, 3] - by_frame(laden(model, data).poses(data.q))[..., :3, 3]
    away = per_metre * away
    N, P, _ = away.shape
    first = torch.stack([data.line_numbers.to(away), used.to(away)], 1)[:, None].expand(N, P, 2)
    marker = torch.arange(P, device=away.device).to(away).expand(N, P)[..., None]
    return torch.cat([first, marker, away, away.norm(dim=-1, keepdim=True)], 2).flatten(0, 1)


def write_residuals(path: Path, rows: Sequence[Tensor], source: MeasuredTable) -> None:
    """Write tables of residuals (N P, 7) one after the other."""
    write_rows(path, RESIDUALS, map(_written, rows), source.table)


def _written(rows: Tensor) -> list[list[float]]:
    """Rows for the file: whole numbers without decimals."""
    return [[int(line), int(used), int(marker), *away] for line, used, marker, *away in rows.tolist()]


def run_registered(model: Path, source: MeasuredTable, free: str, output: Path | None) -> None:
    """Find device and markers anew; print what was found and the errors before and after, and write the model."""
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    data = source.read(kinematics.robot)
    warn_outside_range(kinematics, data.q)
    found = kinematics.registered(data, free=free)
    if output is not None:
        save(found, output)  # before anything is printed: output may be cut off
    errors = evaluate(found, data)
    record.add(errors={"after": errors_entry(errors)}, files={} if output is None else {"model": output})
    table = error_table(f"Position errors of {plain(model.name)} in mm", "rows", angles=errors.angles is not None)
    if found.registration is not None and found.registration.rms_before is not None:
        add_errors(table, evaluate(kinematics, data), f"{len(data)} before registration")
    add_errors(table, errors, f"{len(data)} after registration")
    out.print(table)
    for line in registration_lines(found):
        say(line)
    if output is not None:
        say(f"registered model: {output}")
