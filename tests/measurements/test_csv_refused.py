"""Every mistake in a file or its description is one error that names the file, the line and the column."""

from pathlib import Path
from typing import Any

import pytest
from table_bank import HEADER, JOINTS, POSITION, ROWS, Reader, in_order

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.files import read_measurements, read_observations
from diffeo_calib.measurements.csv.sensors import ReadingColumns, SocketColumns
from diffeo_calib.measurements.table_format import TableFormat

TABLE = HEADER + ROWS
GERMAN = HEADER.replace(",", ";")
Case = tuple[str | bytes, dict[str, Any], str]
DECIMALS = GERMAN + "1.5;2;3.5;4;5.5\n1,5;2;3;4;5\n1;2;3,5;4;5,5\n"
COPIES = TABLE + "9,9,9,9,9\n" + ROWS.replace("0.1,", "0.10,")
PARTS = {"position": ["p_x", "p_y", "p_z"]}
STATED = "expected mm, as stated, got {} in the file; state the unit"
FILES: list[Case] = [
    ("", {}, "is empty: expected a header"),
    (",,\n1,2,3\n", {}, "no column"),
    (HEADER, {}, "header but no rows: expected at least one row"),
    (TABLE + "1,2,3\n", {}, "line 4: expected 5 cells ... got 3"),
    ('"q1",q2,x,y,z\n"1\n",2,3,4,5\n1,2\n' + "1\n" * 6, {}, "line 4, 5, 6, 7, 8 and 2 more: ... got 2"),
    ("q1,q2,x,y,z,q2\n", {}, "header: ['q2'] named more than once"),
    (HEADER, {"joints": ["Q1", "q22"]}, "no column ['Q1', 'q22'] ... ['q1', 'q2'"),
    ("q1,joint_Q2,x,y,z\n1,2,3,4,5\n", {}, "for 'q2', did you mean joint_Q2."),
    (HEADER, {"position": ["x", "y", "height"]}, "no column ['height'] ... written in the header"),
    (GERMAN + "1;2;3;4;5\n", {}, "single column 'q1;q2;x;y;z' without ',' ... pass sep=';'"),
    (DECIMALS, {"sep": ";"}, "line 3, column 'q1' (and 2 more, on line 4) ... '1,5' ... decimal comma ... decimal=','"),
    (GERMAN + "1.5;2;3;4;5\n1,5;2;3;4;5\n", {"sep": ";", "decimal": ","}, "line 2, column 'q1' ... '1.5' ... decimal="),
    (GERMAN + "1;2;1.234;4;5\n", {"sep": ";", "decimal": ","}, "column 'x' ... thousands"),
    (GERMAN + "1;2;1,000;4;5\n", {"sep": ";"}, "line 2, column 'x' ... decimal=',' ... thousands"),
    (HEADER + "1,2,far,4,5\n", {}, "line 2, column 'x': expected a number, got 'far'"),
    (TABLE + "1,2,,4,5\n", {}, "line 4, column 'x': expected a finite number, got an empty cell"),
    (HEADER + "1,2,3,4,NaN\n" * 8, {}, "line 2, column 'z' (and 7 more, on line 3, 4, 5, 6, 7 and 2 more) ... 'NaN'"),
    (HEADER + "1,2,3,1e30,5\n", {}, "line 2, column 'y': expected a number below 1e+12 ... 1e30"),
    (COPIES, {}, "2 line(s) ... 5 repeats 2, 6 repeats 3 ... duplicates='drop'"),
    (HEADER + '1,2,"3,4,5\n6,7,8,9,10\n', {}, "line 2: not valid CSV ... quotes"),
    (b"\0\1" + TABLE.encode(), {}, "is no text but binary"),
    (TABLE.replace("x,", "x (cm),"), {"position": ["x (cm)", "y", "z"], "length": "mm"}, STATED.format("cm")),
    (HEADER + "degree,弧度,米,mm,毫米\n" + ROWS, {"length": "mm"}, "column 'q1': expected rad, as stated, got deg"),
    (TABLE.replace("0.1,", "12°75',"), {"angle": "deg"}, "column 'q1': expected a number, got \"12°75'"),
    ('q1,q2,p\n0,0,"[1, 2, 3]"\n1,1,"[1, 2, 4]"\n1,2,7\n', PARTS, "line 4, column 'p_x' ... got '7_1'"),
    ("q1;q2;p\n0;0;[0,1 0,2 0,3]\n1;1;[0,1 0,2 0,4]\n", PARTS | {"sep": ";", "decimal": ","}, "no column ['p_x'"),
    (TABLE.replace("q1", "q1 [°]"), {"joints": ["q1 [°]", "q2"]}, "column 'q1 [°]': expected rad, as stated, got deg"),
]
OPTIONS: list[Case] = [
    (TABLE, {"length": "km"}, "`length`: expected 'm' or 'mm' or 'cm' or 'um' or 'inch', got 'km'"),
    (TABLE, {"angle": "degrees"}, "`angle`: expected 'rad' or 'deg', got 'degrees'"),
    (TABLE, {"decimal": ","}, "`sep` and `decimal`: expected different ... sep=';'"),
    (TABLE, {"sep": "::"}, "`sep`: expected one character, got '::'"),
    (TABLE, {"duplicates": "ignore"}, "`duplicates`: expected 'error' or 'keep' or 'drop'"),
    (TABLE, {"joints": "q1"}, "`joints` ... 'q1'"),
    (TABLE, {"position": "xyz"}, "`position`: expected three names"),
    (TABLE, {"position": [["x", "y", "z"], ["x", "y"]]}, "`position`"),
    (TABLE, {"kinds": ["revolute"]}, "`joints`: expected 1 columns, one for each of `kinds` ... got 2 (['q1'"),
    (TABLE, {"kinds": ["revolute", "planar"]}, "`kinds` ... 'prismatic' ... got 'planar'"),
    (TABLE, {"joint_length": "m"}, "`joint_length` without the kinds of the joints ... pass the robot, or `kinds`"),
    (TABLE, {"camera_on_tool": True}, "`camera_on_tool` without `rotation`; name the columns"),
]


