"""Proposals of `diffeo-calib init` for tables with poses or places of the machine in place of joint values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from math import ceil, inf, nan
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.identification.registration import spread
from diffeo_calib.cli.column_names import WORDS, column, whole
from diffeo_calib.cli.guesses import Body, RowColumns, Sheet, bodies_in, matrices_in, rows_in
from diffeo_calib.cli.options import Rows, Units
from diffeo_calib.cli.proposals import LARGEST_RESIDUAL, Source, percent, ranked, reason, source_of
from diffeo_calib.cli.tables import table_format
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.measurements.csv.cells import numbers_in
from diffeo_calib.measurements.csv.files import read_poses
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.measurements.poses import rotation_matrices
from diffeo_calib.measurements.table_format import ALL_CONVENTIONS, UNITS_PER_METRE, ZERO, numbers_of
from diffeo_calib.robots.cartesian import cartesian
from diffeo_calib.sensors.tables import measured_positions

NUMBERED = "0123456", "1234567", "012345", "123456"
"""Poses of the tool as a series: a place, then a quaternion, a rotation vector or angles."""
SURELY_METRES, LARGEST_IN_METRES = 2.0, 20.0
"""Numbers below the first are metres, above the second millimetres; between them a machine may be small or large."""
UNUSUAL_LENGTHS = ("", ""), ("cm", ""), ("inch", ""), ("", "cm"), ("", "inch")
"""Units of the machine's places and of those measured, tried until one explains the rows; empty: by their size."""
MOST_ROWS, STEPS = 40, (1, 3)  # rows whose motions are compared, and how many rows each of these spans
MOST_WAYS, FEW_WAYS = 60, 6
"""Ways to read the rows that are tried with a registration; if half of so many are right, no rotation is sure."""
TURNED = "robot_pose", "angle", "convention", "rotation_angle", "camera_on_tool"
GOOD_MOTIONS = 0.75  # share of the motions that are compared: those that agree best
ALIKE, EXACT = 6.0, 1e-6
"""Ways that leave more than so many times what the best one leaves are wrong; and shares that are as good as none."""


class Reading(NamedTuple):
    """One way to read the machine's rotation, or the measured one."""

    convention: str = ""
    angle: str = "rad"


def poses_in(sheet: Sheet) -> list[Body]:
    """Places with their rotations, and poses as 6, 7, 12 or 16 numbers, in the order of columns."""
    bodies = bodies_in(sheet.numbers)
    used = {name for body in bodies for name in (*body.place, *body.turn)}
    others = [name for name in sheet.numbers if name not in used]
    bodies += matrices_in(sheet, others)
    flat = [xy for xy in whole(others, "xy") if xy.wished and not xy.says("rate", "deviation")]
    bodies += [Body([*xy.names.values()], []) for xy in flat]
    for labels in NUMBERED:
        taken = {name for body in bodies for name in (*body.place, *body.turn)}
        for group in whole([name for name in others if name not in taken], labels):
            names = list(group.names.values())
            if group.says("tool") and not group.says("rate", "deviation"):
                bodies.append(Body(names[:3], names[3:]))
    return sorted(bodies, key=lambda body: sheet.header.index(body.place[0]))


def machine_of(bodies: Sequence[Body]) -> Body:
    """Columns of the machine: by words of the names, reported ones before wished ones; else the first."""
    seen = WORDS["seen"] - {"target"}  # beside it, what is only said to be measured is the machine's
    others = any(body.words & seen for body in bodies)

    def rank(body: Body) -> int:
        if others and body.words & WORDS["measured"] and not body.words & seen:
            return 3
        if body.words & WORDS["machine"]:
            return 2 + bool(body.words & WORDS["measured"])
        return bool(body.words & (WORDS["wished"] - {"target"})) - len(body.words & (WORDS["seen"] | WORDS["measured"]))

    return max(bodies, key=rank)


