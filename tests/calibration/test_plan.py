"""Planned poses: the greedy choice against brute force, whether expectations come true; random configurations."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import deformation_bank
import numpy as np
import pytest
import torch
import two_arms_bank
from kind_bank import Kind, kind_named, marked
from numbers_bank import normal, rms, tensor
from product_bank import Case, sliding_robot
from robots_bank import limited
from simulated_camera import BOARD_PRIOR, HEIGHT, WIDTH, camera_arm, fixed_camera_arm, seen_corners
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.planning import plan as planning
from diffeo_calib.calibration.planning.candidates import candidates, collision_free
from diffeo_calib.calibration.planning.sensors import BoardImages, Sensor, sensor_of
from diffeo_calib.cameras.images import Images, sighted
from diffeo_calib.cameras.images import expected as expected_errors
from diffeo_calib.measurements.poses import inverse_poses, poses_from_marks
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.robots import Chain, SimulatedArm
from diffeo_calib.sensors.set_ups import frame_slopes


def by_rank(plan: dc.Plan) -> list[int]:
    return plan.rows[plan.rank.argsort()].tolist()


def brute_force(K: Tensor, R: Tensor, targets: list[int], count: int) -> tuple[list[int], list[float]]:
    """Try every candidate at every step by inverting the whole matrix: rows taken, RMS at the targets."""
    m = R.shape[1]

    def coordinates(rows: list[int]) -> Tensor:
        return torch.tensor([row * m + axis for row in rows for axis in range(m)])

    def variance(rows: list[int]) -> float:
        at, t = coordinates(rows), coordinates(targets)
        inner = K[at][:, at] + torch.block_diag(*R[rows])
        left = K[t][:, t] - K[t][:, at] @ torch.linalg.solve(inner, K[at][:, t])
        return float(left.diagonal().sum()) / (len(targets) * m / 3)

    chosen: list[int] = []
    rms = [float(K[coordinates(targets)][:, coordinates(targets)].diagonal().sum() / (len(targets) * m / 3)) ** 0.5]
    for _ in range(count):
        left = {row: variance([*chosen, row]) for row in range(len(R)) if row not in chosen}
        chosen.append(min(left, key=lambda row: left[row]))
        rms.append(left[chosen[-1]] ** 0.5)
    return chosen, rms


def test_greedy_choice_is_that_of_brute_force_for_a_model(pair: Case) -> None:
    model, q = pair.model, SimulatedArm(seed=1).sample(24, seed=8)
    K = model.map.conditional.covariance_between(model.map.geodesic.linearise(q))
    rows, errors = brute_force(K, model.map.new_noise.expand(len(q), -1, -1), list(range(24)), 5)
    plan = dc.plan(model, q, 5)
    assert by_rank(plan) == rows
    assert_close(plan.expected_rms, tensor(errors), rtol=1e-5, atol=0)


@pytest.mark.parametrize("case", ["pair", "slider", "posed"])
def test_what_is_known_before_is_the_covariance_of_predict(case: str, request: pytest.FixtureRequest) -> None:
    model = request.getfixturevalue(case).model
    limits = model.robot.limits
    q = (model.configurations[:10] + 0.3).clamp(limits[:, 0], limits[:, 1])
    predicted = model.predict_poses if case == "posed" else model.predict
    covariance = predicted(q, noise=False)[1][..., :3, :3].view(10, -1, 3, 3)  # of the markers, or of the origin
    rms = covariance.diagonal(dim1=2, dim2=3).sum(2).mean().sqrt()
    assert_close(dc.plan(model, q, 2).expected_rms[0], rms, rtol=1e-3 if case == "posed" else 1e-6, atol=0)


@pytest.mark.parametrize("free", ["base", "both"])
def test_what_has_moved_is_open_again(arm: Case, free: str) -> None:
    model, q = arm.model, arm.test.q[:10]
    _, covariance = model.predict(q, noise=False)
    by_base = 0.1 * frame_slopes(model(q), model(model.configurations)[:, 0].mean(0))
    added = by_base.square().sum((1, 2)) + (3 * 0.1**2 if free == "both" else 0.0)  # a marker moves like the flange
    rms = (covariance.diagonal(dim1=2, dim2=3).sum((1, 2)) + added).mean().sqrt()
    plan = dc.plan(model, arm.test.q[:60], 12, target=q, free=free)
    assert_close(plan.expected_rms[0], rms, rtol=1e-3, atol=0)
    assert float(plan.expected_rms[-1]) < 2e-4 < float(plan.expected_rms[1])


def test_a_registered_model_knows_what_its_rows_have_told(arm: Case) -> None:
    moved = arm.model.registered(arm.test.rows(slice(0, 15)), free="base", learn=False)
    q = arm.test.q[100:130]
    _, covariance = moved.predict(q, noise=False)
    rms = float(covariance.diagonal(dim1=2, dim2=3).sum(2).mean().sqrt())
    before = float(dc.plan(moved, q, 2).expected_rms[0])
    assert 0.4 * rms < before < 1.05 * rms  # the rows tell of the joints too, which the registration leaves as they are
    assert float(dc.plan(moved, q, 2, free="base").expected_rms[0]) > 0.05
    marker, both = (dc.plan(moved, q, 2, free=free).expected_rms for free in ("marker", "both"))
    assert_close(marker, both, rtol=1e-9, atol=0)  # the base may have moved since the fit anyway


def test_a_plan_can_be_made_in_parts() -> None:
    """What is measured counts like what was planned before."""
    arm = SimulatedArm(seed=1)
    q = arm.sample(200, seed=3)
    whole = dc.plan(arm.nominal, q, 8)
    first = by_rank(whole)[:5]
    rest = dc.plan(arm.nominal, q, 3, measured=q[first])
    assert by_rank(rest) == by_rank(whole)[5:]
    assert_close(rest.expected_rms, whole.expected_rms[5:], rtol=1e-6, atol=0)
    assert whole.assumed
    assert sorted(whole.rank.tolist()) == list(range(1, 9))
    assert torch.equal(whole.q, q[whole.rows])
    moves = torch.cdist(whole.q, whole.q, p=torch.inf)  # the slowest joint decides
    for first, last in combinations(range(9), 2):  # no reversal of a part is a shorter path
        order = [*range(first), *reversed(range(first, last)), *range(last, 8)]
        assert float(moves[order[:-1], order[1:]].sum()) > float(moves.diagonal(1).sum()) - 1e-9
    assert bool((whole.expected_rms.diff() < 0).all())
    assert "8 poses" in str(whole)
    assert "guesses" in str(whole)


def test_expected_errors_are_those_of_the_simulated_arm(arm: Case) -> None:
    """Before and after 20 more planned poses, measured in simulation and fitted."""
    truth = SimulatedArm(seed=1)
    q = truth.sample(600, seed=11)
    plan = dc.plan(arm.model, q, 20)
    new = dc.Measurements(plan.q, truth.true_points(plan.q) + normal(20, 1, 3, size=truth.noise))
    both, scales = dc.Measurements.joined([arm.train, new]), arm.result.selection.scales
    again = dc.calibrate(arm.robot, both, hyperparameters=scales).model
    for model, expected in ((arm.model, plan.expected_rms[0]), (again, plan.expected_rms[-1])):
        assert 0.6 < rms(model(q) - truth.true_points(q)) / float(expected) < 1.4


def test_mistakes_are_one_sentence(arm: Case) -> None:
    robot, model, every = arm.robot, arm.model, arm.train.q

    def planned(of: Any = robot, q: Tensor = every, count: int = 3, **more: Any) -> Callable[[], object]:
        return lambda: dc.plan(of, q, count, **more)

    refused(
        ("`robot_or_model`: expected a robot", planned("robot")),
        ("`candidates`: .*6", planned(q=every[:, :5])),
        ("at most 2, got 3", planned(q=every[:2])),
        ("`target`: .*6", planned(target=[[0.0, 1.0]])),
        ("`measured`: .*not finite", planned(measured=every * torch.nan)),
        ("`marker` has the wrong shape", planned(marker=[1.0, 2.0])),
        ("`free` belongs to a model", planned(free="base")),
        ("`free`: expected None, 'base', 'marker', 'both', got 'tracker'", planned(model, free="tracker")),
        ("`marker` belongs to a robot", planned(model, marker=[0.0, 0.0, 0.1])),
    )


pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
ARM = SimulatedArm(seed=0)
"""That of the bank's readings."""


