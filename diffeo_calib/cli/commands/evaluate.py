"""`diffeo-calib evaluate`: the errors of a model on a table of measurements."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.error_tables import add_errors, error_table
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.registration_lines import registration_lines
from diffeo_calib.cli.tables import MeasuredTable
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.interop.model_file import save
from diffeo_calib.kinematics.evaluation import evaluate, rows_used_in_fit, warn_implausible, warn_outside_range
from diffeo_calib.kinematics.re_registration.motions import motions


def run(model: Path, source: MeasuredTable) -> None:
    """Print errors on all rows, on the rows of the fit and on the other rows; warn of suspicious rows and errors."""
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    data = source.read(kinematics.robot)
    warn_outside_range(kinematics, data.q)
    errors = evaluate(kinematics, data)
    table = error_table(f"Position errors of {plain(model.name)} in mm", "rows", angles=errors.angles is not None)
    add_errors(table, errors, f"{len(data)} in all")
    used = rows_used_in_fit(kinematics, data.q)
    for mask, label in ((used, "used in the fit"), (~used, "not used in the fit")):
        if used.any() and mask.any():
            add_errors(table, evaluate(kinematics, data.rows(mask)), f"{int(mask.sum())} {label}")
    out.print(table)
    named = motions(kinematics.map, kinematics.nominal, kinematics.lever, data)
    for motion in named:
        warn_user(sentence(motion.sentence, fix="evaluate with --register"))
    if not named:
        warn_implausible(kinematics, data, errors)


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
    table = error_table(f"Position errors of {plain(model.name)} in mm", "rows", angles=errors.angles is not None)
    if found.registration is not None and found.registration.rms_before is not None:
        add_errors(table, evaluate(kinematics, data), f"{len(data)} before registration")
    add_errors(table, errors, f"{len(data)} after registration")
    out.print(table)
    for line in registration_lines(found):
        say(line)
    if output is not None:
        say(f"registered model: {output}")
