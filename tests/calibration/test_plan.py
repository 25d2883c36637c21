"""Planned poses: the greedy choice against brute force, what is known before it, and whether expectations come true."""

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import pytest
import torch
from product_bank import Case
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.sensors.set_ups import frame_slopes


def by_rank(plan: dc.Plan) -> list[int]:
    return plan.rows[plan.rank.argsort()].tolist()


def brute_force(K: Tensor, R: Tensor, targets: list[int], count: int) -> tuple[list[int], list[float]]:
    """Try every candidate at every step by inverting the whole matrix: rows taken, RMS at the targets."""
    m = R.shape[1]

    def coordinates(rows: list[int]) -> Tensor:
        return torch.tensor([row * m + axis for row in rows for axis in range(m)])

    def variance(rows: list[int]) -> float:
        at, t = coordinates(rows), coordinates(targets)
        inner = K[at][:, at] + torch.block_diag(*R[rows])
        left = K[t][:, t] - K[t][:, at] @ torch.linalg.solve(inner, K[at][:, t])
        return float(left.diagonal().sum()) / (len(targets) * m / 3)

    chosen: list[int] = []
    rms = [float(K[coordinates(targets)][:, coordinates(targets)].diagonal().sum() / (len(targets) * m / 3)) ** 0.5]
    for _ in range(count):
        left = {row: variance([*chosen, row]) for row in range(len(R)) if row not in chosen}
        chosen.append(min(left, key=lambda row: left[row]))
        rms.append(left[chosen[-1]] ** 0.5)
    return chosen, rms


def test_greedy_choice_is_that_of_brute_force_for_a_model(pair: Case) -> None:
    model, q = pair.model, SimulatedArm(seed=1).sample(24, seed=8)
    K = model.map.conditional.covariance_between(model.map.geodesic.linearise(q))
    rows, rms = brute_force(K, model.map.new_noise.expand(len(q), -1, -1), list(range(24)), 5)
    plan = dc.plan(model, q, 5)
    assert by_rank(plan) == rows
    assert_close(plan.expected_rms, torch.tensor(rms, dtype=torch.float64), rtol=1e-5, atol=0)


@pytest.mark.parametrize("case", ["pair", "slider", "posed"])
def test_what_is_known_before_is_the_covariance_of_predict(case: str, request: pytest.FixtureRequest) -> None:
    model = request.getfixturevalue(case).model
    limits = model.robot.limits
    q = (model.configurations[:10] + 0.3).clamp(limits[:, 0], limits[:, 1])
    predicted = model.predict_poses if case == "posed" else model.predict
    covariance = predicted(q, noise=False)[1][..., :3, :3].view(10, -1, 3, 3)  # of the markers, or of the origin
    rms = covariance.diagonal(dim1=2, dim2=3).sum(2).mean().sqrt()
    assert_close(dc.plan(model, q, 2).expected_rms[0], rms, rtol=1e-3 if case == "posed" else 1e-6, atol=0)


@pytest.mark.parametrize("free", ["base", "both"])
def test_what_has_moved_is_open_again(arm: Case, free: str) -> None:
    model, q = arm.model, arm.test.q[:10]
    _, covariance = model.predict(q, noise=False)
    by_base = 0.1 * frame_slopes(model(q), model(model.configurations)[:, 0].mean(0))
    added = by_base.square().sum((1, 2)) + (3 * 0.1**2 if free == "both" else 0.0)  # a marker moves like the flange
    rms = (covariance.diagonal(dim1=2, dim2=3).sum((1, 2)) + added).mean().sqrt()
    plan = dc.plan(model, arm.test.q[:60], 12, target=q, free=free)
    assert_close(plan.expected_rms[0], rms, rtol=1e-3, atol=0)
    assert float(plan.expected_rms[-1]) < 2e-4 < float(plan.expected_rms[1])


