"""A fitted map seen from another place: T o k1 for a rigid transform T, as exact as k1 itself.

If the task kernel is the same in all directions, K_W(R y, R y') = K_W(y, y'), rotating points and momenta of a geodesic
rotates the geodesic. So T o psi o k0 is the map with

    base <- T base,    p <- R p,    noise <- R noise R^T,

R the rotation of T. The controls z0 = k0(xi) follow the base, and theta stays: its error twist of the base stands
behind the base.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.robots.se3 import nearest_rotations, transforms


def moved(fitted: FittedMap, nominal: GeometryMap, T: Tensor) -> FittedMap:
    """T o k1.

    Args:
        fitted: k1. nominal: its nominal map. T: (4, 4) rigid transform from the old to the new measuring frame, m.

    Raises:
        InputError: the map is not exact, or its task kernel is not the same in all directions.
    """
    old = fitted.geodesic
    check_isotropic(old.spec.task_kernel)
    device = old.x.device
    geometry = nominal.geometry
    base = T.to(geometry.base.device) @ geometry.base
    base = transforms(nearest_rotations(base[:3, :3]), base[:3, 3])
    after = nominal.with_geometry(replace(geometry, base=base))
    by_row: Any = old.spec.at_controls
    by_row = by_row if by_row is None else by_row.around(after)
    spec = replace(old.spec, nominal=after, at_controls=by_row)
    R = T[:3, :3].to(device)
    b, p, theta = old.momenta.tensors
    deformation = GeodesicDeformation(spec, old.x, Momenta(b, p @ R.mT, theta), old.integrator)
    parts = fitted.data, turned(fitted.new_noise, R), fitted.workspace
    if fitted.slopes is not None:  # what was measured has no direction of its own
        each = torch.block_diag(*[R] * (fitted.m // 3))
        return FittedMap(deformation, fitted.noise, *parts, slopes=fitted.slopes @ each.mT, y=fitted.y)
    noise = Noise(turned(fitted.noise.covariance, R), turned_points(fitted.noise.shared, R))
    y = None if fitted.y is None else (fitted.y.unflatten(1, (-1, 3)) @ R.mT + T[:3, 3].to(device)).flatten(1)
    return FittedMap(deformation, noise, *parts, y=y)


def turned_points(displacements: Tensor, R: Tensor) -> Tensor:
    """Turned displacements of points: (N, 3 P, c), (3, 3) -> (N, 3 P, c)."""
    return (R @ displacements.unflatten(1, (-1, 3))).flatten(1, 2)


def turned(covariance: Tensor, R: Tensor) -> Tensor:
    """The covariance of turned points: (..., 3 P, 3 P), (3, 3) -> (..., 3 P, 3 P), symmetric to the last bit."""
    each = torch.block_diag(*[R] * (covariance.shape[-1] // 3))
    after = each @ covariance @ each.mT
    return 0.5 * (after + after.mT)


def check_isotropic(kernel: Kernel) -> None:
    """Raise InputError unless a kernel on R^3 is the same in all directions."""
    for term in kernel.terms:
        if not (isinstance(term, RadialKernel) and _isotropic(term)):
            what = f"the task kernel of this model ({term!r}) is not the same in all directions"
            fix = "fit again in the new frame, or with a task kernel of one length scale and one variance"
            raise InputError.of(f"{what}: the model cannot be moved to another frame", fix=fix)


def _isotropic(kernel: RadialKernel) -> bool:
    periodic = kernel.periodic if isinstance(kernel.periodic, bool) else any(kernel.periodic)
    scales = (kernel.lengthscale, kernel.variance)
    same = all(bool((scale == scale.flatten()[0]).all()) for scale in scales)
    return same and not periodic and kernel.columns is None and kernel.output is None
