"""Configurations that can be measured, drawn at random within the joints' ranges and other criteria.

Links are straight lines from one joint's origin to the next, and on to the tip and the markers: leave room for the
links' thickness in floors and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import cos, isfinite, pi
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_count, check_number, check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode, seeded
from diffeo_calib.common.errors import InputError, as_written, few, listed
from diffeo_calib.common.threads import small_work
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree

POINTS_PER_LINK = 8  # points of each link that are checked: 8 cm apart on a link of 0.6 m

Criterion = Callable[[Tensor], Any]  # configurations (N, n) -> (N,) boolean, whether each is allowed


@dataclass(frozen=True)
class Tracker:
    """A measuring device and the reflector that it has to see. Everything in m and rad.

    Args:
        position: (3,) of the device, in the robot's base frame.
        marker: (3,) place of the reflector, in the tip's frame.
        direction: (3,) in which the reflector looks, in the tip's frame, of any length.
        half_angle: largest angle between that direction and the line to the device.

    Raises:
        InputError: wrong shapes, a direction without length, an angle outside (0, pi].
    """

    position: Sequence[float]
    marker: Sequence[float] = (0.0, 0.0, 0.0)
    direction: Sequence[float] = (0.0, 0.0, 1.0)
    half_angle: float = pi / 4

    def __post_init__(self) -> None:
        for name in ("position", "marker", "direction"):
            as_tensor(getattr(self, name), f"{name} of the tracker", (3,))
        if not float(as_tensor(self.direction, "direction of the tracker", (3,)).norm()) > 0:
            raise InputError.of("`direction` of the tracker", expected="a vector other than zero", got="(0, 0, 0)")
        check_number(self.half_angle, "`half_angle` of the tracker, in rad", above=0.0, below=pi + 1e-9)

    def sees(self, robot: Tree) -> Criterion:
        """Whether the reflector, on every tip, looks at the device."""
        parts = (self.position, self.marker, self.direction)
        position, marker, direction = (as_tensor(part, "tracker", (3,)) for part in parts)

        def criterion(q: Tensor) -> Tensor:
            tips = robot.tip_poses(q)
            line = position - (tips[..., :3, :3] @ marker + tips[..., :3, 3])  # (N, T, 3)
            along = (line * (tips[..., :3, :3] @ direction)).sum(-1)
            return (along >= cos(self.half_angle) * line.norm(dim=-1) * direction.norm()).all(1)

        return criterion


def all_of(criteria: Sequence[Criterion]) -> Criterion | None:
    """Whether all allow a configuration, each asked only where those before it do; None without any."""

    def criterion(q: Tensor) -> Tensor:
        allowed = torch.ones(len(q), dtype=torch.bool, device=q.device)
        for allows in criteria:
            allowed[allowed.clone()] = allows(q[allowed])
        return allowed

    return criterion if criteria else None


def outside_column(robot: Tree, column: object, points: Tensor) -> Criterion:
    """Whether all moving points are outside a column, see :func:`candidates`; points (P, 3) on the tool, m."""
    numbers = as_tensor(column, "column", (3,), also=((4,),), fix="pass x, y, radius and perhaps the top, in m")
    if not float(numbers[2]) > 0:
        raise InputError.of("the radius of `column`", expected="a positive number of m", got=float(numbers[2]))
    x, y, radius, *top = numbers.tolist()

    def criterion(q: Tensor) -> Tensor:
        places = _links(robot, q, points)
        inside = (places[..., 0] - x).square() + (places[..., 1] - y).square() < radius**2
        return ~(inside & (places[..., 2] < top[0]) if top else inside).any(1)

    return criterion


def _links(robot: Tree, q: Tensor, points: Tensor) -> Tensor:
    """Points (N, K, 3) on all that moves in the base frame, m: from the first joint's origin, left out, to the tool."""
    tips, count = robot.tip_poses(q), robot.tip_places.stop
    corners = robot.places(q)[:, :count, :3, 3]  # (N, n_all + T, 3)
    after = [(before, place) for place, before in enumerate(robot.before[:count]) if before >= 0]
    first, last = (list(numbers) for numbers in zip(*after, strict=True))
    tool = points @ tips[..., :3, :3].mT + tips[..., None, :3, 3]  # (N, T, P, 3)
    starts = torch.cat([corners[:, first], tips[..., None, :3, 3].expand_as(tool).flatten(1, 2)], 1)
    ends = torch.cat([corners[:, last], tool.flatten(1, 2)], 1)
    share = torch.arange(1, POINTS_PER_LINK + 1, dtype=q.dtype, device=q.device)[:, None] / POINTS_PER_LINK
    return (starts[:, :, None] + share * (ends - starts)[:, :, None]).flatten(1, 2)