def naive_rms(result: Any, q: Tensor, taken: list[tuple[int, int]]) -> list[float]:
    """RMS error over q after 0, 1, ... readings (row, device), after a rigid fit: the whole covariance inverted."""
    fitted_map, devices = result.model.map, result.placement[0].devices
    wide = replace(devices, deviations=q.new_tensor(devices.prior()).expand_as(devices.deviations))
    z, at = fitted_map.geodesic.linearised_value(q)
    data = fitted_map.geodesic.linearise(fitted_map.x).projected(fitted_map.slopes)
    shared = fitted_map.noise.shared.flatten(0, 1)
    count = shared.shape[1]
    inner = data.gram() + torch.block_diag(*fitted_map.noise.covariance) + shared @ shared.T
    cross = torch.cat([data.gram(at).T, shared.T])  # coordinates, then shifts
    K = torch.block_diag(at.gram(), torch.eye(count, dtype=q.dtype)) - cross @ torch.linalg.solve(inner, cross.T)
    B = frame_slopes(z[:, None], z.mean(0)).flatten(0, 1)
    P = torch.eye(len(B), dtype=q.dtype) - B @ torch.linalg.pinv(B)

    def rms() -> float:
        return float((P @ K[: len(B), : len(B)] @ P).trace() / len(q)) ** 0.5

    found = [rms()]
    for row, number in taken:
        at, own = z[row : row + 1], torch.tensor([number])
        A, D = wide.observation(own).slope(at)[0], wide.shared(at, own)[0]
        H = torch.zeros(len(A), len(K), dtype=q.dtype)
        H[:, 3 * row : 3 * row + 3], H[:, len(B) :] = A, D
        R = fitted_map.noise.covariance[0]  # all rows are measured alike
        K = K - K @ H.T @ torch.linalg.solve(H @ K @ H.T + R, H @ K)
        found.append(rms())
    return found


