"""Tables of readings: units, constants, devices, and cells that are no numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.files import read_observations
from diffeo_calib.measurements.csv.sensors import ReadingColumns
from diffeo_calib.measurements.table_format import TableFormat

MM = TableFormat("mm", "deg", ";", ",")
LINES = ("a;b;d;u;v;where", "10,5;20;400,25;12;7;north", "", "30;-40;410,5;13,5;8;south", "50;60;420;14;9;north")


def read(path: Path, columns: ReadingColumns, table: TableFormat, **options: str) -> dc.Readings:
    return read_observations(path, replace(table, joints=["a", "b"], readings=(columns,)), **options)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    (tmp_path / "t.csv").write_text("\n".join(LINES))
    return tmp_path / "t.csv"


def test_lengths_angles_and_devices_in_si(table: Path) -> None:
    data = read_observations(
        table, replace(MM, joints=["a", "b"], readings=(ReadingColumns("distance", ("d",), "where", offset_std=0.1),))
    )
    assert_close(data.values[:, 0].tolist(), [0.40025, 0.4105, 0.42])
    assert_close(data.q[0].rad2deg().tolist(), [10.5, 20.0])
    assert data.names == ("north", "south")
    assert data.device.tolist() == [0, 1, 0]
    assert data.lines.tolist() == [2, 4, 5]
    assert (data.offset_std, data.unit, data.file_sha256 is None) == (0.1, ("mm", 1e3), False)
    assert data.rows([2]).lines.tolist() == [5]


def test_one_number_for_all_rows_and_pixels(table: Path) -> None:
    assert (
        read_observations(
            table, replace(MM, joints=["a", "b"], readings=(ReadingColumns("distance", 400.0),))
        ).values.tolist()
        == [[0.4]] * 3
    )
    assert (
        read_observations(
            table, replace(MM, joints=["a", "b"], readings=(ReadingColumns("height", 0.0),))
        ).values.tolist()
        == [[0.0]] * 3
    )
    columns = ReadingColumns("image", ("u", "v"), intrinsics=(2.0, 4.0, 12.0, 7.0))
    found = read(table, columns, MM)
    assert_close(found.values.tolist(), [[0.0, 0.0], [0.75, 0.25], [1.0, 0.5]])
    assert found.unit == ("px", 3.0)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (("410,5", "410.5"), "line 4, column 'd': expected a number, got '410.5'"),
        (("410,5", "nan"), "line 4, column 'd': expected a finite number, got 'nan'"),
        (("410,5", ""), "line 4, column 'd': expected a finite number, got an empty cell; remove or repair"),
        (("south", " "), "line 4, column 'where': expected the name of the device of this reading, got an empty cell;"),
        (("north", ""), r"line 2, column 'where' \(and 1 more, on line 5\): expected the name of the device"),
        (("410,5", "-1"), "line 4, column 'd': expected a distance above 0, got '-1'; repair or remove these lines"),
        (("410,5", "0"), "line 4, column 'd': expected a distance above 0, got '0'"),
        (("50;60;420;14;9;north", "10,5;20;400,25;1;1;north"), "line 5 repeats 2"),
    ],
)
def test_bad_cells_are_named(edit: tuple[str, str], said: str, table: Path) -> None:
    table.write_text(table.read_text().replace(*edit))
    with pytest.raises(MeasurementError, match=said):
        read(table, ReadingColumns("distance", ("d",), "where"), MM)


def test_copies_are_dropped_on_demand_and_other_units_doubted(table: Path) -> None:
    table.write_text(table.read_text().replace("50;60;420", "10,5;20;400,25"))
    with pytest.warns(dc.DiffeoCalibWarning, match="dropped 1 line"):
        data = read_observations(
            table, replace(MM, joints=["a", "b"], readings=(ReadingColumns("distance", ("d",)),)), duplicates="drop"
        )
    assert len(data) == 2
    metres = TableFormat("m", "deg", ";", ",")
    with pytest.warns(dc.DiffeoCalibWarning, match=r"distances reach 410.5 m: they look like millimetres"):
        read_observations(
            table, replace(metres, joints=["a", "b"], readings=(ReadingColumns("distance", ("d",)),)), duplicates="keep"
        )
