"""`calibrate`, on robots whose errors are known: what each stage brings, and what happens at the edges."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import partial

import pytest
import torch
from product_bank import Case, calibrated, simulated
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError, RobotError
from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.kernels.radial import RadialKernel

CERTIFICATE = 1e-4


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def sound(case: Case) -> None:
    """The fit solved its problem and says so."""
    fit = case.result.fit
    assert fit.converged
    assert not case.result.interrupted
    assert fit.coupling_residual <= CERTIFICATE
    assert fit.end_residual <= CERTIFICATE
    assert case.result.status.startswith("converged")


# --- what it brings -----------------------------------------------------------------------------------------------


def test_the_stages_improve_in_order(arm: Case) -> None:
    registration, geometry, diffeomorphic = arm.held_out()
    assert list(arm.result.stages) == ["nominal + registration", "geometry", "diffeomorphic"]
    assert geometry < 0.5 * registration
    assert diffeomorphic < 0.15 * geometry
    assert diffeomorphic < 0.065e-3  # of which 0.035 are the noise of the held-out rows
    sound(arm)


@pytest.mark.slow
def test_the_stages_improve_in_order_with_200_poses(arm_200: Case) -> None:
    registration, geometry, diffeomorphic = arm_200.held_out()
    assert geometry < 0.5 * registration
    assert diffeomorphic < 0.1 * geometry
    assert diffeomorphic < 0.045e-3
    sound(arm_200)


@pytest.mark.slow
def test_more_poses_are_better(arm: Case, arm_200: Case) -> None:
    assert arm_200.held_out()[2] < 0.9 * arm.held_out()[2]


def test_the_geometry_that_moves_along_is_part_of_the_model(arm: Case) -> None:
    """The joint fit refines the geometry; the model must hold those refinements, not only its own copy of k0."""
    theta = arm.model.map.deformation.momenta.theta
    assert float(theta.abs().max()) > 1e-6
    refined, frozen = arm.model.geometry, arm.result.identification.geometry
    moved = (refined.points(arm.test.q) - frozen.points(arm.test.q)).norm(dim=-1)
    assert float(moved.max()) > 1e-6
    # Without the flows the refined geometry is what remains, and the deflection under gravity.
    nominal, q = arm.model.nominal, arm.train.q
    errors, coefficients = nominal.split(theta)
    assert_close(refined.points(q).flatten(1), nominal(q, torch.cat([errors, torch.zeros_like(coefficients)])))
    assert float((refined.points(q).flatten(1) - nominal(q, theta)).abs().max()) > 1e-4


def test_the_report_holds_the_numbers_of_the_fit(arm: Case) -> None:
    report, fit = arm.model.report, arm.result.fit
    assert report["rows"] == 60
    assert report["coupling residual"] == fit.coupling_residual
    assert report["end residual"] == fit.end_residual
    assert report["status"] == fit.status
    assert report["energy"] == fit.energy
    assert report["scales"] == arm.result.selection.status
    assert report["outliers"] == 0
    for key, stage in zip(("registration", "geometry", "diffeomorphic"), arm.result.stages.values(), strict=True):
        assert report[f"{key} rms [m]"] == pytest.approx(dc.evaluate(stage, arm.train).rms, rel=1e-9)
    for part in arm.result.parts:
        assert report[f"{part.name} [m]"] == part.displacement
    left_out = arm.result.leave_one_out.errors.norm(dim=1).square().mean().sqrt()
    assert report["leave-one-out rms [m]"] == pytest.approx(float(left_out), rel=1e-9)


@pytest.mark.slow
def test_leave_one_out_errors_foretell_the_held_out_ones(arm: Case, pair: Case, slider: Case) -> None:
    for case in (arm, pair, slider):
        left_out = case.model.report["leave-one-out rms [m]"]
        assert isinstance(left_out, float)
        assert left_out / math.sqrt(case.train.markers) == pytest.approx(case.held_out()[2], rel=0.4)
        assert dc.evaluate(case.model, case.train).rms < left_out


@pytest.mark.slow
def test_leave_one_out_is_what_a_fit_without_the_row_predicts() -> None:
    """Scales given: the closed form against fits of the exact model."""
    arm, train, _ = simulated(16)
    full = dc.calibrate(arm.nominal, train)
    given = full.selection.scales
    for row in (0, 11):
        rest = torch.arange(16) != row
        model = dc.calibrate(arm.nominal, train.rows(rest), hyperparameters=given).model
        error = (train.points[row] - model(train.q[row : row + 1])[0]).flatten().detach()
        size = float(full.leave_one_out.errors[row].norm())
        assert float((error - full.leave_one_out.errors[row]).norm()) < 0.15 * size + 2e-6


@pytest.mark.slow
def test_a_perfect_robot_is_not_made_worse() -> None:
    noise = 2e-6
    case = calibrated(40, geometry=0, transmission=0, gravity=0, noise=noise)
    _, geometry, diffeomorphic = case.held_out()
    assert diffeomorphic < 1.05 * geometry
    assert diffeomorphic < 1.5 * math.sqrt(3) * noise
    sound(case)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:leave-one-out errors contradict the selected scales")  # they are far smaller
def test_noise_free_data_can_be_calibrated() -> None:
    case = calibrated(60, transmission=0, gravity=0, noise=0)
    assert case.held_out()[2] < 1e-7
    assert case.result.fit.converged
    assert case.result.status.startswith("converged to rounding: residual ")  # finer time steps change nothing


@pytest.mark.slow
def test_two_markers(pair: Case) -> None:
    registration, geometry, diffeomorphic = pair.held_out()
    assert geometry < 0.5 * registration
    assert diffeomorphic < 0.4 * geometry
    sound(pair)
    q = pair.test.q[:5]
    assert pair.model(q).shape == (5, 2, 3)
    assert pair.model.jacobian(q).shape == (5, 2, 3, 6)
    mean, covariance = pair.model.predict(q)
    assert (mean.shape, covariance.shape) == ((5, 2, 3), (5, 2, 3, 3))
    assert pair.model.markers == 2


@pytest.mark.slow
def test_a_prismatic_joint(slider: Case) -> None:
    registration, geometry, diffeomorphic = slider.held_out()
    assert geometry < 0.5 * registration
    assert diffeomorphic < 0.2 * geometry
    sound(slider)
    kernel = slider.model.map.deformation.spec.joint_kernel
    assert isinstance(kernel, SumKernel)
    for term in kernel.terms:  # the slide is a line in every one of them, not a circle of 2 pi metres
        assert isinstance(term, RadialKernel)
        assert term.periodic == (True, True, False, True, True, True)


# --- how it is steered --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Told:
    """A calibration with twelve poses, and the progress that it told."""

    result: dc.CalibrationResult
    steps: list[tuple[str, int, int]]


def told() -> Told:
    steps: list[tuple[str, int, int]] = []
    arm, train, _ = simulated(12)
    return Told(dc.calibrate(arm.nominal, train, seed=3, progress=lambda *step: steps.append(step)), steps)


@pytest.fixture(scope="module")
def twelve() -> Told:
    return told()


@pytest.mark.slow
def test_two_runs_are_equal(twelve: Told, arm: Case) -> None:
    first, second = twelve.result, told().result
    assert torch.equal(first.model(arm.test.q), second.model(arm.test.q))
    assert torch.equal(first.selection.scales.logarithms(), second.selection.scales.logarithms())
    assert first.model.report == second.model.report


@pytest.mark.slow
def test_given_scales_are_used(arm: Case) -> None:
    scales = arm.result.selection.scales
    again = dc.calibrate(arm.robot, arm.train, hyperparameters=scales)
    assert again.selection.scales is scales
    assert again.selection.status == "given"
    # The same scales from the start give the weights of outliers another path: a few micrometres at most.
    assert_close(again.model(arm.test.q), arm.model(arm.test.q), rtol=0, atol=1e-5)
    louder = dc.Hyperparameters(**{f.name: getattr(scales, f.name) * 3.0 for f in fields(scales)})
    other = dc.calibrate(arm.robot, arm.train, hyperparameters=louder)
    assert float((other.model(arm.test.q) - arm.model(arm.test.q)).abs().max()) > 1e-6


@pytest.mark.parametrize("rows", [8, 11])
def test_few_poses_take_the_defaults_and_say_so(rows: int) -> None:
    arm, train, _ = simulated(rows)
    with pytest.warns(DiffeoCalibWarning, match=rf"^{rows} poses are too few to select scales: .*at least 12 poses"):
        result = dc.calibrate(arm.nominal, train)
    assert f"{rows} poses are too few" in result.status
    assert result.fit.converged
    assert result.fit.coupling_residual <= CERTIFICATE


@pytest.mark.slow
@pytest.mark.parametrize("rows", [4, 6])
def test_very_few_poses_still_give_a_sound_fit(rows: int) -> None:
    arm, train, test = simulated(rows)
    with pytest.warns(DiffeoCalibWarning, match="poses are too few to select scales"):
        result = dc.calibrate(arm.nominal, train)
    assert result.fit.converged
    assert dc.evaluate(result.model, test).rms < 1.2 * dc.evaluate(result.registration.geometry.points, test).rms


def test_twelve_poses_are_selected_on(twelve: Told, arm: Case) -> None:
    """Without a warning: leave-one-out errors of so few say nothing."""
    result = twelve.result
    assert "12 poses" in result.status
    assert "likelihood" in result.status
    assert dc.evaluate(result.model, arm.test).rms < dc.evaluate(result.registration.geometry.points, arm.test).rms


def test_progress_is_told(twelve: Told) -> None:
    tasks = list(dict.fromkeys(task for task, _, _ in twelve.steps))
    assert tasks == ["registration", "geometry", "hyper-parameters", "Gauss-Newton"]
    assert all(0 <= done <= total for _, done, total in twelve.steps)


# --- Ctrl-C -------------------------------------------------------------------------------------------------------


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
@pytest.mark.parametrize(("task", "at"), [("hyper-parameters", 1), ("hyper-parameters", 12), ("Gauss-Newton", 1)])
def test_ctrl_c_keeps_a_usable_model(task: str, at: int, arm: Case) -> None:
    scales = arm.result.selection.scales if task == "Gauss-Newton" else None
    result = dc.calibrate(arm.robot, arm.train, hyperparameters=scales, progress=interrupting(task, at))
    assert result.interrupted
    assert "interrupted" in result.status
    geometry = dc.evaluate(result.identification.geometry.points, arm.test).rms
    assert dc.evaluate(result.model, arm.test).rms < geometry
    assert bool(torch.isfinite(result.model.predict(arm.test.q[:3])[1]).all())


@pytest.mark.slow
def test_ctrl_c_in_the_second_search_keeps_the_first(arm: Case) -> None:
    """The first climbs from two starts, the second from what they found: the third climb is interrupted at once."""
    began = []

    def progress(name: str, done: int, total: int) -> None:
        if name == "hyper-parameters" and done == 1:
            began.append(total)
            if len(began) == 3:
                raise KeyboardInterrupt

    result = dc.calibrate(arm.robot, arm.train, progress=progress)
    assert len(began) == 3
    assert result.interrupted
    assert result.selection.interrupted
    assert not result.fit.solution.interrupted
    assert result.status.startswith(
        "interrupted in the search for scales, the best so far are kept; fitted with them: "
    )
    assert result.status.count("interrupted") == 1
    assert (
        dc.evaluate(result.model, arm.test).rms < 0.5 * dc.evaluate(result.identification.geometry.points, arm.test).rms
    )


def test_ctrl_c_before_the_first_step_leaves_geometry(arm: Case) -> None:
    given = arm.result.selection.scales
    result = dc.calibrate(arm.robot, arm.train, hyperparameters=given, progress=interrupting("Gauss-Newton", 0))
    assert result.interrupted
    assert "after 0 iterations" in result.status
    assert result.status.count("interrupted") == 1
    assert_close(result.model(arm.test.q), result.identification.geometry.points(arm.test.q), rtol=0, atol=1e-13)


def test_ctrl_c_before_there_is_anything_to_keep(arm: Case) -> None:
    for task in ("registration", "geometry"):
        with pytest.raises(KeyboardInterrupt):
            dc.calibrate(arm.robot, arm.train, progress=interrupting(task, 0))


def test_a_fit_that_does_not_converge_gives_advice_that_can_be_followed(
    arm: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Solver and time steps are not arguments of `calibrate`."""
    monkeypatch.setattr("diffeo_calib.calibration.calibrate.GaussNewton", partial(dc.GaussNewton, max_iterations=1))
    result = dc.calibrate(arm.robot, arm.train, hyperparameters=arm.result.selection.scales)
    assert not result.fit.converged
    assert result.fit.status in result.status
    assert result.model.report["status"] == result.fit.status
    assert "stopped at the limit of 1 iterations; judge it by held-out errors" in result.status
    assert "measure more poses or pass fewer `controls`" in result.status
    assert "max_iterations" not in result.status
    assert "advice" not in arm.result.status
    assert "judge it" not in arm.result.status


