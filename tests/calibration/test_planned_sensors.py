"""Planned poses for what will measure: expected errors against a second implementation, and whether they come true."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import reading_bank
import torch
import two_arms_bank
from kind_bank import kind_named, marked, rigid_rms
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.planning.candidates import Tracker
from diffeo_calib.calibration.planning.knowledge import of_model
from diffeo_calib.calibration.planning.plan import drawn
from diffeo_calib.calibration.planning.sensors import DeviceReadings
from diffeo_calib.calibration.planning.sensors_of_model import sensor_of
from diffeo_calib.regression.rigid_motions import WithoutRigidMotions
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.sensors.set_ups import frame_slopes

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
STEP = 1e-6
ARM = SimulatedArm(seed=0)
"""That of the bank's readings."""
NEW = {
    "distance": dc.Sensor.distances(reading_bank.POINTS),
    "height": dc.Sensor.heights([[0.0, 0.0, 2.0, 0.1], [0.8, 0.0, 0.6, 0.3], [0.0, 1.0, 0.0, 0.2]]),
    "image": dc.Sensor.images([[*eye, 0.0, 0.0, 0.4] for eye in reading_bank.EYES.tolist()]),
}


def fitted(kind: str) -> Any:
    return kind_named(f"{kind}s").result


def slopes_of(devices: Any, number: int, z: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of a reading by the point and by all increments of unit prior, by central differences."""

    def read(point: Tensor, increments: Tensor) -> Tensor:
        moved = devices.moved(increments.view(len(devices.names), -1) * devices.deviations)
        return moved.observation(torch.tensor([number])).value(point[None])[0]

    none = z.new_zeros(devices.freedom)

    def differences(values: Tensor, of: Any) -> Tensor:
        unit = STEP * torch.eye(len(values), dtype=z.dtype)
        return torch.stack([(of(values + h) - of(values - h)) / (2 * STEP) for h in unit], 1)

    return differences(z, lambda point: read(point, none)), differences(none, lambda shifts: read(z, shifts))


def naive_rms(result: Any, q: Tensor, taken: list[tuple[int, int]]) -> list[float]:
    """RMS error over q after 0, 1, ... readings (row, device), after a rigid fit: the whole covariance inverted."""
    fitted_map, devices = result.model.map, result.placement[0].devices
    conditional = fitted_map.conditional
    assert isinstance(conditional, WithoutRigidMotions)
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
        A, D = slopes_of(devices, number, z[row])
        H = torch.zeros(len(A), len(K), dtype=q.dtype)
        H[:, 3 * row : 3 * row + 3], H[:, len(B) :] = A, D
        R = fitted_map.noise.covariance[0]  # all rows are measured alike
        K = K - K @ H.T @ torch.linalg.solve(H @ K @ H.T + R, H @ K)
        found.append(rms())
    return found


@pytest.mark.parametrize("kind", ["distance", "height", "image"])
def test_devices_of_a_fit_against_the_whole_covariance(kind: str) -> None:
    """Where the devices are and what their rows share is read off the map."""
    result = fitted(kind)
    q = ARM.sample(20, seed=8)
    plan = dc.plan(result.model, q, 5)
    sensors: Any = sensor_of(result.model)
    known = result.placement[0].devices.constants
    told = slice(0, 3 if kind == "height" else None)  # the distance of a plane changes no slope
    own = {one.devices.names[0]: int((known - one.devices.constants)[:, told].norm(dim=1).argmin()) for one in sensors}
    order = plan.rank.argsort()
    taken = [(int(plan.rows[k]), own[plan.devices[k]]) for k in order]
    expected = torch.tensor(naive_rms(result, q, taken), dtype=torch.float64)
    torch.testing.assert_close(plan.expected_rms, expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize("kind", ["distance", "height", "image"])
def test_planned_rows_beat_random_rows_for_the_same_devices(kind: str) -> None:
    model, q = fitted(kind).model, ARM.sample(150, seed=8)
    sensor = NEW[kind]
    best = float(dc.plan(model, q, 12, target=q, sensor=sensor).expected_rms[-1])
    random = [float(dc.plan(model, q[k : k + 12], 12, target=q, sensor=sensor).expected_rms[-1]) for k in (0, 30, 60)]
    assert best < min(random)
    tracker = dc.plan(model, q, 12, target=q, sensor=dc.Sensor.positions())
    assert float(tracker.expected_rms[-1]) < best
    assert tracker.devices == ()


ANYWHERE = [
    ("distances", dc.Sensor.positions(), 0.6),
    pytest.param("images of a board", dc.Sensor.positions(), 0.95, marks=pytest.mark.slow),
    pytest.param("two cameras", dc.Sensor.poses(), 0.95, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "sensor", "most"), ANYWHERE)
def test_a_tracker_that_measured_no_row_of_the_fit_stands_anywhere(name: str, sensor: Any, most: float) -> None:
    """Its first rows say where it stands; nothing was known about that."""
    kind = kind_named(name)
    rms = dc.plan(kind.model, kind.q(60), 12, sensor=sensor).expected_rms
    assert float(rms[1]) > 0.999 * float(rms[0])
    assert float(rms[12]) < most * float(rms[0])


@pytest.mark.parametrize("kind", ["distance", "height", "image"])
def test_first_poses_for_devices(kind: str) -> None:
    arm = SimulatedArm(seed=1)
    plan = dc.plan(arm.nominal, arm.sample(100, seed=8), 30, sensor=NEW[kind])
    assert set(plan.devices) <= {f"{kind} {number}" for number in (1, 2, 3)}
    assert len(set(plan.rows.tolist())) == 30
    assert float(plan.expected_rms[30]) < 2e-3 < float(plan.expected_rms[5])
    assert float(dc.plan(arm.nominal, arm.sample(100, seed=8), 30).expected_rms[30]) < float(plan.expected_rms[30])


def test_a_camera_measures_what_it_sees() -> None:
    arm = SimulatedArm(seed=1)
    q = arm.sample(100, seed=8)
    sensor = dc.Sensor.images([[2.0, 0.0, 0.6, 0.5, 0.0, 0.6]])
    plan = dc.plan(arm.nominal, q, 5, sensor=sensor, marker=(0.0, 0.0, 0.1))
    T = arm.nominal(plan.q)
    line = T[:, :3, 3] + 0.1 * T[:, :3, 2] - torch.tensor([2.0, 0.0, 0.6], dtype=torch.float64)
    assert bool((-line[:, 0] > 0.87 * line.norm(dim=1)).all())
    with pytest.raises(dc.DiffeoCalibError, match="candidates that can be measured: expected at least 100"):
        dc.plan(arm.nominal, q, 100, sensor=sensor)


def test_expected_errors_of_distances_come_true() -> None:
    """15 more planned distances to the same fixed points, measured in simulation and fitted."""
    result, q = fitted("distance"), ARM.sample(300, seed=11)
    plan = dc.plan(result.model, q, 15)
    devices: Any = result.placement[0].devices
    sensors: Any = sensor_of(result.model)
    where = {one.devices.names[0]: one.devices.constants[0, :3] for one in sensors}
    numbers = [int((devices.constants[:, :3] - where[name]).norm(dim=1).argmin()) for name in plan.devices]
    names = [devices.names[number] for number in numbers]
    which = torch.tensor([int(name.split()[1]) for name in names])
    lengths = (reading_bank.in_base(ARM, plan.q) - reading_bank.POINTS[which]).norm(dim=1)
    new = dc.Readings.distances(plan.q, lengths, names, ARM.nominal.joint_names)
    both = dc.Readings.joined([kind_named("distances").data, new])
    again = dc.calibrate(ARM.nominal, both, hyperparameters=reading_bank.scales()).model
    for model, expected in ((result.model, plan.expected_rms[0]), (again, plan.expected_rms[-1])):
        assert 0.4 < rigid_rms(model(q).detach(), ARM.true_points(q)) / float(expected) < 1.6


@pytest.mark.parametrize("name", marked("heights", "images and a tracker", "several kinds", "inclinations"))
def test_devices_of_a_fit_have_the_noise_of_their_rows(name: str) -> None:
    """Not that of rows of another kind: of images of a board, in which its origin is uncertain by a millimetre."""
    model = kind_named(name).model
    noise, start = model.map.noise, of_model(model, model.configurations, None)
    sensors: Any = {own.devices.names: own for own in sensor_of(model) if isinstance(own, DeviceReadings)}
    placed = [(own, k, word) for own in model.placement if own.devices is not None for k, word in enumerate(own.names)]
    assert len(sensors) == len(placed)
    for own, number, word in placed:
        rows = own.rows[own.device == number]
        (sensor,) = (one for (key,), one in sensors.items() if key in (word, f"{own.kind} {word}"))
        seen = noise.visible[rows[0]]
        known = noise.covariance[rows][:, seen][:, :, seen].diagonal(dim1=1, dim2=2).mean().sqrt()
        planned = sensor.options(start.scene).noise.diagonal(dim1=1, dim2=2).mean().sqrt()
        assert 0.8 < float(planned / known) < 1.25


AGAIN = ("heights", "distances", "images", "mixture", "several kinds", "two cameras", "two cameras on the tool")


@pytest.mark.parametrize("name", marked(*AGAIN))
def test_recalibrated_and_registered_models_plan_for_their_devices(name: str) -> None:
    """The devices under their names; no place on the tool is open that no row of the registration could tell."""
    kind = kind_named(name)
    names = {f"socket {k}" for k in range(1, 9)} | {"positions"}
    names |= {word for own in kind.model.placement for each in own.names for word in (each, f"{own.kind} {each}")}
    before = float(dc.plan(kind.model, kind.q(30), 1).expected_rms[0])
    for model in (dc.recalibrate(kind.model, kind.new).model, kind.model.registered(kind.new)):
        found = dc.plan(model, kind.q(30), 3)
        assert set(found.devices) <= names
        assert float(found.expected_rms[3]) <= float(found.expected_rms[0]) < 2.5 * before


def test_noise_of_a_stated_deviation(arm: Any) -> None:
    found = dc.plan(arm.model, arm.train.q, 2, sensor=dc.Sensor.positions(1e-4))
    assert found.noise_rms == pytest.approx(3**0.5 * 1e-4)


def test_poses_of_a_ball_in_sockets() -> None:
    kind = kind_named("ball in sockets")
    (sensor,) = sensor_of(kind.model)
    places, ball = sensor.places_in(kind.model.geometry.base), kind.model.geometry.tool[-1]
    assert places is not None
    q = dc.candidates(kind.robot, 40, places=places, ball=ball)
    T = kind.robot(q)
    points = T[:, :3, :3] @ ball + T[:, :3, 3]
    torch.testing.assert_close(points, places[torch.cdist(points, places).argmin(1)], rtol=0, atol=1e-4)
    plan = dc.plan(kind.model, q, 6)
    assert set(plan.devices) <= {f"socket {k}" for k in range(1, len(places) + 1)}
    assert float(plan.expected_rms[6]) < float(plan.expected_rms[0])
    new = dc.plan(kind.model, q, 6, sensor=dc.Sensor.sockets(places))
    assert float(new.expected_rms[6]) > float(plan.expected_rms[6])
    with pytest.raises(dc.DiffeoCalibError, match="candidates that can be measured"):
        dc.plan(kind.model, kind.q(40), 6)


def test_two_tips_are_planned_together(tmp_path: Path) -> None:
    robot = two_arms_bank.robot(tmp_path)
    q = dc.candidates(
        robot, 60, tracker=dc.Tracker((0.0, 0.0, 8.0), direction=(0.0, 0.0, 1.0), half_angle=2.0), floor=0.1
    )
    both = dc.plan(robot, q, 8)
    left = dc.plan(robot, q, 8, marker={"left": (0.1, 0.0, 0.1)})
    assert float(both.expected_rms[8]) != float(left.expected_rms[8])
    still = q.clone()
    still[:, 3:] = 0.3  # the right arm
    moved, held = (float(dc.plan(robot, rows, 8, target=q).expected_rms[8]) for rows in (q, still))
    assert moved < 0.7 * held
    posed = dc.plan(robot, q, 8, sensor=dc.Sensor.poses())
    assert float(posed.expected_rms[8]) < float(posed.expected_rms[4])


def test_payload_of_the_plan() -> None:
    model = kind_named("payloads").model
    q = kind_named("payloads").q(30)
    plans = [dc.plan(model.with_payload(mass), q, 4) for mass in (0.0, 4.0)]
    assert [plan.payload for plan in plans] == [0.0, 4.0]
    assert float(plans[0].expected_rms[0]) != float(plans[1].expected_rms[0])


def test_mistakes_about_sensors_are_one_sentence(arm: Any) -> None:
    q, tracker = arm.train.q, dc.Sensor.positions()
    found = dc.Sensor.distances([[5.0, 0.0, 0.0]], 1e-5)
    assert len(dc.plan(arm.model, q, 3, sensor=found)) == 3

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


def test_sensors_share_the_configurations_that_are_drawn() -> None:
    """Half of them bring the ball to its sockets; those of the tracker show it the marker; all keep their ranges."""
    robot, markers = SimulatedArm(0).nominal, torch.tensor([[0.0, 0.1, 0.1], [0.05, 0.0, 0.1]], dtype=torch.float64)
    places = torch.tensor([[0.6, 0.1, 0.4], [0.5, -0.3, 0.5]], dtype=torch.float64)
    sensors, first = [dc.Sensor.positions(), dc.Sensor.sockets(places)], robot.joint_names[0]
    how: dict[str, Any] = {"ranges": {first: (-1.0, 1.0)}, "keep": lambda q: q[:, 1] > -0.5, "seed": 3}
    q = drawn(robot, sensors, 20, markers, **how)
    assert len(q) == 20
    assert bool((q[:, 0].abs() <= 1.0).all())
    assert bool((q[:, 1] > -0.5).all())
    tips = robot.tip_poses(q)[:, 0]
    ball = tips[:, :3, :3] @ markers[-1] + tips[:, :3, 3]
    near = torch.cdist(ball, places).amin(1) < 1e-3
    assert near.tolist() == [False] * 10 + [True] * 10
    tracker = Tracker((3.0, 0.0, 1.0))
    tips = robot.tip_poses(drawn(robot, sensors[:1], 20, markers, tracker=tracker, **how))[:, 0]
    line = torch.tensor(tracker.position, dtype=torch.float64) - (tips[:, :3, :3] @ markers.mean(0) + tips[:, :3, 3])
    assert bool(((line * tips[:, :3, 2]).sum(1) >= 0.7 * line.norm(dim=1)).all())