TURN = 2 * pi
MOST_TURNS = 10  # turns of a joint without limits that may be asked for
ROUNDING = 1e-6  # of limits in files, rad or m
MOST = 10_000_000
CONFIGURATIONS_AT_ONCE = 4096
"""Configurations that are drawn together, at most: for sockets four times as many as are asked for at first."""
FIRST_DRAWS = 100_000
REACHING_STEPS, LARGEST_STEP, REACHING_DAMPING_M = 25, 0.5, 0.01
"""Damped Gauss-Newton steps that bring a ball to its place, the longest of a joint [rad or m], and their damping."""
REACHED_M = 1e-4
BEYOND_SHARE = 0.25  # of the range of a joint, how far beyond it configurations are near those that have it
LEAST_SHARE = 1e-3
"""Share of the draws that must be accepted, judged from the first draws on: below it the search would not end."""


@small_work()
@outside_inference_mode
def candidates(
    robot: Tree,
    count: int,
    *,
    ranges: Mapping[str, Sequence[float]] | None = None,
    keep: Callable[[Tensor], Any] | None = None,
    tracker: Tracker | None = None,
    floor: float | None = None,
    column: Sequence[float] | None = None,
    places: object = None,
    ball: object = None,
    seed: int = 0,
) -> Tensor:
    """Draw configurations that can be measured, uniformly within the joints' ranges.

    Joint ranges are the limits of the robot, but one turn at most: wider limits are cut around zero, or around their
    middle if they do not hold half a turn to either side of zero.

    Args:
        robot: the chain, n joints.
        count: number of configurations.
        ranges: name of a joint -> (lower, upper), rad or m, instead of its limits; prismatic joints without
            limits need one.
        keep: takes configurations (N, n), rad or m, and returns (N,) booleans, False for those that cannot be measured:
            outside the cell, in collision. See :func:`diffeo_calib.calibration.planning.candidates.collision_free`.
        tracker: the device that has to see the tool.
        floor: height in the robot's base frame, m, below which no link and no tool may be.
        column: x, y and radius of an upright cylinder in the robot's base frame, m, that no link and no tool may enter;
            a fourth number is the height of its top.
        places: (D, 3) in the robot's base frame, m, of sockets to which every configuration has to bring the ball; see
            :class:`Sensor`. They are taken in turn.
        ball: (3,) its place in the frame of the tip, the last of several, m; the tip's origin by default.
        seed: of the draws.

    Returns:
        (count, n), rad or m.

    Raises:
        InputError: arguments of the wrong kind or shape, unknown joints, a slide without range, or fewer than one in a
            thousand draws accepted: the criterion that refuses most of what the others accept is named.
    """
    if not isinstance(robot, Tree):
        raise InputError.of("`robot`", expected="a dc.Tree", got=type(robot).__name__)
    check_count(count, "`count`", most=MOST)
    lower, upper = joint_ranges(robot, ranges)
    criteria = _criteria(robot, keep, tracker, floor, column)
    if places is not None:
        sockets = as_tensor(places, "places", ("D", 3), fix="pass x, y, z of every socket, in m")
        at_ball = as_tensor((0.0, 0.0, 0.0) if ball is None else ball, "ball", (3,))
        criteria = {"places": lambda q: ((q >= lower) & (q <= upper)).all(1), **criteria}
    generator, batches = seeded(check_seed(seed)), [lower.new_empty(0, robot.n)]
    refused = dict.fromkeys(criteria, 0)
    drawn, accepted, together = 0, 0, CONFIGURATIONS_AT_ONCE if places is None else count
    while accepted < count:
        together = min(CONFIGURATIONS_AT_ONCE, 4 * together)
        q = torch.rand(together, robot.n, dtype=torch.float64, device=HOST, generator=generator)
        q = lower + (upper - lower) * q
        if places is not None:
            q = brought_to(robot, q, at_ball, sockets[torch.arange(len(q), device=sockets.device) % len(sockets)])
        for name, criterion in criteria.items():
            allowed = _allowed(name, criterion, q) if len(q) else torch.ones(0, dtype=torch.bool, device=HOST)
            refused[name], q = refused[name] + int((~allowed).sum()), q[allowed]
        drawn, accepted = drawn + together, accepted + len(q)
        batches.append(q)
        if accepted < count and drawn >= FIRST_DRAWS and accepted < LEAST_SHARE * drawn:
            raise _too_few(drawn, refused)
    return torch.cat(batches)[:count]


