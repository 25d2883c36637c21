"""Numbers and units in texts, for all exports."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from math import degrees

from torch import Tensor

from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.measurements.table_format import UNITS_PER_METRE
from diffeo_calib.robots.se3 import roll_pitch_yaw_angles

LENGTHS, ANGLES = UNITS_PER_METRE, {"rad": 1.0, "deg": degrees(1.0)}
"""Units of tables, per metre and per radian."""


def origin_numbers(transform: Tensor) -> tuple[list[float], list[float]]:
    """A rigid transform (4, 4) as x, y, z [m] and roll, pitch, yaw [rad], R = Rz(yaw) Ry(pitch) Rx(roll)."""
    xyz, rpy = transform[:3, 3].tolist(), roll_pitch_yaw_angles(transform[:3, :3])
    return [value + 0.0 for value in xyz], [value + 0.0 for value in rpy]  # no -0.0


def check_units(length: str, angle: str) -> None:
    """Raise InputError for a unit that tables do not have."""
    for name, value, known in (("length", length, LENGTHS), ("angle", angle, ANGLES)):
        if value not in known:
            raise InputError.of(f"`{name}`", expected=" or ".join(map(repr, known)), got=as_written(value))


def in_unit(values: Sequence[float], unit: str) -> list[float]:
    """Lengths in m or angles in rad -> in a unit."""
    return [value * (LENGTHS | ANGLES)[unit] for value in values]


def table_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table as CSV; numbers are read back to the last bit."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()
