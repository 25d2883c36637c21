"""Noise of markers and of poses, and of new rows whose noise differs: by simulation, in units of the noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from scipy.stats import chi2
from simulated_camera import camera_arm
from tangent_bank import built, normal
from torch import Tensor

from diffeo_calib.calibration.choose_scales import robot_problem
from diffeo_calib.calibration.scales.noise_model import NoiseModel, differing_factor
from diffeo_calib.maps.noise import HIDDEN_VARIANCE
from diffeo_calib.measurements.poses import mark_jacobian, mark_points, pose_jacobian
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.regression.regions import region_factor

DRAWS = 20000


def poses(count: int, seed: int = 0) -> Tensor:
    """Frames in general position."""
    found = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    found[:, :3, :3] = turned(normal(count, 3, seed=seed))
    found[:, :3, 3] = normal(count, 3, seed=seed + 1)
    return found


def turned(vectors: Tensor) -> Tensor:
    x, y, z = vectors.unbind(1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, 1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.linalg.matrix_exp(torch.stack(rows, 1))


def pose_sensor(rows: int, slack: float = 2e-6) -> NoiseModel:
    return replace(NoiseModel.alike(rows, 1, 9), modes=mark_jacobian(poses(rows), LEVER)[:, None], slack=slack)


def covariances(rows: int, m: int, seed: int) -> Tensor:
    """Blocks of any kind that are positive definite."""
    root = normal(rows, m, m, seed=seed)
    return root @ root.mT + 0.1 * torch.eye(m, dtype=torch.float64)


def close_to_sample(actual: Tensor, draws: Tensor) -> None:
    """A covariance (m, m) against draws (count, m), in units of its own size."""
    sample = draws.mT @ draws / len(draws)
    scale = actual.diagonal().sqrt()
    difference = (actual - sample) / (scale[:, None] * scale)
    assert float(difference.abs().max()) < 5.0 / len(draws) ** 0.5


def test_covariance_of_markers_is_that_of_simulated_noise() -> None:
    """A tracker that errs and joints that do not repeat, through the robot itself."""
    pair, noise = built("two markers"), torch.linspace(2e-5, 2e-4, 6, dtype=torch.float64)
    scales = replace(pair.scales, joint_noise=noise, sensor_noise=torch.tensor(3e-5, dtype=torch.float64))
    data = pair.tangent_data
    q = data.x[:1]
    shaky = data.nominal(q + noise * normal(DRAWS, 6, seed=1), data.theta) + 3e-5 * normal(DRAWS, 6, seed=2)
    close_to_sample(data.noise(scales)[0], shaky - data.nominal(q, data.theta))


def test_covariance_of_poses_is_that_of_simulated_noise() -> None:
    """A frame that is shifted and turned as a whole; slack and joints are switched off."""
    framed: Any = built("posed")
    data, scales = framed.data, framed.scales
    shift, turn = 4e-5, 5e-4
    scales = replace(
        scales,
        sensor_noise=torch.tensor(shift, dtype=torch.float64),
        rotation_noise=torch.tensor(turn, dtype=torch.float64),
        joint_noise=torch.zeros(6, dtype=torch.float64),
    )
    moved = data.poses[:1].repeat(DRAWS, 1, 1)
    moved[:, :3, :3] = turned(turn * normal(DRAWS, 3, seed=3)) @ moved[:, :3, :3]
    moved[:, :3, 3] += shift * normal(DRAWS, 3, seed=4)
    draws = (mark_points(moved, data.lever) - mark_points(data.poses[:1], data.lever)).flatten(1)
    sensor = NoiseModel.of(data, 0.0).without_known
    close_to_sample(sensor.covariance(scales, framed.tangent_data.jacobian)[0], draws)


@pytest.mark.parametrize("markers", [1, 3])
def test_squares_of_markers(markers: int) -> None:
    """r_k^T R_kk^-1 r_k, every marker by itself."""
    sensor, m = NoiseModel.alike(4, markers), 3 * markers
    covariance, errors = covariances(4, m, seed=8), normal(4, m, seed=9)
    found = sensor.squares(covariance, errors[:, :, None] * errors[:, None])
    assert found.shape == (4, markers)
    for row in range(4):
        for k in range(markers):
            own = slice(3 * k, 3 * k + 3)
            r = errors[row, own]
            expected = float(r @ torch.linalg.inv(covariance[row, own, own]) @ r)
            assert float(found[row, k]) == pytest.approx(expected, rel=1e-10)


def test_squares_of_poses() -> None:
    """The shift and turn that fit the points' errors best, in units of their own covariance."""
    sensor = pose_sensor(4)
    covariance, errors = covariances(4, 9, seed=10), normal(4, 9, seed=11)
    found = sensor.squares(covariance, errors[:, :, None] * errors[:, None])
    assert found.shape == (4, 1)
    for row in range(4):
        modes = sensor.modes[row, 0]
        normal_matrix = modes.mT @ modes
        to_body = torch.linalg.solve(normal_matrix, modes.mT)
        twist = to_body @ errors[row]
        expected = float(twist @ torch.linalg.inv(to_body @ covariance[row] @ to_body.mT) @ twist)
        assert float(found[row, 0]) == pytest.approx(expected, rel=1e-9)


# --- new measurements where the noise differs from row to row ---------------------------------------------------------

