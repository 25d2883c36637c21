"""Tables of every kind, and of several: what is written is read back; lines that cannot be right are named."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from table_bank import CONVENTIONS, POSITION, held, random_poses, says, some
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.csv.files import (
    read_measurements,
    read_observations,
    write_measurements,
    write_predictions,
)
from diffeo_calib.measurements.csv.sensors import ReadingColumns, SocketColumns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.poses import rotation_matrices
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat

NAMES = ("a", "b")
SI, DEGREES = TableFormat("m", "rad"), TableFormat("mm", "deg", ";", ",")


def values(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator("cpu").manual_seed(seed))


def positions(std: float | None = None) -> dc.Measurements:
    return dc.Measurements(some(5, seed=1).q, values(5, 3), NAMES, std=std)


def resting() -> dc.Measurements:
    names, known = ["f/0", "f/1", "g/0", "g/1", "f/0"], {("0", "1"): 0.05}
    return dc.Measurements.from_sockets(some(5, seed=2).q, names, NAMES, distances=known, distance_std=3e-5)


def lengths(std: float | None = None, offset_std: float = 0.0, names: str = "AB") -> Readings:
    q, seen = some(5, seed=3).q, values(5).abs() + 1.0
    return Readings.distances(q, seen, [names[k] for k in (0, 0, 1, 1, 0)], NAMES, std=std, offset_std=offset_std)


def heights() -> Readings:
    return Readings.heights(some(4, seed=4).q, values(4), None, NAMES)


def images(std: float | None = 0.2) -> Readings:
    seen = 100.0 * values(5, 2)
    return Readings.images(some(5, seed=5).q, seen, ["c"] * 5, NAMES, focal=(800.0, 900.0), centre=(3.0, 4.0), std=std)


def poses() -> dc.Measurements:
    return dc.Measurements.from_poses(some(5, seed=6).q, random_poses(5), NAMES, position_std=1e-4, rotation_std=1e-3)


def on_tips() -> dc.Measurements:
    """With a hidden frame, and deviations of each."""
    frames, (std, turns) = random_poses(10).unflatten(0, (5, 2)), 1e-3 * values(2, 5, 2, 3).abs()
    frames[2, 1] = torch.nan
    return dc.Measurements.from_poses(
        some(5, seed=8).q, frames, NAMES, on=["l", "r"], position_std=std, rotation_std=turns
    )


def markers() -> dc.Measurements:
    points = values(5, 2, 3)
    points[2, 1] = torch.nan
    return dc.Measurements(some(5, seed=7).q, points, NAMES, ["m", "k"], on=["l", "r"], std=1e-3)


KINDS: dict[str, Any] = {
    "positions": positions,
    "positions with deviations": lambda: positions(1e-4),
    "sessions": lambda: positions().with_sessions(["mon", "tue", "mon", "tue", "tue"]),
    "payloads": lambda: positions().with_payload([0.0, 1.0, 2.0, 0.0, 0.5]),
    "hidden markers on tips": markers,
    "poses": poses,
    "poses on tips": on_tips,
    "poses in sessions": lambda: poses().with_sessions(list("xyxyx")).with_payload(1.0),
    "sockets": resting,
    "mixture": lambda: dc.Measurements.joined([positions(1e-4), resting()]),
    "mixture in sessions": lambda: dc.Measurements.joined([positions().with_sessions(list("uvuvu")), resting()]),
    "distances": lengths,
    "displacements": lambda: lengths(1e-5, 1.0).with_payload(2.0),
    "heights": heights,
    "images": images,
    "images on a tip": lambda: images(None).with_tips(["left"]),
    "poses and sockets": lambda: dc.Measurements.joined([poses(), resting()]),
    "all": lambda: Observations.joined(
        [positions(), lengths(), resting(), heights(), images(), lengths(1e-4, 0.1, "CD")]
    ),
    "all in sessions": lambda: Observations.joined([positions().with_sessions(list("uvuvu")), images(), resting()]),
    "laden": lambda: Observations.joined([poses(), heights()]).with_payload(torch.arange(9.0)),
}


def assert_same(found: Any, wanted: Any) -> None:
    """Everything but the lines and the file."""
    assert type(found) is type(wanted)
    assert found.joint_names == wanted.joint_names
    if isinstance(wanted, Observations):
        assert found.kinds == wanted.kinds
        assert found.device_names == wanted.device_names
    for own, other in zip(found.parts, wanted.parts, strict=True):
        if isinstance(other, Observations):
            continue
        assert own.device_names == other.device_names
        assert set(own.columns) == set(other.columns)
        for name, values in other.columns.items():
            if name not in ("session", "device", "socket", "line_numbers"):  # numbers of names, whose order may differ
                assert_close(own.columns[name], values, rtol=0.0, atol=1e-9, equal_nan=True)
        for name in ("on", "lever", "payload_at", "offset_std", "intrinsics"):
            assert getattr(own, name, None) == getattr(other, name, None), name
        if getattr(other, "sockets", None) is not None:
            assert own.sockets == other.sockets
            assert own.socket.tolist() == other.socket.tolist()


@pytest.mark.parametrize(
    ("kind", "table"),
    [
        *product(KINDS, (SI, DEGREES)),
        *(("poses on tips", replace(DEGREES, convention=own, rotation_angle="rad")) for own in CONVENTIONS[:5]),
    ],
)
def test_written_tables_are_read_back(kind: str, table: TableFormat, tmp_path: Path) -> None:
    data = KINDS[kind]()
    form = write_measurements(tmp_path / "t.csv", data, table)
    again = read_observations(tmp_path / "t.csv", form)
    assert_same(again, data)
    assert again.line_numbers.tolist() == list(range(2, 2 + len(data)))
    assert len(again.sha256) == 64
    shuffled = data.rows([3, 1, 0, 2])
    form = write_measurements(tmp_path / "s.csv", shuffled, table)
    assert_close(read_observations(tmp_path / "s.csv", form).q, data.q[[3, 1, 0, 2]])


def test_shuffled_rows_of_several_kinds_keep_their_order(tmp_path: Path) -> None:
    data = KINDS["all"]().rows([27, 3, 14, 0, 20, 8, 22, 9, 12, 13])
    form = write_measurements(tmp_path / "t.csv", data, DEGREES)
    found = read_observations(tmp_path / "t.csv", form)
    assert_close(found.q, data.q)
    assert sorted(found.kinds) == sorted(data.kinds)
    assert found.kinds == data.kinds


def test_set_ups_are_not_written_into_another_column(tmp_path: Path) -> None:
    data = KINDS["all"]()
    with pytest.raises(MeasurementError, match=says("distinct names", "socket")):
        write_measurements(tmp_path / "t.csv", data, SI, session="socket")


LINES = """a,b,x,y,z,d,u,v,spot,who,sd
0.1,0.2,1,2,3,,,,,,
0.2,0.3,,,,1.5,,,,A,0.1
0.3,0.4,1,2,4,1.7,,,,B,0.1
0.4,0.5,,,,,7,8,,C,
0.5,0.6,,,,,,,s0,,
"""
WIRE = ReadingColumns("distance", ("d",), "who", std=("sd",))
CAMERA = ReadingColumns("image", ("u", "v"), "who", intrinsics=(2.0, 2.0, 0.0, 0.0))
COLUMNS = replace(SI, joints=NAMES, position=list("xyz"), sockets=SocketColumns(("spot",)), readings=(WIRE, CAMERA))


def read(tmp_path: Path, text: str, table: TableFormat = COLUMNS, **options: Any) -> Any:
    (tmp_path / "t.csv").write_text(text)
    return read_observations(tmp_path / "t.csv", table, **options)


def test_a_line_with_two_kinds_is_two_rows(tmp_path: Path) -> None:
    data = read(tmp_path, LINES)
    assert data.kinds == ("position", "distance", "position", "distance", "image", "socket")
    assert data.line_numbers.tolist() == [2, 3, 4, 4, 5, 6]
    assert data.device_names == ["", "A", "", "B", "C", ""]
    assert held(data.parts[1].std).tolist() == [[0.1], [0.1]]
    both = LINES.replace("1,2,3,,,,,", "1,2,3,,,,s1,")
    assert read(tmp_path, both).kinds[:2] == ("position", "socket")


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (("0.3,0.4,1,2,4,1.7", "0.3,0.4,,,,"), "line 4: expected a position, a socket, a distance or an image"),
        (("7,8,,C", "7,,,C"), "line 5, column 'v': expected a finite number, got an empty cell"),
        (("1,2,3,", "1,,3,"), "line 2, column 'y'"),
        (("1.5,,,,A", "far,,,,A"), "line 3, column 'd': expected a number, got 'far'"),
        (("1.5,,,,A", "1.5,,,,"), "line 3, column 'who': expected the name of the device of this reading"),
        (("1.5,,,,A", "-1.5,,,,A"), "line 3, column 'd': expected a distance above 0, got '-1.5'"),
        (("A,0.1", "A,"), "line 3, column 'sd': expected a finite number, got an empty cell"),
        (("A,0.1", "A,-1"), "line 3, column 'sd': expected a positive standard deviation, got '-1'"),
        (("7,8,,C", ",,s0,"), "columns u, v: empty in all 5 lines: expected some line that holds an image"),
        (("0.5,0.6,,,,,,,s0,,", "0.5,0.6,,,,,,,s0,"), "line 6: expected 11 cells as in the header"),
        (("0.5,0.6,,,,,,,s0,,", "0.2,0.3,,,,1.5,,,,A,0.1\n0.7,0.6,,,,,,,s0,,"), "line 6 repeats 3"),
    ],
)
def test_bad_lines_are_named(edit: tuple[str, str], said: str, tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=says(said)):
        read(tmp_path, LINES.replace(*edit))


def test_bad_descriptions(tmp_path: Path) -> None:
    plane = ReadingColumns("height", 0.0)
    for columns, said in (
        (replace(SI, joints=NAMES), "`position` is missing"),
        (replace(COLUMNS, readings=(plane,)), "one height for all rows beside rows of other kinds"),
        (replace(COLUMNS, position=None, session="who"), "`session` beside `socket`"),
        (replace(SI, joints=NAMES, readings=(WIRE,), session="who"), "`session` beside `readings`"),
        (replace(COLUMNS, readings=(replace(WIRE, values=("rope",)),)), "no column ['rope']"),
    ):
        with pytest.raises(MeasurementError, match=says(said)):
            read(tmp_path, LINES, columns)
    with pytest.raises(MeasurementError, match=says("line 3, 5: expected a position or a socket, got neither")):
        read(tmp_path, LINES, replace(COLUMNS, readings=()))
    touched = replace(COLUMNS, readings=(replace(plane, device="spot"),), sockets=None)
    text = LINES.replace("0.2,0.3,,,,", "0.2,0.3,1,1,1,").replace("0.4,0.5,,,,", "0.4,0.5,1,1,2,")
    found = read(tmp_path, text, touched)
    assert found.kinds[-1] == "height"
    assert found.device_names[-1] == "s0"


def test_what_cannot_be_written(tmp_path: Path) -> None:
    both = Observations.joined([positions(), poses()])
    clash = Readings.heights(some(3).q, 0.0, joint_names=["height", "b"])
    wrong: tuple[tuple[Any, dict[str, Any], str], ...] = (
        (both, {}, "write them to two files"),
        (positions(), {"session": "who"}, "`session`: got a table without set-ups"),
        (heights(), {"position": list("xyz")}, "`position`: got a table without positions"),
        (clash, {}, "expected distinct columns: 'height'"),
        (lengths(), {"joints": ["a"]}, "joint columns: expected 2"),
    )
    for data, options, said in wrong:
        with pytest.raises(MeasurementError, match=says(*said.split(": "))):
            write_measurements(tmp_path / "t.csv", data, SI, **options)
    assert not (tmp_path / "t.csv").exists()


def test_readings_name_their_columns_and_units(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("a,b,d,u,v,who,kg\n10,20,400,7,8,A,0\n30,40,500,9,8,B,2\n")
    units: dict[str, Any] = {"length": "mm", "angle": "deg"}

    def read(*given: Any, own: dict[str, Any] = units, payload: str | None = None, **columns: Any) -> Any:
        return read_measurements(path, NAMES, readings=(dc.ReadingColumns(*given, **columns),), payload=payload, **own)

    near = read("distance", "d", "who", payload="kg", on="left", offset_std=0.1)
    assert_close(near.values[:, 0].tolist(), [0.4, 0.5])
    assert (near.device_names, near.on, near.offset_std) == (["A", "B"], "left", 0.1)
    assert held(near.payload).tolist() == [0.0, 2.0]
    seen = read("image", ["u", "v"], std="d", intrinsics=(2.0, 4.0, 0.0, 0.0))
    assert held(seen.reported_std).tolist() == [[400.0, 400.0], [500.0, 500.0]]
    assert read("height", 0.0).values.tolist() == [[0.0], [0.0]]
    with pytest.warns(dc.DiffeoCalibWarning, match=r"distances reach 500 m: they look like millimetres"):
        read("distance", "d", own={"length": "m", "angle": "deg"})
    wrong: tuple[tuple[Any, Any, dict[str, Any], str], ...] = (
        (("u",), "image", {"intrinsics": (1.0, 1.0, 0.0, 0.0)}, "2 names of columns for 'image'"),
        ("d", "pose", {}, "`kind`"),
        ("d", "height", {"intrinsics": (1.0, 1.0, 0.0, 0.0)}, "`intrinsics` of 'height'"),
        (("u", "v"), "image", {}, "`intrinsics` of 'image'"),
    )
    for names, kind, options, said in wrong:
        with pytest.raises(MeasurementError, match=says(said)):
            dc.ReadingColumns(kind, names, **options)


def test_a_socket_that_is_not_a_number_is_none(tmp_path: Path) -> None:
    """As a program writes a table of numbers and names."""
    (tmp_path / "t.csv").write_text("a,b,x,y,z,s\n0,1,1,2,3,nan\n1,2,nan,nan,nan,p\n2,2,NaN,NaN,NaN,p\n")
    known: dict[str, Any] = {"length": "m", "angle": "rad"}
    found = read_measurements(tmp_path / "t.csv", NAMES, list("xyz"), socket="s", **known)
    assert found.row_sockets == ["", "p", "p"]
    (tmp_path / "t.csv").write_text("a,b,s\n0,1,p\n1,2,nan\n2,2,p\n")
    with pytest.raises(MeasurementError, match=r"line 3, column 's'.*name"):
        read_measurements(tmp_path / "t.csv", NAMES, socket="s", **known)


def test_poses_beside_sockets_and_payloads(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,b,x,y,z,rx,ry,rz,s,kg\n0,1,1,2,3,0,0,1,,1\n1,2,,,,,,,p,2\n")
    turned: dict[str, Any] = {"rotation": ["rx", "ry", "rz"], "convention": "rotvec", "rotation_angle": "rad"}
    found = read_measurements(
        tmp_path / "t.csv", NAMES, list("xyz"), length="m", angle="rad", socket="s", payload="kg", **turned
    )
    assert isinstance(found, Observations)
    assert found.kinds == ("pose", "socket")
    assert held(found.payload).tolist() == [1.0, 2.0]


def test_kinds_share_a_column_of_deviations_in_one_unit_alone(tmp_path: Path) -> None:
    text = "a,b,d,h,sd,who\n0,1,5,,0.1,A\n1,2,,7,0.2,B\n"
    wire = ReadingColumns("distance", ("d",), "who", std=("sd",))
    plane = replace(wire, kind="height", values=("h",))
    data = read(tmp_path, text, replace(SI, joints=NAMES, readings=(wire, plane)))
    assert [held(part.std).tolist() for part in data.parts] == [[[0.1]], [[0.2]]]
    angle = replace(plane, kind="angle", unit=("mrad", 1e3))
    with pytest.raises(MeasurementError, match=says("distinct columns", "'sd'")):
        read(tmp_path, text, replace(SI, joints=NAMES, readings=(wire, angle)))


MARKER_HEADER = "a,b,ball,x,y,z"
MARKER_LINES = (
    "0.1,0.2,top,1,2,3",
    "0.1,0.2,left,4,5,6",
    "0.3,0.4,left,7,8,9",
    "0.3,0.4,low,1,1,2",
    "0.3,0.4,top,3,3,4",
    "0.5,0.6,low,5,5,6",
)


def read_markers(
    folder: Path, lines: Sequence[str] = MARKER_LINES, header: str = MARKER_HEADER, **how: Any
) -> dc.Measurements:
    path = folder / "t.csv"
    path.write_text("\n".join((header, *lines)) + "\n")
    given = {"position": ["x", "y", "z"], "marker": "ball", "length": "m", "angle": "rad", "duplicates": "keep"}
    return dc.read_measurements(path, ["a", "b"], **(given | how))


def test_lines_of_one_pose_are_one_row(tmp_path: Path) -> None:
    data = read_markers(tmp_path)
    assert data.marker_names == ("top", "left", "low"), "in the order in which they appear"
    assert data.line_numbers.tolist() == [2, 4, 7], "the first line of each row"
    assert data.visible.tolist() == [[True, True, False], [True, True, True], [False, False, True]]
    assert data.points[1].tolist() == [[3, 3, 4], [7, 8, 9], [1, 1, 2]]
    assert_close(data.q[:, 0], torch.tensor([0.1, 0.3, 0.5], dtype=torch.float64), rtol=0, atol=0)


def test_a_marker_seen_again_is_another_row(tmp_path: Path) -> None:
    """Repeats of a pose are rows, as are lines of it that do not follow each other."""
    assert len(read_markers(tmp_path, [*MARKER_LINES[:2], *MARKER_LINES[:2]])) == 2
    assert len(read_markers(tmp_path, [MARKER_LINES[0], MARKER_LINES[2], MARKER_LINES[1], MARKER_LINES[3]])) == 4
    lines = [f"{line},{mass}" for line, mass in zip(MARKER_LINES[:2], "12", strict=True)]
    assert len(read_markers(tmp_path, lines, f"{MARKER_HEADER},kg", payload="kg")) == 2
    assert len(read_markers(tmp_path, lines, f"{MARKER_HEADER},day", session="day")) == 2


def test_later_tables_keep_the_order_of_the_markers(tmp_path: Path) -> None:
    whole = read_markers(tmp_path)
    assert isinstance(whole.origin, TableOrigin)
    assert whole.origin.columns.table.marker == "ball=top,left,low"
    assert "--marker ball=top,left,low" in whole.origin.options
    some = read_markers(tmp_path, MARKER_LINES[3:], marker=whole.origin.columns.table.marker)
    assert some.marker_names == whole.marker_names
    assert some.visible.tolist() == [[True, False, True], [False, False, True]]
    assert_close(some.points[0], torch.where(some.visible[0, :, None], whole.points[1], torch.nan), equal_nan=True)


def test_deviations_belong_to_the_marker_of_their_line(tmp_path: Path) -> None:
    lines = [f"{line},{k + 1}" for k, line in enumerate(MARKER_LINES)]
    data = read_markers(tmp_path, lines, f"{MARKER_HEADER},s", std=["s"])
    assert data.std is not None
    assert data.std[:, :, 0].nan_to_num(0.0).tolist() == [[1, 2, 0], [5, 3, 4], [0, 0, 6]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"marker": "ball=top,left"}, r"column 'ball': expected markers of the model: top, left, got low"),
        ({"marker": "smr"}, r"no column \['smr'\]"),
        ({"lines": ["0.1,0.2,,1,2,3"]}, r"line 2, column 'ball': expected the name of a marker, got an empty cell"),
        ({"position": [["x", "y", "z"], ["u", "v", "w"]]}, r"`marker` \(ball\): expected one position"),
        ({"rotation": ["u", "v", "w"], "convention": "xyz", "rotation_angle": "deg"}, r"`marker` \(ball\)"),
        ({"socket": "place"}, r"`marker` \(ball\)"),
    ],
)
def test_what_is_no_marker_is_one_error(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=message):
        read_markers(tmp_path, **change)


# --- written columns ---


def test_written_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_measurements(path, Measurements([[0.5]], [[1, 2, 3]]), TableFormat("mm", "rad", ";", ","))
    assert path.read_text().splitlines() == ["q1;x;y;z", "0,5;1000,0;2000,0;3000,0"]
    write_measurements(path, Measurements([[0.5]], [[[1, 2, 3]] * 2]), SI)
    assert path.read_text().splitlines()[0] == "q1,marker1_x,marker1_y,marker1_z,marker2_x,marker2_y,marker2_z"
    write_measurements(path, some(2), TableFormat("m", "deg"), joints=["a", "b"], position=["u", "v", "w"])
    assert path.read_text().splitlines()[0] == "a,b,u,v,w"


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says("none", "cannot be written", "No such file or directory", "folder")):
        write_measurements(tmp_path / "none" / "table.csv", some(2), SI)


# --- poses ----------------------------------------------------------------------------------------


WRITTEN_ROTATIONS = {
    "rotvec": ["rx", "ry", "rz"],
    "quat_xyzw": ["qx", "qy", "qz", "qw"],
    "quat_wxyz": ["qw", "qx", "qy", "qz"],
    "matrix": ["r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"],
    "ZYX": ["euler1", "euler2", "euler3"],
}


@pytest.mark.parametrize("convention", WRITTEN_ROTATIONS)
def test_written_columns_of_poses(convention: str, tmp_path: Path) -> None:
    path, pose = tmp_path / "table.csv", torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices([[0, 0, 90]], "rotvec", angle="deg")[0]
    data = Measurements.from_poses([[0.5]], pose[None], rotation_std=0.5)
    write_measurements(path, data, TableFormat("mm", "deg", convention=convention))
    header, row = (line.split(",") for line in path.read_text().splitlines())
    assert header == ["q1", "x", "y", "z", *WRITTEN_ROTATIONS[convention], "std_rx", "std_ry", "std_rz"]
    assert float(row[-1]) == pytest.approx(math.degrees(0.5))
    if convention == "rotvec":
        assert [float(cell) for cell in row[4:7]] == pytest.approx([0, 0, 90])
        write_measurements(path, data, TableFormat("mm", "deg", rotation_angle="rad"))  # the default convention
        assert [float(cell) for cell in path.read_text().splitlines()[1].split(",")[4:7]] == pytest.approx(
            [0, 0, math.pi / 2]
        )


def test_own_names_of_written_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    pose = torch.eye(4, dtype=torch.float64)[None]
    data = Measurements.from_poses([[0.5]], pose, position_std=1e-3, rotation_std=1.0)
    names: dict[str, Any] = {"position": "xyz", "rotation": "abc", "std": "uvw", "rotation_std": "klm"}
    options: dict[str, Any] = {name: list(letters) for name, letters in names.items()}
    write_measurements(path, data, SI, joints=["j"], **options)
    assert path.read_text().splitlines() == [
        "j,x,y,z,a,b,c,u,v,w,k,l,m",
        "0.5" + ",0.0" * 6 + ",0.001" * 3 + ",1.0" * 3,
    ]


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (False, {"convention": "rotvec"}, ("`convention` without `rotation`", "leave this out")),
        (False, {"std": ["a", "b", "c"]}, ("['a', 'b', 'c']", "without these values")),
        (True, {"rotation_std": ["a", "b", "c"]}, ("['a', 'b', 'c']", "without these values")),
        (True, {"convention": "euler"}, ("`convention`", "got 'euler'")),
        (True, {"rotation_angle": "turns"}, ("`rotation_angle`", "'rad' or 'deg'")),
        (True, {"rotation": ["a", "b"]}, ("`rotation`", "3 names")),
        (True, {"std": ["s"]}, ("standard deviations", "expected 3", "got 1")),
        (True, {"position": [POSITION, ["u", "v", "w"]]}, ("position triples", "expected 1", "got 2")),
    ],
)
def test_wrong_option_of_written_poses_is_one_clear_error(
    poses: bool, options: dict[str, Any], message: tuple[str, ...], tmp_path: Path
) -> None:
    frames = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    data = Measurements.from_poses([[0.0], [1.0]], frames, position_std=1.0) if poses else some(2)
    with pytest.raises(MeasurementError, match=says(*message)):
        write_measurements(tmp_path / "table.csv", data, SI, **options)
    assert not (tmp_path / "table.csv").exists()


def test_predicted_poses_are_written(tmp_path: Path) -> None:
    path, pose = tmp_path / "p.csv", torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, :3] = rotation_matrices([[0, 90, 0]], "rotvec", angle="deg")[0]
    pose[0, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    q, std = torch.tensor([[0.5]], dtype=torch.float64), torch.full((1, 6), 1e-3, dtype=torch.float64)
    std[:, 3:] = math.radians(0.25)
    write_predictions(path, [(q, pose, std)], TableFormat("mm", "deg"), joints=["j"], poses=True)
    header, row = path.read_text().splitlines()
    assert header == "j,x,y,z,std_x,std_y,std_z,rx,ry,rz,std_rx,std_ry,std_rz"
    expected = [math.degrees(0.5), 1000, 2000, 3000, 1, 1, 1, 0, 90, 0, 0.25, 0.25, 0.25]
    assert [float(cell) for cell in row.split(",")] == pytest.approx(expected, abs=1e-12)
    write_predictions(
        path, [(q, pose, std)], TableFormat("mm", "deg", convention="quat_wxyz"), joints=["j"], poses=True
    )
    assert path.read_text().splitlines()[0] == "j,x,y,z,std_x,std_y,std_z,qw,qx,qy,qz,std_rx,std_ry,std_rz"
    wrong = TableFormat("mm", "deg", convention="euler")
    with pytest.raises(MeasurementError, match=says("`convention`", "got 'euler'")):
        write_predictions(path, [(q, pose, std)], wrong, joints=["j"], poses=True)


def test_predicted_markers_are_written(tmp_path: Path) -> None:
    path, q = tmp_path / "p.csv", torch.tensor([[0.5, 0.25]], dtype=torch.float64)
    points, std = torch.tensor([[[1.0, 2, 3], [4, 5, 6]]]).double(), torch.full((1, 2, 3), 1e-3, dtype=torch.float64)
    table = TableFormat("mm", "deg", ";", ",")
    kinds, prefixes = ["revolute", "prismatic"], ["left_", "ball_"]
    write_predictions(path, [(q, points, std)], table, joints=["a", "b"], kinds=kinds, prefixes=prefixes)
    header, row = path.read_text().splitlines()
    markers = [f"{prefix}{kind}{axis}" for prefix in prefixes for kind in ("", "std_") for axis in "xyz"]
    assert header.split(";") == ["a", "b", *markers]
    expected = [math.degrees(0.5), 250, 1000, 2000, 3000, 1, 1, 1, 4000, 5000, 6000, 1, 1, 1]
    assert [float(cell.replace(",", ".")) for cell in row.split(";")] == pytest.approx(expected, rel=1e-12)
    write_predictions(path, [(q, points[:, :1], std[:, :1])], table, joints=["a", "b"])
    assert path.read_text().splitlines()[0] == "a;b;x;y;z;std_x;std_y;std_z"
