"""Geometric errors, gravity sag, gears and axes: points, what absorbing errors means, names."""

from dataclasses import replace
from math import pi

import pytest
import torch
from deformation_bank import deformation_of, errors_of, geometry_of
from robots_bank import CHAIN, CHAINS, draw, every_chain
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.kinematics.nominal import GeometryMap, PositionErrors
from diffeo_calib.kinematics.transmission import transmission
from diffeo_calib.robots import Chain, Geometry, Joint, from_dh
from diffeo_calib.robots.gravity import GravitySag


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
    nominal, mimics = (
        Geometry.nominal(CHAIN),
        r"expected \(7, 4, 4\), got \(3, 4, 4\); pass one .* `chain.moving_names",
    )
    skew = torch.stack([eye, eye, 2 * eye, eye])
    refused(
        (r"expected \(39,\), or one", lambda: geometry.points(q, torch.zeros(3))),
        ("has 39", lambda: geometry.points(q, torch.full((39,), torch.nan))),
        (r"`q` must have shape \(N, 4\)", lambda: geometry.sensitivities(torch.zeros(2, 3))),
        ("one transform per joint", lambda: replace(geometry, joint_errors=eye)),
        (r"expected \(4, 4, 4\), got \(3, 4, 4\)", lambda: replace(geometry, joint_errors=geometry.joint_errors[:3])),
        ("joint_errors of 'elbow': expected a rigid transform", lambda: replace(geometry, joint_errors=skew)),
        ("base: expected a rigid transform", lambda: replace(geometry, base=torch.ones(4, 4))),
        (r"`tool` has the wrong shape: expected \(P, 3\)", lambda: replace(geometry, tool=torch.zeros(3))),
        (mimics, lambda: replace(nominal, joint_errors=eye.repeat(3, 1, 1))),
    )


@every_chain
def test_values_are_those_of_the_deflected_geometry(chain: Chain) -> None:
    """Row by row, with the sum of the error twists of parameters and deflection."""
    nominal = GeometryMap(geometry_of(chain), elastic=True)
    x, theta = draw(4, chain.n, seed=13), draw(nominal.parameters, seed=14, size=0.1)
    geometry, w = nominal.geometry, theta[nominal.geometry.size :]
    for row, value in zip(x, nominal(x, theta), strict=True):
        errors = theta[: geometry.size].clone()
        errors[geometry.slices["joints"]] += GravitySag(chain).twists(row[None], w).flatten()
        assert_close(value, geometry.points(row[None], errors).flatten(), rtol=1e-13, atol=1e-14)


def test_a_wave_turns_its_joint_and_nothing_else() -> None:
    chain = CHAINS["arm"]
    plain, waves = deformation_of(chain).spec.nominal, errors_of(chain).waves
    assert isinstance(plain, GeometryMap)
    with_waves = GeometryMap(plain.geometry, elastic=True, own=PositionErrors(waves))
    x, theta, c = draw(4, chain.n, seed=1, size=2.0), draw(plain.parameters, seed=2, size=0.03), draw(6, seed=3)
    turned = x.clone()
    for k, (joint, w) in enumerate(waves):
        turned[:, joint] += c[2 * k] * (w * x[:, joint]).cos() + c[2 * k + 1] * (w * x[:, joint]).sin()
    assert_close(with_waves(x, torch.cat([theta, c])), plain(turned, theta), rtol=0, atol=1e-14)


def test_waves_are_added_to_what_kernels_and_axes_turn_a_joint_by() -> None:
    chain, deformation = CHAINS["arm"], deformation_of(CHAINS["arm"], waves=True)
    values, name = draw(9, seed=1, size=3.0), chain.joint_names[-1]
    added = transmission(deformation, chain, name, values) - transmission(deformation, chain, name, values, lines=False)
    c = deformation.momenta.theta[deformation.spec.nominal.parts["waves"]]  # pyright: ignore
    expected = sum(c[2 * k] * (w * values).cos() + c[2 * k + 1] * (w * values).sin() for k, w in enumerate((7.3, 14.7)))
    assert_close(added, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["arm", "slides", "mimic slides"])
def test_errors_of_an_axis_along_itself_are_a_transmission_error(name: str) -> None:
    chain, x = CHAINS[name], draw(5, CHAINS[name].n, seed=1)
    for joint, moving in enumerate(map(chain.moving_names.index, chain.joint_names)):
        nominal = GeometryMap(geometry_of(chain), own=PositionErrors((), ((moving, -1.0, 1.0, 2),)))
        theta, part = torch.zeros(nominal.parameters, dtype=torch.float64), nominal.parts["axes"]
        along = torch.cat([chain.axes[moving] * ~chain.revolute[moving], chain.axes[moving] * chain.revolute[moving]])
        added = nominal.along_axis(x, joint)[:, part].unflatten(1, (2, 6)) @ along  # (N, 2)
        followed = int(chain.coupling[:, joint].count_nonzero()) > 1
        by_axis = nominal.sensitivities(x, theta)[..., part].unflatten(2, (2, 6)) @ along
        expected = nominal.jacobian(x, theta)[..., joint, None] * added[:, None]
        assert bool(added.any()) != followed
        assert_close(added.any() * by_axis, expected, rtol=0, atol=1e-12)


def test_an_axis_shifts_and_turns_the_frame_before_its_joint() -> None:
    """As an error twist of each row, constant beyond the range of the axis."""
    chain = CHAINS["mimic slides"]
    geometry, axis = geometry_of(chain), (1, -0.5, 0.7, 3)
    crooked = GeometryMap(geometry, own=PositionErrors(axes=(axis,)))
    x, theta, c = draw(9, chain.n, seed=1, size=2.0), draw(geometry.size, seed=2, size=0.03), draw(3, 6, seed=3)
    held = chain.moving_values(x)[:, 1].clamp(-0.5, 0.7)
    assert 0 < int(((held > -0.5) & (held < 0.7)).sum()) < 9
    errors = theta.repeat(9, 1)
    for k in range(3):
        errors[:, 12:18] += ((k + 1) * pi * (held + 0.5) / 1.2).cos()[:, None] * c[k]
    found, theta = crooked(x, torch.cat([theta, c.flatten()])), torch.cat([theta, c.flatten()])
    assert_close(found, geometry.points(x, errors).flatten(1), rtol=0, atol=1e-13)