def brought_to(robot: Tree, q: Tensor, ball: Tensor, places: Tensor) -> Tensor:
    """Configurations near others (N, n) that bring the ball (3,) to places (N, 3), m; NaN where none was found."""
    geometry = Geometry.nominal(robot, 1, robot.tips[-1:]).with_tool(ball[None])
    for _ in range(REACHING_STEPS):
        away = (places - geometry.points(q)[:, 0])[:, :, None]
        J = geometry.jacobian(q)[:, 0]
        damped = J @ J.mT + REACHING_DAMPING_M**2 * torch.eye(3, dtype=q.dtype, device=q.device)
        q = q + (J.mT @ torch.linalg.solve(damped, away))[..., 0].clamp(-LARGEST_STEP, LARGEST_STEP)
    away = (places - geometry.points(q)[:, 0]).norm(dim=1, keepdim=True)
    return torch.where(away < REACHED_M, q, torch.nan)


def joint_ranges(robot: Tree, ranges: Mapping[str, Sequence[float]] | None = None) -> tuple[Tensor, Tensor]:
    """Lower and upper ends (n,) of the joints' ranges; arguments and errors as in :func:`candidates`."""
    if not (ranges is None or isinstance(ranges, Mapping)):
        raise InputError.of("`ranges`", expected="a dictionary joint -> (lower, upper)", got=type(ranges).__name__)
    given = dict(ranges or {})
    unknown = [name for name in given if name not in robot.joint_names]
    if unknown:
        expected = f"joints of the robot: {listed(robot.joint_names)}"
        raise InputError.of(f"`ranges` names {listed(unknown)}", expected=expected, fix="correct the names")
    ends = [
        _given(name, given[name], limits) if name in given else _usual(name, turns, *limits)
        for name, turns, limits in zip(robot.joint_names, robot.periodic, robot.limits.tolist(), strict=True)
    ]
    lower, upper = torch.tensor(ends, dtype=torch.float64, device=HOST).unbind(1)
    return lower, upper


def ranges_around(robot: Tree, q: Tensor) -> dict[str, tuple[float, float]]:
    """Ranges of the joints not far beyond those of configurations (M, n): for what few others show."""
    low, high = q.aminmax(dim=0)
    more, (least, most) = BEYOND_SHARE * (high - low), robot.limits.to(q).unbind(1)
    ends = torch.stack([torch.maximum(low - more, least), torch.minimum(high + more, most)], 1).tolist()
    return {name: (lower, upper) for name, (lower, upper) in zip(robot.joint_names, ends, strict=True)}


def _given(name: str, ends: object, limits: Sequence[float]) -> tuple[float, float]:
    lower, upper = as_tensor(ends, f"ranges['{name}']", (2,), fix="pass (lower, upper)").tolist()
    least, most = (max(limits[0], -MOST_TURNS * TURN), min(limits[1], MOST_TURNS * TURN))
    if not least - ROUNDING <= lower <= upper <= most + ROUNDING:
        expected = f"lower <= upper within the joint's limits, {least:g} to {most:g}"
        got = f"{lower:g} to {upper:g}"
        raise InputError.of(f"`ranges['{name}']`", expected=expected, got=got, fix="check the unit, rad or m")
    return lower, upper