def commanded(sheet: Sheet) -> Source:
    """The table as poses of a machine; InputError without poses, places that were measured, or a clear way to read."""
    bodies = poses_in(sheet)
    if not bodies:
        expected = "a ROBOT whose joints the table has columns of, or columns of the poses of a machine"
        what, got = f"'{sheet.path}' without a robot's description", few(sheet.header, 20)
        raise InputError.of(what, expected=expected, got=got)
    machine = machine_of(bodies)
    used = [*machine.place, *machine.turn]
    others = tuple(name for name in sheet.numbers if name not in used)
    rows = rows_in(replace(sheet, numbers=others), used)
    if rows.bodies and rows.bodies[0].turn:  # poses of one frame
        body, *others = rows.bodies
        rows.left.extend(f"{few(extra.place)}: beside the pose of {few(body.place)}; not used" for extra in others)
        rows = rows._replace(bodies=[body], options={**rows.options, "position": [body.written()]})
    tried = list[list[Source]]()
    for lengths in UNUSUAL_LENGTHS:
        tried.append(ranked(_ways(sheet, machine, rows, lengths=lengths)))
        if tried[-1] and tried[-1][0].left <= LARGEST_RESIDUAL:
            break
    ways = min(tried, key=lambda ranking: ranking[0].left if ranking else inf)
    if ways and ways[0].left == inf:
        ways[0].share()  # says why
    if not ways or ways[0].left > LARGEST_RESIDUAL:
        got = f"{percent(ways[0].left)} of what the rows vary unexplained" if ways else "no way to read them"
        what = f"poses of the machine in {few(used, 16)}"
        fix = "check that the rows belong together, or write the campaign file yourself; for joints name the robot"
        if not machine.turn:  # by two axes, in columns of any names
            fix += "; if the machine turns too, a function makes its poses: "
            fix += f"fit --robot-pose {','.join(used)},...=FILE.py:NAME"
        raise InputError.of(what, expected="a convention and units that explain the rows", got=got, fix=fix)
    best, *_ = alike = [way for way in ways if _as_good(way, ways[0])]
    why = reason(best, *(way for way in ways if way not in alike))
    by_size, whose = "the size of the numbers", _lengths(machine.place, _numbers(sheet, machine.place))
    why = {"robot_pose": f"{why}; by their names, in place of joint values", "angle": why, "convention": why}
    why |= {"length": by_size, "joint_length": by_size}
    why |= {"rotation": "beside the columns of its place", "camera_on_tool": "what stands is seen from the flange"}
    best = best.into(why)
    if len(whose) > 1 and best.options.joint_length is None:
        more = f"{by_size}; which machine it is, they do not tell"
        best = best.asking("length", dict.fromkeys(whose, more))
    unsure = 2 * len(alike) >= len(ways) >= MOST_WAYS
    for name in TURNED:
        values = dict.fromkeys(getattr(way.options, name) for way in alike)
        if len(values) > 1 or unsure:
            best = best.asking(name, {value: best.why[name] for value in values if value})
    return best


def _as_good(way: Source, best: Source) -> bool:
    """Whether the rows do not tell a way from the best one: who saw whom changes what a residual is a share of."""

    def metres(source: Source) -> float:
        positions = measured_positions(source.data)
        return source.left * (1.0 if positions is None else spread(positions.largest_session().points))

    factor = gates.READINGS_TOLD_APART
    return way.left <= factor * best.left or (way.left <= LARGEST_RESIDUAL and metres(way) < factor * metres(best))


def _ways(sheet: Sheet, machine: Body, rows: RowColumns, *, lengths: tuple[str, str]) -> Iterator[Source]:
    """The likeliest ways to read the table; lengths of the machine and of what was measured are empty where sought."""
    place, turn, *_ = rows.bodies[0] if rows.bodies else Body([], [])
    groups = machine.place, machine.turn, place, turn
    numbers = _numbers(sheet, [name for names in groups for name in names])
    if not len(numbers):
        return
    commanded_at, commanded_turn, seen_at, seen_turn = numbers.split([len(names) for names in groups], 1)
    length = lengths[0] or _lengths(machine.place, commanded_at)[0]
    other = lengths[1] or (_lengths(place, seen_at)[0] if place else length)
    own, seen = _readings(commanded_turn), _readings(seen_turn)
    if own and seen:
        metres = [values / UNITS_PER_METRE[unit] for values, unit in ((commanded_at, length), (seen_at, other))]
        ways = _alike((metres[0], own), (metres[1], seen))
    else:
        ways = list(product(own or [Reading()], seen or [Reading()], (False, True)[: 1 + Rows(**rows.options).images]))
    units = {"length": other, "joint_length": None if length == other else length}
    for commanded, measured, camera in ways[:FEW_WAYS] if any(lengths) else ways:
        pose = PoseColumns((*machine.place, *machine.turn), commanded.convention).text
        given: dict[str, Any] = {**units, "angle": commanded.angle, "robot_pose": pose}
        more: dict[str, Any] = {"camera_on_tool": camera}
        if turn:
            unit = measured.angle if len(turn) == 3 else None
            more |= {"rotation": [",".join(turn)], "convention": measured.convention, "rotation_angle": unit}
        with quiet(), suppress(DiffeoCalibError):
            robot = cartesian(read_poses(sheet.path, table_format(Units(**given, **sheet.marks)))[1])
            yield source_of(sheet, robot, rows, **given, **more)


