"""Waves of gears in the nominal map: derivatives, names, transmission errors."""

from __future__ import annotations

import pytest
import torch
from deformation_bank import deformation_of, model_of, waves_of
from math_bank import central_difference
from robots_bank import CHAINS, draw, every_chain
from torch.testing import assert_close

from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.transmission import gear_lines
from diffeo_calib.robots import Chain
from diffeo_calib.robots.gear_waves import GearWaves


@every_chain
@pytest.mark.parametrize("elastic", [True, False])
def test_derivatives(chain: Chain, elastic: bool) -> None:
    nominal = deformation_of(chain, elastic=elastic, waves=True).spec.nominal
    x, theta = draw(4, chain.n, seed=1, size=2.0), draw(nominal.parameters, seed=2, size=0.03)
    dx, dtheta = draw(4, chain.n, seed=3), draw(nominal.parameters, seed=4)
    by_x = central_difference(lambda q: nominal(q, theta), x, dx)
    assert_close((nominal.jacobian(x, theta) @ dx[:, :, None])[..., 0], by_x, rtol=0, atol=1e-7)
    by_theta = central_difference(lambda t: nominal(x, t), theta, dtheta)
    assert_close(nominal.sensitivities(x, theta) @ dtheta, by_theta, rtol=0, atol=1e-9)


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


@pytest.mark.parametrize("waves", [((-1,), (5.0,)), ((0,), (0.0,)), ((0,), (float("nan"),))])
def test_waves_that_cannot_be(waves: tuple[tuple[int, ...], tuple[float, ...]]) -> None:
    with pytest.raises(InputError, match="waves of gears"):
        GearWaves(*waves)


def test_a_wave_of_a_joint_that_is_not_there() -> None:
    chain = CHAINS["arm"]
    with pytest.raises(InputError, match="joints of gear waves"):
        GeometryMap(deformation_of(chain).spec.nominal.geometry, waves=GearWaves((chain.n,), (5.0,)))
