"""Noise of markers and of poses: covariances by simulation, weights, and distances in units of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from tangent_bank import Setting, body_modes, normal, posed, two_markers
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.scales.noise_model import SLACK_SHARE, SMALLEST_NOISE_M, NoiseModel
from diffeo_calib.measurements.poses import mark_jacobian, mark_points
from diffeo_calib.process.tails import Tails

LEVER = 0.15
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


def marker_sensor(rows: int, markers: int) -> NoiseModel:
    return NoiseModel(markers)


def pose_sensor(rows: int, slack: float = 2e-6) -> NoiseModel:
    return NoiseModel(1, 9, modes=mark_jacobian(poses(rows), LEVER)[:, None], slack=slack)


@pytest.fixture(scope="module")
def pair() -> Setting:
    return two_markers()


@pytest.fixture(scope="module")
def framed() -> Setting:
    return posed()


def covariances(rows: int, m: int, seed: int) -> Tensor:
    """Blocks of any kind that are positive definite."""
    root = normal(rows, m, m, seed=seed)
    return root @ root.mT + 0.1 * torch.eye(m, dtype=torch.float64)


# --- what kind of sensor ------------------------------------------------------------------------------------------


def test_sensor_of_markers(pair: Setting) -> None:
    sensor = NoiseModel.of(pair.data, 1e-4)
    assert (sensor.bodies, sensor.size, sensor.freedom) == (2, 3, 3)
    assert sensor.modes is None
    assert sensor.known is None


def test_sensor_of_poses(framed: Setting) -> None:
    sensor, data = NoiseModel.of(framed.data, 1e-5), framed.data
    assert (sensor.bodies, sensor.size, sensor.freedom) == (1, 9, 6)
    assert sensor.slack == pytest.approx(SLACK_SHARE * 1e-5)
    assert data.poses is not None
    assert data.lever is not None
    assert sensor.modes is not None
    assert_close(sensor.modes[:, 0], body_modes(data.poses, data.lever), rtol=1e-6, atol=1e-8)
    assert sensor.known is not None
    assert_close(sensor.known, data.covariance)


def test_rows_of_a_sensor(framed: Setting) -> None:
    sensor, rows = framed.tangent_data.noise_model, torch.tensor([4, 1])
    some = sensor.rows(rows)
    assert some.modes is not None
    assert some.known is not None
    assert sensor.modes is not None
    assert sensor.known is not None
    assert torch.equal(some.modes, sensor.modes[rows])
    assert torch.equal(some.known, sensor.known[rows])
    assert (some.slack, some.bodies) == (sensor.slack, sensor.bodies)
    assert NoiseModel(2).rows(rows) == NoiseModel(2)


# --- covariance ---------------------------------------------------------------------------------------------------


def close_to_sample(actual: Tensor, draws: Tensor) -> None:
    """A covariance (m, m) against draws (count, m), in units of its own size."""
    sample = draws.mT @ draws / len(draws)
    scale = actual.diagonal().sqrt()
    difference = (actual - sample) / (scale[:, None] * scale)
    assert float(difference.abs().max()) < 5.0 / len(draws) ** 0.5


def test_covariance_of_markers_is_that_of_simulated_noise(pair: Setting) -> None:
    """A tracker that errs and joints that do not repeat, through the robot itself."""
    noise = torch.linspace(2e-5, 2e-4, 6, dtype=torch.float64)
    scales = replace(pair.scales, joint_noise=noise, sensor_noise=torch.tensor(3e-5, dtype=torch.float64))
    data = pair.tangent_data
    q = data.x[:1]
    shaky = data.nominal(q + noise * normal(DRAWS, 6, seed=1), data.theta) + 3e-5 * normal(DRAWS, 6, seed=2)
    close_to_sample(data.noise(scales)[0], shaky - data.nominal(q, data.theta))


def test_covariance_of_poses_is_that_of_simulated_noise(framed: Setting) -> None:
    """A frame that is shifted and turned as a whole; slack and joints are switched off."""
    data, scales = framed.data, framed.scales
    assert data.poses is not None
    assert data.lever is not None
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
    sensor = replace(NoiseModel.of(data, 0.0), known=None)
    close_to_sample(sensor.covariance(scales, framed.tangent_data.jacobian)[0], draws)


def test_slack_and_finest_noise_are_those_of_single_points(framed: Setting) -> None:
    jacobian, eye = torch.zeros(12, 9, 6, dtype=torch.float64), torch.eye(9, dtype=torch.float64)
    nothing = torch.zeros((), dtype=torch.float64)
    scales = replace(framed.scales, sensor_noise=nothing, rotation_noise=nothing)
    sensor = replace(framed.tangent_data.noise_model, known=None, slack=3e-6)
    expected = (3e-6**2 + SMALLEST_NOISE_M**2) * eye
    assert_close(sensor.covariance(scales, jacobian), expected.expand(12, 9, 9), rtol=1e-12, atol=0)


@pytest.mark.parametrize("kind", ["pair", "framed"])
def test_known_covariance_is_added(kind: str, request: pytest.FixtureRequest) -> None:
    setting: Setting = request.getfixturevalue(kind)
    known = 1e-9 * covariances(*setting.tangent_data.y.shape, seed=5)
    jacobian = setting.tangent_data.jacobian
    without = replace(setting.tangent_data.noise_model, known=None).covariance(setting.scales, jacobian)
    with_it = replace(setting.tangent_data.noise_model, known=known).covariance(setting.scales, jacobian)
    assert_close(with_it - without, known, rtol=1e-9, atol=1e-20)


def test_known_covariance_of_measured_points_reaches_the_sensor(pair: Setting) -> None:
    std = torch.full((14, 2, 3), 5e-5, dtype=torch.float64)
    std[3, 1, 2] = 1e-3
    data = dc.Measurements(pair.data.q, pair.data.points, std=std)
    known = NoiseModel.of(data, 1e-4).known
    assert known is not None
    assert_close(known, torch.diag_embed(std.flatten(1).square()))


# --- weights ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sensor", "m"), [(marker_sensor(5, 3), 9), (marker_sensor(5, 1), 3), (pose_sensor(5), 9)])
def test_weights_divide_the_noise_of_their_body(sensor: NoiseModel, m: int) -> None:
    covariance = covariances(5, m, seed=6)
    weights = torch.from_numpy(np.random.default_rng(7).uniform(0.01, 2.0, (5, sensor.bodies)))
    found, each = sensor.weighted(covariance, Tails(3.0, weights)), m // sensor.bodies
    for row in range(5):
        for a in range(m):
            for b in range(m):
                factor = float(weights[row, a // each] * weights[row, b // each]) ** -0.5
                assert float(found[row, a, b]) == pytest.approx(factor * float(covariance[row, a, b]), rel=1e-12)
    assert_close(sensor.weighted(covariance, Tails.none(5, sensor.bodies)), covariance)
    root, other = (matrix.diagonal(dim1=1, dim2=2).sqrt() for matrix in (covariance, found))
    correlations = covariance / (root[:, :, None] * root[:, None])
    assert_close(found / (other[:, :, None] * other[:, None]), correlations)


# --- distances ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("markers", [1, 3])
def test_squares_of_markers(markers: int) -> None:
    """r_k^T R_kk^-1 r_k, every marker by itself."""
    sensor, m = NoiseModel(markers), 3 * markers
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
    assert sensor.modes is not None
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


def test_squares_of_a_pose_do_not_depend_on_its_lever() -> None:
    """Shift and turn are the same thing for near and far points."""
    frames, twist, found = poses(1), normal(6, seed=12), []
    sizes = torch.tensor([2.0, 2.0, 2.0, 0.3, 0.3, 0.3], dtype=torch.float64)
    for lever in (0.01, 0.1, 3.0):
        modes = mark_jacobian(frames, lever)
        sensor, error = NoiseModel(1, 9, modes=modes[:, None]), (modes @ twist)[0]
        covariance = (modes * sizes.square()) @ modes.mT + 1e-9 * torch.eye(9, dtype=torch.float64)
        found.append(float(sensor.squares(covariance, torch.outer(error, error)[None])))
    expected = float((twist / sizes).square().sum())
    assert found == pytest.approx([expected] * 3, rel=1e-4)


@pytest.mark.parametrize(("sensor", "m"), [(marker_sensor(5, 3), 9), (pose_sensor(5), 9)])
def test_squares_of_noise_itself_count_its_coordinates(sensor: NoiseModel, m: int) -> None:
    covariance = covariances(5, m, seed=13)
    expected = torch.full((5, sensor.bodies), float(sensor.freedom), dtype=torch.float64)
    assert_close(sensor.squares(covariance, covariance), expected)
    root = torch.linalg.cholesky(covariance[:1])
    draws = (root @ normal(4000, m, 1, seed=14))[:, :, 0]
    same = replace(sensor, modes=None if sensor.modes is None else sensor.modes[:1].expand(4000, -1, -1, -1))
    squares = same.squares(covariance[:1].expand(4000, -1, -1), draws[:, :, None] * draws[:, None])
    for body in range(sensor.bodies):
        share = float((squares[:, body] > float(chi2.isf(0.1, sensor.freedom))).double().mean())
        assert share == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize("residual", [1e-3, 1e-6])
def test_the_slack_drowns_no_known_error(residual: float) -> None:
    """Poses are as exact as their best direction says, however large the others, and the residuals, are."""
    frames, best = poses(20), 3e-6
    known = {"position_std": torch.tensor([best, 3e-4, 1e-3]).expand(20, 3), "rotation_std": 2e-3}
    q = normal(20, 2, seed=4)
    data = dc.Measurements.from_poses(q, frames, lever=LEVER, **known)  # pyright: ignore[reportArgumentType]
    found = NoiseModel.of(data, residual)
    finest = 3**0.5 * best
    assert found.slack == pytest.approx(min(SLACK_SHARE * residual, 0.3 * finest), rel=1e-3)
    assert found.slack**2 < 0.1 * finest**2  # a tenth of the finest variance
    free = NoiseModel.of(dc.Measurements.from_poses(q, frames, lever=LEVER), residual)
    assert free.slack == pytest.approx(SLACK_SHARE * residual)
    points = dc.Measurements(q, frames[:, None, :3, 3], std=best)
    assert NoiseModel.of(points, residual).slack == pytest.approx(SLACK_SHARE * residual)
