"""Geometric errors: points, sensitivities at and away from zero, and what absorbing them means."""

import re
from dataclasses import replace
from math import pi

import pytest
import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import Chain, Geometry, Joint, from_dh
from diffeo_calib.robots.se3 import twist_transform

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def draw(*shape: int, seed: int = 0, size: float = 1.0) -> Tensor:
    return size * torch.randn(*shape, dtype=torch.float64, generator=generator(seed))


@pytest.fixture
def chain() -> Chain:
    rows = [(0.1, 0.4, 0.3, 0.2), (-0.2, -1.1, 0.5, 0.7, "prismatic"), (0.3, 0.9, -0.1), (0.1, pi / 2, 0.2)]
    return from_dh(rows, "craig", names=["waist", "rail", "elbow", "wrist"])


@pytest.fixture
def geometry(chain: Chain) -> Geometry:
    """A geometry in general position: nothing is the identity, three markers."""
    twists = twist_transform(draw(chain.n + 1, 6, seed=1, size=0.3))
    return replace(Geometry.nominal(chain, 3), base=twists[0], joint_errors=twists[1:], tool=draw(3, 3, seed=2))


@pytest.fixture(params=[0.0, 1e-9, 5e-3, 0.4, 2.0])
def theta(request: pytest.FixtureRequest, geometry: Geometry) -> Tensor:
    return draw(geometry.size, seed=3, size=request.param)


def test_points_multiply_out_as_documented(geometry: Geometry) -> None:
    chain, q, theta = geometry.chain, draw(1, 4, seed=4), draw(geometry.size, seed=5, size=0.2)
    errors = torch.linalg.matrix_exp(twist_matrix(theta[:30].reshape(5, 6)))
    errors[:, :3, 3] = theta[:30].reshape(5, 6)[:, :3]  # translation first: T(t, w), not the screw exponential
    pose = geometry.base @ errors[0]
    for j in range(chain.n):
        alone = Chain("one", "a", "b", [Joint("j", chain.kinds[j], torch.eye(4), chain.axes[j])])
        pose = pose @ chain.offsets[j] @ geometry.joint_errors[j] @ errors[j + 1] @ alone(q[:, j : j + 1])[0]
    pose = pose @ chain.tip_offsets[0]
    tool = geometry.tool + theta[30:].reshape(3, 3)
    torch.testing.assert_close(geometry.points(q, theta)[0], tool @ pose[:3, :3].mT + pose[:3, 3])


