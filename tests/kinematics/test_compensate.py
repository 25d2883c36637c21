"""Commands that bring calibrated tools to their targets, one tool or those of both hands: round trips, optimality in
the box, statuses, limits, paths."""

from collections.abc import Callable, Sequence
from math import radians
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from deformation_bank import made, model_of
from product_bank import Case
from robots_bank import parallelogram, tool_frame
from table_bank import held, refused
from torch import Tensor
from torch.testing import assert_close
from two_arms_bank import HANDS, robot

import diffeo_calib as dc
from diffeo_calib.kinematics.compensation.problem import joint_limits
from diffeo_calib.kinematics.compensation.targets import Targets
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.build import calibrated_chain

BOUND = radians(1.0)
LEVER = 0.1


class Tools(NamedTuple):
    """A model with the tools of its tips, commands, and where the tools should be (N, T, 4, 4), in the base."""

    model: dc.CalibratedKinematics
    tools: Sequence[tuple[Any, str | None]]
    q: Tensor
    targets: Tensor

    def given(self, values: Tensor) -> Tensor:
        """Of one tool without its dimension."""
        return values if len(self.tools) > 1 else values[:, 0]

    @property
    def tool(self) -> Any:
        return self.given(torch.stack([torch.as_tensor(tool) for tool, _ in self.tools])[None])[0]

    def of_each(self, query: Callable[..., Tensor], q: Tensor, frame: str = "base") -> Tensor:
        """Poses or Jacobians of the tools (N, T, ...)."""
        return torch.stack([query(q, tool, frame, tip) for tool, tip in self.tools], 1)

    def slope(self, q: Tensor, targets: Tensor) -> Tensor:
        """(N, n) of 1/2 |p* - p|^2 + LEVER^2 (1 - cos angle), from the rotation vector of the angle."""
        poses, J = (self.of_each(query, q) for query in (self.model.tool_poses, self.model.tool_jacobian))
        spin = targets[..., :3, :3] @ poses[..., :3, :3].mT
        turn = 0.5 * torch.stack([spin[..., i, j] - spin[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
        shift = (targets - poses)[..., :3, 3]
        each = J[..., :3, :].mT @ shift[..., None] + LEVER**2 * J[..., 3:, :].mT @ turn[..., None]
        return -each[..., 0].sum(1)


def angles(one: Tensor, other: Tensor) -> Tensor:
    """(N, T) between rotations (N, T, 3, 3)."""
    return angle_between(one.flatten(0, 1), other.flatten(0, 1)).unflatten(0, one.shape[:2])


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


TOOLS = torch.tensor([[0.0, 0.0, 0.1], [0.02, 0.05, 0.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def hands(tmp_path_factory: pytest.TempPathFactory) -> Tools:
    """Both hands of a small robot, whose waist moves both, and where its commands hold them."""
    model = model_of(robot(tmp_path_factory.mktemp("two_arms")), dc.RK4(1), 1, elastic=False)
    q = torch.from_numpy(np.random.default_rng(0).uniform(-1.2, 1.2, (12, 5)))
    found = Tools(model.with_tool(None, HANDS[0]), [*zip(TOOLS, HANDS, strict=True)], q, q)
    return found._replace(targets=found.of_each(model.tool_poses, q))


@pytest.fixture
def start(hands: Tools) -> Tensor:
    return hands.q + torch.from_numpy(np.random.default_rng(1).uniform(-0.01, 0.01, hands.q.shape))


@pytest.fixture
def single(arm: Case) -> Tools:
    """The tool where the nominal robot holds it."""
    q = commands(arm, 100)
    return Tools(arm.model, [(tool_frame(), None)], q, intended(arm, q)[:, None])


@pytest.mark.parametrize("frame", ["base", "measuring"])
@pytest.mark.parametrize("aim", ["poses", "places", "x", "z"])
@pytest.mark.parametrize("name", ["single", "hands"])
def test_at_the_command_the_model_is_at_the_target(
    name: str, aim: str, frame: str, start: Tensor, request: pytest.FixtureRequest
) -> None:
    """At a pose, at a place, or at a place with the direction of an axis."""
    case: Tools = request.getfixturevalue(name)
    begin, several = (start, True) if name == "hands" else (case.q, False)
    wanted = case.targets if frame == "base" else case.model.geometry.base @ case.targets
    how: dict[str, Any] = {"tool": case.tool, "frame": frame}
    if aim in ("x", "z"):
        how |= {"axis": case.given(2.5 * wanted[..., :3, "xyz".index(aim)]), "tool_axis": aim}
    found = dc.compensate(case.model, case.given(wanted if aim == "poses" else wanted[..., :3, 3]), begin, **how)
    assert int(found.reached.sum()) > (0.75 if aim == "poses" else 0.9) * len(begin)
    assert bool(found.reached.all()) or not several
    assert found.counts["reached"] == int(found.reached.sum()) == sum(s == "reached" for s in found.status)
    assert bool((found.correction.abs() <= BOUND).all())
    at = case.of_each(case.model.tool_poses, found.q, frame)
    assert_close(found.poses, case.given(at), rtol=0, atol=1e-12)
    distance, turn = (at - wanted)[..., :3, 3].norm(dim=-1), angles(at[..., :3, :3], wanted[..., :3, :3])
    assert_close(found.miss, case.given(distance), rtol=1e-6, atol=1e-12)
    assert float(distance[found.reached].max()) <= 1e-9
    if aim == "poses":
        assert_close(found.angle_miss, case.given(turn), rtol=1e-6, atol=1e-12)
        assert float(turn[found.reached].max()) <= 1e-9
    elif aim == "places":
        assert found.angle_miss is None
    else:
        cosine = (at * wanted)[..., :3, "xyz".index(aim)].sum(-1)
        assert float((1 - cosine)[found.reached].max()) <= 1e-14
        assert float(turn[found.reached].max()) > 1e-5 or several  # the turn about the axis is free
    before = case.of_each(case.model.tool_poses, begin, frame)
    assert float((before - wanted)[..., :3, 3].norm(dim=-1).max()) > 1e-4  # something was to be done


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


def test_a_free_hand_stays(hands: Tools, start: Tensor) -> None:
    """Rows with one target get the command of that hand alone; the waist moves both."""
    wanted = hands.targets[..., :3, 3].clone()
    wanted[::2, 1] = torch.nan
    found = dc.compensate(hands.model, wanted, start, tool=TOOLS)
    alone = dc.compensate(hands.model.with_tool(TOOLS[0], HANDS[0]), wanted[::2, 0], start[::2])
    assert_close(found.q[::2], alone.q, rtol=0, atol=1e-9)
    assert not bool(found.correction[::2, 3:].any())
    assert found.miss.isnan().equal(wanted[..., 0].isnan())
    assert bool(found.reached.all())
    axes = hands.targets[..., :3, 0].where(wanted.isfinite(), torch.nan)
    found = dc.compensate(hands.model, wanted, start, axis=axes, tool_axis="x", tool=TOOLS)
    assert bool(found.reached.all())
    assert held(found.angle_miss).isnan().equal(wanted[..., 0].isnan())


@pytest.mark.parametrize("name", ["single", "hands"])
def test_the_nearest_command_in_the_box(name: str, arm: Case, hands: Tools) -> None:
    """First-order conditions, near a singular wrist, and of two poses that five joints cannot hold: no allowed motion
    of a joint lowers the miss."""
    q = near_wrist_singularity(arm, 100)
    case = hands if name == "hands" else Tools(arm.model, [(tool_frame(), None)], q, intended(arm, q)[:, None])
    targets = case.targets.clone()
    if name == "hands":
        targets[:, 0, :3, 3] += torch.tensor([1e-3, -2e-3, 1e-3], dtype=torch.float64)
    found = dc.compensate(case.model, case.given(targets), case.q, tool=case.tool)
    assert case.model is not arm.model or inside(arm, found)
    missed = ~found.reached
    assert int(missed.sum()) > 0.5 * len(case.q)
    slope = case.slope(found.q, targets)[missed]
    low = torch.maximum(case.model.robot.limits[:, 0], case.q - BOUND)[missed]
    high = torch.minimum(case.model.robot.limits[:, 1], case.q + BOUND)[missed]
    at = found.q[missed]
    blocked = ((at <= low + 1e-12) & (slope > 0)) | ((at >= high - 1e-12) & (slope < 0))
    scale = case.slope(case.q, targets)[missed].norm(dim=1)
    assert bool(blocked.any(1).all()) or name == "hands"
    assert float((torch.where(blocked, 0.0, slope).norm(dim=1) / scale).max()) < 1e-6


@pytest.mark.parametrize("axes", [3, 1, 0])
def test_gradient_and_hessian_of_the_cost(hands: Tools, axes: int) -> None:
    """By central differences, of rigid kinematics far from the targets, a free hand in two rows."""
    model, rng, h, free = hands.model, np.random.default_rng(1), 1e-5, np.zeros((6, 2), dtype=bool)
    free[1, 0] = free[4, 1] = True
    poses = twist_transform(torch.from_numpy(rng.standard_normal((6, 2, 6)))).numpy()
    q = rng.uniform(-2, 2, (6, model.robot.n))
    goal = Targets(poses[..., :3, 3], poses[..., :3, :axes], np.eye(3)[:, 3 - axes :], 0.3, free)
    errors = model.geometry.joint_errors.numpy()
    chain = calibrated_chain(model.robot.arrays, np.eye(4), errors, np.zeros(6 + 6 * model.robot.moving))

    def slope(at: np.ndarray) -> np.ndarray:
        there, jacobian = chain.poses_and_jacobian(at)
        return -np.einsum("nkj,nk->nj", goal.slopes(jacobian), goal.errors(there))

    here, jacobian = chain.poses_and_jacobian(q)
    S = goal.slopes(jacobian)
    hessian = S.swapaxes(1, 2) @ S + goal.curvature(jacobian, here)
    for joint, step in enumerate(h * np.eye(q.shape[1])):
        rise = goal.cost(chain.poses_and_jacobian(q + step)[0]) - goal.cost(chain.poses_and_jacobian(q - step)[0])
        np.testing.assert_allclose(slope(q)[:, joint], rise / (2 * h), rtol=0, atol=1e-8)
        change = (slope(q + step) - slope(q - step)) / (2 * h)
        np.testing.assert_allclose(hessian[:, :, joint], change, rtol=0, atol=1e-8)


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


def limited(mimic: dict[str, float], offset: float, low: float, high: float) -> dc.Chain:
    """Three joints, the last of which follows others within its own limits."""
    frame = torch.eye(4, dtype=torch.float64)
    frame[0, 3] = 0.3
    joints = [Joint(f"j{k}", "revolute", frame, lower=-2.0, upper=2.0) for k in range(2)]
    joints.append(Joint("j2", "revolute", frame, lower=low, upper=high, mimic=mimic, mimic_offset=offset))
    return dc.Chain("limited", "floor", "hand", joints)


def test_limits_of_a_mimic_joint_bind_its_driver() -> None:
    found = joint_limits(limited({"j1": -2.0}, 0.5, -1.5, 1.0), None)
    np.testing.assert_allclose(found.low, [-2.0, -0.25])
    np.testing.assert_allclose(found.high, [2.0, 1.0])
    assert not len(found.matrix)
    assert np.isinf(joint_limits(parallelogram(), None).high).all()


def test_corrections_stop_at_the_limits_of_joints_that_follow_several() -> None:
    found = joint_limits(limited({"j0": 1.0, "j1": 1.0}, 0.0, -1.0, 1.0), None)
    start = np.array([[0.5, 0.4], [0.1, 0.1], [0.8, 0.8], [0.5, 0.5]])
    q = start + np.array([[0.1, 0.1], [0.1, 0.1], [0.0, 0.0], [-0.1, 0.0]])
    kept = found.within(start, q)
    np.testing.assert_allclose(kept[[0, 1, 3]], [start[0], q[1], q[3]])
    assert np.isnan(kept[2]).all()


def test_no_rows_and_wrong_input(arm: Case, hands: Tools) -> None:
    none = torch.zeros(0, 6, dtype=torch.float64)
    for targets in (none[:, :3], none.new_zeros(0, 4, 4)):
        assert len(dc.compensate(arm.model, targets, none)) == 0

    def wrong(**changed: object) -> Callable[[], object]:
        given: Any = {"model": arm.model, "targets": torch.zeros(3, 3), "start": torch.zeros(3, 6)} | changed
        return lambda: dc.compensate(**given)

    def of_both(targets: Tensor, **more: Any) -> Callable[[], object]:
        return wrong(model=hands.model, targets=targets, start=torch.zeros(2, 5), **more)

    both = torch.zeros(2, 2, 3, dtype=torch.float64)
    missing = both.index_put((torch.tensor([1]), torch.tensor([0]), torch.tensor([2])), both.new_tensor(torch.nan))
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
        ("`targets` of robot 'two_arms': expected 2 tips", of_both(both[:, :1])),
        (r"`tool` has the wrong shape: expected \(2, 4, 4\)", of_both(both, tool=[0.0, 0.0, 0.1])),
        ("row 0: no tip has a target", of_both(torch.full((2, 2, 3), torch.nan))),
        ("not finite", of_both(missing)),
        ("`targets`, row 0, tip 0: the last row", of_both(torch.ones(2, 2, 4, 4))),
        (r"`axis` has the wrong shape: expected \(2, 2, 3\)", of_both(both, axis=torch.ones(2, 3))),
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
