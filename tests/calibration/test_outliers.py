"""Rows that look wrong: they must not spoil the fit, and are named with a cause; few fits choose scales."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kind_bank import kind_named
from numbers_bank import inside, normal, rms, tensor
from product_bank import Case, simulated, usual_scales, with_usual_scales
from reading_bank import scales
from source_bank import resting
from table_bank import warned
from torch import Tensor
from varied_arms import KINDS, VariedArm

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics import judged_rows
from diffeo_calib.calibration.diagnostics.judged_rows import FAR, Outlier, block_text, contradicted, excluded, steps_of
from diffeo_calib.calibration.diagnostics.likely_mistakes import out_of_step
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation

# Several outliers among few rows make the noise hard to estimate, and the calibration warns of it.
pytestmark = [
    pytest.mark.slow,  # calibrations by the dozen
    pytest.mark.filterwarnings("ignore:leave-one-out errors contradict the selected scales"),
]


def aside(size: float, *seeds: int) -> Tensor:
    """A displacement of this size, m, in any direction, for each seed."""
    return size * torch.nn.functional.normalize(torch.stack([normal(3, seed=seed) for seed in seeds]), dim=1)


def flagged(result: Any, data: dc.Measurements) -> dict[tuple[int, int | None], Outlier]:
    """Outliers by row and marker. No row is dropped: each has a weight, and the model knows all configurations."""
    weights = result.tails.weights
    assert weights.shape == (len(data), 1 if data.poses is not None else data.markers)
    assert bool((weights > 0).all())
    assert torch.equal(result.model.configurations, data.q)
    assert result.model.summary.outliers == len(result.outliers)
    assert result.outliers == sorted(result.outliers, key=lambda outlier: -outlier.distance)
    for outlier in result.outliers:
        assert outlier.number == int(data.line_numbers[outlier.row])
        assert outlier.weight == float(weights[outlier.row, outlier.marker or 0])
        assert outlier.weight < 0.25
    return {(outlier.row, outlier.marker): outlier for outlier in result.outliers}


def with_its_scales(case: Case, data: dc.Measurements) -> tuple[Any, Any]:
    """The result, and its errors of rows that are held out."""
    result = dc.calibrate(case.robot, data, hyperparameters=case.result.selection.scales)
    return result, dc.evaluate(result.model, case.test)


def test_clean_data_have_no_outliers(arm: Case, pair: Case, posed: Case) -> None:
    for case in (arm, pair, posed):  # their scales are searched: with given ones chance decides
        assert flagged(case.result, case.train) == {}
        assert float(case.result.tails.weights.min()) > 0.5
        assert case.result.tails.freedom > 10


def test_wrong_points_joints_and_pairings(arm: Case) -> None:
    """Row 7: off by 50 mm. Row 9: the elbow read wrong by 0.02 rad. 13, 26: exchanged. 40: the points of row 50."""
    q, points = arm.train.q.clone(), arm.train.points.clone()
    points[7] += aside(0.05, 7)[0]
    q[9, 2] += 0.02
    points[13], points[26], points[40] = points[26].clone(), points[13].clone(), points[50]
    data = dc.Measurements(q, points).with_line_numbers(range(100, 160))
    result, errors = with_its_scales(arm, data)
    assert errors.rms < 1.3 * arm.held_out()[2]
    found = {row: one for (row, _), one in flagged(result, data).items()}
    other = "fits the configuration of row {}: a wrong pairing?".format
    expected = {7: FAR, 9: FAR, 13: other(126), 26: other(113), 40: other(150)}
    assert {row: one.reason for row, one in found.items()} == expected
    assert found[7].distance == pytest.approx(0.05, rel=0.01)
    assert found[7].weight is not None
    assert found[7].weight < 1e-4


def test_reasons_with_three_markers() -> None:
    """One fit: 0 and 2 exchanged in row 5, marker 1 off by 2 mm in row 8, row 13 the points of row 20."""
    arm, train, test = simulated(25, markers=3)
    points = train.points.clone()
    points[5] = points[5, [2, 1, 0]]
    points[8, 1] += aside(0.002, 8)[0]
    points[13] = points[20]
    data = dc.Measurements(train.q, points)
    result = with_usual_scales(arm.nominal, data)
    assert {at: one.reason for at, one in flagged(result, data).items()} == {
        (5, 0): "markers 0 and 2 seem to be exchanged",
        (5, 2): "markers 2 and 0 seem to be exchanged",
        (8, 1): "marker 1 alone is off, the other markers of this row fit",
        **{(13, k): "fits the configuration of row 20: a wrong pairing?" for k in range(3)},
    }
    weights = result.tails.weights
    assert float(weights[8, [0, 2]].min()) > 10 * float(weights[8, 1])  # the other markers of the row still count
    assert dc.evaluate(result.model, test).rms < 0.4 * dc.evaluate(result.identification.geometry.points, test).rms


def test_poses_that_are_wrong_in_position_or_orientation(posed: Case) -> None:
    """A pose is one measurement: it has one weight."""
    poses = posed.train.poses.clone()
    poses[4, :3, :3] = rotation(tensor([0.0, 0.02, 0.0])) @ poses[4, :3, :3]
    poses[11, :3, 3] += aside(0.005, 11)[0]
    data = dc.Measurements.from_poses(posed.train.q, poses, posed.train.joint_names, lever=posed.train.lever or 0.1)
    result, errors = with_its_scales(posed, data)
    found = flagged(result, data)
    assert set(found) == {(4, None), (11, None)}
    assert found[11, None].distance == pytest.approx(0.005, rel=0.05)
    before: Any = dc.evaluate(posed.model, posed.test)
    assert errors.rms < 2.0 * before.rms
    assert errors.orientation.rms < 1.5 * before.orientation.rms


def test_a_wrong_joint_reading_in_a_row_that_alone_places_the_marker(ur10_150: Case) -> None:
    """The tool turns by only 0.5 mrad in these rows: 0.02 rad in one of them outweigh all other rows."""
    assert ur10_150.result.outliers == []
    assert 1e3 * ur10_150.held_out()[2] < 0.18
    q = ur10_150.train.q.clone()
    q[9, 2] += 0.02
    _, errors = with_its_scales(ur10_150, dc.Measurements(q, ur10_150.train.points))
    assert errors.rms < 1.1 * ur10_150.held_out()[2]


@pytest.mark.parametrize(("share", "chosen"), [(0.05, False), (0.2, True)])
def test_regions_of_the_robot_hold_beside_gross_rows(share: float, *, chosen: bool) -> None:
    """With Student's t a third of the true places was inside at 5 %; noise chosen beside 20 % was twice as large."""
    arm, rows = SimulatedArm(seed=1), 120
    q, points = arm.measure(rows, seed=3)
    wrong = np.random.default_rng(3).permutation(rows)[: round(share * rows)].tolist()
    points[wrong, 0] += aside(0.02, *wrong)
    given, new = None if chosen else usual_scales(arm.nominal), arm.sample(200, 4)
    result = dc.calibrate(arm.nominal, dc.Measurements(q, points), hyperparameters=given)
    assert result.tails.gross
    assert {outlier.row for outlier in result.outliers} == set(wrong)
    mean, covariance = result.model.predict(new, noise=False)
    assert inside(arm.true_points(new) - mean, covariance) >= 0.9
    assert float(result.selection.scales.sensor_noise) < 1.1 * arm.noise


