"""Rows of devices that measure no position of the tool's ball: distances, heights above planes, points in images.

A ball bar, wire or interferometer reports the distance from the ball to its fixed end. A dial gauge reports a height
along its axis; a surface that the ball touches is a plane at the height 0. A calibrated camera reports where it sees
the ball, or any other mark on the tool, in its image. Where the devices stand is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Literal

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written
from diffeo_calib.measurements.splits import REPEAT_TOLERANCE, exact_copies, in_train, repeat_groups
from diffeo_calib.measurements.table_checks import arrays_sha256, chosen_rows, copied, joint_table, session_numbers

ReadingKind = Literal["distance", "height", "image"]
ONE_DEVICE = "device"
"""Name of the device of all rows, where none is given."""


@dataclass(frozen=True, eq=False)
class Readings:
    """N joint configurations and what a device reported in each of one ball, or another mark, on the tool.

    Made by :meth:`distances`, :meth:`heights` and :meth:`images`.

    Args:
        kind: "distance", "height" or "image", of all rows.
        q: (N, n) joint values, rad or m. values: (N, r) readings: r = 1, m; of images r = 2, tangents of angles.
        device: (N,) int64, number of the device of each row. names: of the devices.
        offset_std: standard deviation of the unknown zero of a distance, m; 0 if lengths are absolute.
        focal: pixels of an image per unit tangent; 1 of other kinds.
        joint_names: n names in the order of the columns of ``q``, or None.
        line_numbers: (N,) int64, lines of the rows in their file; by default their numbers.
        file_sha256: SHA-256 of that file.
    """

    kind: ReadingKind
    q: Tensor
    values: Tensor
    device: Tensor
    names: tuple[str, ...]
    offset_std: float = 0.0
    focal: float = 1.0
    joint_names: tuple[str, ...] | None = None
    line_numbers: Tensor | None = None
    file_sha256: str | None = None

    @classmethod
    def distances(
        cls,
        q: object,
        lengths: object,
        devices: Sequence[str] | None = None,
        joint_names: Sequence[str] | None = None,
        *,
        offset_std: float = 0.0,
    ) -> Readings:
        """Distances from the ball to fixed points that are not known.

        Args:
            q: (N, n) joint values, rad or m. lengths: (N,) distances, m, or one for all rows of a ball bar.
            devices: (N,) name of each row's fixed point; one for all rows by default.
            joint_names: n names, in the order of the columns of ``q``.
            offset_std: standard deviation in m of a length that all readings of a device lack, as those of an
                interferometer or a wire with an unknown zero; 0 if they are absolute.

        Raises:
            MeasurementError: wrong shapes, values that are not finite, a length that is not positive.
        """
        if isinstance(offset_std, bool) or not isinstance(offset_std, (int, float)) or not 0.0 <= offset_std < inf:
            fix = "pass metres, or 0 for absolute lengths"
            raise MeasurementError.of("`offset_std`", expected="0 or more", got=as_written(offset_std), fix=fix)
        found = cls._of("distance", q, lengths, devices, joint_names)
        low = int(found.values.argmin())
        if not offset_std and float(found.values[low]) <= 0.0:
            got, fix = f"{float(found.values[low]):g} m in row {low}", "check the column, or pass `offset_std`"
            raise MeasurementError.of("`lengths`", expected="above 0", got=got, fix=fix)
        return replace(found, offset_std=float(offset_std))

    @classmethod
    def heights(
        cls,
        q: object,
        heights: object = 0.0,
        devices: Sequence[str] | None = None,
        joint_names: Sequence[str] | None = None,
    ) -> Readings:
        """Heights of the ball above planes that are not known.

        Args:
            q: (N, n) joint values, rad or m. heights: (N,) m, such as those of a dial gauge; 0 where the ball touched,
                and the height of a gauge block where it touched this on the same plane.
            devices: (N,) name of each row's plane; one for all rows by default.
            joint_names: n names, in the order of the columns of ``q``.

        Raises:
            MeasurementError: wrong shapes, or values that are not finite.
        """
        return cls._of("height", q, heights, devices, joint_names)

    @classmethod
    def images(
        cls,
        q: object,
        pixels: object,
        devices: Sequence[str] | None = None,
        joint_names: Sequence[str] | None = None,
        *,
        focal: tuple[float, float],
        centre: tuple[float, float],
    ) -> Readings:
        """Places of the ball in the images of fixed cameras, whose poses are not known.

        Args:
            q: (N, n) joint values, rad or m. pixels: (N, 2) column and row in the image, lens distortion removed.
            devices: (N,) name of each row's camera; one for all rows by default.
            joint_names: n names, in the order of the columns of ``q``.
            focal: focal lengths fx, fy in pixels. centre: principal point cx, cy in pixels. For tangents of angles
                in place of pixels pass (1, 1) and (0, 0).

        Raises:
            MeasurementError: wrong shapes, values that are not finite, focal lengths that are not positive.
        """
        f = copied(focal, "focal", (2,), fix="pass (fx, fy) in pixels")
        c = copied(centre, "centre", (2,), fix="pass (cx, cy) in pixels")
        if not bool((f > 0).all()):
            raise MeasurementError.of("`focal`", expected="two positive numbers", got=as_written(f.tolist()))
        seen = cls._of("image", q, pixels, devices, joint_names)
        return replace(seen, values=(seen.values - c) / f, focal=float(f.mean()))

    @classmethod
    def _of(
        cls,
        kind: ReadingKind,
        q: object,
        values: object,
        devices: Sequence[str] | None,
        joint_names: Sequence[str] | None,
    ) -> Readings:
        angles, joints = joint_table(q, joint_names)
        N = len(angles)
        if kind == "image":
            read = copied(values, "pixels", (N, 2), fix="pass column and row of each row")
        else:
            given = [float(values)] * N if isinstance(values, (int, float)) and not isinstance(values, bool) else values
            name = "lengths" if kind == "distance" else "heights"
            read = copied(given, name, (N,), (N, 1), fix="pass one per row, in m").reshape(N, 1)
        numbers, names = session_numbers([ONE_DEVICE] * N if devices is None else devices, N)
        if numbers is None:
            raise MeasurementError.of("`devices`", expected=f"{N} names, one per row", got="none")
        return cls(kind, angles, read, numbers.to(HOST), names, joint_names=joints)

    @property
    def unit(self) -> tuple[str, float]:
        """Name of the unit in which readings are shown, and how many of it are one of ``values``."""
        return ("px", self.focal) if self.kind == "image" else ("mm", 1e3)

    @property
    def sha256(self) -> str:
        """SHA-256 of the file that the rows were read from, or of the arrays if they come from Python."""
        names = {"kind": self.kind.encode(), "names": repr((self.names, self.offset_std)).encode()}
        return self.file_sha256 or arrays_sha256({"q": self.q, "values": self.values, "device": self.device}, names)

    @property
    def lines(self) -> Tensor:
        """(N,) lines of the rows in their file, or their numbers."""
        return torch.arange(len(self), device=HOST) if self.line_numbers is None else self.line_numbers

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        return f"Readings({len(self)} {self.kind}s of {len(self.names)} devices)"

    def rows(self, index: object) -> Readings:
        """The rows chosen by an integer, slice, list of integers or boolean mask, in that order, and their devices."""
        chosen = chosen_rows(index, len(self))
        used, numbers = self.device[chosen.to(HOST)].unique(return_inverse=True)
        q, values = self.q[chosen.to(self.q.device)], self.values[chosen.to(self.q.device)]
        names = tuple(self.names[number] for number in used.tolist())
        lines = self.lines[chosen.to(HOST)]
        return replace(self, q=q, values=values, device=numbers, names=names, line_numbers=lines)

    def groups(self) -> Tensor:
        """(N,) a number for each configuration, the same for its repeats; see :meth:`Measurements.groups`."""
        return repeat_groups(self.q, REPEAT_TOLERANCE)

    def copies(self) -> list[tuple[int, int]]:
        """(earlier row, row) for every row that repeats an earlier one exactly, its device included."""
        return exact_copies(torch.cat([self.q, self.values, self.device[:, None].to(self.q)], 1))

    def split(self, fraction: float = 0.7, seed: int = 0) -> tuple[Readings, Readings]:
        """Split at random into (train, test), repeated configurations together; see :meth:`Measurements.split`.

        Raises:
            MeasurementError: fraction outside (0, 1), or a single configuration.
        """
        train = in_train(self.groups(), fraction, seed)
        return self.rows(train), self.rows(~train)
