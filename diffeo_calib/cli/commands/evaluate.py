"""`diffeo-calib evaluate`: the errors of a model on a table of measurements."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.console import out, say
from diffeo_calib.cli.error_tables import add_errors, error_table
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.tables import MeasuredTable
from diffeo_calib.kinematics.evaluation import evaluate, rows_used_in_fit, warn_implausible, warn_outside_range


def run(model: Path, source: MeasuredTable) -> None:
    """Print errors on all rows, on the rows of the fit and on the other rows; warn of suspicious rows and errors."""
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    data = source.read(kinematics.robot)
    warn_outside_range(kinematics, data.q)
    errors = evaluate(kinematics, data)
    table = error_table(f"Position errors of {model.name} in mm", "rows", angles=errors.angles is not None)
    add_errors(table, errors, f"{len(data)} in all")
    used = rows_used_in_fit(kinematics, data.q)
    for mask, label in ((used, "used in the fit"), (~used, "not used in the fit")):
        if used.any() and mask.any():
            add_errors(table, evaluate(kinematics, data.rows(mask)), f"{int(mask.sum())} {label}")
    out.print(table)
    warn_implausible(kinematics, data, errors)
