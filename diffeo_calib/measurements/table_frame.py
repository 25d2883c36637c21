"""Measurements as a data frame."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.data_frames import data_frame
from diffeo_calib.measurements.pose_frames import frame_tips
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.sockets import row_sockets


def measurements_frame(data: Any) -> Any:
    """A pandas.DataFrame of the rows, in SI units, whose index are the line numbers.

    Its columns are the joints (q1, q2, ... without names), x, y and z of the marker, or NAME_x, ... of several; for
    poses x, y, z and a rotation vector rx, ry, rz, or TIP_x, ... of several; for a ball in sockets their names, as
    socket. Then known standard deviations as std_x, ..., std_rx, ..., names of set-ups as session, and known masses as
    payload. Poses seen by a camera on the tool are those of the camera in the board's frame, with the deviations along
    the camera's axes.

    Raises:
        ImportError: pandas is not installed.
    """
    columns = _joint_columns(data)
    if data.sockets is not None:
        columns["socket"] = row_sockets(data)
    triples = [name for triple in default_triples(data) for name in triple]
    places = data.points if data.poses is None else data.frames[..., :3, 3]
    columns |= dict(zip(triples, places.flatten(1).T, strict=data.sockets is None))
    turns = [f"{prefix}{name}" for prefix in frame_prefixes(data) for name in ("rx", "ry", "rz")]
    if data.poses is not None:
        columns |= dict(zip(turns, visible_rotation_numbers(data.frames, "rotvec", "rad").flatten(1).T, strict=True))
    if data.std is not None:
        columns |= dict(zip([f"std_{name}" for name in triples], data.std.flatten(1).T, strict=data.sockets is None))
    if data.rotation_std is not None:
        columns |= dict(zip([f"std_{name}" for name in turns], data.rotation_std.flatten(1).T, strict=True))
    if data.session is not None:
        columns["session"] = data.device_names
    return _frame(data, columns)


def readings_frame(data: Any) -> Any:
    """A pandas.DataFrame of the rows, in m and pixels, whose index are the line numbers.

    Its columns are the joints, then distance, displacement (of an unknown zero), height, or u and v of images; known
    standard deviations as std_distance, ...; the names of the devices as session, and known masses as payload.

    Raises:
        ImportError: pandas is not installed.
    """
    names = reading_names(data)
    columns = _joint_columns(data) | dict(zip(names, data.reported.T, strict=True))
    if data.std is not None:
        columns |= dict(zip([f"std_{name}" for name in names], data.reported_std.T, strict=True))
    return _frame(data, columns | {"session": data.device_names})


def observations_frame(data: Any) -> Any:
    """A pandas.DataFrame of the rows, in SI units and pixels, whose index are the line numbers.

    Its columns are kind, those of :meth:`Measurements.to_frame` and of :meth:`Readings.to_frame`; cells are empty (NaN)
    where rows of a kind have no such value.

    Raises:
        ImportError: pandas is not installed.
    """
    frames = [part.to_frame() for part in data.parts]
    order = torch.cat(data.index).argsort().numpy()
    import pandas  # noqa: PLC0415  # optional; the line before has found it

    whole = pandas.concat(frames).iloc[order]
    whole.insert(0, "kind", data.kinds)
    return whole


def reading_names(data: Any) -> tuple[str, ...]:
    """Names of the columns of readings."""
    if data.kind == "image":
        return ("u", "v")
    name, count = "displacement" if data.offset_std else data.kind, data.values.shape[1]
    return (name,) if count == 1 else tuple(f"{name} {number + 1}" for number in range(count))


def _joint_columns(data: Any) -> dict[str, Any]:
    names = data.joint_names or [f"q{joint + 1}" for joint in range(data.n)]
    return dict(zip(names, data.q.T, strict=True))


def _frame(data: Any, columns: dict[str, Any]) -> Any:
    if data.payload is not None:
        columns["payload"] = data.payload
    return data_frame(columns, data.line_numbers.numpy())


def default_triples(data: Any) -> list[tuple[str, ...]]:
    """Names of the position columns of measurements that are written; none for a ball in sockets, the last marker."""
    if data.poses is not None:
        return [(f"{prefix}x", f"{prefix}y", f"{prefix}z") for prefix in frame_prefixes(data)]
    measured = data.markers - (data.sockets is not None)
    if measured == 1 and data.marker_names is None:
        return [("x", "y", "z")]
    markers = (data.marker_names or [f"marker{k + 1}" for k in range(measured)])[:measured]
    return [(f"{name}_x", f"{name}_y", f"{name}_z") for name in markers]


def frame_prefixes(data: Any) -> list[str]:
    """What the names of the columns of each measured frame begin with: nothing for a single one, else TIP_."""
    frames = 0 if data.frames is None else data.frames.shape[1]
    return [""] if frames == 1 else [f"{tip}_" for tip in frame_tips(data.on, frames)]


def visible_rotation_numbers(frames: Tensor, convention: str, angle: str) -> Tensor:
    """Rotations of frames (N, T, 4, 4) written as numbers (N, T, k), see :func:`rotation_numbers`; NaN where hidden."""
    hidden = frames.isnan().flatten(2).any(2)
    written = rotation_numbers(frames[~hidden][:, :3, :3], convention, angle=angle)
    found = written.new_full((*hidden.shape, written.shape[1]), torch.nan)
    found[~hidden] = written
    return found
