"""Hidden markers from the table to the report: calibration, files, registration anew, recalibration, commands."""

from __future__ import annotations

import csv
import json
from math import nan
from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import FORMAT, TABLE, Command, leave_undrawn
from product_bank import usual_scales
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.reports.analysis.predictions import FitRows, Predictions
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms

pytestmark = pytest.mark.slow  # several fits
ROWS, WRONG_ROW = 40, 7
INSIDE_95 = 7.8147


def arm(*, worn: float = 1.0) -> SimulatedArm:
    return SimulatedArm(seed=0, markers=3).worn(2, worn)


def hidden(data: dc.Measurements, seed: int, share: float = 0.3) -> dc.Measurements:
    """The same rows without some markers."""
    gone = torch.rand(data.points.shape[:2], generator=torch.Generator().manual_seed(seed)) < share
    gone[gone.all(1), 0] = False
    return dc.Measurements(data.q, data.points.masked_fill(gone[..., None], nan), data.joint_names)


def elsewhere(data: dc.Measurements) -> dc.Measurements:
    """The same rows seen from another place."""
    turn = rotation(torch.tensor([0.3, -2.0, 0.7], dtype=torch.float64))
    T = transforms(turn, torch.tensor([1.5, -0.4, 0.2], dtype=torch.float64))
    return dc.Measurements(data.q, data.points @ T[:3, :3].mT + T[:3, 3], data.joint_names)


def rows(count: int, seed: int, robot: SimulatedArm | None = None) -> dc.Measurements:
    robot = robot or arm()
    return dc.Measurements(*robot.measure(count, seed=seed), robot.nominal.joint_names)


@pytest.fixture(scope="module")
def some() -> dc.Measurements:
    """Rows with gaps, one of them with a wrong marker beside a hidden one."""
    data = hidden(rows(ROWS, 1), 0)
    points = data.points.clone()
    points[WRONG_ROW] = rows(ROWS, 1).points[WRONG_ROW]
    points[WRONG_ROW, 0], points[WRONG_ROW, 2, 1] = nan, points[WRONG_ROW, 2, 1] + 2e-3
    return dc.Measurements(data.q, points, data.joint_names)


@pytest.fixture(scope="module")
def result(some: dc.Measurements) -> Any:
    return dc.calibrate(arm().nominal, some)


def squares(model: dc.CalibratedKinematics, test: dc.Measurements) -> Tensor:
    mean, covariance = model.predict(test.q)
    away = (test.points - mean)[..., None]
    return (away.mT @ torch.linalg.solve(covariance, away)).flatten()


def test_calibration_with_gaps_is_nearly_as_good_as_without(some: dc.Measurements, result: Any) -> None:
    test = rows(100, 9)
    errors = {"hidden": dc.evaluate(result.model, test).rms}
    scales = result.selection.scales
    for name, given in (("all", rows(ROWS, 1)), ("whole rows", some.rows(some.visible.all(1)))):
        errors[name] = dc.evaluate(dc.calibrate(arm().nominal, given, hyperparameters=scales).model, test).rms
    assert errors["hidden"] < 1.3 * errors["all"] < 0.5 * errors["whole rows"]
    assert float((squares(result.model, test) < INSIDE_95).double().mean()) > 0.93


def test_only_the_wrong_marker_loses_its_weight(result: Any) -> None:
    (found,) = result.outliers
    assert (found.row, found.marker) == (WRONG_ROW, 2)
    assert "marker 2 alone is off" in found.reason
    weights = result.tails.weights[WRONG_ROW]
    assert float(weights[2]) < 0.1 < float(weights[1])
    assert float(weights[0]) == 1.0


def test_errors_are_those_of_what_was_seen(some: dc.Measurements, result: Any) -> None:
    found = dc.evaluate(result.model, some)
    distances = (some.points - result.model(some.q).detach()).norm(dim=-1)
    seen = distances[some.visible]
    assert_close(found.errors[some.visible], seen, rtol=1e-12, atol=0)
    assert bool(found.errors[~some.visible].isnan().all())
    assert found.rms == pytest.approx(float(seen.square().mean().sqrt()), rel=1e-12)
    assert found.median == pytest.approx(float(seen.quantile(0.5)), rel=1e-12)
    assert found.max == float(seen.max())
    assert f"({len(seen)} distances" in repr(found)