def _usual(name: str, turns: bool, lower: float, upper: float) -> tuple[float, float]:
    """The limits of a joint, or one turn of them."""
    if not turns and not (isfinite(lower) and isfinite(upper)):
        fix = f"pass ranges={{'{name}': (lower, upper)}} in m, or --range {name}=LOWER:UPPER"
        raise InputError.of(f"the prismatic joint '{name}' has no limits", fix=fix)
    if not turns or upper - lower <= TURN:
        return lower, upper
    if lower > -pi:
        return lower, lower + TURN
    return (upper - TURN, upper) if upper < pi else (-pi, pi)


def check_limits(robot: Tree, q: Tensor, name: str) -> None:
    """Raise InputError for configurations (N, n) beyond the limits of the joints: they are commands to a robot."""
    outside = (q < robot.limits[:, 0] - ROUNDING) | (q > robot.limits[:, 1] + ROUNDING)
    if bool(outside.any()):
        joint = int(outside.sum(0).argmax())
        lower, upper = robot.limits[joint].tolist()
        raise InputError.of(
            f"`{name}`: {int(outside.any(1).sum())} of {len(q)} configurations are beyond the robot's limits",
            expected=f"joint '{robot.joint_names[joint]}' within {lower:g} to {upper:g}",
            got=f"{float(q[:, joint].min()):g} to {float(q[:, joint].max()):g}",
            fix="check the unit, rad or m, or leave these configurations out",
        )


def _criteria(robot: Tree, keep: object, tracker: object, floor: float | None, column: object) -> dict[str, Criterion]:
    """Name of every criterion that is asked -> the criterion, cheap ones first."""
    if tracker is not None and not isinstance(tracker, Tracker):
        raise InputError.of("`tracker`", expected="a dc.Tracker", got=type(tracker).__name__)
    if keep is not None and not callable(keep):
        raise InputError.of("`keep`", expected="a function (N, n) -> (N,)", got=type(keep).__name__)
    tip = torch.zeros(1, 3, dtype=torch.float64, device=HOST)
    points = tip if tracker is None else as_tensor(tracker.marker, "marker", (3,))[None]
    criteria: dict[str, Criterion] = {}
    if tracker is not None:
        criteria["tracker"] = tracker.sees(robot)
    if floor is not None:
        check_number(floor, "`floor`, a height in m", above=-float("inf"))
        criteria["floor"] = lambda q: (_links(robot, q, points)[..., 2] >= floor).all(1)
    if column is not None:
        criteria["column"] = outside_column(robot, column, points)
    if keep is not None:
        criteria["keep"] = keep
    return criteria


def _allowed(name: str, criterion: Criterion, q: Tensor) -> Tensor:
    """Which configurations a criterion allows: (N,) boolean."""
    given = criterion(q.clone())  # which it may change
    try:
        value = given.detach().cpu().numpy() if isinstance(given, Tensor) else np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError.of(f"the value of `{name}`", expected="(N,) booleans", got=as_written(given)) from error
    if value.shape != (len(q),) or value.dtype != np.bool_:
        got = f"{value.dtype} {value.shape}"
        raise InputError.of(f"the value of `{name}`", expected=f"({len(q)},) booleans, one per row of q", got=got)
    return torch.from_numpy(value.copy())


def _too_few(drawn: int, refused: dict[str, int]) -> InputError:
    """Names the criterion that refuses the largest share of what those before it accept."""
    shares, left = {}, drawn
    for name, count in refused.items():
        shares[name], left = count / max(left, 1), left - count
    worst = max(shares, key=lambda name: shares[name])
    return InputError.of(
        f"`{worst}` refuses nearly everything: {left} of {drawn} random configurations can be measured",
        expected=f"at least one in {1 / LEAST_SHARE:.0f}",
        got=", ".join(f"`{name}` refuses {100 * share:.2f} %" for name, share in shares.items()),
        fix=f"check the frame and the units of `{worst}`, or narrow the joints' ranges",
    )


ALWAYS_DRAWS = 200
"""Random configurations in which pairs of bodies that always collide are found: neighbours that overlap by design."""


