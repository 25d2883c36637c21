"""Registration of any frame and marker, joint offsets, open directions; geometric identification and its noise."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from math import inf, pi, radians
from typing import Any

import pytest
import torch
from campaigns import CAMPAIGNS, box
from commanded_bank import flange
from degenerate import arm_of, measured, record
from numbers_bank import drawn, rms, tensor
from robots_bank import draw
from table_bank import warned
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.open_directions import warn_of_open_directions, warn_of_single_joints
from diffeo_calib.calibration.identification.identification import Prior, identify
from diffeo_calib.calibration.identification.registration import find_joint_offsets, register, with_joint_offsets
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.robots import Chain, DHRow, Geometry, SimulatedArm, from_dh

ARM = SimulatedArm()


def somewhere(seed: int, markers: int = 1) -> Geometry:
    """The simulated arm's nominal chain, metres away in any orientation, with markers within centimetres."""
    base = torch.eye(4, dtype=torch.float64)
    base[:3, :3] = torch.linalg.qr(draw(3, 3, seed=seed)).Q
    base[:3, 0] *= torch.linalg.det(base[:3, :3])
    base[:3, 3] = draw(3, seed=seed + 1, size=3.0)
    return replace(Geometry.nominal(ARM.nominal, markers), base=base, tool=draw(markers, 3, seed=seed + 2, size=0.1))


@pytest.mark.parametrize(("seed", "markers", "rows"), [(0, 1, 12), (1, 3, 12), (2, 1, 4), (5, 1, 4)])
def test_registration_finds_any_frame_and_marker(seed: int, markers: int, rows: int) -> None:
    """With few poses a single start, even the linear solution, sometimes ends in another local minimum."""
    truth, q = somewhere(seed, markers), ARM.sample(rows, seed)
    found = register(ARM.nominal, q, truth.points(q))
    assert_close((found.geometry.base, found.geometry.tool), (truth.base, truth.tool), rtol=0, atol=1e-6)
    assert found.rms < 1e-12


def test_too_few_poses_are_explained() -> None:
    for markers, poses, need in ((1, 2, 3), (2, 1, 2), (3, 1, 2)):
        q = ARM.sample(poses)
        message = f"expected at least {need} poses, got {poses}, that is {3 * markers * poses} coordinates"
        with pytest.raises(MeasurementError, match=message):
            register(ARM.nominal, q, somewhere(7, markers).points(q))


SLIDE, DOWN = (0, pi / 2, 0, pi / 2, "prismatic"), (0, 0, 0, 0, "prismatic")


@pytest.mark.parametrize(
    ("rows", "tool"),
    [([(0.5, 0, 0), (0.4, 0, 0), (0.2, 0, 0)], [0.03, -0.02, 0.0]), ([SLIDE, SLIDE, DOWN], [0.0, 0.0, 0.0])],
    ids=["in a plane", "never turns"],
)
def test_directions_that_no_row_can_show_belong_to_the_base(rows: Any, tool: list[float]) -> None:
    chain = from_dh(rows, name="machine")
    truth = replace(Geometry.nominal(chain), base=somewhere(9).base, tool=tensor([tool]))
    q = draw(40, 3)
    found = register(chain, q, truth.points(q)).geometry
    assert_close((found.base, found.tool), (truth.base, truth.tool), rtol=0, atol=1e-9)


# --- joint offsets far from the description ---------------------------------------------------------------------------

OTHER = SimulatedArm(seed=3)


@pytest.mark.parametrize(("joint", "degrees"), [(1, 10.0), (2, -25.0), (3, 12.0), (4, 45.0)])
def test_one_joint_is_found_among_geometric_errors(joint: int, degrees: float) -> None:
    q, points = OTHER.measure(56, seed=1)
    q[:, joint] -= math.radians(degrees)
    points[:6, 0] += draw(6, 3)  # gross outliers
    offsets = find_joint_offsets(register(OTHER.nominal, q[6:], points[6:]).geometry, q, points)
    expected = torch.zeros(6, dtype=torch.float64)
    expected[joint] = math.radians(degrees)
    assert_close(offsets[1:5], expected[1:5], rtol=0, atol=0.01)  # base and marker may carry the first and the last


def test_absorbed_offsets_are_exactly_other_joint_values() -> None:
    """Turning, sliding and mimic joints."""
    rows = [DHRow(0.1, 0.3, 0.2), DHRow(0.0, 0.5, 0.1, kind="prismatic"), DHRow(0.2, -0.4, 0.0)]
    rows.append(DHRow(0.3, 0.2, 0.1, mimic={"joint_1": -0.5, "joint_3": 1.0}))
    geometry = Geometry.nominal(from_dh(rows), 2)
    geometry, q = geometry.absorb(draw(geometry.size, seed=1, size=0.1)), draw(7, 3, seed=2)
    offsets = torch.tensor([0.2, -0.05, 0.4], dtype=torch.float64)
    assert_close(with_joint_offsets(geometry, offsets).points(q), geometry.points(q + offsets), rtol=0, atol=1e-14)


