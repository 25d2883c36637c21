"""Tools that take turns, payloads of other rows, and ratios of slides and mimic joints that a fit would take up."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numbers_bank import drawn, normal, tensor
from reading_bank import scales
from table_bank import refused, warned
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.hypotheses import lengths
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.simulated_arm import URDF_FILE

ARM, ROWS = SimulatedArm(3), 80


def said_of(rows: Any) -> list[str]:
    """What a calibration warns of, with scales given."""
    return warned(dc.calibrate, ARM.nominal, rows, hyperparameters=scales())[1]


@pytest.mark.parametrize("every", [2, 5])
def test_tools_that_take_turns_are_named_with_their_rows(every: int) -> None:
    q, y = ARM.measure(ROWS, seed=1)
    y[::every, 0] += ARM.truth.poses(q)[::every, :3, :3] @ tensor([3e-4, 0.0, 4e-4])
    (text,) = [one for one in said_of(dc.Measurements(q, y)) if "another tool" in one]
    lines = ", ".join(str(every * k) for k in range(5))
    assert text.startswith(f"{ROWS // every} of {ROWS} rows seem to have another tool or marker, 0.")
    assert f"mm away: lines {lines} and" in text
    assert 0.4 < float(text.split("marker, ")[1].split(" mm")[0]) < 0.6


@pytest.mark.parametrize(
    ("change", "rows", "words"),
    [
        (lambda m: m.roll(2), ROWS, "the payloads seem to be those 2 lines later"),
        (lambda m: torch.where(m == 10, 1.0, m), ROWS, "10 times as large where they are 1"),
        (lambda m: torch.cat([m[:40], 1000 * m[40:]]), ROWS, "1000 times as large where they are at most 10"),
        (lambda m: m.flip(0), 120, "rows seem to have carried payloads of other rows"),
        (lambda m: m, ROWS, ""),
    ],
)
def test_payloads_of_other_lines_and_units_are_named_and_right_ones_are_not(change: Any, rows: int, words: str) -> None:
    masses = torch.from_numpy(np.random.default_rng(5).choice([0.0, 5.0, 10.0], rows))
    data = dc.Measurements(*ARM.measure(rows, 2, masses)).with_payload(change(masses.clone()))
    assert [words in one for one in said_of(data) if "payload" in one] == [True] * bool(words)


@pytest.mark.parametrize(
    ("q", "y", "words"),
    [
        pytest.param(1.0, 1e3, "the positions seem to be 1000 times too large", marks=pytest.mark.slow),
        pytest.param(1.0, 1e-3, "the positions seem to be 1000 times too small", marks=pytest.mark.slow),
        (180 / np.pi, 1.0, "degrees"),
    ],
)
def test_the_unit_of_one_session_is_named(q: float, y: float, words: str) -> None:
    values, points = ARM.measure(ROWS, seed=1)
    values[50:] *= q
    points[50:] *= y
    data = dc.Measurements(values, points, doubt=False).with_sessions(["a"] * 50 + ["b"] * 30)
    refused((f"session 'b': .*{words}", lambda: dc.calibrate(ARM.nominal, data)))


def edited(tmp_path: Path, multiplier: float, base: str) -> dc.Tree:
    """The arm on a rail, with a joint before its forearm that follows the shoulder."""
    rail = '<link name="floor"/><joint name="rail" type="prismatic"><parent link="floor"/><child link="base_link"/>'
    rail += '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    follows = '<link name="mid"/><joint name="coupler" type="revolute"><parent link="{}"/><child link="mid"/>'
    follows += '<axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>'
    follows += f'<mimic joint="shoulder_joint" multiplier="{multiplier}"/></joint>'
    before, joint, after = URDF_FILE.read_text(encoding="utf-8").partition('<joint name="forearm_roll_joint"')
    parent = after.split('parent link="')[1].split('"')[0]
    after = after.replace(f'parent link="{parent}"', 'parent link="mid"', 1)
    before = before.replace('<link name="base_link">', rail + '<link name="base_link">', 1)
    path = tmp_path / "robot.urdf"
    path.write_text(before + follows.format(parent) + joint + after, encoding="utf-8")
    return dc.load_urdf(path, base, "flange")


def measured(robot: dc.Tree, stroke: float = 0.0) -> tuple[Tensor, Tensor]:
    """Joint values (N, n), of a rail first, and places (N, 1, 3) of a point of a robot with usual errors, m."""
    low, high = robot.limits[-6:].unbind(1)
    q = torch.cat([stroke * drawn(ROWS, robot.n - 6, seed=2), low + (high - low) * drawn(ROWS, 6, seed=1)], 1)
    T = robot(q + 2e-4 * torch.sin(q))
    y = T[:, :3, 3] + T[:, :3, :3] @ tensor([0.03, 0.02, 0.1]) + 1.0
    return q, y[:, None] + normal(ROWS, 1, 3, seed=4, size=2e-5)


def doubted(robot: dc.Tree, q: Tensor, y: Tensor) -> list[tuple[str, float]]:
    """Names and values of ratios that are too improbable."""
    placed = place(robot, dc.Measurements(q, y), lambda *_: None)
    data = placed.tangent_data()
    found = lengths(data, defaults(data, placed.identification.noise, placed.identification.prior))
    return [(one.cause.name, one.value) for one in found if one.cause.usual and abs(one.value) > one.unnoticed]


def test_the_multiplier_of_a_mimic_joint_is_judged(tmp_path: Path) -> None:
    robot = edited(tmp_path, 1.0, "base_link")
    assert doubted(robot, *measured(robot)) == []
    ((name, value),) = doubted(robot, *measured(edited(tmp_path, 1.02, "base_link")))
    assert name == "the multiplier of coupler"
    assert value == pytest.approx(0.02, rel=0.1)
    other = dc.Measurements(*measured(edited(tmp_path, -1.0, "base_link")))
    refused(("'coupler' seems to follow with -1 times its multiplier", lambda: dc.calibrate(robot, other)))


@pytest.mark.filterwarnings("ignore:rail. hardly moved")
def test_a_slide_of_short_stroke_that_counts_backwards_is_named(tmp_path: Path) -> None:
    robot = edited(tmp_path, 0.0, "floor")
    q, y = measured(robot, stroke=0.02)
    assert doubted(robot, q, y) == []
    q[:, 0] *= -1
    ((name, value),) = doubted(robot, q, y)
    assert name == "the scale of rail"
    assert value == pytest.approx(-2.0, rel=0.1)


def test_a_slide_in_inch_is_refused_by_name(tmp_path: Path) -> None:
    robot = edited(tmp_path, 0.0, "floor")
    q, y = measured(robot, stroke=0.5)
    q[:, 0] /= 0.0254
    message = r"prismatic joints seem to be 39.37 times too large.*`joint_length`"
    refused((message, lambda: dc.calibrate(robot, dc.Measurements(q, y, doubt=False))))


def larger(tmp_path: Path, factor: float) -> dc.Tree:
    """The arm with all lengths multiplied."""
    text = re.sub(
        'xyz="([^"]*)" rpy',
        lambda found: f'xyz="{" ".join(str(factor * float(word)) for word in found[1].split())}" rpy',
        URDF_FILE.read_text(encoding="utf-8"),
    )
    (tmp_path / "larger.urdf").write_text(text, encoding="utf-8")
    return dc.load_urdf(tmp_path / "larger.urdf", "base_link", "flange")


def test_scales_of_robots_that_do_not_suit_are_refused_or_named(tmp_path: Path) -> None:
    q, y = SimulatedArm(0).measure(60, seed=9)
    robot, other, data = larger(tmp_path, 1.4), SimulatedArm(77).measure(60, seed=3), dc.Measurements(q, y)
    model = dc.calibrate(robot, dc.Measurements(other[0], 1.4 * other[1])).model
    with pytest.warns(DiffeoCalibWarning, match="`scales_of` does not suit these rows: got leave-one-out errors"):
        dc.calibrate(ARM.nominal, data, scales_of=[model])
    message = "`scales_of`, model 1: expected one of about 0.*got a reach of"
    refused((message, lambda: dc.calibrate(larger(tmp_path, 0.6), data, scales_of=[model])))
