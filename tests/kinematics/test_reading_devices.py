"""Devices of readings: start values, refinement, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from math_bank import normal, uniform
from product_bank import Case
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.sensors.height import Planes
from diffeo_calib.sensors.image import Cameras
from diffeo_calib.sensors.kinds import KINDS
from diffeo_calib.sensors.places import placed

ROWS = 60
Q = uniform(ROWS, 2, seed=1)
NAMES = ["left", "right"] * (ROWS // 2)


def points(q: Tensor) -> Tensor:
    """Any map of two joints to a ball in space: (N, 1, 3)."""
    return torch.stack([q[:, 0].cos(), q[:, 1].sin(), q.sum(1).sin()], 1)[:, None]


def constants(kind: str) -> Tensor:
    if kind == "distance":
        return torch.tensor([[2.0, 0.5, 0.1, 0.0], [-1.0, 2.0, 0.4, 0.0]], dtype=torch.float64)
    if kind == "height":
        normals = torch.nn.functional.normalize(normal(2, 3, seed=4), dim=1)
        return torch.cat([normals, torch.tensor([[0.3], [-0.2]], dtype=torch.float64)], 1)
    poses = transforms(rotation(0.4 * normal(2, 3, seed=5)), torch.tensor([[0.1, 0.2, 4.0], [0.3, -0.2, 5.0]]).double())
    return torch.cat([poses[:, :3].flatten(1), torch.ones(2, 1, dtype=torch.float64)], 1)


def readings(kind: str) -> dc.Readings:
    """Exact ones."""
    start = {
        "distance": dc.Readings.distances(Q, 1.0, NAMES),
        "height": dc.Readings.heights(Q, 0.0, NAMES),
        "image": dc.Readings.images(Q, torch.zeros(ROWS, 2).double(), NAMES, focal=(800.0, 900.0), centre=(1.0, 2.0)),
    }[kind]
    if kind == "height":  # else no reading says which way a normal points
        start = replace(start, values=start.values + 1.0)
    at = points(Q)
    devices = (
        KINDS[kind].at(start, at[:, 0]) if kind != "image" else Cameras(start.names, constants(kind), torch.ones(2, 6))
    )
    there = replace(devices, constants=constants(kind))
    return replace(start, values=there.observation(start.device).value(at[:, 0]))


@pytest.mark.parametrize("kind", ["distance", "height", "image"])
def test_wrong_rows_hardly_move_devices(kind: str) -> None:
    """The closed form finds them by exact readings."""
    data = readings(kind)
    assert float(KINDS[kind].at(data, points(Q)[:, 0]).errors(data, points(Q)[:, 0]).abs().max()) < 1e-9
    known = constants(kind)
    size = known.shape[1] - (kind == "image")
    wrong = data.values.clone()
    wrong[5:8] += 0.2
    robust = placed(replace(data, values=wrong), points(Q))
    assert_close(robust.constants[:, :size], known[:, :size], rtol=0, atol=1e-3)


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


def test_pixels_are_metres_at_the_mean_depth_and_back() -> None:
    data = readings("image")
    devices = placed(data, points(data.q))
    assert isinstance(devices, Cameras)
    depth = torch.einsum("nj,nij->ni", points(Q)[:, 0], devices.poses[data.device][:, :3, :3])[:, 2]
    depth = depth + devices.poses[data.device][:, 2, 3]
    for number in range(2):
        assert float(devices.metres[number]) == pytest.approx(float(depth[data.device == number].mean()), rel=1e-6)
    error = torch.full((ROWS, 2), 0.01 / 850.0, dtype=torch.float64)  # a hundredth of a pixel
    moved = replace(data, values=data.values + error)
    assert data.unit == ("px", 850.0)
    shown = devices.in_unit(moved, devices.errors(moved, points(Q)[:, 0]))
    assert_close(shown, torch.full_like(shown, 0.01), rtol=1e-6, atol=1e-9)


def test_what_is_refused() -> None:
    data = readings("distance")
    devices = placed(data, points(data.q))
    with pytest.raises(MeasurementError, match="expected distances of left, right, got heights of left, right"):
        devices.errors(readings("height"), points(Q)[:, 0])
    with pytest.raises(MeasurementError, match="at least 8 rows of each device, got 'right' in 3 rows"):
        dc.evaluate(points, data.rows([*range(0, 60, 2), 1, 3, 5]))
    with pytest.raises(MeasurementError, match="`focal`"):
        dc.Readings.images(Q, torch.zeros(ROWS, 2), focal=(0.0, 1.0), centre=(0.0, 0.0))
    with pytest.raises(MeasurementError, match="pixels"):
        dc.Readings.images(Q, torch.zeros(ROWS, 3), focal=(1.0, 1.0), centre=(0.0, 0.0))
    with pytest.raises(InputError, match="row 3 is at its fixed point"):
        devices.errors(data, devices.constants[data.device, :3] + torch.arange(3.0, -57.0, -1.0).double()[:, None])
    assert dc.evaluate(points, data).rms < 1e-9


def test_a_model_of_a_marker_does_not_know_the_ball(arm: Case) -> None:
    data = dc.Readings.distances(arm.result.model.configurations[:20], 1.0)
    with pytest.raises(InputError, match="a model of such readings"):
        dc.evaluate(arm.result.model, data)


def test_readings_that_are_noise() -> None:
    seen = dc.Readings.images(Q, 3.0 * normal(ROWS, 2, seed=3), NAMES, focal=(1.0, 1.0), centre=(0.0, 0.0))
    with pytest.raises(MeasurementError, match=r"no place of the devices explains the readings.*behind its camera"):
        placed(seen, points(seen.q))
    data = readings("distance")
    with pytest.warns(dc.DiffeoCalibWarning, match="no place of the devices explains the readings: expected residuals"):
        placed(replace(data, values=9.0 * normal(ROWS, 1, seed=6).abs()), points(data.q))


def test_cameras_start_in_front_of_points_that_are_not_those() -> None:
    """Eight images each, points of a ball that is thought elsewhere: projection alone puts some behind the camera."""
    truth = Cameras(("left", "right"), constants("image"), torch.ones(2, 6).double())
    behind = 0
    for seed in range(20):
        real = 0.7 * normal(16, 3, seed=seed).clamp(-2, 2)
        none, f = torch.zeros(16, 2).double(), (800.0, 800.0)
        data = dc.Readings.images(Q[:16], none, NAMES[:16], focal=f, centre=(0.0, 0.0))
        data = replace(data, values=truth.observation(data.device).value(real))
        thought = real + 0.3 * normal(16, 3, seed=seed + 100)
        found = Cameras.at(data, thought)
        depth = (found.poses[data.device] @ torch.nn.functional.pad(thought, (0, 1), value=1.0)[..., None])[:, 2, 0]
        behind += int((depth <= 0).any())
    assert behind == 0
