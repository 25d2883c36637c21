"""Sums, flows, fits and models on every device: a second device on the CPU, and the accelerator where there is one."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from math_bank import CASES, Case, normal, rr_problem
from product_bank import Case as ArmCase
from second_device_bank import PLACES, Place, SecondDevice, at
from sum_bank import apart, every_formula, mapped, points, torch_backends
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.flows.geodesic import Flow, energy
from diffeo_calib.kernels.profiles import MaternProfile
from diffeo_calib.kernels.reductions import backends
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kernels.reductions.formulas import Formula
from diffeo_calib.robots import elastic_rr

every_place = pytest.mark.parametrize("place", PLACES, ids=lambda place: place.name)
every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
ONCE, TWICE = (dc.GaussNewton(max_iterations=count) for count in (1, 2))
"""Further iterations repeat the same operations, and every one on the second device passes through Python."""
FITS: dict[str, Callable[[dc.Problem], dc.Fit]] = {
    "Gauss-Newton": lambda problem: dc.fit(problem, TWICE, dc.RK4(2)),
    "chosen steps": lambda problem: dc.fit(problem, ONCE),
    "adaptive": lambda problem: dc.fit(problem, ONCE, dc.TorchDiffEq("bosh3", rtol=1e-1, atol=1e-2)),
    "L-BFGS": lambda problem: dc.fit(problem, dc.LBFGS(max_iterations=2), dc.RK4(2)),
    "descent": lambda problem: dc.fit(problem, dc.GradientDescent(1e-6, max_iterations=2), dc.RK4(1)),
    "conjugate gradients": lambda problem: dc.fit(problem, dc.GaussNewton(linear="cg", max_iterations=1), dc.RK4(1)),
    "eulerian": lambda problem: dc.fit(problem, dc.LBFGS(max_iterations=2), dc.RK4(1), formulation="eulerian"),
}
QUICK = ("Gauss-Newton",)


def test_the_second_device_refuses_to_mix() -> None:
    with SecondDevice() as device:
        here, there = normal(3), normal(3).to("meta")
        with pytest.raises(RuntimeError, match="mixes devices"):
            here.add(there)
        with pytest.raises(RuntimeError, match="mixes devices"):
            there.add_(torch.zeros(3, dtype=torch.float64))
        torch.testing.assert_close(there.add(1.0).to("cpu"), here + 1.0, rtol=0, atol=0)
        assert float(there.sum()) == float(here.sum())
        assert device.operations.calls > 3


@every_place
@every_formula
@torch_backends
def test_sums(place: Place, formula: Formula, backend: Backend) -> None:
    (i, j), many, profile = apart(), points(300, 3), MaternProfile(2.5)
    sides = (i, j), (None, many)
    expected = [value for side in sides for value in backends.evaluate(formula, profile, *side, backend)]
    with at(place) as name:
        i, j, many = (mapped(p, lambda t: t.to(name)) for p in (i, j, many))
        sides = (i, j), (None, many)
        found = [value for side in sides for value in backends.evaluate(formula, profile, *side, backend)]
        for one, other in zip(found, expected, strict=True):
            tolerance = 1e-9 * float(other.abs().max())
            torch.testing.assert_close(place.bring(one), other, rtol=0, atol=tolerance)  # tiles differ by device


@every_place
@every_case
def test_flows_and_their_gradients(place: Place, case: Case) -> None:
    q, a, x = case.points(6), 0.1 * normal(6, case.dim, seed=1), case.points(4, seed=2)

    def work(kernel: dc.Kernel, *parts: Tensor) -> list[Tensor]:
        q, a, x = (t.detach().requires_grad_() for t in parts)
        flow = Flow(kernel, q, a, dc.RK4(2))
        loss = flow(x).square().sum() + flow.end.square().sum() + energy(kernel, q, a)
        variational = Flow(kernel, q.detach(), a.detach(), dc.RK4(2), variational=True)
        return [*torch.autograd.grad(loss, (q, a, x)), *variational.with_jacobian(x.detach()), variational.end]

    expected = work(case.kernel.using("dense"), q, a, x)
    with at(place) as name:
        found = work(case.kernel.to(name).using("dense"), *(t.to(name) for t in (q, a, x)))
        for one, other in zip(found, expected, strict=True):
            place.compare(one, other)


@every_place
@pytest.mark.parametrize("name", [pytest.param(kind, marks=[pytest.mark.slow] * (kind not in QUICK)) for kind in FITS])
def test_fits(place: Place, name: str) -> None:
    problem, x = rr_problem(2, noise=1e-3) if name == "chosen steps" else rr_problem(3), elastic_rr.grid(3)
    expected = FITS[name](problem)
    assert expected.integrator != dc.RK4(1) or name != "chosen steps"
    with at(place) as device:
        fit = FITS[name](problem.to(device))
        assert fit.energy == pytest.approx(expected.energy, rel=0 if place.exact else 1e-6)
        assert fit.status == expected.status or not place.exact
        for momenta, other in zip(fit.momenta.tensors, expected.momenta.tensors, strict=True):
            place.compare(momenta, other, 1e-6)
        model, there = fit.model, x.to(device)
        place.compare(model(there), expected.model(x))
        place.compare(model.jacobian(there), expected.model.jacobian(x))
        if name != "eulerian":
            for one, other in zip(model.predict(there), expected.model.predict(x), strict=True):
                place.compare(one, other)
        torch.testing.assert_close(model.to("cpu")(x), expected.model(x))


@pytest.mark.slow
@every_place
def test_models_of_robots_move_there_and_back_through_a_file(place: Place, arm: ArmCase, tmp_path: Path) -> None:
    q = arm.test.q[:4]
    expected = [arm.model(q), arm.model.jacobian(q), *arm.model.predict(q)]
    with at(place) as name:
        model, there = arm.model.to(name), q.to(name)
        for one, other in zip([model(there), model.jacobian(there), *model.predict(there)], expected, strict=True):
            # On the CPU these queries run without torch.
            torch.testing.assert_close(place.bring(one), other, rtol=1e-9, atol=1e-12)
        dc.save(model, tmp_path / "model.safetensors")
    back = dc.load(tmp_path / "model.safetensors")
    torch.testing.assert_close(back(q), expected[0], rtol=0, atol=1e-15)
