"""Calibrated models that were not fitted but made: any chain, large random momenta, every kind of kernel."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import torch
from robots_bank import CHAINS, draw
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.kernels.profiles import PROFILES
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.robots import Geometry
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.robots.tree import Tree

LEVER = 0.1
CONTROLS = 12


def geometry_of(chain: Tree, markers: int) -> Geometry:
    """Base, errors of the joints and markers in general position; three markers are a triangle."""
    twists = twist_transform(draw(chain.moving + 2, 6, seed=31, size=0.2))
    tool = mark_points(twists[:1], LEVER)[0] if markers == 3 else draw(markers, 3, seed=32, size=0.1)
    return replace(Geometry.nominal(chain, markers), base=twists[1], joint_errors=twists[2:], tool=tool)


@cache
def made(
    name: str, *, profile: str = "matern52", markers: int = 1, elastic: bool = True, steps: int = 1
) -> dc.CalibratedKinematics:
    """A model of one of the CHAINS, whose errors are centimetres and hundredths of a radian; poses of three markers."""
    return made_with(CHAINS[name], dc.RK4(steps), profile, markers, elastic)


def made_with(
    chain: Tree, integrator: Integrator, profile: str = "matern52", markers: int = 1, elastic: bool = False
) -> dc.CalibratedKinematics:
    nominal, space = GeometryMap(geometry_of(chain, markers), elastic=elastic), dc.Space(chain.periodic)
    scales, variances = torch.linspace(0.5, 1.0, chain.n), torch.linspace(1e-3, 2e-3, chain.n)
    own = dc.PerJoint(scales, variances, space, PROFILES[profile])
    together = RadialKernel(PROFILES["gaussian"], lengthscale=scales + 1.0, variance=variances, periodic=space.periodic)
    task = RadialKernel(PROFILES[profile], lengthscale=0.7, variance=1e-3)
    prior = torch.ones(nominal.parameters, dtype=torch.float64)
    spec = ModelSpec(nominal, own + together, task, prior, 3)
    momenta = Momenta(
        draw(CONTROLS, chain.n, seed=33, size=2.0),
        draw(CONTROLS * markers, 3, seed=34, size=2.0),
        draw(nominal.parameters, seed=35, size=0.01),
    )
    deformation = GeodesicDeformation(spec, draw(CONTROLS, chain.n, seed=36), momenta, integrator)
    noise = Noise(1e-8 * torch.eye(3 * markers, dtype=torch.float64).repeat(CONTROLS, 1, 1))
    fitted = FittedMap(deformation, noise)
    return dc.CalibratedKinematics(chain, fitted, lever=LEVER if markers == 3 else None, tool=[0.1, -0.05, 0.2])


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
