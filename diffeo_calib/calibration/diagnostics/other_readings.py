"""Other readings of a table that does not fit: its rotations in another convention, other columns, a longer chain.

The numbers are read again from the file, so that only measurements that were read from one have all of these.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from itertools import permutations
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.errors import LONGEST_NAME, InputError, shown
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.pose_frames import POINTS, inverse_poses, points_of_frames, transforms_of_frames
from diffeo_calib.measurements.poses import is_euler, rotation_matrices
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import moving_joints_below, read_urdf

MOVED = 1e-3
"""Range of a joint, rad or m, below which it never moved."""
MOST_COLUMNS = 4
"""Most columns that are tried in the place of another one: every try is a registration."""

INVERTED = (
    "the poses seem to be those of the measuring frame, seen from the tool: if a camera on the tool sees a board, "
    "pass camera_on_tool=True (--camera-on-tool), else give the poses of the tool in the measuring frame"
)
NOT_INVERTED = (
    "the poses seem to be those of the camera in the board's frame already, or those of a board on the tool that a "
    "fixed camera sees: leave camera_on_tool (--camera-on-tool) out"
)
EULER = tuple(
    order
    for letters in ("xyz", "XYZ")
    for order in ("".join((a, b, c)) for a in letters for b in letters for c in letters)
    if is_euler(order)
)
"""The 24 orders of Euler angles."""


@dataclass(frozen=True)
class Reading:
    """Measurements as they might have been meant.

    Args:
        robot: the chain. q: (N, n) rad or m. points: (N, P, 3) m.
        words: what was changed.
        option: the option that reads the table so, where readings differ by one option alone; else empty.
        partial: whether it explains a part of the measurements only, and is used if nothing else explains them.
        on: tips of the markers; the robot's first tip by default.
    """

    robot: Tree
    q: Tensor
    points: Tensor
    words: str
    option: str = ""
    partial: bool = False
    on: tuple[str, ...] = ()


def other_rotations(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Measured poses whose rotations are read in other ways, or whose poses are inverted."""
    if data.frames is None or data.lever is None:
        return

    def reading(frames: Tensor, words: str, option: str = "") -> Reading:
        moving = frames if data.board is None else inverse_poses(frames)
        return Reading(robot, data.q, points_of_frames(moving, lever), words, option, on=on)

    written = data.frames if data.board is None else inverse_poses(data.frames)
    lever, on = data.lever, data.on or ()
    turns, places = written[..., :3, :3], written[..., :3, 3]
    yield reading(inverse_poses(written), INVERTED if data.board is None else NOT_INVERTED)
    words = "the rotations alone seem to be inverted (transposed): give those that belong to the positions"
    yield reading(transforms_of_frames(turns.mT, places), words)
    for rotations, words, option in _rewritten(data):
        yield reading(transforms_of_frames(rotations.to(places.device), places), words, option)
    if data.board is not None:
        return  # the place of the camera follows from its rotation
    words = "the positions alone fit: check the convention and the unit of the rotation columns"
    yield Reading(robot, data.q, places, words, partial=True, on=on[::POINTS])


