"""The benchmarks on the elastic RR arm: the extended arm, known answers, records, summary, figure, the programs."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import kernel_choices
import numpy as np
import pytest
import rr_calibrations
import rr_methods
import sample_curves
import sample_efficiency
import torch
from harness import Record
from kernel_choices import CHOICES, MODELS
from rr_arm import BASE, COORDINATES, ExtendedArm, extended
from rr_calibrations import Calibrated, Predict, calibrate, geometric_fit
from rr_methods import METHODS, NAMES, OURS, PAPER, PROCESS
from rr_models import LONGEST, around, leave_one_out, log_likelihood
from sample_efficiency import Case
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import elastic_rr

TRUTH = torch.tensor([0.05, -0.02, 0.08, -0.04, 0.04, -0.03], dtype=torch.float64)
FIELDS = {"method", "ours", "train", "noise", "seed", "deformation", "design", "protocol", "rms", "median", "max"}
FAST = ("geometry", "GP", "geometry, phi, psi: flow")


def uniform(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * math.pi * torch.rand(count, 2, dtype=torch.float64, generator=generator) - math.pi


def rms(predict: Predict, truth: Tensor, x: Tensor) -> float:
    return float((predict(x) - truth).square().sum(1).mean().sqrt())


# --- the arm ------------------------------------------------------------------------------------------------------


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


# --- known answers ------------------------------------------------------------------------------------------------


def test_geometry_is_exact_where_the_truth_is_geometric() -> None:
    arm, x, test = ExtendedArm(geometry=True), uniform(6), uniform(100, 1)
    torch.testing.assert_close(geometric_fit(x, arm(extended(x), TRUTH)), TRUTH, rtol=0, atol=1e-9)
    (name, predict, note) = next(METHODS["geometry",](x, arm(extended(x), TRUTH), 0))
    assert (name, note) == ("geometry", None)
    assert rms(predict, arm(extended(test), TRUTH), test) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("group", [group for group in METHODS if any("geometry" in name for name in group)])
def test_methods_with_geometry_add_nothing_where_the_truth_is_geometric(group: tuple[str, ...]) -> None:
    arm, x, test = ExtendedArm(geometry=True), uniform(12), uniform(100, 1)
    for name, (found, predict, note) in zip(group, METHODS[group](x, arm(extended(x), TRUTH), 0), strict=True):
        assert (found, note) == (name, None)
        assert rms(predict, arm(extended(test), TRUTH), test) < 3e-4


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


def test_gradient_of_the_criteria() -> None:
    x = uniform(8)
    recipe = MODELS["geometry, phi, psi"]
    vector = rr_calibrations.first_scales(recipe, x.new_zeros(6), x, elastic_rr.real(x))[0].requires_grad_()
    data = around(recipe, vector.detach(), x.new_zeros(6), x, elastic_rr.real(x))
    for criterion in (log_likelihood, leave_one_out):
        _, slope = criterion(data.matrix(recipe, vector.detach()), data.target.flatten())
        assert slope is not None
        (gradient,) = torch.autograd.grad(data.inner(recipe, vector, slope), vector)
        for k, step in enumerate(1e-5 * torch.eye(len(vector), dtype=torch.float64)):
            up, down = (
                criterion(data.matrix(recipe, vector.detach() + s * step), data.target.flatten())[0] for s in (1, -1)
            )
            assert float(gradient[k]) == pytest.approx((up - down) / 2e-5, rel=1e-3, abs=1e-4)


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


# --- cases and records --------------------------------------------------------------------------------------------


def test_measurements_of_a_case() -> None:
    x, y = Case("samples", 50, 1e-3, seed=3).measure()
    again, _ = Case("samples", 50, 1e-2, seed=3).measure()
    torch.testing.assert_close(x, again, rtol=0, atol=0)
    assert 0.5e-3 < float((y - elastic_rr.real(x)).std()) < 2e-3
    part = Case("extrapolation", 50, design="part")
    edge = -math.pi + 2 * math.pi * sample_efficiency.PART
    assert float(part.measure()[0][:, 0].max()) < edge < float(part.test()[:, 0].min())
    assert -math.pi <= float(part.measure()[0].min())
    assert float(part.test().max()) <= math.pi
    grid = Case("grid", 256, 0.0, design="grid")
    torch.testing.assert_close(grid.measure()[1], elastic_rr.real(elastic_rr.grid(16)), rtol=0, atol=0)
    small = Case("deformation", 10, 0.0, deformation=0.01)
    error = (small.measure()[1] - elastic_rr.nominal(small.measure()[0])).norm(dim=1).mean()
    assert 0.005 < float(error) < 0.02


def test_cases_of_the_whole_program() -> None:
    found = list(sample_efficiency.cases(sample_efficiency.arguments([])))
    assert len(found) == len(set(found)) == 10 * 4 * 7 + 5 * (3 * 4 + 2) + 1
    assert {case.protocol for case in found} == set(sample_efficiency.PROTOCOLS)


def test_failures_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(x: Tensor, y: Tensor, seed: int) -> Iterator[tuple[str, Predict, str | None]]:
        yield "first", elastic_rr.nominal, None
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setitem(METHODS, ("first", "second", "third"), fails)
    first, *others = sample_efficiency.attempt(Case("samples", 6), ("first", "second", "third"))
    assert isinstance(first["rms"], float)
    assert [record["method"] for record in others] == ["second", "third"]
    assert all("rms" not in record and record["note"] == "LinAlgError: singular" for record in others)
    rows = sample_efficiency.summary([first, *others])
    assert [(row["method"], row["runs"], row["failed"]) for row in rows] == [
        ("first", 1, 0),
        ("second", 0, 1),
        ("third", 0, 1),
    ]


def test_summary_has_medians_and_quartiles() -> None:
    records: list[Record] = [
        {**vars(Case("samples", 6)), "method": "GP", "rms": float(k), "seconds": 1.0} for k in range(5)
    ]
    (row,) = sample_efficiency.summary(records)
    assert (row["lower"], row["rms"], row["upper"], row["runs"]) == (1.0, 2.0, 3.0, 5)


@pytest.mark.slow
def test_program(tmp_path: Path) -> None:
    out, figure = tmp_path / "samples.json", tmp_path / "samples.svg"
    given = ["--methods", *FAST, "--protocol", "samples", "--sizes", "6", "20", "--noises", "0", "1e-3", "--seeds", "1"]
    sample_efficiency.run(sample_efficiency.arguments([*given, "--out", str(out), "--figure", str(figure)]))
    found = json.loads(out.read_text())
    assert set(found) == {"machine", "versions", "commit", "records"}
    assert len(found["records"]) == 2 * 2 * len(FAST)
    assert all(set(record) >= FIELDS | {"seconds", "note"} for record in found["records"])
    assert {record["method"] for record in found["records"] if record["ours"]} == {"geometry, phi, psi: flow"}
    assert all(f"<!-- {name} -->" in figure.read_text() for name in FAST)
    figure.unlink()
    sample_efficiency.run(sample_efficiency.arguments(["--from", str(out), "--figure", str(figure)]))
    assert all(f"<!-- {name} -->" in figure.read_text() for name in FAST)


def test_quick_mode_and_names() -> None:
    plan = sample_efficiency.arguments(["--quick"])
    assert len(list(sample_efficiency.cases(plan))) == 2
    assert set(sample_curves.STYLES) <= set(NAMES)
    assert set(OURS) < set(NAMES)
    assert PROCESS.fields == (BASE,)
    assert PROCESS.longest == LONGEST  # peers have no shorter scales than ours


def test_curves_show_medians_between_quartiles() -> None:
    records: list[Record] = [
        {**vars(Case("samples", train, noise, seed)), "method": "GP", "rms": level * (1 + seed), "seconds": 1.0}
        for noise in (1e-4, 1e-3)
        for train, level in ((6, 1e-2), (20, 1e-3))
        for seed in range(5)
    ]
    figure = sample_curves.curves(sample_efficiency.summary(records))
    assert [axes.get_title() for axes in figure.axes] == ["noise 0.0001", "noise 0.001"]
    axes = figure.axes[0]
    line = next(line for line in axes.get_lines() if line.get_label() == "GP")
    np.testing.assert_allclose(np.asarray(line.get_xdata()), [6, 20])
    np.testing.assert_allclose(np.asarray(line.get_ydata()), [3e-2, 3e-3])
    ((band,),) = (band.get_paths() for band in axes.collections)
    heights = np.asarray(band.vertices)[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((2e-3, 4e-2))
    assert [text.get_text() for text in axes.texts] == ["noise"]


def test_nothing_to_draw(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="protocol samples"):
        sample_curves.draw([], tmp_path / "figure.png")


# --- kernels and choices ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_choice_of_scales_improves_the_nominal_arm() -> None:
    case = Case("samples", 40)
    nominal = rms(elastic_rr.nominal, case.truth(case.test()), case.test())
    for option, choice in CHOICES.items():
        records = list(kernel_choices.attempt({"option": option}, choice, MODELS["phi, psi"], case))
        assert [record["kind"] for record in records] == ["tangent", "flow"]
        assert all(float(record["rms"] or 1.0) < 0.3 * nominal for record in records)


def test_choices_that_fail_are_recorded() -> None:
    def fails(*_: object) -> Calibrated:
        raise np.linalg.LinAlgError("singular")

    records = list(kernel_choices.attempt({"option": "none"}, fails, PAPER, Case("samples", 6)))
    assert [record["kind"] for record in records] == ["tangent", "flow"]
    assert all(str(record["note"]).startswith(("LinAlgError", "Unbound")) for record in records)


def test_peers_learn_the_residual_of_the_geometry() -> None:
    case = Case("samples", 40)
    x, y = case.measure()
    geometry = rms(rr_methods._geometric(x, y), case.truth(case.test()), case.test())
    for name, predict, _ in rr_methods.radial(x, y, 0):
        assert name in NAMES
        assert rms(predict, case.truth(case.test()), case.test()) < 0.5 * geometry
