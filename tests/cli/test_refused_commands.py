"""Wrong usage, options and tables with mistakes, broken files: an exit code and one sentence that says what to do."""

import json
import os
import re
from functools import partial
from pathlib import Path

import jsonschema
import pytest
from command_bank import VALIDATOR, Command, Site, edited, rows_of
from commanded_bank import flange, seen, write_columns
from deformation_bank import model_of
from init_bank import write_socket_table, write_wire_table
from model_file_bank import planar
from table_bank import in_order
from two_arms_bank import robot as two_arms

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.results import SCHEMA


def test_unconverged_is_exit_3(site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_measurements(tmp_path / "t.csv", site.data.rows(slice(11)), TableFormat("m", "rad"))
    monkeypatch.setattr("diffeo_calib.calibration.calibrate.GaussNewton", partial(dc.GaussNewton, max_iterations=1))
    path = tmp_path / "early.safetensors"
    table = ["--position", "x,y,z", "--length", "m", "--angle", "rad"]
    done = command("fit", tmp_path / "t.csv", *site.robot(), *table, "-o", path, "--holdout", 0)
    assert done.code == 3
    assert "stopped at the limit of 1 iterations; judge it by held-out errors" in done.out
    assert "max_iterations" not in done.out
    assert any("11 poses are too few to select scales" in warning for warning in done.warnings)
    assert isinstance(dc.load(path), dc.CalibratedKinematics)


@pytest.fixture(scope="module")
def cell(small_site: Site, sound: bytes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot, tables of all kinds and models: of the robot, of another one with two hands, of a plain function."""
    folder = tmp_path_factory.mktemp("cell")
    (folder / "arm.urdf").write_bytes(small_site.urdf.read_bytes())
    (folder / "model").write_bytes(sound)
    (folder / "points.csv").write_bytes(small_site.csv.read_bytes())
    for name, rows in (("none.csv", (0,)), ("two.csv", (0, 1, 2))):
        edited(small_site, folder / name, rows_of(*rows))
    edited(
        small_site,
        folder / "turned.csv",
        lambda cells: [row + list("ijkl" if k == 0 else "7908") for k, row in enumerate(cells)],
    )
    write_socket_table(folder / "sockets.csv", small_site.arm, "ab", 1)
    write_wire_table(folder / "wires.csv", small_site.arm, 1)
    poses, board = flange(), seen(flange(), camera_on_tool=True)
    turns = {"RX_RY_RZ": rotation_numbers(poses[:, :3, :3], "xyz", angle="deg")}
    turned = rotation_numbers(board[:, :3, :3], "quat_xyzw")
    write_columns(
        folder / "poses.csv", X_Y_Z=1e3 * poses[:, :3, 3], **turns, tx_ty_tz=1e3 * board[:, :3, 3], qx_qy_qz_qw=turned
    )
    dc.save(planar(rows=6).model, folder / "plain")
    hands = model_of(two_arms(folder), dc.RK4(1))
    dc.save(hands, folder / "hands")
    (folder / "hands.csv").write_text(";".join(hands.robot.joint_names) + "\n0;0;0;0;0\n")
    return folder


MM, ROBOT = "--length mm --angle deg", "--robot arm.urdf --base base_link --tip flange"
UNITS = f"{MM} --sep ; --decimal ,"
TABLE = f"--position mx,my,mz {UNITS}"
FIT = f"fit points.csv {ROBOT} {TABLE}"
TURNED, PARTS = FIT.replace("points", "turned"), f"{ROBOT} {MM} --position x,y,z"
SOCKETS, WIRES = f"fit sockets.csv {ROBOT} {MM}", f"fit wires.csv {ROBOT} {MM}"
BLOCK = f"{SOCKETS} --socket place,socket --distance-std 0.01 --distance "
SEEN = "--length mm --position tx,ty,tz --rotation qx,qy,qz,qw --convention quat_xyzw --camera-on-tool"
POSE, PLAN, CORRECT = "X,Y,Z,RX,RY,RZ", f"plan {UNITS} -n 3", f"correct model points.csv {UNITS}"
BOTH = f"correct hands hands.csv {UNITS}"
REFUSED = {
    "fit": "Usage",
    "nonsense": "Usage",
    "evaluate m t.csv --position x,y,z --length km --angle rad": "Usage",
    "evaluate m t.csv --position x,y,z --length m --angle rad --surprise": "Usage",
    "fit t.csv --holdout 1.5": "Usage",
    "evaluate m t.csv --position x,y,z --length m --angle rad --rotation-angle turn": "Usage",
    "demo --count 3": "Usage",
    f"{FIT} --sep ,": "--sep and --decimal: expected different characters ... --sep ';'",
    FIT.replace("flange", "hand"): "no link 'hand' ... its links are base_link, ... flange",
    f"{FIT} --position zenith_gon=x,y,z": "--position: ... in one way, got x, y and z and zenith_gon",
    f"{FIT} --tip wrist_link": "--tip: expected 1, one for each --position, got 2",
    f"{FIT} --base output_link": "no moving joint from 'output_link' to 'flange'",
    FIT.replace("flange", "wrist_link"): "do not fit this robot, even with geometric errors ... as the tip",
    f"{FIT} --joints waist_joint,shoulder_joint": "expected 6 columns, in the order ... got 2",
    f"{FIT} --joints shoulder_joint,waist_joint,elbow_joint,forearm_roll_joint,wrist_bend_joint,wrist_roll_joint": (
        "in another order: expected waist_joint, ... leave it out: columns that are named after"
    ),
    f"{FIT} --robot nowhere.urdf": "there is no file nowhere.urdf; check the path of --robot",
    f"{TURNED} --rotation a,b,c": "--rotation is given, but its --convention is not: expected 'rotvec'",
    f"{TURNED} --rotation a,b,c --convention xyz": "--rotation-angle is missing: expected 'rad'",
    f"{FIT} --lever 100": "--lever without --rotation",
    f"{FIT} --std a,b": "--std: expected names of columns: one, one per marker or three per",
    FIT.replace("points", "none"): "has a header but no rows",
    FIT.replace("points", "two") + " --holdout 0": "at least 3 poses, got 2 ... measure more poses",
    SOCKETS: "name the position columns, or those of --socket or --reading",
    f"{BLOCK} a,b=50 --std s": "--std beside `socket`; leave it out",
    f"{SOCKETS} --distance a,b=50 --distance-std 1 --position x,y,z": "--distance-std without --socket",
    f"{BLOCK} a=50": "--distance a=50: expected A,B=LENGTH",
    f"{BLOCK} a,c=50": "a known distance: expected names of two sockets",
    f"{BLOCK} a,b=50000": "check the unit of `distances`",
    f"{WIRES} --reading length=wire": "--reading length=wire: expected distance=COLUMN",
    f"{WIRES} --reading image=u,v,0,1,2,3": "focal lengths FX, FY are positive",
    f"{WIRES} --reading distance=0": "expected a distance above 0; write the length of the ball bar",
    f"fit sockets.csv --places wires.csv {PARTS}": "--places without --by",
    f"fit sockets.csv --by name {PARTS}": "--by without --places",
    f"campaign sockets.csv --places wires.csv --by name {PARTS}": "--places or --marker, of a table that grows",
    f"campaign sockets.csv --marker reflector {PARTS}": "--places or --marker, of a table that grows",
    f"fit sockets.csv --marker place --socket x {PARTS}": "--marker (place): expected one position",
    f"fit poses.csv --robot-pose {POSE}=XYZ --angle deg {SEEN}": f"poses fit with --robot-pose {POSE}=xyz --angle deg",
    f"fit poses.csv --robot-pose {POSE}=xyz --angle rad {SEEN}": f"poses fit with --robot-pose {POSE}=xyz --angle deg",
    f"fit poses.csv --robot-pose {POSE}=xyz --angle deg --robot poses.csv {SEEN}": (
        "--robot, --base or --tip beside --robot-pose"
    ),
    f"fit poses.csv --robot-pose {POSE}=xyz --angle deg --joints {POSE} {SEEN}": "--joints beside --robot-pose",
    PLAN: "what to plan for: expected a MODEL, or --robot, got neither",
    f"{PLAN} model --base x": "--base beside MODEL",
    f"{PLAN} {ROBOT} --free base": "--free without MODEL",
    f"{PLAN} {ROBOT} --tracker 1,2": "--tracker 1,2: expected 3 or 6 or 7 numbers",
    f"{PLAN} {ROBOT} --range joint_1": "--range joint_1: expected JOINT=A:B",
    f"{PLAN} {ROBOT} --candidates points.csv --draw 9": "--draw beside --candidates",
    f"{PLAN} {ROBOT} --candidates points.csv -n 99": "at most 30, got 99",
    f"{PLAN} {ROBOT} --floor 9000": "`floor` refuses nearly everything",
    "export model": "name at least one file to write: --urdf",
    "export model --urdf a.urdf --tool 0,0,1": "--tool without --c or --torch or --onnx",
    "export model --urdf arm.urdf": "is the robot's own URDF; name another",
    "export model --dh d.csv --dh-convention khalil": "'khalil' is not one of",
    "export model --dh same --joint-offsets same": "same is the file of --dh",
    "export model --c u.c --joint-offsets u.h": "--c (its header) u.h is the file of --joint-offsets",
    "export model --urdf a.urdf --ur-kinematics ur.yaml": "expected shoulder_pan_joint, shoulder_lift_joint",
    f"{CORRECT} --tool 1,2": "--tool 1,2: expected X,Y,Z, or 6 numbers with the rotation as 'rotvec'",
    f"{CORRECT} --tool 1,2,3,1,1,1,1 --convention quat_xyzw": "--tool: expected a quaternion of length 1",
    f"{CORRECT} --tool 0,0,150 --length m": "error: --tool is 150 m long, more than the robot reaches",
    f"{CORRECT} --tool measured:0,0,0.1": "calibrated with points, which have no measured frame",
    f"{CORRECT} --frame measuring": "--frame measuring: the nominal poses of commands are in the robot's base",
    f"{CORRECT} --limit 0": "--limit: expected a number above 0",
    f"{CORRECT} --rotation a,b,c": "--rotation without --position",
    f"{BOTH} --tip left --tip left": "--tip left is named twice",
    f"{BOTH} --tip left --tip foot": "--tip: expected one of",
    f"{BOTH} --tip left --tip right --tool 0,0,1": "--tool: expected 2 of them, got 1",
    BOTH: "has several tips",
    f"evaluate arm.urdf points.csv {TABLE}": "it is a URDF; pass a file written by",
    f"evaluate plain points.csv {TABLE}": "plain function",
    f"evaluate model points.csv {TABLE} --length m": "1000 times too large",
    f"evaluate model points.csv {UNITS} --position my,mx,mz": "left-handed: exchange",
    f"evaluate model points.csv {TABLE} --joints waist_joint": "expected 6 columns, in the order",
    f"evaluate model turned.csv {TABLE} --rotation i,j,k --convention xyz --rotation-angle deg": (
        "with points: expected measured points, got poses"
    ),
    f"evaluate model points.csv {TABLE} -o m.safetensors": "-o without --free: expected a table of errors, got ",
    f"evaluate model points.csv {TABLE} --free both -o model": "-o model is the file of MODEL; name another file.",
    f"evaluate model two.csv {TABLE} --free both": "expected at least 3 rows, got 2",
    f"predict model points.csv {UNITS} --convention rotvec": "this model has none",
    f"predict model points.csv {UNITS} --rotation-angle deg": "this model has none",
}
"""Words of a command -> what is said."""


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_refused(words: str, cell: Path, command: Command) -> None:
    command.monkeypatch.chdir(cell)
    before, output = os.listdir(), ["-o", "out"] * (words.split(maxsplit=1)[0] in ("fit", "plan", "correct", "predict"))
    done = command(*words.split(), *output)
    said = " ".join(done.err.split())
    assert re.search(in_order(REFUSED[words]), said), said
    assert done.code == (2 if "Usage" in said else 1)
    assert "Traceback" not in said
    assert "Usage" in said or done.error
    assert os.listdir() == before


def test_outputs_are_checked_before_the_fit(small_site: Site, command: Command, tmp_path: Path) -> None:
    command.monkeypatch.setattr("diffeo_calib.cli.models.robot_of", lambda *_: pytest.fail("the work has begun"))
    (tmp_path / "here.png").mkdir()
    for option in ("-o", "--report"):
        for place, message in (("none/file.png", "No such file or directory"), ("here.png", "Is a directory")):
            done = command(*small_site.fit(small_site.csv, tmp_path / "model"), option, tmp_path / place)
            assert done.code == 1
            assert f"file '{tmp_path / place}' cannot be written ({message})" in done.error


def test_results_of_errors_and_places_that_are_taken(cell: Path, tmp_path: Path, command: Command) -> None:
    """With --json: results for programs, as the schema describes them."""
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    out, model, predicted, table = tmp_path / "out.json", cell / "model", tmp_path / "p.csv", cell / "points.csv"
    assert command("evaluate", "none.safetensors", table, *MM.split(), "--json", out).code == 1
    written = json.loads(out.read_text(encoding="utf-8"))
    VALIDATOR.validate(written)
    assert (written["exit_code"], written["results"], written["arguments"][0]) == (1, {}, "evaluate")
    assert "none.safetensors" in written["error"]
    before = model.read_bytes()
    for place, words in ((model, "--json"), (predicted, "--json"), (tmp_path / "none" / "x.json", "make its folder")):
        assert words in command.failed("predict", model, table, *UNITS.split(), "-o", predicted, "--json", place)
    assert model.read_bytes() == before
    assert not predicted.exists()


@pytest.mark.parametrize(
    "words",
    [
        "predict model new.csv --length furlong --json out.json",
        "predict model --no-such-option --json=out.json",
        "fit none.toml --json out.json",
        "fit c.toml",
    ],
)
def test_an_earlier_result_is_removed(words: str, tmp_path: Path, command: Command) -> None:
    """The command ends before it could begin: nothing is left, whatever the exit code is looked at."""
    command.monkeypatch.chdir(tmp_path)
    Path("out.json").write_text('{"format": "diffeo_calib result", "exit_code": 0}', encoding="utf-8")
    Path("c.toml").write_text('csv = "new.csv"\njson = "out.json"\nlength = "furlong"\n', encoding="utf-8")
    assert command(*words.split()).code in (1, 2)
    assert not Path("out.json").exists()
