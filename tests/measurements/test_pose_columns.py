"""Columns of commanded poses: all conventions and units, there and back."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.files import read_joints, read_poses
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.measurements.poses import ALL_CONVENTIONS, rotation_numbers
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, TableFormat
from diffeo_calib.robots.se3 import transforms


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
    assert_close(read_poses(path, columns, table), commanded, rtol=0, atol=1e-12)
    robot = dc.cartesian(commanded)
    own = PoseColumns(columns.columns, convention, robot)
    q = read_joints(path, own, table)
    assert_close(robot(q), commanded, rtol=0, atol=1e-12)
    again = Columns.of(table.joints_only(own)).joints_from_si(q)
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
