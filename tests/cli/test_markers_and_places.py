"""Tables whose lines name their marker, and measured places in a file of their own."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from command_bank import Command

from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.tables import as_at_the_fit
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

FIT = "diffeo-calib fit t.csv --position x,y,z --length mm --angle deg --places p.csv --by name -o m"
ARM = SimulatedArm(seed=2, markers=3)
ROWS = 30


class Files(NamedTuple):
    """A robot; its table with one marker in each line; the same in two files, the second one in another order."""

    urdf: Path
    whole: Path
    joints: Path
    places: Path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("files")
    found = Files(*(folder / name for name in ("arm.urdf", "whole.csv", "joints.csv", "places.csv")))
    ARM.write_urdf(found.urdf)
    q, points = ARM.measure(ROWS, seed=3)
    joints = [list(ARM.nominal.joint_names), q.rad2deg().tolist()]
    seen = [[*(1e3 * points[row, row % 3]).tolist(), ("front", "left", "top")[row % 3]] for row in range(ROWS)]
    names, xyz, table = [f"P{row}" for row in range(ROWS)], ["x", "y", "z", "reflector"], TableFormat("mm", "deg")
    write_rows(found.whole, [*joints[0], *xyz], [[[*a, *b] for a, b in zip(joints[1], seen, strict=True)]], table)
    write_rows(found.joints, ["name", *joints[0]], [[[a, *b] for a, b in zip(names, joints[1], strict=True)]], table)
    order = [*zip(seen, names, strict=True)][::-1]
    write_rows(found.places, [*xyz, "name"], [[[*a, b] for a, b in order[1:]]], table)
    return found


def test_later_tables_have_the_markers_of_the_model() -> None:
    """The order of the markers is kept with the model, also where the column is typed; not the file of the places."""
    command = f"{FIT} --marker smr --marker smr=b,a,c"
    assert as_at_the_fit(command, Rows()).marker == "smr=b,a,c"
    for typed, expected in (("ball", "ball=b,a,c"), ("ball=c,a", "ball=c,a")):
        given = Rows(position=["x,y,z"], marker=typed, length="m", angle="rad")
        assert as_at_the_fit(command, given).marker == expected
    assert as_at_the_fit(FIT, Rows(marker="ball")).marker == "ball"
    units = Rows(length="mm", angle="deg")
    assert as_at_the_fit(FIT, units) == replace(units, position=["x,y,z"])
    new = replace(units, places=Path("new.csv"))
    assert as_at_the_fit(FIT, new) == replace(new, position=["x,y,z"], by="name")


def test_init_joins_two_files_and_finds_the_markers(files: Files, tmp_path: Path, command: Command, init: Any) -> None:
    _, text = init(files.joints, files.urdf, "--places", files.places)
    assert 'by = "name"  # 29 lines of places.csv are joined with lines of joints.csv by name; lines without' in text
    for words in ('places.csv"  # the measured', 'marker = "reflector"', 'length = "mm"', "# all columns are used"):
        assert words in text
    done = command("fit", tmp_path / "c.toml", "--position", "x")
    assert "--position: expected three names of columns" in done.error
    written, text = init(files.whole, files.urdf)
    assert 'marker = "reflector"  # names the marker of each row: 3 values between which the points jump' in text
    assert written["length"] == "mm"


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_a_model_knows_its_markers(files: Files, tmp_path: Path, command: Command, init: Any) -> None:
    init(files.joints, files.urdf, "--places", files.places)
    done = command.ran("fit", tmp_path / "c.toml", "-o", tmp_path / "m.safetensors", "--holdout", 0)
    header, *lines = files.whole.read_text().splitlines()
    some = [line for line in lines if not line.endswith("left")]
    (tmp_path / "some.csv").write_text("\n".join([header, *some]) + "\n")
    done = command.ran("evaluate", tmp_path / "m.safetensors", tmp_path / "some.csv")
    assert done.numbers("in all")[0] < 0.1
    (tmp_path / "some.csv").write_text("\n".join([header, *some]).replace("front", "rear") + "\n")
    done = command("evaluate", tmp_path / "m.safetensors", tmp_path / "some.csv")
    assert "column 'reflector': expected markers of the model: " in done.error
    assert "got rear" in done.error
