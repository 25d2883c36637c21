"""The HTML report: complete, self-contained, small, and true to the numbers it was made from."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest
import torch
from command_bank import Command
from kind_bank import kind_named
from lxml import html
from product_bank import Case, usual_scales
from simulated_body import HANDS, SimulatedUpperBody

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, MeasurementError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.analysis.findings import Findings, find
from diffeo_calib.reports.html.sentences import verdict
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.sensors.tables import divided

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


@pytest.mark.parametrize("name", ["arm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("slider",))])
def test_models_of_every_kind(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    case: Case = request.getfixturevalue(name)
    new = case.test[:SHOWN]
    found = made(tmp_path / "report.html", case.model, new)
    assert found.errors["calibrated"].rms == pytest.approx(dc.evaluate(case.model, new).rms)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"{1e3 * found.errors['calibrated'].rms:.3f}\u00a0mm calibrated" in text
    assert f"{SHOWN} rows that the model has not seen" in text
    assert len(text) < 3e6


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
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.1], [0.3, 0, 0.2], [-0.1, -0.2, 0.0]])).double()
    turn[:3, 3] = torch.tensor([0.5, -0.2, 0.1])
    moved = dc.Measurements(arm.test.q, arm.test.points @ turn[:3, :3].T + turn[:3, 3])
    registered = arm.model.registered(moved[:15])
    new = moved[15 : 15 + SHOWN]
    found = made(tmp_path / "registered.html", registered, new)
    assert found.errors["calibrated"].rms == pytest.approx(dc.evaluate(registered, new).rms)
    again = dc.recalibrate(arm.model, moved[:20]).model
    found = made(tmp_path / "again.html", again)
    assert found.errors["calibrated"].rms < 3e-4
    torch.testing.assert_close(found.rows.points[-20:], moved[:20].points, atol=1e-7, rtol=0)


@pytest.fixture(scope="module")
def body() -> tuple[dc.CalibratedKinematics, dc.Measurements]:
    """A model of two hands, and measurements of both that it has not seen."""
    true = SimulatedUpperBody(seed=2)
    seen, new = (dc.Measurements(*true.measure(SHOWN, seed=k), true.nominal.joint_names, on=HANDS) for k in (0, 5))
    scales = usual_scales(true.nominal).inflated(3.0)
    return dc.calibrate(true.nominal, seen, hyperparameters=scales).model, new


@pytest.mark.usefixtures("undrawn")
@pytest.mark.slow
def test_markers_on_several_tips_are_named(
    body: tuple[dc.CalibratedKinematics, dc.Measurements], tmp_path: Path
) -> None:
    model, new = body
    points = new.points.clone()
    points[7, 1, 2] += 0.01
    found = made(tmp_path / "new.html", model, dc.Measurements(new.q, points, new.joint_names, on=HANDS))
    text = html.fromstring((tmp_path / "new.html").read_text(encoding="utf-8")).text_content()
    for number, hand in enumerate(HANDS):
        assert f"marker {number} in the frame of {hand} [m]" in text
    assert found.shown.outliers[0].marker == 1
    assert f"1 on {HANDS[1]}" in text
    exchanged = dc.Measurements(new.q, new.points.flip(1), new.joint_names, on=HANDS[::-1])
    with pytest.raises(MeasurementError, match="other tips"):
        dc.write_report(model, tmp_path / "exchanged.html", exchanged)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.slow
def test_rows_of_the_fit_are_seen_from_its_own_frame(arm: Case, tmp_path: Path) -> None:
    """The table of a fit of two sessions holds half of its rows in another frame."""
    away = arm.train.points.clone()
    away[40:] += torch.tensor([0.3, -0.1, 0.2])
    names = ["monday <&>"] * 40 + ["tuesday"] * (len(away) - 40)
    table = dc.Measurements(arm.train.q, away, arm.robot.joint_names).with_sessions(names)
    table = table.with_line_numbers([2 + row for row in range(len(away))])
    result = dc.calibrate(arm.robot, table, hyperparameters=usual_scales(arm.robot))
    found = made(tmp_path / "report.html", result.model, table)
    assert found.errors["calibrated"].rms < 2.0 * result.left_out_rms
    assert found.shown.predictions.data.line_numbers[0] == 2
    unseen = arm.test[:SHOWN]
    new = dc.Measurements(unseen.q, unseen.points + torch.tensor([0.3, -0.1, 0.2]), arm.robot.joint_names)
    new = new.with_sessions(["tuesday"] * len(new))
    for rows in (new, result.aligned(new)):
        found = made(tmp_path / "new.html", result.model, rows)
        assert found.errors["calibrated"].rms < 2.0 * result.left_out_rms


@pytest.mark.usefixtures("undrawn")
def test_text_of_the_user_is_text(arm: Case, tmp_path: Path) -> None:
    """Names and notes are neither markup nor control characters."""
    assert arm.model.provenance is not None
    made(tmp_path / "report.html", arm.model, arm.test[:SHOWN], title="<script>alert(1)</script> \x1b[31m& co")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert "\x1b" not in text


def test_bad_places_are_input_errors(arm: Case, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="report"):
        dc.write_report(arm.model, tmp_path / "none" / "report.html")


def test_columns_with_gaps_are_shown_and_their_gaps_counted(files: tuple[Path, Path], tmp_path: Path) -> None:
    model, table = dc.load(files[0]), files[1]
    assert isinstance(model, dc.CalibratedKinematics)
    lines = table.read_text().splitlines()
    for line, gap in ((3, ""), (7, "NaN")):
        before, _, humidity = lines[line].rsplit(",", 2)
        lines[line] = f"{before},{gap},{humidity}"
    table.write_text("\n".join(lines) + "\n")
    data = dc.read_measurements(table, model.robot, ["x", "y", "z"], length="mm", angle="deg")
    found = made(tmp_path / "report.html", model, data)
    assert int(found.columns["air_temp"].isnan().sum()) == 2
    assert "2 of 40 rows have no value" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_five_hundred_poses_of_three_markers_are_small(tmp_path: Path) -> None:
    """Of a model that was fitted to 30 of them."""
    arm = dc.robots.simulated_arm.SimulatedArm(seed=0, markers=3)
    data = dc.Measurements(*arm.measure(530, seed=0))
    model = dc.calibrate(arm.nominal, data[:30], hyperparameters=usual_scales(arm.nominal)).model
    made(tmp_path / "report.html", model, data[30:])
    assert (tmp_path / "report.html").stat().st_size < 3e6


@pytest.fixture
def files(arm: Case, tmp_path: Path) -> tuple[Path, Path]:
    """A model file, and a table of new rows with a column of temperatures."""
    dc.save(arm.model, tmp_path / "arm.safetensors")
    plain = tmp_path / "plain.csv"
    named = arm.test[:40].with_joint_names(arm.robot.joint_names)
    write_measurements(plain, named, TableFormat("mm", "deg"), position=("x", "y", "z"))
    lines = plain.read_text().splitlines()
    extra = ["air_temp,humidity", *(f"{20 + 0.1 * k:.1f},{50 - k % 7}" for k in range(40))]
    table = tmp_path / "new.csv"
    table.write_text("\n".join(f"{line},{more}" for line, more in zip(lines, extra, strict=True)) + "\n")
    return tmp_path / "arm.safetensors", table


@pytest.mark.usefixtures("undrawn")
def test_the_command(files: tuple[Path, Path], tmp_path: Path, command: Command, arm: Case) -> None:
    model, table = files
    out = tmp_path / "report.html"
    done = command("report", model, "-o", out, "--data", table, *POSITION, "--against", "humidity")
    assert (done.code, done.err) == (0, "")
    assert f"report: {out}" in done.out
    assert "40 rows that the model has not seen" in done.out.replace("\n", " ")
    text = out.read_text(encoding="utf-8")
    check_page(text)
    assert "Errors against air_temp" in text
    assert "Errors against humidity" in text
    alone = command("report", model, "-o", out)
    assert alone.code == 0
    assert "60 rows of the fit" in alone.out.replace("\n", " ")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--against", "humidity"], "--data"),
        ([*POSITION], "--data"),
        (["--data", "TABLE"], "--length and --angle missing"),
        (["--data", "TABLE", *POSITION, "--against", "pressure"], "pressure"),
    ],
)
def test_options_that_do_not_go_together(
    files: tuple[Path, Path], tmp_path: Path, command: Command, arguments: list[str], text: str
) -> None:
    model, table = files
    words = [str(table) if word == "TABLE" else word for word in arguments]
    done = command("report", model, "-o", tmp_path / "report.html", *words)
    assert done.code == 1
    assert text in done.err
    assert not (tmp_path / "report.html").exists()


def test_rows_of_another_kind_are_refused_even_where_their_joints_are_those_of_the_fit(
    arm: Case, tmp_path: Path
) -> None:
    q, out = arm.train.q, tmp_path / "r.html"
    eye = torch.eye(4, dtype=torch.float64).expand(len(q), 4, 4)
    with pytest.raises(InputError, match="calibrated with points: expected measured points, got poses"):
        dc.write_report(arm.model, out, dc.Measurements.from_poses(q, eye))
    with pytest.raises(InputError, match="the markers of `data`: expected 1, got 2"):
        dc.write_report(arm.model, out, dc.Measurements(q, arm.train.points.repeat(1, 2, 1)))
    assert not out.exists()


def test_names_of_any_length_and_with_markup_fit_into_their_panels(tmp_path: Path) -> None:
    evil = "<img src=x onerror=alert(1)>&\"'</script>$x^2$"
    links = [(0.0, 1.57, 0.3), (0.4, 0.0, 0.0), (0.1, 1.57, 0.1)]
    robot = dc.from_dh(links, names=[f"{evil}{joint}{'y' * 200}" for joint in range(3)], name=evil)
    rng = torch.Generator().manual_seed(0)
    q = 3 * torch.rand(30, 3, dtype=torch.float64, generator=rng) - 1.5
    noise = 1e-5 * torch.randn(30, 1, 3, dtype=torch.float64, generator=rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DiffeoCalibWarning)
        data = dc.Measurements(q, Geometry.nominal(robot).points(q) + noise)
        model = dc.calibrate(robot, data, hyperparameters=usual_scales(robot), note=evil).model
    dc.write_report(model, tmp_path / "r.html", title=evil)
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "<img" not in text
    assert text.count("</script>") == text.count("<script")


@pytest.mark.usefixtures("undrawn")
def test_a_tolerance_is_judged(files: tuple[Path, Path], tmp_path: Path, command: Command) -> None:
    model, table = files
    out = tmp_path / "report.html"
    for tolerance, sentence in (("5mm", "Within the tolerance of 5 mm"), ("10um", "Above the tolerance of 0.01 mm")):
        done = command("report", model, "-o", out, "--data", table, *POSITION, "--tolerance", tolerance)
        assert done.code == 0, done.err
        assert sentence in done.out
        assert sentence in out.read_text(encoding="utf-8").replace("\u00a0", " ")


def test_rows_of_the_fit_are_not_held_against_a_tolerance(
    files: tuple[Path, Path], tmp_path: Path, command: Command, arm: Case
) -> None:
    fitted = arm.train[:30].with_joint_names(arm.robot.joint_names)
    write_measurements(tmp_path / "old.csv", fitted, TableFormat("mm", "deg"), position=("x", "y", "z"))
    out, given = tmp_path / "report.html", ("--data", tmp_path / "old.csv", *POSITION)
    done = command("report", files[0], "-o", out, *given, "--tolerance", "5mm")
    assert done.code == 1
    assert "--tolerance" in done.error
    assert "30 that did" in done.error
    assert not out.exists()


def test_measured_positions_decide_about_a_tolerance() -> None:
    """The error that a model of several kinds expects of itself is below it; new rows are not."""
    kind = kind_named("mixture")
    own = divided(kind.new)[0]
    assert own is not None
    tracked = own.table.device_rows()  # without those within sockets
    wrong = with_attributes(tracked, points=tracked.points + 0.003 * torch.sin(97.0 * tracked.points))
    found = find(kind.model, wrong)
    assert found.deviations.error.whole < 1e-3 < found.judged.value
    assert verdict(found, 1e-3).startswith("Above")
    new = find(kind.model, kind.new)
    assert new.shown.predictions is not None
    assert len(new.shown.predictions) == len(tracked) < new.count
    assert list(new.kinds) == ["position", "socket"]
    assert f"on {len(tracked)} rows that the model has not seen" in verdict(new)
    assert "Spread within sockets: " in verdict(new)
    assert new.errors["calibrated"].rms == pytest.approx(dc.evaluate(kind.model, kind.new).rms)
    assert verdict(find(kind.model), 1e-3).startswith("Within")


def test_a_tolerance_is_a_length(files: tuple[Path, Path], tmp_path: Path, command: Command) -> None:
    model, _ = files
    for text in ("0.5px", "0.15", "-1mm"):
        done = command("report", model, "-o", tmp_path / "report.html", "--tolerance", text)
        assert done.code == 1
        assert f"--tolerance {text}" in done.error


def test_consoles_complete_the_names_of_plots() -> None:
    assert {"residuals", "workspace", "transmissions"} <= set(dir(dc.plots))
    assert all(callable(getattr(dc.plots, name)) for name in dir(dc.plots))


def test_comparisons_are_read_in_a_console(arm: Case) -> None:
    found = repr(dc.compare(arm.model, arm.model))
    assert "tensor" not in found
    assert found.startswith("Comparison(rms: position 0.0000 mm")
    assert "no change was found" in found
