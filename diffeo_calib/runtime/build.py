"""Programs from the contents of model files: plain numbers in, constants out.

The run of a flow's controls, which flow.py replays, is the landmark geodesic of flows/geodesic.py in NumPy:

    q' = v(q),    a' = -Dv(q)^T a,    v = sum_j K(., q_j) a_j.

Sums are plain matrices here: they run once per model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import Array, Tableau
from diffeo_calib.runtime.chain import CalibratedChain, Sag, skew, transforms
from diffeo_calib.runtime.flow import RadialTerm, RecordedFlow
from diffeo_calib.runtime.tables import JointTables, PeriodicSum, Table, tabulate

ROTARY = ("revolute", "continuous")
COINCIDENT = 1e-6
"""Frames whose origins are closer than this [m] count as one place for masses."""
MOST_TABULATED = 1500
"""With more controls, tables would take longer to make than they save: the time grows with the square."""


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


def ancestors_of(before: Sequence[int] | np.ndarray, joints: int) -> np.ndarray:
    """(F, n_all) whether joint l moves place f, from the joints before the places, -1 for the base."""
    found = np.zeros((len(before), joints), dtype=bool)
    for place, last in enumerate(before):
        if last >= 0:
            found[place] = found[last]
            found[place, last] = True
    return found


def motion_terms(axes: Array, revolute: np.ndarray) -> Array:
    """(4, n_all, 4, 4) C, S, D, L of J_l = C + S sin q + D cos q + L q: Rodrigues 1 + K^2 + K sin q - K^2 cos q."""
    K = skew(axes) * revolute[:, None, None]
    out = np.zeros((4, len(axes), 4, 4))
    out[0] = np.eye(4)
    out[0, :, :3, :3] += K @ K
    out[1, :, :3, :3], out[2, :, :3, :3] = K, -(K @ K)
    out[3, :, :3, 3] = axes * ~revolute[:, None]
    return out


def nominal_chain(robot: Mapping[str, Any]) -> NominalChain:
    """The robot that is described as in model files (Tree.to_config)."""
    joints, serial = robot["joints"], "tip" in robot
    parents = range(-1, len(joints) - 1) if serial else robot["parents"]
    tips = {robot["tip"]: len(joints) - 1} if serial else dict(robot["tips"])
    ends, ground = [*tips.values()], -1
    if not serial:
        ground = robot["ground"]
        ends += [number for _, number in robot["loads"]] + ([ground] if ground >= 0 else [])
    after: dict[int, tuple[int, Array]] = {-1: (-1, np.eye(4))}
    offsets, before = [], []
    for number, (joint, parent) in enumerate(zip(joints, parents, strict=True)):
        last, pending = after[parent]
        after[number] = last, pending @ np.array(joint["origin"], float)
        if joint["kind"] != "fixed":
            offsets.append(after[number][1])
            before.append(last)
            after[number] = len(offsets) - 1, np.eye(4)
    offsets += [after[end][1] for end in ends]
    before += [after[end][0] for end in ends]
    moving = [joint for joint in joints if joint["kind"] != "fixed"]
    axes = np.array([joint["axis"] for joint in moving], float)
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    revolute = np.array([joint["kind"] in ROTARY for joint in moving])
    table = _coupling(moving, [joint for joint in robot.get("drivers", ()) if joint["kind"] != "fixed"])
    places = np.array(offsets), np.array(before), tuple(tips), ground >= 0
    return NominalChain(*places, axes, revolute, table[:, :-1].copy(), table[:, -1].copy())


def active_joints(robot: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The joints whose values are the columns of q, described as in model files."""
    every = [*robot["joints"], *robot.get("drivers", ())]
    return [joint for joint in every if joint["kind"] != "fixed" and joint["mimic"] is None]


def _coupling(joints: Sequence[Mapping[str, Any]], drivers: Sequence[Mapping[str, Any]]) -> Array:
    """Values of the moving joints from those of the active ones and 1: (n_all, n + 1).

    Raises:
        ValueError: joints that mimic each other in a circle, or joints that are not there.
    """
    moving = [*joints, *drivers]
    active = [joint["name"] for joint in moving if joint["mimic"] is None]
    units = np.eye(len(active) + 1)
    rows = dict(zip(active, units[:-1], strict=True))
    for _ in moving:  # every round finds a mimic joint at least
        for joint in moving:
            driving = joint["mimic"] or {}
            if joint["name"] not in rows and all(name in rows for name in driving):
                driven = sum(slope * rows[name] for name, slope in driving.items())
                rows[joint["name"]] = driven + joint["mimic_offset"] * units[-1]
    if len(rows) < len(moving):
        raise ValueError("joints that mimic each other in a circle, joints that are not there, or one name twice")
    return np.array([rows[joint["name"]] for joint in joints])


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
        ancestors=ancestors_of(nominal.before, L),
        motions=motion_terms(nominal.axes, nominal.revolute),
        axes=nominal.axes,
        revolute=nominal.revolute,
        coupling=nominal.coupling,
        coupling_offset=nominal.coupling_offset,
        sag=sag,
    )