def test_fields_explain_no_gross_errors_that_the_geometry_hides(ur10_folder: Path) -> None:
    """Errors of 2 mm beside .3 mm by the sag: the fields took them up, and the robot was wrong by .7 mm."""
    robot = dc.load_urdf(ur10_folder / "ur10_robot.urdf", base="base_link", tip="ee_link")
    arm, rng = VariedArm(robot, KINDS["soft"], 510), np.random.default_rng([0, 77])
    q, new = arm.rows(120, 0), arm.rows(200, 9000)
    points = arm.true_points(q) + torch.from_numpy(arm.kind.noise * rng.standard_normal((120, 1, 3)))
    wrong, away = rng.permutation(120)[:12], torch.from_numpy(rng.standard_normal((12, 1, 3)))
    points[wrong] += 2e-3 * torch.nn.functional.normalize(away, dim=2)
    rows = [row for row in range(86) if row not in (52, 53, 54, 74, 75, 76)]
    result = dc.calibrate(robot, dc.Measurements(q[rows], points[rows]))
    assert {rows.index(row) for row in wrong.tolist() if row in rows} <= {one.row for one in result.outliers}
    assert rms(result.model(new) - arm.true_points(new)) < 1e-4


# --- rows that a model contradicts ------------------------------------------------------------------------------------

ASIDE = tensor([0.2, 0.0, 0.0])


def changed(case: Case, rows: slice, change: Tensor, count: int = 60) -> dc.Measurements:
    """Some of the held-out rows, a part of them displaced."""
    points = case.test.points[:count].clone()
    points[rows] += change
    return dc.Measurements(case.test.q[:count], points).with_line_numbers(range(2, count + 2))


