"""Balls in sockets, readings, payloads, and rows of several kinds on the command line, and what is refused."""

import json
from pathlib import Path

import pytest
import torch
from command_bank import Command
from init_bank import write_socket_table, write_wire_table
from kind_bank import UNITS, kind_named
from product_bank import with_usual_scales
from simulated_sockets import rest_in_sockets
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.tables import measured_table
from diffeo_calib.measurements.csv.sensors import ReadingColumns
from diffeo_calib.robots import SimulatedArm

ROBOT, DEG = ["--robot", "arm.urdf", "--base", "base_link", "--tip", "flange"], ["--length", "mm", "--angle", "deg"]
SOCKETS = ["--socket", "place,socket", "--distance", "a,b=50", "--distance-std", "0.01"]


@pytest.fixture(scope="module")
def sockets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where, arm = tmp_path_factory.mktemp("sockets"), SimulatedArm(seed=1)
    arm.write_urdf(where / "arm.urdf")
    write_socket_table(where / "t.csv", arm, "ab", 1)
    return where


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_from_a_campaign_file_to_errors(sockets: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(sockets)
    campaign = ['csv = "t.csv"', 'robot = "arm.urdf"', 'base = "base_link"', 'tip = "flange"', 'length = "mm"']
    campaign += ['angle = "deg"', 'socket = ["place", "socket"]', 'distance = ["a,b=50"]', "distance-std = 0.01"]
    (sockets / "c.toml").write_text("\n".join([*campaign, 'output = "m.safetensors"']))
    fitted = command.ran("fit", "c.toml")
    assert "Spread within sockets in mm by stage" in fitted.out
    assert "12 held out" in fitted.out, "one whole place"
    assert "known 50.000" in fitted.out
    done = command.ran("evaluate", "m.safetensors", "t.csv", *SOCKETS, *DEG)
    assert done.out.count("known 50.000") == 3


@pytest.fixture(scope="module")
def wires(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where, arm = tmp_path_factory.mktemp("wire"), SimulatedArm(seed=1)
    arm.write_urdf(where / "arm.urdf")
    write_wire_table(where / "t.csv", arm, 1)
    return where


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "name the position columns, or those of --socket or --reading"),
        ([*SOCKETS, "--std", "s"], "--std beside `socket`; leave it out"),
        (["--distance", "a,b=50", "--distance-std", "1", "--position", "x,y,z"], "--distance-std without --socket"),
        ([*SOCKETS[:2], "--distance", "a=50", *SOCKETS[4:]], r"--distance a=50: expected A,B=LENGTH"),
        ([*SOCKETS[:2], "--distance", "a,c=50", *SOCKETS[4:]], "a known distance: expected names of two sockets"),
        ([*SOCKETS[:2], "--distance", "a,b=50000", *SOCKETS[4:]], "check the unit of `distances`"),
        (["--reading", "length=wire"], "--reading length=wire: expected distance=COLUMN"),
        (["--reading", "image=u,v,0,1,2,3"], "focal lengths FX, FY are positive"),
        (["--reading", "distance=0"], "expected a distance above 0; write the length of the ball bar"),
    ],
)
def test_refused_rows(options: list[str], message: str, sockets: Path, wires: Path, command: Command) -> None:
    command.monkeypatch.chdir(wires if "--reading" in options else sockets)
    done = command("fit", "t.csv", *ROBOT, *DEG, *options, "-o", "none.safetensors")
    assert done.code in (1, 2)
    assert message in " ".join(done.err.split())
    assert not Path("none.safetensors").exists()


RAD = ["--length", "mm", "--angle", "rad"]
POSITION = ["--position", "x,y,z"]
TRACKED = 11
"""Too few to search for scales: defaults are quick."""


@pytest.fixture(scope="module")
def mixtures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of 11 positions and 2 places x 2 sockets x 3 rows, shuffled, and its robot."""
    where, arm = tmp_path_factory.mktemp("mixture"), SimulatedArm(seed=1, markers=2)
    rows = rest_in_sockets(arm, seed=1, places=2, rows=3)
    arm.write_urdf(where / "arm.urdf")
    q, points = arm.measure(TRACKED, seed=3)
    seen = zip(q.tolist(), (1e3 * points[:, 1]).tolist(), strict=True)
    lines = [["", "", *map(repr, angles), *map(repr, place)] for angles, place in seen]
    for angles, name in zip(rows.q.tolist(), rows.names, strict=True):
        place, socket = name.split("/")
        lines.insert(3, [f"spot {place}", "ab"[int(socket)], *map(repr, angles), "", "", ""])
    header = ["place", "socket", *arm.nominal.joint_names, "x", "y", "z"]
    (where / "t.csv").write_text("\n".join(map(",".join, [header, *lines])))
    return where


@pytest.fixture(scope="module")
def mixed(mixtures: Path) -> Path:
    robot = dc.load_urdf(mixtures / "arm.urdf", "base_link", "flange")
    columns = {"socket": ["place", "socket"], "distances": {("a", "b"): 0.05}, "distance_std": 1e-5}
    rows = dc.read_measurements(mixtures / "t.csv", robot, ["x", "y", "z"], **columns, length="mm", angle="rad")
    dc.save(with_usual_scales(robot, rows).model, mixtures / "mixed.safetensors")
    return mixtures / "mixed.safetensors"


def test_set_ups_are_evaluated_each_in_its_place(mixed: Path, command: Command, tmp_path: Path) -> None:
    """The device moves by 100 mm before the rows of b: errors stay what they are, and so does the spread in sockets."""
    header, *lines = mixed.with_name("t.csv").read_text().split("\n")
    cells = [[*line.split(","), "" if line.startswith("spot") else "ab"[k % 2]] for k, line in enumerate(lines)]
    for row in cells:
        row[-4] = repr(float(row[-4]) + 100.0) if row[-1] == "b" else row[-4]
    (tmp_path / "moved.csv").write_text("\n".join([f"{header},day", *map(",".join, cells)]))
    written = []
    for options in ([mixed.with_name("t.csv")], [tmp_path / "moved.csv", "--session", "day"]):
        done = command.ran("evaluate", mixed, *options, *POSITION, *SOCKETS, *RAD, "--json", tmp_path / "e.json")
        written.append(json.loads((tmp_path / "e.json").read_text())["results"])
    assert "the frames of 2 sessions were found from these rows, 12 numbers in all" in " ".join(done.out.split())
    still, placed = written
    assert placed["kinds"]["socket"] == still["kinds"]["socket"]
    assert placed["errors"]["all"]["rows"] == TRACKED
    assert sum(own["rows"] for own in placed["errors"]["in_sessions"].values()) == TRACKED
    assert placed["errors"]["all"]["rms_m"] <= still["errors"]["all"]["rms_m"]
    a, b = (torch.tensor(placed["session_transforms"][name], dtype=torch.float64)[:3, 3] for name in "ab")
    assert_close(b - a, torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64), rtol=0, atol=2e-3)


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
