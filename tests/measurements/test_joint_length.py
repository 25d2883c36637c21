"""Prismatic joints in another unit than the positions, in reading, writing and at the command line."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from product_bank import sliding_measurements, sliding_robot
from table_bank import HEADER, Reader, read_table
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.options import Targets, Units
from diffeo_calib.cli.tables import MeasuredTable, ProgramTable, table_format
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.csv.writing import write_predictions
from diffeo_calib.measurements.table_format import TableFormat

ROBOT = SimpleNamespace(joint_names=("q1", "q2"), kinds=("prismatic", "revolute"))
MIXED = TableFormat("mm", "deg", joint_length="m")


def test_slides_in_metres_beside_positions_in_millimetres(read: Reader) -> None:
    data = read(HEADER + "0.25,90,1000,0,500\n", joints=ROBOT, length="mm", angle="deg", joint_length="m")
    assert_close(data.q, torch.tensor([[0.25, torch.pi / 2]], dtype=torch.float64))
    assert data.points.tolist() == [[[1.0, 0.0, 0.5]]]


@pytest.mark.parametrize("units", [("mm", "m"), ("m", "mm")])
def test_what_is_written_is_read_back(units: tuple[str, str], tmp_path: Path) -> None:
    robot = sliding_robot()
    data = sliding_measurements(robot, 12)
    table = TableFormat(units[0], "deg", joint_length=units[1])
    write_measurements(tmp_path / "t.csv", data, table, joints=robot)
    again = read_table(tmp_path / "t.csv", robot, ["x", "y", "z"], table)
    assert_close(again.q, data.q, rtol=1e-14, atol=1e-15)
    assert_close(again.points, data.points, rtol=1e-14, atol=1e-15)
    with pytest.warns(DiffeoCalibWarning, match="prismatic joints reach"):
        plain = read_table(tmp_path / "t.csv", robot, ["x", "y", "z"], replace(table, joint_length=units[0]))
    factor = 1000.0 if units[0] == "m" else 1e-3
    assert_close(plain.q[:, 2], factor * data.q[:, 2])  # the file's own numbers differ


def test_programs_and_predictions_keep_the_unit(tmp_path: Path) -> None:
    robot, q = sliding_robot(), sliding_measurements(sliding_robot(), 3).q
    path, table = (tmp_path / "program.csv", table_format(Units(length="mm", angle="deg", joint_length="m")))
    assert table == MIXED
    points = torch.ones(3, 1, 3, dtype=torch.float64)
    write_predictions(path, [(q, points, 1e-3 * points)], table, joints=robot.joint_names, kinds=robot.kinds)
    source = ProgramTable(path, None, table, Targets())
    assert_close(source.commands(robot), q, rtol=1e-14, atol=1e-15)
    header, first, *_ = list(csv.reader(path.read_text().splitlines()))
    cells = dict(zip(header, first, strict=True))
    assert float(cells["slide"]) == pytest.approx(float(q[0, 2]))
    assert float(cells["x"]) == 1000.0
    measured = MeasuredTable(path, None, replace(table, position=[["x", "y", "z"]])).read(robot)
    assert_close(measured.q, q, rtol=1e-14, atol=1e-15)


def test_units_that_look_wrong_are_doubted(read: Reader) -> None:
    with pytest.warns(DiffeoCalibWarning, match="prismatic joints reach only 0.25 mm: they look like metres; pass j"):
        read(HEADER + "0.25,90,1000,0,500\n", joints=ROBOT, length="mm", angle="deg")
    with pytest.warns(DiffeoCalibWarning, match=r"reach 250 m: they look like millimetres; pass joint_length='mm'"):
        read(HEADER + "250,90,1,0,0.5\n", joints=ROBOT, length="m", angle="deg")


def test_wrong_use_is_explained(read: Reader) -> None:
    for options, message in (
        ({"joints": ROBOT, "joint_length": "km"}, "`joint_length`: expected 'm' or 'mm' or 'cm' or 'inch', got 'km'"),
        ({"joint_length": "m"}, "`joint_length` without the kinds of the joints: .*; pass the robot, or `kinds`"),
    ):
        with pytest.raises(MeasurementError, match=message):
            read(HEADER + "0.25,90,1000,0,500\n", **options)


@pytest.mark.slow
def test_slides_in_the_wrong_unit_are_refused_with_the_unit_named() -> None:
    robot = sliding_robot()
    data = sliding_measurements(robot, 15)
    q = data.q.clone()
    q[:, 2] *= 1e3
    with pytest.raises(
        MeasurementError, match=r"values of prismatic joints seem to be 1000 times too .*\(`joint_length`\)"
    ):
        dc.calibrate(robot, dc.Measurements(q, data.points, doubt=False))
