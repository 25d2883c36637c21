"""What `init` reads in the names of columns, as devices and programs write them."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from init_bank import NAMES, XYZ, Proposed, rows

from diffeo_calib.cli.guesses import Body, bodies_in, guess_deviations, guess_joints, joints_without_column

SIX = [f"joint_{k}" for k in range(1, 7)]
SO_100 = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
UR = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
ARM = ["base_turn", "shoulder", "elbow", "forearm", "wrist", "flange_turn"]


def series(text: str, first: int = 1, count: int = 6) -> list[str]:
    return [text.format(k) for k in range(first, first + count)]


def triple(text: str, axes: str = "xyz") -> list[str]:
    return [text.format(axis) for axis in axes]


def written(text: str) -> list[str]:
    """Names such as "J{123} [deg]", one for each letter in braces."""
    before, _, rest = text.partition("{")
    letters, _, after = rest.partition("}")
    return [before + letter + after for letter in letters] or [text] * bool(text)


ROBOTS = {"KUKA": ["rail", *SIX], "Franka": [*SIX, "joint_7"], "LeRobot": SO_100, "PlotJuggler": ARM, "UR pendant": UR}
"""Joints of other arms than one with six."""
HEADERS = """
UR RTDE | actual_q_{012345} | laser_{xyz} | | target_q_{012345} | target_qd_{012345} | actual_TCP_pose_{012345}
UR pendant | Base (°), Shoulder (°), Elbow (°), Wrist 1 (°), Wrist 2 (°), Wrist 3 (°) | {XYZ} (mm) | R{XYZ} (rad)
KUKA | $AXIS_ACT.E1, $AXIS_ACT.A{123456} | $POS_ACT.{XYZ} | $POS_ACT.{ABC} | $POS_FOR.{XYZ}_soll
Fanuc | J{123456} [deg] | {XYZ} [mm] | {WPR} [deg] | J{123456} [deg/s]
ABB | robax.rax_{123456} | trans.{xyz} | rot.q{1234} | extax.eax_{1}
Franka | q_{0123456} | tracker/{xyz} | | q_d_{0123456} | dq_{0123456} | tau_J_{0123456}
LeRobot | observation.state.JOINT.pos | {xyz}_m | | action.JOINT.pos
PlotJuggler | /joint_states/JOINT/position | /tracker/point/{xyz} | | /joint_states/JOINT/velocity | __time
OptiTrack | left_arm_joint_{123456} | EE Position {XYZ} | EE Rotation {XYZW} | EE Mean Marker Error | Time (Seconds)
Vicon | theta{123456}_rad | tool:tool T{XYZ} | tool:tool R{XYZ}
Leica | Achse {123456} Ist | {xyz} actual [mm] | | Achse {123456} Soll | {xyz} nominal [mm] | Std {xyz} [mm]
"""
"""Device | columns of the joints | of a place | of its rotation | others."""


@pytest.mark.parametrize("line", HEADERS.strip().split("\n"), ids=lambda line: line.partition(" |")[0])
def test_headers_of_devices(line: str) -> None:
    device, *texts = line.split("|")
    joints = ROBOTS.get(device.strip(), SIX)
    groups = list[list[str]]()
    for text in (*texts, "")[: max(len(texts), 3)]:
        each = [text.replace("JOINT", name) for name in joints] if "JOINT" in text else text.split(",")
        groups.append([name for one in each for name in written(one.strip())])
    wanted, place, turn, *_ = groups
    for header in ([name for own in way for name in own] for way in (groups, groups[::-1])):
        assert guess_joints(header, joints)[0].names == wanted
        (found,) = [own for own in bodies_in([name for name in header if name not in wanted]) if not own.left]
        assert (found.place, found.turn) == (place, turn)


WISHED = "{}_ist|{}_soll, {}_act|{}_nom, {}|ref_{}, laser_{}|cmd pose {}, {}mesure|consigne {}, {} реал|planned{}"
WISHED += ", {}|desired {} [mm], 实测{}|目标{}"


@pytest.mark.parametrize(("measured", "wished"), [pair.split("|") for pair in WISHED.split(", ")])
def test_wished_places_are_no_markers(measured: str, wished: str) -> None:
    for axes in ("xyz", "XYZ"):
        places = triple(wished, axes), triple(measured, axes)
        found = [(own.place, own.left) for own in bodies_in([*places[0], *places[1]])]
        assert found == [(places[0], "wished places"), (places[1], "")]


def test_markers_deviations_and_rotations() -> None:
    for one, other in (("{}", "{}"), *(("b_{}", name) for name in ("left_{}", "{}1", "target 1 {}", "m{}"))):
        both = [triple(one), triple(other, "XYZ")]
        assert bodies_in([*both[0], *both[1]]) == [Body(names, []) for names in both]
    names = triple("Std {} [mm]")
    assert guess_deviations(names[::-1], [triple("{} actual [mm]")]) == names
    assert guess_deviations(names[:2], [triple("{} actual [mm]")]) is None
    assert [own.turn for own in bodies_in([*triple("tip_{}"), *triple("m2_{}")])] == [[], []]
    assert bodies_in(["x", "y", "z", "rx", "ry"]) == [Body(["x", "y", "z"], [])]
    for names in ("{} rot {}", "{}_r{} [deg]"):
        each = [[names.format(body, axis) for axis in "xyz"] for body in "ab"]
        places = [name for body in "ab" for name in triple(f"{body}_{{}}")]
        found = bodies_in(["Goal roll", "Goal pitch", "Goal yaw", *each[0], *each[1], *places])
        assert [own.turn for own in found] == each


@pytest.mark.parametrize("other", ["v{}", "gyro_{}", "rot_{}", "d{}", "force {} [N]", "sigma_{}", "q_{}"])
def test_other_triples_are_no_places(other: str) -> None:
    assert [own.place for own in bodies_in([*triple(other), *triple("p{}")])] == [triple("p{}")]


@pytest.mark.parametrize("other", ["qd_{}", "tau_{}", "J{} [deg/s]", "joint_velocity_{}", "joint_current_{}", "tcp_{}"])
def test_speeds_and_torques_are_no_joints(other: str) -> None:
    assert not guess_joints(series(other), SIX)
    assert guess_joints([*series(other), *series("s{}")], SIX)[0].names == series("s{}")


def test_which_columns_are_the_joints() -> None:
    """Reported values come before others, and commanded ones last; an axis without a column is named."""
    found = guess_joints([*series("q_cmd_{}"), *series("q_{}"), *series("q_meas_{}")], SIX)
    assert [one.names[0] for one in found] == ["q_meas_1", "q_1", "q_cmd_1"]
    assert "reported: 'meas'" in found[0].how
    assert "commanded" in found[2].how
    assert guess_joints([*series("q_{}"), "q of many more words than any label has"], SIX)[0].names == series("q_{}")
    equal = guess_joints([*series("A{}"), *series("J{}")], SIX)
    assert len({one.rank for one in equal}) == 1 < len(equal), "names alone do not tell"
    names = [f"{name}.pos" for name in ARM if name != "forearm"]
    assert not guess_joints(names, ARM)
    assert joints_without_column(names, ARM) == ["forearm"]
    assert guess_joints([*names, "E1"], ARM)[0].names[3] == "E1"
    assert guess_joints(["E1", *names], ARM)[0].names[3] == "E1"
    seven = ["A1", "A2", "E1", "A3", "A4", "A5", "A6"]  # a seventh axis between the others
    assert guess_joints([*seven, "X", "Y", "Z"], [f"lbr_A{k}" for k in range(1, 8)])[0].names == seven


@pytest.mark.parametrize(
    ("columns", "joints"),
    [
        ("x_axis,y_axis,c,a", "x_axis,y_axis,c_axis,a_axis"),
        ("Az (deg),Alt (deg)", "azimuth,altitude"),
        ("θ1/deg,θ2/deg,d3/mm,θ4/deg", "joint1,joint2,joint3,joint4"),
    ],
)
def test_columns_named_after_joints_each_in_its_way(columns: str, joints: str) -> None:
    names, places = columns.split(","), ["X", "Y", "Z"]
    assert guess_joints([*places, *names], joints.split(","))[0].names == names
    assert not guess_joints([*places, *names[:-1]], joints.split(","))


PAGE = Path(__file__).parents[2] / "scripts/docs/pages/howto/makers.md"
TABLE = PAGE.read_text(encoding="utf-8").split("\n## ")[1]
ROWS = re.findall(r"\n\| ([^|]*) \| `([^`]*)`", TABLE)
MAKERS = {maker: names.removesuffix(",...").split(",") for maker, names in ROWS}
assert len(MAKERS) == TABLE.count("\n| ") - 1 >= 11


@pytest.mark.parametrize("maker", MAKERS)
def test_joints_of_a_maker_are_found_beside_their_speeds(maker: str) -> None:
    own, places = [name for name in MAKERS[maker] if name != "timestamp"], ["X [mm]", "Y [mm]", "Z [mm]"]
    joints = [name.removesuffix(".pos") if "." in name else f"j{k}" for k, name in enumerate(own, 1)]
    columns = [*MAKERS[maker], *(f"d{name}" for name in own), *places]
    assert guess_joints(columns, ["q1", "q2"] if maker.startswith("ROS") else joints)[0].names == own
    assert [one.place for one in bodies_in(columns)] == [places]


WORDS = ["Drehteller", "Schulter", "alpha", "beta", "gamma", "Flansch"]
AWAY = torch.tensor([[512345.0, 5412345.0, 312.0]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("names", "per_deg", "joints", "axes", "away"),
    [
        (WORDS, 1.0, ",".join(WORDS), XYZ, 0.0),
        (NAMES, 1.0, ",".join(NAMES), ["E", "N", "H"], 0.0),
        (NAMES, 1.0, ",".join(NAMES), ["Easting", "Northing", "Height"], AWAY),
        pytest.param(
            *(NAMES, 1 / 360, ",".join(f"2*pi*{{{name}}}" for name in NAMES), XYZ, 0.0),
            marks=pytest.mark.slow,
            id="turns",
        ),
    ],
)
def test_other_names_places_and_turns(
    names: list[str], per_deg: float, joints: str, axes: list[str], *, away: Any, proposed: Proposed
) -> None:
    """All other columns are the joints if there are as many; places of a survey are far from zero."""
    q, points = rows()
    found, text = proposed((names, per_deg * q), (axes, 1e-3 * points + away))
    assert (found["joints"], found["length"], found["position"]) == (joints, "m", [",".join(axes)])
    assert "all columns are used" in text
    assert "look like millimetres" not in text