# --- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_units_and_pairings_that_cannot_be_right_are_refused(arm: Case) -> None:
    q, points = arm.train.q, arm.train.points
    for wrong, message in (
        (dc.Measurements(q, 1e3 * points), "do not have the robot's size.*length unit"),
        (dc.Measurements(q, 1e-3 * points), "do not have the robot's size.*length unit"),
        (dc.Measurements(q.deg2rad(), points), "do not have the robot's size.*angle unit"),
        (dc.Measurements(q.rad2deg(), points, doubt=False), "do not fit this robot.*angle unit"),
        (dc.Measurements(q, points.roll(1, 0)), "do not fit this robot.*one row too late: pair every configuration"),
        (dc.Measurements(q, points.roll(-1, 0)), "do not fit this robot.*one row too early: pair every configuration"),
        (dc.Measurements(q, points[torch.randperm(60, generator=seeded(0))]), "do not fit this robot.*that rows pair"),
        (dc.Measurements(q[:, [1, 0, 2, 3, 4, 5]], points), "do not fit this robot.*order of the joints"),
        (dc.Measurements(q[:, [0, 1, 2, 3, 5, 4]], points), "do not fit this robot.*order of the joints"),
    ):
        with pytest.raises(MeasurementError, match=message):
            dc.calibrate(arm.robot, wrong)


def test_another_number_or_order_of_joints_is_refused(arm: Case) -> None:
    q, points = arm.train.q, arm.train.points
    with pytest.raises(MeasurementError, match=r"expected 6 joints .waist_joint.*, got 5; check the base and tip"):
        dc.calibrate(arm.robot, dc.Measurements(q[:, :5], points))
    with pytest.raises(RobotError, match="put the columns in the robot's order"):
        dc.calibrate(arm.robot, dc.Measurements(q, points, joint_names=arm.robot.joint_names[::-1]))


@pytest.mark.parametrize("rows", [1, 2])
def test_too_few_rows_to_register(rows: int, arm: Case) -> None:
    with pytest.raises(MeasurementError, match=r"at least 3 poses, got .*measure more poses"):
        dc.calibrate(arm.robot, arm.train.rows(slice(rows)))


def test_one_configuration_measured_many_times_is_refused_for_what_it_is(arm: Case) -> None:
    q = arm.train.q[:1].repeat(30, 1)
    noise = 1e-5 * torch.randn(30, 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pytest.raises(MeasurementError, match=r"same configuration|does not move"):
        dc.calibrate(arm.robot, dc.Measurements(q, arm.train.points[:1] + noise))
