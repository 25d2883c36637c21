"""ROS 2 bags: joint states and what a device saw, by the times in their headers. Needs the package rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from diffeo_calib.cameras.detection import opencv
from diffeo_calib.common.errors import InputError, MeasurementError, few
from diffeo_calib.measurements.stops import Array, Recording

PLACES = ("point", "pose.position", "pose.pose.position", "transform.translation")
TURNS = ("pose.orientation", "pose.pose.orientation", "transform.rotation")
"""Where messages of geometry_msgs with a header hold places and rotations."""
CHANNELS = {"mono8": [0], "8UC1": [0], "bgr8": [0, 1, 2], "8UC3": [0, 1, 2], "rgb8": [2, 1, 0]}
"""Encodings of sensor_msgs/Image: where a pixel has its grey value, or blue, green and red."""
SUFFIXES = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"BM": ".bmp", b"II*\0": ".tif", b"MM\0*": ".tif"}
"""First bytes of compressed images that `images` reads."""


def read_bag(bag: Path, joints: str, seen: str) -> tuple[Recording, list[str], Recording]:
    """Two topics of a bag.

    Args:
        joints: topic of sensor_msgs/JointState. seen: of geometry_msgs, stamped points, poses or transforms; or images.

    Returns:
        joint values (T, n), rad or m, and the joints' names; places (T, 3), m, with unit quaternions (T, 7) if there
        are any, or (T, 0) for images.

    Raises:
        InputError: rosbags is missing, or the bag cannot be read. MeasurementError: topics that it does not have, or
            that hold something else.
    """
    states, places, names = [], [], list[str]()
    for topic, message in _messages(bag, (joints, seen)):
        time = _time(message, topic)
        if topic == seen:
            places.append([time, *_place(message, seen)])
            continue
        if not hasattr(message, "position"):
            expected = "sensor_msgs/JointState"
            raise MeasurementError.of(f"messages of {joints}", expected=expected, got=type(message).__name__)
        names = names or list(message.name)
        if names != list(message.name):
            raise MeasurementError.of(f"{joints}: joint states of {few(names)} and of {few(message.name)}")
        if len(message.position) != len(names):
            got = str(len(message.position))
            raise MeasurementError.of(f"positions in {joints}", expected=f"{len(names)} joints", got=got)
        states.append([time, *message.position])
    return _recording(states, joints), names, _recording(places, seen)


def read_images(bag: Path, topic: str, times: Collection[float]) -> Iterator[tuple[float, str, bytes]]:
    """The images of some times [s]: time, suffix and content of a file.

    Raises:
        InputError: OpenCV is missing. MeasurementError: no sensor_msgs/Image or CompressedImage, or an encoding that is
            not read.
    """
    for _, message in _messages(bag, (topic,)):
        time = _time(message, topic)
        if time in times:
            content = bytes(message.data)
            if hasattr(message, "encoding"):
                yield time, ".png", _png(message, content, topic)
                continue
            suffix = next((suffix for first, suffix in SUFFIXES.items() if content.startswith(first)), None)
            if suffix is None:
                got = str(getattr(message, "format", type(message).__name__))
                raise MeasurementError.of(f"images of {topic}", expected=f"one of {few([*SUFFIXES.values()])}", got=got)
            yield time, suffix, content


def _png(message: Any, content: bytes, topic: str) -> bytes:
    """A sensor_msgs/Image as a file."""
    if message.encoding not in CHANNELS:
        expected = f"one of {few([*CHANNELS])}"
        raise MeasurementError.of(f"the encoding of images of {topic}", expected=expected, got=message.encoding)
    order, height, width = CHANNELS[message.encoding], message.height, message.width
    if not height or len(content) < height * message.step or message.step < width * len(order):
        got = f"{width} x {height} pixels in {len(content)} bytes"
        raise MeasurementError.of(f"an image of {topic}", expected="all of its rows", got=got)
    lines: Array = np.frombuffer(content, np.uint8)[: height * message.step].reshape(height, message.step)
    pixels = lines[:, : width * len(order)].reshape(height, width, len(order))[:, :, order]
    return opencv().imencode(".png", pixels)[1].tobytes()


def _messages(bag: Path, wanted: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """Topic and content of the messages of some topics."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
    except ImportError as error:
        what, fix = "bags are read by the package rosbags, which is not installed", "pip install 'diffeo_calib[ros]'"
        raise InputError.of(what, fix=fix) from error
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = sorted({one.topic for one in reader.connections})
            missing = [topic for topic in wanted if topic not in topics]
            if missing:
                expected = f"one of {few(topics)}" if topics else "topics with messages"
                raise MeasurementError.of(f"{bag}: no topic {few(missing)}", expected=expected)
            connections = [one for one in reader.connections if one.topic in wanted]
            for one, _, raw in reader.messages(connections=connections):
                yield one.topic, reader.deserialize(raw, one.msgtype)
    except (OSError, AnyReaderError) as error:
        raise InputError.of(f"{bag} cannot be read", expected="a ROS 2 bag", got=str(error)) from error


def _time(message: Any, topic: str) -> float:
    """Of the header, s."""
    header = getattr(message, "header", None)
    if header is None:
        fix = "record the stamped kind of message"
        raise MeasurementError.of(f"messages of {topic}", expected="a header", got=type(message).__name__, fix=fix)
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def _place(message: Any, topic: str) -> list[float]:
    """Place and, if the message has one, rotation; nothing of an image."""
    if hasattr(message, "encoding") or hasattr(message, "format"):
        return []
    place = next(filter(None, (_part(message, path) for path in PLACES)), None)
    if place is None:
        expected = "stamped points, poses or transforms of geometry_msgs, or images"
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
    if table[0, 0] == table[-1, 0]:
        raise MeasurementError.of(f"headers of {topic}", expected="times", got=f"{table[0, 0]:g} s in all of them")
    if table.shape[1] == 8:
        turned = (table[1:, 4:] * table[:-1, 4:]).sum(1) < 0
        table[1:, 4:] *= np.cumprod(np.where(turned, -1.0, 1.0))[:, None]
    return Recording(table[:, 0], table[:, 1:])
