"""Columns that are not what they seem: stuck, rounded, of unnamed markers, of markers that nobody measured."""

import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from numbers_bank import drawn, normal, tensor
from product_bank import Case, simulated, with_usual_scales
from source_bank import tracked
from table_bank import refused, warned
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.judged_rows import stuck_columns, warn_of_stuck
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_identification,
    check_markers,
    marker_column,
    quantum,
    unmeasured_markers,
)
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import Geometry, SimulatedArm, from_dh
from diffeo_calib.robots.se3 import rotation

HELD = {
    "poses": ("pose", "z"),
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


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD)
def test_a_stuck_column_is_named(name: str) -> None:
    """Before a calibration chooses scales and fits."""
    kind, (rows, column) = kind_named(name), HELD[name]
    data = stuck(kind.data, rows)
    placed, _ = warned(place, kind.robot, data, silent)
    (text,) = warned(warn_of_stuck, placed.tangent_data(), data)[1]
    assert f"'{column}' of the {rows}s" in text


def planar_rows(wrong: int = 0) -> tuple[Any, dc.Measurements]:
    """A planar robot, whose marker a flat device sees: the third coordinate is zero in all rows."""
    robot = from_dh([(0.5, 0, 0), (0.4, 0, 0), (0.2, 0, 0)], name="planar")
    q, flat = 2.4 * drawn(60, 3, seed=4) - 1.2, tensor([1.0, 1.0, 0.0])
    points = Geometry.nominal(robot, 1).with_tool(tensor([[0.03, -0.02, 0.0]])).points(q + 2e-3 * torch.sin(q))
    points = flat * (points + normal(60, 1, 3, seed=5, size=2e-5))
    points[:wrong] += flat * normal(wrong, 1, 3, seed=6, size=0.03)
    return robot, dc.Measurements(q, points, robot.joint_names)


@pytest.mark.parametrize("wrong", [0, 28])
def test_the_height_of_a_planar_robot_may_be_one_value(wrong: int) -> None:
    robot, data = planar_rows(wrong)
    assert [words for words, _ in stuck_columns(data)] == ["'z' of the positions"]
    found, texts = warned(with_usual_scales, robot, data)
    assert len(found.outliers) >= 0.8 * wrong
    assert any("are outliers" in one for one in texts) == bool(wrong)
    assert not any("one value" in one for one in texts)


def test_deviations_and_a_few_rows_are_no_stuck_columns_and_others_are() -> None:
    data = kind_named("positions").data
    for right in (
        with_attributes(data, std=torch.full_like(data.points, 2e-5)),
        stuck(data.rows(slice(5)), "position"),
    ):
        assert not [*stuck_columns(right)]
    for name, rows, column in (("heights", "height", "height"), ("images", "image", "v")):
        ((words, _),) = stuck_columns(stuck(kind_named(name).data, rows))
        assert f"'{column}' of the {rows}s" in words
    hidden = kind_named("hidden markers")
    _, texts = warned(dc.calibrate, hidden.robot, stuck(hidden.data, "position"), hyperparameters=hidden.scales)
    assert any("'marker3_z' of the positions holds one value" in one for one in texts)


@pytest.mark.parametrize(("step", "words"), [(5e-4, "0.0005 rad"), (math.radians(0.01), "0.01 degrees")])
def test_the_step_of_a_column(step: float, words: str, arm: Case) -> None:
    values = (arm.train.q[:, 1] / step).round() * step
    assert quantum(values, turning=True) == (pytest.approx(step), words)
    assert quantum(arm.train.q[:, 1], turning=True) is None
    assert quantum(values[:6], turning=True) is None  # a few round numbers are no evidence
    assert quantum(1e-6 * drawn(40), turning=True) is None  # nor is zero, of any step
    values = (torch.linspace(0.1, 0.6, 40, dtype=torch.float64).sqrt() * 1e3).round() / 1e3
    assert quantum(values, turning=False) == (pytest.approx(1e-3), "1 mm")


@pytest.mark.parametrize("step", [1e-2, 1e-3, 1e-6])
def test_rounded_joint_values_are_warned_about_where_they_cause_the_error(step: float) -> None:
    """Those of 1e-2 were commanded, and reached: their rounding would cause far larger errors than remain."""
    arm, train, _ = simulated(40)
    q = (train.q / step).round() * step
    points = arm.true_points(q) + 2e-5 * normal(40, 1, 3, seed=2) if step > 1e-3 else train.points
    words = r"waist_joint, .*, wrist_roll_joint are rounded to 0.001 rad: .* got 0\.\d+ mm RMS of position error"
    _, texts = warned(with_usual_scales, arm.nominal, dc.Measurements(q, points))
    assert [bool(re.search(words, one)) for one in texts if "rounded" in one] == [True] * (step == 1e-3)


ROWS = 45
ARM = SimulatedArm(seed=4, markers=3)
Q, POINTS = ARM.measure(ROWS, seed=5)
LABELS = torch.arange(ROWS) % 3


