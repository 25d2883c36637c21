"""`init`: sockets, rotations, deviations, wires, payloads and cameras of a table."""

from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import Command
from init_bank import ARM, ROWS, XYZ, Proposed, write_socket_table, write_wire_table
from kind_bank import kind_named
from product_bank import simulated_poses

import diffeo_calib as dc
from diffeo_calib.cli.guesses import guess_sheet, rows_in
from diffeo_calib.cli.main import expanded
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots.simulated_arm import SimulatedArm


def test_sockets_are_proposed(tmp_path: Path, proposed: Proposed, init: Proposed) -> None:
    """Angles in degrees, known by the ball; distances are for the user to fill in. Beside positions in their unit."""
    arm, table = SimulatedArm(seed=1), tmp_path / "t.csv"
    arm.write_urdf(tmp_path / "arm.urdf")
    write_socket_table(table, arm, "ab", 1)
    written, text = init(table, tmp_path / "arm.urdf")
    assert (written["socket"], written["angle"], written["length"]) == ("place,socket", "deg", "mm")
    assert not {"position", "distance", "distance-std"} & set(written)
    assert "# all columns are used" in text
    (tmp_path / "cell.toml").write_text(text.replace("# distance", "distance"))
    words = expanded(["fit", str(tmp_path / "cell.toml")])
    assert [words[words.index(name) + 1] for name in ("--socket", "--distance")] == ["place,socket", "a,b=50"]
    header, *lines = table.read_text().split("\n")
    holes = [line.replace(",", "", 1) for line in lines]
    table.write_text("\n".join([header.replace("place,socket", "hole"), *holes]))
    assert init(table, tmp_path / "arm.urdf")[0]["socket"] == "hole"
    table.write_text("q1,u1,v1,u2,v2,u3,v3,u4,v4\n" + "1,2,3,4,5,6,7,8,9\n" * 3)
    with pytest.raises(InputError, match="a line for each, with image, board_x"):
        rows_in(guess_sheet(table), ["q1"])
    q, points = arm.measure(20, seed=2)
    both = torch.cat([q.rad2deg(), points[:, 0]], 1).tolist()
    seen = [",".join(["", "", *map(repr, row)]) for row in both]
    table.write_text("\n".join([f"{header},x,y,z", *seen, *(f"{line},,," for line in lines)]))
    written, text = init(table, tmp_path / "arm.urdf")
    assert (written["position"], written["socket"]) == (["x,y,z"], "place,socket")
    assert (written["angle"], written["length"]) == ("deg", "m")
    assert '# distance = "a,b=0.05"' in text
    assert "# distance-std = 3e-05" in text


def test_sockets_of_a_panda(ur10_folder: Path, init: Proposed) -> None:
    """Read as degrees all angles are near zero, and the ball hardly leaves its place: 4.9 mm beside the right 2.6."""
    data = ur10_folder.parent / "mukca"
    assert init(data / "panda_3.csv", data / "panda.urdf")[0]["angle"] == "rad"


def test_rotations_that_no_convention_explains_are_named_and_not_used(tmp_path: Path, init: Proposed) -> None:
    arm, data, _ = simulated_poses(ROWS)
    arm.write_urdf(tmp_path / "arm.urdf")
    turned = data.rows([*range(1, ROWS), 0])
    mixed = dc.Measurements(data.q, data.points[:, 0], data.joint_names).to_frame()
    mixed[["rx", "ry", "rz"]] = turned.to_frame()[["rx", "ry", "rz"]].to_numpy()
    mixed.to_csv(tmp_path / "t.csv", index=False)
    written, text = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    assert "rotation" not in written
    assert "# rx, ry, rz: rotations of no convention that is clearly better than others; not used" in text


def test_deviations_are_proposed_if_they_can_be_some(tmp_path: Path, frame: Any, init: Proposed) -> None:
    for std, proposed in ((2e-5, True), (0.0, False), (0.5, False)):
        frame[["std_x", "std_y", "std_z"]] = std
        frame.to_csv(tmp_path / "t.csv", index=False)
        _, text = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
        assert ('std = "std_x,std_y,std_z"' in text) is proposed
        assert ("# std_x, std_y, std_z: no standard deviations" in text) is not proposed


def test_an_edited_file_is_kept(tmp_path: Path, command: Command, frame: Any) -> None:
    frame.rename(columns={axis: f"t{axis}" for axis in XYZ}).to_csv(tmp_path / "t.csv", index=False)
    out = tmp_path / "c.toml"
    words = "init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", out
    command.ran(*words)
    assert 'position = ["tx,ty,tz"]' in out.read_text()
    assert command(*words).code == 0  # the same again
    edited = out.read_text() + "holdout = 0\n"
    out.write_text(edited)
    assert "exists and holds other options" in command(*words).error
    assert out.read_text() == edited
    command.ran(*words, "--force")
    assert "holdout" not in out.read_text()


@pytest.mark.slow
def test_a_wire_its_anchors_and_a_payload(tmp_path: Path, frame: Any, init: Proposed) -> None:
    write_wire_table(tmp_path / "wire.csv", ARM, seed=1)
    written, _ = init(tmp_path / "wire.csv", tmp_path / "arm.urdf")
    expected = {"reading": "displacement=wire", "session": "anchor", "length": "mm", "angle": "deg"}
    assert {name: written[name] for name in expected} == expected
    frame["payload_kg"], frame["time_s"], frame["Temperature"] = [0.0, 2.0] * 20, range(ROWS), [21.5] * ROWS
    frame["distance"] = 1.0  # in every row: rows of several kinds leave the cells of the other kinds empty
    frame.to_csv(tmp_path / "t.csv", index=False)
    written, _ = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    expected = {"payload": "payload_kg", "time": "time_s", "temperature": "Temperature"}
    assert {name: written.get(name) for name in (*expected, "reading")} == {**expected, "reading": None}
    frame["time_s"] += 20_210_313_000_000  # a date: `fit` refuses it
    frame.to_csv(tmp_path / "t.csv", index=False)
    assert "time" not in init(tmp_path / "t.csv", tmp_path / "arm.urdf")[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["several tips", "camera on the tool"])
def test_tips_and_cameras_are_proposed(name: str, init: Proposed) -> None:
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


def test_lenses_that_no_table_holds_are_to_be_filled_in(tmp_path: Path, command: Command, init: Proposed) -> None:
    """Angles follow from the images all the same; `fit` refuses the file until the lens is there."""
    kind = kind_named("images")
    table, _ = kind.table()
    written, _ = init(table, kind.urdf)
    assert (written["reading"], written["session"], written["angle"]) == ("image=u,v,FX,FY,CX,CY", "session", "deg")
    assert "--reading image=u,v,FX,FY,CX,CY" in command.failed("fit", tmp_path / "c.toml")
