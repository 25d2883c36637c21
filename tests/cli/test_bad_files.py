"""Models that cannot be read, and files that cannot be written: exit code 1 and one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_bank import TABLE, Command, Site

import diffeo_calib as dc

pytestmark = pytest.mark.slow  # calibrations by the dozen


def test_bad_models(small_site: Site, sound: bytes, command: Command, tmp_path: Path) -> None:
    """tests/interop damages files in every way."""
    path, table = tmp_path / "model.safetensors", [*TABLE[2:], "-o", str(tmp_path / "p.csv")]
    for content, message in (
        (None, "there is no model file"),
        (sound.replace(b'\\"rows\\": 10', b'\\"rows\\": 99'), "checksum does not match"),
        (small_site.csv.read_bytes(), "cannot be read as a model file"),
    ):
        if content is not None:
            assert content != sound
            path.write_bytes(content)
        done = command("predict", path, small_site.csv, *table)
        assert done.code == 1
        assert message in done.error
        assert not (tmp_path / "p.csv").exists()


def test_a_model_of_a_plain_function(small_site: Site, command: Command, tmp_path: Path) -> None:
    x = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    kernels = dc.VonMises(1.0), dc.Gaussian(1.0)
    problem = dc.Problem(lambda q: q * 1.0, x, x + 0.01, noise=0.01, joint_kernel=kernels[0], task_kernel=kernels[1])
    dc.save(dc.fit(problem).model, tmp_path / "plain.safetensors")
    done = command("evaluate", tmp_path / "plain.safetensors", small_site.csv, *TABLE)
    assert done.code == 1
    assert "plain function" in done.error


PLACES = [("none/file.png", "No such file or directory"), ("here.png", "Is a directory")]


@pytest.mark.parametrize("case", [(option, *place) for option in ("-o", "--report") for place in PLACES])
def test_outputs_are_checked_before_the_fit(
    case: tuple[str, str, str], small_site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    option, place, message = case
    monkeypatch.setattr("diffeo_calib.cli.commands.fit.robot_of", lambda *_, **__: pytest.fail("the work has begun"))
    (tmp_path / "here.png").mkdir()
    done = command(*small_site.fit(small_site.csv, tmp_path / "model"), option, tmp_path / place)
    assert done.code == 1
    assert f"file '{tmp_path / place}' cannot be written ({message})" in done.error


def test_a_urdf_in_place_of_a_model(small_site: Site, command: Command) -> None:
    done = command("evaluate", small_site.urdf, small_site.csv, *TABLE)
    assert done.code == 1
    assert "arm.urdf cannot be read as a model file: it is a URDF; pass a file written by" in done.error


def test_names_that_no_file_system_takes(command: Command, tmp_path: Path) -> None:
    joints = ",".join(f"q{number}" for number in range(6))
    (tmp_path / "joints.csv").write_text(f"{joints},image\n0,0,0,0,0,0,{'x' * 5000}\n", encoding="utf-8")
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(b"")
    given = tmp_path / "images", tmp_path / "joints.csv", "--board", "chessboard:7x5:0.03", "--length", "mm"
    done = command("images", *given, "-o", tmp_path / "corners.csv")
    assert done.code == 1
    assert "File name too long; check the path" in done.error
