"""`diffeo-calib evaluate --socket`: spread within sockets, known distances, and the absolute error to expect."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.commands.acceptance import accept
from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.error_tables import add_errors, error_table
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.record import errors_entry, record
from diffeo_calib.cli.socket_tables import SPREAD_TITLE, expectation_lines, socket_lines
from diffeo_calib.cli.tables import MeasuredTable
from diffeo_calib.kinematics.evaluation import evaluate, rows_used_in_fit, warn_outside_range


def run(model: Path, source: MeasuredTable, *, limit: float | None = None) -> None:
    """Print the spread of all rows, of the rows of the fit and of the other rows, and the errors of known distances.

    Args:
        model: its file. source: the table. limit: largest RMS spread of new rows, m, that is good enough.

    Raises:
        InputError: a model that was calibrated with measured positions.
    """
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    data = source.read(kinematics.robot)
    errors, used = evaluate(kinematics, data), rows_used_in_fit(kinematics, data.q)
    parts = {"used in the fit": used, "not used in the fit": ~used}
    table = error_table(f"{SPREAD_TITLE} of {plain(model.name)}", "rows")
    add_errors(table, errors, f"{len(used)} in all")
    entries = {"all": errors_entry(errors)}
    for label, mask in parts.items():
        if used.any() and mask.any():
            some = evaluate(kinematics, data.rows(mask))
            add_errors(table, some, f"{int(mask.sum())} {label}")
            entries[label.replace(" ", "_")] = errors_entry(some)
    record.add(errors=entries, files={})
    out.print(table)
    for line in [*socket_lines(errors, "all rows"), *expectation_lines(kinematics)]:
        say(line)
    warn_outside_range(kinematics, data.q)
    if limit is not None:
        new = ~used if not used.all() else used
        rows = f"{int(new.sum())} rows{' not used in the fit' * bool((~used).any())}"
        accept(evaluate(kinematics, data.rows(new)).rms, limit, rows)
