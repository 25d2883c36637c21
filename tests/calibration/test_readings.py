"""Calibration by distances, heights and images: start values, scales, the exact model, and what is refused."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from numbers_bank import normal, tensor
from reading_bank import AXES, POINTS, cameras, in_base, reading_errors, readings, scales
from table_bank import refused, warned
from tangent_bank import built, shaken, tangent_covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.open_directions import warn_of_what_is_open
from diffeo_calib.calibration.placing import readings as placed_readings
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.placing.readings import register_readings
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.fitting.result import silent
from diffeo_calib.maps.observation import ReadPoints
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.sensors.range import FixedPoints


@pytest.mark.parametrize(
    ("kind", "zero"), [("distance", 0.03), ("image", 0.0), pytest.param("height", 0.0, marks=pytest.mark.slow)]
)
def test_a_perfect_robot_finds_ball_and_devices(kind: str, zero: float) -> None:
    arm = SimulatedArm(2, geometry=0.0, transmission=0.0, gravity=0.0)
    found = place(arm.nominal, readings(arm, kind, 45, zero), silent).identification
    assert found.rms < 2e-6
    assert_close(found.geometry.tool, arm.truth.tool, rtol=0, atol=1e-4)
    expected = {
        "distance": torch.cat([POINTS, torch.full((3, 1), zero)], 1),
        "height": torch.cat([AXES, torch.full((3, 1), 0.3)], 1),
        "image": cameras()[:, :3].flatten(1),
    }[kind]
    (devices,) = found.devices
    assert_close(devices.constants[:, : expected.shape[1]], expected.double(), rtol=0, atol=1e-4)


def test_the_covariance_of_distances_is_that_of_positions_along_their_directions() -> None:
    setting = built("two markers")
    whole = setting.tangent_data
    x, geometry = whole.x, setting.nominal.geometry
    one = geometry.with_tool(geometry.tool[:1])
    nominal = type(setting.nominal)(one, elastic=True)
    theta = 1e-4 * normal(nominal.parameters, seed=4)
    fixed = tensor([3.0, 2.0, 1.0, 0.0]).repeat(len(x), 1)
    observe = ReadPoints(FixedPoints.read, fixed, 3)
    y = observe.value(nominal(x, theta)) + 1e-4 * normal(len(x), 1, seed=5)
    tails = type(whole.tails).none(len(x), 1)
    data = TangentData(nominal, theta, x, y, NoiseModel.alike(len(x), 1, 1), tails, observe=observe)
    scales = replace(shaken(setting.scales, 3), task_amplitude=tensor(1e-3))
    A = torch.block_diag(*observe.slope(nominal(x, theta)))
    expected = A @ tangent_covariance(scales, nominal, theta, x) @ A.T
    assert_close(data.linearisation(scales).gram(), expected, rtol=1e-9, atol=1e-16)


def errors_after_similarity(found: Tensor, truth: Tensor) -> tuple[float, float]:
    """RMS error after the best rigid motion and change of size, m, and this change."""
    T = rigid_fit(found, truth)
    errors, away = found @ T[:3, :3].mT + T[:3, 3] - truth, truth - truth.mean(0)
    size = float((errors * away).sum() / away.square().sum())
    return float((errors - size * away).square().sum(1).mean().sqrt()), size


def calibrated(arm: SimulatedArm, data: dc.Readings) -> tuple[dc.CalibrationResult, str]:
    """The result with given scales, and all warnings."""
    result, texts = warned(dc.calibrate, arm.nominal, data, hyperparameters=scales())
    return result, " ".join(texts)


def test_cameras_find_the_robot_but_for_its_size() -> None:
    """The size is as uncertain as the warning says; the rest is found; nothing is better on new rows by chance."""
    arm = SimulatedArm(3)
    data = readings(arm, "image", 130, noise=2e-5)
    train, new = data.rows(slice(100)), data.rows(slice(100, None))
    result, said = calibrated(arm, train)
    assert said.startswith("the readings hold too little length: the robot's size is known to 0.")
    q = arm.sample(200, 9)
    truth = in_base(arm, q)
    before, _ = errors_after_similarity(result.identification.geometry.points(q)[:, 0], truth)
    after, size = errors_after_similarity(result.model(q).detach()[:, 0], truth)
    assert after < 0.2 * before
    assert abs(size) < 3 * result.expected.size
    assert result.expected.size > 2e-4
    assert result.expected.size_share > 0.8
    errors = reading_errors(result, new)
    assert float(errors.norm()) < 0.2 * float(reading_errors(result, new, "nominal").norm())
    known = float(result.readings[0].devices.in_unit(new, errors).norm(dim=1).square().mean().sqrt())  # px
    assert known / 1.5 < dc.evaluate(result.model, new).rms < 1.2 * known
    assert len([line for line in result.placement.sentences() if line.startswith("camera 'device ")]) == 3


def touched(arm: SimulatedArm, heights: tuple[float, ...], rows: int) -> dc.Readings:
    """The ball brought to planes, or to blocks of these heights on them, by steps along the true Jacobian."""
    q, which = arm.sample(6 * rows, 4), torch.arange(6 * rows) % 3
    at = tensor(heights)[torch.arange(6 * rows) // 3 % len(heights)]
    base = arm.truth.base[:3, :3]
    for _ in range(25):
        miss = at - ((in_base(arm, q) * AXES[which]).sum(1) - 0.3)
        slopes = torch.einsum("ni,ij,njk->nk", AXES[which], base.mT, arm.truth.jacobian(q)[:, 0])
        q = q + (slopes * (miss / slopes.square().sum(1))[:, None]).clamp(-0.3, 0.3)
    there = ((in_base(arm, q) * AXES[which]).sum(1) - 0.3 - at).abs() < 1e-9
    chosen = there.nonzero()[:rows, 0]
    assert len(chosen) == rows
    names = [f"plane {number}" for number in which[chosen].tolist()]
    return dc.Readings.heights(q[chosen], at[chosen], names, arm.nominal.joint_names)


def test_a_gauge_block_gives_touched_planes_a_length() -> None:
    arm = SimulatedArm(1)
    without, said = calibrated(arm, touched(arm, (0.0,), 90))
    assert "touch a gauge block of known height" in said
    known, said = calibrated(arm, touched(arm, (0.0, 0.1), 90))
    assert "length" not in said
    assert known.expected.size < 0.25 * without.expected.size
    assert known.expected.workspace < 0.5 * without.expected.workspace


def said_before_the_fit(arm: SimulatedArm, data: dc.Readings) -> str:
    def placed() -> None:
        found = place(arm.nominal, data, silent)
        warn_of_what_is_open(found.tangent_data(), [own.devices for own in found.readings])

    return " ".join(warned(placed)[1])


def test_planes_that_are_parallel_are_named() -> None:
    arm = SimulatedArm(2, transmission=0.0)
    q, which = arm.sample(60, 1), torch.arange(60) % 2
    names = [f"top {number}" for number in which.tolist()]
    said = said_before_the_fit(arm, dc.Readings.heights(q, in_base(arm, q)[:, 2] - 0.2 * which, names))
    assert "no plane faces some directions ('top 0' and 'top 1' are parallel)" in said
    assert "hardly change with waist_joint" in said


def test_a_tool_that_never_tilts_is_warned_about() -> None:
    """With the last joints still, a change of the ball's place is one of the last link's length."""
    arm = SimulatedArm(2, transmission=0.0)
    q = arm.sample(60, 1)
    still = torch.cat([q[:, :1], q[:1, 1:3] + 0.01 * q[:, 1:3], q[:1, 3:].expand(60, -1)], 1)
    for at, tilted in ((q, True), (still, False)):
        data = dc.Readings.distances(at, (in_base(arm, at) - POINTS[0]).norm(dim=1))
        said = said_before_the_fit(arm, data)
        assert ("the tool is hardly tilted" in said) is not tilted
        assert not tilted or "another zero" not in said


@pytest.mark.slow
def test_readings_in_another_unit_are_refused() -> None:
    arm = SimulatedArm(2)
    for data, factor, size in (
        (readings(arm, "height", 45), 1e3, "large"),
        (touched(arm, (-0.008, 0.0, 0.008), 45), 1e-3, "small"),
        (readings(arm, "distance", 51), 1e-3, "small"),
    ):
        with pytest.raises(MeasurementError, match=f"1000 times too {size}: check the units of the readings"):
            register_readings(Geometry.nominal(arm.nominal, 1), [replace(data, values=factor * data.values)])


@pytest.mark.slow
def test_lengths_from_another_zero_are_refused_or_warned_about() -> None:
    arm = SimulatedArm(2)
    exact = readings(arm, "distance", 60, noise=2e-5)
    assert "another zero: with a free one, +" in calibrated(arm, replace(exact, values=exact.values + 3e-3))[1]
    far = replace(exact, values=exact.values + 0.1)
    with pytest.raises(MeasurementError, match=r"\+99\.\d mm at 'device 0'.* times better; check the device's zero"):
        dc.calibrate(arm.nominal, far)
    assert "another zero" not in calibrated(arm, replace(far, offset_std=1.0))[1]


def test_what_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placed_readings, "BALLS_TRIED", 2)
    monkeypatch.setattr(placed_readings, "STARTS_STEPS", 20)
    arm, data = SimulatedArm(2), readings(SimulatedArm(2), "distance", 60)
    three = dc.Readings.distances(data.q[:24], data.values[:24])  # devices as one
    with pytest.warns(dc.DiffeoCalibWarning, match="no place of ball and devices explains"):
        register_readings(Geometry.nominal(arm.nominal, 1), [three])
    kept = data.rows(data.device != 1)
    assert kept.names == ("device 0", "device 2")
    assert set(kept.device.tolist()) == {0, 1}

    def calibrated_by(rows: Any) -> Callable[[], object]:
        return lambda: dc.calibrate(arm.nominal, rows)

    names, swapped = ["rare"] * 3 + ["often"] * 57, data.with_joint_names(arm.nominal.joint_names[::-1])
    refused(
        ("at least 40 rows", calibrated_by(data.rows(slice(0, 30)))),
        ("'rare' in 3 rows", calibrated_by(dc.Readings.distances(data.q, data.values, names))),
        ("joints are not those of robot", calibrated_by(swapped)),
        ("Readings", calibrated_by(data.q)),
        ("above 0", lambda: dc.Readings.distances(data.q, -data.values)),
        ("60 names", lambda: dc.Readings.heights(data.q, 0.0, ["table"])),
    )