@pytest.mark.parametrize("name", marked("distances", "heights", "images"))
def test_devices_of_a_fit_against_the_whole_covariance(name: str) -> None:
    """Where the devices are and what their rows share is read off the map."""
    result = kind_named(name).result
    q = ARM.sample(20, seed=8)
    plan = dc.plan(result.model, q, 5)
    sensors: Any = sensor_of(result.model)
    known = result.placement[0].devices.constants
    told = slice(0, 3 if name == "heights" else None)  # the distance of a plane changes no slope
    found = {name: device.devices.constants for one in sensors for name, device in one.devices.items()}
    own = {name: int((known - constants)[:, told].norm(dim=1).argmin()) for name, constants in found.items()}
    order = plan.rank.argsort()
    taken = [(int(plan.rows[k]), own[plan.devices[k]]) for k in order]
    assert_close(plan.expected_rms, tensor(naive_rms(result, q, taken)), rtol=1e-3, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sensor"), [("images of a board", dc.Sensor.positions()), ("two cameras", dc.Sensor.poses())]
)
def test_a_tracker_beside_cameras_stands_anywhere(name: str, sensor: Any) -> None:
    kind = kind_named(name)
    rms = dc.plan(kind.model, kind.q(60), 12, sensor=sensor).expected_rms
    assert float(rms[1]) > 0.999 * float(rms[0])
    assert float(rms[12]) < 0.95 * float(rms[0])


def test_a_camera_measures_what_it_sees() -> None:
    arm = SimulatedArm(seed=1)
    q = arm.sample(100, seed=8)
    sensor = dc.Sensor.images([[2.0, 0.0, 0.6, 0.5, 0.0, 0.6]])
    plan = dc.plan(arm.nominal, q, 5, sensor=sensor, marker=(0.0, 0.0, 0.1))
    T = arm.nominal(plan.q)
    line = T[:, :3, 3] + 0.1 * T[:, :3, 2] - tensor([2.0, 0.0, 0.6])
    assert bool((-line[:, 0] > 0.87 * line.norm(dim=1)).all())
    with pytest.raises(dc.DiffeoCalibError, match="candidates that can be measured: expected at least 100"):
        dc.plan(arm.nominal, q, 100, sensor=sensor)


