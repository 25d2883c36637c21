"""`diffeo-calib evaluate --free both`, and errors that are named as motions without it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from command_bank import FORMAT, POSITION, TABLE, Command, Outcome, Site
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.robots.se3 import twist_transform

MOVE = twist_transform(torch.tensor([0.01, -0.02, 0.005, 0.004, -0.003, 0.006], dtype=torch.float64))


def table(site: Site, path: Path, T: Tensor, rows: int, *, marker: float = 0.0, seed: int = 9) -> Path:
    """New measurements of the site's arm, seen from another place, the marker moved by so many metres."""
    arm = site.arm
    q, points = arm.measure(rows, seed=seed)
    tip = arm.truth.poses(q)[:, :3, :3]
    points = points + marker * tip[:, None, :, 0]
    data = dc.Measurements(q, points @ T[:3, :3].mT + T[:3, 3], arm.nominal.joint_names)
    write_measurements(path, data, FORMAT, position=[POSITION.split(",")])
    return path


MOVED = {
    0.0: r"moving the measuring device by (\S+) mm and 0\.4\d+ degrees explains (\S+) % of the squared error; ",
    0.01: r"moving the marker on the flange by (\S+) mm explains (\S+) % of the squared error; ",
}
"""By how far the marker moved, m: else the device did."""


@pytest.mark.parametrize("marker", MOVED)
def test_what_moved_is_named(marker: float, fitted: Outcome, site: Site, command: Command, tmp_path: Path) -> None:
    assert fitted.code == 0
    path = table(site, tmp_path / "a", torch.eye(4, dtype=torch.float64) if marker else MOVE, 12, marker=marker)
    done = command("evaluate", site.folder / "model.safetensors", path, *TABLE)
    (line,) = done.warnings
    advice = r"register the model first: `model.registered`, evaluate --free both\."
    found = re.fullmatch(f"warning: {MOVED[marker]}{advice}", line)
    assert done.code == 0
    assert found is not None, line
    assert float(found[1]) == pytest.approx(10.0, abs=0.4) if marker else float(found[1]) > 10.0
    assert float(found[2]) > 99.0


def test_register_prints_and_writes_the_registered_model(
    fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path
) -> None:
    assert fitted.code == 0
    path, output = table(site, tmp_path / "new.csv", MOVE, 8), tmp_path / "there.safetensors"
    done = command("evaluate", site.folder / "model.safetensors", path, *TABLE, "--free", "both", "-o", output)
    assert (done.code, done.err.strip()) == (0, "")
    before, after = done.numbers("8 with the places of the fit")[0], done.numbers("8 with places found anew")[0]
    assert before > 10.0
    assert after < 0.5
    assert "8 rows took part: RMS " in done.out
    assert "with each row left out in turn" in done.out
    assert "the measuring frame of the model, seen from the new one: " in done.out
    assert "marker in the frame of 'flange': " in done.out
    assert f"registered model: {output}" in done.out
    there = dc.load(output)
    assert isinstance(there, dc.CalibratedKinematics)
    assert there.registration is not None
    torch.testing.assert_close(there.registration.transform, MOVE, rtol=0, atol=3e-3)
    assert there.provenance == model.provenance
    rest = table(site, tmp_path / "rest.csv", MOVE, 30, seed=10)
    again = command("evaluate", output, rest, *TABLE)
    assert again.numbers("30 in all")[0] < 0.5
    assert "moving " not in again.out


def test_options_of_the_registration(fitted: Outcome, site: Site, command: Command, tmp_path: Path) -> None:
    assert fitted.code == 0
    model, path = site.folder / "model.safetensors", table(site, tmp_path / "new.csv", MOVE, 8)
    done = command("evaluate", model, path, *TABLE, "--free", "base")
    assert done.code == 0
    assert "in the frame of 'flange'" not in done.out
    refused = command("evaluate", model, path, *TABLE, "-o", tmp_path / "m.safetensors")
    assert refused.code == 1
    assert refused.error.startswith("error: -o without --free: expected a table of errors, got ")
    onto = command("evaluate", model, path, *TABLE, "--free", "both", "-o", model)
    assert onto.error == f"error: -o {model} is the file of MODEL; name another file."
    few = command("evaluate", model, table(site, tmp_path / "two.csv", MOVE, 2), *TABLE, "--free", "both")
    assert few.code == 1
    assert "expected at least 3 rows, got 2" in few.error