def _numbers(sheet: Sheet, names: Sequence[str]) -> Tensor:
    """Columns as they are (N, c), of the rows without an empty cell among them."""
    flat = [ZERO] * len(sheet.cells[sheet.header[0]])  # places in a plane
    columns = [numbers_in(sheet.cells.get(name, flat), sheet.decimal) for name in names]
    values = [[nan if value is None else value for value in series] for series in columns]
    numbers = torch.tensor(values, dtype=torch.float64, device=HOST)
    return numbers[:, numbers.isfinite().all(0)].T


def _lengths(names: Sequence[str], values: Tensor) -> tuple[str, ...]:
    """Units of lengths that places may have, by their names, else by the size of the numbers; the likeliest first."""
    named = {column(name).unit for name in names} - {""}
    if others := named - {*UNITS_PER_METRE}:
        what, expected = f"{few(names)} in {few(sorted(others))}", few([*UNITS_PER_METRE])
        raise InputError.of(what, expected=expected, fix="convert them")
    if len(named) == 1:
        return (named.pop(),)
    largest = float(values.abs().max()) if values.numel() else 0.0
    return ("mm",) if largest > LARGEST_IN_METRES else ("m",) if largest < SURELY_METRES else ("m", "mm")


def _readings(numbers: Tensor) -> dict[Reading, Tensor]:
    """Rotations (N, 3, 3) in every convention that can be meant."""
    rotations = dict[Reading, Tensor]()
    count = numbers.shape[1]
    for convention in (name for name in ALL_CONVENTIONS if numbers_of(name) == count):
        for angle in ("deg", "rad") if count == 3 else ("rad",):
            with suppress(InputError):
                rotations[Reading(convention, angle)] = rotation_matrices(numbers, convention, angle=angle)
    return rotations


def _alike(
    commanded: tuple[Tensor, dict[Reading, Tensor]], target: tuple[Tensor, dict[Reading, Tensor]]
) -> list[tuple[Reading, Reading, bool]]:
    """Ways to read the rotations of both bodies, and whether what stands was seen from the flange, the likeliest first.

    Motions of the flange between rows, A, and of what was seen, B, are conjugate, A X = X B: their angles and their
    shifts along the axes are the same (H. H. Chen, "A screw motion approach to uniqueness analysis of head-eye
    geometry", 1991). So are those of the inverse: who saw whom is for the rows to tell. Of each body places (N, 3), m,
    and rotations (N, 3, 3) by reading.
    """
    some = slice(None, None, -(-len(commanded[0]) // MOST_ROWS))
    bodies = [(place[some], torch.stack([*turns.values()])[:, some]) for place, turns in (commanded, target)]
    size = max(float((place - place.mean(0)).norm(dim=1).mean()) for place, _ in bodies) or 1.0
    flange, others = (_screws(*body, size) for body in bodies)
    whole = flange.abs().mean(1)[:, None] + others.abs().mean(1)  # small where radians are read as degrees
    away = (flange[:, None] - others).abs().sort(dim=2).values  # the worst may be of gross rows
    left = (away[:, :, : ceil(GOOD_MOTIONS * away.shape[2])].mean(2) / whole.clamp(min=EXACT)).flatten().tolist()
    pairs = sorted(zip(left, product(commanded[1], target[1]), strict=True), key=lambda entry: entry[0])
    alike = [pair for misfit, pair in pairs if misfit <= ALIKE * max(pairs[0][0], EXACT)][: MOST_WAYS // 2]
    return [(*pair, camera) for pair in alike for camera in (False, True)]


def _screws(places: Tensor, R: Tensor, size: float) -> Tensor:
    """Angles, rad, and shifts along the axes times sines, over a size, of motions between rows: (c readings, 2 K)."""
    motions = list[Tensor]()
    for step in STEPS:
        turns = R.mT @ R.roll(-step, 1)
        shifts = (R.mT @ (places.roll(-step, 0) - places)[..., None])[..., 0]
        skew = turns - turns.mT
        axes = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], 2)
        trace = turns.diagonal(dim1=2, dim2=3).sum(2)
        motions += [torch.atan2(axes.norm(dim=2), trace - 1), (axes * shifts).sum(2) / (2 * size)]
    return torch.cat(motions, 1)
