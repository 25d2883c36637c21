"""Campaign files: options written once, and `init`, which proposes them."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest
from command_bank import Command
from kind_bank import kind_named
from product_bank import simulated_poses
from trackerless_bank import write_socket_table, write_wire_table
from typer.main import get_command

import diffeo_calib as dc
from diffeo_calib.cli.guesses import guess_deviations, guess_sheet
from diffeo_calib.cli.main import app, expanded
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


def campaign(tmp_path: Path, text: str) -> str:
    (tmp_path / "cell.toml").write_text(text, encoding="utf-8")
    return str(tmp_path / "cell.toml")


def test_entries_become_options(tmp_path: Path) -> None:
    text = 'csv = "a.csv"\nrobot = "r.urdf"\nposition = ["x,y,z", "u,v,w"]\njoints = ["q1", "q2"]\nholdout = 0.2\n'
    words = expanded(["fit", campaign(tmp_path, text), "--holdout", "0"])
    table = [str(tmp_path / "a.csv"), "--robot", str(tmp_path / "r.urdf")]
    markers = ["--position", "x,y,z", "--position", "u,v,w", "--joints", "q1,q2"]
    assert words == ["fit", *table, *markers, "--holdout", "0"]


@pytest.mark.parametrize("typed", [["--tip", "flange"], ["--tip=flange"]])
def test_typed_options_replace_those_of_the_file(tmp_path: Path, typed: list[str]) -> None:
    """A tip beside those of the file would be another arm."""
    text = 'csv = "a.csv"\ntip = ["one", "two"]\nholdout = 0.2\n'
    words = expanded(["fit", campaign(tmp_path, text), *typed])
    assert words[2:] == ["--holdout", "0.2", *typed]


@pytest.mark.parametrize("words", [["fit", "a.csv"], ["evaluate", "a.toml"], ["fit"], []])
def test_other_command_lines_stay(words: list[str]) -> None:
    assert expanded(words) == words


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


@pytest.mark.parametrize(
    "written", [(",", ".", "mm", "deg"), (";", ",", "m", "rad"), ("\t", ".", "mm", "rad"), ("|", ",", "m", "deg")]
)
def test_a_proposal_is_that_of_the_table(written: tuple[str, str, str, str], tmp_path: Path, command: Command) -> None:
    sep, decimal, length, angle = written
    arm = SimulatedArm(seed=3, markers=2)
    arm.write_urdf(tmp_path / "arm.urdf")
    data = dc.Measurements(*arm.measure(60, seed=0), arm.nominal.joint_names)
    positions = [("left x", "left y", "left z"), ("right x", "right y", "right z")]
    write_measurements(tmp_path / "t.csv", data, TableFormat(length, angle, sep, decimal), position=positions)
    out = tmp_path / "sub"
    out.mkdir()
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", out / "cell.toml")
    assert (done.code, done.err) == (0, "")
    assert "the nominal robot leaves, of what the rows vary" in done.out
    words = expanded(["fit", str(out / "cell.toml")])
    options = dict(zip(words[2::2], words[3::2], strict=True))
    assert os.path.realpath(words[1]) == os.path.realpath(tmp_path / "t.csv")
    assert (options["--length"], options["--angle"], options["--decimal"]) == (length, angle, decimal)
    assert options["--sep"] == ("tab" if sep == "\t" else sep)
    assert [words[k + 1] for k, word in enumerate(words) if word == "--position"] == [",".join(p) for p in positions]
    assert options["--joints"] == ",".join(arm.nominal.joint_names)
    assert (options["--base"], options["--tip"]) == ("base_link", "flange")


@pytest.mark.parametrize(("rows", "message"), [(50, "one clear reading"), (3, "3 row(s)")])
def test_a_robot_that_explains_nothing_is_refused(rows: int, message: str, tmp_path: Path, command: Command) -> None:
    arm, other = SimulatedArm(seed=3), SimulatedArm(seed=4)
    arm.write_urdf(tmp_path / "arm.urdf")
    q, _ = arm.measure(rows, seed=0)
    _, points = other.measure(rows, seed=9)
    data = dc.Measurements(q, points, arm.nominal.joint_names)
    write_measurements(tmp_path / "t.csv", data, TableFormat("mm", "deg"), position=("x", "y", "z"))
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "cell.toml")
    assert done.code == 1
    assert message in done.error
    assert not (tmp_path / "cell.toml").exists()


def test_sockets_are_proposed(tmp_path: Path, init: Any) -> None:
    """Angles in degrees, known by the ball; distances are for the user to fill in."""
    arm = SimulatedArm(seed=1)
    arm.write_urdf(tmp_path / "arm.urdf")
    write_socket_table(tmp_path / "t.csv", arm, "ab", 1)
    written, text = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    assert written["socket"] == ["place", "socket"]
    assert (written["angle"], written["length"]) == ("deg", "mm")
    assert not {"position", "distance", "distance-std"} & set(written)
    assert "# all columns are used" in text
    filled = tomllib.loads(text.replace("# distance", "distance"))
    assert filled["distance"] == ["a,b=50"]
    words = expanded(["fit", campaign(tmp_path, text.replace("# distance", "distance"))])
    assert words[words.index("--socket") + 1] == "place,socket"
    assert words[words.index("--distance") + 1] == "a,b=50"


def test_sockets_of_a_panda(ur10_folder: Path, tmp_path: Path, init: Any) -> None:
    """Read as degrees all angles are near zero, and the ball hardly leaves its place: 4.9 mm beside the right 2.6."""
    data = ur10_folder.parent / "mukca"
    init(data / "panda_3.csv", data / "panda.urdf")
    assert tomllib.loads((tmp_path / "c.toml").read_text())["angle"] == "rad"


def test_sockets_beside_positions_are_proposed_in_the_unit_of_these(tmp_path: Path, init: Any) -> None:
    arm = SimulatedArm(seed=1)
    arm.write_urdf(tmp_path / "arm.urdf")
    write_socket_table(tmp_path / "t.csv", arm, "ab", 1)
    header, *rows = (tmp_path / "t.csv").read_text().split("\n")
    q, points = arm.measure(20, seed=2)
    seen = [["", "", *map(repr, [*a, *p])] for a, p in zip(q.rad2deg().tolist(), points[:, 0].tolist(), strict=True)]
    lines = [f"{header},x,y,z", *map(",".join, seen), *(f"{row},,," for row in rows)]
    (tmp_path / "t.csv").write_text("\n".join(lines))
    _, text = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    written = tomllib.loads(text.replace("# distance", "distance"))
    assert (written["position"], written["socket"]) == (["x,y,z"], ["place", "socket"])
    assert (written["angle"], written["length"]) == ("deg", "m")
    assert written["distance"] == ["a,b=0.05"]
    assert float(written["distance-std"]) == 3e-5


def test_the_ur10(ur10_folder: Path, tmp_path: Path, command: Command) -> None:
    assert guess_sheet(ur10_folder / "measurements_iso_cubes.csv").decimal == ","
    done = command(
        "init", ur10_folder / "measurements_iso_cubes.csv", ur10_folder / "ur10_robot.urdf", "-o", tmp_path / "ur.toml"
    )
    assert done.code == 0, done.err
    text = (tmp_path / "ur.toml").read_text()
    for line in (
        *('length = "mm"', 'angle = "rad"', 'decimal = ","', 'sep = ";"', "measurement_x,measurement_y"),
        *('rotation = "measurement_rx,measurement_ry,measurement_rz"', 'convention = "XYZ"', 'rotation-angle = "deg"'),
        'std = "measurement_std_x,measurement_std_y,measurement_std_z"',
    ):
        assert line in text
    assert "time = " not in text, "numbers that `fit` refuses"
    assert "Timestamp, Goal x" in text.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("convention", "unit", "names"),
    [
        ("zyx", "deg", ["roll", "pitch", "yaw"]),
        ("ZXZ", "rad", ["m_rx", "m_ry", "m_rz"]),
        ("rotvec", "deg", ["rx", "ry", "rz"]),
        ("quat_xyzw", None, ["qx", "qy", "qz", "qw"]),
        ("matrix", None, [f"R{i}{j}" for i in "012" for j in "012"]),
    ],
)
def test_rotations_are_proposed_in_the_convention_that_fits(
    convention: str, unit: str | None, names: list[str], tmp_path: Path, init: Any
) -> None:
    arm, data, _ = simulated_poses(40)
    arm.write_urdf(tmp_path / "arm.urdf")
    table = TableFormat("mm", "deg", rotation=names, convention=convention, rotation_angle=unit)
    position = ("m_x", "m_y", "m_z") if names[0].startswith("m_") else ("x", "y", "z")
    write_measurements(tmp_path / "t.csv", data, table, position=position)
    written, _ = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    assert written["rotation"] == ",".join(names)
    assert written["convention"] == convention
    assert written.get("rotation-angle") == unit
    known = [option for one in get_command(app).commands["fit"].params for option in one.opts]  # pyright: ignore[reportAttributeAccessIssue]
    assert {f"--{name}" for name in written} - {"--csv"} <= set(known)


def test_rotations_that_no_convention_explains_are_named_and_not_used(tmp_path: Path, init: Any) -> None:
    arm, data, _ = simulated_poses(40)
    arm.write_urdf(tmp_path / "arm.urdf")
    turned = data.rows([*range(1, 40), 0])
    mixed = dc.Measurements(data.q, data.points[:, 0], data.joint_names).to_frame()
    mixed[["rx", "ry", "rz"]] = turned.to_frame()[["rx", "ry", "rz"]].to_numpy()
    mixed.to_csv(tmp_path / "t.csv", index=False)
    _, text = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    assert "rotation =" not in text
    assert "# rx, ry, rz: rotations of no convention that is clearly better than others; not used" in text
    assert "such names usually mean a rotation vector, or angles about x, y and z" in text


def test_deviations_are_proposed_if_they_can_be_some(tmp_path: Path, command: Command) -> None:
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "arm.urdf")
    frame = dc.Measurements(*arm.measure(40, seed=0), arm.nominal.joint_names, std=2e-5).to_frame()
    for std, proposed in ((2e-5, True), (0.0, False), (0.5, False)):
        frame[["std_x", "std_y", "std_z"]] = std
        frame.to_csv(tmp_path / "t.csv", index=False)
        done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "c.toml", "--force")
        assert done.code == 0, done.err
        text = (tmp_path / "c.toml").read_text()
        assert ('std = "std_x,std_y,std_z"' in text) is proposed
        assert ("# std_x, std_y, std_z: no standard deviations" in text) is not proposed


def test_names_of_deviations() -> None:
    triples = [["m_x", "m_y", "m_z"]]
    assert guess_deviations(["m_std_x", "m_std_z", "m_std_y", "m_x"], triples) == ["m_std_x", "m_std_y", "m_std_z"]
    assert guess_deviations(["m_std_x", "m_std_y", "m_x"], triples) is None


def test_an_edited_file_is_kept(tmp_path: Path, command: Command) -> None:
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "arm.urdf")
    data = dc.Measurements(*arm.measure(40, seed=0), arm.nominal.joint_names)
    write_measurements(tmp_path / "t.csv", data, TableFormat("mm", "deg"), position=("tx", "ty", "tz"))
    words = "init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "c.toml"
    assert command(*words).code == 0
    assert 'position = ["tx,ty,tz"]' in (tmp_path / "c.toml").read_text()
    assert command(*words).code == 0  # the same again
    with (tmp_path / "c.toml").open("a") as file:
        file.write("holdout = 0\n")
    done = command(*words)
    assert done.code == 1
    assert "exists and holds other options" in done.err
    assert (tmp_path / "c.toml").read_text().endswith("holdout = 0\n")
    assert command(*words, "--force").code == 0
    assert "holdout" not in (tmp_path / "c.toml").read_text()


@pytest.mark.slow
def test_a_wire_its_anchors_and_a_payload(tmp_path: Path, command: Command, init: Any) -> None:
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "arm.urdf")
    write_wire_table(tmp_path / "wire.csv", arm, seed=1)
    _, text = init(tmp_path / "wire.csv", tmp_path / "arm.urdf")
    assert 'reading = "displacement=wire"' in text
    assert 'session = "anchor"' in text
    assert 'length = "mm"' in text
    assert 'angle = "deg"' in text
    frame = dc.Measurements(*arm.measure(40, seed=0), arm.nominal.joint_names).to_frame()
    frame["payload_kg"] = [0.0, 2.0] * 20
    frame["time_s"], frame["Temperature"] = range(40), [21.5] * 40
    frame.to_csv(tmp_path / "t.csv", index=False)
    proposed, _ = init(tmp_path / "t.csv", tmp_path / "arm.urdf", name="d.toml")
    assert {name: proposed[name] for name in ("payload", "time", "temperature")} == {
        "payload": "payload_kg",
        "time": "time_s",
        "temperature": "Temperature",
    }
    frame["time_s"] += 20_210_313_000_000  # a date: `fit` refuses it
    frame.to_csv(tmp_path / "t.csv", index=False)
    assert command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "e.toml").code == 0
    assert "time" not in tomllib.loads((tmp_path / "e.toml").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["several tips", "camera on the tool"])
def test_tips_and_cameras_are_proposed(name: str, tmp_path: Path, init: Any) -> None:
    """The options that `init` writes read the table as those that wrote it."""
    kind = kind_named(name)
    table, options = kind.table()
    written, _ = init(table, kind.urdf)
    given: dict[str, list[str]] = {}
    for word, value in zip(options, [*options[1:], ""], strict=True):
        if word.startswith("--"):
            given.setdefault(word.removeprefix("--"), []).append(value)
    for option, values in given.items():
        expected = [True] if option == "camera-on-tool" else values
        assert written[option] == (expected if len(expected) > 1 or option == "position" else expected[0]), option
    assert written["tip"] == (list(kind.robot.tips) if name == "several tips" else kind.robot.tip)


def test_lenses_that_no_table_holds_are_to_be_filled_in(tmp_path: Path, command: Command, init: Any) -> None:
    """Angles follow from the images all the same; `fit` refuses the file until the lens is there."""
    kind = kind_named("images")
    table, _ = kind.table()
    written, _ = init(table, kind.urdf)
    assert (written["reading"], written["session"], written["angle"]) == ("image=u,v,FX,FY,CX,CY", "session", "deg")
    refused = command("fit", tmp_path / "c.toml")
    assert refused.code == 1
    assert "--reading image=u,v,FX,FY,CX,CY" in refused.err


def test_a_full_column_beside_positions_is_no_reading(tmp_path: Path, init: Any) -> None:
    """Rows of several kinds leave the cells of the other kinds empty."""
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "arm.urdf")
    frame = dc.Measurements(*arm.measure(40, seed=0), arm.nominal.joint_names).to_frame()
    frame["distance"] = 1.0
    frame["session"] = ["monday", "tuesday"] * 20
    frame.to_csv(tmp_path / "t.csv", index=False)
    written, _ = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    assert "reading" not in written
    assert written["session"] == "session"
    assert "not used: distance" in (tmp_path / "c.toml").read_text()


@pytest.mark.slow
def test_a_kind_from_outside_alone(tmp_path: Path, command: Command) -> None:
    """Beams need nothing beside them; readings of a frame need poses, and what refuses them says so."""
    said = {}
    for name in ("laser beams", "inclinations"):
        kind = kind_named(name)
        table = tmp_path / f"{name[:3]}.csv"
        rows = kind.source.golden.rows.parts[1].with_joint_names(kind.robot.joint_names)
        write_measurements(table, rows, TableFormat("mm", "deg"))
        said[name] = command("init", table, kind.urdf, "-o", tmp_path / "c.toml")
    assert said["laser beams"].code == 0
    assert "line distance=line distance" in tomllib.loads((tmp_path / "c.toml").read_text())["reading"]
    assert said["inclinations"].code == 1
    assert "measured poses" in said["inclinations"].err
