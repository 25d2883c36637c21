"""Tables that were read wrongly: the right reading is found among others, and named only where the data tell."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from product_bank import simulated_poses, sliding_measurements, sliding_robot
from table_bank import read_table

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.likely_mistakes import (
    likely_mistake,
    other_columns,
    residual_of,
    warn_of_joints_below_tip,
)
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

XYZ = ["x", "y", "z"]


@pytest.fixture(scope="module")
def posed() -> tuple[SimulatedArm, dc.Measurements]:
    arm, train, _ = simulated_poses(40)
    return arm, train


def advice(robot: dc.Tree, data: dc.Measurements) -> str:
    return likely_mistake(robot, data, residual_of(robot, data))


def written_and_read(
    folder: Path, data: dc.Measurements, robot: dc.Tree, convention: str, wrong: dict[str, object]
) -> dc.Measurements:
    """Poses after they were written in one convention and read with other options."""
    unit = None if convention.startswith(("quat", "matrix")) else "deg"
    table = TableFormat("mm", "deg", convention=convention, rotation_angle=unit)
    write_measurements(folder / "t.csv", data, table, joints=robot)
    right = replace(table.for_writing(rotation_std=False), rotation_angle=unit)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DiffeoCalibWarning)  # a wrong unit is doubted when it is read
        return read_table(folder / "t.csv", robot, XYZ, replace(right, **wrong))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("convention", "wrong", "words"),
    [
        ("XYZ", {"convention": "xyz"}, "written with convention='XYZ' (the median residual falls from "),
        ("zyx", {"convention": "rotvec"}, "written with convention='zyx' (the"),
        ("rotvec", {"convention": "ZYX"}, "written with convention='rotvec' (the"),
        ("quat_wxyz", {"convention": "quat_xyzw"}, "written with convention='quat_wxyz' (the"),
        ("XYZ", {"rotation_angle": "rad"}, "written with rotation_angle='deg' (the"),
        ("XYZ", {"rotation": ["euler2", "euler1", "euler3"]}, "to be in the order euler1,euler2,euler3 (the"),
    ],
)
def test_the_right_reading_of_rotations(
    convention: str, wrong: dict[str, object], words: str, posed: tuple[SimulatedArm, dc.Measurements], tmp_path: Path
) -> None:
    arm, data = posed
    read = written_and_read(tmp_path, data, arm.nominal, convention, wrong)
    assert words in advice(arm.nominal, read)


@pytest.mark.slow
def test_a_refusal_names_the_convention(posed: tuple[SimulatedArm, dc.Measurements], tmp_path: Path) -> None:
    arm, data = posed
    read = written_and_read(tmp_path, data, arm.nominal, "xyz", {"convention": "XYZ"})
    with pytest.raises(MeasurementError, match=r"do not fit this robot.*written with convention='xyz' \(the median"):
        dc.calibrate(arm.nominal, read)


@pytest.mark.slow
def test_inverted_poses_and_rotations(posed: tuple[SimulatedArm, dc.Measurements]) -> None:
    arm, data = posed
    assert data.poses is not None
    inverse = dc.Measurements.from_poses(data.q, torch.linalg.inv(data.poses))
    assert "seen from the tool" in advice(arm.nominal, inverse)
    turned = transforms(data.poses[:, :3, :3].mT, data.poses[:, :3, 3])
    assert "the rotations alone seem to be inverted" in advice(arm.nominal, dc.Measurements.from_poses(data.q, turned))


def gantry() -> dc.Chain:
    """Three slides and a head that turns about x."""
    one = torch.eye(4, dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)
    slides = [Joint(f"slide_{name}", "prismatic", one, axis) for name, axis in zip(XYZ, axes, strict=True)]
    return dc.Chain("gantry", "base", "head", [*slides, Joint("head", "revolute", one, axes[0])])


def test_no_claim_where_the_rotations_do_not_tell_conventions_apart(tmp_path: Path) -> None:
    """Turns about one axis are the same in many conventions."""
    generator = torch.Generator().manual_seed(0)
    q = torch.rand(24, 4, dtype=torch.float64, generator=generator)
    poses = gantry()(q)
    poses[:, :3, 3] += 1e-5 * torch.randn(24, 3, dtype=torch.float64, generator=generator)
    data = dc.Measurements.from_poses(q, poses)
    said = advice(gantry(), written_and_read(tmp_path, data, gantry(), "xyz", {"convention": "zyx"}))
    for option in ("'xyz'", "'XYZ'", "'rotvec'"):
        assert f" or convention={option}" in said or f"with convention={option}" in said
    assert "which these rows do not tell apart" in said
    assert "convention='yxz'" not in said


@pytest.mark.slow
def test_a_wrong_column(tmp_path: Path) -> None:
    arm = SimulatedArm(seed=1)
    data = dc.Measurements(*arm.measure(30, seed=2), arm.nominal.joint_names)
    path, table = tmp_path / "t.csv", TableFormat("mm", "deg")
    write_measurements(path, data, table)
    lines = path.read_text().splitlines()
    noise = torch.rand(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).tolist()
    added = ["y_2,load", *(f"{a},{b}" for a, b in noise)]
    lines = [f"{line},{cells}" for line, cells in zip(lines, added, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    names = list(arm.nominal.joint_names)
    read = read_table(path, names, ["x", "y_2", "z"], table, kinds=arm.nominal.kinds)
    assert "column 'y' fits in place of 'y_2': check the position columns (the median" in advice(arm.nominal, read)
    names[1] = "load"
    read = read_table(path, names, XYZ, table, kinds=arm.nominal.kinds)
    right = [
        one for one in other_columns(arm.nominal, read) if "'shoulder_joint' fits as shoulder_joint in pl" in one.words
    ]
    torch.testing.assert_close(right[0].q, data.q, rtol=1e-12, atol=1e-12)
    assert isinstance(read.origin, TableOrigin)
    assert read.origin.numeric_columns(read.line_numbers)["load"].tolist() == [row[1] for row in noise]
    path.write_text("another file\n")
    assert read.origin.numeric_columns(read.line_numbers) == {}
    path.unlink()
    assert read.origin.numeric_columns(read.line_numbers) == {}


@pytest.mark.slow
def test_a_joint_below_the_tip(tmp_path: Path) -> None:
    arm = SimulatedArm(seed=1)
    arm.write_urdf(tmp_path / "arm.urdf")
    path, table = tmp_path / "t.csv", TableFormat("mm", "deg")
    write_measurements(path, dc.Measurements(*arm.measure(40, seed=2), arm.nominal.joint_names), table)
    short = dc.load_urdf(tmp_path / "arm.urdf", "base_link", "wrist_link")
    read = read_table(path, short, XYZ, table)
    words = "joint 'wrist_roll_joint', which is below the tip 'wrist_link': choose 'output_link' or a link below it"
    with pytest.warns(DiffeoCalibWarning, match=f"a joint below the tip seems to move the markers: .*{words}"):
        warn_of_joints_below_tip(short, read)
    # A joint below the tip that does not move the marker, as of a gripper, is no reason for a warning.
    turned = read.q.clone()
    still = dc.Measurements(turned, short(turned)[:, None, :3, 3] + 1e-5 * torch.rand(40, 1, 3, dtype=torch.float64))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_joints_below_tip(short, still.with_columns(line_numbers=read.line_numbers, origin=read.origin))


@pytest.mark.slow
def test_prismatic_joints_in_another_unit() -> None:
    robot = sliding_robot()
    data = sliding_measurements(robot, 40)
    q = data.q.clone()
    q[:, 2] *= 1e-3
    assert "1000 times too small: check their unit (`joint_length`)" in advice(robot, dc.Measurements(q, data.points))


def test_honest_measurements_have_no_mistake() -> None:
    robot = sliding_robot()
    assert advice(robot, sliding_measurements(robot, 8)) == ""


def test_what_joint_values_and_units_mean() -> None:
    """Signs of one joint and of two, a column in degrees, centimetres; several meanings that nothing tells apart."""
    arm = SimulatedArm(seed=3)
    q, points = arm.measure(40, seed=4)
    one, two = torch.ones(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
    one[2], two[[2, 4]] = -1.0, -1.0
    assert "in degrees and mm, with joints='waist_joint,shoulder_joint,-{elbow_joint}," in advice(
        arm.nominal, dc.Measurements(q * one, points)
    )
    said = advice(arm.nominal, dc.Measurements(q * two, points))
    assert "shoulder_joint,-{elbow_joint},forearm_roll_joint,-{wrist_bend_joint}," in said
    assert " or " in said
    assert "{forearm_roll_joint}+180,wrist_bend_joint," in said
    assert "do not tell apart" in said
    one[2] = 180 / math.pi
    assert "pi/180*{elbow_joint}," in advice(arm.nominal, dc.Measurements(q * one, points, doubt=False))
    assert "100 times too small" in advice(arm.nominal, dc.Measurements(q, 0.01 * points))
    assert "10 times too large" in advice(arm.nominal, dc.Measurements(q, 10 * points))


def test_hidden_markers_do_not_spoil_a_diagnosis(tmp_path: Path) -> None:
    """A column in the place of a coordinate has values where the marker is hidden."""
    arm = SimulatedArm(seed=1, markers=3)
    q, points = arm.measure(30, seed=2)
    q[:, 2] += q[:, 1]
    points[[3, 8, 20], [0, 1, 2]] = torch.nan
    path, table = tmp_path / "t.csv", TableFormat("mm", "deg")
    write_measurements(path, dc.Measurements(q, points, arm.nominal.joint_names), table)
    lines = [f"{line},{'marker1_x2' if row == 0 else row}" for row, line in enumerate(path.read_text().splitlines())]
    path.write_text("\n".join(lines) + "\n")
    read = read_table(path, arm.nominal, [[f"marker{k}_{axis}" for axis in XYZ] for k in (1, 2, 3)], table)
    replaced = [one for one in other_columns(arm.nominal, read) if "'marker1_x2' fits in place" in one.words]
    assert replaced
    for one in replaced:
        assert torch.equal(one.points.isnan(), points.isnan())
    assert "-{shoulder_joint}+{elbow_joint}" in advice(arm.nominal, read)


def test_a_marker_that_is_half_hidden_does_not_end_a_reading() -> None:
    arm = SimulatedArm(seed=1)
    q, points = arm.measure(30, seed=2)
    whole: Any = SimpleNamespace(q=q, points=points.clone(), on=None)
    points[2, 0, 1] = torch.nan
    rows: Any = SimpleNamespace(q=q, points=points, on=None)
    assert residual_of(arm.nominal, rows) == pytest.approx(residual_of(arm.nominal, whole), rel=0.2)


def test_a_reading_that_cannot_be_registered_says_nothing() -> None:
    arm = SimulatedArm(seed=1)
    q, points = arm.measure(30, seed=2)
    rows: Any = SimpleNamespace(q=q[:4], points=points[:4], on=None)
    assert residual_of(arm.nominal, rows) == torch.inf
