"""A campaign judges rows as they come: algebra against a fresh factorisation, named mistakes, the result."""

import copy
import threading
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from product_bank import usual_scales
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.campaign.model import limit_of
from diffeo_calib.campaign.verdicts import Verdict
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.robots import SimulatedArm

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
ARM = SimulatedArm(3, markers=2)
ROWS = 24
MM = 1e-3


@pytest.fixture(scope="module")
def measured() -> tuple[Tensor, Tensor]:
    return ARM.measure(ROWS + 12, seed=7)


@pytest.fixture(scope="module")
def running(measured: tuple[Tensor, Tensor]) -> dc.Campaign:
    """A campaign of right rows, whose goal is far. Tests copy it."""
    known: Any = {"candidates": ARM.sample(40, seed=8), "target": ARM.sample(30, seed=9)}
    campaign = dc.Campaign(ARM.nominal, goal=1e-6, **known)
    campaign.add(*(part[:ROWS] for part in measured))
    return campaign


def begun(rows: Any, robot: dc.Tree, **asked: Any) -> dc.Campaign:
    """A campaign that has its first model of all of these rows, which one row after the other would make again."""
    campaign = dc.Campaign(robot, **asked)
    campaign.resume(rows, [Verdict(row, None, accepted=True) for row in range(len(rows))])
    return campaign


def after(running: dc.Campaign, q: Tensor, y: Tensor) -> tuple[dc.Campaign, list[Any]]:
    campaign = copy.deepcopy(running)
    return campaign, campaign.add(q, y)


def test_right_rows_are_accepted_and_the_error_shrinks(running: dc.Campaign, measured: tuple[Tensor, Tensor]) -> None:
    assert running.accepted == list(range(ROWS))
    assert [one.fits for one in running.verdicts] == [None] * 12 + [True] * (ROWS - 12)
    early, late = (running.verdicts[row].expected_error for row in (12, ROWS - 1))
    assert late < 0.7 * early  # pyright: ignore
    model = running.result(hyperparameters=usual_scales(ARM.nominal)).model
    true = float((model(running.target) - ARM.true_points(running.target)).square().sum(-1).mean().sqrt())
    assert 0.3 < true / late < 2  # pyright: ignore
    campaign = copy.deepcopy(running)
    campaign.reject(5)
    rows = [row for row in range(ROWS) if row != 5]
    assert campaign.accepted == rows
    found: Any = campaign.rows()
    assert_close((found.q, found.points), tuple(part[rows] for part in measured), rtol=0, atol=0)
    for row in rows:
        campaign.reject(row)
    assert (campaign.accepted, campaign.expected_error, campaign.next(1)) == ([], None, None)


def test_rows_that_came_before_the_first_model_are_judged_by_it(measured: tuple[Tensor, Tensor]) -> None:
    q, y = (part[:25].clone() for part in measured)
    y[15] += 50 * MM
    threads = threading.active_count()
    campaign = dc.Campaign(ARM.nominal, candidates=ARM.sample(20, seed=8), background=True)
    campaign.add(q, y)
    campaign.repeat(24)  # waits
    assert threading.active_count() == threads  # also the model that was due with the first one is there
    assert [one.row for one in campaign.verdicts if one.fits is None] == list(range(12))
    assert [one.row for one in campaign.verdicts if not one.accepted] == [15, 24]
    assert [one.row for one in campaign.verdicts if one.again] == [24]


def test_mistakes_of_one_row_are_named_and_left_out(running: dc.Campaign, measured: tuple[Tensor, Tensor]) -> None:
    q, y = (part[ROWS : ROWS + 1] for part in measured)
    before = measured[0][ROWS - 1]
    mistakes = {
        "mm as m": (q, 1e3 * y),
        "m as mm": (q, 1e-3 * y),
        "exchanged": (q, y.flip(1)),
        "row before": (q, ARM.true_points(before[None])),
        "degrees as radians": (q.rad2deg(), y),
        "marker 1": (q, y + torch.tensor([[[0.0, 0, 0], [0, 2 * MM, 0]]], dtype=y.dtype)),
    }
    for words, rows in mistakes.items():
        campaign, (verdict,) = after(running, *rows)
        assert verdict.fits is False, (words, verdict)
        assert not verdict.accepted, (words, verdict)
        assert words in verdict.cause, (words, verdict)
        assert campaign.accepted == list(range(ROWS))
        assert campaign.expected_error == pytest.approx(running.expected_error, rel=1e-6)  # it tells nothing
        campaign.accept(ROWS)
        assert campaign.accepted == list(range(ROWS + 1))


