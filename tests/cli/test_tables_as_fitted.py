"""Options of campaign files and of a model's fit, which later tables are read by: columns, units, markers, readings."""

import json
import os
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from command_bank import TABLE, Command, Site
from kind_bank import UNITS, kind_named, table_options
from rich.console import Console
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.main import expanded
from diffeo_calib.cli.models import ErrorTable
from diffeo_calib.cli.options import Rows, Units
from diffeo_calib.cli.tables import as_at_the_fit, measured_table, rows_in_table, table_format
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.csv.sensors import ReadingColumns
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm
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


MM_DEG = Rows(length="mm", angle="deg")


def test_kinds_without_columns_are_left_out(tmp_path: Any) -> None:
    rows = replace(
        MM_DEG, position=["x,y,z"], reading=["distance=wire", "image=u,v,9,9,1,1"], socket="place,socket", session="day"
    )
    rows = replace(rows, distance=["0,1=50"], distance_std=0.03)
    path = tmp_path / "t.csv"
    path.write_text("q1,x,y,z\n1,2,3,4\n")
    found, missing = rows_in_table(path, rows)
    assert found == replace(MM_DEG, position=["x,y,z"])
    assert missing == ["--socket", "--reading distance=wire", "--reading image=u,v,9,9,1,1"]
    path.write_text("q1,u,v,day\n1,2,3,4\n")
    assert rows_in_table(path, rows)[0] == replace(MM_DEG, reading=["image=u,v,9,9,1,1"], session="day")
    path.write_text("q1,a\n1,2\n")
    assert rows_in_table(path, rows) == (rows, [])  # a table of other columns: the reader says so


def campaign(tmp_path: Path, text: str) -> str:
    (tmp_path / "cell.toml").write_text(text, encoding="utf-8")
    return str(tmp_path / "cell.toml")


