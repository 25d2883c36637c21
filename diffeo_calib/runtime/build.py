"""Programs from the contents of model files: plain numbers in, constants out.

The run of a flow's controls, which flow.py replays, is the landmark geodesic of flows/geodesic.py in NumPy:

    q' = v(q),    a' = -Dv(q)^T a,    v = sum_j K(., q_j) a_j.

Sums are plain matrices here: they run once per model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffeo_calib.common.errors import RobotError
from diffeo_calib.runtime.arrays import Array, Tableau, as_index, combined, skew, transforms
from diffeo_calib.runtime.chain import CalibratedChain, Masses, NominalChain, Waves
from diffeo_calib.runtime.flow import RadialTerm, RecordedFlow
from diffeo_calib.runtime.tables import JointTables, PeriodicSum, Table, tabulate

ROTARY = ("revolute", "continuous")
MOST_TABULATED = 1500
"""With more controls, tables would take longer to make than they save: the time grows with the square."""

MOST_TERMS = 1000  # of the errors of an axis: more are no smooth function, and a file with 10^9 would fill the memory


def nominal_chain(robot: Mapping[str, Any]) -> NominalChain:
    """The robot that is described as in model files (Tree.to_config).

    Raises RobotError: a tip without a moving joint before it, two joints with one name, a joint that mimics a fixed
    joint or one that is not there, or joints that mimic one another in a circle.
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
    K, motions = skew(axes) * revolute[:, None, None], np.zeros((4, len(axes), 4, 4))
    motions[0] = np.eye(4)  # Rodrigues: 1 + K^2 + K sin q - K^2 cos q
    motions[0, :, :3, :3] += K @ K
    motions[1, :, :3, :3], motions[2, :, :3, :3] = K, -(K @ K)
    motions[3, :, :3, 3] = axes * ~revolute[:, None]
    between = f"'{robot['base']}' and '{', '.join(tips)}'"
    active = [joint for joint in (*moving, *drivers) if joint["kind"] != "fixed" and joint["mimic"] is None]
    limits = np.array([[joint["lower"], joint["upper"]] for joint in active], float).reshape(-1, 2)  # None is NaN
    limits = np.where(np.isnan(limits), [-np.inf, np.inf], limits)
    table = _coupling(robot, moving, [joint["name"] for joint in active], between)
    places, names = (np.array(offsets), np.array(before), tuple(tips), ground >= 0), [joint["name"] for joint in active]
    coupling, start = table[:, :-1].copy(), table[:, -1].copy()
    return NominalChain(*places, axes, revolute, motions, coupling, start, tuple(names), limits)


def _coupling(
    robot: Mapping[str, Any], moving: Sequence[Mapping[str, Any]], active: Sequence[str], between: str
) -> Array:
    """Values of the n_all moving joints by those of the n active ones, and 1: (n_all, n + 1), rad or m."""
    drivers = [joint for joint in robot.get("drivers", ()) if joint["kind"] != "fixed"]
    mimics = {joint["name"]: joint["mimic"] or {} for joint in (*moving, *drivers)}
    fixed = [joint["name"] for joint in (*robot["joints"], *robot.get("drivers", ())) if joint["name"] not in mimics]
    place = list(mimics).index
    slopes, start = np.zeros((len(mimics), len(mimics))), np.zeros((len(mimics), len(active) + 1))
    start[:, -1] = [joint["mimic_offset"] for joint in (*moving, *drivers)]
    start[[place(name) for name in active]] = np.eye(*start[: len(active)].shape)
    for row, (name, mimic) in enumerate(mimics.items()):
        for driver, slope in mimic.items():
            if driver not in mimics:
                what = f"joint '{name}' of robot '{robot['name']}' mimics '{driver}', which is "
                fix = f"make '{name}' fixed as well, or let it mimic a moving joint"
                if driver not in fixed:
                    what += f"not a joint between {between}"
                    fix = "choose a base and a tip with that joint between them, correct its name, or make it active"
                raise RobotError.of(what + "fixed" * (driver in fixed), fix=fix)
            slopes[row, place(driver)] = slope
    by_driver = (slopes != 0).astype(float)
    ways = by_driver @ np.linalg.matrix_power(by_driver + np.eye(len(mimics)), len(mimics))  # of any length
    if circle := [name for name, closed in zip(mimics, ways.diagonal(), strict=True) if closed]:
        what = f"joints of robot '{robot['name']}' mimic each other in a circle: {', '.join(circle)}"
        raise RobotError.of(what, fix="make one of them active")
    rows = start
    for _ in mimics:
        rows = slopes @ rows + start
    return rows[: len(moving)]


