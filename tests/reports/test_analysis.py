"""Numbers of reports, against brute force and against the truth of the simulated arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from product_bank import Case, simulated, usual_scales, with_usual_scales
from scipy.stats import chi2

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.reports.analysis import predictions
from diffeo_calib.reports.analysis.findings import find
from diffeo_calib.reports.analysis.predictions import SHARES, FitRows, Predictions, forecast
from diffeo_calib.reports.analysis.stages import Deviations, repeats_of, stages_of
from diffeo_calib.reports.html.sections import trust
from diffeo_calib.reports.html.sentences import advice
from diffeo_calib.reports.plots.errors import draw_before_after, draw_distributions
from diffeo_calib.sensors.errors import Evaluation


@pytest.mark.parametrize(
    "name", ["arm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pair", "posed", "slider"))]
)
def test_a_model_knows_what_it_was_fitted_to(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    rows = FitRows(case.model)
    torch.testing.assert_close(rows.points, case.train.points, atol=2e-8, rtol=0)
    assert torch.equal(rows.measurements.q, case.train.q)


@pytest.mark.parametrize("name", ["arm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pair", "posed"))])
def test_left_out_errors_are_those_of_a_model_without_the_row(name: str, request: pytest.FixtureRequest) -> None:
    """The same conditional with one row struck out, by explicit matrices."""
    rows = FitRows(request.getfixturevalue(name).model)
    found, covariance = rows.left_out
    ((numbers, regression),) = rows.blocks
    target = rows.target[numbers]
    n, m = target.shape
    whole = regression.factor.matrix.numpy().reshape(n, m, n, m)
    for row in (0, 7, n - 1):
        others = np.delete(np.arange(n), row)
        inner = whole[others][:, :, others].reshape((n - 1) * m, -1)
        cross = whole[row][:, others].reshape(m, -1)
        weights = np.linalg.solve(inner, cross.T).T
        error = target[row].numpy() - weights @ target.numpy()[others].ravel()
        at = int(numbers[row])
        np.testing.assert_allclose(found[at].numpy(), error, rtol=1e-5, atol=1e-11)
        own = rows.map.noise.covariance[at].numpy()
        expected = whole[row][:, row] - weights @ cross.T - own + rows.map.new_noise.numpy()
        np.testing.assert_allclose(covariance[at].numpy(), expected, rtol=1e-4, atol=1e-15)


@pytest.mark.slow
def test_left_out_errors_agree_with_those_of_the_calibration(arm_200: Case) -> None:
    """The calibration found them around the geometric stage, the report around the fit."""
    errors, _ = FitRows(arm_200.model).left_out
    rms = float(errors.square().sum(1).mean().sqrt())
    assert rms == pytest.approx(arm_200.result.left_out_rms, rel=0.01)
    assert rms == pytest.approx(dc.evaluate(arm_200.model, arm_200.test).rms, rel=0.2)


@pytest.mark.slow
def test_of_very_many_rows_only_those_of_a_block_predict_one(arm_200: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, blocks = FitRows(arm_200.model), FitRows(arm_200.model)
    assert whole.whole
    errors = whole.left_out[0]
    monkeypatch.setattr(predictions, "WHOLE_COORDINATES", 0)
    monkeypatch.setattr(predictions, "BLOCK_COORDINATES", 100)
    assert not blocks.whole
    assert blocks.learning_curve()[-1][0] < len(blocks)
    assert blocks.left_out[0].norm() > errors.norm()


@pytest.mark.slow
def test_a_learning_curve_foretells_what_fewer_rows_reach(arm_200: Case) -> None:
    curve = dict(FitRows(arm_200.model).learning_curve())
    counts = list(curve)
    assert counts == sorted(counts)
    assert counts[-1] == len(arm_200.train)
    assert list(curve.values()) == sorted(curve.values(), reverse=True)
    fewer = arm_200.train.rows(slice(0, 80))
    scales = arm_200.result.selection.scales
    found = dc.evaluate(dc.calibrate(arm_200.robot, fewer, hyperparameters=scales).model, arm_200.test).rms
    assert found == pytest.approx(curve[80], rel=0.35)


def test_a_forecast_follows_a_power_law_above_the_limit() -> None:
    limit = 2e-5
    curve = [(n, ((3e-3 / n) ** 2 + limit**2) ** 0.5) for n in (25, 50, 100, 200)]
    found = forecast(curve, limit)
    assert found is not None
    rows, error = found
    assert rows == 400
    assert error == pytest.approx(((3e-3 / 400) ** 2 + limit**2) ** 0.5)
    assert forecast([(10, 1e-3), (20, 1.1e-3), (40, 1.2e-3)], limit) is None  # no improvement
    assert forecast(curve[:2], limit) is None  # too short
    assert forecast(curve, 1.0) is None  # below its limit


def test_found_shares_of_a_perfect_model_are_the_claimed_ones(arm: Case) -> None:
    seen = Predictions.of(arm.model, arm.test)
    factor = torch.linalg.cholesky(seen.covariance)
    draws = torch.randn(seen.away.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    perfect = seen.predicted + (factor @ draws[..., None])[..., 0]
    exact = Predictions(seen.data, perfect, seen.predicted, seen.covariance, seen.errors)
    np.testing.assert_allclose([exact.coverage(share) for share in SHARES.tolist()], SHARES, atol=0.07)
    squares = exact.squares.flatten().numpy()
    assert exact.coverage(0.8) == np.mean(squares <= chi2.ppf(0.8, 3))


def test_accuracy_and_repeatability_by_the_formulas_of_the_standard(arm: Case) -> None:
    rng = np.random.default_rng(0)
    q = arm.test.q[[0, 0, 0, 1, 2, 2, 2, 2]]
    points = arm.model(q).detach() + torch.from_numpy(rng.normal(scale=3e-5, size=(8, 1, 3)))
    found = repeats_of(dc.Measurements(q, points), {"calibrated": arm.model}, 2e-5)
    assert found is not None
    assert found.lines.tolist() == [0, 4]
    assert found.counts.tolist() == [3, 4]
    squares = 0.0
    for k, rows in enumerate(([0, 1, 2], [4, 5, 6, 7])):
        places = points[rows, 0].numpy()
        lengths = np.linalg.norm(places - places.mean(0), axis=1)
        squares += (lengths**2).sum()
        assert float(found.repeatability[k]) == pytest.approx(lengths.mean() + 3 * lengths.std(ddof=1))
        command = arm.model(q[rows[:1]]).detach()[0, 0].numpy()
        assert float(found.accuracy["calibrated"][k]) == pytest.approx(np.linalg.norm(places.mean(0) - command))
    assert found.deviation == pytest.approx((squares / 5) ** 0.5)
    assert repeats_of(arm.test, {"calibrated": arm.model}, 2e-5) is None


@pytest.mark.parametrize(
    "name", ["arm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pair", "posed", "slider"))]
)
def test_stages_from_a_model_are_those_of_its_calibration(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """`fit --report` and `evaluate --report` show the same numbers, the latter from the model file alone."""
    case: Case = request.getfixturevalue(name)
    dc.save(case.model, tmp_path / "model.safetensors")
    model = dc.load(tmp_path / "model.safetensors")
    assert isinstance(model, dc.CalibratedKinematics)
    for found, known in zip(stages_of(model).values(), case.result.stages.values(), strict=True):
        assert dc.evaluate(found, case.test).rms == pytest.approx(dc.evaluate(known, case.test).rms, rel=1e-5)


@pytest.mark.parametrize("name", ["arm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pair", "posed"))])
def test_expected_errors_are_those_the_model_claims(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    found = Deviations.of(case.model)
    if name == "posed":
        variance = case.model.predict_poses(found.q, noise=False)[1][:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)
    else:
        variance = case.model.predict(found.q, noise=False)[1].diagonal(dim1=-2, dim2=-1).sum(-1).mean(1)
    torch.testing.assert_close(found.deviation.square(), variance, rtol=1e-4, atol=0)
    low, high = case.train.q.amin(0), case.train.q.amax(0)
    assert bool(((found.q >= low) & (found.q <= high)).all())
    assert found.error.measured < found.error.workspace
    assert found.next is not None
    assert len(found.next) == 5


def test_errors_larger_than_expected_are_named(arm: Case) -> None:
    test = arm.test[:60]
    points = test.points + 1.5e-4 * torch.randn(test.points.shape, generator=torch.Generator().manual_seed(1))
    found = find(arm.model, dc.Measurements(test.q, points))
    assert any("times as large as the model expects" in text for text in advice(found)), list(advice(found))
    assert not any("times as large" in text for text in advice(find(arm.model, test)))


def test_outliers_and_moved_markers_are_named(arm: Case) -> None:
    test = arm.test[:60]
    points = test.points.clone()
    points[17] += 0.005
    found = find(arm.model, dc.Measurements(test.q, points))
    assert [one.row for one in found.outliers] == [17]
    assert trust(found).text[0].startswith("1 of 60 rows look wrong")
    assert found.moved == []
    turned = find(arm.model, dc.Measurements(test.q, test.points + torch.tensor([0.003, 0.0, 0.0])))
    assert any("measuring device" in text for text in turned.moved)


def test_rows_of_the_fit_are_left_out_of_new_rows(arm: Case) -> None:
    test = arm.test[:60]
    both = dc.Measurements.joined([arm.train, test])
    found = find(arm.model, both)
    assert found.new
    assert len(found.predictions) == len(test)
    assert found.errors["calibrated"].rms == pytest.approx(dc.evaluate(arm.model, test).rms)
    same = find(arm.model, arm.train)
    assert not same.new
    assert len(same.predictions) == len(arm.train)


@pytest.mark.slow
def test_models_with_control_points_and_with_outliers() -> None:
    arm, train, test = simulated(80)
    test = test[:100]
    points = train.points.clone()
    points[[3, 40]] += 0.004
    data = dc.Measurements(train.q, points)
    model = dc.calibrate(arm.nominal, data, hyperparameters=usual_scales(arm.nominal), controls=40).model
    with pytest.raises(InputError, match="control points"):
        find(model)
    assert find(model, test).errors["calibrated"].rms == pytest.approx(dc.evaluate(model, test).rms)
    found = find(model, data)
    assert {3, 40} <= {one.row for one in found.outliers}
    good = torch.ones(80, dtype=torch.bool)
    good[[3, 40]] = False
    rms = float(found.predictions.errors.rows(good).rms)
    assert rms == pytest.approx(dc.evaluate(model, test).rms, rel=0.3)


def test_bad_arguments_are_input_errors(arm: Case) -> None:
    with pytest.raises(InputError, match="calibrated model"):
        find(arm.robot)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"dc\.Measurements"):
        find(arm.model, arm.test.q)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="warmth"):
        find(arm.model, arm.test[:20], against=["warmth"])


def test_errors_that_no_calibrated_robot_has_are_not_praised(arm: Case) -> None:
    test = arm.test[:60]
    with pytest.raises(MeasurementError, match="left-handed"):
        find(arm.model, dc.Measurements(test.q, test.points[..., [1, 0, 2]]))
    noise = 0.01 * torch.randn(60, 1, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = find(arm.model, dc.Measurements(test.q, test.points + noise))
    assert any("not those of a calibrated robot" in text for text in found.moved)
    assert not any("Twice as many" in text for text in advice(found))


@pytest.mark.slow
def test_rows_that_placed_a_model_are_not_new(arm: Case) -> None:
    test = arm.test[:60]
    shifted = dc.Measurements(test.q, test.points + torch.tensor([0.3, 0.1, -0.2]))
    registered = arm.model.registered(shifted[:12])
    assert len(find(registered, shifted).predictions) == len(shifted) - 12
    assert not find(registered, shifted[:12]).new


def test_neighbours_and_copies_are_no_repeats(arm: Case) -> None:
    steps = 4e-4 * torch.arange(12, dtype=torch.float64)[:, None]
    path = arm.test.q[:1] + steps
    data = dc.Measurements(path, arm.model(path).detach())
    assert repeats_of(data, {"calibrated": arm.model}, 2e-5) is None
    copied = arm.test[[0, 0, 0, 1]]
    assert repeats_of(copied, {"calibrated": arm.model}, 2e-5) is None


@pytest.mark.slow
def test_bands_of_transmission_errors_hold_the_truth() -> None:
    """Over 2 arms, 6 joints and 40 values each; what one arm's bands claim errs together, so the limits are wide."""
    inside = []
    for seed in range(2):
        case_arm = dc.robots.simulated_arm.SimulatedArm(seed=seed)
        q, points = case_arm.measure(80, seed=seed)
        model = with_usual_scales(case_arm.nominal, dc.Measurements(q, points)).model
        rows = FitRows(model)
        for joint, name in enumerate(model.robot.joint_names):
            values = torch.linspace(float(q[:, joint].min()), float(q[:, joint].max()), 40, dtype=torch.float64)
            at = torch.zeros(40, 6, dtype=torch.float64)
            at[:, joint] = values
            true = case_arm.components(at).transmission[:, joint]
            error = (model.transmission(name, values) - true).numpy()
            away = np.abs(error - error.mean()) / rows.transmission_deviation(joint, values).numpy()
            inside.append(np.mean(away < 1.96))
    assert 0.85 < np.mean(inside) <= 1.0


