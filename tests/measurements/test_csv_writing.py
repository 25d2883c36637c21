"""Tables of every kind, and of several: what is written is read back, and columns have the names that are said."""

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from numbers_bank import normal as values
from product_bank import erring, sliding_robot
from table_bank import POSITION, held, in_order, random_poses, read_table, some
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.options import Units
from diffeo_calib.cli.tables import MeasuredTable, of_robot, table_format
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.files import read_joints, read_observations, write_measurements, write_predictions
from diffeo_calib.measurements.csv.sensors import ReadingColumns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.poses import rotation_matrices
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat

NAMES = ("a", "b")
SI, DEGREES = TableFormat("m", "rad"), TableFormat("mm", "deg", ";", ",")


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
    frames, (std, turns) = random_poses(10).unflatten(0, (5, 2)), 1e-3 * values(2, 5, 2, 3).abs()
    frames[2, 1] = torch.nan
    known: dict[str, Any] = {"on": ["l", "r"], "position_std": std, "rotation_std": turns}
    return dc.Measurements.from_poses(some(5, seed=8).q, frames, NAMES, **known)


def boards() -> dc.Measurements:
    known: dict[str, Any] = {"position_std": 2e-4, "rotation_std": 1e-3, "camera_on_tool": True}
    return dc.Measurements.from_poses(some(5, seed=9).q, random_poses(5, seed=2), NAMES, **known)


def markers() -> dc.Measurements:
    points = values(5, 2, 3)
    points[2, 1] = torch.nan
    return dc.Measurements(some(5, seed=7).q, points, NAMES, ["m", "k"], on=["l", "r"], std=1e-3)


FURTHER = lengths(1e-4, 0.1, "CD")
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
    "all": lambda: Observations.joined([positions(), lengths(), resting(), heights(), images(), FURTHER]),
    "all in sessions": lambda: Observations.joined([positions().with_sessions(list("uvuvu")), images(), resting()]),
    "boards": boards,
    "laden": lambda: Observations.joined([poses(), heights()]).with_payload(torch.arange(9.0)),
}


def assert_same(found: Any, wanted: Any) -> None:
    assert type(found) is type(wanted)
    assert found.joint_names == wanted.joint_names
    assert found.device_names == wanted.device_names
    assert_close(found.q, wanted.q)
    assert [part.kind for part in found.parts] == [part.kind for part in wanted.parts]
    for own, other in zip(found.parts, wanted.parts, strict=True):
        assert own.device_names == other.device_names
        assert set(own.columns) == set(other.columns)
        for name, column in other.columns.items():
            if name not in ("session", "device", "socket", "line_numbers"):  # numbers of names, whose order may differ
                assert_close(own.columns[name], column, rtol=0.0, atol=1e-9, equal_nan=True)
        for name in ("on", "lever", "payload_at", "offset_std", "intrinsics"):
            assert getattr(own, name, None) == getattr(other, name, None), name
        if getattr(other, "sockets", None) is not None:
            known = [[each.distance_std, *(d for *_, d in each.lengths)] for each in (own, other)]
            assert known[0] == pytest.approx(known[1])


@pytest.mark.parametrize(
    ("kind", "table"),
    [
        *product([kind for kind in KINDS if kind != "boards"], (SI, DEGREES)),
        *(("poses on tips", replace(DEGREES, convention=own, rotation_angle="rad")) for own in ("matrix", "ZYX")),
        *(("poses", replace(SI, convention=own)) for own in ("quat_xyzw", "quat_wxyz")),
        ("boards", replace(DEGREES, camera_on_tool=True)),
        *(("positions", replace(DEGREES, spherical=own)) for own in ("elevation_rad", "zenith_clockwise_gon")),
    ],
)
def test_written_tables_are_read_back(kind: str, table: TableFormat, tmp_path: Path) -> None:
    data, path = KINDS[kind](), tmp_path / "t.csv"
    again = read_observations(path, write_measurements(path, data, table))
    assert_same(again, data)
    assert again.line_numbers.tolist() == list(range(2, 2 + len(data)))
    assert len(again.sha256) == 64
    assert again.rows([0]).sha256 == again.sha256, "of the file"
    shuffled = data.rows(torch.randperm(len(data), generator=torch.Generator("cpu").manual_seed(0)))
    assert_same(read_observations(path, write_measurements(path, shuffled, table)), shuffled)