def other_columns(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """One column of the joints or of the position replaced by one of similar name that was not read."""
    columns, table = _table(data)
    if columns is None:
        return
    spare = _spare(columns, table)
    for k, (joint, own) in enumerate(zip(robot.joint_names, columns.joints, strict=True)):
        for name in _similar([joint, own], spare):
            q = data.q.clone()
            q[:, k] = _joint_values(columns, spare[name], slides=not robot.periodic[k]).to(q.device)
            words = f"column '{shown(name)}' fits as {joint} in place of '{shown(own)}': check the joint columns"
            yield Reading(robot, q, data.points, words, on=data.on or ())
    for marker, triple in enumerate(columns.triples):
        for axis, own in enumerate(triple):
            for name in _similar([own], spare):
                points = _with_coordinate(data, marker, axis, spare[name] / columns.table.per_metre)
                words = f"column '{shown(name)}' fits in place of '{shown(own)}': check the position columns"
                yield Reading(robot, data.q, points, words, on=data.on or ())


def longer_chains(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """The same with joints below the given tip, for which the table has columns whose values vary."""
    columns, table = _table(data)
    if columns is None or robot.source is None or len(robot.tips) > 1:
        return
    spare, content = _spare(columns, table), robot.source.encode("utf-8", "surrogateescape")
    for joint, child in moving_joints_below(content, robot.tips):
        if joint not in spare:
            continue
        try:
            longer = read_urdf(content, robot.base, child, Path("URDF"))
        except InputError:
            continue  # a joint that cannot be part of a chain
        added = [name for name in longer.joint_names if name not in robot.joint_names]
        if longer.joint_names[: robot.n] != robot.joint_names or not all(name in spare for name in added):
            continue
        values = [
            _joint_values(columns, spare[name], slides=not longer.periodic[robot.n + k]) for k, name in enumerate(added)
        ]
        q = torch.cat([data.q, torch.stack(values, dim=1).to(data.q.device)], dim=1)
        if not bool((q[:, robot.n :].amax(0) - q[:, robot.n :].amin(0) > MOVED).all()):
            continue
        what = f"the table has a column for joint '{joint}', which is below the tip '{robot.tip}'"
        yield Reading(longer, q, data.points, f"{what}: choose '{child}' or a link below it as the tip")


def _rewritten(data: Measurements) -> Iterator[tuple[Tensor, str, str]]:
    """Rotations (N, T, 3, 3) read in other ways, with words, and the option that reads them so."""
    columns, table = _table(data)
    if columns is None or columns.table.convention is None or not all(name in table for name in columns.rotation):
        return
    convention, unit = columns.table.convention, columns.rotation_unit
    frames = len(columns.triples)
    numbers = torch.stack([table[name] for name in columns.rotation], dim=1).unflatten(1, (frames, -1))
    count = numbers.shape[2]
    flat = numbers.flatten(0, 1)
    families = {3: (*EULER, "rotvec"), 4: ("quat_xyzw", "quat_wxyz"), 9: ("matrix",)}
    for other in families[count]:
        if other != convention:
            yield rotation_matrices(flat, other, angle=unit).unflatten(0, (-1, frames)), "", f"convention='{other}'"
    if count == 3:
        other = "deg" if unit == "rad" else "rad"
        again = rotation_matrices(flat, convention, angle=other).unflatten(0, (-1, frames))
        yield again, "", f"rotation_angle='{other}'"
        for order in list(permutations(range(3)))[1:-1]:  # the last, reversed Euler angles, is a convention by itself
            names = ",".join(columns.rotation[k] for k in order)
            words = f"the rotation columns seem to be in the order {shown(names)}"
            again = rotation_matrices(flat[:, list(order)], convention, angle=unit).unflatten(0, (-1, frames))
            yield again, words, ""


def _table(data: Measurements) -> tuple[Columns | None, Mapping[str, Tensor]]:
    """How the measurements were read, and all numeric columns of their file; None if there is none any more."""
    if not isinstance(data.origin, TableOrigin):
        return None, {}
    table = data.origin.numeric_columns(data.line_numbers)
    return (data.origin.columns, table) if table else (None, {})


def _spare(columns: Columns, table: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The columns that were not read and that are not constant."""
    used = set(columns.names)
    return {name: values for name, values in table.items() if name not in used and float(values.std()) > 0}


def _similar(names: Sequence[str], spare: Mapping[str, Tensor]) -> list[str]:
    """The columns whose names are the most similar to some of these names."""
    short = [name for name in spare if len(name) <= LONGEST_NAME]
    closeness = {name: max(SequenceMatcher(None, own, name).ratio() for own in names) for name in short}
    return sorted(short, key=lambda name: -closeness[name])[:MOST_COLUMNS]


def _with_coordinate(data: Measurements, marker: int, axis: int, values: Tensor) -> Tensor:
    """The points (N, P, 3) with other values (N,) of one coordinate of a marker, or of a pose's origin, m."""
    points, values = data.points.clone(), values.to(data.points.device)
    if data.frames is not None and data.board is not None and data.lever is not None:
        written = inverse_poses(data.frames)
        written[:, 0, axis, 3] = values
        return points_of_frames(inverse_poses(written), data.lever)
    if data.frames is None:
        points[:, marker, axis] = values
    else:
        points[:, POINTS * marker : POINTS * (marker + 1), axis] += (values - data.frames[:, marker, axis, 3])[:, None]
    return points


def _joint_values(columns: Columns, values: Tensor, *, slides: bool) -> Tensor:
    """Values of a joint in the units of the file -> rad or m."""
    if slides:
        return values / columns.table.joints_per_metre
    return values.deg2rad() if columns.table.angle == "deg" else values
