"""Rows of one kind: what tables of positions, poses, sockets and readings have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, usable
from diffeo_calib.common.inference_mode import methods_outside_inference_mode
from diffeo_calib.measurements.frozen import with_attributes
from diffeo_calib.measurements.splits import RowGroups
from diffeo_calib.measurements.table_checks import chosen_rows, copied, payloads, unique_names

if TYPE_CHECKING:
    from typing_extensions import Self

ON_HOST = ("line_numbers", "session", "socket", "device")
"""Columns of numbers that stay on the host."""


@methods_outside_inference_mode
class RowTable(RowGroups):
    """N rows with one value per column and row; its columns are the attributes ``BY_ROW`` that are not None."""

    BY_ROW: ClassVar[tuple[str, ...]] = ()
    """Attributes with a value for each row, all of them tensors (N, ...)."""

    ALIKE: ClassVar[tuple[str, ...]] = ()
    """Other attributes in which tables agree that are joined."""

    q: Tensor
    joint_names: tuple[str, ...] | None
    payload: Tensor | None
    payload_at: str | None
    line_numbers: Tensor
    file_sha256: str | None
    origin: object | None

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def parts(self) -> tuple[Self, ...]:
        """This table alone, so that it can be treated like :class:`Observations`."""
        return (self,)

    @property
    def index(self) -> tuple[Tensor]:
        """(N,) int64 row numbers of this one part."""
        return (torch.arange(len(self), device=HOST),)

    @property
    def lines(self) -> Tensor:
        """(N,) lines of the rows in their file, or their numbers."""
        return self.line_numbers

    @property
    def columns(self) -> dict[str, Tensor]:
        """The columns that this table has, by name."""
        found = {name: getattr(self, name) for name in self.BY_ROW}
        return {name: values for name, values in found.items() if values is not None}

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, index: object) -> Self:
        return self.rows(index)

    def __iter__(self) -> Iterator[Self]:
        return (self.rows(i) for i in range(len(self)))

    def rows(self, index: object) -> Self:
        """Return the rows chosen by an integer, slice, list of integers or boolean mask, in that order.

        Raises:
            IndexError: an index out of range, or a mask of the wrong length.
            MeasurementError: the selection is empty, or nothing that chooses rows.
        """
        chosen = chosen_rows(index, len(self))
        return with_attributes(self, **{name: t[chosen.to(t.device)] for name, t in self.columns.items()})

    def to(self, device: torch.device | str) -> Self:
        """Return the same rows with their values on a device."""
        place = usable(device)
        return with_attributes(self, **{name: t.to(place) for name, t in self.columns.items() if name not in ON_HOST})

    def with_joint_names(self, names: Sequence[str]) -> Self:
        """Return the same rows under other names of the joints.

        Raises:
            MeasurementError: a number of names that does not match, or repeated names.
        """
        return with_attributes(self, joint_names=unique_names(names, "names", self.n, "column of `q`"))

    def with_payload(self, payload: object, at: str | None = None) -> Self:
        """Return the same rows with a payload of known mass, whose sag a calibration then finds.

        Args:
            payload: masses (N,), or one for all rows, in any unit: 0 without load. None if they are not known.
            at: name of the link that carries it at its origin, a tip or a `load` of the robot; its only tip by default.

        Raises:
            MeasurementError: not one per row, negative, or not finite.
        """
        return with_attributes(self, payload=None if payload is None else payloads(payload, self.q), payload_at=at)

    def with_line_numbers(self, line_numbers: Sequence[int] | Tensor) -> Self:
        """Return the same rows with other line numbers (N,), which tell where every row comes from.

        Raises:
            MeasurementError: not one per row.
        """
        lines = copied(line_numbers, "line_numbers", (len(self),), fix="pass one per row")
        return with_attributes(self, line_numbers=lines.to(HOST, torch.int64))

    def with_file_sha256(self, sha256: str | None) -> Self:
        """Return the same rows as those of the file with this SHA-256."""
        return with_attributes(self, file_sha256=sha256)

    def with_origin(self, origin: object) -> Self:
        """Return the same rows as those of a table that can be read again."""
        return with_attributes(self, origin=origin)