POSED: dict[str, Any] = {"rotation": ["a", "b", "c"], "convention": "XYZ", "rotation_angle": "deg"}
POSE_HEADER, POSE_ROW = "q1,q2,x,y,z,a,b,c,d\n", "0.1,0.2,1.0,2.0,3.0,10,20,30,1\n"
POSE = POSE_HEADER + POSE_ROW
QUATERNION = {"rotation": ["a", "b", "c", "d"], "convention": "quat_xyzw", "rotation_angle": None}
NINE = ",".join(f"r{i}" for i in range(9))
MATRIX = {"rotation": NINE.split(","), "convention": "matrix", "rotation_angle": None}
MATRICES = f"q1,q2,x,y,z,{NINE}\n0,0,1,2,3,1,0,0,0,1,0,0,0,1\n0,0,1,2,3"
NO_ROTATION = {"rotation": None, "convention": None, "rotation_angle": None}
TWO = [["x", "y", "z"], ["a", "b", "c"]]
RAD = [f"{name} [rad]" for name in "abc"]
POSES: list[Case] = [
    (POSE, {"convention": None}, "`rotation` is given, but its `convention` is not ... 'quat_xyzw' ... never guessed"),
    (POSE, {"rotation": None}, "`convention` and `rotation_angle` without `rotation` ... leave"),
    (POSE, NO_ROTATION | {"rotation_std": ["d"] * 3}, "`rotation_std` without `rotation`"),
    (POSE, {"rotation_angle": None}, "`rotation_angle` is missing ... expected 'rad' or 'deg'"),
    (POSE, {"rotation_angle": "grad"}, "`rotation_angle`: expected 'rad' or 'deg', got 'grad'"),
    (POSE, {"convention": "roll-pitch-yaw"}, "`convention` ... got 'roll-pitch-yaw'"),
    (POSE, QUATERNION | {"rotation_angle": "deg"}, "`rotation_angle` beside convention 'quat_xyzw' ... leave it out"),
    (POSE, QUATERNION, "line 2, columns a, b, c, d: expected a quaternion of length 1 ... got 37.4299 ... order"),
    (POSE, QUATERNION | {"rotation_std": ["u", "v", "w"]}, "`rotation_angle` is missing"),
    (POSE, {"position": TWO, "rotation": ["q1"] * 3}, "`rotation`: expected a list for each position"),
    (POSE, {"rotation": [["a", "b", "c"], ["a", "b"]]}, "`rotation`: expected 3 names ... got ['a', 'b']"),
    (POSE, {"std": ["d", "q1"]}, "`std`: expected ... one per marker ... got ['d', 'q1']"),
    (POSE, NO_ROTATION | {"spherical": "zenith_gon", "std": list("abc")}, "`std` of a distance and two angles: got"),
    (POSE, {"rotation_std": ["d", "e"]}, "`rotation_std` ... three, or one for all three axes, got ['d', 'e']"),
    (POSE + "0,0,1,2,3,10,,30,1\n", {}, "line 3, column 'b' ... an empty cell"),
    (POSE + "\n0,0,1,2,3,10,2,30,0\n", {"std": ["d"]}, "line 4, column 'd' ... got '0'"),
    (MATRICES + ",1,0,0,0,1,0,0,0,-1\n", MATRIX, "line 3, columns r0, r1 ... mirrored"),
    (MATRICES + ",2,0,0,0,2,0,0,0,2\n", MATRIX, "line 3 ... orthonormal ... without a scale"),
    (POSE.replace("a,b,c", ",".join(RAD)), {"rotation": RAD}, "column 'a [rad]': expected deg, as stated, got rad"),
]
FRAMES: dict[str, Any] = {"rotation": [[*"abc"], [*"ABC"]], "convention": "rotvec", "rotation_angle": "rad"}
FRAMES |= {"joints": ["q"], "position": [["x", "y", "z"], ["X", "Y", "Z"]]}
TWO_FRAMES = "q,x,y,z,a,b,c,X,Y,Z,A,B,C\n0.1,1,2,3,0.1,0.2,0.3,1,2,3,0.1,0.2,0.3\n"
ONE_FRAME = TWO_FRAMES.partition("\n")[0] + "\n1,,,,,,,1,2,3,0,0,0\n"
SEVERAL: list[Case] = [
    (TWO_FRAMES, {"rotation_std": ["A", "B", "C"]}, "`rotation_std`: expected a list for each position"),
    (TWO_FRAMES + "1,,,,,,,1,2,3,0,,0\n", {}, "line 3, column 'B' ... an empty cell"),
    (TWO_FRAMES + "1,,,,,,0,1,2,3,0,0,0\n", {}, "line 3, column 'x' ... an empty cell"),
    (ONE_FRAME, {}, "columns x, y, z, a, b and 1 more ... shows this frame; leave them out"),
]


