"""Denavit-Hartenberg tables, in both conventions."""

import os
import re
from math import cos, nan, pi, sin
from pathlib import Path

import pytest
import torch

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots import DHRow, from_dh, load_urdf

# data/README: UR10, standard convention, (a, alpha, d) [m, rad]
UR10 = [
    (0.0, pi / 2, 0.1273),
    (-0.612, 0.0, 0.0),
    (-0.5723, 0.0, 0.0),
    (0.0, pi / 2, 0.163941),
    (0.0, -pi / 2, 0.1157),
    (0.0, 0.0, 0.0922),
]


def turn_z(a: float) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:2, :2] = torch.tensor([[cos(a), -sin(a)], [sin(a), cos(a)]], dtype=torch.float64)
    return matrix


def turn_x(a: float) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[1:3, 1:3] = torch.tensor([[cos(a), -sin(a)], [sin(a), cos(a)]], dtype=torch.float64)
    return matrix


def shift(x: float, z: float) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 3], matrix[2, 3] = x, z
    return matrix


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_table_multiplies_out_as_the_convention_says(convention: str) -> None:
    rows = [DHRow(0.1, 0.4, 0.3, 0.2), DHRow(-0.2, -1.1, 0.5, 0.7, "prismatic"), DHRow(0.3, 0.9, -0.1)]
    chain = from_dh(rows, convention)
    q = torch.tensor([[0.3, -0.4, 1.2]], dtype=torch.float64)
    expected = torch.eye(4, dtype=torch.float64)
    for row, value in zip(rows, q[0].tolist(), strict=True):
        theta, d = (row.theta + value, row.d) if row.kind == "revolute" else (row.theta, row.d + value)
        about_z, about_x = turn_z(theta) @ shift(0, d), shift(row.a, 0) @ turn_x(row.alpha)
        expected = expected @ (about_z @ about_x if convention == "standard" else about_x @ about_z)
    torch.testing.assert_close(chain(q)[0], expected, rtol=0, atol=1e-15)
    assert chain.kinds == ("revolute", "prismatic", "revolute")
    assert chain.joint_names == ("joint_1", "joint_2", "joint_3")


def turn_y(a: float) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 0], matrix[0, 2], matrix[2, 0], matrix[2, 2] = cos(a), sin(a), -sin(a), cos(a)
    return matrix


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_hayati_s_twist_comes_after_alpha(convention: str) -> None:
    rows = [DHRow(0.1, 0.4, 0.3, 0.2, beta=0.5), DHRow(-0.2, -0.1, 0.0, 0.7, "prismatic", beta=-0.3)]
    q = torch.tensor([[0.3, -0.4]], dtype=torch.float64)
    expected = torch.eye(4, dtype=torch.float64)
    for row, (theta, d) in zip(rows, [(0.5, 0.3), (0.7, -0.4)], strict=True):
        about_z = turn_z(theta) @ shift(0, d)
        x = shift(row.a, 0) @ turn_x(row.alpha) @ turn_y(row.beta)
        expected = expected @ (about_z @ x if convention == "standard" else x @ about_z)
    torch.testing.assert_close(from_dh(rows, convention)(q)[0], expected, rtol=0, atol=1e-15)


def test_tuples_are_rows() -> None:
    rows = [(0.1, 0.4, 0.3), (0.1, 0.4, 0.3, 0.2), (0.1, 0.4, 0.3, 0.2, "prismatic")]
    same = [DHRow(0.1, 0.4, 0.3), DHRow(0.1, 0.4, 0.3, 0.2), DHRow(0.1, 0.4, 0.3, 0.2, "prismatic")]
    q = torch.tensor([[0.5, -0.6, 0.7]], dtype=torch.float64)
    chain = from_dh(rows, names=["a", "b", "c"], name="table")
    torch.testing.assert_close(chain(q), from_dh(same)(q))
    assert (chain.name, chain.joint_names) == ("table", ("a", "b", "c"))


def test_ur10_table_and_urdf_are_one_robot() -> None:
    folder = os.environ.get("DIFFEO_CALIB_DATA")
    if not folder:
        pytest.skip("needs the measured robots: set DIFFEO_CALIB_DATA to their folder")
    urdf = load_urdf(Path(folder) / "ipa_ur10" / "ur10_robot.urdf", "base_link", "ee_link")
    q = 6 * torch.rand(50, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 3
    table = turn_z(pi) @ from_dh(UR10)(q)
    constant = torch.linalg.inv(table) @ urdf(q)
    # The file writes pi / 2 with 12 digits: 5e-12 rad on a metre of arm, several times.
    torch.testing.assert_close(constant, constant[:1].expand_as(constant), rtol=0, atol=1e-10)
    torch.testing.assert_close(constant[:, :3, 3], torch.zeros(50, 3, dtype=torch.float64), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([],), "the DH table is empty"),
        (([(0, 0, 0)], "modified"), "`convention`: expected 'standard' or 'craig', got 'modified'"),
        (([(0, 0, 0), (0, 0)],), "row 1 of the DH table: expected (a, alpha, d[, theta[, kind[, mimic"),
        (([(0, 0, 0, 0, "revolute", None, 0, 0)],), "mimic_offset]]]]), got 8 entries"),
        (([(0, 0, 0), (0, 0, 0, 0, "revolute", {"elbow": 1})],), "joint 'joint_2' of robot 'robot' mimics 'elbow'"),
        (([(0, 0, 0), DHRow(0, 0, 0, mimic={"joint_1": nan})],), "the multiplier of 'joint_1' in joint 'joint_2'"),
        (([(0, nan, 0)],), "row 0 of the DH table: expected finite numbers"),
        (([DHRow(0, 0, 0, beta=nan)],), "row 0 of the DH table: expected finite numbers"),
        (([(0, "x", 0)],), "row 0 of the DH table: expected numbers"),
        (([(0, 0, 0, 0, "ball")],), "the kind in row 0 of the DH table"),
        (([DHRow(0, 0, 0, 0, "fixed")],), "the kind in row 0 of the DH table"),
        (([(0, 0, 0)], "standard", ["a", "b"]), "`names`: expected 1 names"),
        (([(0, 0, 0), (0, 0, 0)], "standard", ["a", "a"]), "several joints named ['a']"),
    ],
)
def test_wrong_tables_are_explained(arguments: tuple, message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        from_dh(*arguments)
