"""Markers that are hidden in some rows: arrays, files, subsets, and every kind of mistake."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest
import torch
from table_bank import Reader, says
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.table import Measurements

TWO = [("ax", "ay", "az"), ("bx", "by", "bz")]
HEADER = "q1,q2,ax,ay,az,bx,by,bz\n"
ROWS = ["0.1,0.2,1,2,3,4,5,6", "0.3,0.4,1.5,2.5,3.5,,,", "0.5,0.6,,,,4.5,5.5,6.5"]
SEEN = [[True, True], [True, False], [False, True]]


def text(*rows: str, header: str = HEADER) -> str:
    return header + "".join(f"{row}\n" for row in rows)


def points(rows: int = 12, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random rows of three markers of which some are hidden."""
    rng = np.random.default_rng(seed)
    places, gone = rng.uniform(-2, 2, (rows, 3, 3)), rng.random((rows, 3)) < 0.4
    gone[gone.all(1), 0] = False
    places[gone] = nan
    return rng.uniform(-3, 3, (rows, 2)), places


# --- arrays -------------------------------------------------------------------------------------------------------


def test_nan_is_a_hidden_marker_and_follows_its_row() -> None:
    q, places = points()
    data = Measurements(q, places, marker_names=["a", "b", "c"])
    seen: np.ndarray = ~np.isnan(places[..., 0])
    assert data.visible.tolist() == seen.tolist()
    assert f"{int((~seen).sum())} of 36 sightings hidden" in repr(data)
    assert data.rows([3, 1]).visible.tolist() == seen[[3, 1]].tolist()
    train, test = data.split(0.6, seed=1)
    assert Measurements.joined([train, test]).visible.sum() == seen.sum()
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = turn[[1, 2, 0], :3]
    assert data.in_frames(turn.expand(12, 4, 4)).visible.tolist() == seen.tolist()
    assert "nan" not in data._repr_html_()
    frame = data.to_frame()
    assert frame["b_x"].isna().tolist() == (~seen[:, 1]).tolist()
    assert "hidden" not in repr(data.rows(seen.all(1)))


def test_deviations_may_be_missing_where_a_marker_is_hidden() -> None:
    q, places = points()
    gone = np.isnan(places)
    std = np.where(gone, nan, 0.002)
    for given in (std, std[..., 0], np.full(12, 0.002), 0.002):
        data = Measurements(q, places, std=given)
        assert data.std is not None
        assert data.std.isnan().tolist() == gone.tolist()
        expected = np.where(gone, 0.0, 0.002**2).reshape(12, -1)
        assert data.covariance is not None
        assert_close(data.covariance, torch.diag_embed(torch.from_numpy(expected)), rtol=1e-12, atol=0)
    std[0, np.flatnonzero(~gone[0].any(1))[0]] = nan
    with pytest.raises(MeasurementError, match=r"`std` has 3 value\(s\) that are not finite"):
        Measurements(q, places, std=std)


def test_mistakes_in_arrays_are_named() -> None:
    q, places = points()
    half = places.copy()
    half[4] = 1.0
    half[4, 1, 1:] = nan
    with pytest.raises(MeasurementError, match=says("row 4, marker 1", "NaN for y, z only")):
        Measurements(q, half)
    empty = places.copy()
    empty[[2, 5]] = nan
    with pytest.raises(MeasurementError, match=says("row 2, 5: no marker was seen")):
        Measurements(q, empty)
    never = places.copy()
    never[:, 0], never[:, 2] = 1.0, nan
    with pytest.raises(MeasurementError, match=says("marker tool is hidden in all 12 rows")):
        Measurements(q, never, marker_names=["a", "b", "tool"])
    infinite = places.copy()
    infinite[0, 0, 0] = np.inf
    with pytest.raises(MeasurementError):
        Measurements(q, infinite)
    alone = np.ones((12, 3))
    alone[3] = nan
    with pytest.raises(MeasurementError, match=r"`points` has 3 value\(s\) that are not finite"):
        Measurements(q, alone)