def test_a_moved_device_and_a_joint_are_named(running: dc.Campaign, measured: tuple[Tensor, Tensor]) -> None:
    q, y = (torch.cat([own[ROWS:], more]) for own, more in zip(measured, ARM.measure(2, seed=11), strict=True))
    away = torch.tensor([0.5 * MM, -0.3 * MM, 0.4 * MM], dtype=y.dtype)
    other = q + torch.tensor([0, 2e-3, 0, 0, 0, 0], dtype=q.dtype)
    cases = {"device": (q, y + away), ARM.nominal.joint_names[1]: (q[:7], ARM.true_points(other[:7]))}
    for words, rows in cases.items():
        campaign, (verdict,) = after(running, *(part[:1] for part in rows))
        assert verdict.change is None, "a single wrong row is no change of six unknowns some rows before"
        verdicts = [*campaign.add(*(part[1:] for part in rows))]  # of the device more than are looked at together
        change = next(one.change for one in verdicts[::-1] if one.change is not None)
        assert words in (change.cause, *change.others)[0], (words, str(verdicts[-1]))
        assert change.row == ROWS
        assert campaign.accepted == list(range(ROWS))
    assert 1 < change.size < 4
    assert change.unit == "mrad"


@pytest.mark.parametrize(("wrong", "axis"), [(3, 0), (5, 2)])
def test_rows_near_a_wrong_one_stay(running: dc.Campaign, measured: tuple[Tensor, ...], wrong: int, axis: int) -> None:
    """Along a motion a move of the device would explain 0.4 mm of one row as well: it was named in a third of these."""
    share = torch.linspace(0, 1, 16, dtype=torch.float64)[:9, None]
    q = measured[0][ROWS] * (1 - share) + measured[0][ROWS + 1] * share
    y = ARM.true_points(q)
    y[wrong, :, axis] += 0.4 * MM
    _, verdicts = after(running, q, y)
    assert all(one.accepted and one.change is None for row, one in enumerate(verdicts) if row != wrong)


def test_rows_together_have_the_verdicts_of_single_ones(running: dc.Campaign, measured: tuple[Tensor, Tensor]) -> None:
    """With a wrong row among them."""
    q, y = (part[ROWS : ROWS + 5].clone() for part in measured)
    y[2] += 5 * MM
    campaign, verdicts = after(running, q, y)
    other: Any = copy.deepcopy(running)
    for row, one in enumerate(verdicts):
        (single,) = other.add(q[row], y[row])
        assert (one.fits, one.accepted, one.cause) == (row != 2, row != 2, single.cause)
        found, expected = ((each.error, each.expected, each.expected_error) for each in (one, single))
        assert found == pytest.approx(expected, rel=1e-8)
    assert campaign.expected_error == pytest.approx(other.expected_error, rel=1e-8)


def test_the_next_poses_help_more_than_any_others(running: dc.Campaign) -> None:
    found: Any = running.next(3, goal=1e-9)
    assert (len(found.q), found.needed) == (3, None)
    near: Any = running.next(3, goal=0.9 * found.expected[0])
    assert near.needed > 0
    assert torch.equal(running.candidates[found.rows], found.q)
    gained = {}
    for row in (found.rows[0], *(k for k in range(0, 40, 7) if k != found.rows[0])):
        q = running.candidates[row : row + 1]
        campaign, _ = after(running, q, ARM.true_points(q))
        gained[row] = campaign.expected_error
    assert min(gained, key=lambda row: gained[row] or 1.0) == found.rows[0]
    assert_close(gained[found.rows[0]], found.expected[1], rtol=0.02, atol=0.0)


def test_a_row_to_be_repeated_is_left_out_and_its_pose_comes_first(running: dc.Campaign) -> None:
    campaign = copy.deepcopy(running)
    for row in (20, 7):
        campaign.repeat(row)
    assert campaign.accepted == [row for row in range(ROWS) if row not in (7, 20)]
    found: Any = campaign.next(3)
    q = running.table.q
    assert_close(found.q[:2], q[[7, 20]])
    assert (found.again, len(found.rows), len(found.q)) == ([7, 20], 1, 3)
    other = torch.cat([q[20, :1], q[10, 1:]])
    campaign.add(other, ARM.true_points(other[None])[0])
    assert campaign.next(3).again == [7, 20]  # one equal joint makes no repeat  # pyright: ignore
    campaign.add(q[20] + 1e-3, ARM.true_points(q[20:21])[0])
    found = campaign.next(1)
    assert_close(found.q, q[7:8])
    campaign.accept(7)
    found = campaign.next(1)
    assert (found.again, len(found.rows)) == ((), 1)
    early = dc.Campaign(ARM.nominal)
    early.add(q[:2], ARM.true_points(q[:2]))
    early.repeat(1)
    found = early.next(1)
    assert_close(found.q, q[1:2])