# --- long chains ------------------------------------------------------------------------------------------------------


def machine(moving: int, slides: tuple[int, ...] = (), *, mimic: bool = False) -> Chain:
    """A chain of many joints with perpendicular neighbouring axes; ``mimic``: joint 4 is -(q2 + q3), as a torso's."""
    rows = []
    for index in range(moving):
        kind = "prismatic" if index in slides else "revolute"
        twist = pi / 2 if index % 2 else -pi / 2
        follows = {"joint_2": -1.0, "joint_3": -1.0} if mimic and index == 3 else None
        rows.append(DHRow(0.05 + 0.03 * (index % 3), twist, 0.25 - 0.02 * index, 0.1 * index, kind, follows))
    return from_dh(rows, name=f"machine of {moving}")


MACHINES = [machine(7, (0, 4)), machine(11, (0,)), machine(11, (0, 6), mimic=True)]


@pytest.mark.parametrize("chain", MACHINES, ids=repr)
def test_long_chains_are_registered_and_identified(chain: Chain) -> None:
    nominal, ranges = Geometry.nominal(chain, 2), torch.where(torch.tensor(chain.periodic), 3.0, 0.45)
    theta = draw(nominal.size, seed=3, size=5e-4)
    theta[:6] = torch.tensor([1.0, -2.0, 0.5, 0.7, -0.4, 1.1])
    theta[nominal.slices["tool"]] = draw(6, seed=3, size=0.1)
    truth, q = nominal.absorb(theta), ranges * (2 * draw(280, chain.n, seed=1).sigmoid() - 1)
    q, test = q[:80], q[80:]
    exact = register(replace(truth, base=torch.eye(4)), q, truth.points(q))
    assert_close((exact.geometry.base, exact.geometry.tool), (truth.base, truth.tool), rtol=0, atol=1e-9)
    start = register(chain, q, truth.points(q))
    found = identify(start.geometry, q, truth.points(q))
    assert start.rms > 5e-4
    error = (found.geometry.points(test) - truth.points(test)).norm(dim=-1)
    assert float(error.max()) < 1e-6
    assert found.noise == pytest.approx(1e-6)  # no finer: noise-free data


# --- campaigns that leave something open ------------------------------------------------------------------------------

TURN = "turn the tool about several axes between the poses"
SPREAD = "spread the poses over the workspace"
MARKER = r"the place of the marker on 'flange' is known to .* mm only: " + TURN
PLANE, LINE, POINT = (f"the measured positions lie near {what}: got" for what in ("a plane", "a line", "one point"))
ALONG = r"the place of the marker on 'flange' along"
NAMED = {
    **dict.fromkeys(("tool never turned", "tool turned by 0.3 degrees", "tool turned by 3 degrees"), (MARKER,)),
    "one joint moves": [ALONG, TURN],
    "tool turned about the vertical": [ALONG + r" \(.*\) is known to .* mm only: " + TURN],
    "plane": [PLANE, ALONG],
    "plane, tool never turned": [MARKER, PLANE],
    "line": ["the turn of the measuring frame is known to .* degrees only: " + SPREAD],
    "line, tool never turned": [MARKER, "the turn of the measuring frame .*" + SPREAD, LINE],
    "small cube": ["the measured positions lie near", "the turn of the measuring frame"],
    "small cube, tool never turned": [MARKER, POINT],
    "two clusters": ["the measured positions lie near", "the turn of the measuring frame about"],
    "one joint at a time": ["moved one at a time in 40 of 40 rows"],
    **dict.fromkeys(
        ("two joints move", "wrist locked", "last joint locked", "elbow up", "a quarter of every range"), ()
    ),
}


def sentences(robot: dc.Chain, data: dc.Measurements) -> list[str]:
    """What is warned about after registration."""
    single = warned(warn_of_single_joints, robot, data)[1]
    return [*single, *warned(warn_of_open_directions, robot, data, register(robot, data.q, data.points))[1]]


def campaign(name: str, kind: str, rows: int, seed: int = 0) -> tuple[SimulatedArm, dc.Measurements]:
    arm, generator = arm_of(kind, seed), torch.Generator().manual_seed(seed)
    return arm, measured(arm, kind, CAMPAIGNS[name](arm, rows, generator), generator)


@pytest.mark.parametrize("degrees", [0.0, 0.003, 0.03, 0.3])
def test_markers_stay_near_the_tip_of_a_tool_that_hardly_turns(degrees: float) -> None:
    # Errors of a millimetre, divided by these turns, are metres.
    arm, generator = SimulatedArm(0), torch.Generator().manual_seed(0)
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


@pytest.mark.parametrize("kind", ["1 marker", "3 markers", "poses"])
@pytest.mark.parametrize("rows", [15, 60])
def test_honest_campaigns_are_not_warned_about(kind: str, rows: int) -> None:
    for seed in range(2):
        arm, data = campaign("everywhere", kind, rows, seed)
        assert sentences(arm.nominal, data) == []


