"""No work is lost where its output goes nowhere (cut pipes, full disks, closed streams), and no code changes."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from command_bank import PROGRAM, TABLE, Site, edited, environment, rows_of
from server_bank import Server

import diffeo_calib as dc


def in_a_shell(arguments: list[object], redirection: str) -> subprocess.CompletedProcess[str]:
    program = " ".join(map(shlex.quote, [sys.executable, "-c", PROGRAM, *map(str, arguments)]))
    shell = ["bash", "-o", "pipefail", "-c", f"{program} {redirection}"]
    return subprocess.run(shell, capture_output=True, text=True, timeout=300, check=False, env=environment())


@pytest.fixture
def quick_fit(small_site: Site, tmp_path: Path) -> list[object]:
    """Arguments of a fit that writes model.safetensors."""
    few = edited(small_site, tmp_path / "few.csv", rows_of(*range(13)))
    return small_site.fit(few, tmp_path / "model.safetensors")


@pytest.mark.slow
def test_errors_keep_their_exit_code_without_streams(tmp_path: Path) -> None:
    arguments: list[object] = ["evaluate", tmp_path / "none", tmp_path / "none.csv", "--position", "x,y,z"]
    arguments += ["--length", "m", "--angle", "rad"]
    assert in_a_shell(arguments, ">&- 2>&-").returncode == 1


NOWHERE = {
    "a cut pipe": {1: "|"},
    "cut pipes": {1: "|", 2: "|"},
    "a full disk": {1: "/dev/full"},
    "errors to a full disk": {2: "/dev/full"},
    "no input": {0: ""},
    "no output": {1: ""},
    "no errors": {2: ""},
    "nothing": {0: "", 1: "", 2: ""},
}
UNITS = TABLE[2:]
QUICK: dict[str, tuple[int, list[object]]] = {
    "help": (0, ["--help"]),
    "help of a command": (0, ["fit", "--help"]),
    "version": (0, ["--version"]),
    "wrong usage": (2, ["predict"]),
    "no command": (2, []),
    "no such model": (1, ["evaluate", "none", "none.csv", *TABLE]),
}


@pytest.mark.parametrize("name", QUICK)
def test_codes_do_not_depend_on_the_streams(name: str, server: Server) -> None:
    code, arguments = QUICK[name]
    for streams in NOWHERE.values():
        done = server(arguments, streams)
        assert done.code == code, (streams, done)
        assert "Traceback" not in done.err
        assert "Exception" not in done.err


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a full disk", "nothing"])
def test_the_model_is_written_whatever_happens_to_the_output(
    name: str, quick_fit: list[object], server: Server, tmp_path: Path
) -> None:
    done = server(quick_fit, NOWHERE[name])
    assert done.code == 0, done
    assert "Traceback" not in done.err
    assert isinstance(dc.load(tmp_path / "model.safetensors"), dc.CalibratedKinematics)


@pytest.mark.slow
@pytest.mark.parametrize(
    "work",
    [
        ("predict", "cut pipes"),
        ("evaluate", "a full disk"),
        ("register", "nothing"),
        ("correct", "a full disk"),
        ("export", "cut pipes"),
    ],
)
def test_work_is_done_whatever_happens_to_the_output(
    work: tuple[str, str], server: Server, small_site: Site, sound_path: Path, tmp_path: Path
) -> None:
    (name, where), model, csv = work, sound_path, small_site.csv
    arguments: dict[str, list[object]] = {
        "predict": ["predict", model, csv, *UNITS, "-o"],
        "evaluate": ["evaluate", model, csv, *TABLE],
        "register": ["evaluate", model, csv, *TABLE, "--free", "both", "-o"],
        "correct": ["correct", model, csv, *UNITS, "-o"],
        "export": ["export", model, "--dh"],
    }
    wanted = []
    for k, streams in enumerate([{}, NOWHERE[where]]):
        path = tmp_path / f"{k}.csv"
        done = server([*arguments[name], *[path] * (name != "evaluate")], streams)
        assert done.code == 0, (streams, done)
        assert "Traceback" not in done.err
        wanted.append(path.read_bytes() if name != "evaluate" else b"")
    assert len(set(wanted)) == 1
