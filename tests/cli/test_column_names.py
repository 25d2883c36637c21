"""What `init` reads in the names of columns, as devices and programs write them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from diffeo_calib.cli.column_names import column
from diffeo_calib.cli.guesses import Body, bodies_in, guess_joints, guess_matrix, joints_without_column

SIX = [f"joint_{k}" for k in range(1, 7)]
SO_100 = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
UR = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
ARM = ["base_turn", "shoulder", "elbow", "forearm", "wrist", "flange_turn"]


def series(text: str, first: int = 1, count: int = 6) -> list[str]:
    return [text.format(k) for k in range(first, first + count)]


def triple(text: str, axes: str = "xyz") -> list[str]:
    return [text.format(axis) for axis in axes]


HEADERS = {
    "UR RTDE": (
        UR,
        [*series("target_q_{}", 0), *series("target_qd_{}", 0), *series("actual_q_{}", 0), *series("actual_qd_{}", 0)],
        [*series("actual_TCP_pose_{}", 0), *series("actual_current_{}", 0), *series("joint_temperatures_{}", 0)],
        (series("actual_q_{}", 0), triple("laser_{}"), None),
        triple("laser_{}"),
    ),
    "UR pendant": (
        UR,
        ["Base (°)", "Shoulder (°)", "Elbow (°)", "Wrist 1 (°)", "Wrist 2 (°)", "Wrist 3 (°)"],
        triple("{} (mm)", "XYZ"),
        (
            ["Base (°)", "Shoulder (°)", "Elbow (°)", "Wrist 1 (°)", "Wrist 2 (°)", "Wrist 3 (°)"],
            triple("{} (mm)", "XYZ"),
            triple("R{} (rad)", "XYZ"),
        ),
        triple("R{} (rad)", "XYZ"),
    ),
    "KUKA": (
        ["rail", *SIX],
        [*series("$AXIS_ACT.A{}"), "$AXIS_ACT.E1", *triple("$POS_ACT.{}", "XYZ"), *triple("$POS_ACT.{}", "ABC")],
        [*triple("$POS_FOR.{}_soll", "XYZ")],
        (["$AXIS_ACT.E1", *series("$AXIS_ACT.A{}")], triple("$POS_ACT.{}", "XYZ"), triple("$POS_ACT.{}", "ABC")),
        [],
    ),
    "Fanuc": (
        SIX,
        [*series("J{} [deg]"), *triple("{} [mm]", "XYZ"), *triple("{} [deg]", "WPR"), *series("J{} [deg/s]")],
        [],
        (series("J{} [deg]"), triple("{} [mm]", "XYZ"), triple("{} [deg]", "WPR")),
        [],
    ),
    "ABB": (
        SIX,
        [*series("robax.rax_{}"), *series("extax.eax_{}", 1, 1), *triple("trans.{}")],
        series("rot.q{}", 1, 4),
        (series("robax.rax_{}"), triple("trans.{}"), series("rot.q{}", 1, 4)),
        [],
    ),
    "Franka": (
        [f"panda_joint{k}" for k in range(1, 8)],
        [*series("q_d_{}", 0, 7), *series("dq_{}", 0, 7), *series("tau_J_{}", 0, 7), *series("q_{}", 0, 7)],
        triple("tracker/{}"),
        (series("q_{}", 0, 7), triple("tracker/{}"), None),
        [],
    ),
    "LeRobot": (
        SO_100,
        [f"action.{name}.pos" for name in SO_100],
        [*(f"observation.state.{name}.pos" for name in SO_100), *triple("{}_m")],
        ([f"observation.state.{name}.pos" for name in SO_100], triple("{}_m"), None),
        [],
    ),
    "PlotJuggler": (
        ARM,
        [f"/joint_states/{name}/{kind}" for kind in ("velocity", "effort", "position") for name in ARM],
        ["__time", *triple("/tracker/point/{}")],
        ([f"/joint_states/{name}/position" for name in ARM], triple("/tracker/point/{}"), None),
        [],
    ),
    "OptiTrack": (
        SIX,
        ["Frame", "Time (Seconds)", *triple("EE Rotation {}", "XYZW"), *triple("EE Position {}", "XYZ")],
        ["EE Mean Marker Error", *series("left_arm_joint_{}")],
        (series("left_arm_joint_{}"), triple("EE Position {}", "XYZ"), triple("EE Rotation {}", "XYZW")),
        [],
    ),
    "Vicon": (
        SIX,
        [*triple("tool:tool R{}", "XYZ"), *triple("tool:tool T{}", "XYZ"), *series("theta{}_rad")],
        [],
        (series("theta{}_rad"), triple("tool:tool T{}", "XYZ"), triple("tool:tool R{}", "XYZ")),
        [],
    ),
    "Leica": (
        SIX,
        [*series("Achse {} Ist"), *series("Achse {} Soll"), *triple("{} nominal [mm]", "XYZ")],
        [*triple("{} actual [mm]", "XYZ"), *triple("d{} [mm]", "XYZ"), *triple("Std {} [mm]", "XYZ")],
        (series("Achse {} Ist"), triple("{} actual [mm]", "XYZ"), None),
        [],
    ),
}


@pytest.mark.parametrize("device", HEADERS)
def test_headers_of_devices(device: str) -> None:
    joints, first, second, (wanted, position, rotation), third = HEADERS[device]
    header = list(dict.fromkeys([*first, *second, *third]))
    assert guess_joints(header, joints)[0].names == wanted
    (found,) = [own for own in bodies_in([name for name in header if name not in wanted]) if not own.left]
    assert (found.place, found.turn) == (position, rotation or [])


@pytest.mark.parametrize(
    ("measured", "wished"),
    [
        ("{}_ist", "{}_soll"),
        ("{}_act", "{}_nom"),
        ("{}", "ref_{}"),
        ("{}", "nominal_{}"),
        ("laser_{}", "cmd pose {}"),
        ("{}mesure", "consigne {}"),
        ("{} реал", "planned{}"),
        ("{}", "desired {} [mm]"),
        ("实测{}", "目标{}"),
        ("{}", "fk_{}"),
    ],
)
def test_wished_places_are_no_markers(measured: str, wished: str) -> None:
    for axes in ("xyz", "XYZ"):
        found = bodies_in([*triple(wished, axes), *triple(measured, axes)])
        assert [(own.place, own.left) for own in found] == [
            (triple(wished, axes), "wished places"),
            (triple(measured, axes), ""),
        ]


def test_two_markers_stay_two() -> None:
    for one, other in (("{}", "{}"), *(("b_{}", name) for name in ("left_{}", "{}1", "target 1 {}", "m{}"))):
        both = [triple(one), triple(other, "XYZ")]
        assert bodies_in([*both[0], *both[1]]) == [Body(names, []) for names in both]


@pytest.mark.parametrize("other", ["v{}", "gyro_{}", "rot_{}", "d{}", "force {} [N]", "sigma_{}", "q_{}"])
def test_other_triples_are_no_places(other: str) -> None:
    assert bodies_in([*triple(other), *triple("p{}")])[-1].place == triple("p{}")
    assert len(bodies_in([*triple(other), *triple("p{}")])) == 1


@pytest.mark.parametrize("other", ["qd_{}", "tau_{}", "J{} [deg/s]", "joint_velocity_{}", "joint_current_{}", "tcp_{}"])
def test_speeds_and_torques_are_no_joints(other: str) -> None:
    assert not guess_joints(series(other), SIX)
    assert guess_joints([*series(other), *series("s{}")], SIX)[0].names == series("s{}")


def test_reported_values_come_before_others_and_commanded_last() -> None:
    names = [*series("q_cmd_{}"), *series("q_{}"), *series("q_meas_{}")]
    found = guess_joints(names, SIX)
    assert [one.names[0] for one in found] == ["q_meas_1", "q_1", "q_cmd_1"]
    assert "reported: 'meas'" in found[0].how
    assert "commanded" in guess_joints(series("q_cmd_{}"), SIX)[0].how
    assert guess_joints([*series("q_{}"), "q of many more words than any label has"], SIX)[0].names == series("q_{}")
    equal = guess_joints([*series("A{}"), *series("J{}")], SIX)
    assert len(equal) == 2
    assert equal[0].rank == equal[1].rank, "names alone do not tell"


def test_an_axis_without_a_column_is_named() -> None:
    names = [f"{name}.pos" for name in ARM if name != "forearm"]
    assert not guess_joints(names, ARM)
    assert joints_without_column(names, ARM) == ["forearm"]
    assert guess_joints([*names, "E1"], ARM)[0].names[3] == "E1"


@pytest.mark.parametrize(
    ("names", "named"),
    [
        (series("O_T_EE[{}]", 0, 16), False),
        ([f"T{row}{k}" for row in range(4) for k in range(4)], True),
        ([f"T_{row}_{k}" for row in "1234" for k in "1234"], True),
    ],
)
def test_poses_as_matrices(names: list[str], named: bool) -> None:
    wished = [f"{name}_d" for name in names] if "EE" in names[0] else []
    assert guess_matrix([*wished, *names]) == (names, named)
    assert guess_matrix(names[:-1]) == ((names[:12], True) if named else None), "twelve numbers are a pose too"
    assert guess_matrix(names[:11]) is None


@pytest.mark.parametrize(
    ("name", "words", "unit"),
    [
        ("Base (°)", ("base",), "deg"),
        ("Wrist 1 [deg]", ("wrist", "1"), "deg"),
        ("xIst", ("x", "ist"), ""),
        ("POSX_mm", ("pos", "x"), "mm"),
        ("m_x", ("m", "x"), ""),
        ("tvec[2]", ("tvec", "z"), ""),
        ("rvec_0", ("rvec", "x"), ""),
        ("current_joint_1", ("actual", "joint", "1"), ""),
        ("joint_current_1 [A]", ("joint", "current", "1", "a"), ""),
        ("关节1(度)", ("关节", "1"), "deg"),
        ("X坐标(毫米)", ("x", "坐标"), "mm"),
    ],
)
def test_words_and_units(name: str, words: tuple[str, ...], unit: str) -> None:
    found = column(name)
    assert (found.words, found.unit) == (words, unit)


def test_places_are_no_rotations() -> None:
    assert bodies_in([*triple("m1_{}"), *triple("m2_{}")])[1].turn == []
    assert bodies_in([*triple("tip_{}"), *triple("m2_{}")])[1].turn == []
    assert bodies_in(["x", "y", "z", "rx", "ry"]) == [Body(["x", "y", "z"], [])]
    for names in ("{} rot {}", "{}_r{} [deg]"):
        each = [[names.format(body, axis) for axis in "xyz"] for body in "ab"]
        places = [[f"{body}_{axis}" for axis in "xyz"] for body in "ab"]
        found = bodies_in(["Goal roll", "Goal pitch", "Goal yaw", *each[0], *each[1], *places[0], *places[1]])
        assert [own.turn for own in found] == each


PAGE = Path(__file__).parents[2] / "scripts/docs/pages/howto/makers.md"
ROBOTS = PAGE.read_text(encoding="utf-8").split("\n## ")[1]
SERIES = {
    maker: names.removesuffix(",...").split(",") for maker, names in re.findall(r"\n\| ([^|]*) \| `([^`]*)`", ROBOTS)
}
PLACES = ["X [mm]", "Y [mm]", "Z [mm]"]


@pytest.mark.parametrize("maker", SERIES)
def test_joints_of_a_maker_are_found_beside_their_speeds(maker: str) -> None:
    own = [name for name in SERIES[maker] if name != "timestamp"]
    joints = [name.removesuffix(".pos") if "." in name else f"j{k}" for k, name in enumerate(own, 1)]
    joints = ["q1", "q2"] if maker.startswith("ROS") else joints
    columns = [*SERIES[maker], *(f"d{name}" for name in own), *PLACES]
    assert guess_joints(columns, joints)[0].names == own
    assert [own.place for own in bodies_in(columns)] == [PLACES]


def test_every_maker_is_tested() -> None:
    assert len(SERIES) == ROBOTS.count("\n| ") - 1 >= 11
