"""The guides run as they are, from another folder and without a warning."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
import simulated_camera

from diffeo_calib.robots.simulated_arm import SimulatedArm

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "scripts" / "examples").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With at most 50 simulated rows, and 18 images."""
    measure, seen = SimulatedArm.measure, simulated_camera.camera_arm
    monkeypatch.setattr(SimulatedArm, "measure", lambda arm, count, seed: measure(arm, min(count, 50), seed=seed))
    monkeypatch.setattr(simulated_camera, "camera_arm", lambda rows: seen(min(rows, 18)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example)])
    runpy.run_path(str(example), run_name="__main__")
    printed = capsys.readouterr()
    assert printed.out.count("\n") >= 3
    assert printed.err == ""


def test_every_example_is_linked_from_the_documentation() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "scripts/docs/pages").rglob("*.md"))
    assert [path.name for path in EXAMPLES if f"examples/{path.name})" not in text] == []
