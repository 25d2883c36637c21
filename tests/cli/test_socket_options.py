"""`fit` and `evaluate` with a ball in sockets, and what they refuse."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_bank import Command
from trackerless_bank import write_socket_table

from diffeo_calib.robots import SimulatedArm

ROBOT = ["--robot", "arm.urdf", "--base", "base_link", "--tip", "flange", "--length", "mm", "--angle", "deg"]
SOCKETS = ["--socket", "place,socket", "--distance", "a,b=50", "--distance-std", "0.01"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of 3 places x 2 sockets x 6 rows, and its robot."""
    where, arm = tmp_path_factory.mktemp("sockets"), SimulatedArm(seed=1)
    arm.write_urdf(where / "arm.urdf")
    write_socket_table(where / "t.csv", arm, "ab", 1)
    return where


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_from_a_campaign_file_to_errors(folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    campaign = ['csv = "t.csv"', 'robot = "arm.urdf"', 'base = "base_link"', 'tip = "flange"', 'length = "mm"']
    campaign += ['angle = "deg"', 'socket = ["place", "socket"]', 'distance = ["a,b=50"]', "distance-std = 0.01"]
    (folder / "c.toml").write_text("\n".join([*campaign, 'output = "m.safetensors"']))
    fitted = command("fit", "c.toml")
    assert fitted.code == 0, fitted.err
    assert "Spread within sockets in mm by stage" in fitted.out
    assert "12 held out" in fitted.out, "one whole place"
    assert "known 50.000" in fitted.out
    assert "2 to 6 times" in fitted.out
    assert "robot base in the measuring frame" not in fitted.out
    units = ["--length", "mm", "--angle", "deg"]
    done = command("evaluate", "m.safetensors", "t.csv", *SOCKETS, *units)
    assert done.code == 0, done.err
    assert "12 not used in the fit" in done.out
    assert done.out.count("known 50.000") == 3
    assert "expected absolute error" in done.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([*SOCKETS, "--position", "x,y,z"], "no column ['x', 'y', 'z']"),
        ([*SOCKETS, "--std", "s"], "--std beside `socket`; leave it out"),
        (["--distance", "a,b=50", "--distance-std", "1", "--position", "x,y,z"], "--distance-std without --socket"),
        ([*SOCKETS[:2], "--distance", "a=50", *SOCKETS[4:]], r"--distance a=50: expected A,B=LENGTH"),
        (["--socket", "place,socket", "--distance", "a,b=50"], "--distance without --distance-std"),
        ([*SOCKETS[:2], "--distance", "a,c=50", *SOCKETS[4:]], "a known distance: expected names of two sockets"),
        ([*SOCKETS[:2], "--distance", "a,b=50000", *SOCKETS[4:]], "check the unit of `distances`"),
    ],
)
def test_refused(
    options: list[str], message: str, folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    done = command("fit", "t.csv", *ROBOT, *options, "-o", "none.safetensors")
    assert done.code in (1, 2)
    assert message in " ".join(done.err.split())
    assert not Path("none.safetensors").exists()


@pytest.mark.usefixtures("given_scales")
def test_a_wrong_distance_is_warned_of(folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    options = *SOCKETS[:2], "--distance", "a,b=60", *SOCKETS[4:]
    done = command("fit", "t.csv", *ROBOT, *options, "-o", "warned.safetensors")
    assert done.code == 0
    assert "the known distance of the sockets 'spot" in " ".join(done.err.split())


def test_one_of_both_is_required(folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    done = command("fit", "t.csv", *ROBOT, "-o", "none.safetensors")
    assert done.code == 2
    assert "--position" in done.err
