"""`diffeo-calib recalibrate` and `compare`: an old model, a new table, another model."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_bank import FORMAT, POSITION, TABLE, Command
from product_bank import Case, simulated
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements

pytestmark = pytest.mark.slow  # fits


@pytest.fixture(scope="module")
def files(arm: Case, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("again")
    dc.save(arm.model, folder / "old.safetensors")
    robot = simulated(1)[0]
    data = dc.Measurements(*robot.measure(15, seed=5), joint_names=robot.nominal.joint_names)
    write_measurements(folder / "new.csv", data, FORMAT, position=[POSITION.split(",")])
    return {name: str(folder / name) for name in ("old.safetensors", "new.csv", "new.safetensors")}


def test_a_new_model_and_what_has_changed(files: dict[str, str], command: Command) -> None:
    done = command.ran(
        "recalibrate", files["old.safetensors"], files["new.csv"], *TABLE, "-o", files["new.safetensors"]
    )
    assert "the markers are taken to be where they were (these rows show that to 0.0" in done.out
    assert len(dc.load(files["new.safetensors"]).configurations) == 75
    for free, named, other in (("base", True, False), ("remounted", False, False), ("both", False, True)):
        table = files["new.csv"], *TABLE, "--free", free, "-o", files["new.safetensors"]
        done = command("recalibrate", files["old.safetensors"], *table)
        assert ("are taken to be where they were" in done.out, "or are other ones" in done.out) == (named, other)
    compared = command.ran("recalibrate", files["old.safetensors"], files["new.safetensors"])
    assert "RMS from the model, device and markers found anew: position 0.0" in compared.out
    assert "no change was found" in compared.out


def written(path: Path, q: Tensor) -> str:
    robot = simulated(1)[0]
    data = dc.Measurements(q, robot.true_points(q), joint_names=robot.nominal.joint_names, doubt=False)
    write_measurements(path, data, FORMAT, position=[POSITION.split(",")])
    return str(path)


def test_rows_that_test_no_change(arm: Case, files: dict[str, str], tmp_path: Path, command: Command) -> None:
    """Four rows of 20 lie within the old joint ranges: a change may be in the places, which nobody knows."""
    known = arm.model.configurations
    low, high = known.amin(0), known.amax(0)
    q = simulated(1)[0].sample(20, seed=5).clamp(low, high)
    q[4:, 2] = high[2] + 0.05 * (high[2] - low[2])
    entry = tmp_path / "result.json"
    table = written(tmp_path / "new.csv", q)
    done = command.ran("recalibrate", files["old.safetensors"], table, *TABLE, "--json", str(entry))
    assert "warning: only 4 rows lie within the joint ranges that the model knows" in done.err
    assert "a change of the robot, which was not tested, would be in them" in done.out
    assert "unmoved" not in done.out
    assert json.loads(entry.read_text())["results"]["rows_can_tell"] is False
