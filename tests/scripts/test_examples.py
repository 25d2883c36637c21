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
from product_bank import usual_scales

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm, elastic_rr

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
def test_examples_run(example: Path, tmp_path: Path, command: Command) -> None:
    """With at most 40 simulated rows, 121 configurations and 14 images, and given scales."""
    patch, measure, sample = command.monkeypatch.setattr, SimulatedArm.measure, SimulatedArm.sample
    seen, grid, calibrate = simulated_camera.camera_arm, elastic_rr.grid, dc.calibrate

    def given(robot: dc.Tree, *rows: Any, **how: Any) -> Any:
        return calibrate(robot, *rows, **{"hyperparameters": usual_scales(robot)} | how)

    patch(SimulatedArm, "sample", lambda arm, count, seed=0: sample(arm, min(count, 40), seed))
    patch(SimulatedArm, "measure", lambda arm, count, seed: measure(arm, min(count, 40), seed=seed))
    patch(elastic_rr, "grid", lambda count: grid(min(count, 11)))
    patch(simulated_camera, "camera_arm", lambda rows: seen(min(rows, 14)))
    patch(dc, "calibrate", given)
    patch(subprocess, "run", in_this_process(command))
    patch(sys, "argv", [str(example)])
    command.monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example), run_name="__main__")
    printed = command.capsys.readouterr()
    assert printed.out.count("\n") >= 3
    assert printed.err == ""


def test_every_example_is_linked_from_the_documentation() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "scripts/docs/pages").rglob("*.md"))
    assert [path.name for path in EXAMPLES if f"examples/{path.name})" not in text] == []
