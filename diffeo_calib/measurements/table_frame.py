"""Measurements as a data frame."""

from __future__ import annotations

from typing import Any

from diffeo_calib.common.data_frames import data_frame
from diffeo_calib.measurements.poses import rotation_numbers


def measurements_frame(data: Any) -> Any:
    """A pandas.DataFrame of the rows, in SI units, whose index are the line numbers.

    Its columns are the joints (q1, q2, ... without names), x, y and z of the marker, or NAME_x, ... of several; for
    poses x, y, z and a rotation vector rx, ry, rz; then known standard deviations as std_x, ..., std_rx, ..., and
    known masses as payload.

    Raises:
        ImportError: pandas is not installed.
    """
    names = data.joint_names or [f"q{joint + 1}" for joint in range(data.n)]
    columns = dict(zip(names, data.q.T, strict=True))
    triples = [name for triple in default_triples(data) for name in triple]
    places = data.points if data.poses is None else data.poses[:, None, :3, 3]
    columns |= dict(zip(triples, places.flatten(1).T, strict=True))
    turns = ("rx", "ry", "rz")
    if data.poses is not None:
        columns |= dict(zip(turns, rotation_numbers(data.poses[:, :3, :3], "rotvec", angle="rad").T, strict=True))
    if data.std is not None:
        columns |= dict(zip([f"std_{name}" for name in triples], data.std.flatten(1).T, strict=True))
    if data.rotation_std is not None:
        columns |= dict(zip([f"std_{name}" for name in turns], data.rotation_std.T, strict=True))
    if data.payload is not None:
        columns["payload"] = data.payload
    return data_frame(columns, data.line_numbers.numpy())


def default_triples(data: Any) -> list[tuple[str, ...]]:
    """Names of the position columns of measurements that are written."""
    if data.poses is not None or (data.markers == 1 and data.marker_names is None):
        return [("x", "y", "z")]
    markers = data.marker_names or [f"marker{k + 1}" for k in range(data.markers)]
    return [(f"{name}_x", f"{name}_y", f"{name}_z") for name in markers]