@pytest.mark.parametrize("name", marked("heights", "mixture", "two cameras on the tool"))
def test_recalibrated_and_registered_models_plan_for_their_devices(name: str) -> None:
    """The devices under their names; no place on the tool is open that no row of the registration could tell."""
    kind = kind_named(name)
    names = {f"socket {k}" for k in range(1, 9)} | {"positions"}
    names |= {word for own in kind.model.placement for each in own.names for word in (each, f"{own.kind} {each}")}
    before = float(dc.plan(kind.model, kind.q(30), 1).expected_rms[0])
    for model in (kind.recalibrated.model, kind.registered):
        found = dc.plan(model, kind.q(30), 3)
        if model.registration is not None:
            assert float(model.map.new_noise.trace()) >= 0.9 * float(model.registration.noise.trace())
        assert set(found.devices) <= names
        assert float(found.expected_rms[3]) <= float(found.expected_rms[0]) < 2.5 * before


@pytest.mark.slow
def test_poses_of_a_ball_in_sockets() -> None:
    kind = kind_named("ball in sockets")
    (placed,), sensors = kind.model.placement, sensor_of(kind.model)
    places: Any = torch.cat([one.reached(kind.model.geometry.base)["places"] for one in sensors])
    ball = kind.model.geometry.tool[-1]
    q = dc.candidates(kind.robot, 40, places=places, ball=ball)
    T = kind.robot(q)
    points = T[:, :3, :3] @ ball + T[:, :3, 3]
    assert_close(points, places[torch.cdist(points, places).argmin(1)], rtol=0, atol=1e-4)
    plan = dc.plan(kind.model, q, 6)
    assert set(plan.devices) <= set(placed.names)
    assert float(plan.expected_rms[6]) < float(plan.expected_rms[0])
    new = dc.plan(kind.model, q, 6, sensor=dc.Sensor.sockets(places))
    assert float(new.expected_rms[6]) > float(plan.expected_rms[6])
    with pytest.raises(dc.DiffeoCalibError, match="candidates that can be measured"):
        dc.plan(kind.model, kind.q(40), 6)


def test_two_tips_are_planned_together(tmp_path: Path) -> None:
    robot, up = two_arms_bank.robot(tmp_path), dc.Tracker((0.0, 0.0, 8.0), half_angle=2.0)
    q = dc.candidates(robot, 60, tracker=up, floor=0.1)
    still = q.clone()
    still[:, 3:] = 0.3  # the right arm

    def rms(rows: Tensor, count: int = 8, **how: Any) -> float:
        return float(dc.plan(robot, rows, 8, target=q, **how).expected_rms[count])

    assert rms(q) != rms(q, marker={"left": (0.1, 0.0, 0.1)})
    assert rms(q) < 0.7 * rms(still)
    assert rms(q, sensor=dc.Sensor.poses()) < rms(q, 4, sensor=dc.Sensor.poses())


@pytest.mark.slow
def test_payload_of_the_plan() -> None:
    kind = kind_named("payloads")
    none, heavy = (dc.plan(kind.model.with_payload(mass), kind.q(30), 4) for mass in (0.0, 4.0))
    assert (none.payload, heavy.payload) == (0.0, 4.0)
    assert float(none.expected_rms[0]) != float(heavy.expected_rms[0])


