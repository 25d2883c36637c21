"""The benchmark of the paper's section 5: records of quick mode, its cases, failures as records."""

from __future__ import annotations

import pytest
from harness import Record, Value
from paper_rr import Case, attempt, measure

import diffeo_calib as dc
from diffeo_calib.common.errors import NumericalError


@pytest.fixture(scope="module")
def quick() -> list[Record]:
    """The records of quick mode: Gauss-Newton, gradient descent, Eulerian L-BFGS, the printed sign."""
    return list(measure(quick=True))


def number(value: Value) -> float:
    assert isinstance(value, float)
    return value


@pytest.mark.slow
def test_exact_model_beats_the_paper(quick: list[Record]) -> None:
    exact, descent = quick[:2]
    assert exact["converged"] is True
    assert exact["integrator"] == "RK4(2)"
    assert number(exact["energy"]) == pytest.approx(0.0569623, rel=1e-4)
    assert number(exact["orders_random"]) >= 5.0
    assert number(exact["coupling_residual"]) <= 1e-6
    assert number(exact["jacobian_relative_error"]) <= 1e-9
    assert number(exact["jacobian_autograd_error"]) <= 1e-12
    assert descent["converged"] is False
    assert number(descent["energy"]) > 1000.0


@pytest.mark.slow
def test_errors_are_higher_at_the_border(quick: list[Record]) -> None:
    exact = quick[0]
    assert 2.0 < number(exact["border_error_ratio"]) < number(exact["border_error_ratio_lines"])
    assert number(exact["orders_border"]) < number(exact["orders_random"]) < number(exact["orders_interior"])


@pytest.mark.slow
def test_eulerian_formulation_fits_but_its_jacobian_is_off(quick: list[Record]) -> None:
    corrected = quick[2]
    assert corrected["converged"] is True
    assert number(corrected["orders_random"]) > 4.0
    assert 0.01 < number(corrected["jacobian_relative_error"]) < 0.15
    assert corrected["coupling_residual"] is None


@pytest.mark.slow
def test_printed_sign_is_a_record_that_says_so(quick: list[Record]) -> None:
    printed = quick[3]
    assert printed["errata"] == "printed_sign"
    assert printed["converged"] is False
    assert "limit" in str(printed["status"])
    assert number(printed["orders_random"]) < number(quick[2]["orders_random"]) - 0.5


def test_a_failure_is_a_record(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise NumericalError("the flow overflows")

    monkeypatch.setattr(dc, "fit", fails)
    record = attempt(Case("exact", "Gauss-Newton", dc.GaussNewton(), dc.RK4(1), 0.01), quick=True)
    assert record["converged"] is False
    assert record["status"] == "failed: the flow overflows"
