"""Rows of a new set-up as a fitted map sees them in its own frame, and the places where an estimate may begin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.re_registration.linear_rows import noise_of_rows
from diffeo_calib.kinematics.re_registration.registered_map import HARDLY
from diffeo_calib.kinematics.tool import TOOL_LEVER, tool_points, tool_transform
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.poses import kind_of_points, own_blocks, poses_from_marks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import place, rigid_fit
from diffeo_calib.robots.se3 import skew

LEAST_POINTS = 3
"""Points that determine where a frame is."""


@dataclass(frozen=True, eq=False)
class Session:
    """Rows of a new set-up, seen by a fitted map in its own frame.

    Args:
        model: the map, placed anew before or not. nominal: that of the fit, under the payloads of the rows.
        data: M rows that show P points. old: (P, 3) where the model has them, or at the tip, m.
        known: whether they may be there. free: (6 + 3 P,) boolean, which unknowns of frame and points may have moved.
    """

    model: FittedMap
    nominal: GeometryMap
    data: Measurements
    old: Tensor
    known: bool
    free: Tensor

    @classmethod
    def of(
        cls, model: FittedMap, nominal: GeometryMap, lever: float | None, data: Measurements, free: str, *, ball: bool
    ) -> Session:
        """The rows beside a model; arguments as of :func:`find_place`.

        Raises:
            InputError: the markers are to stay, but other ones were measured.
            MeasurementError: no more coordinates than unknowns without a prior.
        """
        before, theta = model.registration, model.unregistered.deformation.momenta.theta
        markers = nominal.geometry.tool + theta[nominal.geometry.slices["tool"]].view(-1, 3)
        markers = markers if before is None else before.markers
        own, seen = Bodies(lever), data.bodies
        known = own.kind == seen.kind and data.markers == len(markers)
        if known:
            data, seen = own.represented(data), own
        elif free == "base":
            what, fix = 'free="base" keeps the markers', 'pass free="both" for other markers'
            got = kind_of_points(data.markers, data.lever)
            raise InputError.of(what, expected=kind_of_points(len(markers), lever), got=got, fix=fix)
        old = markers if known else seen.nowhere(data.markers, data.points)
        numbers = torch.arange(6 + old.numel(), device=data.q.device)
        may = torch.where(numbers < 6, free != "marker", free != "base") & (numbers < len(numbers) - 3 * ball)
        _check_enough(data, framed=free != "marker", known=known)
        return cls(model, nominal, data, old, known, may)

    def rows(self, keep: Tensor) -> Session:
        """The session with some of its rows."""
        return replace(self, nominal=self.nominal.rows(keep), data=self.data.rows(keep))

    @property
    def fitted(self) -> FittedMap:
        """The map of the fit."""
        return self.model.unregistered

    @property
    def same(self) -> bool:
        """Whether the markers are those of the fit."""
        before = self.model.registration
        return self.known and (before is None or before.same)

    def seen(self, T: Tensor) -> Tensor:
        """The measured points in the frame of the map, T^-1 y, m; NaN where hidden."""
        return (self.data.points - T[:3, 3]) @ T[:3, :3]

    @cached_property
    def rough(self) -> Tensor:
        """(4, 4) from the frame of the map to the measuring frame, in closed form, m."""
        return (self.at_old_places() if self.known else self.anywhere())[0]

    @cached_property
    def centre(self) -> Tensor:
        """(3,) about which the frame turns, m."""
        return self.seen(self.rough).flatten(0, 1).nanmean(0)

    @cached_property
    def noise(self) -> Tensor:
        """(M, 3 P, 3 P) covariance of the rows, m^2, without information where hidden.

        For another number of markers each has the mean covariance of the fitted ones.
        """
        block, fit, size = self.model.new_noise, self.fitted, 3 * self.data.markers
        factor = float(block.trace() / fit.new_noise.trace()) if self.known else None
        if len(block) != size:
            block = torch.block_diag(*[own_blocks(block[None], len(block) // 3)[0].mean(0)] * self.data.markers)
        total = noise_of_rows(fit, self.data, self.rough, block, factor)
        return without_hidden(total, self.data.visible.repeat_interleave(3, 1))

    @cached_property
    def shared(self) -> Tensor:
        """(M, 3 P, c) effects of errors of unit variance that rows share, of lenses and boards, m."""
        there = self.data.in_frames(torch.linalg.inv(self.rough).expand(len(self.data), -1, -1))
        return torch.cat(
            [self.noise.new_zeros(*self.noise.shape[:2], 0), *(e.slopes for e in there.shared_errors())], 2
        )

    @cached_property
    def earlier(self) -> Tensor:
        """(6 + 3 P, 6 + 3 P) covariance of frame and points by an earlier registration; zero without one."""
        before, found = self.model.registration, self.noise.new_zeros(len(self.free), len(self.free))
        if before is None:
            return found
        size = len(found) if self.known else 6
        to = torch.eye(size, dtype=found.dtype, device=found.device)
        to[:3, 3:6] = -skew(self.centre - before.centre)
        found[:size, :size] = to @ before.covariance[:size, :size] @ to.mT
        return found

    @cached_property
    def by_fit(self) -> Tensor:
        """(6 + 3 P, 6 + 3 P) covariance of the points' old places by the fit where it hardly knew them; a part of C."""
        found = self.noise.new_zeros(len(self.free), len(self.free))
        if self.same:
            part = self.nominal.geometry.slices["tool"]
            numbers = torch.arange(part.start, part.stop, device=found.device)
            known = self.fitted.with_nominal(self.nominal.typical).parameter_covariance(numbers)
            variances, Q = torch.linalg.eigh(known)
            open_by = variances * (variances > HARDLY**2 * self.fitted.new_noise.diagonal().mean())
            found[6:, 6:] = (Q * open_by) @ Q.mT
        return found

    def at_old_places(self) -> tuple[Tensor, Tensor]:
        """Frame (4, 4) in closed form, m, and the points where they were."""
        T = torch.eye(4, dtype=self.data.q.dtype, device=self.data.q.device)
        if bool(self.free[0]):
            model = self.fitted.geodesic.with_nominal(FlangePoints(self.nominal, self.old, same=self.same))
            T = rigid_fit(model(self.data.q).view(-1, 3), self.data.points.flatten(0, 1))
        return T, self.old

    def anywhere(self) -> tuple[Tensor, Tensor]:
        """Frame (4, 4) and points in closed form, m; what never moves stays."""
        own, points = self.nominal.geometry, self.data.points
        tips = list(dict.fromkeys(own.on)) if len(own.on) == points.shape[1] else [own.on[0]]
        corners = tool_points(tool_transform(None).to(points.device)).repeat(len(tips), 1)
        marks = FlangePoints(self.nominal, corners, on=tuple(tip for tip in tips for _ in range(3)))
        poses = poses_from_marks(self.fitted.geodesic.with_nominal(marks)(self.data.q).view(-1, 3, 3), TOOL_LEVER)
        carrying = [tips.index(tip) for tip in own.on] if len(tips) > 1 else [0] * points.shape[1]
        found = place(poses.view(-1, len(tips), 4, 4)[:, carrying], points)
        shown = (~points.isnan()).any(2).any(0)
        return found.base, torch.where(shown[:, None], found.tool, self.old)


def _check_enough(data: Measurements, *, framed: bool, known: bool) -> None:
    """Raise MeasurementError unless there are more coordinates than unknowns without a prior."""
    bodies = data.bodies
    each = bodies.numbers * float(data.seen_bodies.sum()) / len(data)
    unknowns = 6 * framed + bodies.numbers * (data.markers // bodies.points) * (not known)
    points = -(-LEAST_POINTS // data.markers) if framed else 1
    least = max(int(unknowns // each) + 1, points)  # one coordinate more than unknowns: a contradiction can show
    if len(data) < least:
        what, fix = "these rows do not determine where everything is", "measure 6 to 10 poses"
        raise MeasurementError.of(what, expected=f"at least {least} rows", got=len(data), fix=fix)