def gravity_sag(nominal: NominalChain, coefficients: Array) -> Sag:
    """The sag with these coefficients: m_k = sum_f (o_f - o_l) x c_f for the masses at the places f beyond joint l."""
    steps, before = nominal.offsets, nominal.before
    F, L = len(steps), len(nominal.axes)
    distinct = distinct_places(steps, before, nominal.revolute)
    moved, signs = seen_from_ground(ancestors_of(before, L), grounded=nominal.grounded)
    joints, axes, moments, forces, directions, first = [], [], [], [], [], 0
    for joint, axis in enumerate(nominal.axes):
        beyond = [place for place in range(F) if moved[place, joint] and distinct[place] and place != joint]
        turns = [axis, *perpendicular(axis)]
        slides = [] if nominal.revolute[joint] else [axis]
        for direction, sliding in [*((e, True) for e in slides), *((e, False) for e in turns if beyond)]:
            size = 3 if sliding else 3 * len(beyond)
            c = coefficients[first : first + size].reshape(-1, 3)
            first += size
            W, twist = np.zeros((3, F, 3)), np.zeros((L, 6))
            if not sliding:
                W[:, beyond] = -skew(c).swapaxes(0, 1)
                W[:, joint] = skew(c.sum(0))
            twist[joint, : 3 if sliding else 6][-3:] = direction
            joints.append(joint)
            axes.append(direction)
            moments.append(W.reshape(3, -1))
            forces.append(c[0] if sliding else np.zeros(3))
            directions.append(twist.ravel())
    tables = np.array(joints), np.array(axes), np.concatenate(moments), np.array(forces), np.array(directions)
    return Sag(steps, before, nominal.grounded, moved, signs, *tables)


def seen_from_ground(ancestors: np.ndarray, *, grounded: bool) -> tuple[Array, Array]:
    """Which joints move which places as seen from the ground (F, n_all), and the sense (n_all,) of their axes.

    A joint between base and ground, which is the last place if ``grounded``, moves what is on the base's side, in the
    opposite sense.
    """
    moved, signs = ancestors.copy(), np.ones(ancestors.shape[1])
    if grounded:
        between = ancestors[-1]
        moved[:, between] = ~moved[:, between]
        signs[between] = -1.0
    return moved.astype(float), signs


def distinct_places(offsets: Array, before: np.ndarray, revolute: np.ndarray) -> np.ndarray:
    """(F,) whose origin differs from the one before in some configuration: masses there are distinguishable."""
    far = np.linalg.norm(offsets[:, :3, 3], axis=1) > COINCIDENT
    ends = (before < 0) & (np.arange(len(before)) >= len(revolute))
    return far | np.where(before < 0, ends, ~revolute[before])


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
    terms = [term for term in (radial_term(config, stages) for config in kernel) if term.weights.any()]
    alone = {config["output"] for config in kernel if config["output"] is not None}
    small = stages.shape[2] <= MOST_TABULATED
    own = {joint: [term for term in terms if small and term.acts_alone_on(joint)] for joint in sorted(alone)}
    tables = {joint: tables for joint, found in own.items() if found and (tables := _joint_tables(found, joint))}
    rest = [term for term in terms if not any(term in own[joint] for joint in tables)]
    joints = tuple(tables)
    per_stage = tuple(zip(*tables.values(), strict=True))
    steps = len(stages) // len(weights)
    together = JointTables(joints, per_stage) if tables else None
    return RecordedFlow(stages.shape[-1], steps, coefficients, weights, tuple(rest), together)


def _joint_tables(terms: Sequence[RadialTerm], joint: int) -> list[Table] | None:
    """Tables of a joint's own function at every stage; None if it is too rough for them."""
    found = []
    for controls, *weights in zip(terms[0].controls, *(term.weights for term in terms), strict=True):
        sums = [
            PeriodicSum(term.profile, 1.0 / float(term.scales[0]), controls[:, joint], w[:, joint])
            for term, w in zip(terms, weights, strict=True)
        ]
        table = tabulate(sums)
        if table is None:
            return None
        found.append(table)
    return found


def radial_term(config: Mapping[str, Any], stages: Array) -> RadialTerm:
    """A kernel's term with its controls and weights; arguments as in :func:`recorded_flow`."""
    n = stages.shape[-1]
    periodic, columns = config["periodic"], config["columns"]
    columns = range(n) if columns is None else columns
    circle = [periodic if isinstance(periodic, bool) else periodic[c] for c in columns]
    scales = np.broadcast_to(1.0 / np.array(config["lengthscale"], float), (len(circle),))
    lines = [k for k, turning in enumerate(circle) if not turning]
    circles = [k for k, turning in enumerate(circle) if turning]
    amplitude = np.broadcast_to(np.array(config["variance"], float), (n,))
    if config["output"] is not None:
        amplitude = amplitude * (np.arange(n) == config["output"])
    return RadialTerm(
        config["profile"],
        tuple(columns[k] for k in lines),
        tuple(columns[k] for k in circles),
        scales[[*lines, *circles]],
        np.ascontiguousarray(stages[:, 0]),
        stages[:, 1] * amplitude,
    )


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
            stages.append(_combined(state, row, slopes))
            slopes.append(_slope(kernel, stages[-1]))
        state = _combined(state, weights, slopes)
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


def _combined(state: Array, coefficients: Array, slopes: Sequence[Array]) -> Array:
    for c, slope in zip(coefficients, slopes, strict=False):
        state = state + c * slope
    return state
