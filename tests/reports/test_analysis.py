"""Numbers of reports, against brute force and against the truth of the simulated arm."""

from pathlib import Path

import numpy as np
import pytest
import torch
from product_bank import Case
from scipy.stats import chi2
from table_bank import refused
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.reports.analysis import predictions
from diffeo_calib.reports.analysis.findings import Deviations, find, repeats_of, stages_of
from diffeo_calib.reports.analysis.predictions import SHARES, FitRows, Predictions, forecast
from diffeo_calib.reports.html.sections import advice, trust
from diffeo_calib.robots import SimulatedArm


def of(fast: str, *slow: str) -> pytest.MarkDecorator:
    """Cases as parameters, of which all but the first are slow."""
    return pytest.mark.parametrize("name", [fast, *(pytest.param(name, marks=pytest.mark.slow) for name in slow)])


@of("arm", "pair", "posed")
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


def test_a_fit_from_the_model_alone(arm: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its rows, their errors as the calibration found them before the fit, and what fewer rows reach."""
    rows, blocks = FitRows(arm.model), FitRows(arm.model)
    assert_close(rows.points, arm.train.points, atol=2e-8, rtol=0)
    assert torch.equal(rows.measurements.q, arm.train.q)
    errors, _ = rows.left_out
    assert float(errors.square().sum(1).mean().sqrt()) == pytest.approx(arm.result.left_out_rms, rel=0.05)
    curve = dict(rows.learning_curve())
    assert list(curve) == sorted(curve)
    assert list(curve)[-1] == len(arm.train)
    assert list(curve.values()) == sorted(curve.values(), reverse=True)
    fewer, scales = arm.train.rows(slice(0, 36)), arm.result.selection.scales
    found = dc.evaluate(dc.calibrate(arm.robot, fewer, hyperparameters=scales).model, arm.test).rms
    assert found == pytest.approx(curve[36], rel=0.35)
    monkeypatch.setattr(predictions, "WHOLE_COORDINATES", 0)
    monkeypatch.setattr(predictions, "BLOCK_COORDINATES", 60)
    assert rows.whole
    assert not blocks.whole
    assert blocks.learning_curve()[-1][0] < len(blocks)
    assert blocks.left_out[0].norm() > errors.norm()


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
    steps = 4e-4 * torch.arange(12, dtype=torch.float64)[:, None]
    neighbours = dc.Measurements(arm.test.q[:1] + steps, arm.model(arm.test.q[:1] + steps).detach())
    for none in (arm.test, neighbours, arm.test[[0, 0, 0, 1]]):  # the last are copies
        assert repeats_of(none, {"calibrated": arm.model}, 2e-5) is None


@of("arm", "posed")
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


@of("arm", "pair", "posed")
def test_expected_errors_are_those_the_model_claims(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    found = Deviations.of(case.model)
    if name == "posed":
        variance = case.model.predict_poses(found.q, noise=False)[1][:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)
    else:
        variance = case.model.predict(found.q, noise=False)[1].diagonal(dim1=-2, dim2=-1).sum(-1).mean(1)
    assert_close(found.deviation.square(), variance, rtol=1e-4, atol=0)
    low, high = case.train.q.amin(0), case.train.q.amax(0)
    assert bool(((found.q >= low) & (found.q <= high)).all())
    assert found.error.measured < found.error.workspace
    assert found.next is not None
    assert len(found.next) == 5


@pytest.mark.usefixtures("undrawn")
def test_errors_larger_than_expected_are_named_and_not_praised(arm: Case) -> None:
    test = arm.test[:60]
    noise = torch.randn(test.points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def said(size: float) -> str:
        return " ".join(advice(find(arm.model, dc.Measurements(test.q, test.points + size * noise))))

    assert "times as large" not in said(0.0)
    assert "times as large as the model expects" in said(1.5e-4)
    assert "not those of a calibrated robot" in said(0.01)


@pytest.mark.usefixtures("undrawn")
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


@pytest.mark.usefixtures("undrawn")
def test_rows_of_the_fit_and_of_a_registration_are_left_out_of_new_rows(arm: Case) -> None:
    test = arm.test[:60]
    found, same = find(arm.model, dc.Measurements.joined([arm.train, test])), find(arm.model, arm.train)
    assert (found.new, same.new) == (True, False)
    assert (len(found.predictions), len(same.predictions)) == (len(test), len(arm.train))
    assert found.errors["calibrated"].rms == pytest.approx(dc.evaluate(arm.model, test).rms)
    shifted = dc.Measurements(test.q, test.points + torch.tensor([0.3, 0.1, -0.2]))
    registered = arm.model.registered(shifted[:12])
    assert len(find(registered, shifted).predictions) == len(shifted) - 12
    assert not find(registered, shifted[:12]).new


@pytest.mark.usefixtures("undrawn")
def test_bad_arguments_are_input_errors(arm: Case) -> None:
    refused(
        ("calibrated model", lambda: find(arm.robot)),  # pyright: ignore[reportArgumentType]
        (r"dc\.Measurements", lambda: find(arm.model, arm.test.q)),
        ("warmth", lambda: find(arm.model, arm.test[:20], against=["warmth"])),
        ("left-handed", lambda: find(arm.model, dc.Measurements(arm.test.q, arm.test.points[..., [1, 0, 2]]))),
    )


def test_bands_of_transmission_errors_hold_the_truth(arm: Case) -> None:
    """Over 6 joints and 40 values each; what the bands of an arm claim errs together, so the limits are wide."""
    rows, inside, truth = FitRows(arm.model), [], SimulatedArm(seed=1)
    for joint, name in enumerate(arm.robot.joint_names):
        low, high = arm.train.q[:, joint].aminmax()
        values = torch.linspace(float(low), float(high), 40, dtype=torch.float64)
        at = torch.zeros(40, 6, dtype=torch.float64)
        at[:, joint] = values
        error = arm.model.transmission(name, values) - truth.components(at).transmission[:, joint]
        away = (error - error.mean()).abs() / rows.transmission_deviation(joint, values)
        inside.append(float((away < 1.96).double().mean()))
    assert 0.85 < np.mean(inside) <= 1.0, inside
