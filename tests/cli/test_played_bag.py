"""`campaign` on a recorded bag: its stops come at their times, each once. Skipped without rosbags."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from queue import Queue

import numpy as np
import pytest
from bag_bank import PLACES, Bag
from command_bank import Command

from diffeo_calib.cli.commands.campaign import play
from diffeo_calib.robots import SimulatedArm

ARM, ROWS, RATE = SimulatedArm(2), 4, 25
WORDS = ["--position", "x,y,z", "--base", "base_link", "--tip", "flange", "--length", "m", "--seen", PLACES]


@pytest.fixture
def words(tmp_path: Path) -> list[object]:
    """A bag with stops of a second each, half a second apart."""
    q, y = (part.flatten(1).numpy() for part in ARM.measure(ROWS, seed=0))
    share = np.concatenate([np.zeros(RATE), np.linspace(0, 1, RATE // 2)])
    path = [(1 - s) * a + s * b for a, b in zip(q, [*q[1:], q[-1]], strict=True) for s in share]
    seen = [(1 - s) * a + s * b for a, b in zip(y, [*y[1:], y[-1]], strict=True) for s in share]
    bag, times = Bag(), np.arange(len(path)) / RATE
    bag.joints(times, np.array(path), [*ARM.nominal.joint_names])
    bag.poses(times, np.array(seen))
    ARM.write_urdf(tmp_path / "arm.urdf")
    return ["campaign", tmp_path / "run.csv", "--robot", tmp_path / "arm.urdf", "--bag", bag.write(tmp_path / "bag")]


def test_the_stops_of_a_bag_are_judged_once_each(words: list[object], tmp_path: Path, command: Command) -> None:
    for _ in range(2):
        done = command(*words, *WORDS, "--angle", "rad", "--speed", "1000")
        assert done.code == 0, done.err
        with (tmp_path / "run.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["id"] for row in rows] == [str(number) for number in range(ROWS)]
        assert f"{ROWS} of {ROWS} rows accepted" in done.out
    assert done.out.count("not judged yet") == 0, "the second time they are known"
    (q, y), (first, *_) = ARM.measure(ROWS, seed=0), rows
    found = [float(first[name]) for name in [*ARM.nominal.joint_names, *"xyz"]]
    np.testing.assert_allclose(found, [*q[0], *y[0, 0]], rtol=0, atol=1e-3)


def test_options_that_do_not_go_with_a_bag_are_named(words: list[object], command: Command) -> None:
    for more, named in (
        (["--angle", "deg"], "--angle rad"),
        (["--angle", "rad", "--once"], "--once"),
        (["--angle", "rad", "--joint-states", "/none"], "/none"),
    ):
        done = command(*words, *WORDS, *more)
        assert done.code == 1
        assert named in done.err
    done = command(*words, *WORDS[:-2], "--angle", "rad")
    assert done.code == 1
    assert "--seen" in done.err


def test_rows_are_played_at_their_times() -> None:
    rows, inbox, waited = [{"time": time} for time in (7.0, 47.0, 48.0)], Queue(), []
    play(rows, inbox, 10.0, waited.append)
    assert [inbox.get() for _ in range(3)] == rows
    assert inbox.get() is None
    assert waited == pytest.approx([0.0, 4.0, 4.1], abs=0.05)
    play([], inbox, 1.0, lambda _: math.nan)
    assert inbox.get() is None
