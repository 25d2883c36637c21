"""Geometric identification: parameters, noise, tails and prior, on simulated truth and on hardware."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import pytest
import torch
from commanded_bank import flange
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.identification.identification import Prior, identify, solve
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.robots.se3 import rotation

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


def test_noise_of_few_poses_is_not_underestimated() -> None:
    # 105 coordinates, some 36 of them used up by parameters: the plain residual would say 0.04 mm.
    levels = []
    for seed in range(8):
        arm = SimulatedArm(seed=seed, transmission=0, gravity=0, noise=5e-5)
        q, points = arm.measure(35, seed)
        levels.append(identify(register(arm.nominal, q, points).geometry, q, points).noise)
    assert sum(levels) / len(levels) == pytest.approx(5e-5, rel=0.07)


@pytest.mark.parametrize("size", [1e-3, 5e-2])
def test_outliers_lose_their_influence(size: float) -> None:
    arm = SimulatedArm(seed=2, markers=2, transmission=0, gravity=0, noise=2e-5)
    q, points = arm.measure(80)
    spoilt, bad = points.clone(), [3, 4, 40, 77]
    spoilt[bad, 1] += draw(4, 3, seed=1) * size
    start, test = register(arm.nominal, q, points).geometry, arm.sample(300, seed=9)
    clean, found = identify(start, q, points), identify(start, q, spoilt)
    wrong = identify(start, q, spoilt, noise=2e-5)
    assert float(found.tails.weights[bad, 1].max()) < 0.05
    others = torch.ones(80, 2, dtype=torch.bool)
    others[bad, 1] = False
    assert float(found.tails.weights[others].min()) > 0.15
    assert found.tails.freedom < 10
    assert found.noise == pytest.approx(clean.noise, rel=0.3)
    truth = arm.true_points(test)
    assert rms(found.geometry, test, truth) < 1.3 * rms(clean.geometry, test, truth)
    assert rms(wrong.geometry, test, truth) > 3 * rms(clean.geometry, test, truth)


def test_left_out_points_are_predicted_by_the_others() -> None:
    """In closed form as by leaving every row out."""
    arm = SimulatedArm(seed=2, transmission=0, gravity=0, noise=5e-5)
    q, points = arm.measure(25)
    start, squares = register(arm.nominal, q, points).geometry, []
    found = identify(start, q, points)
    for row in range(25):
        others = torch.arange(25) != row
        alone = identify(start, q[others], points[others], found.noise, found.prior).geometry
        squares.append(float((alone.points(q[row : row + 1]) - points[row]).square().sum()))
    assert found.left_out == pytest.approx((sum(squares) / 25) ** 0.5, rel=0.1)
    assert found.left_out > 1.5 * found.rms


def test_scales_of_the_joint_errors_are_found() -> None:
    """Translations and rotations apart: one arm of each kind."""
    arm = SimulatedArm(seed=3, transmission=0, gravity=0, noise=1e-5)
    q = arm.sample(200)
    start = replace(Geometry.nominal(arm.nominal, 2), tool=draw(2, 3, seed=1, size=0.1))
    for translation, rotation_size in ((1e-3, 1e-4), (1e-4, 1e-3)):
        theta = torch.zeros(start.size, dtype=torch.float64)
        twists = draw(6, 6, seed=2) * torch.tensor([translation] * 3 + [rotation_size] * 3, dtype=torch.float64)
        theta[start.slices["joints"]] = twists.flatten()
        points = start.points(q, theta) + draw(200, 2, 3, seed=3, size=1e-5)
        prior = identify(start, q, points).prior
        larger, smaller = sorted((prior.translation, prior.rotation), reverse=True)
        assert larger == pytest.approx(1e-3, rel=0.5)
        assert smaller < 4e-4  # the smaller one is still falling when the noise has settled
        assert (prior.translation > prior.rotation) == (translation > rotation_size)


class Ahead:
    """One row with one unknown c, from c = 0.9 on nothing can be measured, such as behind a camera."""

    freedom = (1,)

    def errors(self, theta: Tensor, c: Tensor) -> list[Tensor]:
        if float(c[0]) > 0.9:
            raise InputError("behind the camera")
        return [100 * (1 / (1 - c) - 2).view(1, 1, 1)]

    def slopes(self, theta: Tensor, c: Tensor, root: Tensor) -> list[Tensor]:
        return [100 / (1 - c).square().view(1, 1, 1, 1)]


def test_a_step_to_where_nothing_can_be_measured_is_shortened() -> None:
    """The first step of Gauss-Newton leads to c = 1."""
    rows: Any = Ahead()
    one, none = torch.ones(1, 1, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
    found = solve(rows, one[0], none)
    assert float(found.shifts[0]) == pytest.approx(0.5, abs=1e-4)
    with pytest.raises(InputError, match="behind"):
        solve(rows, one[0], none, start=(one[0], one[0]))


def test_what_is_given_stays() -> None:
    q, points = ARM.measure(40)
    start, given = register(ARM.nominal, q, points).geometry, Prior(translation=2e-3, rotation=3e-4)
    assert identify(start, q, points, prior=given).prior == given
    found = identify(start, q, points, noise=3e-4)
    assert found.prior == Prior()
    assert found.noise == pytest.approx(3e-4)
    assert torch.equal(found.tails.weights, torch.ones(40, 1, dtype=torch.float64))
    assert found.tails.freedom == inf


def test_identification_is_the_maximum_a_posteriori() -> None:
    q, points = ARM.measure(50)
    start, noise = register(ARM.nominal, q, points).geometry, 3e-4
    found = identify(start, q, points, noise=noise)
    scale = Prior().deviations(start)
    # theta by least squares from the absorbed geometry back to the start is not unique: test the objective instead
    best = objective(start, found.geometry, q, points, noise)
    for seed in range(20):
        theta = scale * draw(start.size, seed=seed, size=1e-3)
        assert objective(start, found.geometry.absorb(theta), q, points, noise) > best


def objective(start: Geometry, geometry: Geometry, q: Tensor, points: Tensor, noise: float) -> float:
    errors = torch.linalg.solve(start.joint_errors, geometry.joint_errors)
    twists = torch.cat([errors[:, :3, 3], rotation_vectors(errors[:, :3, :3])], dim=1)
    return float(
        (geometry.points(q) - points).square().sum() / noise**2 + twists.square().sum() / Prior().rotation ** 2
    )


def rotation_vectors(matrices: Tensor) -> Tensor:
    half = (matrices - matrices.mT) / 2  # the angles are milliradians
    w = torch.stack([half[:, 2, 1], half[:, 0, 2], half[:, 1, 0]], dim=1)
    torch.testing.assert_close(rotation(w), matrices, rtol=0, atol=1e-6)
    return w


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
