"""Denavit-Hartenberg tables, in both conventions."""

import re
from dataclasses import replace
from math import nan, pi
from typing import Any

import pytest
import torch
from scipy.spatial.transform import Rotation

from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, RobotError
from diffeo_calib.robots import DHRow, from_dh
from diffeo_calib.robots.tree import robot_from_config


def moved(axis: str, angle: float, *shift: float) -> torch.Tensor:
    """A shift, then a turn about an axis."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.from_numpy(Rotation.from_euler(axis, angle).as_matrix())
    matrix[:3, 3] = torch.tensor(shift or (0.0, 0.0, 0.0), dtype=torch.float64)
    return matrix


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_table_multiplies_out_as_the_convention_says(convention: str) -> None:
    """Hayati's twist comes after alpha."""
    rows = [DHRow(0.1, 0.4, 0.3, 0.2, beta=0.5), DHRow(-0.2, -1.1, 0.5, 0.7, "prismatic"), DHRow(0.3, 0.9, -0.1)]
    chain = from_dh(rows, convention)
    q = torch.tensor([[0.3, -0.4, 1.2]], dtype=torch.float64)
    expected = torch.eye(4, dtype=torch.float64)
    for row, value in zip(rows, q[0].tolist(), strict=True):
        theta, d = (row.theta + value, row.d) if row.kind == "revolute" else (row.theta, row.d + value)
        about_z, about_x = moved("z", theta, 0, 0, d), moved("x", row.alpha, row.a, 0, 0) @ moved("y", row.beta)
        expected = expected @ (about_z @ about_x if convention == "standard" else about_x @ about_z)
    torch.testing.assert_close(chain(q)[0], expected, rtol=0, atol=1e-15)
    assert chain.kinds == ("revolute", "prismatic", "revolute")
    assert chain.joint_names == ("joint_1", "joint_2", "joint_3")
    named = from_dh([(0.1, 0.4, 0.3, 0.2), *rows[1:]], convention, names=["a", "b", "c"], name="table")
    assert (named.name, named.joint_names) == ("table", ("a", "b", "c"))


def test_angles_beyond_a_turn_are_angles() -> None:
    """As in calibrated tables of makers; degrees are warned about."""
    turned = from_dh([(0.1, 0.3, 0.2), (0.2, 6.50222, 0.1, -6.4)])
    same = from_dh([(0.1, 0.3, 0.2), (0.2, 6.50222 - 2 * pi, 0.1, 2 * pi - 6.4)])
    q = torch.rand(5, 2, dtype=torch.float64)
    torch.testing.assert_close(turned(q), same(q), rtol=0, atol=1e-14)
    with pytest.warns(DiffeoCalibWarning, match="an angle in row 1 of the DH table is 90 rad; convert degrees"):
        from_dh([(0, 1, 0), (0, 90, 0)])


@pytest.mark.parametrize("row", [(612, 0, 0), (0, 0, -128)])
def test_millimetres_are_warned_about(row: tuple[float, float, float]) -> None:
    with pytest.warns(DiffeoCalibWarning, match="row 0 of the DH table is .* in mm"):
        from_dh([row])
    with pytest.warns(DiffeoCalibWarning, match="inf m"), pytest.raises(InputError, match="the origin of joint"):
        from_dh([(1e308, 0.0, 0.0)])


BRANCHED = [
    DHRow(0.0, pi / 2, 0.4),
    DHRow(0.1, 0.3, 0.2, 0.5),
    DHRow(0.2, -0.7, 0.1, kind="prismatic"),
    DHRow(0.3, 1.1, 0.0),
    DHRow(-0.2, 0.4, 0.1, parent=1),
    DHRow(0.1, -0.9, 0.3),
    DHRow(0.5, 0.2, 0.1, parent=-1),
]
PATHS = {"tip_1": [0, 1, 2, 3], "tip_2": [0, 1, 4, 5], "tip_3": [6]}


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_every_branch_is_the_chain_of_its_rows(convention: str) -> None:
    robot = from_dh(BRANCHED, convention)
    assert robot.tips == tuple(PATHS)
    assert robot.n == len(BRANCHED)
    q = torch.linspace(-1.0, 1.2, 3 * 7, dtype=torch.float64).view(3, 7)
    poses = robot(q)
    for tip, path in PATHS.items():
        alone = from_dh([replace(BRANCHED[row], parent=None) for row in path], convention)
        torch.testing.assert_close(poses[:, robot.tips.index(tip)], alone(q[:, path]), rtol=0, atol=1e-14)


def test_branches_without_a_tip_only_weigh() -> None:
    robot = from_dh(BRANCHED, tips={"hand": 5})
    assert (robot.tips, robot.loads) == (("hand",), ("joint_4", "joint_7"))
    q = torch.linspace(-1.0, 1.2, 7, dtype=torch.float64)[None]
    torch.testing.assert_close(robot(q), from_dh(BRANCHED)(q)[:, 1], rtol=0, atol=0)
    assert robot_from_config(robot.to_config())(q).equal(robot(q))
    middle = from_dh(BRANCHED, tips={"elbow": 4, "hand": 5})(q)
    torch.testing.assert_close(middle[:, 1], robot(q), rtol=0, atol=0)


FORK = [DHRow(0, 0, 0.3), DHRow(0.3, 1.2, 0.1), DHRow(0.3, 0.9, 0.1, parent=0)]
ROW = (0, 0, 0)


@pytest.mark.parametrize(
    ("rows", "arguments", "message"),
    [
        (5, {}, "the DH table: expected rows"),
        ([ROW], {"convention": "modified"}, "`convention`: expected 'standard' or 'craig', got 'modified'"),
        ([ROW, (0, 0)], {}, "row 1 of the DH table: expected (a, alpha, d[, theta[, kind[, mimic"),
        ([(0, 0, 0, 0, "revolute", None, 0, 0)], {}, "mimic_offset]]]]), got 8 entries"),
        ([ROW, (0, 0, 0, 0, "revolute", {"elbow": 1})], {}, "joint 'joint_2' of robot 'robot' mimics 'elbow'"),
        ([ROW, DHRow(0, 0, 0, mimic={"joint_1": nan})], {}, "the multiplier of 'joint_1' in joint 'joint_2'"),
        ([(0, nan, 0)], {}, "row 0 of the DH table: expected finite numbers"),
        ([(0, 0, 0, 0, "ball")], {}, "the kind in row 0 of the DH table"),
        ([ROW], {"names": ["a", "b"]}, "`names`: expected 1 names"),
        (FORK, {"names": 5}, "`names`: expected 3 names, one for each row, got 5"),
        ([ROW, ROW], {"names": ["a", "a"]}, "several joints named ['a']"),
        *(([ROW, DHRow(*ROW, parent=parent)], {}, "the parent in row 1") for parent in (4, -2, 1.0, False)),
        (FORK, {"tips": {"hand": 7}}, "`tips` of the DH table: expected names with numbers of rows, 0 to 2"),
        *((FORK, {"tips": {tip: 1}}, "the name of a tip of the DH table") for tip in ("joint_3", "base", "")),
    ],
)
def test_wrong_tables_are_explained(rows: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        from_dh(rows, **arguments)
