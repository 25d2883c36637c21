"""The benchmarks on the elastic RR arm: the extended arm, known answers, records, summary, figure, the programs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import kernel_choices
import pytest
import sample_efficiency
import torch
from kernel_choices import MODELS
from rr_arm import COORDINATES, ExtendedArm, extended
from rr_calibrations import Calibrated, Predict, calibrate, geometric_fit
from rr_methods import METHODS, PAPER, PROCESS
from rr_models import around, leave_one_out
from torch import Tensor

from diffeo_calib.robots import elastic_rr

TRUTH = torch.tensor([0.05, -0.02, 0.08, -0.04, 0.04, -0.03], dtype=torch.float64)
FAST = ("geometry", "GP", "geometry, phi, psi: flow")


def uniform(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * math.pi * torch.rand(count, 2, dtype=torch.float64, generator=generator) - math.pi


def rms(predict: Predict, truth: Tensor, x: Tensor) -> float:
    return float((predict(x) - truth).square().sum(1).mean().sqrt())


# --- the arm --------------------------------------------------------------------------------------------------------


def test_extended_arm_is_the_nominal_one_with_exact_derivatives() -> None:
    x = uniform(4)
    for arm in (ExtendedArm(geometry=True, gravity=True), ExtendedArm(geometry=True), ExtendedArm(geometry=False)):
        theta = 0.1 * torch.randn(arm.parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        torch.testing.assert_close(arm(extended(x), 0 * theta), elastic_rr.nominal(x), rtol=0, atol=1e-15)
        at = extended(x) + 0.1 * torch.arange(COORDINATES)
        by_theta = torch.autograd.functional.jacobian(lambda t, arm=arm, at=at: arm(at, t), theta)
        torch.testing.assert_close(arm.sensitivities(at, theta), by_theta, rtol=0, atol=1e-13)  # pyright: ignore[reportArgumentType]
        by_x = [torch.autograd.functional.jacobian(lambda r, arm=arm, t=theta: arm(r[None], t)[0], row) for row in at]
        torch.testing.assert_close(arm.jacobian(at, theta), torch.stack(by_x), rtol=0, atol=1e-13)  # pyright: ignore


# --- known answers --------------------------------------------------------------------------------------------------


def test_geometry_is_exact_where_the_truth_is_geometric() -> None:
    arm, x, test = ExtendedArm(geometry=True), uniform(6), uniform(100, 1)
    torch.testing.assert_close(geometric_fit(x, arm(extended(x), TRUTH)), TRUTH, rtol=0, atol=1e-9)
    (name, predict, note) = next(METHODS["geometry",](x, arm(extended(x), TRUTH), 0))
    assert (name, note) == ("geometry", None)
    assert rms(predict, arm(extended(test), TRUTH), test) < 1e-9


def test_a_process_is_the_usual_one() -> None:
    # scikit-learn's process on cos and sin with the scales that were found here; equal amplitudes.
    gaussian_process = pytest.importorskip("sklearn.gaussian_process")
    kernels = gaussian_process.kernels
    x, test = uniform(15), uniform(20, 1)
    y = elastic_rr.real(x)
    length, amplitude, noise = (1.2, 0.8), 0.1, 1e-3
    vector = torch.tensor([noise, amplitude, amplitude, *length], dtype=torch.float64).log()
    model = Calibrated(PROCESS, vector, around(PROCESS, vector, x.new_zeros(0), x, y), x, y)
    shape = kernels.ConstantKernel(amplitude**2) * kernels.RBF([*length, *length])
    same = gaussian_process.GaussianProcessRegressor(shape, alpha=noise**2, optimizer=None)
    features, at = (torch.cat([z.cos(), z.sin()], 1).numpy() for z in (x, test))
    expected = same.fit(features, (y - elastic_rr.nominal(x)).numpy()).predict(at)
    found = model.tangent()(test) - elastic_rr.nominal(test)
    torch.testing.assert_close(found, torch.from_numpy(expected), rtol=0, atol=1e-9)


def test_leave_one_out_equals_refits_without_each_row() -> None:
    x = uniform(6)
    y = elastic_rr.real(x)
    vector = PAPER.logarithms(**kernel_choices.paper_values())
    data = around(PAPER, vector, x.new_zeros(0), x, y)
    value, _ = leave_one_out(data.matrix(PAPER, vector), data.target.flatten())
    errors = []
    for row in range(len(x)):
        rest = torch.arange(len(x)) != row
        model = Calibrated(PAPER, vector, around(PAPER, vector, x.new_zeros(0), x[rest], y[rest]), x[rest], y[rest])
        errors.append(model.tangent()(x[row : row + 1]) - y[row])
    assert value == pytest.approx(-len(x) * math.log(float(torch.cat(errors).square().mean())), rel=1e-6)


def test_tangent_and_flow_agree_where_deformations_are_small() -> None:
    x, test = uniform(30), uniform(50, 1)
    y = elastic_rr.real(x, 1e-3)
    model = calibrate(MODELS["geometry, phi, psi"], x, y, 0)
    flow, note = model.flow()
    assert note is None
    torch.testing.assert_close(flow(test), model.tangent()(test), rtol=0, atol=2e-6)
    assert rms(flow, elastic_rr.real(test, 1e-3), test) < 5e-6  # of 1e-4 that the nominal arm leaves


# --- cases and records ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_program(tmp_path: Path) -> None:
    out, figure = tmp_path / "samples.json", tmp_path / "samples.svg"
    given = ["--methods", *FAST, "--protocol", "samples", "--sizes", "6", "--noises", "0", "1e-3", "--seeds", "1"]
    sample_efficiency.run(sample_efficiency.arguments([*given, "--out", str(out), "--figure", str(figure)]))
    found = json.loads(out.read_text())
    assert set(found) == {"machine", "versions", "commit", "records"}
    assert len(found["records"]) == 2 * len(FAST)
    assert {record["method"] for record in found["records"] if record["ours"]} == {"geometry, phi, psi: flow"}
    assert all(f"<!-- {name} -->" in figure.read_text() for name in FAST)
    figure.unlink()
    sample_efficiency.run(sample_efficiency.arguments(["--from", str(out), "--figure", str(figure)]))
    assert all(f"<!-- {name} -->" in figure.read_text() for name in FAST)


# --- kernels and choices --------------------------------------------------------------------------------------------
