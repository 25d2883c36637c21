"""Programs for NumPy against the torch model that they were made of: two implementations of the same formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from deformation_bank import deformation_of
from robots_bank import CHAINS, draw, every_chain
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.kernels.profiles import PROFILES, Profile
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.program import program_of
from diffeo_calib.kinematics.tool import FlangePoints, pose_slopes
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.robots import Chain
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.program import Program

ROWS = 5
every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)


def made(deformation: GeodesicDeformation) -> Program:
    program = program_of(deformation)
    assert program is not None
    return program


def equal(found: np.ndarray, expected: Tensor, tolerance: float = 1e-12) -> None:
    torch.testing.assert_close(torch.from_numpy(found), expected, rtol=0, atol=tolerance)


def agree(program: Program, deformation: GeodesicDeformation, q: Tensor) -> None:
    expected, slopes = (found.unflatten(1, (-1, 3)) for found in (deformation(q), deformation.jacobian(q)))
    equal(program.points(q.numpy()), expected)
    points, jacobian = program.points_and_jacobian(q.numpy())
    equal(points, expected)
    equal(jacobian, slopes, 1e-9)  # the derivative of tables


@every_chain
@pytest.mark.parametrize("elastic", [True, False])
def test_points_and_jacobian(chain: Chain, elastic: bool) -> None:
    deformation = deformation_of(chain, elastic=elastic)
    agree(made(deformation), deformation, draw(ROWS, chain.n, seed=5, size=3.0))


def test_waves_of_gears() -> None:
    """Beyond one turn too: the joint is no circle for a wave that does not close."""
    for name in ("arm", "mimic joints"):
        chain = CHAINS[name]
        deformation = deformation_of(chain, waves=True)
        q, program = draw(ROWS, chain.n, seed=5, size=9.0), made(deformation)
        agree(program, deformation, q)
        still = replace(program, chain=replace(program.chain, waves=None))
        assert np.abs(still.points(q.numpy()) - program.points(q.numpy())).max() > 1e-3


@every_profile
def test_every_profile(profile: Profile) -> None:
    chain = CHAINS["arm"]
    deformation = deformation_of(chain, profile, integrator=dc.RK8(1))
    agree(made(deformation), deformation, draw(ROWS, chain.n, seed=5, size=3.0))


@every_chain
def test_tool_poses(chain: Chain) -> None:
    deformation = deformation_of(chain)
    nominal = deformation.spec.nominal
    assert isinstance(nominal, GeometryMap)
    q, tool = draw(ROWS, chain.n, seed=5), twist_transform(draw(6, seed=6))
    other = deformation.with_nominal(FlangePoints(nominal, mark_points(tool[None], 0.2)[0]))
    points, slopes = other(q).unflatten(1, (3, 3)), other.jacobian(q).unflatten(1, (3, 3))
    expected = poses_from_marks(points, 0.2)
    equal(made(deformation).poses(q.numpy(), tool.numpy(), "measuring", 0.2), expected)
    poses, jacobian = made(deformation).poses_and_jacobian(q.numpy(), tool.numpy(), "measuring", 0.2)
    equal(poses, expected)
    equal(jacobian, pose_slopes(points, slopes, 0.2), 1e-9)


def test_jacobian_is_the_derivative_of_the_program_itself() -> None:
    program = made(deformation_of(CHAINS["arm"]))
    q, step = draw(3, program.chain.n, seed=5).numpy(), 1e-6
    jacobian = program.points_and_jacobian(q)[1]
    for joint in range(q.shape[1]):
        e = step * np.eye(q.shape[1])[joint]
        by_differences = (program.points(q + e) - program.points(q - e)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., joint], by_differences, rtol=0, atol=1e-8)


def test_flows_without_momenta_are_skipped() -> None:
    deformation = deformation_of(CHAINS["arm"])
    spec, x, (b, p, theta) = deformation.spec, deformation.x, deformation.momenta.tensors
    still = GeodesicDeformation(spec, x, Momenta(0 * b, 0 * p, theta), deformation.integrator)
    program = made(still)
    assert program.joint_flow.vanishes
    assert program.task_flow.vanishes
    q = draw(ROWS, x.shape[1], seed=5)
    equal(program.points(q.numpy()), still(q).unflatten(1, (-1, 3)))


def test_points_far_from_the_measuring_frame() -> None:
    """Surveyors' coordinates: kilometres from the origin, where squared distances would cancel."""
    deformation = deformation_of(CHAINS["arm"])
    nominal = deformation.spec.nominal
    assert isinstance(nominal, GeometryMap)
    base = nominal.geometry.base.clone()
    base[:3, 3] += 1e3
    far = GeometryMap(replace(nominal.geometry, base=base), elastic=True)
    moved = GeodesicDeformation(
        replace(deformation.spec, nominal=far), deformation.x, deformation.momenta, deformation.integrator
    )
    q = draw(ROWS, deformation.x.shape[1], seed=5)
    equal(made(moved).points(q.numpy()) - 1e3, deformation(q).unflatten(1, (-1, 3)), 1e-11)


def test_maps_without_constant_stages_have_no_program() -> None:
    chain = CHAINS["arm"]
    assert program_of(deformation_of(chain, integrator=dc.TorchDiffEq())) is None
