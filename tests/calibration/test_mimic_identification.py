"""Registration and identification of long chains, with slides and mimic joints."""

from dataclasses import replace
from math import pi

import pytest
import torch
from robots_bank import draw
from torch import Tensor

from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.robots import Chain, DHRow, Geometry, from_dh


def machine(moving: int, slides: tuple[int, ...] = (), *, mimic: bool = False) -> Chain:
    """A chain of many joints with perpendicular neighbouring axes; ``mimic``: joint 4 is -(q2 + q3), as a torso's."""
    rows = []
    for index in range(moving):
        kind = "prismatic" if index in slides else "revolute"
        twist = pi / 2 if index % 2 else -pi / 2
        follows = {"joint_2": -1.0, "joint_3": -1.0} if mimic and index == 3 else None
        rows.append(DHRow(0.05 + 0.03 * (index % 3), twist, 0.25 - 0.02 * index, 0.1 * index, kind, follows))
    return from_dh(rows, name=f"machine of {moving}")


def placed(chain: Chain, deviation: float, seed: int = 3) -> Geometry:
    """Errors of the given size in all moving joints, the base metres away, two markers."""
    nominal = Geometry.nominal(chain, 2)
    theta = draw(nominal.size, seed=seed, size=deviation)
    theta[:6] = torch.tensor([1.0, -2.0, 0.5, 0.7, -0.4, 1.1])
    theta[nominal.slices["tool"]] = draw(6, seed=seed, size=0.1)
    return nominal.absorb(theta)


def configurations(chain: Chain, count: int, seed: int) -> Tensor:
    turning = torch.tensor(chain.periodic)
    return torch.where(turning, 2.0, 0.3) * (2 * draw(count, chain.n, seed=seed).sigmoid() - 1) * 1.5


MACHINES = [
    machine(7),
    machine(7, (0, 4)),
    machine(9, (2,)),
    machine(11, (0,)),
    machine(11, mimic=True),
    machine(11, (0, 6), mimic=True),
]


@pytest.mark.parametrize("chain", MACHINES, ids=repr)
def test_long_chains_are_registered_and_identified(chain: Chain) -> None:
    truth = placed(chain, 5e-4)
    q, test = configurations(chain, 80, seed=1), configurations(chain, 200, seed=2)
    exact = register(replace(truth, base=torch.eye(4)), q, truth.points(q))
    torch.testing.assert_close(exact.geometry.base, truth.base, rtol=0, atol=1e-9)
    torch.testing.assert_close(exact.geometry.tool, truth.tool, rtol=0, atol=1e-9)

    start = register(chain, q, truth.points(q))
    found = identify(start.geometry, q, truth.points(q))
    assert start.rms > 5e-4
    assert found.status.startswith("converged")
    error = (found.geometry.points(test) - truth.points(test)).norm(dim=-1)
    assert float(error.max()) < 1e-6


def test_the_error_of_a_mimic_joint_is_found() -> None:
    chain = machine(11, mimic=True)
    assert "joint_4" in repr(chain).split("mimic joints: ")[1]
    truth = placed(chain, 0.0)
    theta = torch.zeros(truth.size, dtype=torch.float64)
    theta[truth.parameter_names.index("joint_4 tz [m]")] = 2e-3
    theta[truth.parameter_names.index("joint_4 rx [rad]")] = 3e-3
    truth = truth.absorb(theta)
    q, test = configurations(chain, 80, seed=1), configurations(chain, 200, seed=2)
    points = truth.points(q) + draw(80, 2, 3, seed=4, size=2e-5)
    start = register(chain, q, points).geometry
    found = identify(start, q, points)
    assert found.noise == pytest.approx(2e-5, rel=0.15)
    before, after = ((g.points(test) - truth.points(test)).norm(dim=-1) for g in (start, found.geometry))
    assert float(after.max()) < 1e-4 < float(before.mean())
