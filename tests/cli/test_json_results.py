"""--json: the results of every command for programs, as the schema describes them."""

import json
from pathlib import Path

import jsonschema
import pytest
from command_bank import VALIDATOR, Command
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.results import SCHEMA

UNITS = ["--length", "mm", "--angle", "deg"]


@pytest.fixture
def folder(arm: Case, tmp_path: Path) -> Path:
    dc.save(arm.model, tmp_path / "arm.safetensors")
    named = arm.test[:30].with_joint_names(arm.robot.joint_names)
    write_measurements(tmp_path / "new.csv", named, TableFormat("mm", "deg"), position=("x", "y", "z"))
    return tmp_path


def test_errors_and_places_that_are_taken(folder: Path, command: Command) -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    words = "evaluate", "none.safetensors", folder / "new.csv", *UNITS, "--json", folder / "out.json"
    assert command(*words).code == 1
    written = json.loads((folder / "out.json").read_text(encoding="utf-8"))
    VALIDATOR.validate(written)
    assert (written["exit_code"], written["results"], written["arguments"][0]) == (1, {}, "evaluate")
    assert "none.safetensors" in written["error"]
    model, predicted = folder / "arm.safetensors", folder / "p.csv"
    before = model.read_bytes()
    for place, words in ((model, "--json"), (predicted, "--json"), (folder / "none" / "x.json", "make its folder")):
        assert words in command.failed("predict", model, folder / "new.csv", *UNITS, "-o", predicted, "--json", place)
    assert model.read_bytes() == before
    assert not predicted.exists()


@pytest.mark.parametrize(
    "words",
    [
        "predict arm.safetensors new.csv --length furlong --json out.json",
        "predict arm.safetensors --no-such-option --json=out.json",
        "fit none.toml --json out.json",
        "fit c.toml",
    ],
)
def test_an_earlier_result_is_removed(words: str, folder: Path, command: Command) -> None:
    """The command ends before it could begin: nothing is left, whatever the exit code is looked at."""
    command.monkeypatch.chdir(folder)
    (folder / "out.json").write_text('{"format": "diffeo_calib result", "exit_code": 0}', encoding="utf-8")
    (folder / "c.toml").write_text('csv = "new.csv"\njson = "out.json"\nlength = "furlong"\n', encoding="utf-8")
    assert command(*words.split()).code in (1, 2)
    assert not (folder / "out.json").exists()
