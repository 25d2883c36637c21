"""A fitted map with one more marker, which none of its rows shows: a ball that new rows see."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap, SessionMarkers
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.measurements.pose_frames import own_blocks


def with_ball(fitted: FittedMap, nominal: GeometryMap, ball: Tensor, tip: str, deviation: float) -> FittedMap:
    """The same map with a ball as its last marker.

    Args:
        fitted: the map. nominal: its nominal map. ball: (3,) where it roughly is in the frame of a tip, m.
        tip: name of the tip. deviation: of its prior around that place, m.
    """
    old, end = fitted.geodesic, nominal.geometry.size
    tool = torch.cat([nominal.geometry.tool, ball[None]])
    geometry = nominal.geometry.with_tool(tool, (*nominal.geometry.on, tip))
    after = nominal.with_geometry(geometry)
    prior, theta = old.spec.prior_variance, old.momenta.theta
    prior = torch.cat([prior[:end], prior.new_full((3,), deviation**2), prior[end:]])
    theta = torch.cat([theta[:end], theta.new_zeros(3), theta[end:]])
    p = old.momenta.task.view(len(old.x), -1, 3)
    p = torch.cat([p, p.new_zeros(len(p), 1, 3)], 1).flatten(0, 1)
    spec = replace(old.spec, nominal=after, prior_variance=prior, at_controls=_of_rows(old.spec.at_controls, after))
    deformation = GeodesicDeformation(spec, old.x, Momenta(old.momenta.joint, p, theta), old.integrator)
    markers = nominal.geometry.markers
    slopes = torch.eye(3 * markers, dtype=p.dtype, device=p.device).expand(len(fitted.x), -1, -1)
    slopes = torch.nn.functional.pad(slopes if fitted.slopes is None else fitted.slopes, (0, 3))
    new_noise = torch.block_diag(fitted.new_noise, own_blocks(fitted.new_noise[None], markers)[0].mean(0))
    parts = fitted.noise, fitted.data, new_noise, fitted.workspace
    return FittedMap(deformation, *parts, slopes=slopes, y=fitted.measured())


def _of_rows(by_row: NominalMap | None, after: GeometryMap) -> NominalMap | None:
    """k0 of the controls with the ball at one place in all of them."""
    if isinstance(by_row, SessionMarkers):
        ball = after.geometry.tool[-1:].expand(len(by_row.tools), 1, 3)
        return SessionMarkers(
            after.with_payload(by_row.nominal.payload), by_row.session, torch.cat([by_row.tools, ball], 1)
        )
    return after.with_payload(by_row.payload) if isinstance(by_row, GeometryMap) else by_row
