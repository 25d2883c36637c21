"""`diffeo-calib recalibrate` and `compare`: an old model, a new table, another model."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_bank import FORMAT, POSITION, TABLE, Command
from product_bank import Case, simulated

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements

pytestmark = pytest.mark.slow  # fits


@pytest.fixture(scope="module")
def files(arm: Case, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An old model and a new table of 15 rows."""
    folder = tmp_path_factory.mktemp("again")
    dc.save(arm.model, folder / "old.safetensors")
    robot = simulated(1)[0]
    data = dc.Measurements(*robot.measure(15, seed=5), joint_names=robot.nominal.joint_names)
    write_measurements(folder / "new.csv", data, FORMAT, position=[POSITION.split(",")])
    return {name: str(folder / name) for name in ("old.safetensors", "new.csv", "new.safetensors", "where.png")}


def test_a_new_model_and_what_has_changed(files: dict[str, str], command: Command) -> None:
    done = command("recalibrate", files["old.safetensors"], files["new.csv"], *TABLE, "-o", files["new.safetensors"])
    assert done.code == 0
    assert "the markers are where they were" in done.out
    assert "no change was found but the places of device and markers" in done.out
    assert len(dc.load(files["new.safetensors"]).configurations) == 75
    compared = command("compare", files["old.safetensors"], files["new.safetensors"], "--figure", files["where.png"])
    assert compared.code == 0
    assert "the models differ by 0.0" in compared.out
    assert "transmission of shoulder_joint: 0.0" in compared.out
    assert Path(files["where.png"]).stat().st_size > 10_000


def test_a_table_is_compared(files: dict[str, str], command: Command) -> None:
    done = command("compare", files["old.safetensors"], files["new.csv"], *TABLE, "--marker-freedom", "same")
    assert done.code == 0
    assert "no change was found" in done.out


def test_a_table_needs_its_columns(files: dict[str, str], command: Command) -> None:
    done = command("compare", files["old.safetensors"], files["new.csv"])
    assert done.code == 1
    assert "--length and --angle missing" in done.error
    done = command("compare", files["old.safetensors"], files["new.csv"], "--position", POSITION)
    assert done.code == 1
    assert "--length and --angle missing" in done.error
