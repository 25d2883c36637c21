"""ROS bags: joint states and what a device saw, by the times in their headers. Needs the package rosbags."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffeo_calib.cameras.detection import opencv
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, InputError, MeasurementError, few, warn_user
from diffeo_calib.measurements.csv.joined import Array, Recording
from diffeo_calib.measurements.poses import rotation_matrices, rotation_numbers
from diffeo_calib.robots.se3 import transforms

KINDS = "PointStamped, PoseStamped, PoseWithCovarianceStamped, TransformStamped, Odometry, TFMessage or images"
"""Messages of what a device saw."""
PLACES = ("point", "pose.position", "pose.pose.position", "transform.translation")
TURNS = ("pose.orientation", "pose.pose.orientation", "transform.rotation")
"""Where messages of geometry_msgs with a header hold places and rotations."""
QUATERNION = "quat_xyzw"
CHANNELS = {"mono8": [0], "8UC1": [0], "bgr8": [0, 1, 2], "8UC3": [0, 1, 2], "rgb8": [2, 1, 0]}
"""Encodings of sensor_msgs/Image: where a pixel has its grey value, or blue, green and red."""
SUFFIXES = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"BM": ".bmp", b"II*\0": ".tif", b"MM\0*": ".tif"}
"""First bytes of compressed images that `images` reads."""
_Rows = list[list[float]]  # times, s, each with values
_Edge = tuple[str, str]  # parent and child of a transform
LONGEST_GAP_S, LONGEST_GAP = 0.5, 5.0
"""The larger of these, s and median intervals, is the longest time between messages across which is interpolated."""


def read_bag(bag: Path, joints: str, view: str) -> tuple[Recording, list[str], Recording]:
    """Two topics of a bag: joint values (T, n), rad or m, their names, and places (T, 3), m, perhaps with quaternions.

    Joints are joined by their names over all messages and publishers: each has the times of the messages that hold it,
    between which its values are interpolated. Of images there is nothing but times: (T, 0).
    joints: topic of sensor_msgs/JointState, or TOPIC:NAME,NAME for some of its joints.
    view: of geometry_msgs, stamped points, poses or transforms; or images. Of tf2_msgs/TFMessage with the frame
        whose motion was measured: TOPIC:CHILD, or TOPIC:PARENT>CHILD for two frames that transforms join.
    Raises InputError: rosbags is missing, or the bag cannot be read.
    Raises MeasurementError: topics, joints or frames that it does not have, or topics that hold something else.
    """
    (joints, _, wanted), (view, _, frames) = (words.partition(":") for words in (joints, view))
    states, edges, fixed = dict[str, _Rows](), dict[_Edge, _Rows](), set[_Edge]()
    places: _Rows = []
    for topic, message in _messages(bag, (joints, view), f"{view}_static"):
        if topic == joints != view:
            _add_joints(states, message, topic)
            continue
        for transform in getattr(message, "transforms", ()):
            edge = transform.header.frame_id.strip("/"), transform.child_frame_id.strip("/")
            edges.setdefault(edge, []).append([_time(transform, view), *_place(transform, view)])
            fixed |= {edge} if topic != view else set()
        if not hasattr(message, "transforms"):
            places.append([_time(message, topic), *_place(message, topic)])
    recording, names = _joined(states, [word.strip() for word in wanted.split(",") if word.strip()], joints)
    if frames and not edges:
        raise MeasurementError.of(f"frames of {view}", expected="transforms (TFMessage)", fix=f"name the topic {view}")
    return recording, names, _moving(edges, fixed, frames, view) if edges else _recording(places, view)


def _add_joints(states: dict[str, _Rows], message: Any, topic: str) -> None:
    """Add the time and value of each joint of a message; one without positions holds none."""
    if not hasattr(message, "position"):
        expected = "sensor_msgs/JointState"
        raise MeasurementError.of(f"messages of {topic}", expected=expected, got=message.__msgtype__)
    if len(message.position) not in (0, len(message.name)):
        got = str(len(message.position))
        raise MeasurementError.of(f"positions in {topic}", expected=f"{len(message.name)} joints", got=got)
    time = _time(message, topic)
    for name, value in zip(message.name, message.position, strict=False):
        if np.isfinite(value):
            states.setdefault(name, []).append([time, value])


def _joined(states: Mapping[str, _Rows], wanted: list[str], topic: str) -> tuple[Recording, list[str]]:
    """All joints, or those wanted, at the times of the one in most messages, where messages of all of them span them.

    Unless wanted, a joint whose messages span less than half of the time is left out with a warning.
    """
    missing = [name for name in wanted if name not in states]
    if missing:
        what, got = f"joints of {topic}", few([*states], 20)
        raise MeasurementError.of(what, expected=few(missing), got=got, fix="name joints that its messages hold")
    spans = {name: (min(rows)[0], max(rows)[0]) for name, rows in states.items()}
    longest = max((last - first for first, last in spans.values()), default=0.0)
    names = wanted or [name for name, (first, last) in spans.items() if 2 * (last - first) >= longest]
    left = [name for name in states if name not in names]
    if left and not wanted:
        warn_user(f"joints left out, because messages of {topic} hold them for less than half of the time: {few(left)}")
    first, last = (edge(spans[name][k] for name in names) if names else 0.0 for k, edge in enumerate((max, min)))
    most = max((states[name] for name in names), key=len, default=[])
    times: Array = np.array(sorted(time for time, _ in most if first <= time <= last))
    for name in names:
        stamps: Array = np.array(sorted(time for time, _ in states[name]))
        times = times[_near(times, stamps)] if len(stamps) > 1 else times
    parts = [np.interp(times, *np.array(sorted(states[name])).T) for name in names]
    return _recording(np.column_stack([times, *parts]).tolist(), topic), names


def _near(times: Array, stamps: Array) -> Array:
    """Which times have one of a part, in order, within the gap across which it is interpolated."""
    limit = max(LONGEST_GAP_S, LONGEST_GAP * float(np.median(np.diff(stamps))))
    after = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    return np.minimum(abs(times - stamps[after - 1]), abs(stamps[after] - times)) <= limit


def _moving(edges: Mapping[_Edge, _Rows], fixed: Collection[_Edge], frames: str, topic: str) -> Recording:
    """The motion of a frame in its parent, or in any frame to which transforms join it, at times of the rarest."""
    parent, _, child = (word.strip().strip("/") for word in frames.rpartition(">"))
    parents = [parent] if parent else [start for start, other in edges if other == child]
    paths = [path for start in parents if (path := _path(edges, start, child))]
    moved = [edge for edge, _ in paths[0] if edge not in fixed] if len(paths) == 1 else []
    if not moved:
        expected = f"one moving frame, as '{topic}:CHILD' or '{topic}:PARENT>CHILD'"
        got = f"{frames or 'none'} of {few(['>'.join(edge) for edge in edges if edge not in fixed], 20)}"
        raise MeasurementError.of(f"the frame in {topic}", expected=expected, got=got)
    tables = {edge: _recording(edges[edge], f"{'>'.join(edge)} in {topic}") for edge in moved}
    first, last = max(table.times[0] for table in tables.values()), min(table.times[-1] for table in tables.values())
    times = min((table.times for table in tables.values()), key=len)
    times = times[(times >= first) & (times <= last)]
    for table in tables.values():
        times = times[_near(times, table.times)]
    whole = torch.eye(4, dtype=torch.float64, device=HOST)
    for edge, forward in paths[0]:
        values = np.tile(edges[edge][-1][1:], (len(times), 1)) if edge not in tables else tables[edge].at(times)
        places, turns = torch.from_numpy(values).split([3, 4], 1)
        motion = transforms(rotation_matrices(turns / turns.norm(dim=1, keepdim=True), QUATERNION), places)
        whole = whole @ (motion if forward else torch.linalg.inv(motion))
    turns = rotation_numbers(whole[:, :3, :3], QUATERNION)
    return _recording(np.column_stack([times, whole[:, :3, 3], turns]).tolist(), topic)


def _path(edges: Collection[_Edge], parent: str, child: str) -> list[tuple[_Edge, bool]]:
    """The fewest transforms from one frame to another, each with whether it is taken from parent to child."""
    paths, waiting = {parent: list[tuple[_Edge, bool]]()}, deque([parent])
    while waiting:
        at = waiting.popleft()
        for edge in edges:
            for here, there in (edge, edge[::-1]):
                if here == at and there not in paths:
                    paths[there] = [*paths[at], (edge, here == edge[0])]
                    waiting.append(there)
    return paths.get(child, [])


def read_images(bag: Path, topic: str, times: Collection[float]) -> Iterator[tuple[float, str, bytes]]:
    """The images of some times [s]: time, suffix and content of a file.

    InputError if OpenCV is missing, MeasurementError for other messages, or an encoding that is not read.
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
                got = str(getattr(message, "format", message.__msgtype__))
                raise MeasurementError.of(f"images of {topic}", expected=f"one of {few([*SUFFIXES.values()])}", got=got)
            yield time, suffix, content