INSIDE_95 = float(chi2.ppf(0.95, 3))
POSITION_STD, ROTATION_STD = 1e-4, 1e-3


def blocks(rows: int, coordinates: int, seed: int) -> Tensor:
    """Covariances of different sizes and directions."""
    root = normal(rows, coordinates, coordinates, seed=seed) * normal(rows, 1, coordinates, seed=seed + 1).square()
    return root @ root.mT + 1e-3 * torch.eye(coordinates, dtype=torch.float64)


def everywhere(covariance: Tensor) -> Tensor:
    return torch.ones(covariance.shape[:2], dtype=torch.bool)


def share(errors: Tensor, covariance: Tensor) -> float:
    """Share of errors (..., 3 P) whose markers lie in their 95 % regions."""
    inside = []
    for marker in range(len(covariance) // 3):
        own = slice(3 * marker, 3 * marker + 3)
        found = errors[..., own].reshape(-1, 3)
        squares = (found * torch.linalg.solve(covariance[own, own], found.mT).mT).sum(1)
        inside.append(float((squares < INSIDE_95).double().mean()))
    return sum(inside) / len(inside)


def test_regions_hold_95_percent_of_a_mixture() -> None:
    for seed in range(3):
        each = blocks(60, 6, 10 * seed)
        mean = each.mean(0)
        errors = (torch.linalg.cholesky(each)[:, None] @ normal(60, 2000, 6, seed=seed)[..., None])[..., 0]
        factor = differing_factor(each, mean, everywhere(each))
        assert share(errors, mean) < 0.93
        assert share(errors, factor * mean) == pytest.approx(0.95, abs=0.01)


def test_few_rows_of_large_noise_never_narrow_the_regions() -> None:
    each = torch.eye(3, dtype=torch.float64).repeat(100, 1, 1)
    each[0] *= 1e6
    assert differing_factor(each, each.mean(0), everywhere(each)) == pytest.approx(1.0, abs=1e-12)


def test_hidden_markers_do_not_count() -> None:
    each = blocks(30, 6, 3)
    seen = everywhere(each)
    seen[20:, :3] = seen[:10, 3:] = False
    hidden = torch.where(seen[:, :, None] & seen[:, None], each, HIDDEN_VARIANCE * torch.eye(6, dtype=torch.float64))
    other = torch.where(seen[:, :, None] & seen[:, None], each, torch.eye(6, dtype=torch.float64))
    mean = each.mean(0)
    assert differing_factor(hidden, mean, seen) == pytest.approx(differing_factor(other, mean, seen), rel=1e-12)


@pytest.mark.slow
def test_a_camera_s_poses_lie_in_the_regions_of_their_noise() -> None:
    """Errors of drawn poses of the board, turned into poses of the camera with its own formulas; ten of each."""
    seen = camera_arm(150, 2)
    seen = replace(seen, q=seen.q.repeat(10, 1), boards=seen.boards.repeat(10, 1, 1))
    data = seen.measured(POSITION_STD, ROTATION_STD)
    errors = (data.points - seen.arm.true_points(seen.q)).flatten(1)
    modes = pose_jacobian(data.frames, LEVER, data.board)[:, 0]
    deviations = torch.tensor([POSITION_STD] * 3 + [ROTATION_STD] * 3, dtype=torch.float64)
    each = modes * deviations.square() @ modes.mT
    mean = each.mean(0) + 1e-16 * torch.eye(9, dtype=torch.float64)
    factor = differing_factor(each, mean, everywhere(each))
    assert share(errors, mean) < 0.93
    assert share(errors, factor * mean) == pytest.approx(0.95, abs=0.01)


def test_new_noise_is_the_mean_and_what_differs() -> None:
    """Joint noise moves a marker by its lever arms; without it all rows err alike."""
    data, scales = built("two markers").tangent_data, built("two markers").scales
    each, mean = data.noise(scales), data.new_noise(scales)
    factor = differing_factor(each, mean, data.visible)
    assert factor > 1.001
    torch.testing.assert_close(robot_problem(data, scales).new_noise, factor * mean, rtol=1e-12, atol=0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
@pytest.mark.parametrize("name", ["several kinds", "laser beams", "inclinations"])
def test_coordinates_beside_readings_have_the_tails_of_all_rows(name: str) -> None:
    """Those of the geometric calibration, which it leaves large, would widen the noise of a position by a half."""
    noise, new = kind_named(name).model.map.noise, kind_named(name).model.map.new_noise
    whole = noise.visible.sum(1) == noise.visible.sum(1).max()
    size = int(noise.visible[whole][0].sum())
    measured = noise.covariance[whole][:, :size, :size].diagonal(dim1=1, dim2=2).mean()
    assert 0.9 < float(new[:size, :size].diagonal().mean() / measured) < 1.15


def test_rows_with_known_deviations_keep_their_own() -> None:
    """They are judged by these: the mean is too large for most, and too small for the rest."""
    plain, scales = built("two markers").tangent_data, built("two markers").scales
    each = blocks(*plain.y.shape, seed=8) * 1e-8
    data = replace(plain, noise_model=replace(plain.noise_model, known=each))
    wanted = data.noise(scales) * region_factor(data.tails.freedom, 3)
    torch.testing.assert_close(data.noise_of_new_rows(scales), wanted, rtol=1e-12, atol=0.0)
    found = plain.noise_of_new_rows(scales)
    torch.testing.assert_close(found, found[:1].expand_as(found))
