"""Geometric errors: points, sensitivities at and away from zero, and what absorbing them means."""

import re
from dataclasses import replace
from math import pi

import pytest
import torch
from deformation_bank import geometry_of
from robots_bank import CHAIN, draw
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import Chain, Geometry, Joint, from_dh

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


@pytest.fixture
def chain() -> Chain:
    rows = [(0.1, 0.4, 0.3, 0.2), (-0.2, -1.1, 0.5, 0.7, "prismatic"), (0.3, 0.9, -0.1), (0.1, pi / 2, 0.2)]
    return from_dh(rows, "craig", names=["waist", "rail", "elbow", "wrist"])


@pytest.fixture(params=["table", "mimic joints"])
def geometry(chain: Chain, request: pytest.FixtureRequest) -> Geometry:
    """A geometry in general position: nothing is the identity, three markers."""
    return geometry_of(chain if request.param == "table" else CHAIN, 3)


@pytest.fixture(params=[0.0, 1e-9, 5e-3, 0.4, 2.0])
def theta(request: pytest.FixtureRequest, geometry: Geometry) -> Tensor:
    return draw(geometry.size, seed=3, size=request.param)


def test_points_multiply_out_as_documented(geometry: Geometry) -> None:
    chain, q, theta = geometry.chain, draw(1, geometry.chain.n, seed=4), draw(geometry.size, seed=5, size=0.2)
    twists, shifts = theta[: -3 * 3].reshape(-1, 6), theta[-3 * 3 :].reshape(3, 3)
    errors = torch.linalg.matrix_exp(twist_matrix(twists))
    errors[:, :3, 3] = twists[:, :3]  # translation first: T(t, w), not the screw exponential
    pose = geometry.base @ errors[0]
    kinds = [joint.kind for joint in chain.joints if joint.kind != "fixed"]
    for j, value in enumerate(chain.moving_values(q)[0]):
        alone = Chain("one", "a", "b", [Joint("j", kinds[j], torch.eye(4), chain.axes[j])])
        pose = pose @ chain.offsets[j] @ geometry.joint_errors[j] @ errors[j + 1] @ alone(value[None, None])[0]
    pose = pose @ chain.tip_offsets[0]
    torch.testing.assert_close(geometry.points(q, theta)[0], (geometry.tool + shifts) @ pose[:3, :3].mT + pose[:3, 3])


def twist_matrix(twists: Tensor) -> Tensor:
    matrix = torch.zeros(len(twists), 4, 4, dtype=torch.float64)
    for index, (x, y, z) in enumerate(twists[:, 3:].tolist()):
        matrix[index, :3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return matrix


def test_poses_carry_the_markers(geometry: Geometry) -> None:
    q = draw(5, geometry.chain.n)
    poses = geometry.poses(q)
    expected = torch.einsum("nab,pb->npa", poses[:, :3, :3], geometry.tool) + poses[:, None, :3, 3]
    torch.testing.assert_close(geometry.points(q), expected)
    names, first = geometry.parameter_names, geometry.chain.moving_names[0]
    assert len(names) == geometry.size
    assert (names[0], names[6], names[-1]) == ("base tx [m]", f"{first} tx [m]", "marker 2 z [m]")


def test_absorbing_theta_changes_no_point(geometry: Geometry, theta: Tensor) -> None:
    q = draw(6, geometry.chain.n, seed=7)
    absorbed = geometry.absorb(theta)
    torch.testing.assert_close(absorbed.points(q), geometry.points(q, theta), rtol=0, atol=1e-13)
    torch.testing.assert_close(absorbed.jacobian(q), geometry.jacobian(q, theta), rtol=0, atol=1e-13)
    again = draw(geometry.size, seed=8, size=0.01)
    torch.testing.assert_close(absorbed.absorb(again).points(q), absorbed.points(q, again), rtol=0, atol=1e-13)


def test_wrong_input_is_explained(chain: Chain) -> None:
    geometry, q, eye = geometry_of(chain, 3), torch.zeros(2, 4), torch.eye(4)
    for theta, message in ((torch.zeros(3), "expected (39,), or one"), (torch.full((39,), torch.nan), "has 39")):
        with pytest.raises(InputError, match=re.escape(message)):
            geometry.points(q, theta)
    with pytest.raises(InputError, match=r"`q` must have shape \(N, 4\)"):
        geometry.sensitivities(torch.zeros(2, 3))
    for name, value, message in (
        ("joint_errors", eye, "one transform per joint"),
        ("joint_errors", geometry.joint_errors[:3], r"expected \(4, 4, 4\), got \(3, 4, 4\)"),
        ("joint_errors", torch.stack([eye, eye, 2 * eye, eye]), "joint_errors of 'elbow': expected a rigid transform"),
        ("base", torch.ones(4, 4), "base: expected a rigid transform"),
        ("tool", torch.zeros(3), r"`tool` has the wrong shape: expected \(P, 3\)"),
    ):
        with pytest.raises(InputError, match=message):
            replace(geometry, **{name: value})
    with pytest.raises(InputError, match=r"expected \(7, 4, 4\), got \(3, 4, 4\); pass one .* `chain.moving_names`"):
        replace(Geometry.nominal(CHAIN), joint_errors=eye.repeat(3, 1, 1))
