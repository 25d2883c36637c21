"""Deformations of robots in general position, without a fit: every kernel, error and parameter differs from zero."""

from __future__ import annotations

from dataclasses import replace

import torch
from robots_bank import draw

import diffeo_calib as dc
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.kernels.profiles import PROFILES, Profile
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.robots import Chain, Geometry
from diffeo_calib.robots.gear_waves import GearWaves
from diffeo_calib.robots.se3 import twist_transform

CONTROLS = 9
RK4_TWICE = dc.RK4(2)


def deformation_of(
    chain: Chain,
    profile: Profile = PROFILES["matern52"],
    *,
    elastic: bool = True,
    waves: bool = False,
    integrator: Integrator = RK4_TWICE,
) -> GeodesicDeformation:
    """A deformation in general position: every kernel, error and parameter differs from zero."""
    twists = twist_transform(draw(chain.moving + 1, 6, seed=11, size=0.3))
    on = chain.tips[:2] if len(chain.tips) > 1 else ()  # a marker on each hand
    geometry = replace(
        Geometry.nominal(chain, 2, on), base=twists[0], joint_errors=twists[1:], tool=draw(2, 3, seed=12)
    )
    nominal = GeometryMap(geometry, elastic=elastic, waves=waves_of(chain) if waves else GearWaves())
    space, n = dc.Space(chain.periodic), chain.n
    scales = torch.linspace(0.6, 1.2, n, dtype=torch.float64)
    together = dc.Gaussian(scales, variance=1e-2 * scales, space=space)
    # the scales of different joints differ; the compound kernel is anisotropic in and out
    joint = SumKernel([dc.PerJoint(scales, 1e-2 * scales, space, profile), together])
    task = SumKernel([dc.Gaussian(0.8, 1e-2), dc.Cauchy(0.7, 1e-2)])
    spec = ModelSpec(nominal, joint, task, torch.ones(nominal.parameters, dtype=torch.float64), 3)
    momenta = Momenta(
        draw(CONTROLS, n, seed=1), draw(2 * CONTROLS, 3, seed=2), draw(nominal.parameters, seed=3, size=0.05)
    )
    return GeodesicDeformation(spec, draw(CONTROLS, n, seed=4, size=2.0), momenta, integrator)


def waves_of(chain: Chain) -> GearWaves:
    """Two waves of the last joint and one of the first; no frequency is a whole number."""
    return GearWaves((chain.n - 1, chain.n - 1, 0), (7.3, 14.7, 5.1))


def model_of(chain: Chain, integrator: Integrator = RK4_TWICE, waves: bool = False) -> dc.CalibratedKinematics:
    """A model of two markers around such a deformation."""
    noise = 1e-4 * torch.eye(6, dtype=torch.float64).expand(CONTROLS, 6, 6)
    return dc.CalibratedKinematics(
        chain, FittedMap(deformation_of(chain, integrator=integrator, waves=waves), Noise(noise))
    )