def test_mistakes_about_sensors_are_one_sentence(arm: Any) -> None:
    q, tracker = arm.train.q, dc.Sensor.positions()
    found = dc.Sensor.distances([[5.0, 0.0, 0.0]], 1e-5)
    assert len(dc.plan(arm.model, q, 3, sensor=found)) == 3
    assert dc.plan(arm.model, q, 2, sensor=dc.Sensor.positions(1e-4)).noise_rms == pytest.approx(3**0.5 * 1e-4)

    def planned(sensor: Any, **more: Any) -> Callable[[], object]:
        return lambda: dc.plan(arm.model, q, 3, sensor=sensor, **more)

    refused(
        ("`sensor`: expected a dc.Sensor", planned("tracker")),
        ("poses of a robot that is known by markers", planned(dc.Sensor.poses())),
        ("`measured`: expected configurations that one device", planned([tracker, found], measured=q[:2])),
        ("NX,NY,NZ,D", lambda: dc.Sensor.heights([[0.0, 0.0, 1.0]])),
        ("with a direction", lambda: dc.Sensor.heights([[0.0, 0.0, 0.0, 1.0]])),
        ("`std` of a sensor", lambda: dc.Sensor.positions(-1.0)),
    )


# --- images of a board ------------------------------------------------------------------------------------------------


FEWEST = 4


def cameras(kind: Kind) -> list[Any]:
    return [one for one in sensor_of(kind.model) if isinstance(one, BoardImages)]


@cache
def drawn(kind: str) -> Tensor:
    """Half of them where a camera sees the board, half anywhere."""
    model, q = kind_named(kind).model, []
    for one in cameras(kind_named(kind)):
        q.append(candidates(model.robot, 40, **one.reached(model.geometry.base)))
    return torch.cat([*q, candidates(model.robot, 40)])


def corners_in_truth(q: Tensor, arm: Any, *, on_tool: bool) -> Tensor:
    """(N,) corners of the real board that the real camera sees from its front."""
    poses = poses_from_marks(arm.arm.true_points(q), LEVER)
    boards = inverse_poses(poses) if on_tool else poses
    from_above = inverse_poses(boards)[:, 2, 3] > 0
    return (~seen_corners(boards, 0.0, camera=arm.camera)[..., 3].isnan()).sum(1) * from_above * (boards[:, 2, 3] > 0)


SEEN: dict[str, tuple[Any, tuple[str, ...]]] = {
    "images of a board": (lambda second: camera_arm(60), ("camera",)),
    "two cameras": (lambda second: fixed_camera_arm(70, second=second), ("left", "right")),
    "two cameras on the tool": (lambda second: camera_arm(70, second=second), ("left", "right")),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEN)
def test_the_camera_sees_the_board_in_the_poses_that_are_planned_for_it(name: str) -> None:
    model, (arm_of, names) = kind_named(name).model, SEEN[name]
    arms = {own: arm_of(own == "right") for own in names}
    plan = dc.plan(model, drawn(name), 12)
    for own, q in zip(plan.devices or 12 * names, plan.q, strict=True):
        assert int(corners_in_truth(q[None], arms[own], on_tool=name != "two cameras")) >= FEWEST
    last = cameras(kind_named(name))[-1]
    alone = dc.plan(model, drawn(name), 6, sensor=last)
    assert int(corners_in_truth(alone.q, arms[last.name or names[-1]], on_tool=name != "two cameras").min()) >= FEWEST


@pytest.mark.slow
def test_an_image_tells_what_its_pose_shows() -> None:
    """Against poses and effects that are found from corners."""
    arm = camera_arm(60)
    corners = arm.shown(0.1)[1]
    whole = (~corners[..., 3].isnan()).all(1)
    found = sighted(Images(corners[whole, :, :3], corners[whole, :, 3:], WIDTH, HEIGHT), None, BOARD_PRIOR)
    covariance, effects = expected_errors(found.camera, found.poses)
    ratio = covariance.diagonal(dim1=1, dim2=2) / found.covariance.diagonal(dim1=1, dim2=2)
    assert 0.6 < float(ratio.median()) < 1.6  # an image's noise is its own
    assert_close(effects @ found.camera.root, found.shared, rtol=0, atol=0.02 * float(found.shared.abs().max()))


# --- random configurations respect everything that is asked -----------------------------------------------------------


@pytest.fixture(scope="module")
def robot() -> Chain:
    return SimulatedArm(seed=1).nominal


