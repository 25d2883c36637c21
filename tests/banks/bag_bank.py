"""Small ROS 2 bags; needs rosbags."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

JOINTS, PLACES, PICTURES = "/joint_states", "/at", "/camera"
STATE, POSE = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"
FRAMES = "tf2_msgs/msg/TFMessage"
RAW, PACKED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


class Bag:
    """A bag to be written: messages of a topic with the time of their headers, s."""

    def __init__(self) -> None:
        typesys = pytest.importorskip("rosbags.typesys", reason="needs rosbags")
        self.store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        self.types = self.store.types
        self.topics: dict[str, tuple[str, list[tuple[float, Any]]]] = {}

    def add(self, topic: str, kind: str, messages: Iterable[tuple[float, Any]]) -> None:
        """Messages without their header."""
        make = self.types[kind]
        filled = [(time, make(self.header(time), *fields)) for time, fields in messages]
        self.topics.setdefault(topic, (kind, []))[1].extend(filled)

    def header(self, time: float) -> Any:
        nanoseconds = round(1e9 * time)
        stamp = self.types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    def joints(self, times: np.ndarray, q: np.ndarray, names: list[str]) -> None:
        nothing = np.zeros(0)
        self.add(JOINTS, STATE, [(t, (names, row, nothing, nothing)) for t, row in zip(times, q, strict=True)])

    def poses(self, times: np.ndarray, p: np.ndarray) -> None:
        """Places, turned about z by x rad, with quaternions whose sign, which has no meaning, changes."""
        point, turn, pose = (self.types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose"))
        turns = (-1.0) ** np.arange(len(p))[:, None] * np.stack([np.sin(p[:, 0] / 2), np.cos(p[:, 0] / 2)], 1)
        each = zip(times, p, turns, strict=True)
        self.add(PLACES, POSE, [(t, (pose(point(*at), turn(0, 0, *own)),)) for t, at, own in each])

    def frames(self, topic: str, times: np.ndarray, parent: str, child: str, poses: np.ndarray) -> None:
        """Transforms (T, 7), place and quaternion x y z w, of a frame in its parent."""
        vector, turn, transform = (
            self.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion", "Transform")
        )
        stamped, message = self.types["geometry_msgs/msg/TransformStamped"], self.types[FRAMES]
        own = self.topics.setdefault(topic, (FRAMES, []))[1]
        for time, row in zip(times, poses, strict=True):
            header = self.header(time)
            header.frame_id = parent
            own.append((time, message([stamped(header, child, transform(vector(*row[:3]), turn(*row[3:])))])))

    def images(self, times: Iterable[float], pixels: np.ndarray, encoding: str) -> None:
        """The same raw image (H, W, channels) at several times; each row ends with two bytes that belong to none."""
        lines = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, 2))).astype(np.uint8)
        fields = *pixels.shape[:2], encoding, 0, lines.shape[1], lines.flatten()
        self.add(PICTURES, RAW, [(time, fields) for time in times])

    def packed(self, times: Iterable[float], content: bytes) -> None:
        """The same compressed image at several times."""
        self.add(PICTURES, PACKED, [(time, ("", np.frombuffer(content, np.uint8))) for time in times])

    def write(self, path: Path) -> Path:
        rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs rosbags")
        with rosbag2.Writer(path, version=9) as writer:
            for topic, (kind, messages) in self.topics.items():
                connection = writer.add_connection(topic, kind, typestore=self.store)
                for time, message in messages:
                    content = self.store.serialize_cdr(message, kind)
                    writer.write(connection, round(1e9 * max(time + 5, 0)), content)
        return path


def standing(places: np.ndarray, stand_s: float, move_s: float, times: np.ndarray) -> np.ndarray:
    """Joints (T, n), rad, that stand at each of some places (P, n) and move smoothly to the next."""
    number, rest = np.divmod(times, stand_s + move_s)
    share = np.clip((rest - stand_s) / move_s, 0, 1)[:, None]
    first, after = (places[np.minimum(number.astype(int) + k, len(places) - 1)] for k in (0, 1))
    return first + (after - first) * (3 * share**2 - 2 * share**3)


def place(q: np.ndarray) -> np.ndarray:
    """Where a tool of two joints is (T, 3), m."""
    return np.stack([np.cos(q[:, 0]), np.sin(q[:, 0]), q[:, 1]], 1)
