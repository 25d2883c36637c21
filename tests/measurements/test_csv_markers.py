"""Tables whose lines name the marker that they hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.tables import TableOrigin

HEADER = "a,b,ball,x,y,z"
LINES = (
    "0.1,0.2,top,1,2,3",
    "0.1,0.2,left,4,5,6",
    "0.3,0.4,left,7,8,9",
    "0.3,0.4,low,1,1,2",
    "0.3,0.4,top,3,3,4",
    "0.5,0.6,low,5,5,6",
)


def read(folder: Path, lines: Sequence[str] = LINES, header: str = HEADER, **how: Any) -> dc.Measurements:
    path = folder / "t.csv"
    path.write_text("\n".join((header, *lines)) + "\n")
    given = {"position": ["x", "y", "z"], "marker": "ball", "length": "m", "angle": "rad", "duplicates": "keep"}
    return dc.read_measurements(path, ["a", "b"], **(given | how))


def test_lines_of_one_pose_are_one_row(tmp_path: Path) -> None:
    data = read(tmp_path)
    assert data.marker_names == ("top", "left", "low"), "in the order in which they appear"
    assert data.line_numbers.tolist() == [2, 4, 7], "the first line of each row"
    assert data.visible.tolist() == [[True, True, False], [True, True, True], [False, False, True]]
    assert data.points[1].tolist() == [[3, 3, 4], [7, 8, 9], [1, 1, 2]]
    assert_close(data.q[:, 0], torch.tensor([0.1, 0.3, 0.5], dtype=torch.float64), rtol=0, atol=0)


def test_a_marker_seen_again_is_another_row(tmp_path: Path) -> None:
    """Repeats of a pose are rows, as are lines of it that do not follow each other."""
    assert len(read(tmp_path, [*LINES[:2], *LINES[:2]])) == 2
    assert len(read(tmp_path, [LINES[0], LINES[2], LINES[1], LINES[3]])) == 4
    lines = [f"{line},{mass}" for line, mass in zip(LINES[:2], "12", strict=True)]
    assert len(read(tmp_path, lines, f"{HEADER},kg", payload="kg")) == 2
    assert len(read(tmp_path, lines, f"{HEADER},day", session="day")) == 2


def test_later_tables_keep_the_order_of_the_markers(tmp_path: Path) -> None:
    whole = read(tmp_path)
    assert isinstance(whole.origin, TableOrigin)
    assert whole.origin.columns.table.marker == "ball=top,left,low"
    assert "--marker ball=top,left,low" in whole.origin.options
    some = read(tmp_path, LINES[3:], marker=whole.origin.columns.table.marker)
    assert some.marker_names == whole.marker_names
    assert some.visible.tolist() == [[True, False, True], [False, False, True]]
    assert_close(some.points[0], torch.where(some.visible[0, :, None], whole.points[1], torch.nan), equal_nan=True)


def test_deviations_belong_to_the_marker_of_their_line(tmp_path: Path) -> None:
    lines = [f"{line},{k + 1}" for k, line in enumerate(LINES)]
    data = read(tmp_path, lines, f"{HEADER},s", std=["s"])
    assert data.std is not None
    assert data.std[:, :, 0].nan_to_num(0.0).tolist() == [[1, 2, 0], [5, 3, 4], [0, 0, 6]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"marker": "ball=top,left"}, r"column 'ball': expected markers of the model: top, left, got low"),
        ({"marker": "smr"}, r"no column \['smr'\]"),
        ({"lines": ["0.1,0.2,,1,2,3"]}, r"line 2, column 'ball': expected the name of a marker, got an empty cell"),
        ({"position": [["x", "y", "z"], ["u", "v", "w"]]}, r"`marker` \(ball\): expected one position"),
        ({"rotation": ["u", "v", "w"], "convention": "xyz", "rotation_angle": "deg"}, r"`marker` \(ball\)"),
        ({"socket": "place"}, r"`marker` \(ball\)"),
    ],
)
def test_what_is_no_marker_is_one_error(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=message):
        read(tmp_path, **change)