def labelled(path: Path, points: Tensor, labels: Tensor, q: Tensor = Q) -> dc.Measurements:
    names = ARM.nominal.joint_names
    rows = [[*one.tolist(), "ABCDEFGHI"[label]] for one, label in zip(torch.cat([q, points], 1), labels, strict=True)]
    write_rows(path, [*names, "x", "y", "z", "target"], [rows], TableFormat("m", "rad"))
    return dc.read_measurements(path, ARM.nominal, ["x", "y", "z"], length="m", angle="rad", duplicates="keep")


def test_several_markers_are_told_by_their_column(tmp_path: Path) -> None:
    data = labelled(tmp_path / "t.csv", POINTS[torch.arange(ROWS), LABELS], LABELS)
    start = register(ARM.nominal, data.q, data.points)
    column, words = marker_column(start.geometry, data) or ("", "")
    found = re.match(r"3 values between which the points jump by ([\d.]+) mm", words)
    assert column == "target"
    assert found is not None
    assert float(found[1]) == pytest.approx(1e3 * float(torch.cdist(ARM.truth.tool, ARM.truth.tool).max()), rel=0.1)
    refused(
        (
            r"column 'target' takes 3 values.* name the column: --marker target",
            lambda: check_identification(data, start),
        )
    )


@pytest.mark.parametrize("case", ["no jump", "other labels", "device", "mass", "repeated poses"])
def test_other_columns_name_no_marker(case: str, tmp_path: Path) -> None:
    """Labels without meaning, a device that moved, a load, a few poses again and again."""
    points, labels, q = POINTS[:, 0], LABELS, Q
    if case == "other labels":
        points, labels = POINTS[torch.arange(ROWS), LABELS], torch.arange(ROWS) // 9
    elif case == "device":
        points = points + tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.03, 0.01]])[labels]
    elif case == "mass":
        heavy = [ARM.measure(ROWS, seed=5, payload=mass)[1][:, 0] for mass in (0.0, 10.0, 40.0)]
        points = torch.stack(heavy)[labels, torch.arange(ROWS)]
    elif case == "repeated poses":
        q, labels = Q[:9].repeat(5, 1), torch.arange(9).repeat(5)
        points = ARM.true_points(q)[:, 0]
    data = labelled(tmp_path / "t.csv", points, labels, q)
    assert marker_column(register(ARM.nominal, data.q, data.points).geometry, data) is None


PAIR = SimulatedArm(seed=5, markers=2)
PAIR_ROWS = tracked(PAIR, 40, 1)
FIRST = PAIR_ROWS.points[:, 0]


def pair(first: Tensor, second: Tensor) -> dc.Measurements:
    return dc.Measurements(PAIR_ROWS.q, torch.stack([first, second], 1), PAIR_ROWS.joint_names)


def wished(digits: int, reached: float = 0.0) -> Tensor:
    """Places of the nominal robot in another frame, to so many digits of a mm, at joint values reached so well, rad."""
    q = PAIR_ROWS.q
    poses = PAIR.nominal(q + reached * normal(*q.shape))
    at = poses[:, :3, :3] @ tensor([0.02, 0.03, 0.1]) + poses[:, :3, 3]
    return (at @ rotation(tensor([-0.2, 0.1, 0.3])).mT + 0.4).round(decimals=3 + digits)


def test_markers_that_are_no_measurements_are_refused() -> None:
    """Wished places, and copies, also shifted ones; measured markers are silent."""
    follows, copy = (
        r"marker 1 follows the nominal robot to 0\.00.* mm, another one to",
        "marker 1 is a copy of marker 0",
    )
    shifted = FIRST + tensor([0.1, 0.0, 0.2])
    refused(
        (follows, lambda: dc.calibrate(PAIR.nominal, pair(FIRST, wished(2)))),
        (follows, lambda: check_markers(PAIR.nominal, pair(FIRST, wished(9)))),
        (copy, lambda: dc.calibrate(PAIR.nominal, pair(FIRST, FIRST.clone()))),
        (f"{copy}, shifted by the same", lambda: check_markers(PAIR.nominal, pair(FIRST, shifted))),
    )
    hidden = FIRST.clone()
    hidden[::2] = torch.nan
    assert [proved for _, _, proved in unmeasured_markers(PAIR.nominal, pair(FIRST, hidden))] == [True]
    for rows in (PAIR_ROWS, PAIR_ROWS.rows(slice(8))):
        assert not list(unmeasured_markers(PAIR.nominal, rows))


def test_a_marker_that_is_near_the_nominal_robot_is_measured_where_the_other_one_does_not_belong() -> None:
    """A robot with errors of micrometres, and a marker that is not on its tip: no proof against the first."""
    near = wished(4, reached=3e-5)
    with pytest.warns(DiffeoCalibWarning, match="marker 1 follows the nominal robot"):
        check_markers(PAIR.nominal, pair(FIRST, near))
    elsewhere = PAIR.nominal(PAIR_ROWS.q.roll(1, 0))[:, :3, 3]
    assert not list(unmeasured_markers(PAIR.nominal, pair(elsewhere, near)))
    planar, data = planar_rows()  # markers above each other on a robot whose axes are parallel are two
    above = torch.cat([data.points, data.points + tensor([0.0, 0.0, 0.1])], 1)
    assert not list(unmeasured_markers(planar, dc.Measurements(data.q, above)))
