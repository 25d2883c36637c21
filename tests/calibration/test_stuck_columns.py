"""Columns of one value: named where the rows contradict them, accepted where they may be right."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from kind_bank import kind_named, marked

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.stuck_columns import stuck_columns
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm, from_dh
from diffeo_calib.robots.geometry import Geometry

HELD = {
    "positions": ("position", "z"),
    "hidden markers": ("position", "marker3_z"),
    "poses": ("pose", "z"),
    "heights": ("height", "height"),
    "distances": ("distance", "distance"),
    "images": ("image", "v"),
    "images and a tracker": ("marker", "marker 2"),
    "inclinations": ("inclination", "inclination 2"),
}
"""Kind of table -> kind of its rows, and the column that sticks there."""


def stuck(data: Any, kind: str) -> Any:
    """The last number of rows of a kind, of the first device: one value in all rows."""
    if isinstance(data, dc.Observations):
        return dc.Observations([stuck(part, kind) for part in data.parts], data.index)
    if data.kind != kind:
        return data
    if isinstance(data, dc.Readings):
        values, own = data.values.clone(), (data.device == 0).nonzero()[:, 0]
        number = min(1, values.shape[1] - 1)
        values[own, number] = float(values[own[0], number])
        return with_attributes(data, values=values)
    if data.poses is not None:
        poses = data.poses.clone()
        poses[:, 2, 3] = poses[0, 2, 3]
        return dc.Measurements.from_poses(data.q, poses, data.joint_names)
    points = data.points.clone()
    points[:, -1, 2] = torch.where(points[:, -1, 2].isnan(), torch.nan, 0.4)
    return with_attributes(data, points=points)


def named(robot: dc.Tree, data: Any, scales: dc.Hyperparameters) -> str:
    """The warning about columns of one value."""
    with pytest.warns(DiffeoCalibWarning) as caught:
        dc.calibrate(robot, data, hyperparameters=scales)
    return next(str(one.message) for one in caught if "one value" in str(one.message))


@pytest.mark.parametrize("name", marked(*HELD))
def test_a_stuck_column_is_named(name: str) -> None:
    kind = kind_named(name)
    rows, column = HELD[name]
    data = stuck(kind.data, rows)
    assert f"'{column}' of the {rows}s" in named(kind.robot, data, kind.scales)


@pytest.mark.parametrize("marker", [0, 1])
def test_one_of_two_markers_with_a_stuck_coordinate_is_named(marker: int) -> None:
    arm = SimulatedArm(seed=1, markers=2)
    data = dc.Measurements(*arm.measure(60, seed=2), arm.nominal.joint_names)
    points = data.points.clone()
    points[:, marker, 1] = points[0, marker, 1]
    text = named(arm.nominal, with_attributes(data, points=points), kind_named("positions").scales)
    assert text.startswith(f"'marker{marker + 1}_y' of the positions holds one value")


def planar_rows(wrong: int = 0) -> tuple[Any, dc.Measurements]:
    """A planar robot, whose marker a flat device sees: the third coordinate is zero in all rows."""
    robot = from_dh([(0.5, 0, 0), (0.4, 0, 0), (0.2, 0, 0)], name="planar")
    draw = torch.Generator().manual_seed(4)
    q = 2.4 * torch.rand(60, 3, dtype=torch.float64, generator=draw) - 1.2
    geometry = Geometry.nominal(robot, 1).with_tool(torch.tensor([[0.03, -0.02, 0.0]], dtype=torch.float64))
    points = geometry.points(q + 2e-3 * torch.sin(q))
    points[..., :2] += 2e-5 * torch.randn(60, 1, 2, dtype=torch.float64, generator=draw)
    points[:wrong, 0, :2] += 0.03 * torch.randn(wrong, 2, dtype=torch.float64, generator=draw)
    points[..., 2] = 0.0
    return robot, dc.Measurements(q, points, robot.joint_names)


@pytest.mark.parametrize("wrong", [0, 28])
def test_the_height_of_a_planar_robot_may_be_one_value(wrong: int) -> None:
    robot, data = planar_rows(wrong)
    assert [one.words for one in stuck_columns(data)] == ["'z' of the positions"]
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        found = dc.calibrate(robot, data)
    assert len(found.outliers) >= 0.8 * wrong


def test_deviations_and_a_few_rows_are_no_stuck_columns() -> None:
    data = kind_named("positions").data
    known = with_attributes(data, std=torch.full_like(data.points, 2e-5))
    assert stuck_columns(known) == []
    points = data.points[:5].clone()
    points[..., 2] = 0.1
    assert stuck_columns(with_attributes(data.rows(slice(5)), points=points)) == []
