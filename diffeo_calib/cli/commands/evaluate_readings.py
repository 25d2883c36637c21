"""`diffeo-calib evaluate --reading`: errors of readings, whose devices are placed where they fit best."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.commands.acceptance import accept
from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.cli.tables.readings import (
    add_reading_errors,
    errors_in_unit,
    reading_entry,
    reading_table,
)
from diffeo_calib.cli.tables.sockets import expectation_lines
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.kinematics.evaluation import Evaluation, impossible, rows_used_in_fit, warn_outside_range
from diffeo_calib.kinematics.reading_errors import placed
from diffeo_calib.sensors.devices import FLATTERY


def run(model: Path, source: MeasuredTable, *, limit: float | None = None) -> None:
    """Print errors of all rows, of the rows of the fit and of the other rows.

    Args:
        model: its file. source: the table. limit: largest RMS error of new rows, m, that is good enough.

    Raises:
        InputError: a model that was calibrated with measured positions, or a limit in mm for images.
        MeasurementError: errors that say nothing about the robot.
    """
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    data = source.read(kinematics.robot)
    if limit is not None and data.kind == "image":
        fix = "leave it out, and judge the errors in pixels"
        raise InputError.of("--fail-above with --reading image", expected="readings in units of length", fix=fix)
    devices = placed(kinematics, data)
    away = devices.errors(data, kinematics(data.q).detach()[:, -1])
    errors, used = errors_in_unit(devices, data, away), rows_used_in_fit(kinematics, data.q)
    table = reading_table(f"of {plain(model.name)}", data, "rows")
    add_reading_errors(table, errors, f"{len(used)} in all")
    entries = {"all": reading_entry(errors, data.unit[0])}
    for label, mask in {"used in the fit": used, "not used in the fit": ~used}.items():
        if used.any() and mask.any():
            add_reading_errors(table, errors.rows(mask), f"{int(mask.sum())} {label}")
            entries[label.replace(" ", "_")] = reading_entry(errors.rows(mask), data.unit[0])
    record.add(reading_errors=entries, files={})
    out.print(table)
    if impossible(kinematics, Evaluation(away.norm(dim=1, keepdim=True))):
        what, got = (
            "these errors are not those of a calibrated robot",
            f"a median of {errors.median:.4g} {data.unit[0]}",
        )
        fix = "check --length, the columns of --reading, and --session, which names the device of every row"
        raise MeasurementError.of(what, got=got, fix=fix)
    say(f"the places of the devices were found from these rows: {', '.join(map(plain, data.names))}")
    for line in expectation_lines(kinematics, FLATTERY):
        say(line)
    warn_outside_range(kinematics, data.q)
    if limit is not None:
        new = ~used if not used.all() else used
        rows = f"{int(new.sum())} rows{' not used in the fit' * bool((~used).any())}"
        accept(errors.rows(new).rms / data.unit[1], limit, rows)
