"""`diffeo-calib evaluate --socket`: spread within sockets, known distances, and the absolute error to expect.

Where some positions were measured, their errors too.
"""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.commands.acceptance import accept
from diffeo_calib.cli.commands.evaluate import NAME_SESSIONS, OF_OTHER_FRAMES
from diffeo_calib.cli.commands.evaluate_sessions import placed, say_places
from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.error_tables import add_errors, error_table
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.record import errors_entry, record
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.cli.tables.sockets import SPREAD_TITLE, expectation_lines, socket_lines
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import (
    Evaluation,
    check_plausible,
    evaluate,
    rows_used_in_fit,
    warn_outside_range,
)
from diffeo_calib.kinematics.session_places import rows_of_other_frames
from diffeo_calib.kinematics.socket_errors import with_markers_of
from diffeo_calib.measurements.table import Measurements

Entries = dict[str, dict[str, float | int | None]]


def run(model: Path, source: MeasuredTable, *, limit: float | None = None) -> None:
    """Print the errors of measured positions, the spread of rows in sockets, and the errors of known distances.

    Each of all rows, of the rows of the fit and of the other rows.

    Args:
        model: its file. source: the table. limit: largest RMS error of new rows, m, that is good enough; of their
            spread if no position was measured.

    Raises:
        InputError: a model that was calibrated with measured positions alone.
        MeasurementError: errors that say nothing about the robot.
    """
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    data, frames = placed(kinematics, with_markers_of(kinematics, source.read(kinematics.robot)))
    elsewhere = rows_of_other_frames(kinematics, data.q) if frames is None and not data.without_device else 0
    name, places, entries = plain(model.name), data.places, Entries()
    resting = data if data.without_device or places is None else data.rows(places >= 0)
    judged = resting
    if places is not None and not data.without_device:
        judged = data.rows(places < 0)
        errors, entries = _shown(kinematics, judged, f"Position errors of {name} in mm")
        check_plausible(kinematics, judged, errors)
    errors, spread = _shown(kinematics, resting, f"{SPREAD_TITLE} of {name}")
    record.add(errors=entries | {"in_sockets": spread} if entries else spread, files={})
    say_places(frames)
    if elsewhere:
        warn_user(sentence(f"{elsewhere} {OF_OTHER_FRAMES}", fix=NAME_SESSIONS))
    for line in [*socket_lines(errors, "all rows"), *expectation_lines(kinematics)]:
        say(line)
    warn_outside_range(kinematics, data.q)
    if limit is not None:
        used = rows_used_in_fit(kinematics, judged.q)
        new = ~used if not used.all() else used
        rows = f"{int(new.sum())} rows{' not used in the fit' * bool((~used).any())}"
        accept(evaluate(kinematics, judged.rows(new)).rms, limit, rows)


def _shown(model: CalibratedKinematics, data: Measurements, title: str) -> tuple[Evaluation, Entries]:
    """Print a table of the errors of some rows; the errors of all of them, and entries for programs."""
    errors, used = evaluate(model, data), rows_used_in_fit(model, data.q)
    table = error_table(title, "rows")
    add_errors(table, errors, f"{len(used)} in all")
    entries = {"all": errors_entry(errors)}
    for label, mask in {"used in the fit": used, "not used in the fit": ~used}.items():
        if used.any() and mask.any():
            some = evaluate(model, data.rows(mask))
            add_errors(table, some, f"{int(mask.sum())} {label}")
            entries[label.replace(" ", "_")] = errors_entry(some)
    out.print(table)
    return errors, entries
