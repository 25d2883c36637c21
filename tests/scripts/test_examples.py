"""The guides run as they are, from another folder and without a warning."""

import runpy
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import simulated_camera
from command_bank import Command

from diffeo_calib.robots.simulated_arm import SimulatedArm

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "scripts" / "examples").glob("*.py"))


def in_this_process(command: Command) -> Callable[..., subprocess.CompletedProcess[str]]:
    """`subprocess.run` of the command line, without another start of Python."""

    def run(words: Sequence[str], *, cwd: Path, **_: Any) -> subprocess.CompletedProcess[str]:
        assert words[:3] == [sys.executable, "-m", "diffeo_calib"]
        with command.monkeypatch.context() as patch:
            patch.chdir(cwd)
            done = command(*words[3:])
        return subprocess.CompletedProcess(words, done.code, done.out, done.err)

    return run


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn", "given_scales")
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(
    example: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With at most 40 simulated rows, and 14 images; scales are given where the command line fits."""
    measure, sample, seen = SimulatedArm.measure, SimulatedArm.sample, simulated_camera.camera_arm
    monkeypatch.setattr(SimulatedArm, "sample", lambda arm, count, seed=0: sample(arm, min(count, 40), seed))
    monkeypatch.setattr(SimulatedArm, "measure", lambda arm, count, seed: measure(arm, min(count, 40), seed=seed))
    monkeypatch.setattr(subprocess, "run", in_this_process(command))
    monkeypatch.setattr(simulated_camera, "camera_arm", lambda rows: seen(min(rows, 14)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example)])
    runpy.run_path(str(example), run_name="__main__")
    printed = capsys.readouterr()
    assert printed.out.count("\n") >= 3
    assert printed.err == ""


def test_every_example_is_linked_from_the_documentation() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "scripts/docs/pages").rglob("*.md"))
    assert [path.name for path in EXAMPLES if f"examples/{path.name})" not in text] == []
