"""Laws of devices of every kind, those of scripts/examples too, and of set-ups: exact readings, slopes, carrying."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from inclinometer import AXES, Inclinometers
from laser_line import DIRECTIONS, POINTS, Beams
from math_bank import normal
from product_bank import Case
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.bodies import triple
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.robots.se3 import rotation, transforms, twist_transform
from diffeo_calib.sensors.coordinates import SENSORS, placed
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.height import Planes
from diffeo_calib.sensors.image import Cameras
from diffeo_calib.sensors.kinds import stored_devices
from diffeo_calib.sensors.range import FixedPoints
from diffeo_calib.sensors.set_ups import MeasuringFrames, MountedFrames, MountedMarkers, SetUps
from diffeo_calib.sensors.tool_frames import Contacts, HeldTools, SocketPlaces, Trackers

ROWS, STEP = 60, 1e-6


def frames(count: int, seed: int, size: float = 0.4) -> Tensor:
    return transforms(rotation(size * normal(count, 3, seed=seed)), size * normal(count, 3, seed=seed + 1))


HELD = frames(2, 21)
FAR = torch.tensor([[0.1, 0.2, 4.0], [0.3, -0.2, 5.0]], dtype=torch.float64)
KINDS: dict[type[Devices], Tensor] = {
    FixedPoints: torch.tensor([[2.0, 0.5, 0.1, 0.0], [-1.0, 2.0, 0.4, 0.0]], dtype=torch.float64),
    Planes: torch.cat([normalize(normal(2, 3, seed=4), dim=1), normal(2, 1, seed=5)], 1),
    Cameras: torch.cat([transforms(rotation(0.4 * normal(2, 3, seed=5)), FAR)[:, :3].flatten(1), FAR[:, 2:]], 1),
    SocketPlaces: normal(2, 3, seed=6),
    Beams: torch.cat([POINTS, normalize(DIRECTIONS, dim=1)], 1),
    Trackers: torch.cat([frames(2, 7)[:, :3].flatten(1), 0.1 * normal(2, 3, seed=8)], 1),
    Contacts: torch.cat([normal(2, 3, seed=9), 0.1 * normal(2, 3, seed=10)], 1),
    HeldTools: HELD[:, :3].flatten(1),
    Inclinometers: Inclinometers.stated(torch.cat([AXES.flatten(), torch.tensor([0.1, -0.2, 1.0])]).expand(2, -1)),
}
"""Two devices of each kind."""
TOLD = {Cameras: slice(12), Beams: slice(3, None), Inclinometers: slice(0)}
"""What readings tell: no mean depth, no point along a beam; axes turned by half a turn may read the same."""


def exact(kind: type[Devices]) -> tuple[Devices, Readings, Tensor]:
    """Two devices, their readings without errors, and the coordinates (N, 3 k) that they saw, m."""
    names, device = ("left", "right"), torch.arange(ROWS) % 2
    there = kind(names, KINDS[kind], torch.full((2, kind.increments_each), 0.1, dtype=torch.float64))
    points = 0.5 * normal(ROWS, 3, seed=2)
    if kind.seen_points > 1:
        bodies = frames(ROWS, 11)
        several = [bodies, bodies @ HELD[device]][: kind.seen_points // 3]
        points = torch.cat([mark_points(own, LEVER) for own in several], 1).flatten(1)
    values = there.observation(device).value(points) / there.metres[device][:, None]
    return there, Readings(kind.kind, normal(ROWS, 2), values, device, names), points


@pytest.mark.parametrize("kind", KINDS)
def test_exact_readings_find_both_devices(kind: type[Devices]) -> None:
    there, data, points = exact(kind)
    start = kind.at(data, points)
    assert float(start.errors(data, points).abs().max()) < 1e-6  # in closed form
    found = start.refined(data, points)
    assert float(found.errors(data, points).abs().max()) < 1e-9
    same = TOLD.get(kind, slice(None))
    assert_close(found.constants[:, same].abs(), there.constants[:, same].abs(), rtol=0, atol=1e-7)
    rough = replace(data, values=data.values + 1e-3 * normal(*data.values.shape, seed=17))
    again = kind.at(rough, points).refined(data, points)  # increments lead from wherever readings with errors start
    assert float(again.errors(data, points).abs().max()) < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_slopes_are_derivatives(kind: type[Devices]) -> None:
    """By points and by increments, which are shared by the rows of a device."""
    there, data, points = exact(kind)
    number = data.device
    step, shift = normal(*there.deviations.shape, seed=12), normal(*points.shape, seed=13)
    if kind.seen_points > 1:  # frames stay frames
        shift = torch.linalg.cross(
            normal(ROWS, 1, 3, seed=14).expand(-1, kind.seen_points, -1), points.view(ROWS, -1, 3)
        )
        shift = shift.flatten(1)

    def change(read: Any) -> Tensor:
        return (read(STEP) - read(-STEP)) / (2 * STEP)

    seen = there.observation(number)
    expected = change(lambda h: seen.value(points + h * shift))
    assert_close((seen.slope(points) @ shift[..., None])[..., 0], expected, rtol=1e-6, atol=1e-8)
    expected = change(
        lambda h: there.shifted((h * step / there.deviations).flatten()).observation(number).value(points)
    )
    assert_close(
        (there.by_increments(points, number) @ step[number][..., None])[..., 0], expected, rtol=1e-6, atol=1e-8
    )
    assert_close(there.shared(points, number) @ (step / there.deviations).flatten(), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_carried_devices_read_of_moved_points_what_they_read(kind: type[Devices]) -> None:
    there, data, points = exact(kind)
    T = transforms(rotation(normal(3, seed=15)), normal(3, seed=16))
    before = points.unflatten(1, (-1, 3))
    after = before @ T[:3, :3].mT + T[:3, 3]
    other = replace(there, constants=there.carried(T, before, after, torch.zeros(1, 3, dtype=T.dtype)))
    errors = other.values(data) - other.observation(data.device).value(other.points_of(after))
    along_axes = kind in (SocketPlaces, Contacts)
    turned = data.values @ T[:3, :3].mT - data.values if along_axes else 0.0
    assert_close(errors + turned, torch.zeros_like(errors), rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_sets_of_devices_are_taken_apart_joined_and_written(kind: type[Devices]) -> None:
    there, data, _ = exact(kind)
    there = replace(there, rows=torch.arange(ROWS), device=data.device)
    first, second = (there.only([name]) for name in there.names)
    assert torch.equal(second.rows, (data.device == 1).nonzero()[:, 0])
    both = first.beside(second)
    assert both.names == there.names
    assert torch.equal(both.constants, there.constants)
    assert torch.equal(both.device[both.rows.argsort()], data.device)
    assert both.beside(first).stored() == both.stored()
    assert stored_devices(there.stored(), ROWS).stored() == there.stored()
    assert len(there.sentences()) == 2


@pytest.mark.parametrize("kind", [FixedPoints, Planes])
def test_what_rows_leave_open_of_a_device_is_that_of_least_squares(kind: type[Devices]) -> None:
    there, data, points = exact(kind)
    data = replace(data, values=data.values + 0.1 * normal(ROWS, 1, seed=19))
    noise = float(there.errors(data, points).square().mean())
    for number, deviations in enumerate(there.open_deviations(data, points)):
        own = data.device == number
        S = there.by_increments(points, data.device)[own, 0]
        expected = torch.linalg.inv(S.T @ S / noise + there.deviations[number].square().reciprocal().diag())
        assert_close(deviations, expected.diagonal().sqrt())


def test_a_held_tool_reads_how_the_second_hand_is_off() -> None:
    """Shift and turn along its own axes."""
    twist, left = 1e-6 * normal(6, seed=20), frames(1, 31)[0]
    read = HeldTools.read(KINDS[HeldTools][0], torch.stack([left, left @ HELD[0] @ twist_transform(twist)]))
    assert_close(read, torch.cat([twist[:3], LEVER * twist[3:]]), rtol=1e-4, atol=1e-11)


def test_sockets_are_the_middles_of_balls() -> None:
    """A single row deviates as those of others do."""
    balls = 1e-3 * normal(5, 3, seed=18)
    rows: Any = dc.Measurements.from_sockets(normal(5, 2), list("aaaab"))
    (found,) = SENSORS["socket"].settled(rows, balls[:, None], lambda q: q)
    assert found.names == ("a", "b")
    assert_close(found.constants[1], balls[4], rtol=1e-5, atol=0)
    assert_close(found.constants[0], balls[:4].mean(0), rtol=0, atol=3e-4)  # the row that is farthest counts less
    assert_close(2.0 * found.deviations[0], found.deviations[1], rtol=1e-3, atol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_rows_hardly_move_devices(kind: type[Devices]) -> None:
    there, data, points = exact(kind)
    wrong = data.values.clone()
    wrong[5:8] += 0.2 / there.metres[data.device[5:8], None]
    wrong = replace(data, values=wrong)
    found = kind.at(wrong, points).refined(wrong, points)
    assert float(found.errors(data, points).abs().max()) < 2e-3


@pytest.mark.parametrize("spread", [0.0, 1e-4, 5e-3, 0.3])
def test_planes_are_found_by_a_ball_that_stays_near_them(spread: float) -> None:
    """Heights of a ball that touches them do not differ; points err by 1 mm."""
    normals = torch.nn.functional.normalize(normal(1, 3, seed=4), dim=1)[0]
    heights = spread * normal(ROWS, seed=5)
    across = normal(ROWS, 3, seed=6)
    z = across - (across @ normals - heights)[:, None] * normals + 1e-3 * normal(ROWS, 3, seed=7)
    found = Planes.start(heights[:, None], z)[:3] @ normals
    assert float(found if spread > 1e-3 else found.abs()) > 1 - 1e-4


def test_a_stated_camera_is_right_handed_and_looks_at_its_point() -> None:
    numbers = normal(9, 6, seed=5)
    R, t = Cameras.stated(numbers)[:, :12].view(9, 3, 4).split([3, 1], 2)
    assert_close(torch.linalg.det(R), torch.ones(9, dtype=torch.float64))
    assert_close(R.mT @ t, -numbers[:, :3, None])
    line = numbers[:, 3:] - numbers[:, :3]
    assert_close(R[:, 2], line / line.norm(dim=1, keepdim=True))
    assert triple(1e3 * numbers[0, :3]) in replace(exact(Cameras)[0], constants=Cameras.stated(numbers)).where(0)


def test_pixels_are_metres_at_the_mean_depth_and_back() -> None:
    there, data, points = exact(Cameras)
    focal, centre, names = torch.tensor([800.0, 900.0]), torch.tensor([1.0, 2.0]), list(data.device_names)
    known = {"focal": tuple(focal.tolist()), "centre": tuple(centre.tolist())}
    data = dc.Readings.images(data.q, data.values * focal + centre, names, **known)
    devices = placed(data, points[:, None])
    assert isinstance(devices, Cameras)
    depth = there._seen(there.constants[data.device], points)[:, 2]
    for number in range(2):
        assert float(devices.metres[number]) == pytest.approx(float(depth[data.device == number].mean()), rel=1e-6)
    error = torch.full((ROWS, 2), 0.01 / 850.0, dtype=torch.float64)  # a hundredth of a pixel
    moved = replace(data, values=data.values + error)
    assert data.unit == ("px", 850.0)
    shown = devices.in_unit(moved, devices.errors(moved, points))
    assert_close(shown, torch.full_like(shown, 0.01), rtol=1e-6, atol=1e-9)


def test_what_is_refused() -> None:
    devices, data, points = exact(FixedPoints)
    with pytest.raises(MeasurementError, match="expected distances of left, right, got heights of left, right"):
        devices.errors(exact(Planes)[1], points)
    rows = [*range(0, 60, 2), 1, 3, 5]
    with pytest.raises(MeasurementError, match="at least 8 rows with each name, got 'right' in 3 rows"):
        placed(data.rows(rows), points[rows, None])
    for wrong, size, focal in (("`focal`", 2, 0.0), ("pixels", 3, 1.0)):
        with pytest.raises(MeasurementError, match=wrong):
            dc.Readings.images(data.q, torch.zeros(ROWS, size), focal=(focal, 1.0), centre=(0.0, 0.0))
    with pytest.raises(InputError, match="row 3 is at its fixed point"):
        devices.errors(data, devices.constants[data.device, :3] + torch.arange(3.0, -57.0, -1.0).double()[:, None])
    assert dc.evaluate(lambda _: points[:, None], data).rms < 1e-9


def test_a_model_of_a_marker_does_not_know_the_ball(arm: Case) -> None:
    data = dc.Readings.distances(arm.result.model.configurations[:20], 1.0)
    with pytest.raises(InputError, match="a model of such readings"):
        dc.evaluate(arm.result.model, data)


def test_readings_that_are_noise() -> None:
    _, images, points = exact(Cameras)
    with pytest.raises(MeasurementError, match=r"no place of the devices explains the readings.*behind its camera"):
        placed(replace(images, values=3.0 * normal(ROWS, 2, seed=3)), points[:, None])
    _, data, points = exact(FixedPoints)
    with pytest.warns(dc.DiffeoCalibWarning, match="no place of the devices explains the readings: expected residuals"):
        placed(replace(data, values=9.0 * normal(ROWS, 1, seed=6).abs()), points[:, None])


def test_cameras_start_in_front_of_points_that_are_not_those() -> None:
    """Eight images each, points of a ball that is thought elsewhere: projection alone puts some behind the camera."""
    truth, data, _ = exact(Cameras)
    data = data.rows(torch.arange(16))
    for seed in range(20):
        real = 0.7 * normal(16, 3, seed=seed).clamp(-2, 2)
        values = truth.observation(data.device).value(real) / truth.metres[data.device][:, None]
        thought = real + 0.3 * normal(16, 3, seed=seed + 100)
        found = Cameras.at(replace(data, values=values), thought)
        assert float(found._seen(found.constants[data.device], thought)[:, 2].min()) > 0


COUNT, NAMES = 20, ("here", "there")


TIPS, MOVED = frames(COUNT, 1, 1.0), torch.cat([torch.eye(4).double()[None], frames(1, 3, 0.1)])
SESSION = torch.arange(COUNT) % 2


def points(tips: Tensor) -> Tensor:
    """(N, 3, 3) of the model's tool: three points that mark a frame, m."""
    return mark_points(tips, LEVER)


