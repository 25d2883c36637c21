"""`diffeo-calib evaluate`: the errors of a model on a table of measurements."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.calibration.contradicted_rows import block_text, contradicted, step_text, steps_of
from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.error_tables import add_errors, error_table, outlier_lines
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.registration_lines import registration_lines
from diffeo_calib.cli.tables import MeasuredTable
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
from diffeo_calib.kinematics.re_registration.motions import motions
from diffeo_calib.measurements.table import Measurements


def run(model: Path, source: MeasuredTable) -> None:
    """Print errors on all rows, on the rows of the fit and on the other rows; judge suspicious rows and errors.

    Raises:
        MeasurementError: see :func:`_judge`; the errors have been printed by then.
    """
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
    _judge(kinematics, data, errors)


def _judge(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> None:
    """Name rows that look wrong, and warn of a likely cause of large errors.

    Raises:
        MeasurementError: rows out of step with their joints, or errors that say nothing about the robot.
    """
    steps = steps_of(model, data)
    if steps:
        raise MeasurementError(step_text(steps[0]))
    named = motions(model.map, model.nominal, model.lever, data)
    causes = [sentence(motion.sentence, fix="evaluate with --register") for motion in named]
    causes = causes or [text for text in [implausible(model, data, errors)] if text is not None]
    if impossible(model, errors):
        raise MeasurementError(" ".join(causes))
    if not causes:
        wrong = contradicted(model, data)
        for line in outlier_lines(wrong, len(data), "rows"):
            say(line)
        causes = [text for text in [block_text(model, data, wrong)] if text is not None]
    for text in causes:
        warn_user(text)


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
