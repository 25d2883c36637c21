"""Scales of any problem by marginal likelihood."""

import pytest
import torch
from math_bank import normal, uniform
from torch import Tensor
from torch.func import jacrev, vmap

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.scales import SPREAD
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.robots import elastic_rr

SIGMA = 0.01
X = uniform(100, 2, seed=3)
Y = elastic_rr.real(X) + SIGMA * normal(100, 2, seed=4)


def arm(concentration: float = 0.1, variance: float = 1.0, length: float = 2.0, noise: float = 0.03) -> dc.Problem:
    K_V = dc.VonMises(concentration=(concentration,) * 2, variance=variance)
    K_W = dc.Gaussian(length) + dc.Matern(length, variance=0.0)
    return dc.Problem(elastic_rr.nominal, X, Y, joint_kernel=K_V, task_kernel=K_W, noise=noise)


def density(problem: dc.Problem, given: dc.Problem, logs: Tensor) -> float:
    """Log posterior density of factors exp(logs) on the scales given, by matrices of pairs and torch.distributions."""
    J = vmap(jacrev(lambda q: elastic_rr.nominal(q[None])[0]))(X)
    z, spec = elastic_rr.nominal(X), problem.spec
    G = torch.einsum("iab,ijbc,jdc->iajd", J, blocks(spec.joint_kernel, X), J).reshape(200, 200)
    G = (
        G
        + blocks(spec.task_kernel, z).permute(0, 2, 1, 3).reshape(200, 200)
        + torch.block_diag(*problem.noise.covariance)
    )
    likelihood = torch.distributions.MultivariateNormal(torch.zeros(200, dtype=G.dtype), G).log_prob((Y - z).flatten())
    return float(likelihood - 0.5 * (logs / SPREAD).square().sum())


def blocks(kernel: dc.Kernel, x: Tensor) -> Tensor:
    """(N, N, n, n)."""
    return kernel.matrix(x, x).view(len(x), x.shape[1], len(x), x.shape[1]).permute(0, 2, 1, 3)


def scales_of(problem: dc.Problem) -> Tensor:
    """Logarithms of length scales, amplitudes and noise."""
    K_V, K_W = problem.spec.joint_kernel, problem.spec.task_kernel.terms[0]
    parts = [part for K in (K_V, K_W) for part in (K.lengthscale.view(-1), K.variance.view(-1).sqrt())]  # pyright: ignore
    return torch.cat([*parts, problem.noise.covariance[0, 0, :1].sqrt()]).log()


def test_scales_do_not_depend_on_those_given_and_serve_the_fit() -> None:
    found = [dc.choose_scales(arm(*own)) for own in ((0.1, 1.0, 2.0), (10.0, 0.1, 0.3, 0.003))]
    new = uniform(300, 2, seed=5)
    given, *after = (
        float((dc.fit(own).model(new) - elastic_rr.real(new)).norm(dim=1).mean()) for own in (arm(), *found)
    )
    assert after == pytest.approx([after[0]] * 2, rel=0.05)
    assert after[0] < 0.3 * given
    for own in found:
        assert float(scales_of(own)[-1].exp()) == pytest.approx(SIGMA, rel=0.2)


def test_chosen_scales_are_the_likeliest() -> None:
    given = arm()
    found = dc.choose_scales(given)
    start, logs = scales_of(given), scales_of(found) - scales_of(given)
    best = density(found, given, logs)
    for number in range(len(start)):
        for step in (-0.05, 0.05):
            moved = torch.zeros_like(logs).index_fill(0, torch.tensor(number), step)
            joint, task, noise = moved.split([3, 2, 1])
            spec = found.spec
            other = dc.Problem(
                elastic_rr.nominal,
                X,
                Y,
                joint_kernel=spec.joint_kernel.rescaled(joint),
                task_kernel=spec.task_kernel.rescaled(torch.cat([task, torch.zeros(2, dtype=task.dtype)])),
                noise=float(found.noise.covariance[0, 0, 0].sqrt() * noise.exp()),
            )
            assert density(other, given, logs + moved) < best + 1e-4


def test_hidden_coordinates_stay_hidden() -> None:
    given = arm()
    gone = torch.zeros(100, 2, dtype=torch.bool).index_fill(0, torch.arange(0, 100, 7), True) & torch.tensor(
        [True, False]
    )
    noise = Noise(without_hidden(given.noise.covariance, ~gone))
    kernels = {"joint_kernel": given.spec.joint_kernel, "task_kernel": given.spec.task_kernel}
    odd, even = (
        dc.choose_scales(dc.Problem(elastic_rr.nominal, X, torch.where(gone, Y + off, Y), noise=noise, **kernels))
        for off in (0.0, 5.0)
    )
    torch.testing.assert_close(odd.noise.covariance, even.noise.covariance, rtol=0.02, atol=0)
    assert torch.equal(odd.noise.visible, ~gone)


def test_what_is_not_chosen_stays() -> None:
    found = dc.choose_scales(arm())
    assert float(found.spec.task_kernel.terms[1].variance) == 0.0  # pyright: ignore[reportAttributeAccessIssue]
    assert found.x is X or torch.equal(found.x, X)
    with pytest.raises(InputError, match=r"`problem`: expected a dc.Problem, got Tensor"):
        dc.choose_scales(X)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="`iterations`"):
        dc.choose_scales(arm(), iterations=0)
    with pytest.raises(InputError, match="expected all data as control points, got 5 controls"):
        dc.choose_scales(arm().with_controls(X[:5]))
    twice, kernels = [torch.cat([own, own]) for own in (X, Y)], (found.spec.joint_kernel, found.spec.task_kernel)
    exact = dc.Problem(elastic_rr.nominal, *twice, joint_kernel=kernels[0], task_kernel=kernels[1], noise=1e-30)
    with pytest.raises(NumericalError, match="raise `noise`"):
        dc.choose_scales(exact)