def measured(kind: type[SetUps]) -> Any:
    """Rows of two set-ups, the first one that of the model."""
    q, names = normal(COUNT, 2), [NAMES[k] for k in SESSION.tolist()]
    if kind is MeasuringFrames:
        T = MOVED[SESSION]
        return dc.Measurements(q, points(TIPS) @ T[:, :3, :3].mT + T[:, None, :3, 3]).with_sessions(names)
    shifts = 0.01 * normal(3, 3, seed=5) * SESSION[:, None, None]
    return dc.Measurements(q, points(TIPS) + shifts @ TIPS[:, :3, :3].mT).with_sessions(names, remounted=True)


def found(kind: type[SetUps], tips: Tensor = TIPS) -> SetUps:
    """Where they fit the points of a model."""
    own = kind.of(points(tips), measured(kind), lambda _: tips[:, None, :3, :3].expand(-1, 3, -1, -1))
    return own.with_reference(0)


@pytest.mark.parametrize("kind", [MeasuringFrames, MountedMarkers])
def test_rows_of_all_set_ups_are_those_of_the_model(kind: type[SetUps]) -> None:
    own = found(kind)
    assert own.elsewhere.tolist() == [False, True]
    assert_close(own.aligned(measured(kind)).points, points(TIPS), rtol=0, atol=1e-9)
    there = points(own.view(1, TIPS))[SESSION == 1] if kind is MeasuringFrames else points(TIPS)[SESSION == 1]
    shifts = torch.zeros(3, 3).double() if kind is MeasuringFrames else own.constants[1].view(3, 3)
    there = there + shifts @ TIPS[SESSION == 1][:, :3, :3].mT
    assert_close(measured(kind).points[SESSION == 1], there, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", [MeasuringFrames, MountedMarkers])
def test_increments_are_what_steps_do_to_the_rows(kind: type[SetUps]) -> None:
    own, data, centre, eye = found(kind), measured(kind), normal(3, seed=7), torch.eye(9, dtype=torch.float64)
    by_tool = torch.stack([torch.block_diag(*[T[:3, :3]] * 3) for T in TIPS])
    effects = own.increments(points(TIPS), eye.expand(COUNT, -1, -1), by_tool, centre)[..., :9]
    steps = normal(1, effects.shape[2], seed=8)
    if kind is MeasuringFrames:  # and markers, which it leaves where they are
        steps[:, 6:] = 0.0

    def rows(h: float) -> Tensor:
        moved = own.moved([1], h * steps, 0.0 * own.deviations[1:], centre, torch.eye(4, dtype=torch.float64))
        return moved.aligned(data).points.flatten(1)

    change = (rows(-STEP) - rows(STEP)) / (2 * STEP)  # of the model's own points against the rows
    assert_close((effects @ steps[0])[SESSION == 1], change[SESSION == 1], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("kind", [MeasuringFrames, MountedMarkers])
def test_carried_set_ups_belong_to_the_other_model(kind: type[SetUps]) -> None:
    T, own = frames(1, 11, 1.0)[0], found(kind)
    tips, shifts = T @ TIPS, 0.01 * normal(3, 3, seed=13) * (kind is MountedMarkers)  # elsewhere on the other's tool
    constants = own.carried(T, points(TIPS), points(tips), shifts)
    other = replace(own, constants=constants, turns=found(kind, tips).turns if kind is MountedMarkers else None)
    data = measured(kind)
    if kind is not MeasuringFrames:  # what is on the tool goes with the device
        data = with_attributes(data, points=data.points @ T[:3, :3].mT + T[:3, 3])
    assert_close(other.aligned(data).points, points(tips) - shifts @ tips[:, :3, :3].mT, rtol=0, atol=1e-9)


def test_the_deviations_of_markers_are_those_of_means() -> None:
    noise, turns = 1e-4 * normal(COUNT, 3, 3, seed=9), TIPS[:, None, :3, :3].expand(-1, 3, -1, -1)
    data = measured(MountedMarkers)
    own = MountedMarkers.of(points(TIPS), with_attributes(data, points=data.points + noise), lambda _: turns)
    away = (noise @ TIPS[:, :3, :3])[SESSION == 1]
    assert_close(own.deviations[1].view(3, 3), away.std(0, correction=0) / len(away) ** 0.5)


def test_frames_that_are_found_in_rows_of_known_ones_lead_on_from_these() -> None:
    first, second = (MountedFrames(NAMES, frames(2, k, 0.1).flatten(1), normal(2, 6, seed=k)) for k in (21, 23))
    for number in range(2):
        there = first.view(number, second.view(number, TIPS))
        assert_close(second.after(first).view(number, TIPS), there)
