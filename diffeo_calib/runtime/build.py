"""Programs from the contents of model files: plain numbers in, constants out.

The run of a flow's controls, which flow.py replays, is the landmark geodesic of flows/geodesic.py in NumPy:

    q' = v(q),    a' = -Dv(q)^T a,    v = sum_j K(., q_j) a_j.

Sums are plain matrices here: they run once per model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from diffeo_calib.common.errors import RobotError
from diffeo_calib.runtime.arrays import Array, Tableau, as_index, skew, transforms
from diffeo_calib.runtime.chain import CalibratedChain, Sag
from diffeo_calib.runtime.flow import RadialTerm, RecordedFlow, combined
from diffeo_calib.runtime.tables import JointTables, PeriodicSum, Table, tabulate

ROTARY = ("revolute", "continuous")
COINCIDENT_FRAMES_M = 1e-6
"""Frames whose origins are closer than this [m] count as one place for masses."""
MOST_TABULATED = 1500
"""With more controls, tables would take longer to make than they save: the time grows with the square."""


@dataclass(frozen=True, eq=False)
class Compliance:
    """One compliance and its family of features: the sag of a joint's frame in one direction; see robots/gravity.py.

    Args:
        joint: number of the moving joint whose frame sags.
        direction: (6,) unit twist in the frame before the joint's motion, translation first.
        own: whether it is along the joint's own motion (else lateral).
        places: numbers of the places at which masses pull. Empty for a slide along its axis, where the feature is the
            force itself.
        loaded: whether the load is the payload, whose mass is known.
    """

    joint: int
    direction: Array
    own: bool
    places: tuple[int, ...]
    loaded: bool = False

    @property
    def size(self) -> int:
        """Number of its features."""
        return 3 * max(len(self.places), 1)

    @property
    def axis(self) -> Array:
        """(3,) the unit vector along which it slides, or about which it turns."""
        return self.direction[3:] if self.places else self.direction[:3]


@dataclass(frozen=True, eq=False)
class NominalChain:
    """Constants of a robot, see robots/tree.py.

    Args:
        offsets: (F, 4, 4) of all places: joints, tips, loads, ground.
        before: (F,) the moving joints before them, -1 for the base.
        tips: their names. grounded: whether the last place is the ground; else it is the base.
        axes: (n_all, 3). revolute: (n_all,).
        coupling: (n_all, n). coupling_offset: (n_all,).
    """

    offsets: Array
    before: np.ndarray
    tips: tuple[str, ...]
    grounded: bool
    axes: Array
    revolute: np.ndarray
    coupling: Array
    coupling_offset: Array

    @cached_property
    def ancestors(self) -> np.ndarray:
        """(F, n_all) whether joint l moves place f."""
        found = np.zeros((len(self.before), len(self.axes)), dtype=bool)
        for place, last in enumerate(self.before):
            if last >= 0:
                found[place] = found[last]
                found[place, last] = True
        return found

    @cached_property
    def motion_terms(self) -> Array:
        """(4, n_all, 4, 4) C, S, D, L of J_l = C + S sin q + D cos q + L q.

        Rodrigues: 1 + K^2 + K sin q - K^2 cos q.
        """
        K = skew(self.axes) * self.revolute[:, None, None]
        out = np.zeros((4, len(self.axes), 4, 4))
        out[0] = np.eye(4)
        out[0, :, :3, :3] += K @ K
        out[1, :, :3, :3], out[2, :, :3, :3] = K, -(K @ K)
        out[3, :, :3, 3] = self.axes * ~self.revolute[:, None]
        return out

    @cached_property
    def seen_from_ground(self) -> tuple[np.ndarray, Array]:
        """Which joints move which places as seen from the ground (F, n_all), and the sense (n_all,) of their axes.

        A joint between base and ground moves what is on the base's side, in the opposite sense.
        """
        moved, signs = self.ancestors.copy(), np.ones(len(self.axes))
        if self.grounded:
            between = self.ancestors[-1]
            moved[:, between] = ~moved[:, between]
            signs[between] = -1.0
        return moved, signs

    @cached_property
    def distinct(self) -> np.ndarray:
        """(F,) whose origin differs from the one before in some configuration: masses there are distinguishable."""
        far = np.linalg.norm(self.offsets[:, :3, 3], axis=1) > COINCIDENT_FRAMES_M
        ends = (self.before < 0) & (np.arange(len(self.before)) >= len(self.axes))
        return far | np.where(self.before < 0, ends, ~self.revolute[self.before])

    @cached_property
    def compliances(self) -> tuple[Compliance, ...]:
        """Every joint's own compliance and its two lateral ones (three for a slide)."""
        moved, found = self.seen_from_ground[0] & self.distinct[:, None], []
        for joint, axis in enumerate(self.axes):
            beyond = tuple(place for place in np.flatnonzero(moved[:, joint]).tolist() if place != joint)
            if not self.revolute[joint]:
                found.append(Compliance(joint, np.append(axis, np.zeros(3)), True, ()))
            if beyond:
                turns = np.pad([axis, *perpendicular(axis)], ((0, 0), (3, 0)))
                own = bool(self.revolute[joint]), False, False
                found += [Compliance(joint, *turn, beyond) for turn in zip(turns, own, strict=True)]
        return tuple(found)