@pytest.mark.parametrize("units", [("mm", "m"), ("m", "mm")])
def test_slides_keep_their_unit(units: tuple[str, str], tmp_path: Path) -> None:
    robot, path = sliding_robot(), tmp_path / "t.csv"
    data = erring(robot, 3)
    table = table_format(Units(length=units[0], angle="deg", joint_length=units[1]))
    write_measurements(path, data, table, joints=robot)
    again = read_table(path, robot, POSITION, table)
    assert_close((again.q, again.points), (data.q, data.points), rtol=1e-14, atol=1e-15)
    write_predictions(path, [(data.q, data.points, 1e-3 * data.points)], table, joints=robot)
    assert_close(read_joints(path, of_robot(table, robot)), data.q, rtol=1e-14, atol=1e-15)
    first = next(csv.DictReader(path.read_text().splitlines()))
    scale = {"m": 1.0, "mm": 1e3}
    assert float(first["slide"]) == pytest.approx(scale[units[1]] * float(data.q[0, 2]))
    assert float(first["x"]) == pytest.approx(scale[units[0]] * float(data.points[0, 0, 0]))
    measured = MeasuredTable(path, replace(table, position=[POSITION])).read(robot)
    assert_close(measured.q, data.q, rtol=1e-14, atol=1e-15)


TURN = torch.eye(4, dtype=torch.float64)
TURN[:3, :3] = rotation_matrices([[0, 0, 90]], "rotvec", angle="deg")[0]
TURNED = Measurements.from_poses([[0.5]], TURN[None], position_std=1e-3, rotation_std=0.5)
NO_STD = Measurements.from_poses([[0.5]], TURN[None])
SEEN = Measurements.from_poses([[0.5]], TURN[None], camera_on_tool=True)
OWN = {"position": "xyz", "rotation": "abc", "std": "uvw", "rotation_std": "klm"}
ROTATIONS = {
    "rotvec": "rx,ry,rz",
    "quat_xyzw": "qx,qy,qz,qw",
    "quat_wxyz": "qw,qx,qy,qz",
    "matrix": "r11,r12,r13,r21,r22,r23,r31,r32,r33",
    "ZYX": "euler1,euler2,euler3",
}
NINETY = [0.0, 0.0, 0.0, 0.0, 0.0, 90.0]
WRITTEN: list[tuple[Any, TableFormat, str, list[float]]] = [
    (Measurements([[0.5]], [[[1, 2, 3]] * 2]), SI, f"q1,{','.join(f'marker{k}_{a}' for k in '12' for a in 'xyz')}", []),
    (some(2), replace(SI, joints=["a", "b"], position=["u", "v", "w"]), "a,b,u,v,w", []),
    (Measurements([[0.5]], [[1, 2, 3]]), TableFormat("mm", "rad", ";", ","), "q1;x;y;z", [0.5, 1e3, 2e3, 3e3]),
    (NO_STD, TableFormat("mm", "deg", convention="rotvec"), "q1,x,y,z,rx,ry,rz", [math.degrees(0.5), *NINETY]),
    (NO_STD, TableFormat("mm", "rad", rotation_angle="deg"), "q1,x,y,z,rx,ry,rz", [0.5, *NINETY]),
    *((NO_STD, replace(SI, convention=own), f"q1,x,y,z,{names}", []) for own, names in ROTATIONS.items()),
    (SEEN, replace(SI, camera_on_tool=True), "q1,x,y,z,rx,ry,rz", [0.5, *NINETY[:5], math.pi / 2]),
    (TURNED, SI, "q1,x,y,z,rx,ry,rz,std_x,std_y,std_z,std_rx,std_ry,std_rz", []),
    (
        TURNED,
        replace(SI, joints=["j"], **{name: list(letters) for name, letters in OWN.items()}),
        "j,x,y,z,a,b,c,u,v,w,k,l,m",
        [0.5, *NINETY[:5], math.pi / 2, 1e-3, 1e-3, 1e-3, 0.5, 0.5, 0.5],
    ),
]


@pytest.mark.parametrize(("data", "table", "header", "numbers"), WRITTEN)
def test_written_columns(data: Any, table: TableFormat, header: str, numbers: list[float], tmp_path: Path) -> None:
    write_measurements(tmp_path / "t.csv", data, table)
    first, row, *_ = (tmp_path / "t.csv").read_text().splitlines()
    assert first == header
    if numbers:
        assert [float(cell.replace(table.decimal, ".")) for cell in row.split(table.sep)] == pytest.approx(numbers)


TWO_KINDS = Observations.joined([positions(), poses()])
CLASH = Readings.heights(some(3).q, 0.0, joint_names=["height", "b"])
LETTERS = ["a", "b", "c"]