def test_a_registered_model_knows_what_its_rows_have_told(arm: Case) -> None:
    moved = arm.model.registered(arm.test.rows(slice(0, 15)), free="base", learn=False)
    q = arm.test.q[100:130]
    _, covariance = moved.predict(q, noise=False)
    rms = float(covariance.diagonal(dim1=2, dim2=3).sum(2).mean().sqrt())
    before = float(dc.plan(moved, q, 2).expected_rms[0])
    assert 0.4 * rms < before < 1.05 * rms  # the rows tell of the joints too, which the registration leaves as they are
    assert float(dc.plan(moved, q, 2, free="base").expected_rms[0]) > 0.05
    marker, both = (dc.plan(moved, q, 2, free=free).expected_rms for free in ("marker", "both"))
    assert_close(marker, both, rtol=1e-9, atol=0)  # the base may have moved since the fit anyway


def test_a_plan_can_be_made_in_parts() -> None:
    """What is measured counts like what was planned before."""
    arm = SimulatedArm(seed=1)
    q = arm.sample(200, seed=3)
    whole = dc.plan(arm.nominal, q, 8)
    first = by_rank(whole)[:5]
    rest = dc.plan(arm.nominal, q, 3, measured=q[first])
    assert by_rank(rest) == by_rank(whole)[5:]
    assert_close(rest.expected_rms, whole.expected_rms[5:], rtol=1e-6, atol=0)
    assert whole.assumed
    assert sorted(whole.rank.tolist()) == list(range(1, 9))
    assert torch.equal(whole.q, q[whole.rows])
    moves = torch.cdist(whole.q, whole.q, p=torch.inf)  # the slowest joint decides
    for first, last in combinations(range(9), 2):  # no reversal of a part is a shorter path
        order = [*range(first), *reversed(range(first, last)), *range(last, 8)]
        assert float(moves[order[:-1], order[1:]].sum()) > float(moves.diagonal(1).sum()) - 1e-9
    assert bool((whole.expected_rms.diff() < 0).all())
    assert "8 poses" in str(whole)
    assert "guesses" in str(whole)


def test_expected_errors_are_those_of_the_simulated_arm(arm: Case) -> None:
    """Before and after 20 more planned poses, measured in simulation and fitted."""
    truth = SimulatedArm(seed=1)
    q = truth.sample(600, seed=11)
    plan = dc.plan(arm.model, q, 20)
    noise = truth.noise * torch.from_numpy(np.random.default_rng(0).standard_normal((20, 1, 3)))
    new = dc.Measurements(plan.q, truth.true_points(plan.q) + noise)
    both, scales = dc.Measurements.joined([arm.train, new]), arm.result.selection.scales
    again = dc.calibrate(arm.robot, both, hyperparameters=scales).model
    for model, expected in ((arm.model, plan.expected_rms[0]), (again, plan.expected_rms[-1])):
        found = (model(q) - truth.true_points(q)).square().sum((1, 2)).mean().sqrt()
        assert 0.6 < float(found / expected) < 1.4


def test_mistakes_are_one_sentence(arm: Case) -> None:
    robot, model, every = arm.robot, arm.model, arm.train.q

    def planned(of: Any = robot, q: Tensor = every, count: int = 3, **more: Any) -> Callable[[], object]:
        return lambda: dc.plan(of, q, count, **more)

    refused(
        ("`robot_or_model`: expected a robot", planned("robot")),
        ("`candidates`: .*6", planned(q=every[:, :5])),
        ("at most 2, got 3", planned(q=every[:2])),
        ("`target`: .*6", planned(target=[[0.0, 1.0]])),
        ("`measured`: .*not finite", planned(measured=every * torch.nan)),
        ("`marker` has the wrong shape", planned(marker=[1.0, 2.0])),
        ("`free` belongs to a model", planned(free="base")),
        ("`free`: expected None, 'base', 'marker', 'both', got 'tracker'", planned(model, free="tracker")),
        ("`marker` belongs to a robot", planned(model, marker=[0.0, 0.0, 0.1])),
    )