def nominal_chain(robot: Mapping[str, Any]) -> NominalChain:
    """The robot that is described as in model files (Tree.to_config).

    Raises:
        RobotError: a tip without a moving joint before it, two joints with one name, a joint that mimics a fixed joint
            or one that is not there, or joints that mimic one another in a circle.
    """
    joints, serial, drivers = robot["joints"], "tip" in robot, robot.get("drivers", ())
    parents = range(-1, len(joints) - 1) if serial else robot["parents"]
    tips = {robot["tip"]: len(joints) - 1} if serial else dict(robot["tips"])
    ends, ground = [*tips.values()], -1
    if not serial:
        ground = robot["ground"]
        ends = [*(tips | dict(robot["loads"])).values()] + ([ground] if ground >= 0 else [])
    after: dict[int, tuple[int, Array]] = {-1: (-1, np.eye(4))}  # moving joint before a link, and transform from it
    offsets, before = [], []
    for number, (joint, parent) in enumerate(zip(joints, parents, strict=True)):
        last, pending = after[parent]
        after[number] = last, pending @ np.array(joint["origin"], float)
        if joint["kind"] != "fixed":
            offsets.append(after[number][1])
            before.append(last)
            after[number] = len(offsets) - 1, np.eye(4)
    for tip, end in tips.items():
        if after[end][0] < 0:
            what = f"robot '{robot['name']}' has no moving joint from '{robot['base']}' to '{tip}'"
            raise RobotError.of(what, fix="choose a base and a tip with a moving joint between them")
    offsets += [after[end][1] for end in ends]
    before += [after[end][0] for end in ends]
    moving = [joint for joint in joints if joint["kind"] != "fixed"]
    names = [joint["name"] for joint in (*moving, *drivers)]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RobotError.of(f"robot '{robot['name']}' has several joints named {twice}", fix="give each its own name")
    axes = np.array([joint["axis"] for joint in moving], float)
    revolute = np.array([joint["kind"] in ROTARY for joint in moving])
    fixed = [joint["name"] for joint in (*joints, *drivers) if joint["kind"] == "fixed"]
    between = f"'{robot['base']}' and '{', '.join(tips)}'"
    driving = [joint for joint in drivers if joint["kind"] != "fixed"]
    table = _coupling(moving, driving, fixed, f"robot '{robot['name']}'", between)
    places = np.array(offsets), np.array(before), tuple(tips), ground >= 0
    return NominalChain(*places, axes, revolute, table[:, :-1].copy(), table[:, -1].copy())


