"""Measured frames on several tips: T frames are T tables of one frame side by side, in arrays and in files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from table_bank import held, random_poses, says
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.csv.files import read_measurements
from diffeo_calib.measurements.poses import directions_of_frames, frames_of_points, points_of_frames
from diffeo_calib.measurements.table import Measurements

ROWS, TIPS = 6, ("left", "right", "head")
HIDDEN = [(0, 1), (2, 0), (2, 2)]
"""Row and number of the frames that were not seen."""


def table(*, hidden: bool = True, known: bool = True) -> Measurements:
    """Poses on three tips, with standard deviations."""
    rng = np.random.default_rng(3)
    poses = random_poses(3 * ROWS, seed=5).unflatten(0, (ROWS, 3))
    std, turns = (torch.from_numpy(rng.uniform(1e-5, 1e-3, (ROWS, 3, 3))) for _ in range(2))
    for row, frame in HIDDEN if hidden else ():
        poses[row, frame] = torch.nan
    deviations: dict[str, Any] = {"position_std": std, "rotation_std": turns} if known else {}
    return Measurements.from_poses(rng.uniform(-1, 1, (ROWS, 2)), poses, ["a", "b"], on=TIPS, lever=0.2, **deviations)


def single(data: Measurements, frame: int) -> tuple[Measurements, Tensor]:
    """One frame as a table of its own, and its rows."""
    rows = ~held(data.frames)[:, frame].isnan().flatten(1).any(1)
    std, turns = held(data.std)[rows, frame], held(data.rotation_std)[rows, frame]
    own: dict[str, Any] = {"lever": 0.2, "position_std": std, "rotation_std": turns}
    return Measurements.from_poses(data.q[rows], held(data.poses)[rows, frame], **own), rows


def test_frames_are_tables_of_one_frame_side_by_side() -> None:
    data = table()
    covariance = held(data.covariance)
    for frame in range(3):
        one, rows = single(data, frame)
        own = slice(9 * frame, 9 * frame + 9)
        assert_close(data.points[rows, 3 * frame : 3 * frame + 3], one.points)
        assert_close(covariance[rows, own, own], held(one.covariance), rtol=1e-12, atol=0)
        assert not bool(data.visible[~rows, 3 * frame : 3 * frame + 3].any())
        assert not bool(covariance[rows][:, own, : 9 * frame].any())
    assert data.on == tuple(tip for tip in TIPS for _ in range(3))
    assert data.frames is data.poses
    assert repr(data) == "Measurements(6 rows, 2 joints, poses on 3 tips, 3 of 18 sightings hidden)"


def test_directions_are_derivatives() -> None:
    """Of the poses by their points, against finite differences; no frame depends on the points of another."""
    frames = held(table(hidden=False).frames)[:, :2]
    points, step = points_of_frames(frames, 0.3), 1e-6
    found = directions_of_frames(frames, 0.3)
    for k in range(points[0].numel()):
        moved = points.flatten(1).clone()
        moved[:, k] += step
        away = frames_of_points(moved.view_as(points), 0.3)
        turn = (away[..., :3, :3] @ frames[..., :3, :3].mT - torch.eye(3, dtype=torch.float64)) / step
        turn = torch.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], -1)
        slope = torch.cat([(away - frames)[..., :3, 3] / step, turn], -1).flatten(1)
        assert_close(found[..., k], slope, rtol=0, atol=1e-4)


def test_one_frame_of_several_axes_is_one_frame() -> None:
    poses = random_poses(4)
    plain = Measurements.from_poses([[0.1], [0.2], [0.3], [0.4]], poses)
    again = Measurements.from_poses(plain.q, poses[:, None], on="hand")
    assert_close(held(again.poses), held(plain.poses), rtol=0, atol=0)
    assert again.on == ("hand",) * 3


def test_other_measuring_frames() -> None:
    """Poses, points and deviations of all tips move as those of each."""
    data, T = table(), random_poses(ROWS, seed=8)
    moved = data.in_frames(T)
    for frame in range(3):
        one, rows = single(data, frame)
        expected = one.in_frames(T[rows])
        assert_close(held(moved.frames)[rows, frame], held(expected.poses))
        assert_close(held(moved.rotation_std)[rows, frame], held(expected.rotation_std))
        assert_close(held(moved.std)[rows, frame], held(expected.std)[:, 0])


# --- files --------------------------------------------------------------------------------------------------------


def test_frames_in_a_data_frame() -> None:
    pytest.importorskip("pandas")
    data = table()
    found = data.to_frame()
    assert_close(torch.from_numpy(found["right_y"].to_numpy(copy=True)), held(data.frames)[:, 1, 1, 3], equal_nan=True)
    turns = found[[f"head_r{axis}" for axis in "xyz"]].to_numpy(copy=True)
    assert_close(torch.from_numpy(turns).isnan().all(1), held(data.frames)[:, 2, 0, 0].isnan())


# --- bad input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda poses: poses[:, :, :3], {}, ("(N, 4, 4), or one for each of T tips", "(6, 3, 3, 4)")),
        (lambda poses: poses.mT, {}, ("`poses`, row 0, frame 0", "not its transpose")),
        (lambda poses: poses.index_fill(0, torch.tensor(4), torch.nan), {}, ("`poses`, row 4: no frame was seen",)),
        (lambda poses: poses.index_fill(1, torch.tensor(1), torch.nan), {}, ("the frame on 'right'", "all 6 rows")),
        (lambda poses: poses * 2, {}, ("`poses`, row 0, frame 0", "[0, 0, 0, 1]")),
        (lambda poses: poses, {"on": ["left"]}, ("`on`", "expected 3 names", "per measured frame")),
        (lambda poses: poses, {"position_std": -1.0}, ("`position_std`", "positive")),
    ],
)
def test_wrong_poses_are_one_clear_error(change: Any, options: dict[str, Any], message: tuple[str, ...]) -> None:
    data = table(hidden=False, known=False)
    given: dict[str, Any] = {"on": TIPS} | options
    with pytest.raises((MeasurementError, InputError), match=says(*message)):
        Measurements.from_poses(data.q, change(held(data.poses).clone()), **given)


HEADER = "q,x,y,z,a,b,c,X,Y,Z,A,B,C\n"
ROW = "0.1,1,2,3,0.1,0.2,0.3,1,2,3,0.1,0.2,0.3\n"


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (HEADER + ROW, {"rotation": ["a", "b", "c"]}, ("one triple of columns for each", "2 triples and 1 list")),
        (HEADER + ROW, {"rotation": [["a", "b", "c"], ["A", "B"]]}, ("`rotation`", "3 names", "got ['A', 'B']")),
        (HEADER + ROW, {"rotation_std": ["A", "B", "C"]}, ("`position` beside `rotation_std`", "1 list")),
        (HEADER + ROW + "1,,,,,,,1,2,3,0,,0\n", {}, ("line 3, column 'B'", "an empty cell")),
        (HEADER + ROW + "1,,,,,,0,1,2,3,0,0,0\n", {}, ("line 3, column 'x'", "an empty cell")),
        (
            HEADER + "1,,,,,,,1,2,3,0,0,0\n",
            {},
            ("columns x, y, z, a, b and 1 more", "shows this frame; leave them out"),
        ),
    ],
)
def test_wrong_tables_are_one_clear_error(
    text: str, options: dict[str, Any], message: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "table.csv"
    path.write_text(text)
    given = {"rotation": [["a", "b", "c"], ["A", "B", "C"]], "convention": "rotvec", "rotation_angle": "rad"} | options
    with pytest.raises(MeasurementError, match=says(*message)):
        read_measurements(path, ["q"], [["x", "y", "z"], ["X", "Y", "Z"]], length="m", angle="rad", **given)


def test_points_become_poses_with_a_lever() -> None:
    data = table(known=False)
    again = Measurements.of_points(data.q, data.points, data.on, data.lever)
    assert_close(held(again.poses), held(data.poses), equal_nan=True)
    assert Measurements.of_points(data.q, data.points, None, None).poses is None
