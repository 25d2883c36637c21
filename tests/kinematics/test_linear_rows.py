"""Linearised rows of a new set-up: the Gaussian that they are, with explicit matrices."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

from diffeo_calib.kinematics.re_registration.linear_rows import LinearRows

M, R, K = 6, 3, 4
DRAWS = torch.Generator().manual_seed(0)


def normal(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=DRAWS, dtype=torch.float64)


def rows() -> LinearRows:
    shapes, noise, prior = normal(M * R, 5), normal(M, R, R + 2), normal(K, K + 2)
    visible = torch.ones(M, R, dtype=torch.bool)
    given = normal(M, R), normal(M, R, K), shapes @ shapes.T, noise @ noise.mT, visible, prior @ prior.T, normal(K)
    return LinearRows(*given, by_fit=torch.zeros(K, K, dtype=torch.float64))


def test_evidence_and_left_out_errors_are_those_of_the_whole_covariance() -> None:
    one = rows()
    covariance = one.C + torch.block_diag(*one.noise) + one.slopes @ one.prior @ one.slopes.T
    density = MultivariateNormal(one.slopes @ one.mean, covariance)
    assert_close(one.log_evidence(), float(density.log_prob(one.residual.flatten())))
    for row in range(M):
        own = torch.arange(M * R) // R == row
        gain = covariance[own][:, ~own] @ torch.linalg.inv(covariance[~own][:, ~own])
        assert_close(one.left_out[row], one.target[own] - gain @ one.target[~own])
        assert_close(torch.linalg.inv(one.precisions[row]), (covariance[own] - gain @ covariance[~own])[:, own])


def test_places_are_those_of_the_noise_alone_and_their_covariance_is_that_of_all_errors() -> None:
    """Without errors of the model it is the posterior of a linear Gaussian; with them their effect is added."""
    one = rows()
    precision = torch.block_diag(*torch.linalg.inv(one.noise))
    posterior = torch.linalg.inv(torch.linalg.inv(one.prior) + one.slopes.T @ precision @ one.slopes)
    pull = torch.linalg.solve(one.prior, one.mean) + one.slopes.T @ precision @ one.residual.flatten()
    assert_close(one.step, posterior @ pull)
    assert_close(one.covariance, posterior + one.gain @ one.C @ one.gain.T)
    left = one.residual.flatten() - one.slopes @ one.step
    assert_close(one.after_placing @ one.target, left)