def twist_matrix(twists: Tensor) -> Tensor:
    matrix = torch.zeros(len(twists), 4, 4, dtype=torch.float64)
    for index, (x, y, z) in enumerate(twists[:, 3:].tolist()):
        matrix[index, :3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return matrix


def test_nominal_geometry_is_the_chain(chain: Chain) -> None:
    q = draw(5, 4)
    geometry = Geometry.nominal(chain, 2)
    torch.testing.assert_close(geometry.points(q), chain(q)[:, None, :3, 3].expand(5, 2, 3))
    torch.testing.assert_close(geometry.poses(q), chain(q))
    torch.testing.assert_close(geometry.jacobian(q)[:, 1], chain.jacobian(q)[:, :3])


def test_poses_carry_the_markers(geometry: Geometry) -> None:
    q = draw(5, 4)
    poses = geometry.poses(q)
    expected = torch.einsum("nab,pb->npa", poses[:, :3, :3], geometry.tool) + poses[:, None, :3, 3]
    torch.testing.assert_close(geometry.points(q), expected)


def test_sensitivities_are_the_derivatives_by_theta(geometry: Geometry, theta: Tensor) -> None:
    q = draw(4, 4, seed=6)
    expected = torch.func.jacrev(lambda x: geometry.points(q, x))(theta)
    torch.testing.assert_close(geometry.sensitivities(q, theta), expected, rtol=0, atol=1e-11)
    forward = torch.func.jacfwd(lambda x: geometry.points(q, x))(theta)
    torch.testing.assert_close(geometry.sensitivities(q, theta), forward, rtol=0, atol=1e-11)


def test_sensitivities_at_zero_by_differences(geometry: Geometry) -> None:
    q, h = draw(2, 4, seed=6), 1e-5
    steps = h * torch.eye(geometry.size, dtype=torch.float64)
    difference = torch.stack([(geometry.points(q, s) - geometry.points(q, -s)) / (2 * h) for s in steps], dim=-1)
    torch.testing.assert_close(geometry.sensitivities(q), difference, rtol=0, atol=1e-9)


def test_jacobian_is_the_derivative_by_the_joints(geometry: Geometry, theta: Tensor) -> None:
    q = draw(4, 4, seed=6)
    expected = torch.func.vmap(torch.func.jacrev(lambda x: geometry.points(x[None], theta)[0]))(q)
    torch.testing.assert_close(geometry.jacobian(q, theta), expected, rtol=0, atol=1e-11)


def test_absorbing_theta_changes_no_point(geometry: Geometry, theta: Tensor) -> None:
    q = draw(6, 4, seed=7)
    absorbed = geometry.absorb(theta)
    torch.testing.assert_close(absorbed.points(q), geometry.points(q, theta), rtol=0, atol=1e-13)
    torch.testing.assert_close(absorbed.jacobian(q), geometry.jacobian(q, theta), rtol=0, atol=1e-13)
    again = draw(geometry.size, seed=8, size=0.01)
    torch.testing.assert_close(absorbed.absorb(again).points(q), absorbed.points(q, again), rtol=0, atol=1e-13)


def test_second_derivatives_exist_at_zero(geometry: Geometry) -> None:
    q = draw(1, 4, seed=6)
    zero = torch.zeros(geometry.size, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: geometry.sensitivities(q, x), (zero,))
    assert torch.autograd.gradcheck(lambda x: geometry.jacobian(x, zero), (q.requires_grad_(),))


def test_names_and_slices_address_the_parameters(geometry: Geometry) -> None:
    names = geometry.parameter_names
    assert len(names) == geometry.size == 6 + 6 * 4 + 3 * 3
    assert (names[0], names[5], names[6], names[29]) == (
        "base tx [m]",
        "base rz [rad]",
        "waist tx [m]",
        "wrist rz [rad]",
    )
    assert (names[30], names[-1]) == ("marker 0 x [m]", "marker 2 z [m]")
    parts = geometry.slices
    assert all(name.startswith("base") for name in names[parts["base"]])
    assert all(name.startswith("marker") for name in names[parts["tool"]])
    assert len(names[parts["joints"]]) == 24

    theta = torch.zeros(geometry.size, dtype=torch.float64)
    theta[names.index("marker 1 y [m]")] = 0.01
    moved = geometry.points(draw(3, 4), theta) - geometry.points(draw(3, 4))
    torch.testing.assert_close(moved.norm(dim=-1), torch.tensor([[0, 0.01, 0]] * 3, dtype=torch.float64))


def test_sensitivities_pass_through_vmap(geometry: Geometry) -> None:
    q = draw(3, 4)
    each = torch.func.vmap(lambda x: geometry.sensitivities(x[None])[0])(q)
    torch.testing.assert_close(each, geometry.sensitivities(q))


def test_no_rows(geometry: Geometry) -> None:
    q = torch.zeros(0, 4)
    assert geometry.points(q).shape == (0, 3, 3)
    assert geometry.jacobian(q).shape == (0, 3, 3, 4)
    assert geometry.sensitivities(q).shape == (0, 3, 3, geometry.size)


def test_wrong_input_is_explained(geometry: Geometry) -> None:
    q = torch.zeros(2, 4)
    with pytest.raises(
        InputError, match=re.escape("`theta` has the wrong shape: expected (39,), or one such row per conf")
    ):
        geometry.points(q, torch.zeros(3))
    with pytest.raises(InputError, match="`theta` has 39 value"):
        geometry.points(q, torch.full((39,), float("nan")))
    with pytest.raises(InputError, match=r"`q` must have shape \(N, 4\)"):
        geometry.sensitivities(torch.zeros(2, 3))
    with pytest.raises(InputError, match="one transform per joint"):
        replace(geometry, joint_errors=torch.eye(4))
    with pytest.raises(InputError, match=r"expected \(4, 4, 4\), got \(3, 4, 4\)"):
        replace(geometry, joint_errors=geometry.joint_errors[:3])
    with pytest.raises(InputError, match="joint_errors of 'elbow': expected a rigid transform"):
        replace(geometry, joint_errors=torch.stack([geometry.base] * 2 + [2 * torch.eye(4)] + [geometry.base]))
    with pytest.raises(InputError, match="base: expected a rigid transform"):
        replace(geometry, base=torch.ones(4, 4))
    with pytest.raises(InputError, match=r"`tool` has the wrong shape: expected \(P, 3\)"):
        replace(geometry, tool=torch.zeros(3))
