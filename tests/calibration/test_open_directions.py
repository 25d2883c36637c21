"""Campaigns that leave something open: the registration stays near the tip, warnings name it, deviations hold."""

from __future__ import annotations

import re
import warnings
from math import pi, radians

import pytest
import torch
from campaigns import CAMPAIGNS, box, joints
from degenerate import arm_of, deviations, measured, record
from product_bank import with_usual_scales
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.campaign import warn_of_open_directions
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.robots import SimulatedArm

TURN = "turn the tool about several axes between the poses"
SPREAD = "spread the poses over the workspace"
MARKER = r"the place of the marker on 'flange' is known to .* mm only: " + TURN
PLANE, LINE, POINT = (f"the measured positions lie near {what}: got" for what in ("a plane", "a line", "one point"))
NAMED = {
    "tool never turned": [MARKER],
    "tool turned by 0.3 degrees": [MARKER],
    "tool turned by 3 degrees": [MARKER],
    "one joint moves": [r"the place of the marker on 'flange' along", TURN],
    "two joints move": [],
    "tool turned about the vertical": [
        r"the place of the marker on 'flange' along \(.*\) is known to .* mm only: " + TURN
    ],
    "plane": [PLANE, r"the place of the marker on 'flange' along"],
    "plane, tool never turned": [MARKER, PLANE],
    "line": ["the turn of the measuring frame is known to .* degrees only: " + SPREAD],
    "line, tool never turned": [MARKER, "the turn of the measuring frame .*" + SPREAD, LINE],
    "small cube": ["the measured positions lie near", "the turn of the measuring frame"],
    "small cube, tool never turned": [MARKER, POINT],
    "wrist locked": [],
    "last joint locked": [],
    "elbow up": [],
    "a quarter of every range": [],
    "two clusters": ["the measured positions lie near", "the turn of the measuring frame about"],
    "one joint at a time": ["moved one at a time in 40 of 40 rows"],
}


def sentences(robot: dc.Chain, data: dc.Measurements) -> list[str]:
    """What is warned about after registration."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DiffeoCalibWarning)
        warn_of_open_directions(robot, data, register(robot, data.q, data.points))
    return [str(one.message) for one in caught]


def campaign(name: str, kind: str, rows: int, seed: int = 0) -> tuple[SimulatedArm, dc.Measurements]:
    arm, generator = arm_of(kind, seed), torch.Generator().manual_seed(seed)
    return arm, measured(arm, kind, CAMPAIGNS[name](arm, rows, generator), generator)


@pytest.mark.parametrize("degrees", [0.0, 0.003, 0.03, 0.3])
@pytest.mark.parametrize("seed", range(2))
def test_markers_stay_near_the_tip_of_a_tool_that_hardly_turns(degrees: float, seed: int) -> None:
    # Errors of a millimetre, divided by these turns, are metres.
    arm, generator = SimulatedArm(seed), torch.Generator().manual_seed(seed)
    q = box((0.4, 0.4, 0.3), radians(degrees))(arm, 40, generator)
    data = measured(arm, "1 marker", q, generator)
    found = register(arm.nominal, q, data.points)
    assert float(found.geometry.tool.norm()) < 0.5
    away = (found.geometry.tool - arm.truth.tool)[0].abs()
    assert bool((away < 4.0 * found.deviations[found.geometry.slices["tool"]]).all())


@pytest.mark.parametrize("name", NAMED)
def test_what_is_missing_is_named(name: str) -> None:
    arm, data = campaign(name, "1 marker", 40)
    found = sentences(arm.nominal, data)
    for wanted in NAMED[name]:
        assert any(re.search(wanted, text) for text in found), found
    assert bool(found) == bool(NAMED[name]), found


def test_a_pose_on_a_line_leaves_turns_open_too() -> None:
    arm, data = campaign("line, tool never turned", "poses", 15)
    found = " ".join(sentences(arm.nominal, data))
    assert "the place of the measured frame on 'flange'" in found
    assert "the turn of the measured frame on 'flange' about" in found


@pytest.mark.parametrize("kind", ["1 marker", "3 markers", "poses"])
@pytest.mark.parametrize("rows", [15, 60])
def test_honest_campaigns_are_not_warned_about(kind: str, rows: int) -> None:
    for seed in range(4):
        arm, data = campaign("everywhere", kind, rows, seed)
        assert sentences(arm.nominal, data) == []


@pytest.mark.parametrize("rows", ["scara", "gantry"])
def test_robots_that_cannot_turn_their_tools_are_not_asked_to(rows: str) -> None:
    if rows == "scara":
        robot = dc.from_dh([(0.4, 0, 0), (0.3, 0, 0), (0, 0, 0, 0, "prismatic")], name=rows)
    else:
        slide = (0, pi / 2, 0, pi / 2, "prismatic")
        robot = dc.from_dh([slide, slide, (0, 0, 0, 0, "prismatic")], name=rows)
    q = torch.rand(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    points = robot(q)[:, None, :3, 3]
    noise = torch.randn(points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert sentences(robot, dc.Measurements(q, points + 1e-4 * noise, doubt=False)) == []


def worst(model: dc.CalibratedKinematics, data: dc.Measurements) -> Tensor:
    return deviations(model, data)[2].max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tool never turned", "one joint moves"])
def test_predictions_elsewhere_carry_the_deviation_that_they_deserve(name: str) -> None:
    arm, data = campaign(name, "1 marker", 15)
    far = measured(arm, "1 marker", joints(arm, 60, torch.Generator().manual_seed(9)), torch.Generator())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DiffeoCalibWarning)
        model = with_usual_scales(arm.nominal, data).model
    assert float(worst(model, far)) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "seed"),
    [
        ("tool never turned", "poses", 0),
        ("two clusters", "poses", 1),
    ],
)
def test_so_do_those_of_several_markers_and_of_poses(name: str, kind: str, seed: int) -> None:
    found = record(name, kind, 15, seed)
    assert found["far_worst"] < 4.0
    assert found["near_worst"] < 4.0
    assert found["near_claimed_mm"] < 0.2  # rows like the measured ones are known in any case
