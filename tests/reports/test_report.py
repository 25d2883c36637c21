"""The HTML report: complete, self-contained, true to its numbers; these against brute force and the simulated arm."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from command_bank import Command
from kind_bank import ELSEWHERE, kind_named
from lxml import html
from product_bank import Case, usual_scales
from scipy.stats import chi2
from table_bank import refused
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.analysis import predictions
from diffeo_calib.reports.analysis.findings import Deviations, Findings, find, repeats_of, stages_of
from diffeo_calib.reports.analysis.predictions import SHARES, FitRows, Predictions, forecast
from diffeo_calib.reports.html.sections import advice, figures, trust, verdict
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.sensors.kinds import divided

SECTIONS = ["errors", "where", "why", "trust", "repeatability", "record"]
SHOWN = 40
"""New rows: pages of few are as complete as pages of many, and drawn in less time."""
POSITION = ["--position", "x,y,z", "--length", "mm", "--angle", "deg"]


def made(path: Path, model: dc.CalibratedKinematics, data: dc.Measurements | None = None, **options: str) -> Findings:
    found = dc.write_report(model, path, data, **options)  # pyright: ignore[reportArgumentType]
    assert isinstance(found, Findings)
    check_page(path.read_text(encoding="utf-8"))
    return found


def check_page(text: str) -> None:
    page = html.fromstring(text)
    sections = [section.get("id") for section in page.iter("section")]
    assert [name for name in sections if name != "devices"] == SECTIONS  # sessions have devices
    ids = page.xpath("//@id")
    assert len(ids) == len(set(ids))
    anchors = {link.get("href").removeprefix("#") for link in page.iter("a")}
    assert anchors <= set(ids)
    assert set(SECTIONS) <= anchors
    assert not page.xpath("//script/@src | //img/@src | //iframe | //link[@rel='stylesheet']")
    assert not re.search(r"https?://(?!www\.w3\.org/)", text)
    assert "@import" not in text
    assert not re.search(r"\bnan\b|\binf\b|\bNone\b", page.text_content())
    for reference in re.findall(r'(?:url\(#|href="#)([^)"]+)', text):
        assert reference in ids, reference
    assert all(figure.get("aria-label") for figure in page.iter("figure"))
    assert all(len(figure.xpath(".//*[local-name()='path']")) > 3 for figure in page.iter("figure"))


def test_new_rows(arm: Case, tmp_path: Path) -> None:
    new = arm.test[:SHOWN]
    found = made(tmp_path / "report.html", arm.model, new)
    assert found.errors["calibrated"].rms == pytest.approx(dc.evaluate(arm.model, new).rms)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"{1e3 * found.errors['calibrated'].rms:.3f}\u00a0mm calibrated" in text
    assert f"{SHOWN} rows that the model has not seen" in text
    assert len(text) < 3e6
    errors, top = found.errors["calibrated"], dict(figures(found))
    assert top["calibrated, RMS"] == f"{1e3 * errors.rms:.3f} mm"
    assert top["95 % of errors below"] == f"{1e3 * errors.p95:.3f} mm"
    assert top["inside claimed 95 % regions"].startswith(f"{found.predictions.inside()[0]} of {SHOWN} ")
    panels = dc.plots.pictures(arm.model, new)
    assert {"distributions-0", "before-after-0", "expected-0", "parts", "transmission-5", "coverage"} <= set(panels)
    (axes,) = panels["distributions-0"].axes
    assert (axes.get_xlabel(), len(axes.lines)) == ("position error [mm]", 3)


@pytest.mark.usefixtures("undrawn")
def test_without_measurements_the_rows_of_the_fit_are_left_out_one_by_one(arm: Case, tmp_path: Path) -> None:
    found = made(tmp_path / "report.html", arm.model)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "60 rows of the fit, each predicted by all others" in text
    assert found.errors["calibrated"].rms > 1.5 * dc.evaluate(arm.model, arm.train).rms
    assert arm.model.provenance is not None
    assert arm.model.provenance.table_sha256 in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.slow
def test_a_registered_and_a_recalibrated_model(arm: Case, tmp_path: Path) -> None:
    moved = arm.test.in_frames(twist_transform(ELSEWHERE).expand(len(arm.test), 4, 4))
    registered, new = arm.model.registered(moved[:15]), moved[15 : 15 + SHOWN]
    found = made(tmp_path / "registered.html", registered, new)
    assert found.errors["calibrated"].rms == pytest.approx(dc.evaluate(registered, new).rms)
    found = made(tmp_path / "again.html", dc.recalibrate(arm.model, moved[:20]).model)
    assert found.errors["calibrated"].rms < 3e-4
    torch.testing.assert_close(found.rows.points[-20:], moved[:20].points, atol=1e-7, rtol=0)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.slow
def test_rows_of_the_fit_are_seen_from_its_own_frame(arm: Case, tmp_path: Path) -> None:
    """The table of a fit of two sessions holds half of its rows in another frame."""
    shift, path = torch.tensor([0.3, -0.1, 0.2]), tmp_path / "report.html"
    away = arm.train.points.clone()
    away[40:] += shift
    names = ["monday <&>"] * 40 + ["tuesday"] * (len(away) - 40)
    table = dc.Measurements(arm.train.q, away).with_sessions(names).with_line_numbers(2 + torch.arange(len(away)))
    result = dc.calibrate(arm.robot, table, hyperparameters=usual_scales(arm.robot))
    found = made(path, result.model, table)
    assert found.predictions.data.line_numbers[0] == 2
    new = dc.Measurements(arm.test.q[:SHOWN], arm.test.points[:SHOWN] + shift).with_sessions(["tuesday"] * SHOWN)
    for one in (found, made(path, result.model, new), made(path, result.model, result.aligned(new))):
        assert one.errors["calibrated"].rms < 2.0 * result.left_out_rms


@pytest.fixture
def files(arm: Case, tmp_path: Path) -> tuple[Path, Path]:
    """A model file, and a table of new rows with columns of temperatures, two of them missing, and humidity."""
    dc.save(arm.model, tmp_path / "arm.safetensors")
    table = tmp_path / "new.csv"
    named = arm.test[:40].with_joint_names(arm.robot.joint_names)
    write_measurements(table, named, TableFormat("mm", "deg"), position=("x", "y", "z"))
    extra = ["air_temp,humidity", *(f"{20 + 0.1 * k:.1f},{50 - k % 7}" for k in range(40))]
    extra[3], extra[7] = ",48", "NaN,51"
    lines = table.read_text().splitlines()
    table.write_text("\n".join(f"{line},{more}" for line, more in zip(lines, extra, strict=True)) + "\n")
    return tmp_path / "arm.safetensors", table


@pytest.mark.usefixtures("undrawn")
def test_the_command(files: tuple[Path, Path], tmp_path: Path, command: Command) -> None:
    model, table = files
    out = tmp_path / "report.html"
    judged = ("5mm", "Within the tolerance of 5 mm", 0), ("10um", "Above the tolerance of 0.01 mm", 4)
    for tolerance, sentence, code in judged:
        words = (*POSITION, "--against", "humidity", "--tolerance", tolerance)
        done = command("evaluate", model, table, "--report", out, *words)
        assert (done.code, done.err) == (code, "")
        text = out.read_text(encoding="utf-8")
        check_page(text)
        assert sentence in done.out
        assert sentence in text.replace("\u00a0", " ")
    assert f"report: {out}" in done.out
    assert "40 rows that the model has not seen" in done.out.replace("\n", " ")
    assert "Errors against humidity" in text
    assert re.search(r"Errors against air_temp[^<]* 2 of 40 rows have no value", text)
    alone = command.ran("evaluate", model, "--report", out)
    assert "60 rows of the fit" in alone.out.replace("\n", " ")


def test_what_is_refused(files: tuple[Path, Path], tmp_path: Path, command: Command, arm: Case) -> None:
    (model, table), out, old = files, tmp_path / "report.html", tmp_path / "old.csv"
    fitted = arm.train[:30].with_joint_names(arm.robot.joint_names)
    write_measurements(old, fitted, TableFormat("mm", "deg"), position=("x", "y", "z"))
    wrong: tuple[tuple[list[object], str], ...] = (
        (["--against", "humidity"], "CSV"),
        ([*POSITION], "CSV"),
        ([table], "--length and --angle missing"),
        ([table, *POSITION, "--against", "pressure"], "pressure"),
        ([old, *POSITION, "--tolerance", "5mm"], "30 that did"),
        *((["--tolerance", text], f"--tolerance {text}") for text in ("0.5px", "0.15", "-1mm")),
    )
    for words, text in wrong:
        assert text in command.failed("evaluate", model, "--report", out, *words)
    q, eye, two = arm.train.q, torch.eye(4, dtype=torch.float64).expand(60, 4, 4), arm.train.points.repeat(1, 2, 1)
    poses, markers = dc.Measurements.from_poses(q, eye), dc.Measurements(q, two)
    refused(
        ("with points: expected measured points, got poses", lambda: dc.write_report(arm.model, out, poses)),
        ("the markers of `data`: expected 1, got 2", lambda: dc.write_report(arm.model, out, markers)),
        ("report", lambda: dc.write_report(arm.model, tmp_path / "none" / "report.html")),
    )
    assert not out.exists()


@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
def test_names_of_any_length_and_with_markup_fit_into_their_panels(tmp_path: Path) -> None:
    evil = "<img src=x onerror=alert(1)>&\"'</script>$x^2$"
    links = [(0.0, 1.57, 0.3), (0.4, 0.0, 0.0), (0.1, 1.57, 0.1)]
    robot = dc.from_dh(links, names=[f"{evil}{joint}{'y' * 200}" for joint in range(3)], name=evil)
    q, noise = torch.randn(30, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).split(3, 1)
    data = dc.Measurements(q, Geometry.nominal(robot).points(q) + 1e-5 * noise[:, None])
    model = dc.calibrate(robot, data, hyperparameters=usual_scales(robot), note=evil).model
    dc.write_report(model, tmp_path / "r.html", title=f"{evil}\x1b[31m")
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "<img" not in text
    assert "\x1b" not in text
    assert text.count("</script>") == text.count("<script")


def test_measured_positions_decide_about_a_tolerance() -> None:
    """The error that a model of several kinds expects of itself is below it; new rows are not."""
    kind = kind_named("mixture")
    own = divided(kind.new)[0]
    assert own is not None
    tracked = own.table
    wrong = with_attributes(tracked, points=tracked.points + 0.003 * torch.sin(97.0 * tracked.points))
    found = find(kind.model, wrong)
    assert found.deviations.error.whole < 1e-3 < found.judged.value
    assert verdict(found, 1e-3).startswith("Above")
    new = find(kind.model, kind.new)
    assert new.predictions is not None
    assert len(new.predictions) == len(tracked) < new.count
    assert list(new.kinds) == ["position", "socket"]
    assert f"on {len(tracked)} rows that the model has not seen" in verdict(new)
    assert "Spread within sockets: " in verdict(new)
    assert new.errors["calibrated"].rms == pytest.approx(dc.evaluate(kind.model, kind.new).rms)
    assert verdict(find(kind.model), 1e-3).startswith("Within")


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


def test_forecasts_and_shares_of_a_perfect_model(arm: Case) -> None:
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
def test_stages_of_a_model_are_those_of_its_fit(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
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
def test_wrong_rows_are_named_and_those_of_the_fit_left_out(arm: Case) -> None:
    test = arm.test[:60]
    noise = torch.randn(test.points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def said(size: float) -> str:
        return " ".join(advice(find(arm.model, dc.Measurements(test.q, test.points + size * noise))))

    assert "times as large" not in said(0.0)
    assert "times as large as the model expects" in said(1.5e-4)
    assert "not those of a calibrated robot" in said(0.01)
    test = arm.test[:60]
    points = test.points.clone()
    points[17] += 0.005
    found = find(arm.model, dc.Measurements(test.q, points))
    assert [one.row for one in found.outliers] == [17]
    assert trust(found).text[0].startswith("1 of 60 rows look wrong")
    assert found.moved == []
    turned = find(arm.model, dc.Measurements(test.q, test.points + torch.tensor([0.003, 0.0, 0.0])))
    assert any("measuring device" in text for text in turned.moved)
    test = arm.test[:60]
    found, same = find(arm.model, dc.Measurements.joined([arm.train, test])), find(arm.model, arm.train)
    assert (found.new, same.new) == (True, False)
    assert (len(found.predictions), len(same.predictions)) == (len(test), len(arm.train))
    assert found.errors["calibrated"].rms == pytest.approx(dc.evaluate(arm.model, test).rms)
    shifted = dc.Measurements(test.q, test.points + torch.tensor([0.3, 0.1, -0.2]))
    registered = arm.model.registered(shifted[:12])
    assert len(find(registered, shifted).predictions) == len(shifted) - 12
    assert not find(registered, shifted[:12]).new
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
