"""Nominal kinematics of points on the flange that were not measured, or that have moved since."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.nominal import NominalMap


class FlangePoints(NominalMap):
    """k0 of other points on the flange, with the parameters theta of the map that was fitted: m = 3 P'.

    The fitted parameters keep their meaning; those that shift the measured markers have no effect here. Only if the
    points are these markers after a known motion (``same``), what is not known about the markers' places counts.

    Args:
        fitted: nominal map of the measured markers.
        points: (P', 3) points in their tip's frame, m.
        same: whether the points are the measured markers, one for one.
        on: names of their tips, P' of them; as many points as measured markers are on the same tips by default.
    """

    def __init__(self, fitted: GeometryMap, points: Tensor, *, same: bool = False, on: tuple[str, ...] = ()) -> None:
        self.fitted, self.points, self.same = fitted, points, same
        self.map = fitted.with_geometry(fitted.geometry.with_tool(points, on))
        self.parameters = fitted.parameters

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        """Positions in m: (N, 3 P')."""
        return self.map(x, self._own(theta))

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """In m/rad or m/m: (N, 3 P', n)."""
        return self.map.jacobian(x, self._own(theta))

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        """By the fitted parameters, m/m or m/rad: (N, 3 P', K)."""
        own, markers = self.map.geometry.slices["tool"], self.fitted.geometry.slices["tool"]
        slopes = self.map.sensitivities(x, self._own(theta))
        if self.same:
            return slopes
        unmoved = slopes.new_zeros(*slopes.shape[:2], markers.stop - markers.start)
        return torch.cat([slopes[..., : own.start], unmoved, slopes[..., own.stop :]], dim=-1)

    def shifts(self, x: Tensor, theta: Tensor) -> Tensor:
        """By shifts of the points in the tip's frame, m/m: (N, 3 P', 3 P')."""
        return self.map.sensitivities(x, self._own(theta))[..., self.map.geometry.slices["tool"]]

    def _own(self, theta: Tensor) -> Tensor:
        """theta of the other points: theirs are not shifted."""
        markers = self.fitted.geometry.slices["tool"]
        return torch.cat([theta[: markers.start], theta.new_zeros(self.points.numel()), theta[markers.stop :]])