PAIR: dict[str, Any] = {"position": [("ax", "ay", "az"), ("bx", "by", "bz")]}
MARKERS = "q1,q2,ax,ay,az,bx,by,bz\n0.1,0.2,1,2,3,4,5,6\n0.3,0.4,1.5,2.5,3.5,,,\n0.5,0.6,,,,4.5,5.5,6.5\n"
COMMAS: dict[str, Any] = {"sep": ";", "decimal": ","}
DEVIATIONS = "q1;q2;ax;ay;az;bx;by;bz;sa;sb\n0,1;0,2;1;2;3;;;;;\n"
HALVES = {
    "0.7,0.8,1,,3,4,5,6": "'ay' ... an empty cell ... marker or frame are empty",
    "0.7,0.8,1,2,3,,,6": "'bx' ... an empty cell ... marker or frame are empty",
    "0.7,,1,2,3,4,5,6": "'q2' ... an empty cell",
    "0.7,,,,,,,": "'q2': expected a finite number",
    "0.7,0.8,1,2,3,,inf,": "'by' ... 'inf'",  # and not the empty one beside it
    "0.7,0.8,1,2,3,,,1e400": "'bz' ... '1e400'",
    "0.7,1e13,1,2,3,4,5,6": "'q2' ... '1e13'",
}
HIDDEN: list[Case] = [
    *((MARKERS + row + "\n", PAIR, f"line 5, column {message}") for row, message in HALVES.items()),
    (DEVIATIONS, COMMAS | PAIR | {"std": ["sa", "sb"]}, "line 2, column 'sa' ... an empty cell"),
    (MARKERS.partition("0.5,0.6")[0].replace("4,5,6", ",,"), PAIR, "bx, by, bz: empty in all lines"),
]
BALLS = "q1,q2,ball,x,y,z\n0.1,0.2,top,1,2,3\n0.3,0.4,low,1,1,2\n"
BALL: dict[str, Any] = {"marker": "ball"}
OF_MARKERS: list[Case] = [
    (BALLS, {"marker": "ball=top,left"}, "column 'ball': expected markers of the model: top, left, got low"),
    (BALLS, {"marker": "smr"}, "no column ['smr']"),
    (BALLS.replace("top", ""), BALL, "line 2, column 'ball': expected the name of a marker, got an empty cell"),
    (BALLS, BALL | {"position": [["x", "y", "z"], ["u", "v", "w"]]}, "`marker` (ball): expected one position"),
    (BALLS, BALL | {"socket": "place"}, "`marker` (ball)"),
]


@pytest.mark.parametrize(
    ("text", "how", "message"),
    [
        *FILES,
        *OPTIONS,
        *((text, POSED | how, message) for text, how, message in POSES),
        *((text, FRAMES | how, message) for text, how, message in SEVERAL),
        *HIDDEN,
        *OF_MARKERS,
    ],
)
def test_one_clear_error(text: str | bytes, how: dict[str, Any], message: str, read: Reader) -> None:
    with pytest.raises(MeasurementError, match=in_order(message)) as caught:
        read(text, **how)
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value)
    assert "table.csv'" in str(caught.value) or message.startswith(("`", "distinct")), "the file is named"


