"""The energy (16), its certificates, functionals of k1 as measurements, and the input that problems refuse."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fit_bank import Offset, deformed, noise_blocks
from math_bank import K_V, K_W, circle, normal, planar_two_markers, rr_problem, tensor, two_marker_problem, uniform
from section_5 import section_5
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.problem import Problem, tangent
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.maps.observation import LinearFunctionals, Observation, ReadPoints
from diffeo_calib.regression.conditional import Process
from diffeo_calib.robots import elastic_rr


def offset_problem() -> Problem:
    x = uniform(10, 2, seed=3)
    return Problem(
        Offset(), x, elastic_rr.real(x), joint_kernel=K_V, task_kernel=K_W, noise=0.01, prior_variance=[0.2, 0.5]
    )


PROBLEMS = {
    "rr": rr_problem(4),
    "two markers": two_marker_problem(uniform(12, 2, seed=3)),
    "noise blocks": two_marker_problem(uniform(12, 2, seed=3), noise_blocks(12, 4)),
    "parameters": offset_problem(),
}
every_problem = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS.keys())


@every_problem
def test_energy_parts(problem: Problem) -> None:
    """(16) with every sum written out."""
    deformation = deformed(problem)
    b, p, theta = deformation.momenta.tensors
    parts = problem.energy(deformation)
    z0 = problem.spec.nominal(deformation.joint_flow(problem.x), theta).reshape(p.shape)
    field_x = sum(
        float(b[i] @ problem.spec.joint_kernel.matrix(problem.x[[i]], problem.x[[j]]) @ b[j])
        for i in range(len(b))
        for j in range(len(b))
    )
    field_y = float(p.flatten() @ problem.spec.task_kernel.matrix(z0, z0) @ p.flatten())
    data = 0.0
    for i, r in enumerate(deformation(problem.x) - problem.y):
        data += float(r @ torch.linalg.inv(problem.noise.covariance[i]) @ r)
    prior = float((theta * theta / problem.spec.prior_variance).sum())
    assert float(parts.field_x) == pytest.approx(field_x / 2, rel=1e-11)
    assert float(parts.field_y) == pytest.approx(field_y / 2, rel=1e-11)
    assert float(parts.data) == pytest.approx(data / 2, rel=1e-10)
    assert float(parts.prior) == pytest.approx(prior / 2, rel=1e-13)
    assert float(parts.total) == pytest.approx((field_x + field_y + data + prior) / 2, rel=1e-10)


@every_problem
def test_gradient_of_the_energy(problem: Problem) -> None:
    vector = deformed(problem).momenta.flatten()
    direction = normal(len(vector), seed=13)

    def total(at: Tensor) -> Tensor:
        return problem.energy(problem.deform(problem.zero().unflatten(at), RK4(2))).total

    live = vector.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(live), live)
    eps = 1e-4
    plus, minus, plus2, minus2 = (total(vector + k * eps * direction) for k in (1, -1, 2, -2))
    difference = (8 * (plus - minus) - (plus2 - minus2)) / (12 * eps)
    torch.testing.assert_close(gradient @ direction, difference, rtol=1e-7, atol=0)


@every_problem
def test_residuals_by_their_definitions(problem: Problem) -> None:
    deformation = deformed(problem)
    jacobian = problem.spec.nominal.jacobian(deformation.xi, deformation.momenta.theta)
    b_end, p_end = deformation.joint_flow.end[1], deformation.task_flow.end[1].reshape(problem.y.shape)
    p = deformation.momenta.task.reshape(problem.y.shape)
    gap = torch.stack([b_end[i] - jacobian[i].T @ p[i] for i in range(len(p))])
    assert problem.coupling_residual(deformation) == pytest.approx(float(gap.norm() / b_end.norm()), rel=1e-12)
    covariance, error = problem.noise.covariance, problem.y - deformation.z1
    gap = p_end - torch.stack([torch.linalg.solve(c, r) for c, r in zip(covariance, error, strict=True)])
    assert problem.end_residual(deformation) == pytest.approx(float(gap.norm() / p_end.norm()), rel=1e-10)


@every_problem
def test_the_tangent_model_is_written_out_and_the_first_gauss_newton_iterate(problem: Problem) -> None:
    """Its factor is that of G + R, its target y - k0."""
    nominal, x, theta = problem.spec.nominal, problem.x, torch.zeros_like(problem.spec.prior_variance)
    k0, dk0 = nominal(x, theta), torch.block_diag(*nominal.jacobian(x, theta))
    z, S = k0.reshape(-1, problem.spec.task_dim), nominal.sensitivities(x, theta).flatten(0, 1)
    G = dk0 @ problem.spec.joint_kernel.matrix(x, x) @ dk0.T + problem.spec.task_kernel.matrix(z, z)
    expected = G + (S * problem.spec.prior_variance) @ S.T + torch.block_diag(*problem.noise.covariance)
    regression = tangent(problem)
    assert isinstance(regression.conditional, Process)
    found = regression.conditional.about(regression.target)
    torch.testing.assert_close(found.factor.matrix, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(regression.target, problem.y - k0, rtol=0, atol=1e-15)
    torch.testing.assert_close(found.mu, torch.linalg.solve(expected, (problem.y - k0).flatten()), rtol=1e-8, atol=1e-8)
    first = dc.GaussNewton(max_iterations=1).solve(problem, RK4(2)).momenta
    for actual, wanted in zip(first.tensors, regression.momenta().tensors, strict=True):
        torch.testing.assert_close(actual, wanted, rtol=1e-8, atol=1e-9)


X = uniform(5, 2, seed=3)
Y = elastic_rr.real(X)


def make(**changes: object) -> Problem:
    given = {"nominal": elastic_rr.nominal, "x": X, "y": Y, "joint_kernel": K_V, "task_kernel": K_W, "noise": 0.01}
    return Problem(**(given | changes))  # pyright: ignore[reportArgumentType]


def test_gradients_do_not_lead_back_to_the_data() -> None:
    """Arrays and lists: tests/kinematics/test_data_frames.py."""
    with pytest.warns(dc.DiffeoCalibWarning, match="back to `x`"):
        assert not make(x=X.clone().requires_grad_()).x.requires_grad


def with_nan(t: Tensor) -> Tensor:
    t = t.clone()
    t[3, 1] = torch.nan
    return t


def wrong_blocks(row: int, skew: float = 0.0) -> Tensor:
    """One of which is not symmetric, or negative."""
    covariance = noise_blocks(5, 2)
    covariance[row] *= 1.0 if skew else -1.0
    covariance[row, 0, 1] += skew
    return covariance


BAD: tuple[tuple[str, dict[str, object]], ...] = (
    (r"`x` has 1 value\(s\) that are not finite, the first at index \[3, 1\]", {"x": with_nan(X)}),
    ("`x` is empty", {"x": X[:0], "y": Y[:0]}),
    (r"`x` has the wrong shape: expected \(N, n\), got \(5,\)", {"x": X[:, 0]}),
    (r"`y` has the wrong shape: expected \(5, m\), got \(4, 2\); pass one measured point", {"y": Y[:4]}),
    ("`markers`: expected a divisor of the 2 columns of `y`, got 3", {"markers": 3}),
    ("`joint_kernel`|length scales|number of length scales", {"joint_kernel": dc.VonMises([1.0, 1.0, 1.0])}),
    (r"`joint_kernel`.* on 2 coordinates", {"joint_kernel": dc.PerJoint([1.0] * 3, [1.0] * 3, circle(3))}),
    ("`task_kernel`: expected a kernel on 2 coordinates", {"task_kernel": dc.Gaussian(1.0, [1.0] * 3)}),
    ("`noise`: expected positive", {"noise": -0.1}),
    ("`joint_kernel`: expected a kernel such as .*got None", {"joint_kernel": None}),
    ("`noise`: expected sigma in m or one covariance block per row, got None", {"noise": None}),
    ("`noise` has 1 value", {"noise": float("nan")}),
    (r"`noise` has the wrong shape: expected \(5, 2, 2\)", {"noise": noise_blocks(1, 2)}),
    ("`noise`: expected symmetric positive definite.*first at row 3", {"noise": wrong_blocks(3, 1e-6)}),
    ("`noise`: expected symmetric.*first at row 2", {"noise": wrong_blocks(2)}),
    ("`new_noise` cannot be read as numbers", {"new_noise": "x"}),
    (r"`new_noise` has the wrong shape: expected \(2, 2\)", {"new_noise": torch.eye(5)}),
    ("`new_noise`: expected a symmetric positive", {"new_noise": [[1.0, 0.5], [0.0, 1.0]]}),
    ("`new_noise`: expected a symmetric positive", {"new_noise": [[1.0, 0.0], [0.0, -1.0]]}),
    ("`nominal`: expected a function", {"nominal": 3}),
    (r"`nominal\(x\)` has the wrong shape: expected \(5, 2\), got \(5, 4\)", {"nominal": planar_two_markers}),
    (r"`nominal\(x\)` has \d+ value\(s\) that are not finite", {"nominal": lambda x: x.sqrt()}),
    ("`prior_variance`", {"nominal": Offset()}),
    ("`prior_variance`: expected positive numbers", {"nominal": Offset(), "prior_variance": [1.0, -1.0]}),
)


def test_bad_input_is_refused() -> None:
    observe, apart, x = observations()["distance"], "not differentiable by torch", configurations()
    detached, by_numpy = lambda x: elastic_rr.nominal(x.detach()), lambda x: torch.as_tensor(np.cos(x.numpy()))
    refused(
        *((message, partial(make, **changes)) for message, changes in BAD),
        (apart, lambda: tangent(make(nominal=detached))),
        (apart, lambda: tangent(make(nominal=by_numpy))),
        (r"`y`.*\(30, 1\)", lambda: make(x=x, y=x, observe=observe)),
        ("Observation", lambda: make(x=x, y=x[:, :1], observe=len)),
        ("Eulerian", lambda: dc.fit(problem_of(observe), formulation="eulerian")),
    )


def test_a_nominal_map_may_ignore_a_joint() -> None:
    problem = make(nominal=lambda x: torch.stack([x[:, 0].cos(), 0.0 * x[:, 0]], -1))
    jacobian = problem.spec.nominal.jacobian(X, tensor([]))
    expected = torch.zeros(5, 2, 2, dtype=torch.float64)
    expected[:, 0, 0] = -X[:, 0].sin()
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-15)


def test_controls_equal_to_the_data_are_the_problem_itself() -> None:
    """Equal, not identical: a copy takes the exact algorithm too, with its certificates."""
    problem = section_5(k=5)
    fit = dc.fit(problem, integrator=dc.RK4(2), controls=problem.x.clone())
    assert fit.coupling_residual < 1e-2  # NaN of a coarse model
    assert fit.energy == dc.fit(problem, integrator=dc.RK4(2)).energy
    assert not problem.with_controls(problem.x.clone()).reduced
    assert problem.with_controls(problem.x[:7]).reduced


ROWS = 30


def configurations() -> Tensor:
    return uniform(ROWS, 2, seed=3)


def distances(fixed: Tensor) -> ReadPoints:
    return ReadPoints(lambda own, point: (point - own).norm()[None], fixed, fixed.shape[1])


def observations() -> dict[str, Observation]:
    angle = 6.0 * uniform(ROWS, 1, seed=5)
    axes = torch.stack([angle.cos(), angle.sin()], -1)
    where = torch.tensor([[2.5, 0.5], [-2.0, 1.5]], dtype=torch.float64).repeat(ROWS // 2, 1)
    return {"distance": distances(where), "plane": LinearFunctionals(axes, 0.1 * normal(ROWS, 1, seed=7))}


def problem_of(observe: Observation, noise: object = 1e-3) -> Problem:
    x = configurations()
    y = observe.value(elastic_rr.real(x))
    return Problem(elastic_rr.nominal, x, y, joint_kernel=K_V, task_kernel=K_W, noise=noise, observe=observe)


def test_the_identity_as_a_functional_is_a_measured_position(tmp_path: Path) -> None:
    x, blocks = configurations(), noise_blocks(ROWS, 2)
    y = elastic_rr.real(x)
    kernels: dict[str, Any] = {"joint_kernel": K_V, "task_kernel": K_W}
    eye = torch.eye(2, dtype=torch.float64).expand(ROWS, 2, 2)
    turn = torch.linalg.qr(normal(ROWS, 2, 2, seed=6)).Q
    whole = Problem(elastic_rr.nominal, x, y, noise=blocks, new_noise=blocks[0], **kernels)
    turned = Problem(
        elastic_rr.nominal,
        x,
        (turn @ y[:, :, None])[:, :, 0] - 0.25,
        noise=turn @ blocks @ turn.mT,
        new_noise=blocks[0],
        observe=LinearFunctionals(turn @ eye, torch.full((ROWS, 2), 0.25, dtype=torch.float64)),
        **kernels,
    )
    first, second = (dc.fit(problem, integrator=dc.RK4(2)) for problem in (whole, turned))
    assert second.energy == pytest.approx(first.energy, rel=1e-9)
    at = uniform(20, 2, seed=9)
    torch.testing.assert_close(second.model(at), first.model(at), rtol=0, atol=1e-7)
    for mine, theirs in zip(second.model.predict(at), first.model.predict(at), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-7)
    dc.save(second.model, tmp_path / "model.safetensors")
    again = dc.load(tmp_path / "model.safetensors", elastic_rr.nominal)
    for mine, theirs in zip(again.predict(at), second.model.predict(at), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", [pytest.param("distance", marks=pytest.mark.slow), "plane"])
def test_certificates_and_solvers(name: str) -> None:
    """Gauss-Newton by both linear solvers ends at one optimum, which (12) certifies and L-BFGS cannot lower."""
    problem, steps = problem_of(observations()[name], noise=0.01), dc.RK8(2)
    found = dc.fit(problem, dc.GaussNewton(tolerance=1e-6), steps)
    assert found.converged, found.status
    assert max(found.coupling_residual, found.end_residual) < 1e-6
    by_sums = dc.fit(problem, dc.GaussNewton(tolerance=1e-6, linear="cg"), steps)
    assert by_sums.energy == pytest.approx(found.energy, rel=1e-9)
    descended = dc.fit(problem, dc.LBFGS(max_iterations=10), steps, start=found.momenta)
    assert descended.energy == pytest.approx(found.energy, rel=1e-8)
    gradient = _gradient(problem, found)
    assert float(gradient.norm()) < 1e-5 * float(_gradient(problem, None).norm())
    miss = (found.model(problem.x) - elastic_rr.real(problem.x)).norm(dim=1).mean()
    before = (elastic_rr.nominal(problem.x) - elastic_rr.real(problem.x)).norm(dim=1).mean()
    assert float(miss) < 0.5 * float(before)


def _gradient(problem: Problem, found: dc.Fit | None) -> Tensor:
    at = (problem.zero() if found is None else found.momenta).flatten().clone().requires_grad_()
    total = problem.energy(problem.deform(problem.zero().unflatten(at), dc.RK8(2))).total
    return torch.autograd.grad(total, at)[0]
