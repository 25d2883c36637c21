"""Slow drift of device and arm in proportion to a column, such as time or temperature.

Between the smallest and the largest value of the column the measuring frame shifts and turns, lengths grow, and every
joint offset changes, by unknowns u with a wide prior that all rows share: row i differs from the model by a_i B_i u
with a_i from -1/2 to 1/2, so that the model holds for the middle of the column. The unknowns stay in the fit where they
predict rows that are left out better, see diagnostics/hypotheses.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.placing.placement import DeviceSet, OtherRows, Seen, Settled
from diffeo_calib.common.device import HOST
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.known_drift import OFFSETS, KnownDrift
from diffeo_calib.sensors.set_ups import frame_slopes

FRAME_M_RAD, GROWTH, OFFSET_RAD_M = 1e-3, 3e-4, 1e-3
"""Prior standard deviations over the whole range: of the frame's shift and turn, of lengths, and of joint offsets."""


@dataclass(frozen=True, eq=False)
class Drift(DeviceSet):
    """Drift of N rows with K columns."""

    devices: KnownDrift  # what was found, or zero before a fit
    ramp: Tensor  # (N, K) from -1/2 to 1/2
    q: Tensor  # (N, n) configurations
    # (3,) about which the frame turns and lengths grow, m; by default the middle of the rows
    centre: Tensor | None = None

    @classmethod
    def of_table(cls, data: Measurements | Readings | Observations, chain: Tree) -> list[DeviceSet]:
        """That of all columns of a table which are not constant; none without any."""
        values = data.covariates
        if values is None or not bool((values.amax(0) > values.amin(0)).all()):
            return []
        joints = tuple(zip(chain.joint_names, chain.periodic, strict=True))
        nothing = values.new_zeros(values.shape[1], OFFSETS + len(joints))
        ends = values.amin(0), values.amax(0), *values.new_zeros(3, len(nothing))
        known = KnownDrift(data.covariate_names, torch.cat([torch.stack(ends, 1), nothing], 1), nothing, joints)
        none = torch.zeros(0, dtype=torch.int64, device=HOST)
        return [cls(known, none, none, known.ramp(data), data.q)]

    @property
    def size(self) -> int:
        """Shift, turn, growth and joint offsets for each column."""
        return self.devices.sizes.numel()

    def effects(self, data: Seen) -> Tensor:
        places = data.points.unflatten(1, (-1, 3))
        centre = places.mean((0, 1)) if self.centre is None else self.centre
        frame, away = FRAME_M_RAD * frame_slopes(places, centre), (places - centre).flatten(1)[..., None]
        offsets = OFFSET_RAD_M * data.nominal.jacobian(self.q, data.y.new_zeros(data.nominal.parameters))
        whole = data.slopes @ torch.cat([frame, GROWTH * away, offsets], 2)
        return (whole[:, :, None] * self.ramp[:, None, :, None]).flatten(2)

    def settled(self, found: Settled) -> Drift:
        own = found.shifts.new_tensor([FRAME_M_RAD] * 6 + [GROWTH] + [OFFSET_RAD_M] * len(self.devices.joints))
        shifts, deviations = (
            own * each.view(len(self.names), -1) for each in (found.shifts, found.covariance.diagonal().sqrt())
        )
        constants = torch.cat([self.devices.constants[:, :2], found.centre.expand(len(shifts), 3), shifts], 1)
        known = replace(self.devices, constants=constants, deviations=deviations)
        return replace(self, devices=known, centre=found.centre)

    def with_rows(self, other: OtherRows) -> Drift:
        return replace(self, ramp=self.devices.ramp(other.data), q=other.data.q, centre=other.centre)

    def sentences(self) -> list[str]:
        """How much drifted with each column, of what is known well."""
        return list(self.devices.of_joints())

    def entry(self) -> dict[str, object]:
        """Unknowns in m and rad over the range of every column."""
        return {"drift": dict(zip(self.names, self.devices.sizes.tolist(), strict=True))}