def test_model_file_knows_what_was_hidden(
    some: dc.Measurements, result: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dc.save(result.model, tmp_path / "model.safetensors")
    loaded = dc.load(tmp_path / "model.safetensors")
    assert isinstance(loaded, dc.CalibratedKinematics)
    fit_rows = FitRows(loaded)
    assert_close(fit_rows.points, some.points, rtol=0, atol=1e-8, equal_nan=True)
    predictions = Predictions.of_fit(fit_rows)
    assert bool((predictions.squares.isnan() == ~some.visible).all())
    assert 0.9 < predictions.coverage() <= 1.0
    dc.write_report(loaded, tmp_path / "report.html", hidden(rows(20, 5), 2))
    leave_undrawn(monkeypatch)
    dc.write_report(loaded, tmp_path / "fit.html")
    for name in ("report.html", "fit.html"):
        text = (tmp_path / name).read_text(encoding="utf-8")
        assert "NaN" not in text
        assert ">nan" not in text


def test_registration_anew_with_gaps(result: Any) -> None:
    new, test = elsewhere(rows(12, 5)), elsewhere(rows(60, 6))
    full, gaps = result.model.registered(new), result.model.registered(hidden(new, 3))
    assert dc.evaluate(gaps, test).rms < 1.3 * dc.evaluate(full, test).rms
    away = gaps.registration.transform[:3, 3] - full.registration.transform[:3, 3]
    assert float(away.norm()) < 4 * float(gaps.registration.frame_deviations[:3].norm())
    assert float((squares(gaps, test) < INSIDE_95).double().mean()) > 0.9
    wrong = hidden(new, 3).points.clone()
    wrong[4] += 0.01
    with pytest.warns(DiffeoCalibWarning, match="took no part: row 4;"):
        found = result.model.registered(dc.Measurements(new.q, wrong, new.joint_names)).registration
    assert found.outliers == (4,)


def test_sessions_with_gaps() -> None:
    every, test = rows(50, 21), rows(100, 22)
    points = every.points.clone()
    points[30:] += torch.tensor([4e-3, -2e-3, 3e-3], dtype=torch.float64)
    data, scales = hidden(dc.Measurements(every.q, points, every.joint_names), 6), usual_scales(arm().nominal)
    found = dc.calibrate(arm().nominal, data.with_sessions(["a"] * 30 + ["b"] * 20), hyperparameters=scales)
    # the shift is known to a tenth of a millimetre, and the errors are those of one set-up
    shift = found.sessions.transforms[1] @ torch.cat([every.points[40].mean(0), every.points.new_ones(1)])
    assert float((shift[:3] - points[40].mean(0)).norm()) < 2e-4
    assert dc.evaluate(found.model, test).rms < 1e-4


@pytest.mark.usefixtures("given_scales", "undrawn")
def test_command_line(command: Command, tmp_path: Path) -> None:
    robot, table, model = arm(), tmp_path / "table.csv", tmp_path / "model.safetensors"
    robot.write_urdf(tmp_path / "arm.urdf")
    data = hidden(rows(40, 1), 0)
    triples = [[f"{axis}{k}" for axis in "xyz"] for k in range(3)]
    write_measurements(table, data, FORMAT, position=triples)
    positions = [word for triple in triples for word in ("--position", ",".join(triple))]
    options = [*positions, *TABLE[2:], "--json", tmp_path / "result.json"]
    chain = ["--robot", tmp_path / "arm.urdf", "--base", "base_link", "--tip", "flange"]
    done = command("fit", table, *chain, *options, "-o", model, "--report", tmp_path / "report.html")
    assert done.code == 0
    counts = (~data.visible).sum(0).tolist()
    assert f"hidden in some of 40 rows: marker 0 in {counts[0]}, marker 1 in {counts[1]}" in done.out
    assert json.loads((tmp_path / "result.json").read_text())["results"]["errors"]["held_out"]
    done = command("evaluate", model, table, *options, "--residuals", tmp_path / "residuals.csv")
    assert done.code == 0
    with (tmp_path / "residuals.csv").open() as file:
        lines = list(csv.DictReader(file, delimiter=";"))
    assert [line["size"] != "" for line in lines] == data.visible.flatten().tolist()
    wrong = table.read_text().splitlines()
    cells = wrong[3].split(";")
    wrong[3] = ";".join([*cells[:6], *[""] * 9])
    table.write_text("\n".join(wrong))
    done = command("fit", table, *chain, *options, "-o", model)
    assert done.code == 0
    assert "no marker was seen in line 4: 1 row(s) left out" in done.err
