"""From the options of a command to the table that they describe. Imports torch: only commands that run import this."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import torch
import typer
from torch import Tensor

from diffeo_calib.cli.options.shared import Angle, Length
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.files import open_measurements, read_joints, read_observations, read_table
from diffeo_calib.measurements.csv.sensors import SocketColumns, TableColumns
from diffeo_calib.measurements.csv.tables import TableFile
from diffeo_calib.measurements.pose_frames import by_frame
from diffeo_calib.measurements.poses import LEVER, numbers_of, rotation_matrices
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.tree import Tree


def table_format(
    length: Length, angle: Angle, sep: str, decimal: str, joint_length: Length | None = None
) -> TableFormat:
    """The format of a table of points; ``sep`` may be a tab written as \\t or tab."""
    slides = None if joint_length is None else joint_length.value
    mark = "\t" if sep in ("\\t", "tab") else sep
    return TableFormat(length.value, angle.value, mark, decimal, joint_length=slides)


def with_rotation(
    table: TableFormat,
    rotation: list[str] | None,
    convention: str | None,
    angle: Angle | None,
    lever: float | None,
    *,
    camera_on_tool: bool = False,
) -> TableFormat:
    """The same format with a rotation, or one for each of several frames; the lever is in the unit of length.

    Raises:
        InputError: a lever or a camera on the tool without a rotation.
    """
    if lever is not None and rotation is None:
        fix = "name the columns of the rotation too, or leave it out"
        raise InputError.of("--lever without --rotation", fix=fix)
    if camera_on_tool and rotation is None:
        raise InputError.of("--camera-on-tool without --rotation", fix="name the columns of the board's rotation too")
    metres = LEVER if lever is None else lever / table.per_metre
    columns, unit = _names_of_each(rotation), None if angle is None else angle.value
    turned = replace(table, rotation=columns, convention=convention, rotation_angle=unit, lever=metres)
    return replace(turned, camera_on_tool=camera_on_tool)


def with_columns(
    table: TableFormat, std: str | None, rotation_std: list[str] | None, payload: str | None = None
) -> TableFormat:
    """The same format with columns of standard deviations, and of payloads."""
    return replace(table, std=_names_if_given(std), rotation_std=_names_of_each(rotation_std), payload=payload)


@dataclass(frozen=True)
class MeasuredTable:
    """A table of measurements as the options describe it.

    Args:
        csv: the file.
        joints: names of the joint columns, separated by commas; None if they are named after the robot's joints.
        position: X,Y,Z of every marker.
        table: the format.
        duplicates: what to do with exactly repeated rows.
        session: column that names the set-up of every row; None if there was one.
        sockets: columns that name the sockets of a ball, beside positions if these are named; None without.
        readings: columns of each kind of reading, beside positions and sockets if these are named.
    """

    csv: Path
    joints: str | None
    position: list[str]
    table: TableFormat
    duplicates: str = "keep"
    session: str | None = None
    sockets: SocketColumns | None = None
    readings: tuple[Any, ...] = ()

    def read(self, robot: Tree, tips: Sequence[str] = ()) -> Any:
        """Read the rows of a robot, under the names of its own joints.

        Args:
            robot: n joints. tips: that of every marker, for a robot with several.

        Returns:
            what :func:`read_observations` returns: measurements, readings, or observations of several kinds.

        Raises:
            InputError: not one tip for every marker.
        """
        triples = _position_triples(self.position) or None
        several = len(tips) > 1 and self.sockets is None and not self.readings
        if several and triples is not None and len(tips) != len(triples):
            expected, fix = f"{len(triples)}, one for each --position", "repeat a tip that carries several markers"
            raise InputError.of("--tip", expected=expected, got=len(tips), fix=fix)
        kinds, names = robot.kinds, joint_columns(self.joints, robot)
        session = self.session if triples or not self.readings else None  # of readings it names their devices
        columns = TableColumns(names, triples, self.sockets, self.readings, session, kinds)
        data = read_observations(self.csv, columns, self.table, duplicates=self.duplicates)
        data = data.with_joint_names(robot.joint_names)
        return data.with_tips(tips) if several else data

    def open(self, robot: Tree) -> TableFile:
        """The same table, to be read in blocks; its joints have the names of their columns."""
        names, triples = joint_columns(self.joints, robot), _position_triples(self.position)
        return open_measurements(self.csv, names, triples, self.table, kinds=robot.kinds)


@dataclass(frozen=True)
class ProgramTable:
    """A robot's program as the options describe it.

    Args:
        csv: the file.
        joints: names of the joint columns, separated by commas; None if they are named after the robot's joints.
        position: X,Y,Z of the targets of every tool; none if the commands' nominal poses are the targets.
        rotation: columns of the targets' orientations.
        table: units, separator and decimal mark.
        convention: how rotations are written. rotation_angle: unit of their angles.
    """

    csv: Path
    joints: str | None
    position: list[str]
    rotation: list[str]
    table: TableFormat
    convention: str | None
    rotation_angle: Angle | None

    def commands(self, robot: Tree) -> Tensor:
        """(N, n) joint values, rad or m."""
        return read_joints(self.csv, joint_columns(self.joints, robot), self.table, kinds=robot.kinds)

    def targets(self, robot: Tree, tools: int) -> Tensor | None:
        """(N, T, 4, 4) poses or (N, T, 3) positions of T tools, m; None if the table has none.

        Raises:
            InputError: a rotation without a position, or not one position for every tool.
        """
        if not self.position:
            if self.rotation:
                raise InputError.of("--rotation without --position", fix="name the columns of the position too")
            return None
        if len(self.position) != tools:
            fix = "name the columns of the targets once for every --tip"
            raise InputError.of("--position", expected=f"{tools} of them", got=len(self.position), fix=fix)
        table = self.table
        if self.rotation:
            table = with_rotation(table, self.rotation, self.convention, self.rotation_angle, None)
        names, triples = joint_columns(self.joints, robot), _position_triples(self.position)
        data = read_table(self.csv, names, triples, table, duplicates="keep", kinds=robot.kinds)
        return data.points if data.poses is None else by_frame(data.poses)

    def written(self) -> TableFormat:
        """The format of the poses that are written: the same convention, a rotation vector without one."""
        unit = None if self.rotation_angle is None else self.rotation_angle.value
        plain = replace(self.table, convention=self.convention, rotation_angle=unit)
        return plain.for_writing(rotation_std=False)


def tool_frame(text: str, table: TableFormat) -> Tensor:
    """A tool centre point X,Y,Z, or X,Y,Z and a rotation in the convention of a table: (4, 4) m.

    Raises:
        InputError: another number of numbers.
    """
    convention = table.convention or "rotvec"
    count = 3 + numbers_of(convention)
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (3, count) or not all(isfinite(value) for value in values):
        expected = f"X,Y,Z, or {count} numbers with the rotation as {convention!r}, separated by commas"
        raise InputError.of(f"--tool {text}", expected=expected, fix="write decimal points in numbers")
    frame = torch.eye(4, dtype=torch.float64, device=HOST)
    frame[:3, 3] = torch.tensor(values[:3], dtype=torch.float64, device=HOST) / table.per_metre
    if len(values) == count:
        angle = table.rotation_angle or table.angle
        frame[:3, :3] = rotation_matrices([values[3:]], convention, angle=angle, place="--tool".format)[0]
    return frame


def joint_columns(joints: str | None, robot: Tree) -> list[str]:
    """Names of the joint columns: those given, or the robot's.

    Raises:
        InputError: another number of names than joints, or the robot's own names in another order.
    """
    if not joints:
        return list(robot.joint_names)
    names = _split_names(joints)
    if names != list(robot.joint_names) and sorted(names) == sorted(robot.joint_names):
        what = "--joints names the robot's joints in another order than the robot's"
        fix = "leave it out: columns that are named after the joints are found wherever they are"
        expected, got = ",".join(robot.joint_names), ",".join(names)
        raise InputError.of(what, expected=expected, got=got, fix=fix)
    if len(names) != robot.n:
        order = ", ".join(robot.joint_names)
        raise InputError.of(f"--joints {joints}", expected=f"{robot.n} columns, in the order {order}", got=len(names))
    return names


def _position_triples(position: list[str]) -> list[list[str]]:
    triples = [_split_names(text) for text in position]
    for triple in triples:
        if len(triple) != 3:
            raise typer.BadParameter(f"expected three columns X,Y,Z, got {','.join(triple)}", param_hint="--position")
    return triples


def _split_names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _names_of_each(texts: list[str] | None) -> list[str] | list[list[str]] | None:
    """Names for the only frame, or a list for each of several."""
    names = [_split_names(text) for text in texts or ()]
    return (names[0] if len(names) == 1 else names) or None


def _names_if_given(text: str | None) -> list[str] | None:
    return None if text is None else _split_names(text)
