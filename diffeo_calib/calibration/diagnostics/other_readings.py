"""Other readings of a table that does not fit: its rotations in another convention, other columns, a longer chain.

The numbers are read again from the file, so that only measurements that were read from one have all of these.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.errors import LONGEST_NAME, InputError, shown
from diffeo_calib.measurements.csv import rotations
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import moving_joints_below, read_urdf

MOVED = 1e-3
"""Range of a joint, rad or m, below which it never moved."""
MOST_COLUMNS = 4
"""Most columns that are tried in the place of another one: every try is a registration."""


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
    for one in rotations.other_rotations(data):
        yield Reading(robot, data.q, *one[:3], one.partial, one.on)


def other_columns(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """One column of the joints or of the position replaced by one of similar name that was not read."""
    columns, table = rotations.numeric_table(data)
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
                points = rotations.with_coordinate(data, marker, axis, spare[name] / columns.table.per_metre)
                words = f"column '{shown(name)}' fits in place of '{shown(own)}': check the position columns"
                yield Reading(robot, data.q, points, words, on=data.on or ())


def longer_chains(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """The same with joints below the given tip, for which the table has columns whose values vary."""
    columns, table = rotations.numeric_table(data)
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


def _spare(columns: Columns, table: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The columns that were not read and that are not constant."""
    used = set(columns.names)
    return {name: values for name, values in table.items() if name not in used and float(values.std()) > 0}


def _similar(names: Sequence[str], spare: Mapping[str, Tensor]) -> list[str]:
    """The columns whose names are the most similar to some of these names."""
    short = [name for name in spare if len(name) <= LONGEST_NAME]
    closeness = {name: max(SequenceMatcher(None, own, name).ratio() for own in names) for name in short}
    return sorted(short, key=lambda name: -closeness[name])[:MOST_COLUMNS]


def _joint_values(columns: Columns, values: Tensor, *, slides: bool) -> Tensor:
    """Values of a joint in the units of the file -> rad or m."""
    if slides:
        return values / columns.table.joints_per_metre
    return values.deg2rad() if columns.table.angle == "deg" else values
