"""Scales of any problem by marginal likelihood."""

from functools import cache

import pytest
import torch
from fit_bank import Offset
from math_bank import normal, uniform
from table_bank import refused
from torch import Tensor
from torch.func import jacrev, vmap

import diffeo_calib as dc
from diffeo_calib.fitting import scales
from diffeo_calib.fitting.scales import SPREAD
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.maps.observation import ReadPoints
from diffeo_calib.robots import elastic_rr

SIGMA, ROWS = 0.01, 60
X = uniform(ROWS, 2, seed=3)
Y = elastic_rr.real(X) + SIGMA * normal(ROWS, 2, seed=4)


def arm(concentration: float = 0.1, variance: float = 1.0, length: float = 2.0, noise: float = 0.03) -> dc.Problem:
    K_V = dc.VonMises(concentration=(concentration,) * 2, variance=variance)
    K_W = dc.Gaussian(length) + dc.Matern(length, variance=0.0)
    return dc.Problem(elastic_rr.nominal, X, Y, joint_kernel=K_V, task_kernel=K_W, noise=noise)


@cache
def chosen() -> dc.Problem:
    return dc.choose_scales(arm())


def density(problem: dc.Problem, logs: Tensor) -> float:
    """Log posterior density of factors exp(logs) on the scales given, by matrices of pairs and torch.distributions."""
    J, size = vmap(jacrev(lambda q: elastic_rr.nominal(q[None])[0]))(X), 2 * ROWS
    z, spec = elastic_rr.nominal(X), problem.spec
    G = torch.einsum("iab,ibjc,jdc->iajd", J, spec.joint_kernel.matrix(X, X).view(ROWS, 2, ROWS, 2), J)
    G = G.reshape(size, size) + spec.task_kernel.matrix(z, z) + torch.block_diag(*problem.noise.covariance)
    likelihood = torch.distributions.MultivariateNormal(torch.zeros(size, dtype=G.dtype), G).log_prob((Y - z).flatten())
    return float(likelihood - 0.5 * (logs / SPREAD).square().sum())


def scales_of(problem: dc.Problem) -> Tensor:
    """Logarithms of length scales, amplitudes and noise."""
    K_V, K_W = problem.spec.joint_kernel, problem.spec.task_kernel.terms[0]
    parts = [part for K in (K_V, K_W) for part in (K.lengthscale.view(-1), K.variance.view(-1).sqrt())]  # pyright: ignore
    return torch.cat([*parts, problem.noise.covariance[0, 0, :1].sqrt()]).log()


def test_scales_do_not_depend_on_those_given_and_serve_the_fit() -> None:
    other, new = dc.choose_scales(arm(10.0, 0.1, 0.3, 0.003)), uniform(300, 2, seed=5)
    given, one, two = (
        float((dc.fit(own, integrator=dc.RK4(2)).model(new) - elastic_rr.real(new)).norm(dim=1).mean())
        for own in (arm(), chosen(), other)
    )
    assert one == pytest.approx(two, rel=0.05)
    assert one < 0.3 * given
    for own in (chosen(), other):
        assert float(scales_of(own)[-1].exp()) == pytest.approx(SIGMA, rel=0.2)


def test_chosen_scales_are_the_likeliest() -> None:
    spec, noise = chosen().spec, chosen().noise.covariance[0, 0, 0].sqrt()
    logs = scales_of(chosen()) - scales_of(arm())
    best = density(chosen(), logs)
    for number in range(len(logs)):
        for step in (-0.05, 0.05):
            moved = torch.zeros_like(logs).index_fill(0, torch.tensor(number), step)
            joint, task, wider = moved.split([3, 2, 1])
            kernels = {
                "joint_kernel": spec.joint_kernel.rescaled(joint),
                "task_kernel": spec.task_kernel.rescaled(torch.nn.functional.pad(task, (0, 2))),
            }
            other = dc.Problem(elastic_rr.nominal, X, Y, noise=float(noise * wider.exp()), **kernels)
            assert density(other, logs + moved) < best + 1e-4


def test_hidden_coordinates_stay_hidden() -> None:
    given = arm()
    gone = (torch.arange(ROWS) % 7 == 0)[:, None] & torch.tensor([True, False])
    noise = Noise(without_hidden(given.noise.covariance, ~gone))
    kernels = {"joint_kernel": given.spec.joint_kernel, "task_kernel": given.spec.task_kernel}
    odd, even = (
        dc.choose_scales(dc.Problem(elastic_rr.nominal, X, torch.where(gone, Y + off, Y), noise=noise, **kernels))
        for off in (0.0, 5.0)
    )
    torch.testing.assert_close(odd.noise.covariance, even.noise.covariance, rtol=0.02, atol=0)
    assert torch.equal(odd.noise.visible, ~gone)


