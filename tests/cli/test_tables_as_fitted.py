"""Commands with a model read a table as that of the model's fit; options that are typed win."""

import json
import os
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from command_bank import TABLE, Command, Site
from rich.console import Console

import diffeo_calib as dc
from diffeo_calib.cli.models import ErrorTable
from diffeo_calib.cli.options import Rows, Units
from diffeo_calib.cli.tables import as_at_the_fit, measured_table, rows_in_table, table_format
from diffeo_calib.common.errors import InputError
from diffeo_calib.sensors.errors import Evaluation

FIT = (
    "diffeo-calib fit t.csv --robot r.urdf --tip flange --position a,b,c --position=d,e,f --length mm --angle deg "
    "--sep ';' --std s --lever 50 --camera-on-tool --session day -o m"
)


def test_columns_and_units_of_the_fit() -> None:
    units = Rows(length="mm", angle="deg", sep=";")
    rows = replace(units, position=["a,b,c", "d,e,f"], std="s", lever=50.0, camera_on_tool=True, session="day")
    assert as_at_the_fit(FIT, Rows()) == rows
    assert as_at_the_fit(FIT, Units()) == Units(length="mm", angle="deg", sep=";")


def test_typed_options_win(tmp_path: Path) -> None:
    rows = as_at_the_fit(FIT, Rows(session="night", angle="rad"))
    assert (rows.session, rows.std, rows.angle, rows.length) == ("night", "s", "rad", "mm")
    whole = Rows(position=["x,y,z"], length="m", angle="rad")
    assert as_at_the_fit(FIT, whole) == whole, "what states both units describes the whole format"
    for sep, taken in ((";", ";"), (",", None)):
        (tmp_path / "t.csv").write_text(sep.join("abc") + "\n" + sep.join("123") + "\n")
        assert as_at_the_fit(FIT, whole, tmp_path / "t.csv").sep == taken, "but for its marks, of a file that has them"


def test_units_are_never_guessed() -> None:
    for command, missing in (("", "--length and --angle missing"), ("diffeo-calib fit --length m", "--angle missing")):
        with pytest.raises(InputError, match=missing):
            table_format(as_at_the_fit(command, Rows(position=["x,y,z"])))
    with pytest.raises(InputError, match="--angle missing"):
        table_format(Units(length="m"))


@pytest.mark.parametrize(
    "words", ["--position 'x,y,z", "--position", "--length furlong", "--lever long --angle deg", "--angle=turns"]
)
def test_options_that_are_none_are_one_error(words: str) -> None:
    """Whoever sends a model file may have edited the line in it."""
    command = f"diffeo-calib fit t.csv --position x,y,z --length mm {words}"
    with pytest.raises(InputError, match=r"the options that the model was fitted with: got .*; name the columns"):
        as_at_the_fit(command, Rows())
    whole = Rows(position=["a,b,c"], length="m", angle="rad")
    assert as_at_the_fit(command, whole) == whole  # nothing of it is needed


@pytest.mark.parametrize("place", ["/dev/zero", "pipe", "/nowhere.yaml"])
def test_a_camera_in_the_options_is_a_file(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device or a pipe would never end."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    command = f"diffeo-calib fit t.csv --reading corners={place} --length mm --angle deg"
    rows = as_at_the_fit(command, Rows())
    with pytest.raises(InputError, match=r"(is|there is) no file.* check the path of the camera file"):
        measured_table(tmp_path / "t.csv", rows)


@pytest.mark.usefixtures("fitted")
def test_model_and_table_are_enough(site: Site, sound_path: Path, command: Command, tmp_path: Path) -> None:
    model, out, results = site.folder / "model.safetensors", tmp_path / "out.json", list[object]()
    for options in ([], TABLE):
        done = command("evaluate", model, site.csv, *options, "--json", out)
        assert done.code == 0, done.err
        assert ("read as at the fit: --position mx,my,mz" in done.out) == (not options)
        results.append(json.loads(out.read_text())["results"])
    assert results[0] == results[1]
    joints = ";".join(site.arm.nominal.joint_names)
    for words, header in (
        (["predict", model, site.csv], f"{joints};x;y;z"),
        (["plan", model, "-n", 2, "--draw", 10, "--joints", "A,B,C,D,E,F"], "A;B;C;D;E;F;rank"),
        (["correct", model, site.csv], joints),  # programs are read in the units of the fit
    ):
        done = command(*words, "-o", tmp_path / "o.csv")
        assert done.code == 0, done.err
        assert (tmp_path / "o.csv").read_text().startswith(header)
    for words in (["evaluate", sound_path, site.csv], ["correct", sound_path, site.csv, "-o", tmp_path / "c.csv"]):
        assert "--length and --angle missing" in command(*words).error


@pytest.mark.parametrize("width", [80, 160])
def test_no_number_is_cut(width: int, site: Site) -> None:
    robot, q = site.arm.nominal, site.data.q[:5]
    data = dc.Measurements.from_poses(q, robot(q), on=robot.tips)
    errors = dc.evaluate(lambda some: data.points, data)
    assert isinstance(errors, Evaluation)
    table = ErrorTable({("calibrated", "123 held out"): errors}, "by stage", "stage", "rows")
    console = Console(width=width, record=True, file=StringIO())
    console.print(table)
    text = console.export_text()
    assert "…" not in text
    assert text.count("calibrated") == 2
    assert text.count("0.0000") == 8


UNITS = Rows(length="mm", angle="deg")


def test_kinds_without_columns_are_left_out(tmp_path: Any) -> None:
    rows = replace(
        UNITS, position=["x,y,z"], reading=["distance=wire", "image=u,v,9,9,1,1"], socket="place,socket", session="day"
    )
    rows = replace(rows, distance=["0,1=50"], distance_std=0.03)
    path = tmp_path / "t.csv"
    path.write_text("q1,x,y,z\n1,2,3,4\n")
    found, missing = rows_in_table(path, rows)
    assert found == replace(UNITS, position=["x,y,z"])
    assert missing == ["--socket", "--reading distance=wire", "--reading image=u,v,9,9,1,1"]
    path.write_text("q1,u,v,day\n1,2,3,4\n")
    assert rows_in_table(path, rows)[0] == replace(UNITS, reading=["image=u,v,9,9,1,1"], session="day")
    path.write_text("q1,a\n1,2\n")
    assert rows_in_table(path, rows) == (rows, [])  # a table of other columns: the reader says so
