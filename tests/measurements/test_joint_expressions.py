"""Joints as linear expressions of columns, and commanded poses in their place: what they mean, there and back."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.files import read_joints, read_poses, write_measurements
from diffeo_calib.measurements.csv.joints import JointExpressions, PoseColumns
from diffeo_calib.measurements.csv.lines import read_cells, write_columns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import ALL_CONVENTIONS, UNITS_PER_METRE, TableFormat
from diffeo_calib.robots.se3 import transforms


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


@pytest.mark.parametrize("text", ["{a}*{b}", "1/{a}", "{a}/0", "{a}+1/0"])
def test_what_is_not_linear_is_refused(text: str) -> None:
    with pytest.raises(MeasurementError, match=r"expected a linear expression of columns.*sums of terms"):
        JointExpressions.of([text])


def test_cells_are_the_inverse_of_values() -> None:
    found = JointExpressions.of(["-{a}+90", "{b}+{a}", "360/4096*{c}-180"])
    cells = torch.rand(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert_close(found.cells(found.values(cells)), cells, rtol=0, atol=1e-9)
    assert_close(found.values(cells)[:, 1], cells[:, 0] + cells[:, 1])


@pytest.mark.parametrize("texts", [["{a}+{b}"], ["{a}", "2*{a}+1"], ["{a}+{b}", "{c}"]])
def test_columns_that_the_joints_do_not_tell_are_not_written(texts: list[str]) -> None:
    with pytest.raises(MeasurementError, match="columns that the joints determine"):
        JointExpressions.of(texts).cells(torch.zeros(2, len(texts), dtype=torch.float64))


def test_a_table_is_read_and_written_in_its_own_columns(tmp_path: Path) -> None:
    """Degrees, a coupled joint and a slide in mm; the file keeps its columns, the data the robot's names."""
    texts, kinds = ["-{A}+90", "{B}+{A}", "{s}+5"], ["revolute", "revolute", "prismatic"]
    table = TableFormat("mm", "deg")
    cells = [[10.0, 20.0, 7.0], [-30.0, 5.0, 9.5]]
    rows = ["note,s,A,B,x,y,z", *(f"n,{s},{a},{b},100,200,{k}" for k, (a, b, s) in enumerate(cells))]
    (tmp_path / "t.csv").write_text("\n".join(rows))
    expected = torch.tensor(
        [[math.radians(90 - a), math.radians(a + b), (s + 5) / 1e3] for a, b, s in cells], dtype=torch.float64
    )
    assert_close(read_joints(tmp_path / "t.csv", replace(table, joints=texts, kinds=kinds)), expected)
    data = dc.read_measurements(
        tmp_path / "t.csv", ["j1", "j2", "j3"], ["x", "y", "z"], joints=texts, kinds=kinds, length="mm", angle="deg"
    )
    assert data.joint_names == ("j1", "j2", "j3")
    assert_close(data.q, expected)
    assert isinstance(data.origin, TableOrigin)
    assert "--joints '-{A}+90,{B}+{A},{s}+5'" in data.origin.options
    write_measurements(tmp_path / "again.csv", data, table, joints=texts, kinds=kinds)
    assert (tmp_path / "again.csv").read_text().startswith("A,B,s,x,y,z")
    assert_close(read_joints(tmp_path / "again.csv", replace(table, joints=texts, kinds=kinds)), expected)
    columns = Columns.of(replace(table, joints=texts, kinds=kinds).joints_only())
    cells = columns.cells(expected + 0.01, {})
    write_columns(tmp_path / "new.csv", read_cells(tmp_path / "t.csv", table.sep), cells, table)
    assert_close(read_joints(tmp_path / "new.csv", replace(table, joints=texts, kinds=kinds)), expected + 0.01)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("mm", 1e-3), ("cm", 1e-2), ("inch", 0.0254)])
def test_units_of_length(unit: str, metres: float, tmp_path: Path) -> None:
    lengths = [f"{value / metres!r}" for value in (0.4, 1.0, 2.0, 3.0)]
    (tmp_path / "t.csv").write_text(f"a,s,x,y,z\n0.5,{','.join(lengths)}\n")
    how = {"length": unit, "angle": "rad", "kinds": ["revolute", "prismatic"]}
    data = dc.read_measurements(tmp_path / "t.csv", ["a", "s"], ["x", "y", "z"], **how)
    assert_close(data.points[0, 0], torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    assert float(data.q[0, 1]) == pytest.approx(0.4)


def poses(count: int = 12) -> Tensor:
    draws = torch.randn(count, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    skewed = torch.zeros(count, 3, 3, dtype=torch.float64)
    skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0] = (0.5 * draws[:, 3:]).unbind(1)
    return transforms((skewed - skewed.mT).matrix_exp(), draws[:, :3])


@pytest.mark.parametrize("convention", ALL_CONVENTIONS)
@pytest.mark.parametrize(("length", "angle"), [("mm", "deg"), ("m", "rad")])
def test_there_and_back(convention: str, length: str, angle: str, tmp_path: Path) -> None:
    commanded = poses()
    turns = rotation_numbers(commanded[:, :3, :3], convention, angle=angle)
    cells = torch.cat([UNITS_PER_METRE[length] * commanded[:, :3, 3], turns], 1)
    names = [f"c{k}" for k in range(cells.shape[1])]
    path = tmp_path / "commanded.csv"
    lines = [",".join(map(repr, row)) for row in cells.tolist()]
    path.write_text("\n".join([",".join(names), *lines, ""]), encoding="utf-8")
    columns, table = PoseColumns.of(f"{','.join(names)}={convention}"), TableFormat(length, angle)
    assert_close(read_poses(path, replace(table, joints=columns)), commanded, rtol=0, atol=1e-12)
    robot = dc.cartesian(commanded)
    own = PoseColumns(columns.columns, convention, robot)
    table = replace(table, joints=own)
    q = read_joints(path, table)
    assert_close(robot(q), commanded, rtol=0, atol=1e-12)
    again = Columns.of(table.joints_only()).joints_from_si(q)
    back = PoseColumns(columns.columns, convention, angle=angle).poses(again)
    assert_close(back[:, :3, :3], commanded[:, :3, :3], rtol=0, atol=1e-12)
    assert_close(again[:, :3], cells[:, :3], rtol=1e-12, atol=1e-12)


def test_rows_without_a_command_stay_empty() -> None:
    commanded = poses()
    own = PoseColumns(tuple("xyzabc"), "xyz", dc.cartesian(commanded))
    q = dc.pose_inputs(dc.cartesian(commanded), commanded)
    q[2] = torch.nan
    cells = own.cells(q)
    assert bool(cells[2].isnan().all())
    assert int(cells.isnan().sum()) == 6


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z,a,b,c", "expected =CONVENTION behind them"),
        ("x,y,z,a,b=xyz", "expected 6 names of columns"),
        ("x,y,z,a,b,c=zz", "`convention`: expected"),
        ("x,y,x", "expected names of columns"),
        ("x,y,z,,b,c=xyz", "expected 6 names of columns"),
    ],
)
def test_wrong_texts(text: str, message: str) -> None:
    with pytest.raises(dc.DiffeoCalibError, match=message):
        PoseColumns.of(text)