def test_a_new_row_that_is_wrong_is_named(arm: Case, pair: Case) -> None:
    for case in (arm, pair):
        assert contradicted(case.model, case.test) == []
        assert steps_of(case.model, case.test) == []
    (found,) = contradicted(arm.model, changed(arm, slice(7, 8), 0.01 * ASIDE))
    assert (found.row, found.number, found.weight) == (7, 9, None)
    assert found.distance == pytest.approx(0.002, rel=0.1)


def test_a_wrong_pose_is_named(posed: Case) -> None:
    assert contradicted(posed.model, posed.test) == []
    poses = posed.test.poses.clone()
    poses[4, :3, 3] += 0.1 * ASIDE
    poses[9, :3, :3] = poses[9, :3, [1, 2, 0]]
    found = contradicted(posed.model, dc.Measurements.from_poses(posed.test.q, poses))
    assert {one.row for one in found} == {4, 9}


def test_a_block_of_rows_that_moved_together(arm: Case) -> None:
    """Of one at the end of a table: tests/cli/test_evaluate_command.py."""
    data = changed(arm, slice(20, 30), ASIDE)
    text = block_text(arm.model, data, judged_rows.flagged(len(data), contradicted(arm.model, data)))
    assert text.startswith("10 rows look wrong that follow one another: lines 22 to 31: got a median error of 200 mm")


def test_the_block_is_where_the_wrong_rows_are() -> None:
    """Random rows are rarely one."""
    generator = torch.Generator().manual_seed(1)
    for share in (0.02, 0.1, 0.3):
        found = [judged_rows.find_block(torch.rand(80, generator=generator) < share) for _ in range(300)]
        assert sum(place is not None for place in found) <= 2
    wrong = torch.zeros(100, dtype=torch.bool)
    wrong[40:50] = True
    wrong[[3, 77]] = True
    assert judged_rows.find_block(wrong) == (40, 50)
    wrong[45] = False
    assert judged_rows.find_block(wrong) == (40, 50)
    assert judged_rows.find_block(~wrong) is None  # nearly all rows


# --- names that few rows carry ----------------------------------------------------------------------------------------


RENAMED: dict[str, Callable[[Any, list[str]], Any]] = {
    "ball in sockets": lambda data, names: dc.Measurements.from_sockets(data.q, names, data.joint_names),
    "sessions": lambda data, names: data.with_sessions(names),
    "heights": lambda data, names: dc.Readings.heights(data.q, data.values[:, 0], names, data.joint_names),
}


@pytest.mark.parametrize("name", RENAMED)
def test_a_lone_name_is_told_by_its_row(name: str) -> None:
    kind = kind_named(name)
    names = list(kind.data.device_names)
    usual, names[5] = names[5], f"{names[5]}x"
    with pytest.raises(MeasurementError, match=rf"'{usual}x' in 1 row \(5\), perhaps meant as '{usual}'"):
        dc.calibrate(kind.robot, RENAMED[name](kind.data, names), hyperparameters=kind.scales)


# --- single rows in sockets -------------------------------------------------------------------------------------------


def test_wrong_rows_are_named() -> None:
    """At their joint values the ball is 0.8 mm beside its socket; nobody says that a plane is too little."""
    arm, wrong, size = SimulatedArm(seed=2), [10, 45], 8e-4
    data = resting(arm, 3, 10)
    q = data.q.clone()
    q[wrong] += torch.linalg.pinv(arm.truth.jacobian(q[wrong])[:, 0]) @ tensor([0.0, size, 0.0])
    result, texts = warned(dc.calibrate, arm.nominal, with_attributes(data, q=q), hyperparameters=scales())
    assert not any("lie near" in text for text in texts)
    assert sorted(one.row for one in result.outliers) == wrong
    assert all(one.weight < 0.3 for one in result.outliers)
    assert all(one.distance == pytest.approx(size, rel=0.4) for one in result.outliers)


# --- rows out of step with their joints -------------------------------------------------------------------------------


def test_a_table_that_is_out_of_step_is_refused() -> None:
    arm, train, _ = simulated(40)
    points = torch.cat([train.points[:20], train.points[19:-1]])
    words = "do not fit this robot: from line 22 on the measured values belong to the joints 1 line above: got .* rows"
    with pytest.raises(MeasurementError, match=words):
        dc.calibrate(arm.nominal, dc.Measurements(train.q, points).with_line_numbers(range(2, 42)))


NOISE = 1e-3
TYPICAL = 1.5 * NOISE
"""Median length of three coordinates."""


