"""Measurements as consoles and notebooks show them: counts, ranges of the joints and of the measured places."""

from __future__ import annotations

from math import degrees
from typing import Any

from torch import Tensor

from diffeo_calib.common.errors import printable
from diffeo_calib.common.notebook import table_html
from diffeo_calib.measurements.pose_frames import seen_bodies
from diffeo_calib.measurements.sockets import NO_SOCKET
from diffeo_calib.measurements.table_frame import reading_names
from diffeo_calib.measurements.visibility import hidden_words

HEADER = ("column", "from [rad or m]", "to", "degrees")


def measurements_text(self: Any) -> str:
    """Counts of rows, joints and markers of measurements, as their method."""
    counts = (len(self), "row"), (self.n, "joint"), (self.markers, "marker")
    parts = [f"{count} {thing}" + "s" * (count != 1) for count, thing in counts]
    if self.sockets is not None:
        named = f"{len(self.sockets.names)} sockets"
        if self.without_device:
            return f"Measurements({', '.join(parts[:2])}, {named})"
        resting = int((self.socket != NO_SOCKET).sum())
        return f"Measurements({', '.join(parts)}, the last one in {named} in {resting} of the rows)"
    if self.poses is not None:
        frames = self.frames.shape[1]
        parts = [*parts[:2], f"poses on {frames} tips" if frames > 1 else "poses"]
    parts += hidden_words(seen_bodies(self))
    return f"Measurements({', '.join(parts)})"


def readings_text(self: Any) -> str:
    """Counts of rows and devices of readings, as their method."""
    devices = len(self.names)
    return f"Readings({len(self)} {self.kind}s of {devices} device" + "s" * (devices != 1) + ")"


def measurements_html(data: Any) -> str:
    """Ranges of every column, in SI units and, for joints that may turn, in degrees."""
    return table_html(repr(data), HEADER, _joint_ranges(data) + _place_ranges(data))


def readings_html(data: Any) -> str:
    """The same for readings, in m or pixels."""
    return table_html(repr(data), HEADER, _joint_ranges(data) + _reading_ranges(data))


def observations_html(data: Any) -> str:
    """The same for rows of several kinds."""
    rows = _joint_ranges(data)
    for part in data.parts:
        rows += _reading_ranges(part) if hasattr(part, "values") else _place_ranges(part)
    return table_html(repr(data), HEADER, rows)


def _joint_ranges(data: Any) -> list[list[str]]:
    rows = []
    for joint, values in enumerate(data.q.T):
        name = printable(data.joint_names[joint]) if data.joint_names else f"joint {joint}"
        low, high = float(values.min()), float(values.max())
        rows.append([name, f"{low:.4f}", f"{high:.4f}", f"{degrees(low):.1f} to {degrees(high):.1f} if it turns"])
    return rows


def _place_ranges(data: Any) -> list[list[str]]:
    places = data.points if data.poses is None else data.frames[..., :3, 3]
    places = places.flatten(0, 1)
    measured = places[~places.isnan().any(1)]  # no row of a ball in sockets
    return [_range(axis, values, "m") for axis, values in zip("xyz", measured.T, strict=True) if len(measured)]


def _reading_ranges(data: Any) -> list[list[str]]:
    unit = {"px": "px", "mm": "m"}.get(data.unit[0], "rad")
    return [_range(name, values, unit) for name, values in zip(reading_names(data), data.reported.T, strict=True)]


def _range(name: str, values: Tensor, unit: str) -> list[str]:
    return [name, f"{float(values.min()):.4f}", f"{float(values.max()):.4f}", unit]