def active_joints(robot: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The joints whose values are the columns of q, described as in model files."""
    every = [*robot["joints"], *robot.get("drivers", ())]
    return [joint for joint in every if joint["kind"] != "fixed" and joint["mimic"] is None]


def _coupling(
    moving: Sequence[Mapping[str, Any]],
    drivers: Sequence[Mapping[str, Any]],
    fixed: Sequence[str],
    robot: str,
    between: str,
) -> Array:
    """Values of all moving joints by those of the n active ones, and 1: (n_all, n + 1), rad or m.

    Args:
        moving: the n_all joints that move something. drivers: joints that drive some of these and move nothing else.
        fixed: names of fixed joints. robot: which robot it is, for messages. between: links where its joints are.
    """
    every = [*moving, *drivers]
    active = [joint["name"] for joint in every if joint["mimic"] is None]
    units = np.eye(len(active) + 1)  # a column per active joint, one of constants
    rows: dict[str, Any] = dict(zip(active, units, strict=False))
    waiting = {joint["name"]: joint["mimic"] for joint in every if joint["mimic"] is not None}
    names = {joint["name"] for joint in every}
    for name, mimic in waiting.items():
        for driver in mimic:
            if driver not in names:
                raise _no_driver(name, driver, robot, between, fixed=driver in fixed)
    constants = {joint["name"]: joint["mimic_offset"] * units[-1] for joint in every}
    while waiting:
        ready = [name for name, mimic in waiting.items() if all(driver in rows for driver in mimic)]
        if not ready:
            what = f"joints of {robot} mimic each other in a circle: {' -> '.join(_circle(waiting))}"
            raise RobotError.of(what, fix="make one of them active")
        for name in ready:
            mimic = waiting.pop(name)
            rows[name] = sum((slope * rows[driver] for driver, slope in mimic.items()), constants[name])
    return np.array([rows[joint["name"]] for joint in moving])


def _no_driver(name: str, driver: str, robot: str, between: str, *, fixed: bool) -> RobotError:
    """The error of a joint that mimics one that does not move, or that is not there."""
    what = f"joint '{name}' of {robot} mimics '{driver}'"
    if fixed:
        fix = f"make '{name}' fixed as well, or let it mimic a moving joint"
        return RobotError.of(f"{what}, which is fixed", fix=fix)
    fix = "choose a base and a tip with that joint between them, correct its name, or make the joint active"
    return RobotError.of(f"{what}, which is not a joint between {between}", fix=fix)


def _circle(waiting: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Names of joints in one circle, closed by the first; every joint of ``waiting`` mimics another one of them."""
    path = [next(iter(waiting))]
    while True:
        driver = next(name for name in waiting[path[-1]] if name in waiting)
        if driver in path:
            return [*path[path.index(driver) :], driver]
        path.append(driver)


def calibrated_chain(
    nominal: NominalChain, base: Array, joint_errors: Array, theta: Array, coefficients: Array | None
) -> CalibratedChain:
    """A chain with its errors.

    Args:
        nominal: the robot. base: (4, 4) [m]. joint_errors: (n_all, 4, 4) [m].
        theta: (6 + 6 n_all,) error twists of base and joints [m, rad].
        coefficients: of the gravity sag (robots/gravity.py); None without it.
    """
    L, T = len(nominal.axes), len(nominal.tips)
    twists = theta[: 6 + 6 * L].reshape(-1, 6)
    offsets = nominal.offsets[:L] @ joint_errors
    sag = None if coefficients is None or not coefficients.any() else gravity_sag(nominal, coefficients)
    if sag is None:
        offsets, constant = offsets @ transforms(twists[1:]), np.zeros_like(twists[1:])
    else:
        constant = twists[1:]
    return CalibratedChain(
        start=base @ transforms(twists[0]),
        offsets=offsets,
        twists=constant,
        tips=nominal.offsets[L : L + T],
        before=nominal.before,
        ancestors=nominal.ancestors,
        motions=nominal.motion_terms,
        axes=nominal.axes,
        revolute=nominal.revolute,
        coupling=nominal.coupling,
        coupling_offset=nominal.coupling_offset,
        sag=sag,
    )


def gravity_sag(nominal: NominalChain, coefficients: Array) -> Sag:
    """The sag with these coefficients: m_k = sum_f (o_f - o_l) x c_f for the masses at the places f beyond joint l."""
    own, F, L = nominal.compliances, len(nominal.offsets), len(nominal.axes)
    moments, forces, directions = (np.zeros((len(own), *shape)) for shape in ((3, F, 3), (3,), (L, 6)))
    sizes = np.cumsum([compliance.size for compliance in own])
    for k, (compliance, w) in enumerate(zip(own, np.split(coefficients, sizes[:-1]), strict=True)):
        c = w.reshape(-1, 3)
        if compliance.places:
            moments[k, :, list(compliance.places)] = -skew(c)
            moments[k, :, compliance.joint] = skew(c.sum(0))
        else:
            forces[k] = c[0]
        directions[k, compliance.joint] = compliance.direction
    moved, signs = nominal.seen_from_ground
    axes, joints = np.array([c.axis for c in own]), np.array([c.joint for c in own])
    flat = moments.reshape(-1, 3 * F), forces, directions.reshape(-1, 6 * L)
    return Sag(nominal.offsets, nominal.before, nominal.grounded, moved.astype(float), signs, joints, axes, *flat)


def perpendicular(axis: Array) -> Array:
    """Two unit vectors perpendicular to a unit vector (3,) and to each other: (2, 3).

    Rows of the Householder reflection that maps the first axis to +-``axis``. Coefficients in model files refer to
    them, so that they must not depend on a library's choice of basis.
    """
    v = axis.copy()
    v[0] += 1.0 if axis[0] >= 0 else -1.0
    return (np.eye(3) - 2.0 * np.outer(v, v) / (v @ v))[1:]


def recorded_flow(
    kernel: Sequence[Mapping[str, Any]], stages: Array, coefficients: Array, weights: Array
) -> RecordedFlow:
    """The flow of a recorded geodesic.

    Args:
        kernel: terms as in model files (kernels/radial.py).
        stages: (S, 2, C, n) controls and momenta at every stage.
        coefficients: (s, s), weights: (s,) of the Runge-Kutta method.
    """
    rest: list[RadialTerm] = []
    alone: dict[int, list[RadialTerm]] = {}
    steps, n = len(stages) // len(weights), stages.shape[-1]
    for config in kernel:
        term, joint = radial_term(config, stages), config["output"]
        if not term.weights.any():
            continue
        if joint is not None and _inputs(config, n) == ([], [joint]) and stages.shape[2] <= MOST_TABULATED:
            alone.setdefault(joint, []).append(term)
        else:
            rest.append(term)
    tables = {joint: _joint_tables(terms, stages[:, 0, :, joint], joint) for joint, terms in sorted(alone.items())}
    smooth = {joint: found for joint, found in tables.items() if found}
    rest += [term for joint, terms in alone.items() if joint not in smooth for term in terms]
    together = JointTables.of(list(smooth), list(zip(*smooth.values(), strict=True)), n) if smooth else None
    steps = steps if rest or together else 0
    return RecordedFlow(n, steps, coefficients / max(steps, 1), weights / max(steps, 1), tuple(rest), together)


def _joint_tables(terms: Sequence[RadialTerm], controls: Array, joint: int) -> list[Table] | None:
    """Tables of a joint's own function at every stage, for controls (S, C); None if it is too rough for them."""
    found = []
    for stage, angles in enumerate(controls):
        sums = [
            PeriodicSum(term.profile, 1.0 / float(term.scales[0]), angles, term.weights[stage, :, joint])
            for term in terms
        ]
        table = tabulate(sums)
        if table is None:
            return None
        found.append(table)
    return found


def _inputs(config: Mapping[str, Any], n: int) -> tuple[list[int], list[int]]:
    """Columns that a kernel's term takes as lines and as circles."""
    periodic, columns = config["periodic"], config["columns"]
    columns = list(range(n)) if columns is None else columns
    circles = [c for c in columns if (periodic if isinstance(periodic, bool) else periodic[c])]
    return [c for c in columns if c not in circles], circles


def radial_term(config: Mapping[str, Any], stages: Array) -> RadialTerm:
    """A kernel's term with its controls and weights; arguments as in :func:`recorded_flow`."""
    n, columns = stages.shape[-1], config["columns"]
    lines, circles = _inputs(config, n)
    columns = list(range(n)) if columns is None else list(columns)
    scales = np.broadcast_to(1.0 / np.array(config["lengthscale"], float), (len(columns),))
    scales = scales[[columns.index(c) for c in (*lines, *circles)]]
    amplitude = np.broadcast_to(np.array(config["variance"], float), (n,))
    if config["output"] is not None:
        amplitude = amplitude * (np.arange(n) == config["output"])
    L, x, angles = len(lines), stages[:, 0][..., lines], stages[:, 0][..., circles]
    centre = x.mean(axis=(0, 1))
    parts = (x - centre) * scales[:L], np.cos(angles) * scales[L:], np.sin(angles) * scales[L:]
    F = np.concatenate(parts, axis=-1)  # (S, C, D)
    square = (F * F).sum(-1, keepdims=True) + (scales[L:] ** 2).sum()  # and that of any point on the circles
    right = np.concatenate([-2.0 * F, square], axis=-1)
    right = np.ascontiguousarray(right.swapaxes(1, 2))
    indices = as_index(lines), as_index(circles)
    return RadialTerm(config["profile"], *indices, scales, centre, right, stages[:, 1] * amplitude)


def recorded_stages(
    kernel: Sequence[Mapping[str, Any]], q: Array, a: Array, tableau: Tableau, steps: int
) -> tuple[Array, Array]:
    """Integrate the controls over t in [0, 1].

    Args:
        kernel: terms as in model files. q, a: (C, n) controls and momenta at time 0.
        tableau: coefficients and weights. steps: number of equal steps.

    Returns:
        the states at every stage (S, 2, C, n), and at the end (2, C, n).
    """
    coefficients, weights = (t / steps for t in tableau)
    state, stages = np.stack([q, a]), []
    for _ in range(steps):
        slopes: list[Array] = []
        for row in coefficients:
            stages.append(combined(state, row, slopes))
            slopes.append(_slope(kernel, stages[-1]))
        state = combined(state, weights, slopes)
    return np.stack(stages), state


def _slope(kernel: Sequence[Mapping[str, Any]], state: Array) -> Array:
    """(v(q), -Dv(q)^T a)."""
    q, a = state
    total = np.zeros_like(state)
    for config in kernel:
        term = radial_term(config, state[None])
        if term.weights.any():
            v, dv = term.velocity_and_jacobian(0, q)
            total += np.stack([v, -(dv.swapaxes(1, 2) @ a[..., None])[..., 0]])
    return total
