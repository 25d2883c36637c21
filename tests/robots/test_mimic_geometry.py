"""Geometric errors of mimic joints: every moving joint has its own."""

from dataclasses import replace

import pytest
import torch
from mimic_bank import CHAIN, FREE, errors_of, expand
from robots_bank import draw

from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import Geometry

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


def test_every_moving_joint_has_an_error_twist() -> None:
    geometry = errors_of(CHAIN)
    names = geometry.parameter_names
    assert geometry.size == len(names) == 6 + 6 * 7 + 3 * 2
    assert (names[6], names[6 + 6 * 3 + 5], names[47]) == ("early tx [m]", "sum rz [rad]", "second rz [rad]")
    assert geometry.slices["joints"] == slice(6, 48)
    assert Geometry.nominal(CHAIN).joint_errors.shape == (7, 4, 4)
    prior = Prior(translation=2e-3, rotation=3e-3).deviations(geometry)
    assert prior[6:48].tolist() == ([2e-3] * 3 + [3e-3] * 3) * 7
    assert len(prior) == geometry.size


def test_points_equal_those_of_the_robot_with_all_joints_active() -> None:
    coupled, free = errors_of(CHAIN), errors_of(FREE)
    q, theta = draw(5, 3), draw(coupled.size, seed=2, size=0.1)
    full = expand(q)
    torch.testing.assert_close(coupled.points(q, theta), free.points(full, theta), rtol=0, atol=1e-13)
    torch.testing.assert_close(coupled.sensitivities(q, theta), free.sensitivities(full, theta), rtol=0, atol=1e-13)
    torch.testing.assert_close(coupled.poses(q), free.poses(full), rtol=0, atol=1e-13)


@pytest.mark.parametrize("size", [0.0, 5e-3, 0.4])
def test_geometry_s_derivatives_are_those_of_autograd(size: float) -> None:
    geometry, q = errors_of(CHAIN), draw(4, 3)
    theta = draw(geometry.size, seed=2, size=size)
    by_joint = torch.func.vmap(torch.func.jacrev(lambda x: geometry.points(x[None], theta)[0]))(q)
    torch.testing.assert_close(geometry.jacobian(q, theta), by_joint, rtol=0, atol=1e-12)
    by_theta = torch.func.jacrev(lambda x: geometry.points(q, x))(theta)
    torch.testing.assert_close(geometry.sensitivities(q, theta), by_theta, rtol=0, atol=1e-12)
    absorbed = geometry.absorb(theta)
    torch.testing.assert_close(absorbed.points(q), geometry.points(q, theta), rtol=0, atol=1e-13)


def test_nominal_geometry_is_the_chain() -> None:
    geometry, q = Geometry.nominal(CHAIN), draw(3, 3)
    torch.testing.assert_close(geometry.poses(q), CHAIN(q))
    torch.testing.assert_close(geometry.jacobian(q)[:, 0], CHAIN.jacobian(q)[:, :3])


def test_an_error_for_the_active_joints_only_is_refused() -> None:
    with pytest.raises(InputError, match=r"expected \(7, 4, 4\), got \(3, 4, 4\); pass one .* `chain.moving_names`"):
        replace(Geometry.nominal(CHAIN), joint_errors=torch.eye(4).repeat(3, 1, 1))