def test_joints_stay_within_their_limits_and_one_turn() -> None:
    inf, pi = math.inf, math.pi
    limits = [(-1.0, 2.0), (-6.5, 6.5), (-inf, inf), (1.0, 9.0), (-9.0, -1.0), (0.1, 0.4)]
    kinds = ["revolute", "revolute", "continuous", "revolute", "revolute", "prismatic"]
    robot = limited(*((kind, *ends) for kind, ends in zip(kinds, limits, strict=True)))
    q = dc.candidates(robot, 4000)
    ends = [(-1.0, 2.0), (-pi, pi), (-pi, pi), (1.0, 1.0 + 2 * pi), (-1.0 - 2 * pi, -1.0), (0.1, 0.4)]
    lower, upper = tensor(ends).unbind(1)
    assert q.shape == (4000, 6)
    assert bool(((q >= lower) & (q <= upper)).all())
    near = 0.01 * (upper - lower)  # uniform: 4000 draws come near both ends
    assert bool(((q.amin(0) < lower + near) & (q.amax(0) > upper - near)).all())
    narrow = dc.candidates(robot, 100, ranges={"j1": (-6.0, -5.0), "j5": (0.2, 0.2)})
    assert bool(((narrow[:, 1] >= -6) & (narrow[:, 1] <= -5) & (narrow[:, 5] == 0.2)).all())


def test_the_device_sees_the_marker(robot: Chain) -> None:
    position, marker, direction = np.array([2.0, 1.0, 0.5]), np.array([0.05, 0.0, 0.1]), np.array([0.0, 3.0, 4.0])
    tracker = dc.Tracker(position.tolist(), marker.tolist(), direction.tolist(), half_angle=math.radians(30))
    tips = robot(dc.candidates(robot, 300, tracker=tracker)).numpy()
    lines, looks = position - (tips @ [*marker, 1.0])[:, :3], tips[:, :3, :3] @ direction
    angles = np.arccos((lines * looks).sum(1) / np.linalg.norm(lines, axis=1) / np.linalg.norm(looks, axis=1))
    assert 29 < np.degrees(angles).max() <= 30


def test_links_and_tool_stay_above_the_floor_and_outside_the_column(robot: Chain) -> None:
    tool, tracker = tensor([0.0, 0.0, 0.2, 1.0]), dc.Tracker((9.0, 0.0, 0.0), (0, 0, 0.2))
    q = dc.candidates(robot, 300, tracker=tracker, floor=0.1, column=(0.4, 0.0, 0.15))
    frames, tip = robot.joint_frames(q), robot(q)
    ends = torch.cat([frames[:, 1:, :3, 3], tip[:, None, :3, 3], (tip @ tool)[:, None, :3]], 1)
    assert float(ends[..., 2].min()) >= 0.1
    for share in torch.linspace(0, 1, 9, dtype=torch.float64):
        away = ends[:, :-1] + share * (ends[:, 1:] - ends[:, :-1]) - tensor([0.4, 0.0, 0.0])
        assert float(away[..., :2].norm(dim=2).min()) >= 0.15 - 1e-12
    below = dc.candidates(robot, 300, column=(0.4, 0.0, 0.15, 0.3))
    inside = ((robot(below)[:, :2, 3] - torch.tensor([0.4, 0.0])).norm(dim=1) < 0.15).nonzero()[:, 0]
    assert len(inside)  # above its top
    assert float(robot(below)[inside, 2, 3].min()) >= 0.3


def test_draws_follow_the_seed_and_the_user_s_own_check(robot: Chain) -> None:
    first = dc.candidates(robot, 10)
    assert torch.equal(first, dc.candidates(robot, 10, seed=0))
    assert torch.equal(first, dc.candidates(robot, 5000)[:10])
    assert not torch.equal(first, dc.candidates(robot, 10, seed=1))
    kept = dc.candidates(robot, 100, keep=lambda q: (q[:, 0] > 0.5).numpy())
    assert kept.shape == (100, 6)
    assert float(kept[:, 0].min()) > 0.5


