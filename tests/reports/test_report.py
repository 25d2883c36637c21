"""The HTML report: complete, self-contained, small, and true to the numbers it was made from."""

import re
from pathlib import Path

import pytest
import torch
from command_bank import Command
from kind_bank import ELSEWHERE, kind_named
from lxml import html
from product_bank import Case, usual_scales
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.analysis.findings import Findings, find
from diffeo_calib.reports.html.sections import figures, verdict
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
    """Sound HTML that loads nothing."""
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
    alone = command("evaluate", model, "--report", out)
    assert alone.code == 0
    assert "60 rows of the fit" in alone.out.replace("\n", " ")


def test_what_is_refused(files: tuple[Path, Path], tmp_path: Path, command: Command, arm: Case) -> None:
    """Options that do not go together, tolerances that are none, and rows of another kind; no page is written."""
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
        done = command("evaluate", model, "--report", out, *words)
        assert done.code == 1
        assert text in done.err
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