def out_of_step_table(rows: int, first: int, last: int, lag: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Predictions, measured values of which the rows first ... last - 1 belong ``lag`` rows below, and line numbers."""
    predicted, wanted = normal(rows, 1, 3, seed=seed), torch.arange(rows)
    wanted[first:last] += lag
    kept = (wanted >= 0) & (wanted < rows)
    measured = predicted[wanted.clamp(0, rows - 1)] + NOISE * normal(rows, 1, 3, seed=seed + 1)
    return predicted[kept], measured[kept], torch.arange(2, rows + 2)[kept]


@pytest.mark.parametrize(("first", "last", "lag"), [(5, 40, -5), (25, 40, -1), (5, 40, 2), (25, 40, 2), (10, 22, -1)])
def test_rows_out_of_step_are_found_from_line_to_line(first: int, last: int, lag: int) -> None:
    (step,) = out_of_step(*out_of_step_table(40, first, last, lag), typical=TYPICAL)
    assert (step.first, step.lag, step.to_the_end) == (first + 2, lag, last == 40)
    there = last - first - 2 * max(lag, 0)  # the last rows have lost their measured values
    assert there - 2 <= step.rows <= there
    assert last == 40 or step.last == last + 1


def test_rows_out_of_step_are_found_in_any_order_with_gaps() -> None:
    """As after a split: 70 % of the rows, and thus half of the pairs."""
    (step,) = out_of_step(*out_of_step_table(40, 10, 22, -1), typical=TYPICAL)
    assert step.sentence().startswith("in lines 12 to 23 the measured values belong to the joints 1 line above")
    rows = torch.randperm(100, generator=torch.Generator().manual_seed(3))[:70]
    (step,) = out_of_step(*(part[rows] for part in out_of_step_table(100, 50, 100, -1)), typical=TYPICAL)
    assert (step.lag, step.to_the_end) == (-1, True)
    assert abs(step.first - 52) <= 2


@pytest.mark.parametrize("rows", [4, 60])
def test_nothing_in_tables_that_are_right(rows: int) -> None:
    """With heavy tails, with every fifth row far off, and with a pair of rows exchanged."""
    for seed in range(10):
        predicted, measured, lines = out_of_step_table(rows, 0, 0, 0, seed=seed)
        assert out_of_step(predicted, measured, lines, TYPICAL) == []
        measured = measured + NOISE * normal(rows, 1, 3, seed=seed + 50) / normal(rows, 1, 1, seed=seed + 60).abs()
        measured[::5] += 0.2
        measured[[1, 2]] = measured[[2, 1]]
        assert out_of_step(predicted, measured, lines, TYPICAL) == []


def test_nothing_on_a_slow_path() -> None:
    """Where the next row is nearer than the error of the nominal robot."""
    t = torch.linspace(0, 1, 200, dtype=torch.float64)
    predicted = torch.stack([t.cos(), t.sin(), t], 1)[:, None]
    measured = predicted + 5e-3 * torch.stack([(3 * t).sin(), (2 * t).cos(), t], 1)[:, None]
    typical = float((predicted - measured).norm(dim=-1).median())
    assert out_of_step(predicted, measured, torch.arange(200), typical) == []


# --- the rule that says which rows look wrong, on clean errors and beside gross ones ----------------------------------

TABLES = 600


@pytest.mark.parametrize("freedom", [1, 6])
@pytest.mark.parametrize("rows", [5, 40])
@pytest.mark.parametrize("expected", [0.05, 20.0])
def test_one_of_a_hundred_clean_tables_is_suspected_however_few_its_rows(
    freedom: int, rows: int, expected: float
) -> None:
    """Whatever the model expects of the errors: the others tell how large they are."""
    drawn = torch.Generator().manual_seed(rows)
    squares = expected * torch.randn(TABLES, rows, freedom, generator=drawn, dtype=torch.float64).square().sum(2)
    each = torch.full((rows, 1), float(freedom), dtype=torch.float64)
    suspected = sum(bool(excluded(one[:, None], each, least=0.0).any()) for one in squares)
    assert suspected < 0.02 * TABLES


def test_a_gross_error_is_named_and_hidden_markers_are_not() -> None:
    squares = torch.randn(30, 2, 3, generator=torch.Generator().manual_seed(0)).double().square().sum(2)
    squares[4, 1], squares[7, 0] = 100.0, torch.nan
    found = excluded(squares, torch.full_like(squares, 3.0))
    assert found.nonzero().tolist() == [[4, 1]]
