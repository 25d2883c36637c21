"""Stops in two recordings with clocks of their own, and a bag as a table of them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from command_bank import Command

from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.stops import Recording, StopLimits, stops

STOPS, STAND_S, MOVE_S, OFFSET_S = 8, 1.5, 0.7, 0.437
NOISE_M = 2e-5


def angle(times: np.ndarray) -> np.ndarray:
    """Two joints (T, 2), rad: they stand for some time at random places, and move smoothly between these."""
    places = np.random.default_rng(0).uniform(-1, 1, (STOPS, 2))
    period = STAND_S + MOVE_S
    number = np.clip((times // period).astype(int), 0, STOPS - 1)
    share = np.clip((times - number * period - STAND_S) / MOVE_S, 0, 1)[:, None]
    after = places[np.minimum(number + 1, STOPS - 1)]
    return places[number] + (after - places[number]) * (3 * share**2 - 2 * share**3)


def place(q: np.ndarray) -> np.ndarray:
    """Where the tool is (T, 3), m."""
    return np.stack([np.cos(q[:, 0]), np.sin(q[:, 0]), q[:, 1]], 1)


def recordings(seed: int = 1) -> tuple[Recording, Recording]:
    """Joints 100 times, places 130 times a second by a clock that is behind."""
    random, last = np.random.default_rng(seed), STOPS * (STAND_S + MOVE_S)
    joints, seen = np.arange(0, last, 0.01), np.arange(0, last, 1 / 130)
    noisy = place(angle(seen)) + NOISE_M * random.standard_normal((len(seen), 3))
    return Recording(joints, angle(joints)), Recording(seen - OFFSET_S, noisy)


def test_stops_and_the_offset_are_found() -> None:
    found, offset = stops(*recordings())
    assert offset == pytest.approx(OFFSET_S, abs=0.03)
    assert len(found) == STOPS
    for number, one in enumerate(found):
        assert number * (STAND_S + MOVE_S) < one.time < number * (STAND_S + MOVE_S) + STAND_S + MOVE_S
        np.testing.assert_allclose(one.joints, angle(np.array([one.time]))[0], rtol=0, atol=5e-4)
        np.testing.assert_allclose(one.seen, place(one.joints[None])[0], rtol=0, atol=1e-4)
        assert np.all((one.deviations > 0.6 * NOISE_M) & (one.deviations < 1.6 * NOISE_M))
        assert one.count > 100


def test_recordings_without_stops_or_motions_are_refused() -> None:
    joints, seen = recordings()
    still = Recording(joints.times, np.zeros_like(joints.values))
    with pytest.raises(MeasurementError, match="offset between the clocks"):
        stops(still, seen)
    with pytest.raises(MeasurementError, match="stops"):
        stops(joints, seen, StopLimits(shortest=5.0))
    assert len(stops(joints, seen, offset=OFFSET_S)[0]) == STOPS


def test_a_bag_becomes_a_table(tmp_path: Path, command: Command) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs rosbags")
    from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]

    store = get_typestore(Stores.ROS2_HUMBLE)
    types, nothing = store.types, np.zeros(0)

    def header(time: float):
        nanoseconds = round(1e9 * (time + 100))
        stamp = types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    state, pose = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"
    joints, seen = recordings()
    quaternion = types["geometry_msgs/msg/Quaternion"]
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        topics = [writer.add_connection(*names, typestore=store) for names in (("/joint_states", state), ("/at", pose))]
        for time, q in zip(joints.times, joints.values, strict=True):
            message = types[state](header(time), ["a", "b"], q, nothing, nothing)
            writer.write(topics[0], round(1e9 * (time + 100)), store.serialize_cdr(message, state))
        for row, (time, p) in enumerate(zip(seen.times, seen.values, strict=True)):
            turn = quaternion(0.0, 0.0, (-1.0) ** row, 0.0)  # the sign of a quaternion has no meaning
            at = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*p), turn)
            writer.write(topics[1], round(1e9 * (time + 100)), store.serialize_cdr(types[pose](header(time), at), pose))
    done = command("record", tmp_path / "bag", "--seen", "/at", "-o", tmp_path / "run.csv")
    assert done.code == 0, done.err
    with (tmp_path / "run.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == STOPS
    assert [abs(float(rows[0][name])) for name in ("qx", "qy", "qz", "qw")] == [0, 0, 1, 0]
    q = np.array([[float(row[name]) for name in "ab"] for row in rows])
    y = np.array([[float(row[name]) for name in "xyz"] for row in rows])
    np.testing.assert_allclose(y, place(q), rtol=0, atol=1e-4)
    refused = command("record", tmp_path / "bag", "--seen", "/other", "-o", tmp_path / "run.csv")
    assert refused.code == 1
    assert "/other" in refused.err


def test_a_missing_bag_is_one_error(tmp_path: Path, command: Command) -> None:
    done = command("record", tmp_path / "none", "--seen", "/at", "-o", tmp_path / "run.csv")
    assert done.code == 1
    assert "none" in done.err