@pytest.mark.parametrize(
    ("data", "how", "message"),
    [
        (TWO_KINDS, {}, "write them to two files"),
        (KINDS["all"](), {"session": "socket"}, "distinct names ... socket"),
        (positions(), {"session": "who"}, "`session`: got a table without set-ups"),
        (heights(), {"position": list("xyz")}, "`position`: got a table without positions"),
        (CLASH, {}, "expected distinct columns ... 'height'"),
        (lengths(), {"joints": ["a"]}, "joint columns: expected 2"),
        (some(2), {"convention": "rotvec"}, "`convention` without `rotation` ... leave this out"),
        (some(2), {"std": LETTERS}, "['a', 'b', 'c'] ... without these values"),
        (TURNED, {"convention": "euler"}, "`convention` ... got 'euler'"),
        (TURNED, {"rotation_angle": "turns"}, "`rotation_angle`: expected 'rad' or 'deg'"),
        (TURNED, {"std": ["s"]}, "standard deviations: expected 3, got 1"),
        (TURNED, {"position": [POSITION, ["u", "v", "w"]]}, "position triples: expected 1, got 2"),
        (TURNED, {"camera_on_tool": True, "rotation": LETTERS}, "`camera_on_tool`: expected False, got True"),
        (SEEN, {}, "`camera_on_tool`: expected True, got False"),
    ],
)
def test_what_cannot_be_written(data: Any, how: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=in_order(message)):
        write_measurements(tmp_path / "t.csv", data, SI, **how)
    assert not (tmp_path / "t.csv").exists()


def predictions(path: Path, mean: Tensor, std: Tensor, table: TableFormat, **how: Any) -> tuple[list[str], list[float]]:
    q = torch.tensor([[0.5, 0.25]], dtype=torch.float64)
    write_predictions(path, [(q, mean, std)], table, joints=NAMES, **how)
    header, row = path.read_text().splitlines()
    return header.split(table.sep), [float(cell.replace(",", ".")) for cell in row.split(table.sep)]