def test_entries_become_options_and_typed_ones_replace_them(tmp_path: Path) -> None:
    text = 'csv = "a.csv"\nrobot = "r.urdf"\nposition = ["x,y,z", "u,v,w"]\njoints = ["q1", "q2"]\nholdout = 0.2\n'
    words = expanded(["fit", campaign(tmp_path, text), "--holdout", "0"])
    table = [str(tmp_path / "a.csv"), "--robot", str(tmp_path / "r.urdf")]
    markers = ["--position", "x,y,z", "--position", "u,v,w", "--joints", "q1,q2"]
    assert words == ["fit", *table, *markers, "--holdout", "0"]
    for typed in (["--tip", "flange"], ["--tip=flange"]):  # a tip beside those of the file would be another arm
        text = 'csv = "a.csv"\ntip = ["one", "two"]\nholdout = 0.2\n'
        assert expanded(["fit", campaign(tmp_path, text), *typed])[2:] == ["--holdout", "0.2", *typed]
    for other in (["fit", "a.csv"], ["evaluate", "a.toml"], ["fit"], []):
        assert expanded(other) == other


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('csv = "a.csv"\nlenght = "mm"\n', "lenght"),
        ('length = "mm"\n', "csv"),
        ("csv = \n", "TOML"),
        ('csv = "a.csv"\nlength = {unit = "mm"}\n', "length"),
        ('csv = ["a.csv"]\n', "csv"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        expanded(["fit", campaign(tmp_path, text)])
    with pytest.raises(InputError, match=r"none\.toml"):
        expanded(["fit", str(tmp_path / "none.toml")])
    with pytest.raises(InputError, match=r"\.toml. is too large for a campaign file: expected at most 1 MB"):
        expanded(["fit", campaign(tmp_path, "#" * (1 << 20) + "\n")])
    (tmp_path / "endless.toml").symlink_to("/dev/zero")
    deep = campaign(tmp_path, "x=" + "[" * 5000), "is no TOML"
    for name, words in (deep, ("a\0.toml", "no file"), (str(tmp_path / "endless.toml"), "is no file")):
        with pytest.raises(InputError, match=words):
            expanded(["fit", name])


WITH_PLACES = "diffeo-calib fit t.csv --position x,y,z --length mm --angle deg --places p.csv --by name -o m"
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
    command = f"{WITH_PLACES} --marker smr --marker smr=b,a,c"
    assert as_at_the_fit(command, Rows()).marker == "smr=b,a,c"
    for typed, expected in (("ball", "ball=b,a,c"), ("ball=c,a", "ball=c,a")):
        given = Rows(position=["x,y,z"], marker=typed, length="m", angle="rad")
        assert as_at_the_fit(command, given).marker == expected
    assert as_at_the_fit(WITH_PLACES, Rows(marker="ball")).marker == "ball"
    units = Rows(length="mm", angle="deg")
    assert as_at_the_fit(WITH_PLACES, units) == replace(units, position=["x,y,z"])
    new = replace(units, places=Path("new.csv"))
    assert as_at_the_fit(WITH_PLACES, new) == replace(new, position=["x,y,z"], by="name")


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


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("distance=bar", ReadingColumns("distance", ("bar",))),
        ("distance=7", ReadingColumns("distance", ("7",))),  # a column of this name
        ("distance=7.0", ReadingColumns("distance", 7.0)),
        ("displacement=wire", ReadingColumns("distance", ("wire",), offset_std=1.0)),
        ("height=0", ReadingColumns("height", 0.0)),
        ("image=u, v,900,910,320.5,-2", ReadingColumns("image", ("u", "v"), None, 0.0, (900.0, 910.0, 320.5, -2.0))),
    ],
)
def test_options_become_columns(text: str, columns: ReadingColumns, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a;b;7\n10;20;100\n20;30;400\n")
    rows = Rows(reading=[text], length="mm", angle="deg", sep=";", decimal=",")
    assert measured_table(tmp_path / "t.csv", rows).table.readings == (columns,)


def test_set_ups_are_evaluated_each_in_its_place(command: Command, tmp_path: Path) -> None:
    """The device moves by 100 mm before the rows of b: errors stay what they are, and so does the spread in sockets."""
    kind, path = kind_named("mixture"), tmp_path / "t.csv"
    tracked, resting = kind.data.parts
    later, away = torch.arange(len(tracked)) % 2, torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    moved = tracked.shifted(later[:, None, None] * away).with_sessions(["ab"[day] for day in later.tolist()])
    written = []
    for rows in (kind.data, dc.Measurements.joined([moved, resting])):
        options = table_options(kind.written(rows, path))
        done = command.ran("evaluate", kind.file, path, *UNITS, *options, "--json", tmp_path / "e.json")
        written.append(json.loads((tmp_path / "e.json").read_text())["results"])
    assert "the frames of 2 sessions were found from these rows, 12 numbers in all" in " ".join(done.out.split())
    still, placed = written
    assert placed["kinds"]["socket"] == still["kinds"]["socket"]
    assert placed["errors"]["all"]["rows"] == len(tracked)
    assert sum(own["rows"] for own in placed["errors"]["in_sessions"].values()) == len(tracked)
    assert placed["errors"]["all"]["rms_m"] <= still["errors"]["all"]["rms_m"]
    a, b = (torch.tensor(placed["session_transforms"][name], dtype=torch.float64)[:3, 3] for name in "ab")
    assert_close(b - a, away, rtol=0, atol=2e-3)


@pytest.mark.slow
def test_models_with_payloads_ask_for_them(tmp_path: Path, command: Command) -> None:
    kind = kind_named("payloads")
    assert f"; payload {kind.model.payload:g}" in repr(kind.model)
    table, options = kind.table("new")
    at = options.index("--payload")
    without, out = [*options[:at], *options[at + 2 :]], ["-o", tmp_path / "out"]
    for words in (
        ["evaluate", kind.file, table, *without],
        ["evaluate", kind.file, table, *without, "--report", tmp_path / "out"],
        ["recalibrate", kind.file, table, *without, *out],
        ["predict", kind.file, table, *UNITS, *out],
        ["correct", kind.file, table, *UNITS, *out],
    ):
        assert "payload" in command.failed(*words)
