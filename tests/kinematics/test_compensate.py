"""Commands that bring a calibrated tool to its targets: round trips, optimality in the box, statuses."""

from collections.abc import Callable
from math import radians
from typing import Any

import numpy as np
import pytest
import torch
from deformation_bank import made
from product_bank import Case
from robots_bank import tool_frame
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.poses import angle_between

BOUND = radians(1.0)
LEVER = 0.1


def commands(case: Case, rows: int, seed: int = 0) -> Tensor:
    """Random configurations inside the limits."""
    low, high = case.robot.limits.unbind(1)
    draw = torch.from_numpy(np.random.default_rng(seed).random((rows, case.robot.n)))
    return low + (high - low) * draw


def intended(case: Case, q: Tensor) -> Tensor:
    """Where the nominal robot holds the tool."""
    return case.robot(q) @ tool_frame()


def misses(case: Case, q: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Distances in m and angles in rad that the model itself has at commands."""
    poses = case.model.tool_poses(q, tool_frame())
    return (poses - targets)[:, :3, 3].norm(dim=1), angle_between(poses[:, :3, :3], targets[:, :3, :3])


def inside(case: Case, found: dc.Compensation, bound: float = BOUND) -> bool:
    low, high = case.robot.limits.unbind(1)
    return bool(((found.q >= low) & (found.q <= high) & (found.correction.abs() <= bound)).all())


@pytest.mark.parametrize("frame", ["base", "measuring"])
def test_at_the_command_the_model_is_at_the_target(arm: Case, frame: str) -> None:
    q = commands(arm, 100)
    targets = intended(arm, q)
    given = targets if frame == "base" else arm.model.geometry.base @ targets
    found = dc.compensate(arm.model, given, q, tool=tool_frame(), frame=frame)
    assert inside(arm, found)
    distance, angle = misses(arm, found.q, targets)
    assert int(found.reached.sum()) > 75
    assert float(distance[found.reached].max()) <= 1e-9
    assert float(angle[found.reached].max()) <= 1e-9
    torch.testing.assert_close(found.miss, distance, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found.angle_miss, angle, rtol=1e-6, atol=1e-12)
    assert all(float(part.max()) > 1e-4 for part in misses(arm, q, targets))  # something was to be done
    assert found.counts["reached"] == int(found.reached.sum()) == sum(s == "reached" for s in found.status)
    assert "reached" in repr(found)
    assert repr(found.status[:1]) == "('reached',)"


@pytest.mark.parametrize("weights", [torch.full((6,), 1e6), torch.tensor([1.0, 10.0, 1.0, 0.1, 1.0, 5.0])], ids=str)
def test_positions_take_the_smallest_motion(arm: Case, weights: Tensor) -> None:
    """Three coordinates for six joints: the weighted correction has no part that leaves the tool where it is."""
    q = commands(arm, 100, seed=1)
    targets = intended(arm, q)[:, :3, 3]
    found = dc.compensate(arm.model, targets, q, tool=tool_frame(), weights=weights)
    assert int(found.reached.sum()) > 95
    assert found.angle_miss is None
    away = (arm.model.tool_poses(found.q, tool_frame())[:, :3, 3] - targets).norm(dim=1)
    assert float(away[found.reached].max()) <= 1e-9
    free = found.reached & (found.correction.abs() < BOUND - 1e-9).all(1)
    J, weigh = arm.model.tool_jacobian(found.q, tool_frame())[free, :3], weights.double()
    change = weigh.sqrt() * found.correction[free]
    by_root = J / weigh.sqrt()
    useful = (torch.linalg.pinv(by_root) @ (by_root @ change[..., None]))[..., 0]
    assert float(((useful - change).norm(dim=1) / change.norm(dim=1)).quantile(0.9)) < 0.02


def test_positions_with_the_direction_of_an_axis(arm: Case) -> None:
    q = commands(arm, 100, seed=2)
    targets = intended(arm, q)
    for axis, name in ((2.5 * targets[:, :3, 2], "z"), (targets[:, :3, 0], "x")):
        found = dc.compensate(arm.model, targets[:, :3, 3], q, axis=axis, tool_axis=name, tool=tool_frame())
        assert int(found.reached.sum()) > 90
        poses = arm.model.tool_poses(found.q, tool_frame())
        column = poses[:, :3, "xyz".index(name)]
        cosine = (column * axis).sum(1) / axis.norm(dim=1)
        assert found.angle_miss is not None
        assert float((poses - targets)[found.reached, :3, 3].norm(dim=1).max()) <= 1e-9
        assert float((1 - cosine)[found.reached].max()) <= 1e-14
        turned = angle_between(poses[:, :3, :3], targets[:, :3, :3])
        assert float(turned[found.reached].max()) > 1e-5  # the turn about the axis is free


def test_a_slide_has_a_bound_in_metres() -> None:
    model = made("slides")
    slides = ~torch.tensor(model.robot.periodic)
    q = model.map.x[:6]
    targets = model.tool_poses(q + 0.015 * torch.sin(50 * q))[:, :3, 3]
    found = dc.compensate(model, targets, q)
    assert bool(found.reached.all())
    assert 0.003 < float(found.correction[:, slides].abs().max()) <= 0.02
    bounds = torch.where(slides, 1e-5, 0.07)
    assert float(dc.compensate(model, targets, q, bound=bounds).correction[:, slides].abs().max()) <= 1e-5


def near_wrist_singularity(case: Case, rows: int) -> Tensor:
    q = commands(case, rows, seed=4)
    q[:, 4] = torch.from_numpy(np.random.default_rng(5).uniform(-1e-3, 1e-3, rows))
    return q


def gradient(case: Case, q: Tensor, targets: Tensor) -> Tensor:
    """(N, n) of 1/2 |p* - p|^2 + LEVER^2 (1 - cos angle), from the rotation vector of the angle."""
    poses, J = case.model.tool_poses(q, tool_frame()), case.model.tool_jacobian(q, tool_frame())
    spin = targets[:, :3, :3] @ poses[:, :3, :3].mT
    turn = 0.5 * torch.stack([spin[:, i, j] - spin[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], 1)
    shift = (targets - poses)[:, :3, 3]
    return -(J[:, :3].mT @ shift[..., None] + LEVER**2 * J[:, 3:].mT @ turn[..., None])[..., 0]


def test_the_nearest_command_in_the_box(arm: Case) -> None:
    """First-order conditions: no allowed motion of a joint lowers the miss."""
    q = near_wrist_singularity(arm, 100)
    targets = intended(arm, q)
    found = dc.compensate(arm.model, targets, q, tool=tool_frame())
    assert inside(arm, found)
    missed = ~found.reached
    assert int(missed.sum()) > 50
    slope = gradient(arm, found.q, targets)[missed]
    low = torch.maximum(arm.robot.limits[:, 0], q - BOUND)[missed]
    high = torch.minimum(arm.robot.limits[:, 1], q + BOUND)[missed]
    at = found.q[missed]
    blocked = ((at <= low + 1e-12) & (slope > 0)) | ((at >= high - 1e-12) & (slope < 0))
    scale = gradient(arm, q, targets)[missed].norm(dim=1)
    assert bool(blocked.any(1).all())
    assert float((torch.where(blocked, 0.0, slope).norm(dim=1) / scale).max()) < 1e-6


def test_statuses_of_singular_and_distant_targets(arm: Case) -> None:
    """Bent back at the edge of the workspace, or in need of a larger motion: both by what lies beyond the bound."""
    q = near_wrist_singularity(arm, 100)
    targets = intended(arm, q)
    far = targets.clone()
    far[:, :3, 3] *= 2.0 / far[:, :3, 3].norm(dim=1, keepdim=True)  # the arm reaches 1.5 m at most
    together = dc.compensate(arm.model, torch.cat([targets, far]), q.repeat(2, 1), tool=tool_frame())
    near = dc.compensate(arm.model, targets, q, tool=tool_frame())
    torch.testing.assert_close(together.q[:100], near.q, rtol=0, atol=1e-9)  # no row disturbs another one
    assert together.status[:100] == near.status
    assert set(near.counts) <= {"reached", "singular", "limit"}
    assert near.counts["singular"] > 50
    assert float(near.miss.max()) < 1e-3
    gone = dc.compensate(arm.model, far, q, tool=tool_frame())
    assert gone.counts == {"unreachable": 100}
    assert inside(arm, gone)
    regular = commands(arm, 100, seed=6)
    aside = intended(arm, regular)
    aside[:, :3, 3] += 0.1  # 100 mm, no singularity: the bound is the only obstacle
    assert dc.compensate(arm.model, aside, regular, tool=tool_frame()).counts.get("singular", 0) == 0


def test_limits_stop_a_row_and_are_named(arm: Case) -> None:
    q, joint = commands(arm, 40, seed=8), 1
    q[:, joint] *= 0.02  # so that some rows begin within the limit and need to go beyond it
    targets = intended(arm, q)
    free = dc.compensate(arm.model, targets, q, tool=tool_frame())
    ways = free.correction[:, joint]
    narrow = arm.robot.limits.clone()
    narrow[joint] = torch.tensor([-10.0, float(q[free.reached, joint].median())])
    found = dc.compensate(arm.model, targets, q, tool=tool_frame(), limits=narrow)
    assert bool((found.q[:, joint].nan_to_num(-9.0) <= narrow[joint, 1]).all())
    for row, status in enumerate(found.status):
        if not free.reached[row]:
            continue
        needed = float(q[row, joint] + ways[row])  # where the row would be without this limit
        assert status == ("reached" if needed <= float(narrow[joint, 1]) else "limit")
        beyond = float(q[row, joint] - narrow[joint, 1]) > BOUND
        assert bool(found.q[row].isnan().any()) == beyond
    assert found.counts["limit"] > 5


def test_no_rows_and_wrong_input(arm: Case) -> None:
    none = torch.zeros(0, 6, dtype=torch.float64)
    assert [len(dc.compensate(arm.model, targets, none)) for targets in (none[:, :3], none.new_zeros(0, 4, 4))] == [
        0,
        0,
    ]

    def wrong(**changed: object) -> Callable[[], object]:
        given: Any = {"model": arm.model, "targets": torch.zeros(3, 3), "start": torch.zeros(3, 6)} | changed
        return lambda: dc.compensate(**given)

    poses, ones = torch.eye(4).repeat(3, 1, 1), torch.ones(3, 3)
    refused(
        (r"`targets` has 9 value\(s\) that are not finite.*\[0, 0\]", wrong(targets=torch.nan * ones)),
        (r"`start` has the wrong shape: expected \(N, 6\)", wrong(start=torch.zeros(3, 7))),
        (r"`targets` has the wrong shape: expected \(3, 3\), got \(4, 3\)", wrong(targets=torch.zeros(4, 3))),
        ("`targets`, row 0: the last row of the transform", wrong(targets=torch.ones(3, 4, 4))),
        ("`axis`, row 0: expected a direction", wrong(axis=torch.zeros(3, 3))),
        ("`axis` beside target poses", wrong(targets=poses, axis=ones)),
        ("`tool_axis`: expected 'x', 'y' or 'z'", wrong(axis=ones, tool_axis="w")),
        ("`frame`: expected 'base' or 'measuring'", wrong(frame="flange")),
        ("`bound` has the wrong shape", wrong(bound=[1.0, 2.0])),
        ("`lever`", wrong(lever=0.0)),
        ("`limits` of joint 'waist_joint': expected lower <= upper", wrong(limits=[[1.0, -1.0]] * 6)),
        ("`model`: expected a calibrated model of a robot, got int", wrong(model=3)),
        ("`rate` and `time` limit how fast the corrections of a path change", wrong(rate=0.1)),
        ("`time`, row 2: expected increasing times, got 1 after 1", wrong(path=True, time=[0.0, 1.0, 1.0])),
    )


def line(case: Case, rows: int, seed: int = 3) -> Tensor:
    """A straight way between two configurations, away from singularities for seed 3."""
    first, last = commands(case, 2, seed) * 0.4
    first[4], last[4] = 0.6, 1.0
    return first + torch.linspace(0, 1, rows, dtype=torch.float64)[:, None] * (last - first)


def through_wrist(case: Case, rows: int) -> Tensor:
    q = line(case, rows)
    q[:, 4] = torch.linspace(-0.2, 0.2, rows, dtype=torch.float64)
    return q


def changes(found: dc.Compensation) -> Tensor:
    return found.correction.diff(dim=0).abs()


def test_a_path_without_jumps_is_that_of_its_rows(arm: Case) -> None:
    q = line(arm, 60)
    targets = intended(arm, q)
    alone = dc.compensate(arm.model, targets, q, tool=tool_frame())
    found = dc.compensate(arm.model, targets, q, tool=tool_frame(), path=True)
    assert bool(alone.reached.all())
    torch.testing.assert_close(found.q, alone.q, rtol=0, atol=0)
    assert found.jumps == ()
    assert float(changes(found).max()) < radians(0.1)


def test_through_a_singularity_the_corrections_stay_slow(arm: Case) -> None:
    q = through_wrist(arm, 81)
    targets = intended(arm, q)
    alone = dc.compensate(arm.model, targets, q, tool=tool_frame())
    rate = radians(0.15)
    assert float(changes(alone).max()) > rate  # there is something to slow down
    time, per_second = torch.linspace(0, 1, 81, dtype=torch.float64) ** 2, [0.2, 0.2, 0.2, 0.3, 0.2, 0.3]
    with pytest.warns(dc.DiffeoCalibWarning):
        found = dc.compensate(arm.model, targets, q, tool=tool_frame(), path=True, rate=per_second, time=time)
    allowed = time.diff()[:, None] * torch.tensor(per_second, dtype=torch.float64)
    assert bool((changes(found) <= allowed + 1e-12).all())
    with pytest.warns(dc.DiffeoCalibWarning, match=r"corrections of the path jump after [\d, ]+ rows"):
        found = dc.compensate(arm.model, targets, q, tool=tool_frame(), path=True, rate=rate)
    assert float(changes(found).max()) <= rate + 1e-12
    assert float(found.correction.abs().max()) <= BOUND
    assert {row for row in range(1, 81) if float(changes(alone)[row - 1].max()) > rate + 1e-9} == set(found.jumps)
    distance, _ = misses(arm, found.q, targets)
    torch.testing.assert_close(found.miss, distance, rtol=1e-6, atol=1e-12)
    assert float(distance[found.reached].max()) <= 1e-9
    for row, status in enumerate(found.status):
        if status == "rate":
            assert float((found.q - alone.q)[row].abs().max()) > 1e-9
    assert float(distance.max()) < 2e-3
    assert found.counts["reached"] > 40
