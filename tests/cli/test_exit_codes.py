"""Exit codes: wrong usage, a fit that does not converge."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from command_bank import Command, Site

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat


@pytest.mark.parametrize(
    "words",
    [
        "fit",
        "fit t.csv --robot r.urdf",
        "nonsense",
        "evaluate m t.csv --position x,y,z --length km --angle rad",
        "evaluate m t.csv --position x,y,z --length m --angle rad --surprise",
        "fit t.csv --holdout 1.5",
        "fit t.csv --holdout nan",
        "evaluate m t.csv --position x,y,z --length m --angle rad --rotation-angle turn",
        "demo --seed -1",
        "demo --count 3",
    ],
)
def test_wrong_usage_is_exit_2(words: str, command: Command) -> None:
    done = command(*words.split())
    assert done.code == 2
    assert "Traceback" not in done.err
    assert "Usage" in done.err


def test_unconverged_is_exit_3_with_the_model_written(
    site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_measurements(tmp_path / "t.csv", site.data.rows(slice(11)), TableFormat("m", "rad"))
    monkeypatch.setattr("diffeo_calib.calibration.calibrate.GaussNewton", partial(dc.GaussNewton, max_iterations=1))
    path = tmp_path / "early.safetensors"
    table = ["--position", "x,y,z", "--length", "m", "--angle", "rad"]
    done = command("fit", tmp_path / "t.csv", *site.robot(), *table, "-o", path, "--holdout", 0)
    assert done.code == 3
    assert "stopped at the limit of 1 iterations; judge it by held-out errors" in done.out
    assert "pass fewer --controls" in done.out
    assert "max_iterations" not in done.out
    assert any("11 poses are too few to select scales" in warning for warning in done.warnings)
    assert isinstance(dc.load(path), dc.CalibratedKinematics)