@pytest.mark.parametrize("numbers", [1500, 2 * ROWS])
def test_gross_rows_are_named_and_hardly_followed(numbers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # Plain scales take 2 of 60 errors of 20 sigma for noise, so that no left-out error looks gross beside it.
    monkeypatch.setattr(scales, "NUMBERS", numbers)
    gross, new = torch.isin(torch.arange(2 * ROWS), torch.tensor([3, 40, 77])), uniform(300, 2, seed=5)
    x = torch.cat([X, uniform(ROWS, 2, seed=6)])
    y = elastic_rr.real(x) + SIGMA * normal(2 * ROWS, 2, seed=7) + 20 * SIGMA * gross[:, None]
    given = arm()
    kernels = {"joint_kernel": given.spec.joint_kernel, "task_kernel": given.spec.task_kernel, "noise": 0.03}
    problem = dc.Problem(elastic_rr.nominal, x, y, **kernels)
    with pytest.warns(dc.DiffeoCalibWarning, match="errors of rows 3, 40, 77 are gross"):
        robust = dc.choose_scales(problem, robust=True)
    plain, clean = dc.choose_scales(problem), dc.Problem(elastic_rr.nominal, x[~gross], y[~gross], **kernels)
    clean = dc.choose_scales(clean, robust=True)  # in which no row is gross
    wrong, right, best = (
        float((dc.fit(own).model(new) - elastic_rr.real(new)).norm(dim=1).mean()) for own in (plain, robust, clean)
    )
    assert right < 0.6 * wrong
    assert right == pytest.approx(best, rel=0.1)
    assert float(robust.noise.covariance[gross, 0, 0].min()) > (5 * SIGMA) ** 2
    assert robust.new_noise is not None
    assert float(robust.new_noise[0, 0].sqrt()) == pytest.approx(SIGMA, rel=0.2)


def test_what_is_not_chosen_stays_and_what_is_refused() -> None:
    assert float(chosen().spec.task_kernel.terms[1].variance) == 0.0  # pyright: ignore[reportAttributeAccessIssue]
    assert torch.equal(chosen().x, X)
    twice, spec = [torch.cat([own, own]) for own in (X, Y)], chosen().spec
    kernels = {"joint_kernel": spec.joint_kernel, "task_kernel": spec.task_kernel}
    exact = dc.Problem(elastic_rr.nominal, *twice, noise=1e-30, **kernels)
    refused(
        (r"`problem`: expected a dc.Problem, got Tensor", lambda: dc.choose_scales(X)),  # pyright: ignore[reportArgumentType]
        ("`iterations`", lambda: dc.choose_scales(arm(), iterations=0)),
        ("expected all data as control points, got 5 controls", lambda: dc.choose_scales(arm().with_controls(X[:5]))),
        ("raise `noise`", lambda: dc.choose_scales(exact)),
    )


@pytest.mark.parametrize("measured", ["positions", "distances"])
def test_gradients_of_a_fit_are_those_of_other_fits(measured: str) -> None:
    """By y, the prior, the noise and every scale, against central differences of losses after new fits."""
    x, new = X[:12], uniform(5, 2, seed=8)
    observe = (
        None
        if measured == "positions"
        else ReadPoints(lambda a, p: (p - a).norm()[None], 2.0 + uniform(12, 2, seed=9), 2)
    )
    points = elastic_rr.real(x) + 0.1
    kernels = {"joint_kernel": dc.Gaussian(1.0, variance=0.02), "task_kernel": dc.Gaussian((0.7, 0.9), variance=0.01)}
    y = points if observe is None else observe.value(points)
    problem = dc.Problem(Offset(), x, y, noise=0.02, prior_variance=torch.full((2,), 0.01), observe=observe, **kernels)
    solver, steps = dc.GaussNewton(tolerance=1e-13, max_iterations=100), dc.RK4(2)
    fit = dc.fit(problem, solver, steps)

    def loss(values: Tensor) -> Tensor:
        return (values - elastic_rr.real(new)).square().sum()

    def other(changed: dc.Problem) -> float:
        return float(loss(dc.fit(changed, solver, steps).model(new)))

    found, small = fit.gradients(new, loss), 1e-4
    by_scales = torch.cat([found.prior[None], found.noise[None], found.joint_kernel, found.task_kernel])
    for gradient, changed in (
        (by_scales, lambda step: scales.rescaled(problem, step)),
        (found.y.flatten(), lambda step: problem._with(y=y + step.view_as(y))),
    ):
        steps_of = small * torch.eye(len(gradient), dtype=y.dtype)[:8]
        differences = [(other(changed(step)) - other(changed(-step))) / (2 * small) for step in steps_of]
        size = float(gradient.abs().max())
        torch.testing.assert_close(gradient[:8], y.new_tensor(differences), rtol=1e-4, atol=1e-5 * size)
    coarse = dc.fit(problem, integrator=steps, controls=5)
    refused(
        ("the fit: expected a converged one", lambda: coarse.gradients(new, loss)),
        ("`loss`: expected a differentiable scalar", lambda: fit.gradients(new, lambda values: values)),
    )