# --- the plot of errors by stage ------------------------------------------------------------------------------------


def errors(rows: int, scale: float, seed: int, markers: int = 1) -> Evaluation:
    return Evaluation(scale * torch.from_numpy(np.random.default_rng(seed).exponential(size=(rows, markers))))


def panels(stages: dict[str, Evaluation]) -> tuple[Axes, Axes]:
    left, right = Figure().subplots(1, 2)
    draw_distributions(left, stages)
    draw_before_after(right, stages)
    return left, right


def millimetres(evaluation: Evaluation) -> np.ndarray:
    return 1e3 * evaluation.errors.flatten().numpy()


def points(axes: Axes) -> np.ndarray:
    """The points of a scatter plot: (N, 2)."""
    (scatter,) = axes.collections
    return np.asarray(scatter.get_offsets())


FIVE = {f"stage {k}": errors(30, 10.0**-k, k, markers=2) for k in range(3, 8)}


def test_every_stage_has_the_distribution_of_its_errors() -> None:
    left, _ = panels(FIVE)
    assert len(left.lines) == 5
    assert len({line.get_color() for line in left.lines}) == 5
    for line, (name, evaluation) in zip(left.lines, FIVE.items(), strict=True):
        np.testing.assert_allclose(np.asarray(line.get_xdata()), np.sort(millimetres(evaluation)), rtol=1e-12)
        np.testing.assert_allclose(np.asarray(line.get_ydata()), 100 * np.arange(1, 61) / 60, rtol=1e-12)
        assert line.get_label() == f"{name}: {1e3 * evaluation.rms:.3g} mm RMS"
    assert (left.get_xlabel(), left.get_ylabel()) == ("position error [mm]", "measurements [%]")
    assert left.get_xscale() == "log"
    assert left.get_ylim()[1] > 100.0
    legend = left.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [line.get_label() for line in left.lines]


