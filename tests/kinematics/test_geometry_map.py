"""The nominal map of a robot: geometry with gravity sag, and its derivatives by joints and parameters."""

from dataclasses import replace

import pytest
import torch
from robots_bank import CHAINS, draw, every_chain
from torch import Tensor

from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import Chain, Geometry
from diffeo_calib.robots.se3 import twist_transform

N = 4


def geometry_of(chain: Chain, markers: int = 2) -> Geometry:
    """A geometry in general position."""
    twists = twist_transform(draw(chain.moving + 1, 6, seed=11, size=0.3))
    bare = Geometry.nominal(chain, markers)
    return replace(bare, base=twists[0], joint_errors=twists[1:], tool=draw(markers, 3, seed=12))


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
def test_jacobian_against_autograd(chain: Chain) -> None:
    nominal, x, theta = setting(chain)
    live = x.clone().requires_grad_()
    expected = by_rows(nominal(live, theta), live)
    torch.testing.assert_close(nominal.jacobian(x, theta), expected, rtol=1e-11, atol=1e-12)


@every_chain
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_sensitivities_against_autograd(chain: Chain, size: float) -> None:
    """Also at zero, where nothing is deflected."""
    nominal, x, theta = setting(chain)
    live = (size * theta).requires_grad_()
    values = nominal(x, live).flatten()
    rows = [torch.autograd.grad(value, live, retain_graph=True)[0] for value in values]
    expected = torch.stack(rows).view(N, 6, nominal.parameters)
    actual = nominal.sensitivities(x, size * theta)
    torch.testing.assert_close(actual, expected, rtol=1e-11, atol=1e-12)
    if nominal.parameters > nominal.geometry.size:
        assert float(actual[..., nominal.geometry.size :].abs().max()) > 1e-3


@every_chain
def test_jacobian_moves_with_the_coefficients(chain: Chain) -> None:
    """The second derivative by joints and coefficients at zero, by finite differences."""
    nominal, x, theta = setting(chain)
    theta[: nominal.geometry.size] = 0.0
    h = 1e-6
    change = (nominal.jacobian(x, h * theta) - nominal.jacobian(x, -h * theta)) / (2 * h)
    live = x.clone().requires_grad_()
    expected = by_rows(torch.einsum("nmk,k->nm", nominal.sensitivities(live, 0 * theta), theta), live)
    torch.testing.assert_close(change, expected, rtol=1e-6, atol=1e-7)


@every_chain
def test_without_parameters_it_is_the_geometry(chain: Chain) -> None:
    nominal, x, _ = setting(chain)
    theta = torch.zeros(nominal.parameters, dtype=torch.float64)
    geometry = nominal.geometry
    assert torch.equal(nominal(x, theta), geometry.points(x).flatten(1))
    assert torch.equal(nominal.jacobian(x, theta), geometry.jacobian(x).flatten(1, 2))
    sensitivities = nominal.sensitivities(x, theta)[..., : geometry.size]
    assert torch.equal(sensitivities, geometry.sensitivities(x).flatten(1, 2))


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


@every_chain
def test_split(chain: Chain) -> None:
    nominal, _, theta = setting(chain)
    errors, coefficients = nominal.split(theta)
    assert nominal.elasticity is not None
    assert len(errors) == nominal.geometry.size
    assert len(coefficients) == nominal.elasticity.size
    assert torch.equal(torch.cat([errors, coefficients]), theta)
    rigid = GeometryMap(nominal.geometry)
    assert len(rigid.split(errors)[1]) == 0


@every_chain
def test_no_rows(chain: Chain) -> None:
    nominal, x, theta = setting(chain)
    none = x[:0]
    for values in (theta, 0 * theta):
        assert nominal(none, values).shape == (0, 6)
        assert nominal.jacobian(none, values).shape == (0, 6, chain.n)
        assert nominal.sensitivities(none, values).shape == (0, 6, nominal.parameters)


# --- parameters that differ from row to row -----------------------------------------------------------------------


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
