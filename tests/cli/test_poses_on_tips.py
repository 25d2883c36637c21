"""Poses of both hands of a small robot, some of them hidden: what commands say of them, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_bank import Command
from kind_bank import UNITS, Kind, kind_named, table_options
from table_bank import held
from torch.testing import assert_close
from two_arms_bank import HANDS, TwoArms

import diffeo_calib as dc

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def kind() -> Kind:
    return kind_named("several tips")


@pytest.fixture(scope="module")
def new(kind: Kind) -> dc.Measurements:
    return TwoArms(kind.robot).measured(20)


def test_fit_says_where_frames_are_and_what_was_hidden(kind: Kind, command: Command, tmp_path: Path) -> None:
    table, options = kind.table()
    command.monkeypatch.setattr("diffeo_calib.cli.commands.fit.calibrate", lambda *_, **__: kind.result)
    words = [table, *kind.robot_options, *options, "--holdout", 0, "-o", tmp_path / "m.safetensors"]
    printed = " ".join(command("fit", *words).out.split())
    assert "hidden in some of 24 rows: the frame on 'left' in 2, the frame on 'right' in 2 of them" in printed
    places = kind.model.measured_frame[:, :3, 3]
    for side, place in zip(HANDS, 1e3 * places, strict=True):
        words = " ".join(f"{value:.3f}" for value in place.tolist())
        assert f"measured frame in the frame of '{side}': {words} mm" in printed
    assert_close(places, TwoArms(kind.robot).frames[:, :3, 3], rtol=0, atol=2e-3)


def test_wrong_pose_of_one_hand_is_named(kind: Kind, new: dc.Measurements, command: Command, tmp_path: Path) -> None:
    poses = held(new.poses).clone()
    poses[7, 1, :3, 3] += 0.01
    wrong = dc.Measurements.from_poses(new.q, poses, new.joint_names, on=HANDS)
    form = kind.written(wrong, tmp_path / "wrong.csv")
    done = command("evaluate", kind.file, tmp_path / "wrong.csv", *UNITS, *table_options(form))
    assert "row 9, right: 17." in done.out
    assert "the frame on 'right' alone is off, the other poses of this row fit" in " ".join(done.out.split())
