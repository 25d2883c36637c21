"""From the options of a command to the table that they describe. Imports torch: only commands that run import this."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import typer

from diffeo_calib.cli.options import Angle, Length
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv_files import read_table
from diffeo_calib.measurements.poses import LEVER
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.chain import Chain


def table_format(length: Length, angle: Angle, sep: str, decimal: str) -> TableFormat:
    """The format of a table of points; ``sep`` may be a tab written as \\t or tab."""
    return TableFormat(length.value, angle.value, "\t" if sep in ("\\t", "tab") else sep, decimal)


def with_rotation(
    table: TableFormat, rotation: str | None, convention: str | None, angle: Angle | None, lever: float | None
) -> TableFormat:
    """The same format with a rotation; the lever is in the unit of length.

    Raises:
        InputError: a lever without a rotation.
    """
    if lever is not None and rotation is None:
        fix = "name the columns of the rotation too, or leave it out"
        raise InputError.of("--lever without --rotation", fix=fix)
    metres = LEVER if lever is None else lever / table.per_metre
    columns, unit = _names_if_given(rotation), None if angle is None else angle.value
    return replace(table, rotation=columns, convention=convention, rotation_angle=unit, lever=metres)


def with_deviations(table: TableFormat, std: str | None, rotation_std: str | None) -> TableFormat:
    """The same format with columns of standard deviations."""
    return replace(table, std=_names_if_given(std), rotation_std=_names_if_given(rotation_std))


@dataclass(frozen=True)
class MeasuredTable:
    """A table of measurements as the options describe it.

    Args:
        csv: the file.
        joints: names of the joint columns, separated by commas; None if they are named after the robot's joints.
        position: X,Y,Z of every marker.
        table: the format.
        duplicates: what to do with exactly repeated rows.
    """

    csv: Path
    joints: str | None
    position: list[str]
    table: TableFormat
    duplicates: str = "keep"

    def read(self, robot: Chain) -> Measurements:
        """Read the measurements of a robot, under the names of its own joints."""
        names, triples = joint_columns(self.joints, robot), _position_triples(self.position)
        data = read_table(self.csv, names, triples, self.table, duplicates=self.duplicates, kinds=robot.kinds)
        return data.with_joint_names(robot.joint_names)


def joint_columns(joints: str | None, robot: Chain) -> list[str]:
    """Names of the joint columns: those given, or the robot's."""
    return _split_names(joints) if joints else list(robot.joint_names)


def _position_triples(position: list[str]) -> list[list[str]]:
    triples = [_split_names(text) for text in position]
    for triple in triples:
        if len(triple) != 3:
            raise typer.BadParameter(f"expected three columns X,Y,Z, got {','.join(triple)}", param_hint="--position")
    return triples


def _split_names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _names_if_given(text: str | None) -> list[str] | None:
    return None if text is None else _split_names(text)