def test_bad_input_is_refused_and_nothing_is_lost(running: dc.Campaign) -> None:
    campaign: Any = copy.deepcopy(running)
    q, y = torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 2, 3, dtype=torch.float64)
    refused(
        ("`robot`: expected a dc.Tree", lambda: dc.Campaign(3)),  # pyright: ignore
        ("`goal`", lambda: dc.Campaign(ARM.nominal, goal=0.0)),
        ("dc.Measurements", lambda: campaign.add(5)),
        ("differ in n; join rows", lambda: campaign.add(q, y)),
        (f"`row`: expected 0 to {ROWS - 1}, got {ROWS}", lambda: campaign.reject(ROWS)),
        ("the accepted rows: expected at least one", lambda: dc.Campaign(ARM.nominal).result()),
        ("`verdicts`: expected 2, of a new campaign, got 0", lambda: campaign.resume(campaign.table[:2], [])),
    )
    assert campaign.accepted == list(range(ROWS))


SLOW = ("mixture", "sessions", "several kinds", "inclinations", "laser beams")


@pytest.mark.parametrize("name", ["poses", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_other_kinds_of_rows(name: str) -> None:
    """The rows of the bank in random order, enough to place every device and for two models."""
    kind = kind_named(name)
    rows: Any = joined_tables([kind.data, kind.new])
    if name == "several kinds":  # distances, whose places are searched for longest, come one by one in no other way
        rows = dc.Observations.joined([part for part in rows.parts if part.kind != "distance"])
    order = torch.randperm(len(rows), generator=torch.Generator("cpu").manual_seed(0))[: 100 if rows.parts[1:] else 36]
    first = 2 * len(order) // 3
    campaign = begun(rows.rows(order[:first]), kind.robot, candidates=kind.q(20), target=kind.q(10))
    judged = [one for row in order[first:, None] for one in campaign.add(rows.rows(row)) if one.fits is not None]
    assert len(judged) > 10, [str(one) for one in campaign.verdicts]
    assert sum(one.fits is False for one in judged) <= 0.05 * len(judged), [str(o) for o in judged if not o.fits]
    found: Any = campaign.next(2)
    assert found.expected[2] < found.expected[0]


def test_set_ups_come_one_after_the_other(measured: tuple[Tensor, Tensor]) -> None:
    """As a table that grows has them: the rows of each set-up name it alone."""
    q, y = (part[:19] for part in measured)
    first, second = (dc.Measurements(q[some], y[some]) for some in (slice(0, 13), slice(13, 19)))
    second = dc.Measurements(second.q, second.points + 0.5)  # seen from elsewhere
    campaign = dc.Campaign(ARM.nominal, candidates=q, target=q)
    campaign.add(first.with_sessions(["monday"] * 13))
    verdicts = campaign.add(second.rows(slice(0, 1)).with_sessions(["tuesday"]))
    for row in (7, 13):  # while the second is not placed yet
        before = campaign.expected_error
        campaign.reject(row)
        assert campaign.accepted == [other for other in range(14) if other != row]
        campaign.accept(row)
        assert campaign.expected_error == pytest.approx(before, rel=1e-3)
    alone = copy.deepcopy(campaign)
    for row in range(13):
        alone.reject(row)
    assert (alone.accepted, alone.expected_error) == ([13], None), "no row of a device that has a place"
    verdicts += campaign.add(second.rows(slice(1, None)).with_sessions(["tuesday"] * 5))
    assert [one.fits for one in verdicts] == [None] * 5 + [True]
    assert campaign.accepted == list(range(19))
    assert campaign.table.device_names == ["monday"] * 13 + ["tuesday"] * 6


def test_limits_and_goals(running: dc.Campaign, measured: tuple[Tensor, Tensor]) -> None:
    """The limit holds 95 % of errors; near the goal scales are selected at 15 % more rows, else at twice as many."""
    random = torch.Generator("cpu").manual_seed(0)
    root = torch.randn(60, 20, generator=random, dtype=torch.float64)
    errors = (root @ torch.randn(20, 4000, generator=random, dtype=torch.float64)).square().mean(0).sqrt()
    S = root @ root.T
    limit = limit_of(float(S.diagonal().mean().sqrt()), S, 0.0)
    assert float((errors < limit).double().mean()) == pytest.approx(0.95, abs=0.015)
    assert limit_of(1.0, S, 0.3) > 1.1 * limit_of(1.0, S, 0.0)
    campaign: Any = copy.deepcopy(running)
    known, limit = campaign.expected_error, campaign.error_limit
    assert 1.1 < limit / known < 2
    for goal, factor, needed in ((1.01 * limit, 1.15, 0), (0.99 * limit, 1.15, 1), (0.5 * known, 2.0, None)):
        campaign.goal = goal
        assert campaign.reached == (needed == 0)
        assert campaign._next_scales(campaign._model) == pytest.approx(factor * 20)
        assert needed is None or campaign.next(1).needed == needed
    few = begun(dc.Measurements(*(part[:14] for part in measured)), ARM.nominal, candidates=measured[0][:5], goal=1.0)
    assert few.expected_error is not None
    assert (few.error_limit, few.reached) == (None, False), "before the scales are selected"