def _png(message: Any, content: bytes, topic: str) -> bytes:
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


def _messages(bag: Path, wanted: tuple[str, ...], optional: str = "") -> Iterator[tuple[str, Any]]:
    try:
        from rosbags.highlevel import AnyReader  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
    except ImportError as error:
        what, fix = "bags are read by the package rosbags, which is not installed", "pip install 'diffeo_calib[ros]'"
        raise InputError.of(what, fix=fix) from error
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = sorted({connection.topic for connection in reader.connections})
            missing = [topic for topic in wanted if topic not in topics]
            if missing:
                expected = f"one of {few(topics)}" if topics else "topics with messages"
                raise MeasurementError.of(f"{bag}: no topic {few(missing)}", expected=expected)
            connections = [connection for connection in reader.connections if connection.topic in (*wanted, optional)]
            for connection, _, raw in reader.messages(connections=connections):
                yield connection.topic, reader.deserialize(raw, connection.msgtype)
    except DiffeoCalibError:
        raise
    except Exception as error:  # rosbags raises errors of many kinds for damaged files
        fix = "pass the folder of a ROS 2 bag, with metadata.yaml, or the .bag file of ROS 1, or use rosbags-convert"
        raise InputError.of(f"{bag} cannot be read", got=str(error), fix=fix) from error


