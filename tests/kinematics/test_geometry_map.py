"""The nominal map of a robot: geometry with gravity sag, and its derivatives by joints and parameters."""

from __future__ import annotations

from math import pi

import pytest
import torch
from deformation_bank import deformation_of, errors_of, geometry_of, model_of
from robots_bank import CHAINS, draw, every_chain
from torch.testing import assert_close

from diffeo_calib.kinematics.nominal import GeometryMap, PositionErrors
from diffeo_calib.kinematics.transmission import gear_lines
from diffeo_calib.robots import Chain
from diffeo_calib.robots.gravity import GravitySag


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


# --- waves of gears in the nominal map: derivatives, names, transmission errors -------------------------------------


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


def test_lines_have_names() -> None:
    model = model_of(CHAINS["arm"], waves=True)
    found = {line.frequency: line for line in gear_lines(model)}
    C, S = model.map.deformation.momenta.theta[model.nominal.parts["waves"]][2:4].tolist()
    last, largest = model.robot.joint_names[-1], gear_lines(model)
    assert [line.displacement for line in largest] == sorted((x.displacement for x in largest), reverse=True)
    assert found[14.7].amplitude == pytest.approx((C * C + S * S) ** 0.5)
    assert found[14.7].multiple == 2
    assert found[14.7].sentence.startswith(f"{last}: gear line 14.7 per rad = 2 x 7.35, ")
    assert found[7.3].multiple == found[5.1].multiple == 1
    values = torch.linspace(-1.0, 1.0, 7, dtype=torch.float64)
    wave = found[5.1].amplitude * (5.1 * values - found[5.1].phase).cos()
    x = torch.nn.functional.pad(values[:, None], (0, model.robot.n - 1))
    by_axis = model.nominal.along_axis(x, 0) @ model.map.deformation.momenta.theta
    first, plain = model.robot.joint_names[0], model_of(CHAINS["arm"])
    expected = plain.transmission(first, values) + wave + by_axis
    assert_close(model.transmission(first, values), expected, rtol=0, atol=1e-12)
    assert gear_lines(plain) == ()


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
