"""A column that nobody read names the marker of each row: told by the rows alone, and from other columns like it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.likely_mistakes import marker_column
from diffeo_calib.calibration.diagnostics.plausibility import check_identification
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.writing import write_rows
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

ROWS = 45
ARM = SimulatedArm(seed=4, markers=3)
Q, POINTS = ARM.measure(ROWS, seed=5)
LABELS = torch.arange(ROWS) % 3


def table(path: Path, points: Tensor, labels: Tensor, q: Tensor = Q) -> dc.Measurements:
    names = ARM.nominal.joint_names
    rows = [[*one.tolist(), "ABCDEFGHI"[label]] for one, label in zip(torch.cat([q, points], 1), labels, strict=True)]
    write_rows(path, [*names, "x", "y", "z", "target"], [rows], TableFormat("m", "rad"))
    return dc.read_measurements(path, ARM.nominal, ["x", "y", "z"], length="m", angle="rad", duplicates="keep")


def named(data: dc.Measurements) -> tuple[str, str] | None:
    return marker_column(register(ARM.nominal, data.q, data.points).geometry, data)


def test_several_markers_are_told_by_their_column(tmp_path: Path) -> None:
    found = named(table(tmp_path / "t.csv", POINTS[torch.arange(ROWS), LABELS], LABELS))
    assert found is not None
    assert found[0] == "target"
    tool = ARM.truth.tool
    jump = 1e3 * float(torch.cdist(tool, tool).max())
    assert found[1].startswith("3 values between which the points jump by")
    assert abs(float(found[1].split("jump by ")[1].split(" mm")[0]) / jump - 1.0) < 0.1


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
    assert named(table(tmp_path / "t.csv", points, labels, q)) is None


def test_rows_of_several_markers_are_no_fit(tmp_path: Path) -> None:
    data = table(tmp_path / "t.csv", POINTS[torch.arange(ROWS), LABELS], LABELS)
    with pytest.raises(MeasurementError, match=r"column 'target' takes 3 values.* name the column: --marker target"):
        check_identification(data, register(ARM.nominal, data.q, data.points))
