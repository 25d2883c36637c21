"""Benchmarks on the paper's arm: records of quick mode, failures as records, tangent and flow."""

from __future__ import annotations

import math

import pytest
import torch
from harness import Value
from kernel_choices import MODELS
from paper_rr import Case, attempt, measure
from rr_calibrations import calibrate

import diffeo_calib as dc
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.robots import elastic_rr


def number(value: Value) -> float:
    assert isinstance(value, float)
    return value


@pytest.mark.slow
def test_records_of_quick_mode() -> None:
    """Gauss-Newton, gradient descent, Eulerian L-BFGS, the printed sign; what they mean is tested in tests/paper."""
    exact, descent, corrected, printed = measure(quick=True)
    assert (exact["converged"], exact["integrator"], descent["converged"]) == (True, "RK4(2)", False)
    assert number(exact["energy"]) == pytest.approx(0.0569623, rel=1e-4)
    assert number(exact["jacobian_relative_error"]) <= 1e-9
    assert number(exact["jacobian_autograd_error"]) <= 1e-12
    assert 2.0 < number(exact["border_error_ratio"]) < number(exact["border_error_ratio_lines"])
    assert number(exact["orders_border"]) < number(exact["orders_random"]) < number(exact["orders_interior"])
    assert 0.01 < number(corrected["jacobian_relative_error"]) < 0.15
    assert (corrected["coupling_residual"], printed["errata"]) == (None, "printed_sign")
    assert "limit" in str(printed["status"])


def test_a_failure_is_a_record(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise NumericalError("the flow overflows")

    monkeypatch.setattr(dc, "fit", fails)
    record = attempt(Case("exact", "Gauss-Newton", dc.GaussNewton(), dc.RK4(1), 0.01), quick=True)
    assert record["converged"] is False
    assert record["status"] == "failed: the flow overflows"


def test_tangent_and_flow_agree_where_deformations_are_small() -> None:
    draws = torch.rand(80, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x, test = (2 * math.pi * draws - math.pi).split([30, 50])
    model = calibrate(MODELS["geometry, phi, psi"], x, elastic_rr.real(x, 1e-3), 0)
    flow, note = model.flow()
    assert note is None
    torch.testing.assert_close(flow(test), model.tangent()(test), rtol=0, atol=2e-6)
    error = (flow(test) - elastic_rr.real(test, 1e-3)).square().sum(1).mean().sqrt()
    assert float(error) < 5e-6  # of 1e-4 that the nominal arm leaves
