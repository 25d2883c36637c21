"""Rows that a model contradicts: new rows one by one, and blocks of rows with their common cause."""

from __future__ import annotations

import pytest
import torch
from product_bank import Case
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.judgement import block_text, contradicted, find_block, steps_of

ASIDE = torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)


def changed(case: Case, rows: slice, change: Tensor, count: int = 60) -> dc.Measurements:
    """Some of the held-out rows, a part of them displaced."""
    points = case.test.points[:count].clone()
    points[rows] += change
    return dc.Measurements(case.test.q[:count], points).with_line_numbers(range(2, count + 2))


def test_new_rows_that_are_right_are_not_named(arm: Case, pair: Case) -> None:
    for case in (arm, pair):
        assert contradicted(case.model, case.test) == []
        assert steps_of(case.model, case.test) == []


def test_a_new_row_that_is_wrong_is_named(arm: Case) -> None:
    (found,) = contradicted(arm.model, changed(arm, slice(7, 8), 0.01 * ASIDE))
    assert (found.row, found.number, found.weight) == (7, 9, None)
    assert found.distance == pytest.approx(0.002, rel=0.1)


def test_a_wrong_pose_is_named(posed: Case) -> None:
    assert contradicted(posed.model, posed.test) == []
    assert posed.test.poses is not None
    poses = posed.test.poses.clone()
    poses[4, :3, 3] += 0.1 * ASIDE
    poses[9, :3, :3] = poses[9, :3, [1, 2, 0]]
    found = contradicted(posed.model, dc.Measurements.from_poses(posed.test.q, poses))
    assert {one.row for one in found} == {4, 9}


@pytest.mark.parametrize(
    ("rows", "words"),
    [(slice(50, 60), "lines 52 to 61 to the end of the table: got"), (slice(20, 30), "lines 22 to 31: got")],
)
def test_a_block_of_rows_that_moved_together(rows: slice, words: str, arm: Case) -> None:
    data = changed(arm, rows, ASIDE)
    text = block_text(arm.model, data, contradicted(arm.model, data))
    assert text is not None
    assert text.startswith(f"10 rows look wrong that follow one another: {words} a median error of 200 mm")
    assert "moving the measuring device by 200 mm" in text


def test_a_block_without_a_common_cause(arm: Case) -> None:
    generator = torch.Generator().manual_seed(0)
    data = changed(arm, slice(20, 30), 0.1 * torch.randn(10, 1, 3, generator=generator, dtype=torch.float64))
    text = block_text(arm.model, data, contradicted(arm.model, data))
    assert text is not None
    assert "for no common reason" in text


def test_rows_that_are_wrong_here_and_there_are_no_block(arm: Case) -> None:
    data = changed(arm, slice(0, 60, 6), ASIDE)
    wrong = contradicted(arm.model, data)
    assert len(wrong) == 10
    assert block_text(arm.model, data, wrong) is None


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_random_rows_are_rarely_a_block(share: float) -> None:
    generator = torch.Generator().manual_seed(1)
    found = [find_block(torch.rand(80, generator=generator) < share) for _ in range(300)]
    assert sum(place is not None for place in found) <= 2


def test_the_block_is_where_the_wrong_rows_are() -> None:
    wrong = torch.zeros(100, dtype=torch.bool)
    wrong[40:50] = True
    wrong[[3, 77]] = True
    assert find_block(wrong) == (40, 50)
    wrong[45] = False
    assert find_block(wrong) == (40, 50)
    assert find_block(~wrong) is None  # nearly all rows
