"""Fits with fewer control points than measurements."""

from itertools import pairwise
from math import pi

import pytest
import torch
from fit_bank import stop_at
from math_bank import K_V, K_W, normal, rr_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting import fit as fitting
from diffeo_calib.fitting.fit import choose_controls
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.robots import elastic_rr


@pytest.mark.slow
def test_few_control_points_fit_many_data() -> None:
    """100 of 256 configurations as controls: a small held-out error, and L-BFGS finds the same optimum."""
    problem = rr_problem(16)
    x = uniform(300, 2, seed=2)
    fit = dc.fit(problem, integrator=dc.RK4(2), controls=100)
    assert fit.converged
    assert len(fit.model.deformation.x) == 100
    assert fit.model.x is problem.x
    nominal, fitted = ((y - elastic_rr.real(x)).norm(dim=1).mean() for y in (elastic_rr.nominal(x), fit.model(x)))
    assert float(fitted) <= 1e-4 * float(nominal)
    solver = dc.LBFGS(max_iterations=20)
    after = dc.fit(problem, solver, dc.RK4(2), controls=fit.problem.controls, start=fit.momenta)
    assert fit.energy * (1 - 1e-6) <= after.energy <= fit.energy


def test_the_covariance_of_a_coarse_model_is_not_smaller_than_that_of_the_full_one() -> None:
    problem = rr_problem(8)
    x = uniform(10, 2, seed=5)
    full, coarse = (dc.fit(problem, integrator=dc.RK4(2), controls=c).model for c in (None, 40))
    wide, narrow = (torch.diagonal(m.predict(x, noise=False)[1], dim1=1, dim2=2) for m in (coarse, full))
    assert bool((wide >= -1e-9).all())
    assert float((wide - narrow).min()) >= -0.2 * float(narrow.max())


def test_interrupting_the_start_of_a_coarse_fit_keeps_it() -> None:
    fit = dc.fit(rr_problem(6), integrator=dc.RK4(1), controls=20, progress=stop_at(2))
    assert fit.solution.interrupted
    assert len(fit.model.deformation.x) == 20
    assert "interrupted after 2 iterations" in fit.status


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        (0, "`controls`: expected 1 to 25"),
        (26, "`controls`: expected 1 to 25"),
        (torch.zeros(3, 3), r"`controls` has the wrong shape.*pass configurations of 2 joints"),
        (torch.full((3, 2), float("nan")), "`controls` has 6 value"),
        ("all", "`controls` cannot be read as numbers"),
        (True, r"`controls` cannot be read as numbers \(booleans\)"),
    ],
)
def test_invalid_control_points_are_refused(controls: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        dc.fit(rr_problem(5), controls=controls)


@pytest.mark.slow
def test_a_coarse_fit_that_stops_before_the_optimum_says_how_to_continue() -> None:
    """With large deformations and few control points Gauss-Newton's step is approximate; L-BFGS continues from it."""
    x = pi * uniform(100, 3, seed=0)

    def links(x: Tensor, lengths: tuple[float, float, float]) -> Tensor:
        angles, scale = x.cumsum(1), torch.tensor(lengths, dtype=x.dtype)
        return torch.stack([(scale * angles.cos()).sum(1), (scale * angles.sin()).sum(1)], 1)

    y = links(x + 0.02 * x.sin() + 0.01 * (2 * x).cos(), (1.02, 0.69, 0.31)) + 0.01
    kernels = {"joint_kernel": dc.VonMises((1.0,) * 3, variance=0.5), "task_kernel": dc.Gaussian(0.7)}
    problem = Problem(lambda x: links(x, (1.0, 0.7, 0.3)), x, y, noise=1e-3, **kernels)  # pyright: ignore[reportArgumentType]
    stopped = dc.fit(problem, integrator=dc.RK4(2), controls=x[::2])
    assert not stopped.converged
    assert "no step in the approximate Gauss-Newton direction" in stopped.status
    assert "dc.LBFGS() from `start=fit.momenta`" in stopped.status
    better = dc.fit(problem, dc.LBFGS(max_iterations=20), dc.RK4(2), controls=x[::2], start=stopped.momenta)
    assert better.energy < 0.9 * stopped.energy


def small_deformations(rows: int = 120) -> Problem:
    """An arm with a fiftieth of the errors of the paper's."""
    x = uniform(rows, 2, seed=3)
    nominal, noise = elastic_rr.nominal(x), 1e-4
    y = nominal + 0.02 * (elastic_rr.real(x) - nominal) + noise * normal(rows, 2, seed=4)
    kernels = {"joint_kernel": K_V.scaled(0.02**2), "task_kernel": K_W.scaled(0.02**2)}
    return Problem(elastic_rr.nominal, x, y, noise=noise, **kernels)  # pyright: ignore[reportArgumentType]


def test_many_rows_start_from_a_sample_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The controls and the first iterations come from a sample; the optimum is that of all rows."""
    problem = small_deformations()
    monkeypatch.setattr(fitting, "SAMPLE_COORDINATES", 60)
    rows = fitting.sample(problem)
    assert rows is not None
    assert len(rows) == 30
    chosen = choose_controls(problem, 20)
    assert set(chosen.tolist()) <= set(rows.tolist())
    fit = dc.fit(problem, controls=20)
    same = dc.fit(problem, integrator=fit.integrator, controls=problem.x[chosen])  # without a sample
    assert fit.energy == pytest.approx(same.energy, rel=1e-6)
    assert fit.model.x is problem.x


def test_a_fit_ends_when_the_linearised_problem_was_right() -> None:
    """With small deformations the energy falls as the linearised problem says, and no iteration has to confirm it."""
    problem = small_deformations()
    loose, tight = (
        dc.fit(problem, dc.GaussNewton(tolerance=tolerance), dc.RK4(2), controls=20) for tolerance in (1e-4, 1e-12)
    )
    falls = [(a - b) / b for a, b in pairwise(loose.history)]
    assert falls[-1] > 1e-4 >= loose.solution.measure  # the fall itself would ask for one more
    assert 0 <= loose.energy - tight.energy <= 1e-4 * tight.energy
