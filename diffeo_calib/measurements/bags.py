"""ROS 2 bags: joint states and what a device saw, by the times in their headers. Needs the package rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffeo_calib.common.errors import InputError, MeasurementError, few
from diffeo_calib.measurements.stops import Array, Recording

PLACES = ("point", "pose.position", "pose.pose.position", "transform.translation")
TURNS = ("pose.orientation", "pose.pose.orientation", "transform.rotation")
"""Where messages of geometry_msgs with a header hold places and rotations."""


def read_bag(bag: Path, joints: str, seen: str) -> tuple[Recording, list[str], Recording]:
    """Two topics of a bag.

    Args:
        joints: topic of sensor_msgs/JointState. seen: of geometry_msgs, stamped points, poses or transforms.

    Returns:
        joint values (T, n), rad or m, and the joints' names; places (T, 3), m, or with unit quaternions (T, 7).

    Raises:
        InputError: rosbags is missing, or the bag cannot be read. MeasurementError: topics that it does not have, or
            that hold something else.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
    except ImportError as error:
        fix = "pip install 'diffeo_calib[camera]'"
        raise InputError.of("reading bags", expected="the package rosbags", got="none", fix=fix) from error
    states, places, names = [], [], list[str]()
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = sorted({one.topic for one in reader.connections})
            missing = [topic for topic in (joints, seen) if topic not in topics]
            if missing:
                raise MeasurementError.of(f"{bag}: no topic {few(missing)}", expected=f"one of {few(topics)}")
            wanted = [one for one in reader.connections if one.topic in (joints, seen)]
            for one, _, raw in reader.messages(connections=wanted):
                message: Any = reader.deserialize(raw, one.msgtype)
                time = _time(message, one.topic)
                if one.topic == seen:
                    places.append([time, *_place(message, seen)])
                    continue
                names = names or list(message.name)
                if names != list(message.name):
                    raise MeasurementError.of(f"{joints}: joint states of {few(names)} and of {few(message.name)}")
                if len(message.position) != len(names):
                    got = str(len(message.position))
                    raise MeasurementError.of(f"positions in {joints}", expected=f"{len(names)} joints", got=got)
                states.append([time, *message.position])
    except (OSError, AnyReaderError) as error:
        raise InputError.of(f"{bag} cannot be read", expected="a ROS 2 bag", got=str(error)) from error
    return _recording(states, joints), names, _recording(places, seen)


def _time(message: Any, topic: str) -> float:
    """Of the header, s."""
    header = getattr(message, "header", None)
    if header is None:
        fix = "record the stamped kind of message"
        raise MeasurementError.of(f"messages of {topic}", expected="a header", got=type(message).__name__, fix=fix)
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def _place(message: Any, topic: str) -> list[float]:
    """Place and, if the message has one, rotation."""
    place = next(filter(None, (_part(message, path) for path in PLACES)), None)
    if place is None:
        expected = "stamped points, poses or transforms of geometry_msgs"
        raise MeasurementError.of(f"messages of {topic}", expected=expected, got=type(message).__name__)
    turn = next(filter(None, (_part(message, path) for path in TURNS)), None)
    return [place.x, place.y, place.z] + ([] if turn is None else [turn.x, turn.y, turn.z, turn.w])


def _part(message: Any, path: str) -> Any:
    for name in path.split("."):
        message = getattr(message, name, None)
    return message


def _recording(rows: list[list[float]], topic: str) -> Recording:
    """Rows (time, values) in the order of time; quaternions with one sign."""
    if len(rows) < 3:
        raise MeasurementError.of(f"messages of {topic}", expected="at least 3", got=str(len(rows)))
    table: Array = np.array(sorted(rows))
    if table.shape[1] == 8:
        turned = (table[1:, 4:] * table[:-1, 4:]).sum(1) < 0
        table[1:, 4:] *= np.cumprod(np.where(turned, -1.0, 1.0))[:, None]
    return Recording(table[:, 0], table[:, 1:])