def test_predictions_are_written(tmp_path: Path) -> None:
    path, std = tmp_path / "p.csv", torch.full((1, 6), 1e-3, dtype=torch.float64)
    std[:, 3:] = math.radians(0.25)
    pose = TURN[None].clone()
    pose[0, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    q, table = [math.degrees(0.5), math.degrees(0.25)], TableFormat("mm", "deg")
    header, row = predictions(path, pose, std, table, poses=True)
    assert ",".join(header) == "a,b,x,y,z,std_x,std_y,std_z,rx,ry,rz,std_rx,std_ry,std_rz"
    assert row == pytest.approx([*q, 1000, 2000, 3000, 1, 1, 1, 0, 0, 90, 0.25, 0.25, 0.25], abs=1e-12)
    header, _ = predictions(path, pose, std, replace(table, convention="quat_wxyz"), poses=True)
    assert header[8:12] == ["qw", "qx", "qy", "qz"]
    points, std = torch.tensor([[[1.0, 2, 3], [4, 5, 6]]]).double(), torch.full((1, 2, 3), 1e-3, dtype=torch.float64)
    how: dict[str, Any] = {"kinds": ["revolute", "prismatic"], "prefixes": ["left_", "ball_"]}
    header, row = predictions(path, points, std, DEGREES, **how)
    named = [f"{own}{what}{axis}" for own in how["prefixes"] for what in ("", "std_") for axis in "xyz"]
    assert header == ["a", "b", *named]
    assert row == pytest.approx([q[0], 250, 1000, 2000, 3000, 1, 1, 1, 4000, 5000, 6000, 1, 1, 1], rel=1e-12)
    assert predictions(path, points[:, :1], std[:, :1], DEGREES)[0][2:] == ["x", "y", "z", "std_x", "std_y", "std_z"]


def test_lines_of_two_kinds_and_of_none(tmp_path: Path) -> None:
    rows = "0,1,1,2,3,,,,\n1,2,,,,1.5,,A,0.1\n2,3,1,2,4,1.7,,B,0.1\n3,4,1,1,1,,s0,,\n"
    (tmp_path / "t.csv").write_text("a,b,x,y,z,d,spot,who,sd\n" + rows)
    wire = ReadingColumns("distance", ("d",), "who", std=("sd",))
    sockets = {"socket": "spot", "position": POSITION}
    data = dc.read_measurements(tmp_path / "t.csv", NAMES, length="m", angle="rad", readings=(wire,), **sockets)
    assert data.kinds == ("position", "distance", "position", "distance", "position", "socket")
    assert data.line_numbers.tolist() == [2, 3, 4, 4, 5, 5]
    assert data.device_names == ["", "A", "", "B", "", "s0"]
    assert held(data.parts[1].std).tolist() == [[0.1], [0.1]]
    (tmp_path / "t.csv").write_text("a,b,x,y,z,s\n0,1,1,2,3,nan\n1,2,nan,nan,nan,p\n2,2,NaN,NaN,NaN,p\n")
    known: dict[str, Any] = {"length": "m", "angle": "rad", "socket": "s"}
    assert dc.read_measurements(tmp_path / "t.csv", NAMES, POSITION, **known).device_names == ["", "p", "p"]
    (tmp_path / "t.csv").write_text("a,b,s\n0,1,p\n1,2,nan\n2,2,p\n")
    with pytest.raises(MeasurementError, match=r"line 3, column 's'.*name"):
        dc.read_measurements(tmp_path / "t.csv", NAMES, **known)


def test_readings_name_their_columns_and_units(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("a,b,d,u,v,who,kg\n10,20,400,7,8,A,0\n30,40,500,9,8,B,2\n")

    def read(*given: Any, length: str = "mm", payload: str | None = None, **columns: Any) -> Any:
        own = (dc.ReadingColumns(*given, **columns),)
        return dc.read_measurements(path, NAMES, readings=own, payload=payload, length=length, angle="deg")

    near = read("distance", "d", "who", payload="kg", on="left", offset_std=0.1)
    assert_close(near.values[:, 0].tolist(), [0.4, 0.5])
    assert (near.device_names, near.on, near.offset_std) == (["A", "B"], "left", 0.1)
    assert held(near.payload).tolist() == [0.0, 2.0]
    seen = read("image", ["u", "v"], std="d", intrinsics=(2.0, 4.0, 0.0, 0.0))
    assert held(seen.reported_std).tolist() == [[400.0, 400.0], [500.0, 500.0]]
    assert read("height", 2.0).values.tolist() == [[2e-3], [2e-3]]
    with pytest.warns(dc.DiffeoCalibWarning, match=r"distances reach 500 m: they look like millimetres"):
        read("distance", "d", length="m")


BALLS = ".1,.2,top,1,2,3,1 .1,.2,left,4,5,6,2 .3,.4,left,7,8,9,3 .3,.4,low,1,1,2,4 .3,.4,top,3,3,4,5 .5,.6,low,5,5,6,6"
BALLS = BALLS.split()


def read_markers(folder: Path, lines: Sequence[str] = BALLS, **how: Any) -> dc.Measurements:
    path = folder / "t.csv"
    path.write_text("\n".join(("a,b,ball,x,y,z,s", *lines)) + "\n")
    given = {"position": POSITION, "marker": "ball", "length": "m", "angle": "rad", "duplicates": "keep"}
    return dc.read_measurements(path, ["a", "b"], **(given | how))


def test_lines_of_one_pose_are_one_row(tmp_path: Path) -> None:
    """But not repeats, or lines that do not follow each other; later tables keep the order of the markers."""
    data = read_markers(tmp_path, std=["s"])
    assert data.marker_names == ("top", "left", "low"), "in the order in which they appear"
    assert data.line_numbers.tolist() == [2, 4, 7], "the first line of each row"
    assert data.visible.tolist() == [[True, True, False], [True, True, True], [False, False, True]]
    assert data.points[1].tolist() == [[3, 3, 4], [7, 8, 9], [1, 1, 2]]
    assert held(data.std)[:, :, 0].nan_to_num(0.0).tolist() == [[1, 2, 0], [5, 3, 4], [0, 0, 6]]
    assert data.q[:, 0].tolist() == [0.1, 0.3, 0.5]
    assert len(read_markers(tmp_path, [*BALLS[:2], *BALLS[:2]])) == 2
    assert len(read_markers(tmp_path, [BALLS[0], BALLS[2], BALLS[1], BALLS[3]])) == 4
    assert len(read_markers(tmp_path, BALLS[:2], payload="s")) == 2
    assert len(read_markers(tmp_path, BALLS[:2], session="s")) == 2
    whole = read_markers(tmp_path)
    assert isinstance(whole.origin, TableOrigin)
    assert "--marker ball=top,left,low" in whole.origin.options
    later = read_markers(tmp_path, BALLS[3:], marker=whole.origin.columns.table.marker)
    assert later.marker_names == whole.marker_names
    assert later.visible.tolist() == [[True, False, True], [False, False, True]]
    assert_close(later.points[0], torch.where(later.visible[0, :, None], whole.points[1], torch.nan), equal_nan=True)
