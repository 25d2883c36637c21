"""Tables that were read wrongly: the right reading is found among others, and named only where the data tell."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from numbers_bank import drawn, normal, tensor
from product_bank import erring, simulated_poses, sliding_robot
from table_bank import read_table
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.likely_mistakes import (
    Reading,
    conventions_of,
    likely_mistake,
    other_columns,
    residual_of,
    warn_of_joints_below_tip,
)
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.measurements.csv.columns import JointExpressions
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import Joint, SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms

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
def test_inverted_rotations_and_poses(posed: tuple[SimulatedArm, dc.Measurements]) -> None:
    arm, data = posed
    turned = transforms(data.poses[:, :3, :3].mT, data.poses[:, :3, 3])
    for poses, words in ((turned, "the rotations alone seem"), (torch.linalg.inv(data.poses), "seen from the tool")):
        assert words in advice(arm.nominal, dc.Measurements.from_poses(data.q, poses))


def gantry() -> dc.Chain:
    """Three slides and a head that turns about x."""
    none, inf = [0.0, 0.0, 0.0], math.inf
    return robot(*(("prismatic", none, axis, -inf, inf) for axis in (X, Y, UP)), ("revolute", none, X, -inf, inf))


def test_no_claim_where_the_rotations_do_not_tell_conventions_apart(tmp_path: Path) -> None:
    """Turns about one axis are the same in many conventions."""
    q = drawn(24, 4)
    poses = gantry()(q)
    poses[:, :3, 3] += normal(24, 3, size=1e-5)
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
    added = ["y_2,load", *(f"{a},{b}" for a, b in drawn(30, 2).tolist())]
    lines = [f"{line},{cells}" for line, cells in zip(lines, added, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    names = list(arm.nominal.joint_names)
    read = read_table(path, names, ["x", "y_2", "z"], table, kinds=arm.nominal.kinds)
    assert "column 'y' fits in place of 'y_2': check the position columns (the median" in advice(arm.nominal, read)
    names[1] = "load"
    read = read_table(path, names, XYZ, table, kinds=arm.nominal.kinds)
    right = [
        one
        for one in other_columns(Reading.of(arm.nominal, read), read)
        if "'shoulder_joint' fits as shoulder_joint in pl" in one.words
    ]
    torch.testing.assert_close(right[0].q, data.q, rtol=1e-12, atol=1e-12)
    for changed in (lambda: path.write_text("another file\n"), path.unlink):
        changed()
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
    still = dc.Measurements(read.q, short(read.q)[:, None, :3, 3] + normal(40, 1, 3, size=1e-5))
    warn_of_joints_below_tip(short, still.with_columns(line_numbers=read.line_numbers, origin=read.origin))


def with_joint(q: Tensor, joint: int, factor: float, offset: float = 0.0) -> Tensor:
    return q.index_copy(1, torch.tensor([joint]), factor * q[:, [joint]] + offset)


MISTAKES: dict[str, Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    "1000 times too large": lambda q, y: (q, 1e3 * y),
    "radians that were converted": lambda q, y: (q.deg2rad(), y),
    "seems to be left-handed": lambda q, y: (q, y[..., [1, 0, 2]]),
    "joints='waist_joint,shoulder_joint,wrist_bend_joint,": lambda q, y: (q[:, [0, 1, 4, 3, 2, 5]], y),
    "pi/180*{elbow_joint},": lambda q, y: (with_joint(q, 2, 180 / math.pi), y),
    ",{elbow_joint}-90,": lambda q, y: (with_joint(q, 2, 1.0, math.pi / 2), y),
    "-{elbow_joint}": lambda q, y: (with_joint(with_joint(q, 2, -1.0), 4, -1.0), y),
}


@pytest.mark.parametrize("words", [*MISTAKES])
def test_what_joint_values_and_units_mean(words: str) -> None:
    arm = SimulatedArm(seed=3)
    assert words in advice(arm.nominal, dc.Measurements(*MISTAKES[words](*arm.measure(40, seed=4)), doubt=False))


def test_joints_of_a_slide() -> None:
    """Honest measurements have no mistake."""
    robot = sliding_robot()
    data = erring(robot, 40)
    assert advice(robot, data) == ""
    read = dc.Measurements(with_joint(data.q, 2, 1e-3), data.points)
    assert "1000 times too small: check their unit (`joint_length`)" in advice(robot, read)


UP, Y, X = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]


def robot(*joints: tuple[str, list[float], list[float], float, float], error: float = 0.0) -> dc.Chain:
    """Joints (kind, origin, axis, limits); origins differ by an error [m] from what is known of them."""
    made = []
    for k, (kind, origin, axis, low, high) in enumerate(joints):
        place = torch.eye(4, dtype=torch.float64)
        place[:3, 3] = tensor(origin) + normal(3, seed=k, size=error)
        made.append(Joint(f"j{k + 1}", kind, place, tensor(axis), lower=low, upper=high))
    return dc.Chain("robot", "base", "tip", made)


SCARA = (
    ("revolute", [0.0, 0.0, 0.3], UP, -2.3, 2.3),
    ("revolute", [0.4, 0.0, 0.0], UP, -2.5, 2.5),
    ("prismatic", [0.35, 0.0, 0.0], UP, -0.25, 0.0),
    ("revolute", [0.0, 0.0, 0.0], UP, -3.0, 3.0),
)
SEVEN = (
    ("revolute", [0.0, 0.0, 0.34], UP, -2.9, 2.9),
    ("revolute", [0.0, 0.0, 0.0], Y, -2.0, 2.0),
    ("revolute", [0.0, 0.0, 0.4], UP, -2.9, 2.9),
    ("revolute", [0.05, 0.0, 0.0], Y, -2.0, 2.0),
    ("revolute", [0.0, 0.0, 0.4], UP, -2.9, 2.9),
    ("revolute", [0.0, 0.0, 0.0], Y, -2.0, 2.0),
    ("revolute", [0.1, 0.0, 0.12], UP, -3.0, 3.0),
)


def measured(joints: tuple[Any, ...], rows: int = 40) -> tuple[Tensor, Tensor]:
    """Joint values (N, n) and a marker (N, 3) of a robot with errors of several mm, in another frame."""
    real = robot(*joints, error=0.003)
    low, high = real.limits.unbind(1)
    q = low + (high - low) * (0.2 + 0.6 * drawn(rows, real.n, seed=1))
    poses = real(q)
    seen = poses[:, :3, 3] + poses[:, :3, :3] @ tensor([0.03, -0.05, 0.08])
    return q, seen @ rotation(normal(3, seed=2)).mT + 2.0 + normal(rows, 3, seed=3, size=1e-4)


def found(joints: tuple[Any, ...], q: Tensor, points: Tensor) -> list[str]:
    """Expressions of the columns a, b, ..., in degrees and m."""
    nominal = robot(*joints)
    names = list("abcdefg"[: nominal.n])
    data = dc.Measurements(q, points, doubt=False)
    return [",".join(one.texts(names, "deg", 1.0)) for one in conventions_of(nominal, data, "deg")]


def test_signs_and_zeros_of_a_scara() -> None:
    """The zero of the first joint and of the last are those of base and marker: the plain one is named."""
    q, points = measured(SCARA)
    read = q.clone()
    read[:, 2] *= -1
    read[:, 1] -= math.pi / 2
    read[:, 0] += 1.0
    assert found(SCARA, read, points) == ["a,{b}+90,-{c},d"]


def test_percent_of_limits_beside_a_joint_that_stands_still() -> None:
    """Such as a gripper."""
    joints = (*SCARA[:2], SCARA[3], ("revolute", [0.0, 0.0, 0.1], X, 0.2, 0.8))
    q, points = measured((*joints[:3], (*joints[3][:3], 0.4, 0.4001)))
    read = q * torch.tensor([100.0 / math.degrees(one[4]) for one in joints])
    assert found(joints, read, points)[0].startswith("1.3178*{a},1.43239*{b},1.71887*{c},")


def test_expressions_that_were_read_are_composed() -> None:
    """Not nested: "-{-{b}+90}"."""
    q, points = measured(SCARA)
    read = q.clone()
    read[:, 1] *= -1
    (one,) = conventions_of(robot(*SCARA), dc.Measurements(read, points, doubt=False), "deg")
    given = JointExpressions.of(["a", "-{b}+90", "c", "{d}+{b}"])
    own = one.of_columns(given.matrix, given.offset, "deg", 1.0)
    assert own.texts(given.columns, "deg", 1.0) == ["a", "{b}-90", "c", "{b}+{d}"]


def test_nothing_is_proposed_for_a_right_table_of_a_wrong_robot() -> None:
    q, points = measured(SCARA)
    assert found(SCARA, q, points) == []
    shuffled = points[torch.randperm(40, generator=torch.Generator().manual_seed(0))]
    assert found(SCARA, q, shuffled) == []


@pytest.mark.slow
def test_a_seven_axis_arm() -> None:
    q, points = measured(SEVEN)
    middle = ",".join(f"360/4096*{{{name}}}+180" for name in "bcdef")
    assert f"360/4096*{{a}},{middle},360/4096*{{g}}" in found(SEVEN, (q + math.pi) * (4096 / 360), points)