@pytest.mark.parametrize("rows", [[(0.4, 0, 0), (0.3, 0, 0), DOWN], [SLIDE, SLIDE, DOWN]], ids=["scara", "gantry"])
def test_robots_that_cannot_turn_their_tools_are_not_asked_to(rows: Any) -> None:
    robot = dc.from_dh(rows, name="machine")
    q = drawn(30, 3) - 0.5
    points = robot(q)[:, None, :3, 3] + draw(30, 1, 3, seed=1, size=1e-4)
    assert sentences(robot, dc.Measurements(q, points, doubt=False)) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "seed"),
    [
        ("tool never turned", "1 marker", 0),
        ("one joint moves", "1 marker", 0),
        ("tool never turned", "poses", 0),
        ("two clusters", "poses", 1),
    ],
)
def test_predictions_elsewhere_carry_the_deviation_that_they_deserve(name: str, kind: str, seed: int) -> None:
    found = record(name, kind, 15, seed)
    assert found["far_worst"] < 4.0
    assert found["near_worst"] < 4.0
    assert kind == "1 marker" or found["near_claimed_mm"] < 0.2  # rows like the measured ones are known in any case


def test_identification_estimates_the_noise_and_its_own_error() -> None:
    arm = SimulatedArm(seed=2, transmission=0, gravity=0, noise=5e-5)
    q, points = arm.measure(150)
    found = identify(register(arm.nominal, q, points).geometry, q, points)
    assert found.noise == pytest.approx(5e-5, rel=0.1)
    test = arm.sample(400, seed=9)
    slopes = found.geometry.sensitivities(test)
    spread = torch.einsum("npaj,jk,npak->npa", slopes, found.covariance, slopes).sqrt()
    ratio = (found.geometry.points(test) - arm.true_points(test)) / spread
    assert 0.6 < float(ratio.square().mean().sqrt()) < 1.5
    assert bool((found.deviations[6:42] <= Prior().rotation * (1 + 1e-9)).all())  # never vaguer than the prior
    assert found.tails.freedom > 20  # clean data have no tails
    assert found.tails.weights.shape == (150, 1)
    assert 0.5 < float(found.tails.weights.min()) <= float(found.tails.weights.max()) < 1.2


def test_outliers_lose_their_influence() -> None:
    arm = SimulatedArm(seed=2, markers=2, transmission=0, gravity=0, noise=2e-5)
    q, points = arm.measure(80)
    spoilt, bad = points.clone(), [3, 4, 40, 77]
    spoilt[bad, 1] += draw(4, 3, seed=1, size=1e-3)
    start, test = register(arm.nominal, q, points).geometry, arm.sample(300, seed=9)
    clean, found = identify(start, q, points), identify(start, q, spoilt)
    given = identify(start, q, spoilt, noise=2e-5)
    assert float(found.tails.weights[bad, 1].max()) < 0.05
    others = torch.ones(80, 2, dtype=torch.bool)
    others[bad, 1] = False
    assert float(found.tails.weights[others].min()) > 0.15
    assert found.noise == pytest.approx(clean.noise, rel=0.3)
    errors = [rms(each.geometry.points(test) - arm.true_points(test)) for each in (clean, found, given)]
    assert errors[1] < 1.3 * errors[0] < 1.3 * errors[2] / 3
    assert (given.noise, given.prior, given.tails.freedom) == (2e-5, Prior(), inf)
    assert bool((given.tails.weights == 1.0).all())


def test_deviations_of_translations_and_of_rotations_are_found_apart() -> None:
    q, start = ARM.sample(200), Geometry.nominal(ARM.nominal).with_tool(draw(2, 3, seed=1, size=0.1))
    theta = torch.zeros(start.size, dtype=torch.float64)
    theta[start.slices["joints"]] = (draw(6, 6, seed=2) * torch.tensor([1e-4] * 3 + [1e-3] * 3)).flatten()
    prior = identify(start, q, start.points(q, theta) + draw(200, 2, 3, seed=3, size=1e-5)).prior
    assert prior.rotation == pytest.approx(1e-3, rel=0.5)
    assert prior.translation < 4e-4  # it is still falling when the noise has settled


@pytest.mark.parametrize("axes", [3, 6])
def test_the_joints_of_commanded_poses_have_no_errors(axes: int) -> None:
    """They are numbers, not links: what is found is where base and marker are."""
    commanded = flange() if axes == 6 else flange()[:, :3, 3]
    machine = dc.cartesian(commanded)
    geometry = Geometry.nominal(machine).with_tool(tensor([[0.1, 0.0, 0.05]]))
    q = dc.pose_inputs(machine, commanded)
    found = identify(geometry, q, geometry.points(q) + draw(len(q), 1, 3, size=1e-3))
    joints = geometry.slices["joints"]
    assert float(found.theta[joints].abs().max()) == 0.0
    assert float(found.deviations[joints].max()) == 0.0
    assert float(found.deviations[geometry.slices["base"]].min()) > 1e-5
    first = register(machine, q, geometry.points(q)).geometry.tool
    assert_close(first, geometry.tool if axes == 6 else 0.0 * geometry.tool)  # where it sits is in the base
