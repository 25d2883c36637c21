"""`fit`, `demo`, `plan`, `recalibrate` and `export`: what they print and write, as the functions of Python do."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import FORMAT, POSITION, STAGES, TABLE, Command, Outcome, Site
from export_bank import own_poses
from kind_bank import table_rows
from numbers_bank import normal
from product_bank import Case, simulated
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import read_joints, write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform


def test_three_stages_in_training_and_held_out(fitted: Outcome, site: Site, model: dc.CalibratedKinematics) -> None:
    assert fitted.err.strip() == ""
    parts = dict(zip(("28 training", "12 held out"), site.data.split(0.7, seed=0), strict=True))
    rms = {label: [fitted.numbers(stage, label)[0] for stage in STAGES] for label in parts}
    assert rms["12 held out"][0] > rms["12 held out"][1] > rms["12 held out"][2]
    for label, data in parts.items():
        found = dc.evaluate(model, data)
        expected = [1e3 * value for value in (found.rms, found.median, found.p95, found.max)]
        assert fitted.numbers(STAGES[2], label) == pytest.approx(expected, abs=1.01e-4)
    assert "look wrong" not in fitted.out
    assert model.report["outliers"] == 0
    (before, *_), (after, _, most, _) = (fitted.numbers(stage, "12 held out") for stage in STAGES[1:])
    words = f"held out: {after:.3f} mm RMS, 95 % below {most:.3f} (12 rows; geometry alone {before:.3f} mm RMS)"
    assert fitted.out.startswith(words)


@pytest.mark.usefixtures("given_scales")
def test_without_held_out_rows_and_all_that_can_be_printed(site: Site, command: Command, tmp_path: Path) -> None:
    """Joint columns of other names; other points and commas; a wrong row by its line; the solver, what parts do."""
    table, model, names = tmp_path / "t.csv", tmp_path / "all.safetensors", list("abcdef")
    (data := site.data.rows([*range(20)])).points[7] += 0.03  # of a copy
    write_measurements(table, data, TableFormat("m", "rad", "\t"), joints=names)
    given = ["--position", "x,y,z", "--length", "m", "--angle", "rad", "--joints", ",".join(names), "--sep", "\\t"]
    done = command.ran("--verbose", "fit", table, *site.robot(), *given, "--holdout", 0, "-o", model)
    assert not done.warnings
    assert "no row was held out: these are errors on rows that were fitted" in done.out
    assert re.search(r"leave-one-out RMS: position \d+\.\d+ mm", done.out) is not None
    for stage in STAGES:
        assert len(done.numbers(stage, "20 training")) == 4
    loaded: Any = dc.load(model)
    assert "1 of 20 training rows look wrong (numbers are lines of the file); none was dropped:\n  row 9: " in done.out
    assert (loaded.report["rows"], loaded.report["outliers"]) == (20, 1)
    assert loaded.robot.joint_names == site.arm.nominal.joint_names


@pytest.mark.usefixtures("given_scales")
def test_rows_along_motions_say_little_of_other_places(site: Site, command: Command, tmp_path: Path) -> None:
    q, model = site.arm.sample(10, seed=3), tmp_path / "motions.safetensors"
    steps = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    q = torch.cat([start + steps * (end - start) for start, end in zip(q[::2], q[1::2], strict=True)])
    points = site.arm.true_points(q) + 2e-5 * normal(len(q), 1, 3)
    data = dc.Measurements(q, points, site.arm.nominal.joint_names)
    write_measurements(table := tmp_path / "t.csv", data, FORMAT, position=POSITION.split(","))
    _, said, *others = command.ran(*site.fit(table, model)).out.splitlines()
    expected = next(line for line in others if "over the joint ranges of the fit" in line).split(": ")[1].split(";")[0]
    assert said == f"these lie along 5 motions, beside fitted rows: over the joint ranges expect {expected}"


@pytest.mark.usefixtures("given_scales")
def test_a_device_that_moved_half_way_fails_the_fit(tmp_path: Path, command: Command) -> None:
    arm = SimulatedArm(seed=0)
    q, points = arm.measure(90, seed=3)
    turn = twist_transform(torch.tensor([0.1, -0.05, 0.02, 0.03, 0.05, 0.1], dtype=torch.float64))
    points[55:] = points[55:] @ turn[:3, :3].mT + turn[:3, 3]
    table = tmp_path / "moved.csv"
    write_measurements(table, dc.Measurements(q, points, arm.nominal.joint_names), TableFormat("mm", "deg"))
    arm.write_urdf(tmp_path / "arm.urdf")
    robot = ["--robot", tmp_path / "arm.urdf", "--base", arm.nominal.base, "--tip", arm.nominal.tip]
    given = [*robot, "--position", "x,y,z", "--length", "mm", "--angle", "deg", "-o", tmp_path / "m.safetensors"]
    done = command("fit", table, *given)
    assert done.code == 1
    assert any("near row 57" in line for line in done.warnings)
    assert "from the model" in done.error
    assert "session" in done.error


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_demo(command: Command, tmp_path: Path) -> None:
    done = command.ran("demo", "--output", tmp_path / "demo", "--count", 30, silent=True)
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert names == {"arm.urdf", "measurements.csv", "model.safetensors", "report.html"}
    assert done.numbers("calibrated", "held out")[0] < done.numbers("geometric", "held out")[0]
    shown = re.search(r"  diffeo-calib (fit .*?)\n\n", done.out, re.DOTALL)
    model: Any = dc.load(tmp_path / "demo" / "model.safetensors")
    assert shown is not None, "the command that it runs"
    assert model.provenance.command == " ".join(f"diffeo-calib {shown[1]}".replace("\\\n", " ").split())


UNITS = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]


def planned(path: Path, robot: dc.Chain) -> tuple[torch.Tensor, list[int]]:
    return read_joints(path, replace(FORMAT, joints=robot)), [int(row["rank"]) for row in table_rows(path, ";")]


def test_first_poses_of_a_cell(site: Site, command: Command, tmp_path: Path) -> None:
    output = tmp_path / "poses.csv"
    cell = ["--tracker", "2500,300,600,0,0,1,40", "--floor", 100]
    cell += ["--range", "waist_joint=-60:90"]
    cell += ["--column", "600,0,80,400", "--marker", "50,0,100", "--draw", 200]
    done = command.ran("plan", *site.robot(), "-n", 25, "-o", output, *UNITS, *cell)
    robot = site.arm.nominal
    q, ranks = planned(output, robot)
    assert q.shape == (25, 6)
    assert sorted(ranks) == list(range(1, 26))
    tracker = dc.Tracker((2.5, 0.3, 0.6), (0.05, 0.0, 0.1), half_angle=math.radians(40))
    ranges = {"waist_joint": (-math.pi / 3, math.pi / 2)}
    drawn = dc.candidates(robot, 200, ranges=ranges, tracker=tracker, floor=0.1, column=(0.6, 0, 0.08, 0.4))
    expected = dc.plan(robot, drawn, 25, marker=(0.05, 0.0, 0.1))
    torch.testing.assert_close(q, expected.q, rtol=0, atol=1e-8)
    rms = float(expected.expected_rms[20])
    for shown in (rms, math.hypot(rms, expected.noise_rms)):  # of the model, and held out
        assert f" {1e3 * shown:.3f}" in done.out
    assert "25 of 200 configurations written to" in done.out


def test_poses_to_measure_again(site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path) -> None:
    first, again = tmp_path / "next.csv", tmp_path / "again.csv"
    file = site.folder / "model.safetensors"
    done = command.ran("plan", file, "-n", 6, "-o", first, *UNITS, "--candidates", site.csv)
    q, _ = planned(first, model.robot)
    torch.testing.assert_close(q, dc.plan(model, site.data.q, 6).q, rtol=0, atol=1e-8)
    done = command(
        *("plan", file, "-n", 6, "-o", again, *UNITS, "--candidates", site.csv),
        *("--free", "base", "--measured", first, "--target-poses", first),
    )
    assert done.code == 0, done.err
    expected = dc.plan(model, site.data.q, 6, free="base", measured=q, target=q)
    torch.testing.assert_close(planned(again, model.robot)[0], expected.q, rtol=0, atol=1e-8)
    done = command("plan", file, "-n", 4, "-o", again, *UNITS, "--candidates", site.csv, "--free", "base")
    rms = dc.plan(model, site.data.q, 4, free="base").expected_rms
    assert rms[2] > 0.01 > rms[3]
    assert "fewer than 3 poses do not show where the measuring device is now" in done.out
    assert f"{1e3 * float(rms[0]):.3f}" not in done.out  # its place, and no error of the robot


@pytest.fixture(scope="module")
def files(arm: Case, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("again")
    dc.save(arm.model, folder / "old.safetensors")
    robot = simulated(1)[0]
    data = dc.Measurements(*robot.measure(15, seed=5), joint_names=robot.nominal.joint_names)
    write_measurements(folder / "new.csv", data, FORMAT, position=[POSITION.split(",")])
    return {name: str(folder / name) for name in ("old.safetensors", "new.csv", "new.safetensors")}


@pytest.mark.slow
def test_a_new_model_and_what_has_changed(files: dict[str, str], command: Command) -> None:
    done = command.ran(
        "recalibrate", files["old.safetensors"], files["new.csv"], *TABLE, "-o", files["new.safetensors"]
    )
    assert "the markers are taken to be where they were (these rows show that to 0.0" in done.out
    assert len(dc.load(files["new.safetensors"]).configurations) == 75
    for free, named, other in (("base", True, False), ("remounted", False, False), ("both", False, True)):
        table = files["new.csv"], *TABLE, "--free", free, "-o", files["new.safetensors"]
        done = command("recalibrate", files["old.safetensors"], *table)
        assert ("are taken to be where they were" in done.out, "or are other ones" in done.out) == (named, other)
    compared = command.ran("recalibrate", files["old.safetensors"], files["new.safetensors"])
    assert "RMS from the model, device and markers found anew: position 0.0" in compared.out
    assert "no change was found" in compared.out


def written(path: Path, q: Tensor, offset: float = 0.0) -> str:
    robot, moved = simulated(1)[0], q.clone()
    moved[:, 2] += offset
    data = dc.Measurements(q, robot.true_points(moved), joint_names=robot.nominal.joint_names, doubt=False)
    write_measurements(path, data, FORMAT, position=[POSITION.split(",")])
    return str(path)


@pytest.mark.slow
def test_the_frame_of_a_robot_that_has_changed(files: dict[str, str], tmp_path: Path, command: Command) -> None:
    q, out = simulated(1)[0].sample(25, seed=5), ("-o", tmp_path / "new.safetensors")
    for offset in (0.0, 3e-3):
        table = written(tmp_path / "new.csv", q, offset)
        done = command.ran("recalibrate", files["old.safetensors"], table, *TABLE, *out)
        doubted = "deg, if the robot has not changed: a part of the change below is in this" in done.out
        assert (doubted, "has changed by" in done.out) == (offset > 0.0, offset > 0.0)


@pytest.mark.slow
def test_rows_that_test_no_change(arm: Case, files: dict[str, str], tmp_path: Path, command: Command) -> None:
    """Four rows of 20 lie within the old joint ranges: a change may be in the places, which nobody knows."""
    known = arm.model.configurations
    low, high = known.amin(0), known.amax(0)
    q = simulated(1)[0].sample(20, seed=5).clamp(low, high)
    q[4:, 2] = high[2] + 0.05 * (high[2] - low[2])
    entry = tmp_path / "result.json"
    table = written(tmp_path / "new.csv", q)
    done = command.ran("recalibrate", files["old.safetensors"], table, *TABLE, "--json", str(entry))
    assert "warning: only 4 rows lie within the joint ranges that the model knows" in done.err
    assert "a change of the robot, which was not tested, would be in them" in done.out
    assert "unmoved" not in done.out
    assert json.loads(entry.read_text())["results"]["rows_can_tell"] is False


OLD = Path(__file__).parents[1] / "interop" / "data" / "robot_format_3.safetensors"


@pytest.fixture
def path(arm: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("model") / "model.safetensors"
    dc.save(arm.model, found)
    return found


def row(done: Outcome, label: str) -> list[float]:
    (line,) = [line for line in done.out.splitlines() if line.startswith(f"│ {label} ")]
    return [float(cell) for cell in line.split("│")[2:-1] if cell.strip()]


@pytest.mark.slow
def test_all_files_of_one_command(arm: Case, path: Path, command: Command, tmp_path: Path) -> None:
    """The same bytes as the Python functions write, one row for each in the printed table, a robot of these poses."""
    model, ours, theirs = arm.model, tmp_path / "ours", tmp_path / "theirs"
    for folder in (ours, theirs):
        folder.mkdir()
    done = command(
        *("export", path, "--urdf", ours / "a.urdf", "--dh", ours / "dh.csv", "--dh-convention", "craig"),
        *("--joint-offsets", ours / "o.csv", "--correction-tables", ours / "t.csv", "--length", "mm", "--angle", "deg"),
    )
    assert (done.code, done.err.strip()) == (0, "")
    interop = dc.interop
    rigid = interop.rigid_kinematics(model, transmission=True)  # for use together with the correction tables
    interop.write_urdf(rigid.geometry, theirs / "a.urdf")
    interop.write_dh(rigid.geometry, theirs / "dh.csv", "craig", length="mm", angle="deg")
    interop.write_joint_offsets(model, theirs / "o.csv", length="mm", angle="deg")
    interop.write_correction_tables(model, theirs / "t.csv", length="mm", angle="deg")
    for name in ("a.urdf", "dh.csv", "o.csv", "t.csv"):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes(), name
    chain, q = dc.load_urdf(ours / "a.urdf", "base_link", "flange"), arm.test.q[:40]
    torch.testing.assert_close(chain(q), own_poses(rigid.geometry, q), rtol=0, atol=1e-12)
    place = " ".join(f"{1e3 * value:.3f}" for value in rigid.geometry.base[:3, 3].tolist())
    assert f"their robot base in the measuring frame: {place} mm" in done.out
    left_out = rigid.validated[rigid.how]
    assert model.summary is not None
    whole = [left_out, (left_out**2 + model.summary.leave_one_out_rms**2) ** 0.5]
    assert row(done, "--urdf, --dh and --correction-tables")[2:] == pytest.approx([1e3 * v for v in whole], abs=1e-4)
    assert row(done, "(the model itself)") == pytest.approx([1e3 * model.summary.leave_one_out_rms], abs=1e-4)
    assert row(done, "nominal robot, registered")[0] > row(done, "--urdf, --dh alone")[0]
    offsets = interop.best_joint_offsets(model).rigid
    with_tables, alone = row(done, "--urdf, --dh and --correction-tables"), row(done, "--urdf, --dh alone")
    assert with_tables[:2] == pytest.approx([1e3 * rigid.rms, 1e3 * rigid.largest], abs=1e-4)
    assert row(done, "--joint-offsets")[:2] == pytest.approx([1e3 * offsets.rms, 1e3 * offsets.largest], abs=1e-4)
    assert with_tables[0] < min(alone[0], row(done, "--correction-tables, nominal")[0])
    for words in ("reading + offset is the joint value", "a controller adds the correction", "nothing is known beyond"):
        assert words in done.out
    assert "DH rows with Hayati's beta, next to parallel axes: elbow_joint" in done.out


def test_old_files_need_the_urdf(command: Command, tmp_path: Path) -> None:
    new, urdf = tmp_path / "new.urdf", tmp_path / "arm.urdf"
    SimulatedArm(seed=1).write_urdf(urdf)
    done = command("export", OLD, "--urdf", new)
    assert done.code == 1
    assert "does not hold the URDF that it was fitted with" in done.error
    assert "--robot URDF" in done.error
    assert not new.exists()
    done = command.ran("export", OLD, "--urdf", new, "--robot", urdf, silent=True)
    assert "from the projection of the model" in done.out
    assert dc.load_urdf(new, "base_link", "flange").n == 6
