"""Geometric identification: parameters, noise, tails and prior, on simulated truth and on hardware."""

from math import inf

import pytest
import torch
from commanded_bank import flange
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.identification.identification import Prior, identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.robots import Geometry, SimulatedArm

ARM = SimulatedArm()


def draw(*shape: int, seed: int = 0, size: float = 1.0) -> Tensor:
    return size * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def rms(geometry: Geometry, q: Tensor, points: Tensor) -> float:
    return float((geometry.points(q) - points).square().sum(-1).mean().sqrt())


@pytest.mark.parametrize("markers", [1, 3])
def test_identification_recovers_a_rigid_arm(markers: int) -> None:
    arm = SimulatedArm(seed=1, markers=markers, transmission=0, gravity=0, noise=0)
    q, points = arm.measure(60)
    start = register(arm.nominal, q, points)
    found = identify(start.geometry, q, points)
    test = arm.sample(500, seed=9)
    assert start.rms > 5e-4
    assert rms(found.geometry, test, arm.true_points(test)) < 1e-7
    assert found.noise == pytest.approx(1e-6)  # no finer: noise-free data


def test_identification_estimates_the_noise_and_its_own_error() -> None:
    arm = SimulatedArm(seed=2, transmission=0, gravity=0, noise=5e-5)
    q, points = arm.measure(150)
    found = identify(register(arm.nominal, q, points).geometry, q, points)
    assert found.noise == pytest.approx(5e-5, rel=0.1)
    test = arm.sample(400, seed=9)
    slopes = found.geometry.sensitivities(test)
    spread = torch.einsum("npaj,jk,npak->npa", slopes, found.covariance, slopes).sqrt()
    ratio = (found.geometry.points(test) - arm.true_points(test)) / spread
    assert 0.6 < float(ratio.square().mean().sqrt()) < 1.5
    assert bool((found.deviations[6:42] <= Prior().rotation * (1 + 1e-9)).all())  # never vaguer than the prior
    assert found.tails.freedom > 20  # clean data have no tails
    assert found.tails.weights.shape == (150, 1)
    assert 0.5 < float(found.tails.weights.min()) <= float(found.tails.weights.max()) < 1.2


def test_outliers_lose_their_influence() -> None:
    arm = SimulatedArm(seed=2, markers=2, transmission=0, gravity=0, noise=2e-5)
    q, points = arm.measure(80)
    spoilt, bad = points.clone(), [3, 4, 40, 77]
    spoilt[bad, 1] += draw(4, 3, seed=1, size=1e-3)
    start, test = register(arm.nominal, q, points).geometry, arm.sample(300, seed=9)
    clean, found = identify(start, q, points), identify(start, q, spoilt)
    given = identify(start, q, spoilt, noise=2e-5)
    assert float(found.tails.weights[bad, 1].max()) < 0.05
    others = torch.ones(80, 2, dtype=torch.bool)
    others[bad, 1] = False
    assert float(found.tails.weights[others].min()) > 0.15
    assert found.noise == pytest.approx(clean.noise, rel=0.3)
    truth = arm.true_points(test)
    assert rms(found.geometry, test, truth) < 1.3 * rms(clean.geometry, test, truth)
    assert rms(given.geometry, test, truth) > 3 * rms(clean.geometry, test, truth)
    assert (given.noise, given.prior, given.tails.freedom) == (2e-5, Prior(), inf)
    assert bool((given.tails.weights == 1.0).all())


def test_deviations_of_translations_and_of_rotations_are_found_apart() -> None:
    q, start = ARM.sample(200), Geometry.nominal(ARM.nominal).with_tool(draw(2, 3, seed=1, size=0.1))
    theta = torch.zeros(start.size, dtype=torch.float64)
    theta[start.slices["joints"]] = (draw(6, 6, seed=2) * torch.tensor([1e-4] * 3 + [1e-3] * 3)).flatten()
    prior = identify(start, q, start.points(q, theta) + draw(200, 2, 3, seed=3, size=1e-5)).prior
    assert prior.rotation == pytest.approx(1e-3, rel=0.5)
    assert prior.translation < 4e-4  # it is still falling when the noise has settled


@pytest.mark.parametrize("axes", [3, 6])
def test_the_joints_of_commanded_poses_have_no_errors(axes: int) -> None:
    """They are numbers, not links: what is found is where base and marker are."""
    commanded = flange() if axes == 6 else flange()[:, :3, 3]
    machine = dc.cartesian(commanded)
    geometry = Geometry.nominal(machine).with_tool(torch.tensor([[0.1, 0.0, 0.05]], dtype=torch.float64))
    q = dc.pose_inputs(machine, commanded)
    found = identify(geometry, q, geometry.points(q) + draw(len(q), 1, 3, size=1e-3))
    joints = geometry.slices["joints"]
    assert float(found.theta[joints].abs().max()) == 0.0
    assert float(found.deviations[joints].max()) == 0.0
    assert float(found.deviations[geometry.slices["base"]].min()) > 1e-5
    first = register(machine, q, geometry.points(q)).geometry.tool
    assert_close(first, geometry.tool if axes == 6 else 0.0 * geometry.tool)  # where it sits is in the base
