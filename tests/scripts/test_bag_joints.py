"""Joint values at the times of images in a ROS 2 bag. Skipped without rosbags."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs rosbags")

SCRIPT = Path(__file__).parents[2] / "scripts" / "bag_joints.py"
PIXELS = b"\x89PNG of this test"


def angle(time: float) -> float:
    """A joint that stands until 1 s and turns until 2 s, rad."""
    return 0.3 + 0.5 * min(max(time - 1.0, 0.0), 1.0)


def test_images_of_a_robot_at_rest_and_its_joints(tmp_path: Path) -> None:
    from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types

    def header(time: float):
        nanoseconds = round(1e9 * time)
        stamp = types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    state, image = "sensor_msgs/msg/JointState", "sensor_msgs/msg/CompressedImage"
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        joints = writer.add_connection("/joint_states", state, typestore=store)
        camera = writer.add_connection("/camera", image, typestore=store)
        nothing = np.zeros(0)
        for step in range(301):
            time = 0.01 * step
            position = np.array([angle(time), -angle(time)])
            message = types[state](header(time), ["a", "b"], position, nothing, nothing)
            writer.write(joints, round(1e9 * (time + 5)), store.serialize_cdr(message, state))
        for time in (0.503, 1.5, 2.604, 3.4):
            content = types[image](header(time), "png", np.frombuffer(PIXELS, dtype=np.uint8))
            writer.write(camera, round(1e9 * (time + 5)), store.serialize_cdr(content, image))
    command = [sys.executable, SCRIPT, tmp_path / "bag", tmp_path / "images", "/camera"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "2 of 4 images; left out: 1 while the robot moved, 1 outside" in done.stdout
    with (tmp_path / "images" / "joints.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = [[float(row["a"]), float(row["b"])] for row in rows]
    np.testing.assert_allclose(found, [[0.3, -0.3], [0.8, -0.8]], rtol=0, atol=1e-12)
    assert all((tmp_path / "images" / row["image"]).read_bytes() == PIXELS for row in rows)
