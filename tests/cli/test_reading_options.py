"""`fit`, `evaluate` and `predict` with readings that are not positions, and what they refuse."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_bank import Command
from trackerless_bank import write_wire_table

from diffeo_calib.cli.options import Rows, Units
from diffeo_calib.cli.tables import measured_table
from diffeo_calib.measurements.csv.sensors import ReadingColumns
from diffeo_calib.robots import SimulatedArm

ROBOT = ["--robot", "arm.urdf", "--base", "base_link", "--tip", "flange"]
UNITS = ["--length", "mm", "--angle", "deg"]
WIRE = ["--reading", "distance=wire", "--session", "anchor"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """64 rows of a wire that is pulled from two anchors in turn, and the robot."""
    where, arm = tmp_path_factory.mktemp("wire"), SimulatedArm(seed=1)
    arm.write_urdf(where / "arm.urdf")
    write_wire_table(where / "t.csv", arm, 1)
    return where


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("distance=400", ReadingColumns("distance", 400.0)),
        ("distance=bar", ReadingColumns("distance", ("bar",))),
        ("displacement=wire", ReadingColumns("distance", ("wire",), offset_std=1.0)),
        ("height=0", ReadingColumns("height", 0.0)),
        ("image=u, v,900,910,320.5,-2", ReadingColumns("image", ("u", "v"), None, 0.0, (900.0, 910.0, 320.5, -2.0))),
    ],
)
def test_options_become_columns(text: str, columns: ReadingColumns) -> None:
    units = Units(length="mm", angle="deg", sep=";", decimal=",")
    table = measured_table(Path("t.csv"), Rows(reading=[text]), units, "error")
    assert table.table.readings == (columns,)
    assert (table.table.sep, table.table.decimal, table.duplicates) == (";", ",", "error")


def test_a_number_that_names_a_column_is_that_column(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,b,7\n10,20,100\n20,30,400\n")
    for text, values in {"7": ("7",), "7.0": 7.0}.items():
        rows, units = Rows(reading=[f"distance={text}"]), Units(length="mm", angle="deg")
        table = measured_table(tmp_path / "t.csv", rows, units)
        assert table.table.readings == (ReadingColumns("distance", values),)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([*WIRE, "--position", "x,y,z"], "no column ['x', 'y', 'z']"),
        (["--reading", "length=wire"], "--reading length=wire: expected distance=COLUMN"),
        (["--reading", "distance=wire,anchor"], "--reading distance=wire,anchor: expected"),
        (["--reading", "image=u,v"], "--reading image=u,v: expected distance=COLUMN"),
        (["--reading", "image=u,v,0,1,2,3"], "focal lengths FX, FY are positive"),
        (["--reading", "image=u,v,9,9,2,x"], "--reading image=u,v,9,9,2,x: expected"),
        (
            ["--reading", "distance=0"],
            "--reading distance=0: expected a distance above 0; write the length of the ball bar",
        ),
        (["--reading", "distance=wire", "--tip", "tool"], "tool"),
    ],
)
def test_refused(
    options: list[str], message: str, folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    done = command("fit", "t.csv", *ROBOT, *UNITS, *options, "-o", "none.safetensors")
    assert done.code in (1, 2)
    assert message in " ".join(done.err.split())
    assert not Path("none.safetensors").exists()
