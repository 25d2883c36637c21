"""Bags of ROS as tables of stops, and as images with their joint values. Skipped without rosbags."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_bank import JOINTS, PICTURES, PLACES, Bag, place, standing
from command_bank import Command
from kind_bank import table_rows

from diffeo_calib.measurements.bags import read_images

NAMES, STAND_S, MOVE_S, START_S = ["a", "b"], 1.0, 0.5, 100.0
PLACES_RAD = np.random.default_rng(0).uniform(-1, 1, (4, 2))
MIDDLES = START_S + np.arange(4) * (STAND_S + MOVE_S) + 0.5 * STAND_S
PIXELS = np.random.default_rng(1).integers(0, 255, (4, 5, 3))
PNG = b"\x89PNG of this test"


def motion(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and two joints (T, 2), rad."""
    times = np.arange(0, len(PLACES_RAD) * (STAND_S + MOVE_S), 1 / rate)
    return START_S + times, standing(PLACES_RAD, STAND_S, MOVE_S, times)


@pytest.fixture
def bag() -> Bag:
    made = Bag()
    made.joints(*motion(25), NAMES)
    return made


@dataclass
class Recorder:
    command: Command
    folder: Path

    def table(self, bag: Bag | Path, seen: str, *more: str) -> tuple[Any, list[dict[str, str]]]:
        path = bag.write(self.folder / f"bag{id(bag)}") if isinstance(bag, Bag) else bag
        done = self.command("record", path, seen, "-o", self.folder / "run.csv", *more)
        assert done.code == 0, done.err
        return done, table_rows(self.folder / "run.csv")

    def refused(self, path: Path, seen: str, *words: str, more: Sequence[str] = ()) -> None:
        done = self.command("record", path, seen, "-o", self.folder / "no.csv", *more)
        assert done.code == 1, (seen, done.out)
        assert all(word in done.err for word in words), (words, done.err)
        assert not (self.folder / "no.csv").exists()


@pytest.fixture
def record(command: Command, tmp_path: Path) -> Recorder:
    return Recorder(command, tmp_path)


def numbers(table: list[dict[str, str]], names: Iterable[str] = NAMES) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in table])


def test_a_bag_becomes_a_table(bag: Bag, record: Recorder) -> None:
    times, q = motion(80)
    bag.poses(times - 0.437, place(q))
    _, table = record.table(bag, PLACES)
    found = numbers(table)
    np.testing.assert_allclose(found, PLACES_RAD, rtol=0, atol=5e-4)
    np.testing.assert_allclose(numbers(table, "xyz"), place(found), rtol=0, atol=1e-4)
    halves = np.cos(found[:, 0]) / 2
    whole = np.stack([0 * halves, 0 * halves, np.sin(halves), np.cos(halves)], 1)
    turns = numbers(table, ("qx", "qy", "qz", "qw"))
    np.testing.assert_allclose(np.abs((turns * whole).sum(1)), 1, rtol=0, atol=1e-6)
    assert int(table[0]["readings"]) > 50


def test_joints_are_joined_by_name(record: Recorder, tmp_path: Path) -> None:
    times, q = motion(30)
    apart, alone = Bag(), Bag()
    for k, time in enumerate(times):  # in another order each time, and a gripper beside the arm
        order = [1, 0] if k % 2 else [0, 1]
        apart.joints(times[k : k + 1], q[k : k + 1, order], [NAMES[own] for own in order])
        apart.joints(np.array([time + 0.003]), np.array([[0.4]]), ["claw"])
        for own in (0, 1):
            alone.joints(np.array([time + 0.004 * own]), q[k : k + 1, [own]], [NAMES[own]])
    apart.joints(times[:9], np.zeros((9, 1)), ["lamp"])
    paths = []
    for made in (apart, alone):
        made.poses(times, place(q))
        paths.append(made.write(tmp_path / f"{len(paths)}"))
    for path, more in ((paths[0], ["--joints", f"{JOINTS}:{','.join(NAMES)}"]), (paths[0], []), (paths[1], [])):
        done, table = record.table(path, PLACES, *more)
        np.testing.assert_allclose(numbers(table), PLACES_RAD, rtol=0, atol=5e-4)
        assert ("claw" in table[0]) == (path == paths[0] and not more)
        assert "lamp" not in table[0]
        assert ("left out" in done.err and "lamp" in done.err) == ("claw" in table[0])
    record.refused(paths[1], PLACES, "expected elbow, got a, b", more=["--joints", f"{JOINTS}:a,elbow"])


def test_frames_are_chained(record: Recorder, bag: Bag, tmp_path: Path) -> None:
    times, q = motion(30)
    level, moved = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(times), 1)), place(q)
    poses = np.concatenate([moved, level[:, 3:]], 1)
    half = np.array([[0.1, 0.2, 0.3, 0.0, 0.0, 0.5**0.5, 0.5**0.5]])  # a quarter turn about z
    bag.frames("/tf", times, "camera", "/ball", poses)
    bag.frames("/tf", times[::3], "/world", "lift", level[::3])
    bag.frames("/tf_static", times[:1], "lift", "camera", half)
    path = bag.write(tmp_path / "bag")
    turned = np.stack([-moved[:, 1], moved[:, 0], moved[:, 2]], 1) + half[:, :3]
    for frames, expected in (("ball", moved), ("world>/ball", turned), ("ball>camera", -moved)):
        done, table = record.table(path, f"/tf:{frames}")
        assert "without rotations" in done.out
        stands = np.array([expected[np.abs(times - middle).argmin()] for middle in MIDDLES])
        np.testing.assert_allclose(numbers(table, "xyz"), stands, rtol=0, atol=1e-4)
    for frames, words in (("", ["none of", "camera>ball", "world>lift"]), (":cube", ["cube of"]), (":camera", [])):
        record.refused(path, f"/tf{frames}", *words, "/tf:PARENT>CHILD")


