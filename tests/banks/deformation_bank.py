"""Robots in general position, without a fit: every kernel, error and parameter differs from zero; large momenta."""

from dataclasses import replace
from functools import cache
from typing import Any

import torch
from robots_bank import CHAINS, draw
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.kernels.profiles import PROFILES
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import GeometryMap, PositionErrors
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.robots import Geometry
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.robots.tree import Tree

CONTROLS = 9
RK4_TWICE = dc.RK4(2)
LEVER = 0.1


def geometry_of(chain: Tree, markers: int = 2, size: float = 0.3, *, seed: int = 11, reach: float = 1.0) -> Geometry:
    """A base, an error before every joint, and markers; of a robot with several tips one marker on each hand."""
    twists, tool = twist_transform(draw(chain.moving + 1, 6, seed=seed, size=size)), draw(markers, 3, seed=seed + 1)
    on = chain.tips[:2] if len(chain.tips) > 1 and markers == 2 else ()
    return replace(Geometry.nominal(chain, markers, on), base=twists[0], joint_errors=twists[1:], tool=reach * tool)


def deformation_of(
    chain: Tree,
    profile: str = "matern52",
    *,
    elastic: bool = True,
    waves: bool = False,
    integrator: Integrator = RK4_TWICE,
    markers: int = 2,
) -> GeodesicDeformation:
    """A deformation in general position: every kernel, error and parameter differs from zero."""
    geometry, space, n, kappa = geometry_of(chain, markers), dc.Space(chain.periodic), chain.n, PROFILES[profile]
    if markers == 3:  # a triangle, whose poses the model has
        geometry = geometry.with_tool(mark_points(twist_transform(draw(1, 6, seed=30, size=0.2)), LEVER)[0])
    nominal = GeometryMap(geometry, elastic=elastic, own=errors_of(chain) if waves else PositionErrors())
    scales = torch.linspace(0.6, 1.2, n, dtype=torch.float64)
    together = dc.Gaussian(scales, variance=1e-2 * scales, space=space)
    # the scales of different joints differ; the compound kernel is anisotropic in and out
    joint = SumKernel([dc.PerJoint(scales, 1e-2 * scales, space, kappa), together])
    task = SumKernel([dc.Gaussian(0.8, 1e-2), RadialKernel(kappa, lengthscale=0.7, variance=1e-2)])
    spec = ModelSpec(nominal, joint, task, torch.ones(nominal.parameters, dtype=torch.float64), 3)
    theta = draw(nominal.parameters, seed=3, size=0.05)
    momenta = Momenta(draw(CONTROLS, n, seed=1), draw(markers * CONTROLS, 3, seed=2), theta)
    return GeodesicDeformation(spec, draw(CONTROLS, n, seed=4, size=2.0), momenta, integrator)


def errors_of(chain: Tree) -> PositionErrors:
    """Two waves of the last joint and one of the first, no frequency a whole number; two axes, beyond whose ranges
    other values lie."""
    axes = (0, -0.7, 0.9, 3), (chain.moving - 1, -1.5, -0.1, 2)
    return PositionErrors(((chain.n - 1, 7.3), (chain.n - 1, 14.7), (0, 5.1)), axes)


def model_of(
    chain: Tree, integrator: Integrator = RK4_TWICE, markers: int = 2, **options: Any
) -> dc.CalibratedKinematics:
    """A model around such a deformation; of poses with three markers."""
    noise = Noise(1e-8 * torch.eye(3 * markers, dtype=torch.float64).repeat(CONTROLS, 1, 1))
    fitted = FittedMap(deformation_of(chain, integrator=integrator, markers=markers, **options), noise)
    return dc.CalibratedKinematics(chain, fitted, lever=LEVER if markers == 3 else None, tool=[0.1, -0.05, 0.2])


@cache
def made(name: str, *, markers: int = 1, steps: int = 1, **options: Any) -> dc.CalibratedKinematics:
    """A model of one of the CHAINS."""
    return model_of(CHAINS[name], dc.RK4(steps), markers, **options)


def queries(model: dc.CalibratedKinematics | FittedMap, rows: int = 5) -> Tensor:
    """Two control points, where profiles have kinks, and other configurations."""
    x = (model.map if isinstance(model, dc.CalibratedKinematics) else model).x
    return torch.cat([x[:2], draw(rows, x.shape[1], seed=37, size=1.5)])


@cache
def fitted_plain(profile: str) -> FittedMap:
    """A fit of a plain function of two variables, with one time step: compilers unroll all of them."""
    x = draw(20, 2, seed=38)
    kernels = [RadialKernel(PROFILES[profile], lengthscale=1.0, variance=0.1) for _ in range(2)]
    problem = dc.Problem(
        bend, x, bend(x) + 0.02 * (3.0 * x).sin(), joint_kernel=kernels[0], task_kernel=kernels[1], noise=0.01
    )
    return dc.fit(problem, integrator=dc.RK4(1)).model


def bend(x: Tensor) -> Tensor:
    """A smooth map of the plane."""
    return torch.stack([x[:, 0].cos() + 0.3 * x[:, 1], x[:, 1] - 0.7 * x[:, 0].sin()], -1)