def test_what_refuses_everything_is_named(robot: Chain, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffeo_calib.calibration.planning.candidates.FIRST_DRAWS", 10_000)
    tracker, narrow = (dc.Tracker((3.0, 0.0, 0.5), half_angle=angle) for angle in (math.radians(30), 0.01))
    refused(
        (
            r"^`floor` refuses nearly everything: 0 of .* random.*`tracker` refuses 9",
            lambda: dc.candidates(robot, 5, tracker=tracker, floor=5.0),
        ),
        ("^`keep` refuses", lambda: dc.candidates(robot, 5, keep=lambda q: q[:, 0] > 100.0, tracker=tracker)),
        (r"^`tracker` refuses .*: \d+ of", lambda: dc.candidates(robot, 500, tracker=narrow, floor=0.0)),
    )


def test_what_cannot_be_drawn_is_one_sentence(robot: Chain) -> None:
    def drawn(count: int = 3, **options: Any) -> Callable[[], object]:
        return lambda: dc.candidates(robot, count, **options)

    refused(
        ("`count`", drawn(0)),
        (r"`ranges` names \['elbow'\]: expected joints of the robot", drawn(ranges={"elbow": (0, 1)})),
        ("lower <= upper", drawn(ranges={"waist_joint": (1.0, 0.0)})),
        ("joint_1", drawn(ranges={"joint_1": 1.0})),
        ("dc.Tracker, got tuple", drawn(tracker=(1.0, 0.0, 0.0))),
        (r"a function \(N, n\) -> \(N,\)", drawn(keep=True)),
        ("booleans, one per row", drawn(keep=lambda q: True)),
        ("booleans, one per row", drawn(keep=lambda q: q[:, 0])),
        ("`column`", drawn(column=(1.0, 2.0))),
        ("radius of `column`", drawn(column=(1.0, 2.0, -0.1))),
        ("`floor`", drawn(floor="low")),
        ("`seed`", drawn(seed=-1)),
        ("`direction` of the tracker", lambda: dc.Tracker((1, 0, 0), direction=(0, 0, 0))),
        ("`half_angle` of the tracker", lambda: dc.Tracker((1, 0, 0), half_angle=4.0)),
        ("joint 'slide' has no limits.*--range slide=LOWER:UPPER", lambda: dc.candidates(sliding_robot(), 3)),
        (r"a dc\.Tree", lambda: dc.candidates("robot", 3)),  # pyright: ignore[reportArgumentType]
    )


def test_slides_without_limits_stay_where_they_were_measured() -> None:
    model = deformation_bank.model_of(sliding_robot(), dc.RK4(1))
    q = planning.drawn(model, [Sensor.positions()], 9, torch.zeros(1, 3))
    measured = model.configurations[:, 2]
    more = 0.5 * (measured.max() - measured.min())
    assert bool(((q[:, 2] > measured.min() - more) & (q[:, 2] < measured.max() + more)).all())


BAR = """<link name="{child}"><collision><origin xyz="0.2 0 0" rpy="0 1.5707963 0"/>
<geometry><cylinder radius="0.03" length="0.3"/></geometry></collision></link>
<joint name="j{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>"""


def test_bodies_of_the_urdf_collide(robot: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three bars of 0.4 m in a plane; the second joint turns without end."""
    pytest.importorskip("pinocchio")
    bars = (("base", "one", "revolute", 0), ("one", "two", "continuous", 0.4), ("two", "three", "revolute", 0.4))
    text = "".join(BAR.format(parent=parent, child=child, kind=kind, x=x) for parent, child, kind, x in bars)
    (tmp_path / "folding.urdf").write_text(f'<robot name="folding"><link name="base"/>{text}</robot>')
    folding = dc.load_urdf(tmp_path / "folding.urdf", "base", "three")
    keep = collision_free(folding)
    q = tensor([[0.3, 0.0, 0.0], [0.0, 2.1, 2.1], [1.0, -2.1, -2.1], [0.0, 2.1, -2.1]])
    assert keep(q).tolist() == [True, False, False, True]  # a triangle closes, a zigzag does not
    found = dc.candidates(folding, 200, keep=keep)
    assert bool(keep(found).all())
    refused(
        ("has no collision geometry", lambda: collision_free(robot)),
        ("was not read from a URDF", lambda: collision_free(sliding_robot())),
    )
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    refused((r"not installed; pip install .diffeo_calib\[collisions\]", lambda: collision_free(folding)))
