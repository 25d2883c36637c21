"""Lengths against descriptions, and rows that no robot was measured for."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from golden_bank import sockets
from reading_bank import readings, scales
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.sensors.image import Cameras

ARM = SimulatedArm(2)
ROWS = 80


def warned(data: dc.Measurements | dc.Readings) -> tuple[dc.CalibrationResult, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DiffeoCalibWarning)
        result = dc.calibrate(ARM.nominal, data, hyperparameters=scales())
    return result, [str(one.message) for one in caught if "seems to differ" in str(one.message)]


@cache
def clean() -> tuple[dc.CalibrationResult, list[str]]:
    return warned(dc.Measurements(*ARM.measure(ROWS, seed=1)))


@pytest.mark.parametrize(
    ("factors", "name", "percent"),
    [((1.01,) * 3, "the size of the robot", 1.0), ((1.0, 1.001, 1.0), "the scale of the measuring frame along y", 0.1)],
)
def test_a_wrong_scale_is_named_with_its_size(factors: tuple[float, ...], name: str, percent: float) -> None:
    q, y = ARM.measure(ROWS, seed=1)
    result, (text,) = warned(dc.Measurements(q, y * torch.tensor(factors, dtype=torch.float64)))
    found = re.match(rf"{name} seems to differ by \+([\d.]+) %", text)
    assert found is not None, text
    assert float(found[1]) == pytest.approx(percent, rel=0.25)
    wrong = (y - y.mean((0, 1))) * (torch.tensor(factors, dtype=torch.float64) - 1)
    assert result.expected.workspace == pytest.approx(float(wrong.square().sum(-1).mean().sqrt()), rel=0.3)


def test_right_scales_are_not_warned_about() -> None:
    result, texts = clean()
    assert texts == []
    assert abs(result.lengths[0].value) < 3 * result.lengths[0].deviation < 0.004


@pytest.mark.parametrize(("share", "noticed"), [(0.6, False), (1.5, True)])
def test_the_result_tells_which_scales_pass_without_a_warning(share: float, noticed: bool) -> None:
    """The size that is told apart from none, of the clean rows: rows in a tracker's wrong scale are judged by it."""
    q, y = ARM.measure(ROWS, seed=1)
    found = clean()[0].lengths[0]
    wrong, texts = warned(dc.Measurements(q, y * (1 + share * found.unnoticed - found.value)))
    assert bool(texts) == noticed
    moved = (y - y.mean((0, 1))).square().sum(-1).mean().sqrt() * found.unnoticed
    assert found.unnoticed * found.motion * 3**0.5 == pytest.approx(float(moved), rel=0.15)
    assert "may be wrong without a warning" in str(wrong.lengths[0])


def test_sockets_without_a_known_distance_show_no_size() -> None:
    """Neither another one nor a change: what the ball differs within a socket is no motion."""
    golden = sockets()
    table: Any = golden.rows
    table = table.rows(slice(0, 48))
    table = with_attributes(table, sockets=replace(table.sockets, distances=(), distance_std=None))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DiffeoCalibWarning)
        result = dc.calibrate(golden.robot, table, hyperparameters=golden.scales)
    assert len(caught) == 1
    assert "no distance between sockets is known" in str(caught[0].message)
    size = result.lengths[0]
    assert abs(size.value) < size.deviation
    assert size.deviation > 0.01


def test_the_scale_of_a_wire_is_checked_in_the_same_way() -> None:
    data = readings(ARM, "distance", ROWS, zero=0.02)
    wrong = dc.Readings.distances(
        data.q, 1.01 * data.values[:, 0], [data.names[k] for k in data.device.tolist()], offset_std=0.1
    )
    _, (text,) = warned(wrong)
    found = re.match(r"the size of the robot seems to differ by \+([\d.]+) %", text)
    assert found is not None, text
    assert float(found[1]) == pytest.approx(1.0, rel=0.2)
    assert warned(data)[1] == []


def test_what_a_camera_is_said_to_hold() -> None:
    """Effects of focal length and principal point are the derivatives of what it reports."""
    data = readings(ARM, "image", 24)
    points = ARM.nominal(data.q)[:, :3, 3]
    cameras = Cameras.at(data, points)
    found = {one.name: one.effects[..., 0] for one in cameras.hypotheses(points, data.device) if one.said}
    image = cameras.observation(data.device).value(points)
    assert len(found) == 9
    focal = sum(motion for name, motion in found.items() if name.startswith("the focal length"))
    torch.testing.assert_close(focal, image)
    along_u = sum(motion for name, motion in found.items() if "along u" in name)
    assert isinstance(along_u, Tensor)
    torch.testing.assert_close(along_u[:, 0], cameras.metres[data.device])
    assert not bool(along_u[:, 1].any())


@pytest.mark.parametrize("step", [0.0, 1e-6, 1e-4])
def test_the_controllers_own_positions_are_warned_about(step: float) -> None:
    q = ARM.sample(ROWS, 1)
    y = ARM.nominal(q)[:, None, :3, 3] + torch.tensor([0.5, 0.2, 0.1], dtype=torch.float64)
    y = (y / step).round() * step if step else y
    poses = ARM.nominal(q)
    poses[:, :3, 3] = y[:, 0]
    posed = dc.Measurements.from_poses(q, poses, doubt=False)
    for data in (dc.Measurements(q, y, doubt=False), posed)[: 1 + (step == 1e-4)]:
        with pytest.warns(DiffeoCalibWarning, match="show no errors of the robot.*if they were computed"):
            dc.calibrate(ARM.nominal, data, hyperparameters=scales())


def test_rounded_positions_of_a_real_robot_are_not_refused() -> None:
    q, y = ARM.measure(ROWS, seed=1)
    data = dc.Measurements(q, (y / 1e-4).round() * 1e-4, doubt=False)
    assert math.isfinite(dc.calibrate(ARM.nominal, data, hyperparameters=scales()).left_out_rms)


def test_a_robot_without_errors_is_said_to_have_none() -> None:
    perfect = SimulatedArm(2, geometry=0, transmission=0, gravity=0)
    with pytest.warns(DiffeoCalibWarning, match="show no errors of the robot"):
        dc.calibrate(perfect.nominal, dc.Measurements(*perfect.measure(ROWS)), hyperparameters=scales())


@pytest.mark.parametrize("lever", [10.0, 1e-4])
def test_levers_in_another_unit_are_refused(lever: float) -> None:
    q = ARM.sample(ROWS, 1)
    data = dc.Measurements.from_poses(q, ARM.truth.poses(q), lever=lever)
    with pytest.raises(MeasurementError, match=rf"lever.* got {1e3 * lever:g} mm"):
        dc.calibrate(ARM.nominal, data)
