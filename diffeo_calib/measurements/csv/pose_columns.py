"""Columns of a machine's commanded pose, as its controller writes it, in place of joint values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, MeasurementError, as_written
from diffeo_calib.measurements.checks import of_measurements
from diffeo_calib.measurements.csv.cells import repeated
from diffeo_calib.measurements.poses import (
    ALL_CONVENTIONS,
    ANGLE_UNITS,
    CONVENTIONS,
    numbers_of,
    rotation_matrices,
    rotation_numbers,
)
from diffeo_calib.robots.cartesian import cartesian, pose_inputs
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.tree import Chain


@dataclass(frozen=True, eq=False)
class PoseColumns:
    """The columns of places, or of poses, and the joints of a machine that they tell; see :class:`JointExpressions`.

    Args:
        columns: x, y, z, and the numbers of a rotation; or one to three coordinates of a place.
        convention: how the rotation is written; empty for places.
        robot: the machine, see :func:`cartesian`; None before the poses are read.
        angle: unit of Euler angles and rotation vectors.
    """

    columns: tuple[str, ...]
    convention: str = ""
    robot: Chain | None = None
    angle: str = "rad"

    @classmethod
    def of(cls, text: str) -> PoseColumns:
        """Parse ``X,Y,Z``, or ``X,Y,Z,A,B,C=CONVENTION``.

        Raises:
            MeasurementError: another number of columns than the convention says, or a column twice.
        """
        names, equal, convention = text.rpartition("=") if "=" in text else (text, "", "")
        columns = tuple(name.strip() for name in names.split(","))
        if len(columns) > 3 and not equal:
            what = f"the columns of a pose, {text}"
            raise MeasurementError.of(what, expected=f"=CONVENTION behind them: {CONVENTIONS}", got="none")
        with of_measurements():
            count = 3 + numbers_of(convention.strip()) if equal else len(columns)
        if len(columns) != count or "" in columns or repeated(columns):
            expected = f"{count} names of columns" if equal else "names of columns"
            raise MeasurementError.of(f"the columns of a pose, {text}", expected=expected, got=as_written(columns))
        return cls(columns, convention.strip())

    @property
    def text(self) -> str:
        """What :meth:`of` parses."""
        return ",".join(self.columns) + f"={self.convention}" * bool(self.convention)

    @property
    def texts(self) -> tuple[str, ...]:
        """Names of the joints; of the columns without a machine."""
        return self.columns if self.robot is None else self.robot.joint_names

    @property
    def plain(self) -> Tensor:
        """(n,) boolean, which joints are columns as they are."""
        return torch.tensor([not self.convention] * len(self.texts), dtype=torch.bool, device=HOST)

    def poses(self, cells: Tensor) -> Tensor:
        """Cells (N, c) -> poses (N, 4, 4), or places (N, c), in the unit of the table."""
        if not self.convention:
            return cells
        with of_measurements():
            turns = rotation_matrices(
                cells[:, 3:], self.convention, angle=self.angle, place="row {} of the commanded poses".format
            )
        return transforms(turns, cells[:, :3])

    def reread(self, table: Mapping[str, Tensor], per_metre: float) -> Iterator[tuple[Chain, Tensor, str]]:
        """Machine and joint values (N, n) of these columns in every other convention and unit, and its options.

        Args:
            table: the columns of a file. per_metre: units of length in the file.
        """
        if not self.convention:
            return
        cells = torch.stack([table[name] for name in self.columns], 1)
        cells[:, :3] /= per_metre
        alike = [name for name in ALL_CONVENTIONS if numbers_of(name) == numbers_of(self.convention)]
        for convention, angle in product(alike, ANGLE_UNITS):
            other = replace(self, convention=convention, angle=angle)
            if (convention, angle) != (self.convention, self.angle):
                with suppress(DiffeoCalibError):  # numbers that are no rotation in this convention
                    poses = other.poses(cells)
                    machine = cartesian(poses)
                    yield machine, pose_inputs(machine, poses), f"--robot-pose {other.text} --angle {angle}"

    def values(self, cells: Tensor) -> Tensor:
        """Cells (N, c) -> joint values (N, n), in the units of the table; without a machine the cells themselves."""
        if self.robot is None:
            return cells
        with of_measurements():
            q = pose_inputs(self.robot, self.poses(cells))
        return torch.cat([q[:, :3], q[:, 3:].rad2deg() if self.angle == "deg" else q[:, 3:]], 1)

    def cells(self, values: Tensor) -> Tensor:
        """The inverse of :meth:`values`; NaN stays NaN."""
        if self.robot is None or not self.convention:
            return values
        q = torch.cat([values[:, :3], values[:, 3:].deg2rad() if self.angle == "deg" else values[:, 3:]], 1)
        found, known = q.new_full((len(q), len(self.columns)), torch.nan), q.isfinite().all(1)
        poses = self.robot(q[known])
        turns = rotation_numbers(poses[:, :3, :3], self.convention, angle=self.angle)
        found[known] = torch.cat([poses[:, :3, 3], turns], 1)
        return found