def collision_free(
    robot: Tree, *, packages: Sequence[str | PathLike[str]] = (), seed: int = 0
) -> Callable[[Tensor], Tensor]:
    """A check for ``dc.candidates(..., keep=...)``: whether no two bodies of the URDF collide.

    Bodies of one link, of links that are joined to each other, and pairs that collide in all of 200 random
    configurations are left out. Joints of the URDF that are not in the chain stay at zero.

    Args:
        robot: a chain that was read from a URDF.
        packages: folders in which ``package://`` names of meshes are looked up.
        seed: of the random configurations.

    Returns:
        a function of configurations (N, n), rad or m, that returns (N,) booleans.

    Raises:
        InputError: pinocchio is not installed, the robot has no URDF or no collision geometry, meshes are missing, or a
            joint of the chain cannot be found.
    """
    try:
        import pinocchio as pin  # noqa: PLC0415  # optional
    except ImportError as error:
        fix = "pip install 'diffeo_calib[collisions]', or pass your own check as `keep`"
        raise InputError.of("collisions need the package pinocchio, which is not installed", fix=fix) from error
    model, bodies = _collision_model(pin, robot, [str(path) for path in packages])
    joints = [model.joints[model.getJointId(name)] for name in robot.moving_names]
    data, checked = model.createData(), pin.GeometryData(bodies)

    def collisions(row: Tensor, *, first: bool) -> bool:
        """Whether bodies collide at a configuration (n,); pinocchio has pairs (cos, sin) for continuous joints."""
        full = pin.neutral(model)
        for joint, value in zip(joints, robot.moving_values(row[None])[0].tolist(), strict=True):
            full[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else value
        return pin.computeCollisions(model, data, bodies, checked, full, first)

    ends = zip(robot.joint_names, robot.periodic, robot.limits.isfinite().all(1).tolist(), strict=True)
    lower, upper = joint_ranges(robot, {name: (0.0, 1.0) for name, turns, limited in ends if not (turns or limited)})
    always = np.ones(len(bodies.collisionPairs), dtype=bool)
    for draw in np.random.default_rng(seed).random((ALWAYS_DRAWS, robot.n)):
        collisions(lower + (upper - lower) * torch.from_numpy(draw), first=False)
        always &= np.array([result.isCollision() for result in checked.collisionResults], dtype=bool)
    pairs = [(pair.first, pair.second) for pair in bodies.collisionPairs]
    for pair, constant in zip(pairs, always, strict=True):
        if constant:
            bodies.removeCollisionPair(pin.CollisionPair(*pair))
    checked = pin.GeometryData(bodies)
    return lambda q: torch.tensor([not collisions(row, first=True) for row in q.cpu()], dtype=torch.bool, device=HOST)


def _collision_model(pin: Any, robot: Tree, packages: list[str]) -> tuple[Any, Any]:
    """Pinocchio's model of a URDF, and its bodies with the pairs that may collide, none of neighbours."""
    if robot.source is None:
        fix = "load it with dc.load_urdf, or pass your own check as `keep`"
        what = f"robot '{robot.name}' was not read from a URDF, which holds collision geometry"
        raise InputError.of(what, fix=fix)
    source = robot.source.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    try:
        model = pin.buildModelFromXML(source)
        bodies = pin.buildGeomFromUrdfString(model, source, pin.GeometryType.COLLISION, package_dirs=packages)
    except (ValueError, RuntimeError) as error:
        what = f"the collision geometry of robot '{robot.name}' cannot be read ({' '.join(str(error).split())})"
        raise InputError.of(what, fix="name the folders of its meshes (`packages`)") from error
    if not bodies.ngeoms:
        raise InputError.of(f"the URDF of robot '{robot.name}' has no collision geometry", fix="leave it out")
    if missing := [name for name in robot.moving_names if not model.existJointName(name)]:
        raise InputError.of(f"pinocchio finds no joint {few(missing)} in the URDF", fix="pass your own check")
    bodies.removeAllCollisionPairs()
    for first, second in combinations(range(bodies.ngeoms), 2):
        a, b = (bodies.geometryObjects[k].parentJoint for k in (first, second))
        if not (a == b or model.parents[a] == b or model.parents[b] == a):
            bodies.addCollisionPair(pin.CollisionPair(first, second))
    return model, bodies
