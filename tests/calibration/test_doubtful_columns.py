"""Columns that are not what they seem: stuck, rounded, of unnamed markers, of markers that nobody measured."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from kind_bank import kind_named, marked
from product_bank import Case, simulated
from table_bank import warned
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.outliers import stuck_columns
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_identification,
    check_markers,
    marker_column,
    quantum,
    unmeasured_markers,
    warn_of_rounding,
)
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import Geometry, Joint, SimulatedArm, from_dh

# --- columns of one value ---------------------------------------------------------------------------------------------

HELD = {
    "positions": ("position", "z"),
    "hidden markers": ("position", "marker3_z"),
    "poses": ("pose", "z"),
    "heights": ("height", "height"),
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
    found, texts = warned(dc.calibrate, robot, data)
    assert len(found.outliers) >= 0.8 * wrong
    assert wrong or not any("one value" in one for one in texts)


def test_deviations_and_a_few_rows_are_no_stuck_columns() -> None:
    data = kind_named("positions").data
    assert stuck_columns(with_attributes(data, std=torch.full_like(data.points, 2e-5))) == []
    assert stuck_columns(stuck(data.rows(slice(5)), "position")) == []


# --- joint values with few digits -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (5e-4, "0.0005 rad"),
        (math.radians(0.01), "0.01 degrees"),
    ],
)
def test_the_step_of_a_column(step: float, words: str, arm: Case) -> None:
    values = (arm.train.q[:, 1] / step).round() * step
    assert quantum(values, turning=True) == (pytest.approx(step), words)
    assert quantum(arm.train.q[:, 1], turning=True) is None
    assert quantum(values[:6], turning=True) is None  # a few round numbers are no evidence
    assert quantum(1e-6 * torch.rand(40, dtype=torch.float64), turning=True) is None  # nor is zero, of any step
    values = (torch.linspace(0.1, 0.6, 40, dtype=torch.float64).sqrt() * 1e3).round() / 1e3
    assert quantum(values, turning=False) == (pytest.approx(1e-3), "1 mm")


def test_values_commanded_with_few_digits_are_right(arm: Case) -> None:
    """Their rounding would cause far larger errors than remain."""
    tangent = place(arm.robot, arm.train, silent).tangent_data()
    for step in (1e-2, 1e-6):  # or far smaller ones
        data = dc.Measurements((arm.train.q / step).round() * step, arm.train.points)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warn_of_rounding(arm.robot, data, tangent, arm.result.leave_one_out)


@pytest.mark.slow
def test_readings_rounded_to_a_milliradian() -> None:
    arm, train, _ = simulated(40)
    data = dc.Measurements((1e3 * train.q).round() / 1e3, train.points)
    words = (
        r"waist_joint, .*, wrist_roll_joint are rounded to 0.001 rad: .* got 0\.\d+ mm RMS of position error from this"
    )
    with pytest.warns(DiffeoCalibWarning, match=words):
        dc.calibrate(arm.nominal, data)


# --- a column that nobody read names the marker of each row -----------------------------------------------------------

ROWS = 45
ARM = SimulatedArm(seed=4, markers=3)
Q, POINTS = ARM.measure(ROWS, seed=5)
LABELS = torch.arange(ROWS) % 3


def labelled(path: Path, points: Tensor, labels: Tensor, q: Tensor = Q) -> dc.Measurements:
    names = ARM.nominal.joint_names
    rows = [[*one.tolist(), "ABCDEFGHI"[label]] for one, label in zip(torch.cat([q, points], 1), labels, strict=True)]
    write_rows(path, [*names, "x", "y", "z", "target"], [rows], TableFormat("m", "rad"))
    return dc.read_measurements(path, ARM.nominal, ["x", "y", "z"], length="m", angle="rad", duplicates="keep")


def marker_of(data: dc.Measurements) -> tuple[str, str] | None:
    return marker_column(register(ARM.nominal, data.q, data.points).geometry, data)


def test_several_markers_are_told_by_their_column(tmp_path: Path) -> None:
    data = labelled(tmp_path / "t.csv", POINTS[torch.arange(ROWS), LABELS], LABELS)
    found: Any = marker_of(data)
    assert found[0] == "target"
    tool = ARM.truth.tool
    jump = 1e3 * float(torch.cdist(tool, tool).max())
    assert found[1].startswith("3 values between which the points jump by")
    assert abs(float(found[1].split("jump by ")[1].split(" mm")[0]) / jump - 1.0) < 0.1
    with pytest.raises(MeasurementError, match=r"column 'target' takes 3 values.* name the column: --marker target"):
        check_identification(data, register(ARM.nominal, data.q, data.points))


@pytest.mark.parametrize("case", ["no jump", "other labels", "device", "mass", "repeated poses"])
def test_other_columns_name_no_marker(case: str, tmp_path: Path) -> None:
    """Labels without meaning, a device that moved, a load, a few poses again and again."""
    points, labels, q = POINTS[:, 0], LABELS, Q
    if case == "other labels":
        points, labels = POINTS[torch.arange(ROWS), LABELS], torch.arange(ROWS) // 9
    elif case == "device":
        points = points + torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.03, 0.01]]).double()[labels]
    elif case == "mass":
        heavy = [ARM.measure(ROWS, seed=5, payload=mass)[1][:, 0] for mass in (0.0, 10.0, 40.0)]
        points = torch.stack(heavy)[labels, torch.arange(ROWS)]
    elif case == "repeated poses":
        q, labels = Q[:9].repeat(5, 1), torch.arange(9).repeat(5)
        points = ARM.true_points(q)[:, 0]
    assert marker_of(labelled(tmp_path / "t.csv", points, labels, q)) is None


# --- markers that nobody measured -------------------------------------------------------------------------------------

PAIR = SimulatedArm(seed=5, markers=2)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def pair_rows(count: int = 40) -> dc.Measurements:
    q, points = PAIR.measure(count, seed=1)
    return dc.Measurements(q, points, PAIR.nominal.joint_names)


def with_second(points: torch.Tensor) -> dc.Measurements:
    data = pair_rows(len(points))
    return dc.Measurements(data.q, torch.stack([data.points[:, 0], points], 1), data.joint_names)


def wished(digits: int, reached: float = 0.0) -> torch.Tensor:
    """Places of the nominal robot in another frame, to so many digits of a mm, at joint values reached so well, rad."""
    q = pair_rows().q
    q = q + reached * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    poses = PAIR.nominal(q)
    at = poses[:, :3, :3] @ poses.new_tensor([0.02, 0.03, 0.1]) + poses[:, :3, 3]
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.1], [0.3, 0.0, 0.2], [-0.1, -0.2, 0.0]], dtype=q.dtype))
    return ((at @ turn.mT + 0.4) * 10.0 ** (3 + digits)).round() / 10.0 ** (3 + digits)


def test_measured_markers_are_silent() -> None:
    assert not list(unmeasured_markers(PAIR.nominal, pair_rows()))
    assert not list(unmeasured_markers(PAIR.nominal, pair_rows(8)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_markers(PAIR.nominal, pair_rows())


@pytest.mark.parametrize("digits", [2, 9])
def test_places_of_the_nominal_robot_are_refused(digits: int) -> None:
    data = with_second(wished(digits))
    with pytest.raises(MeasurementError, match=r"marker 1 follows the nominal robot to 0\.00.* mm, another one to"):
        dc.calibrate(PAIR.nominal, data)


def test_a_marker_that_is_near_the_nominal_robot_is_measured_where_the_other_one_does_not_belong() -> None:
    """A robot with errors of micrometres, and a marker that is not on its tip: no proof against the first."""
    data = with_second(wished(4, reached=3e-5))
    with pytest.warns(DiffeoCalibWarning, match="marker 1 follows the nominal robot"):
        check_markers(PAIR.nominal, data)
    elsewhere = PAIR.nominal(data.q.roll(1, 0))[:, :3, 3]
    points = torch.stack([elsewhere, data.points[:, 1]], 1)
    assert not list(unmeasured_markers(PAIR.nominal, dc.Measurements(data.q, points, data.joint_names)))


def test_markers_above_each_other_on_a_robot_that_turns_about_one_axis_are_two() -> None:
    joints = [
        Joint(f"j{k}", "revolute", torch.eye(4, dtype=torch.float64), UP, lower=-2.0, upper=2.0) for k in range(2)
    ]
    joints[1].origin[0, 3] = 0.4
    robot, shift = dc.Chain("planar", "base", "tip", joints), torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    q = 4.0 * torch.rand(40, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 2.0
    poses = robot(q)
    first = poses[:, :3, 3] + 0.3 * poses[:, :3, 0] + 1e-3 * torch.sin(q[:, :1])
    assert not list(unmeasured_markers(robot, dc.Measurements(q, torch.stack([first, first + shift], 1))))


def test_copies_are_refused_also_shifted_ones() -> None:
    first = pair_rows().points[:, 0]
    with pytest.raises(MeasurementError, match="marker 1 is a copy of marker 0"):
        dc.calibrate(PAIR.nominal, with_second(first.clone()))
    with pytest.raises(MeasurementError, match="copy of marker 0, shifted by the same"):
        check_markers(PAIR.nominal, with_second(first + torch.tensor([0.1, 0.0, 0.2], dtype=first.dtype)))
    hidden = first.clone()
    hidden[::2] = torch.nan
    assert [one.proved for one in unmeasured_markers(PAIR.nominal, with_second(hidden))] == [True]
