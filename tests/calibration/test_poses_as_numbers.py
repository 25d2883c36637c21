"""A measured pose tells six numbers: regressions have these in place of nine coordinates of its three points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tangent_bank import Setting, built, noise_covariance, normal, tangent_covariance
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.calibration.choose_scales import robot_problem
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.kinematics.nominal import rigid_motions
from diffeo_calib.measurements.poses import mark_jacobian

OPEN_M = 1e-3
"""Noise of what bends the points of a pose, that tells nothing: a thousand times what the fields bend."""


@pytest.fixture(scope="module")
def posed() -> Setting:
    return built("posed")


def naive(setting: Setting, data: TangentData) -> tuple[Tensor, Tensor]:
    """G and R of nine coordinates a pose, of which motions that bend its points are hardly known: (9 N, 9 N) each."""
    frames = setting.data.frames
    assert frames is not None
    moves = mark_jacobian(frames[:, 0], setting.data.bodies.pose_lever())  # (N, 9, 6)
    bent = torch.eye(9, dtype=torch.float64) - moves @ torch.linalg.pinv(moves)
    R = noise_covariance(setting.scales, setting, data.theta, data.tails.weights) + OPEN_M**2 * bent
    G = tangent_covariance(setting.scales, data.told.nominal, data.theta, data.x)
    return G, torch.block_diag(*R)


def test_six_numbers_say_what_nine_coordinates_do(posed: Setting) -> None:
    """Mean and covariance of k1 at the rows, by numpy with nine coordinates a pose."""
    data = replace(posed.tangent_data, y=posed.tangent_data.y + 1e-5 * normal(12, 9, seed=3))
    G, R = naive(posed, data)
    nominal, S = data.told.nominal, data.told.nominal.sensitivities(data.x, data.theta)
    target = (data.y - nominal(data.x, data.theta) + S @ data.theta).flatten()
    solved = np.linalg.solve((G + R).numpy(), np.column_stack([target.numpy(), G.numpy()]))
    mean, covariance = (torch.from_numpy(G.numpy() @ part) for part in (solved[:, 0], solved[:, 1:]))

    told, at = data.told, data.told.linearisation(posed.scales)
    basis = torch.block_diag(*data.basis) if data.basis is not None else torch.eye(len(target), dtype=torch.float64)
    process, gram = told.process(posed.scales), at.gram()
    found = gram @ process.mu
    assert_close(found, basis.T @ mean, rtol=0, atol=1e-4 * float(mean.abs().max()))
    left = process.expected(told.numbers).covariance
    assert_close(left, gram - basis.T @ covariance @ basis, rtol=0, atol=1e-3 * float(left.abs().max()))


def test_the_fit_of_six_numbers_is_that_of_nine(posed: Setting) -> None:
    """Nine coordinates keep the points rigid by the slack, which is worth a small part of the noise of a pose."""
    data, scales = posed.tangent_data, posed.scales
    problem = robot_problem(data, scales)
    assert problem.whole is not None
    maps = [fit(each, GaussNewton(tolerance=1e-6)).model for each in (problem, problem.whole)]
    x = data.x + 0.3
    (six, covariance), (nine, _) = (each.predict(x, noise=False) for each in maps)
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert float((six - nine).abs().max() / deviation.mean()) < 0.05
    assert maps[0].slopes is None
    assert maps[0].noise.covariance.shape == (12, 9, 9)


def test_nothing_bends_the_tool(posed: Setting) -> None:
    model = fit(robot_problem(posed.tangent_data, posed.scales), GaussNewton(tolerance=1e-6)).model
    geometry = posed.nominal.geometry
    tool = geometry.tool + model.deformation.momenta.theta[geometry.slices["tool"]].view(-1, 3)
    before, after = (torch.pdist(points) for points in (geometry.tool, tool))
    assert_close(after, before, rtol=1e-6, atol=0)


def test_rows_and_weights_are_those_of_the_numbers(posed: Setting) -> None:
    data, rows = posed.tangent_data, torch.tensor([3, 1, 8])
    told = data.told
    assert told.told is told
    assert told.y.shape == (12, 6)
    assert_close(data.rows(rows).told.target, told.rows(rows).target)
    motion = mark_jacobian(posed.data.frames[:, 0], posed.data.bodies.pose_lever()) @ normal(12, 6, 1, seed=1)  # pyright: ignore[reportOptionalSubscript]
    assert_close(data.in_coordinates(data.in_numbers(motion[..., 0])), motion[..., 0])
    markers = built("two markers").tangent_data
    assert markers.told is markers
    assert markers.in_numbers(markers.y) is markers.y


def test_what_bends_a_pose_is_no_turn_of_it(posed: Setting) -> None:
    """However far the measured pose is turned against that of k0: else a column has the error of its own row in it."""
    data = posed.tangent_data
    rigid = rigid_motions(data.points)
    bent = torch.eye(9, dtype=torch.float64) - (rigid @ rigid.mT)[:, 0]
    assert data.basis is not None
    assert float((data.basis.mT @ bent).abs().max()) > 1e-6
    assert float(data.motions_in_numbers(bent).abs().max()) < 1e-12
    assert_close(data.motions_in_numbers(rigid[:, 0]), data.basis.mT @ rigid[:, 0])
