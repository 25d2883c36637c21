"""Slow drift of device and arm in proportion to a column, such as time or temperature.

Between the smallest and the largest value of the column the measuring frame shifts and turns, lengths grow, and every
joint offset changes, by unknowns u with a wide prior that all rows share: row i differs from the model by a_i B_i u
with a_i from -1/2 to 1/2, so that the model holds for the middle of the column. The unknowns stay in the fit where they
predict rows that are left out better, see :func:`worth_it`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.placing.placement import DeviceSet, OtherRows, SeenRows, Settled
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.robots.se3 import frame_slopes
from diffeo_calib.sensors.known_drift import KnownDrift
from diffeo_calib.sensors.places import PlacedDevices

FRAME_M_RAD, GROWTH, OFFSET_RAD_M = 1e-3, 3e-4, 1e-3
"""Prior standard deviations over the whole range: of the frame's shift and turn, of lengths, and of joint offsets."""
WORTHWHILE_ERROR_RATIO = 0.97
"""Part of the RMS leave-one-out error that may remain at most with the drift in the model."""
SURE = 3.0
"""Standard deviations from which a gain in squared errors is no chance."""


@dataclass(frozen=True, eq=False)
class Drift(DeviceSet):
    """Drift of N rows with K columns.

    Args:
        names: of the columns. joints: names and whether each turns, n of them.
        lowest, highest: (K,) range of every column in the rows of the fit. values: (N, K).
        q: (N, n) configurations.
        centre: (3,) about which the frame turns and lengths grow, m.
        size_by_column, deviations: (K, 7 + n) the unknowns and their standard deviations: shift, turn, growth, offsets.
    """

    names: tuple[str, ...]
    joints: tuple[tuple[str, bool], ...]
    lowest: Tensor
    highest: Tensor
    values: Tensor
    q: Tensor
    centre: Tensor | None = None
    size_by_column: Tensor | None = None
    deviations: Tensor | None = None

    @classmethod
    def of_table(cls, data: Any, chain: Any) -> list[DeviceSet]:
        """That of all columns of a table which are not constant; none without any."""
        if data.covariates is None:
            return []
        lowest, highest = data.covariates.amin(0), data.covariates.amax(0)
        if not bool((highest > lowest).all()):
            return []
        joints = tuple(zip(chain.joint_names, chain.periodic, strict=True))
        return [cls(data.covariate_names, joints, lowest, highest, data.covariates, data.q)]

    @property
    def size(self) -> int:
        """Shift, turn, growth and joint offsets for each column."""
        return len(self.names) * (7 + len(self.joints))

    def ramp(self, values: Tensor) -> Tensor:
        """From -1/2 to 1/2 over the range of each column: (N, K)."""
        return (values - self.lowest) / (self.highest - self.lowest) - 0.5

    def effects(self, data: SeenRows) -> Tensor:
        """See :class:`DeviceSet`."""
        places = data.points.unflatten(1, (-1, 3))
        centre = places.mean((0, 1)) if self.centre is None else self.centre
        frame, away = FRAME_M_RAD * frame_slopes(places, centre), (places - centre).flatten(1)[..., None]
        offsets = OFFSET_RAD_M * data.nominal.jacobian(self.q, data.y.new_zeros(data.nominal.parameters))
        whole = torch.cat([frame, GROWTH * away, offsets], 2)
        whole = whole if data.slopes is None else data.slopes @ whole
        return (whole[:, :, None] * self.ramp(self.values)[:, None, :, None]).flatten(2)

    def settled(self, found: Settled) -> Drift:
        """See :class:`DeviceSet`."""
        own = found.shifts.new_tensor([FRAME_M_RAD] * 6 + [GROWTH] + [OFFSET_RAD_M] * len(self.joints))
        shifts, deviations = (
            own * each.view(len(self.names), -1) for each in (found.shifts, found.covariance.diagonal().sqrt())
        )
        return replace(self, centre=found.centre, size_by_column=shifts, deviations=deviations)

    def with_rows(self, other: OtherRows) -> Drift:
        """See :class:`DeviceSet`: rows that do not tell the columns are those of the middle."""
        q, values = other.data.q, other.data.covariates
        middle = (0.5 * (self.lowest + self.highest)).expand(len(q), -1)
        values = values if other.data.covariate_names == self.names else middle
        return replace(self, values=values, q=q, centre=other.centre)

    @property
    def known(self) -> KnownDrift | None:
        """Drift that a fit found; None before."""
        if self.size_by_column is None or self.deviations is None or self.centre is None:
            return None
        ends = self.lowest, self.highest
        return KnownDrift(self.names, self.joints, *ends, self.centre, self.size_by_column, self.deviations)

    def placed(self) -> PlacedDevices | None:
        """The drift, for rows that tell the columns."""
        return None if self.known is None else self.known.placed()

    def sentences(self) -> list[str]:
        """How much drifted with each column, of what is known well."""
        return [] if self.known is None else list(self.known.sentences())

    def entry(self) -> dict[str, object]:
        """See :class:`DeviceSet`: unknowns in m and rad over the range of every column."""
        known = [] if self.size_by_column is None else self.size_by_column.tolist()
        return {"drift": dict(zip(self.names, known, strict=False))}


def worth_it(before: LeaveOneOut, after: LeaveOneOut) -> bool:
    """Whether rows that are left out prove a drift: most of them, and not a few large errors."""
    first, second = (one.errors.square().nansum(1) for one in (before, after))
    gain = first - second
    sure = float(gain.mean()) > SURE * float(gain.std()) / len(gain) ** 0.5
    return sure and float(second.mean()) < WORTHWHILE_ERROR_RATIO**2 * float(first.mean())
