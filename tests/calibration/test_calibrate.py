"""`calibrate` on robots whose errors are known: gains of every stage, its arguments, and how it ends early."""

import math

import pytest
import torch
from product_bank import Case, calibrated, simulated
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.fitting.result import silent

CERTIFICATE = 1e-4


def test_the_refined_geometry_is_part_of_the_model(arm: Case) -> None:
    """Without the flows the model consists of the refined geometry and the gravity sag."""
    nominal, q, theta = arm.model.nominal, arm.train.q, arm.model.map.deformation.momenta.theta
    errors, coefficients = nominal.split(theta)
    rigid = nominal(q, torch.cat([errors, torch.zeros_like(coefficients)]))
    assert_close(arm.model.geometry.points(q).flatten(1), rigid, rtol=0, atol=1e-12)
    for less in (nominal(q, theta), arm.result.identification.geometry.points(q).flatten(1)):
        assert float((rigid - less).abs().max()) > 1e-6


def test_the_summary_holds_the_numbers_of_the_stages(arm: Case) -> None:
    summary, result = arm.model.summary, arm.result
    stages = (summary.registration_rms, summary.geometry_rms, summary.diffeomorphic_rms)
    assert stages == pytest.approx([dc.evaluate(stage, arm.train).rms for stage in result.stages.values()], rel=1e-9)
    left_out = result.leave_one_out.errors.norm(dim=1).square().mean().sqrt()
    assert summary.leave_one_out_rms == pytest.approx(float(left_out), rel=1e-9)
    assert summary.parts == {part.name: part.displacement for part in result.parts}
    assert summary.noise_degrees_of_freedom == result.tails.freedom
    assert summary.effective_parameters == result.leave_one_out.effective
    assert (summary.rows, summary.outliers) == (60, 0)
    assert summary.scales == result.selection.status


@pytest.mark.slow
def test_a_perfect_robot_is_not_made_worse() -> None:
    noise = 2e-6
    case = calibrated(40, geometry=0, transmission=0, gravity=0, noise=noise)
    _, geometry, diffeomorphic = case.held_out()
    assert diffeomorphic < 1.05 * geometry
    assert diffeomorphic < 1.5 * math.sqrt(3) * noise
    fit = case.result.fit
    assert fit.converged
    assert not case.result.interrupted
    assert max(fit.coupling_residual, fit.end_residual) <= CERTIFICATE
    assert case.result.status.startswith("converged")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:leave-one-out errors contradict the selected scales")  # they are far smaller
@pytest.mark.filterwarnings("ignore:the link before")  # errors of links are as large as that
def test_noise_free_data_can_be_calibrated() -> None:
    case = calibrated(40, transmission=0, gravity=0, noise=0)
    assert case.held_out()[2] < 1e-6
    assert case.result.fit.converged


def test_twelve_poses_are_selected_on() -> None:
    """Without a warning: their leave-one-out errors are too few to judge the scales. The same model every time."""
    steps: list[tuple[str, int, int]] = []
    arm, train, test = simulated(12)
    result, again = (
        dc.calibrate(arm.nominal, train, seed=3, progress=progress)
        for progress in (lambda *step: steps.append(step), silent)
    )
    assert "12 poses" in result.status
    assert "likelihood" in result.status
    assert dc.evaluate(result.model, test).rms < dc.evaluate(result.registration.geometry.points, test).rms
    assert torch.equal(result.model(test.q), again.model(test.q))
    assert result.model.summary == again.model.summary
    tasks = list(dict.fromkeys(task for task, _, _ in steps))
    assert tasks == ["registration", "geometry", "hyper-parameters", "axes", "cross-validation", "Gauss-Newton"]
    assert all(0 <= done <= total for _, done, total in steps)


@pytest.mark.parametrize("rows", [3, 11])
def test_few_poses_take_the_defaults_and_say_so(rows: int) -> None:
    """And are not worse than the registration."""
    arm, train, test = simulated(rows)
    with pytest.warns(DiffeoCalibWarning, match=rf"^{rows} poses are too few to select scales: .*at least 12 poses"):
        result = dc.calibrate(arm.nominal, train)
    assert f"{rows} poses are too few" in result.status
    assert result.fit.converged
    assert result.fit.coupling_residual <= CERTIFICATE
    assert result.outliers == []
    assert dc.evaluate(result.model, test).rms < 1.1 * dc.evaluate(result.registration.geometry.points, test).rms
    assert bool(torch.isfinite(result.model.predict(test.q[:5])[1]).all())


def interrupting(task: str, at: int):
    """A progress callback that behaves as if Ctrl-C came at this place, once."""
    state = {"done": False}

    def progress(name: str, done: int, total: int) -> None:
        if name == task and done >= at and not state["done"]:
            state["done"] = True
            raise KeyboardInterrupt

    return progress


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:leave-one-out errors contradict the selected scales")  # they are not selected yet
@pytest.mark.parametrize(("task", "at"), [("hyper-parameters", 1), ("cross-validation", 2), ("Gauss-Newton", 0)])
def test_ctrl_c_keeps_a_usable_model(task: str, at: int, arm: Case) -> None:
    scales = arm.result.selection.scales if task == "Gauss-Newton" else None
    result = dc.calibrate(arm.robot, arm.train, hyperparameters=scales, progress=interrupting(task, at))
    assert result.interrupted
    assert "interrupted" in result.status
    assert result.status.count("interrupted") == 1
    geometry = result.identification.geometry.points
    if task == "Gauss-Newton":  # before its first step
        assert_close(result.model(arm.test.q), geometry(arm.test.q), rtol=0, atol=1e-13)
    else:
        assert dc.evaluate(result.model, arm.test).rms < dc.evaluate(geometry, arm.test).rms
    assert bool(torch.isfinite(result.model.predict(arm.test.q[:3])[1]).all())