def calibrated_chain(
    nominal: NominalChain,
    base: Array,
    joint_errors: Array,
    theta: Array,
    markers: int = 0,
    *,
    elastic: bool = False,
    waves: Sequence[Sequence[float]] = (),
    axes: Sequence[Sequence[float]] = (),
) -> CalibratedChain:
    """A chain with its errors.

    Args:
        nominal: the robot. base: (4, 4) [m]. joint_errors: (n_all, 4, 4) [m].
        theta: (K,) error twists of base and joints [m, rad], shifts of the markers, coefficients of the gravity sag of
            an elastic robot (robots/gravity.py), of waves and of axes.
        markers: how many. waves, axes: the arguments of :func:`gear_waves` and :func:`axis_waves`.
    """
    L, T, last = len(nominal.axes), len(nominal.tips), len(theta) - sum(6 * int(axis[3]) for axis in axes)
    ends = 6 + 6 * L, 6 + 6 * L + 3 * markers, last - 2 * len(waves), last
    twist_values, _, coefficients, by_wave, by_axis = np.split(theta, ends)
    periodic = gear_waves(waves, nominal.coupling.shape[1]).times(by_wave) if waves else None
    crooked = axis_waves(axes, L).times(by_axis) if axes else None
    twists, offsets = twist_values.reshape(-1, 6), nominal.offsets[:L] @ joint_errors
    sag, constant = None, twists[1:]
    if elastic and coefficients.any():
        sag = Masses.of(nominal.compliances, nominal).sag(coefficients)
    if sag is None and crooked is None:
        offsets, constant = offsets @ transforms(constant), np.zeros_like(constant)
    start, tips = base @ transforms(twists[0]), nominal.offsets[L : L + T]
    return CalibratedChain(nominal, start, offsets, constant, tips, sag, periodic, crooked)


def gear_waves(waves: Sequence[Sequence[float]], n: int) -> Waves:
    """Cosine and sine of every wave, of which joint and frequency are given, in the value of one of n active joints."""
    for joint, w in waves:
        if not (0 <= joint < n and 0 < w < np.inf):
            raise RobotError.of("gear waves", expected=f"joints below {n}, positive frequencies", got=(joint, w))
    table = np.array([(joint, w, s, -np.inf, np.inf) for joint, w in waves for s in (0.0, 0.5 * np.pi / w)])
    return _waves(table, n)


def axis_waves(axes: Sequence[Sequence[float]], n_all: int) -> Waves:
    """cos(k pi (x - low) / (high - low)) of the value of every axis, for k from 1 to its count.

    Args:
        axes: number of one of ``n_all`` moving joints, low, high and count of each.
    """
    for a, low, high, K in axes:
        if not (0 <= a < n_all and -np.inf < low < high < np.inf and 0 < K <= MOST_TERMS):
            expected = f"joints below {n_all}, ranges, and 1 to {MOST_TERMS} terms"
            raise RobotError.of("errors of axes", expected=expected, got=(a, low, high, K))
    table = [(a, k * np.pi / (high - low), low, low, high) for a, low, high, K in axes for k in range(1, int(K) + 1)]
    return _waves(np.array(table), n_all)


def _waves(table: Array, size: int) -> Waves:
    joints, *columns = table.reshape(-1, 5).T.copy()
    return Waves(joints.astype(np.int64), *columns, np.eye(size)[joints.astype(np.int64)])


def recorded_flow(
    kernel: Sequence[Mapping[str, Any]], stages: Array, coefficients: Array, weights: Array
) -> RecordedFlow:
    """The flow of a recorded geodesic.

    Args:
        kernel: terms as in model files (kernels/radial.py). stages: (S, 2, C, n) controls and momenta at every stage.
        coefficients: (s, s), weights: (s,) of the Runge-Kutta method.
    """
    rest, alone, smooth = list[RadialTerm](), dict[int, list[RadialTerm]](), dict[int, list[Table]]()
    steps, n = len(stages) // len(weights), stages.shape[-1]
    for config in kernel:
        term, joint = radial_term(config, stages), config["output"]
        single: bool = joint is not None and _inputs(config, n) == ([], [joint]) and stages.shape[2] <= MOST_TABULATED
        if term.weights.any():
            (alone.setdefault(int(joint), []) if single else rest).append(term)
    for joint, terms in sorted(alone.items()):
        if (tables := _joint_tables(terms, stages[:, 0, :, joint], joint)) is None:
            rest += terms
        else:
            smooth[joint] = tables
    together = JointTables.of(list(smooth), list(zip(*smooth.values(), strict=True)), n) if smooth else None
    steps = steps if rest or together else 0
    return RecordedFlow(n, steps, coefficients / max(steps, 1), weights / max(steps, 1), tuple(rest), together)


def _joint_tables(terms: Sequence[RadialTerm], controls: Array, joint: int) -> list[Table] | None:
    """Tables of a joint's own function at every stage, for controls (S, C); None if it is too rough for them."""
    tables = list[Table]()
    for stage, angles in enumerate(controls):
        sums = [(term.profile, 1.0 / float(term.scales[0]), angles, term.weights[stage, :, joint]) for term in terms]
        if (table := tabulate([PeriodicSum(*terms_of_sum) for terms_of_sum in sums])) is None:
            return None
        tables.append(table)
    return tables


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
    """Integrate the controls over t in [0, 1]: the states at every stage (S, 2, C, n), and at the end (2, C, n).

    Args:
        kernel: terms as in model files. q, a: (C, n) controls and momenta at time 0. steps: number of equal ones.
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
