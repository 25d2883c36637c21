"""Tables of readings as the options describe them, and what is printed about them. Imports torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from rich.table import Table

from diffeo_calib.cli.error_tables import error_table
from diffeo_calib.cli.tables import positions
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.kinematics.reading_devices import Devices
from diffeo_calib.measurements.csv.files import read_observations
from diffeo_calib.measurements.csv.sensors import ReadingColumns, TableColumns
from diffeo_calib.measurements.readings import ReadingKind, Readings
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.tree import Tree

KINDS: dict[str, ReadingKind] = {"distance": "distance", "displacement": "distance", "height": "height"}
"""Kinds with one column."""
UNKNOWN_ZERO_M = 1.0
"""Standard deviation of the unknown zero of displacements: wide."""
NAMES = ("rms", "median", "p95", "max")


@dataclass(frozen=True)
class ReadingTable:
    """A table of readings as the options describe it.

    Args:
        csv: the file. joints: names of the joint columns, separated by commas; None for those of the robot.
        table: the format. columns: those of the readings. duplicates: what to do with exactly repeated rows.
    """

    csv: Path
    joints: str | None
    table: TableFormat
    columns: ReadingColumns
    duplicates: str

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> ReadingTable:
        """From the options of `fit` or `evaluate`.

        Raises:
            InputError: options that are not written as they should be.
        """
        table = positions.table_format(
            *(options[name] for name in ("length", "angle", "sep", "decimal", "joint_length"))
        )
        columns = _columns(options["reading"][0], options["session"])
        return cls(options["csv"], options["joints"], table, columns, options.get("duplicates") or "keep")

    def read(self, robot: Tree) -> Readings:
        """The readings, under the names of the robot's own joints."""
        names = positions.joint_columns(self.joints, robot)
        columns = TableColumns(names, readings=(self.columns,), kinds=robot.kinds)
        read = read_observations(self.csv, columns, self.table, duplicates=self.duplicates)
        return read.with_joint_names(robot.joint_names)


def _columns(text: str, device: str | None) -> ReadingColumns:
    """KIND=COLUMN as columns; images have two, and the four numbers of their cameras."""
    kind, _, rest = text.partition("=")
    words = tuple(word.strip() for word in rest.split(","))
    numbers = [_number(word) for word in words]
    if kind == "image" and len(words) == 6 and all(words[:2]):
        fx, fy, cx, cy = numbers[2:]
        if fx and fy and cx is not None and cy is not None and min(fx, fy) > 0.0:
            return ReadingColumns("image", words[:2], device, intrinsics=(fx, fy, cx, cy))
    elif kind in KINDS and len(words) == 1 and words[0]:
        value = words if numbers[0] is None else numbers[0]
        if kind == "distance" and isinstance(value, float) and value <= 0.0:
            fix = "write the length of the ball bar in the unit of --length, or name a column"
            raise InputError.of(f"--reading {text}", expected="a distance above 0", fix=fix)
        return ReadingColumns(KINDS[kind], value, device, UNKNOWN_ZERO_M * (kind == "displacement"))
    expected = "distance=COLUMN, displacement=COLUMN, height=COLUMN or image=U,V,FX,FY,CX,CY"
    raise InputError.of(f"--reading {text}", expected=expected, fix="focal lengths FX, FY are positive pixels")


def _number(text: str) -> float | None:
    """A finite number; None for the name of a column."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None


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
