"""The nominal map of a robot: geometry with gravity sag, and its derivatives by joints and parameters."""

from __future__ import annotations

import pytest
import torch
from deformation_bank import deformation_of, geometry_of, model_of, waves_of
from robots_bank import CHAINS, draw, every_chain
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.transmission import gear_lines
from diffeo_calib.robots import Chain
from diffeo_calib.robots.gear_waves import GearWaves

N = 4


def setting(chain: Chain) -> tuple[GeometryMap, Tensor, Tensor]:
    """A map, configurations and parameters."""
    nominal = GeometryMap(geometry_of(chain), elastic=True)
    return nominal, draw(N, chain.n, seed=13), draw(nominal.parameters, seed=14, size=0.1)


def by_rows(values: Tensor, live: Tensor) -> Tensor:
    """Derivatives of values (N, m) by the inputs (N, n) of the same rows: (N, m, n)."""
    rows = [torch.autograd.grad(values[:, k].sum(), live, retain_graph=True)[0] for k in range(values.shape[1])]
    return torch.stack(rows, 1)


@every_chain
def test_values_are_those_of_the_deflected_geometry(chain: Chain) -> None:
    """Row by row, with the sum of the error twists of parameters and deflection."""
    nominal, x, theta = setting(chain)
    assert nominal.elasticity is not None
    geometry, w = nominal.geometry, theta[nominal.geometry.size :]
    joints = geometry.slices["joints"]
    values = nominal(x, theta)
    assert values.shape == (N, 6)
    for row, value in zip(x, values, strict=True):
        errors = theta[: geometry.size].clone()
        errors[joints] += nominal.elasticity.twists(row[None], w).flatten()
        torch.testing.assert_close(value, geometry.points(row[None], errors).flatten(), rtol=1e-13, atol=1e-14)


@every_chain
def test_without_elasticity_it_is_the_geometry(chain: Chain) -> None:
    geometry = geometry_of(chain)
    rigid, x, theta = GeometryMap(geometry), draw(N, chain.n, seed=13), draw(geometry.size, seed=14, size=0.1)
    assert rigid.parameters == geometry.size
    assert torch.equal(rigid(x, theta), geometry.points(x, theta).flatten(1))
    assert torch.equal(rigid.jacobian(x, theta), geometry.jacobian(x, theta).flatten(1, 2))
    assert torch.equal(rigid.sensitivities(x, theta), geometry.sensitivities(x, theta).flatten(1, 2))
    elastic = GeometryMap(geometry, elastic=True)
    longer = torch.cat([theta, theta.new_zeros(elastic.parameters - geometry.size)])
    assert torch.equal(elastic(x, longer), rigid(x, theta))
    assert torch.equal(elastic.jacobian(x, longer), rigid.jacobian(x, theta))


# --- parameters that differ from row to row -------------------------------------------------------------------------


@every_chain
def test_parameters_per_row_are_those_of_each_row(chain: Chain) -> None:
    geometry, x = geometry_of(chain, 3), draw(N, chain.n, seed=15)
    theta = draw(N, geometry.size, seed=16, size=0.3)
    rows = [slice(k, k + 1) for k in range(N)]
    for function in (geometry.points, geometry.jacobian, geometry.sensitivities):
        expected = torch.cat([function(x[row], theta[k]) for k, row in enumerate(rows)])
        torch.testing.assert_close(function(x, theta), expected, rtol=1e-13, atol=1e-14)


def test_sensitivities_per_row_are_derivatives_of_that_row() -> None:
    geometry, x = geometry_of(CHAINS["mimic joints"]), draw(3, CHAINS["mimic joints"].n, seed=17)
    theta = draw(3, geometry.size, seed=18, size=0.3).requires_grad_()
    expected = by_rows(geometry.points(x, theta).flatten(1), theta)
    actual = geometry.sensitivities(x, theta.detach()).flatten(1, 2)
    torch.testing.assert_close(actual, expected, rtol=1e-11, atol=1e-12)


# --- waves of gears in the nominal map: derivatives, names, transmission errors -------------------------------------


def test_a_wave_turns_its_joint_and_nothing_else() -> None:
    chain = CHAINS["arm"]
    plain, waves = deformation_of(chain).spec.nominal, waves_of(chain)
    assert isinstance(plain, GeometryMap)
    with_waves = GeometryMap(plain.geometry, elastic=True, waves=waves)
    x, theta, c = draw(4, chain.n, seed=1, size=2.0), draw(plain.parameters, seed=2, size=0.03), draw(6, seed=3)
    turned = x.clone()
    for k, (joint, w) in enumerate(waves.to_config()):
        turned[:, int(joint)] += c[2 * k] * (w * x[:, int(joint)]).cos() + c[2 * k + 1] * (w * x[:, int(joint)]).sin()
    assert_close(with_waves(x, torch.cat([theta, c])), plain(turned, theta), rtol=0, atol=1e-14)


def test_lines_have_names() -> None:
    model = model_of(CHAINS["arm"], waves=True)
    found = {line.frequency: line for line in gear_lines(model)}
    C, S = model.nominal.wave_coefficients(model.map.deformation.momenta.theta)[2:4].tolist()
    last, largest = model.robot.joint_names[-1], gear_lines(model)
    assert [line.displacement for line in largest] == sorted((x.displacement for x in largest), reverse=True)
    assert found[14.7].amplitude == pytest.approx((C * C + S * S) ** 0.5)
    assert found[14.7].multiple == 2
    assert found[14.7].sentence.startswith(f"{last}: gear line 14.7 per rad = 2 x 7.35, ")
    assert found[7.3].multiple == found[5.1].multiple == 1
    values = torch.linspace(-1.0, 1.0, 7, dtype=torch.float64)
    wave = found[5.1].amplitude * (5.1 * values - found[5.1].phase).cos()
    first, plain = model.robot.joint_names[0], model_of(CHAINS["arm"])
    assert_close(model.transmission(first, values), plain.transmission(first, values) + wave, rtol=0, atol=1e-12)
    assert gear_lines(plain) == ()


def test_waves_that_cannot_be() -> None:
    for waves in (((-1,), (5.0,)), ((0,), (0.0,)), ((0,), (float("nan"),))):
        with pytest.raises(InputError, match="waves of gears"):
            GearWaves(*waves)
    chain = CHAINS["arm"]
    with pytest.raises(InputError, match="joints of gear waves"):
        GeometryMap(deformation_of(chain).spec.nominal.geometry, waves=GearWaves((chain.n,), (5.0,)))
