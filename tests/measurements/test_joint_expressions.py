"""Joints as linear expressions of columns, and commanded poses in their place: what they mean, there and back."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from table_bank import random_poses
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.columns import Columns, JointExpressions, PoseColumns
from diffeo_calib.measurements.csv.files import read_joints, read_poses, write_measurements
from diffeo_calib.measurements.csv.lines import read_cells, write_columns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, TableFormat


@pytest.mark.parametrize(
    ("text", "factors", "constant"),
    [
        ("J1", {"J1": 1.0}, 0.0),
        ("-J2+90", {"-J2+90": 1.0}, 0.0),
        ("Base (deg) {x}", {"Base (deg) {x}": 1.0}, 0.0),
        ("-{J2}+90", {"J2": -1.0}, 90.0),
        ("{J3} + {J2}", {"J3": 1.0, "J2": 1.0}, 0.0),
        ("0.5*{J4}", {"J4": 0.5}, 0.0),
        ("{Joint-4 [deg]}/2 - 1e-1", {"Joint-4 [deg]": 0.5}, -0.1),
        ("360/4096*{ticks5}-180", {"ticks5": 360 / 4096}, -180.0),
        ("180/pi*{q}+pi/2", {"q": 180 / math.pi}, math.pi / 2),
        ("+{a}-{b}*2+{a}", {"a": 2.0, "b": -2.0}, 0.0),
    ],
)
def test_what_a_text_means(text: str, factors: dict[str, float], constant: float) -> None:
    found = JointExpressions.of([text])
    assert dict(zip(found.columns, found.matrix[0].tolist(), strict=True)) == pytest.approx(factors)
    assert float(found.offset) == pytest.approx(constant)
    assert bool(found.plain) == ("{" not in text or text.endswith("{x}"))


def test_what_is_not_linear_or_not_told_is_refused() -> None:
    for text in ("{a}*{b}", "1/{a}", "{a}/0", "{a}+1/0"):
        with pytest.raises(MeasurementError, match=r"expected a linear expression of columns.*sums of terms"):
            JointExpressions.of([text])
    for texts in (["{a}+{b}"], ["{a}", "2*{a}+1"], ["{a}+{b}", "{c}"]):
        with pytest.raises(MeasurementError, match="columns that the joints determine"):
            JointExpressions.of(texts).cells(torch.zeros(2, len(texts), dtype=torch.float64))
    for text, message in (
        ("x,y,z,a,b,c", "expected =CONVENTION behind them"),
        ("x,y,z,a,b=xyz", "expected 6 names of columns"),
        ("x,y,z,a,b,c=zz", "`convention`: expected"),
        ("x,y,x", "expected names of columns"),
        ("x,y,z,,b,c=xyz", "expected 6 names of columns"),
    ):
        with pytest.raises(MeasurementError, match=message):
            PoseColumns.of(text)


def test_a_table_is_read_and_written_in_its_own_columns(tmp_path: Path) -> None:
    """Degrees, a coupled joint and a slide in mm; the file keeps its columns, the data the robot's names."""
    texts, kinds = ["-{A}+90", "{B}+{A}", "{s}+5"], ["revolute", "revolute", "prismatic"]
    plain, path = TableFormat("mm", "deg"), tmp_path / "t.csv"
    table = replace(plain, joints=texts, kinds=kinds)
    cells = [[10.0, 20.0, 7.0], [-30.0, 5.0, 9.5]]
    path.write_text("\n".join(["note,s,A,B,x,y,z", *(f"n,{s},{a},{b},100,2,{k}" for k, (a, b, s) in enumerate(cells))]))
    rows = [[math.radians(90 - a), math.radians(a + b), (s + 5) / 1e3] for a, b, s in cells]
    expected = torch.tensor(rows, dtype=torch.float64)
    assert_close(read_joints(path, table), expected)
    names, how = ["j1", "j2", "j3"], {"length": "mm", "angle": "deg"}
    data = dc.read_measurements(path, names, ["x", "y", "z"], joints=texts, kinds=kinds, **how)
    assert data.joint_names == tuple(names)
    assert_close(data.q, expected)
    assert isinstance(data.origin, TableOrigin)
    assert "--joints '-{A}+90,{B}+{A},{s}+5'" in data.origin.options
    write_measurements(tmp_path / "again.csv", data, plain, joints=texts, kinds=kinds)
    assert (tmp_path / "again.csv").read_text().startswith("A,B,s,x,y,z")
    assert_close(read_joints(tmp_path / "again.csv", table), expected)
    moved = Columns.of(table.joints_only()).cells(expected + 0.01, {})
    write_columns(tmp_path / "new.csv", read_cells(path, table.sep), moved, plain)
    assert_close(read_joints(tmp_path / "new.csv", table), expected + 0.01)


@pytest.mark.parametrize(("length", "angle"), [("mm", "deg"), ("m", "rad")])
@pytest.mark.parametrize("convention", ["rotvec", "quat_wxyz", "matrix", "zyx", "XYZ"])
def test_commanded_poses_there_and_back(convention: str, length: str, angle: str, tmp_path: Path) -> None:
    commanded = random_poses(12)
    turns = rotation_numbers(commanded[:, :3, :3], convention, angle=angle)
    cells = torch.cat([UNITS_PER_METRE[length] * commanded[:, :3, 3], turns], 1)
    names = [f"c{k}" for k in range(cells.shape[1])]
    path = tmp_path / "commanded.csv"
    path.write_text("\n".join([",".join(names), *(",".join(map(repr, row)) for row in cells.tolist()), ""]))
    columns, table = PoseColumns.of(f"{','.join(names)}={convention}"), TableFormat(length, angle)
    assert_close(read_poses(path, replace(table, joints=columns))[1], commanded, rtol=0, atol=1e-12)
    robot = dc.cartesian(commanded)
    table = replace(table, joints=replace(columns, robot=robot))
    q = read_joints(path, table)
    assert_close(robot(q), commanded, rtol=0, atol=1e-12)
    q[2] = torch.nan  # rows without a command stay empty
    again = Columns.of(table.joints_only()).joints_from_si(q)
    assert again.isnan().all(1).tolist() == [row == 2 for row in range(12)]
    kept = torch.arange(12) != 2
    back = PoseColumns(columns.columns, convention, angle=angle).poses(again[kept])
    assert_close(back[:, :3, :3], commanded[kept, :3, :3], rtol=0, atol=1e-12)
    assert_close(again[kept, :3], cells[kept, :3], rtol=1e-12, atol=1e-12)