def test_the_last_stage_is_drawn_against_the_one_before() -> None:
    _, right = panels(FIVE)
    before, after = millimetres(FIVE["stage 6"]), millimetres(FIVE["stage 7"])
    np.testing.assert_allclose(points(right), np.stack([before, after], 1), rtol=1e-12)
    assert (right.get_xlabel(), right.get_ylabel()) == ("stage 6: error [mm]", "stage 7: error [mm]")
    assert right.get_title() == f"better for {100 * (after < before).mean():.0f} % of the measurements"
    (diagonal,) = right.lines
    np.testing.assert_array_equal(diagonal.get_xdata(), diagonal.get_ydata())
    for low, high in (right.get_xlim(), right.get_ylim()):
        assert low < min(before.min(), after.min())
        assert high > max(before.max(), after.max())


def test_hardly_any_rows_and_errors_of_zero() -> None:
    """A logarithmic axis has no zero: they are drawn as tiny errors, without a warning."""
    stages = {"before": errors(1, 1e-3, 0), "after": Evaluation(torch.zeros(1, 1, dtype=torch.float64))}
    left, right = panels(stages)
    drawn = np.asarray(left.lines[1].get_xdata())
    assert 0.0 < drawn.min() <= drawn.max() < 1e-6
    np.testing.assert_allclose(points(right)[:, 1], drawn, rtol=1e-12)