def test_bags_of_ros_1_are_read_by_their_file(tmp_path: Path, record: Recorder) -> None:
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="needs rosbags")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    kinds = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PointStamped"
    state, point = (store.types[kind] for kind in kinds)
    times, q = motion(40)
    path = tmp_path / "one.bag"
    with rosbag1.Writer(path) as writer:
        topics = zip((JOINTS, PLACES), kinds, strict=True)
        known = [writer.add_connection(topic, kind, typestore=store) for topic, kind in topics]
        for k, time in enumerate(times):
            stamp = store.types["builtin_interfaces/msg/Time"](int(time), int(time % 1 * 1e9))
            header, nothing = store.types["std_msgs/msg/Header"](k, stamp, ""), np.zeros(0)
            at = store.types["geometry_msgs/msg/Point"](*place(q[k : k + 1])[0])
            both = state(header, NAMES, q[k], nothing, nothing), point(header, at)
            for own, kind, message in zip(known, kinds, both, strict=True):
                writer.write(own, int(1e9 * time), store.serialize_ros1(message, kind))
    np.testing.assert_allclose(numbers(record.table(path, PLACES)[1]), PLACES_RAD, rtol=0, atol=5e-4)
    for wrong in (tmp_path, path.rename(tmp_path / "one.rosbag")):
        record.refused(wrong, PLACES, "rosbags-convert")


def test_images_of_stops_and_their_joints(bag: Bag, tmp_path: Path, record: Recorder) -> None:
    moving = MIDDLES + 0.5 * (STAND_S + MOVE_S)
    bag.packed([*MIDDLES[1:], *moving, START_S - 1], PNG)
    done, table = record.table(bag, PICTURES)
    assert "3 images" in done.out
    assert "1 stops without" in done.out
    np.testing.assert_allclose(numbers(table), PLACES_RAD[1:], rtol=0, atol=5e-4)
    assert all((tmp_path / row["image"]).read_bytes() == PNG for row in table)
    assert len({row["image"] for row in table}) == 3


def test_raw_images_keep_their_pixels(bag: Bag, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    grey = PIXELS[..., :1]
    ways = ("bgr8", PIXELS, PIXELS), ("rgb8", PIXELS, PIXELS[..., ::-1]), ("mono8", grey, np.repeat(grey, 3, 2))
    for encoding, pixels, expected in ways:
        bag.topics.pop(PICTURES, None)
        bag.images(MIDDLES, pixels, encoding)
        path = bag.write(tmp_path / encoding)
        ((time, suffix, content),) = read_images(path, PICTURES, [MIDDLES[2]])
        assert (time, suffix) == (MIDDLES[2], ".png")
        np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR), expected)


def test_bags_that_hold_something_else_are_named(bag: Bag, tmp_path: Path, record: Recorder) -> None:
    times, q = motion(10)
    bag.poses(times + 1000, place(q))
    bag.packed([], PNG)
    other, unknown, cut, damaged = Bag(), Bag(), Bag(), Bag()
    for one in (other, unknown, cut, damaged):
        one.topics[JOINTS] = bag.topics[JOINTS]
    other.packed(MIDDLES, b"something")
    unknown.images(MIDDLES, PIXELS, "bayer_rggb8")
    cut.images(MIDDLES, PIXELS, "bgr8")
    cut.topics[PICTURES][1][2][1].data = np.zeros(3, np.uint8)
    written = {name: one.write(tmp_path / name) for name, one in locals().items() if isinstance(one, Bag)}
    Bag().write(tmp_path / "empty")
    file = written["damaged"] / "damaged.db3"
    file.write_bytes(file.read_bytes().replace(b"schema_version", b"schema_vers\xdfon"))
    for path, topic, more, words in (
        (written["bag"], "/other", [], ["/other", PLACES]),
        (written["bag"], PICTURES, [], [PICTURES, "0"]),
        (written["bag"], PLACES, [], ["1100", "105"]),
        (written["bag"], PICTURES, ["--joints", PLACES], ["JointState", "PoseStamped"]),
        (written["bag"], JOINTS, [], ["images"]),
        (written["other"], PICTURES, [], [".png"]),
        (written["other"], PICTURES, ["--offset", "-0.6"], ["without an image"]),
        (written["other"], PICTURES, ["--still", "0.001,2"], ["stops"]),
        (written["other"], PICTURES, ["--still", "1,2,3"], ["expected MOTION, or MOTION,SECONDS"]),
        (written["other"], PICTURES, ["--offset", "nan"], ["--offset: expected a number"]),
        (written["unknown"], PICTURES, [], ["bayer_rggb8", "bgr8"]),
        (written["cut"], PICTURES, [], ["5 x 4", "3 bytes"]),
        (tmp_path / "empty", PLACES, [], ["empty", PLACES]),
        (written["damaged"], PLACES, [], ["cannot be read", "utf-8"]),
    ):
        record.refused(path, topic, *words, more=more)
