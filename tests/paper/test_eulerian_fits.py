"""Fits in the paper's formulation, and what it does not support."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from eulerian_bank import P0, deformed
from math_bank import few_points, uniform

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.problem import tangent
from diffeo_calib.paper.eulerian import EulerianProblem


def test_a_fit_of_an_easy_problem(tmp_path: Path) -> None:
    fit = dc.fit(few_points(), formulation="eulerian")
    assert fit.converged
    assert fit.status.startswith("converged")
    again = dc.fit(fit.problem, formulation="eulerian", start=fit.momenta)
    assert again.energy == pytest.approx(fit.energy, rel=1e-8)
    assert fit.energy == pytest.approx(dc.fit(few_points()).energy, rel=0.1)
    x = uniform(6, 2, seed=3)
    found = fit.model.inverse(fit.model(x), x + 0.01)
    torch.testing.assert_close(fit.model(found), fit.model(x), rtol=0, atol=1e-10)
    assert (fit.model(x[:0]).shape, fit.model.jacobian(x[:0]).shape) == ((0, 2), (0, 2, 2))
    for action in (lambda: fit.model.predict(x), lambda: dc.save(fit.model, tmp_path / "model.safetensors")):
        with pytest.raises(InputError, match='formulation="exact"'):
            action()


def test_shooting_starts_at_the_tangent_solution_and_ends_at_12() -> None:
    problem = few_points()
    eulerian = EulerianProblem(problem)
    begin, evaluations = eulerian.start(dc.RK4(2))
    reached = eulerian.deform(begin, dc.RK4(2))
    first = eulerian.deform(eulerian.unknowns(tangent(problem).momenta()), dc.RK4(2))
    assert evaluations > 2
    assert float(eulerian.energy(reached).total) < float(eulerian.energy(first).total)
    assert eulerian.end_residual(reached) < 0.2 * eulerian.end_residual(first)


def test_overflow_is_reported() -> None:
    with pytest.raises(NumericalError, match=r"fixed points \(17\) overflows"):
        deformed(1e30 * P0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"formulation": "lagrangian"}, r'`formulation`: expected "exact" or "eulerian", got \'lagrangian\''),
        ({"printed_sign": True}, r'expected none, got printed_sign; .*formulation="eulerian"'),
        ({"formulation": "eulerian", "sign": True}, r"expected printed_sign, printed_jacobian, .* got sign"),
        ({"formulation": "eulerian", "printed_sign": 1}, r"`printed_sign`: expected True or False, got 1"),
        ({"formulation": "eulerian", "controls": 3}, r"momentum at every measurement"),
        ({"formulation": "eulerian", "solver": dc.GaussNewton()}, r"use dc.LBFGS\(\) or dc.GradientDescent"),
        ({"formulation": "eulerian", "start": tangent(few_points()).momenta()}, r"same control points and formulation"),
    ],
)
def test_wrong_arguments_are_one_clear_error(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        dc.fit(few_points(), integrator=dc.RK4(1), **arguments)  # pyright: ignore[reportArgumentType]