def test_files_that_cannot_be_opened_and_units_that_are_not_named(tmp_path: Path) -> None:
    units: dict[str, Any] = {"length": "m", "angle": "rad"}
    for path, message in ((tmp_path / "nowhere.csv", "nowhere.csv' does not exist.*folder"), (tmp_path, "is a folder")):
        with pytest.raises(MeasurementError, match=message):
            read_measurements(path, JOINTS, POSITION, **units)
    for name in units:
        with pytest.raises(TypeError, match=name):
            read_measurements(tmp_path, JOINTS, POSITION, **{other: units[other] for other in units if other != name})


SI = TableFormat("m", "rad", joints=("a", "b"))
LINES = """a,b,x,y,z,d,u,v,spot,who,sd
0.1,0.2,1,2,3,,,,,,
0.2,0.3,,,,1.5,,,,A,0.1
0.3,0.4,1,2,4,1.7,,,,B,0.1
0.4,0.5,,,,,7,8,,C,
0.5,0.6,,,,,,,s0,,
"""
WIRE = ReadingColumns("distance", ("d",), "who", std=("sd",))
CAMERA = ReadingColumns("image", ("u", "v"), "who", intrinsics=(2.0, 2.0, 0.0, 0.0))
ROPE, PLANE = ReadingColumns("distance", ("rope",), "who"), ReadingColumns("height", 0.0)
KINDS: dict[str, Any] = {"position": list("xyz"), "sockets": SocketColumns(("spot",)), "readings": (WIRE, CAMERA)}
NOTHING = {"position": None, "sockets": None}


@pytest.mark.parametrize(
    ("edit", "how", "message"),
    [
        (("0.3,0.4,1,2,4,1.7", "0.3,0.4,,,,"), {}, "line 4: expected a position or a socket or a distance or an image"),
        (("7,8,,C", "7,,,C"), {}, "line 5, column 'v': expected a finite number, got an empty cell"),
        (("1,2,3,", "1,,3,"), {}, "line 2, column 'y'"),
        (("1.5,,,,A", "far,,,,A"), {}, "line 3, column 'd': expected a number, got 'far'"),
        (("1.5,,,,A", "1.5,,,,"), {}, "line 3, column 'who': expected the name of the device of this reading"),
        (("A,0.1", "A,"), {}, "line 3, column 'sd': expected a finite number, got an empty cell"),
        (("7,8,,C", ",,s0,"), {}, "columns u, v: empty in all lines: expected some line that holds an image"),
        (("0.5,0.6,", "0.2,0.3,,,,1.5,,,,A,0.1\n0.7,0.6,"), {}, "line 6 repeats 3"),
        ((), {"sockets": None, "position": None, "readings": ()}, "`position` is missing"),
        ((), {**NOTHING, "readings": (WIRE,)}, "line 2, column 'd' ... a finite number, got an empty cell"),
        ((), {"readings": (PLANE,)}, "one height for all rows beside rows of other kinds"),
        ((), {"position": None, "session": "who"}, "`session` beside `socket`"),
        ((), {**NOTHING, "session": "who"}, "`session` beside `readings`"),
        ((), {"readings": (ROPE,)}, "no column ['rope']"),
        ((), {"readings": ()}, "line 3, 5: expected a position or a socket, got empty cells"),
    ],
)
def test_several_kinds(edit: Any, how: dict[str, Any], message: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(LINES.replace(*edit) if edit else LINES)
    with pytest.raises(MeasurementError, match=in_order(message)):
        read_observations(tmp_path / "t.csv", TableFormat("m", "rad", joints=("a", "b"), **(KINDS | how)))


@pytest.mark.parametrize(
    ("kind", "names", "how", "message"),
    [
        ("image", ("u",), {"intrinsics": (1.0, 1.0, 0.0, 0.0)}, "2 names of columns for 'image'"),
        ("pose", "d", {}, "`kind`"),
        ("height", "d", {"intrinsics": (1.0, 1.0, 0.0, 0.0)}, "`intrinsics` of 'height'"),
        ("image", ("u", "v"), {}, "`intrinsics` of 'image'"),
    ],
)
def test_columns_of_readings(kind: str, names: Any, how: dict[str, Any], message: str) -> None:
    with pytest.raises(MeasurementError, match=message):
        dc.ReadingColumns(kind, names, **how)