# --- files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blank", ["", "nan", " "])
def test_empty_cells_of_a_marker_are_a_hidden_marker(read: Reader, blank: str) -> None:
    rows = [row.replace(",,,", f",{blank},{blank},{blank}") for row in ROWS[:2]]
    data = read(text(*rows, f"0.5,0.6,{blank},{blank},{blank},4.5,5.5,6.5"), position=TWO)
    assert data.visible.tolist() == SEEN
    assert data.points[0].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert data.points[2, 1].tolist() == [4.5, 5.5, 6.5]


def test_a_marker_that_is_seen_has_a_deviation(read: Reader) -> None:
    header = HEADER.replace(",", ";").rstrip() + ";sa;sb\n"
    for std in (["sa", "sb"], ["sa"]):  # one for each, or one for all
        with pytest.raises(MeasurementError, match=says("line 2", "'sa'", "an empty cell")):
            read(text("0,1;0,2;1;2;3;;;;;", header=header), position=TWO, sep=";", decimal=",", std=std)


@pytest.mark.parametrize(
    ("row", "column"), [("0.7,0.8,1,,3,4,5,6", "'ay'"), ("0.7,0.8,1,2,3,,,6", "'bx'"), ("0.7,,1,2,3,4,5,6", "'q2'")]
)
def test_half_a_marker_is_a_mistake(read: Reader, row: str, column: str) -> None:
    with pytest.raises(MeasurementError, match=says("line 5", column, "an empty cell", "marker or frame are empty")):
        read(text(*ROWS, row), position=TWO)


def test_line_without_any_marker_is_left_out_and_named(read: Reader) -> None:
    with pytest.warns(DiffeoCalibWarning, match="no marker was seen in line 5: 1 row"):
        assert read(text(*ROWS, "0.7,0.8,,,,,,"), position=TWO).visible.tolist() == SEEN
    with pytest.warns(DiffeoCalibWarning, match="no marker was seen in line 3"):
        data = read(text("0.1,0.2,1,2,3,4,5,6", "0.3,0.4,,,,4,5,6"), position=TWO[0])  # of a single marker
    assert data.line_numbers.tolist() == [2]
    with pytest.raises(MeasurementError, match=says("line 5", "'q2'", "a finite number")):
        read(text(*ROWS, "0.7,,,,,,,"), position=TWO)


def test_marker_that_no_line_shows_is_a_mistake(read: Reader) -> None:
    with pytest.raises(MeasurementError, match=says("bx, by, bz", "empty in all 2 lines")):
        read(text("0.1,0.2,1,2,3,,,", "0.3,0.4,1,2,3,,,"), position=TWO)


LOST = ["inf", "1e13", "-3.697314E+28", "-", "----", "hidden", "MISSING", "#N/A", "NULL", "Out of View", "-1.#IND00"]


@pytest.mark.parametrize("cell", LOST)
def test_usual_marks_of_a_lost_marker_hide_it(read: Reader, cell: str) -> None:
    with pytest.warns(DiffeoCalibWarning, match=says(f"'{cell}' (3)", "line 3")):
        data = read(text(*ROWS).replace(",,,\n", f",{cell},{cell},{cell}\n", 1), position=TWO)
    assert data.visible.tolist() == SEEN


@pytest.mark.parametrize("cell", ["far", "1e13", "MISSING"])
def test_no_mark_fills_the_cell_of_a_joint(read: Reader, cell: str) -> None:
    with pytest.raises(MeasurementError, match=says("line 5", "'q2'", cell)):
        read(text(*ROWS, f"0.7,{cell},1,2,3,4,5,6"), position=TWO)


@pytest.mark.parametrize(("cells", "column"), [(",inf,", "by"), (",,1e400", "bz"), (",nan,5", "by"), ("inf,,", "bx")])
def test_wrong_cell_is_named_and_not_the_empty_one_beside_it(read: Reader, cells: str, column: str) -> None:
    wrong = next(cell for cell in cells.split(",") if cell)
    with pytest.raises(MeasurementError, match=says("line 5", f"'{column}'", f"'{wrong}'")):
        read(text(*ROWS, f"0.7,0.8,1,2,3,{cells}"), position=TWO)
