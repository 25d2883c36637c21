"""What is printed about readings. Imports torch."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from diffeo_calib.cli.error_tables import error_table
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.sensors.devices import Devices

NAMES = ("rms", "median", "p95", "max")


def errors_in_unit(devices: Devices, data: Readings, errors: Any) -> Evaluation:
    """Errors (N, r) in m as an evaluation in the unit of the readings, mm or pixels."""
    return Evaluation(devices.in_unit(data, errors).norm(dim=1, keepdim=True))


def reading_table(title: str, data: Readings, *columns: str) -> Table:
    """An empty table of errors of readings in their own unit."""
    return error_table(f"Errors of {data.kind}s in {data.unit[0]} {title}", *columns)


def add_reading_errors(table: Table, errors: Evaluation, *labels: str) -> None:
    """Add a row of errors in the unit of the readings."""
    table.add_row(*labels, *(f"{getattr(errors, name):.4f}" for name in NAMES))


def reading_entry(errors: Evaluation, unit: str) -> dict[str, object]:
    """The same for programs."""
    return {"rows": len(errors.errors), "unit": unit} | {name: getattr(errors, name) for name in NAMES}