def _time(message: Any, topic: str) -> float:
    header = getattr(message, "header", None)
    if header is None:
        fix = "record the stamped kind of message"
        raise MeasurementError.of(f"messages of {topic}", expected=KINDS, got=message.__msgtype__, fix=fix)
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def _place(message: Any, topic: str) -> list[float]:
    """Place and, if the message has one, rotation; nothing of an image."""
    if hasattr(message, "encoding") or hasattr(message, "format"):
        return []

    def part(path: str) -> Any:
        return reduce(lambda field, name: getattr(field, name, None), path.split("."), message)

    place, turn = (next(filter(None, map(part, paths)), None) for paths in (PLACES, TURNS))
    if place is None:
        raise MeasurementError.of(f"messages of {topic}", expected=KINDS, got=message.__msgtype__)
    return [place.x, place.y, place.z] + ([] if turn is None else [turn.x, turn.y, turn.z, turn.w])


def _recording(rows: list[list[float]], topic: str) -> Recording:
    """Rows (time, values) of numbers in the order of time; quaternions with one sign."""
    rows = [row for row in rows if np.isfinite(row).all()]
    if len(rows) < 3:
        raise MeasurementError.of(f"messages of {topic}", expected="at least 3", got=str(len(rows)))
    table: Array = np.array(sorted(rows))
    if table[0, 0] == table[-1, 0]:
        raise MeasurementError.of(f"headers of {topic}", expected="times", got=f"{table[0, 0]:g} s in all of them")
    if table.shape[1] == 8:
        turned = (table[1:, 4:] * table[:-1, 4:]).sum(1) < 0
        table[1:, 4:] *= np.cumprod(np.where(turned, -1.0, 1.0))[:, None]
    return Recording(table[:, 0], table[:, 1:])
