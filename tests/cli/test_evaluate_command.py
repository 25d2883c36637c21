"""`diffeo-calib evaluate`, with --free too, and `predict`; what they say about a model's origin."""

import hashlib
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import FORMAT, NOTE, POSITION, TABLE, Command, Site
from kind_bank import UNITS, kind_named
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.cli.models import registration_lines
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import angle_between, rotation_matrices
from diffeo_calib.robots.se3 import twist_transform

pytestmark = pytest.mark.usefixtures("fitted")


@pytest.fixture
def path(site: Site) -> Path:
    return site.folder / "model.safetensors"


def written(site: Site, path: Path, q: Tensor, points: Tensor) -> Path:
    data = dc.Measurements(q, points, site.data.joint_names, doubt=False)
    write_measurements(path, data, FORMAT, position=[POSITION.split(",")])
    return path


def numbers_in(path: Path) -> tuple[list[str], np.ndarray]:
    """Header and numbers of a table with `;` and decimal commas."""
    header, *rows = path.read_text().splitlines()
    return header.split(";"), np.array([[float(cell.replace(",", ".")) for cell in row.split(";")] for row in rows])


def test_evaluate(site: Site, path: Path, model: dc.CalibratedKinematics, command: Command, tmp_path: Path) -> None:
    """Numbers of all rows, and the residuals of each: measured minus predicted."""
    done = command.ran("evaluate", path, site.csv, *TABLE, "-o", tmp_path / "r.csv", silent=True)
    assert model.provenance is not None
    assert model.provenance.table_sha256 == hashlib.sha256(site.csv.read_bytes()).hexdigest()
    digest = model.provenance.table_sha256[:12]
    assert f"to robot 'simulated_arm', 28 rows, table sha256 {digest}...; note: {NOTE}" in done.out
    train, test = site.data.split(0.7, seed=0)
    for label, data in (("40 in all", site.data), ("28 used in the fit", train), ("12 not used in the fit", test)):
        found = dc.evaluate(model, data)
        expected = [1e3 * value for value in (found.rms, found.median, found.p95, found.max)]
        assert done.numbers(label) == pytest.approx(expected, abs=1.01e-4)
    _, *lines = (tmp_path / "r.csv").read_text().splitlines()
    cells = np.array([line.replace(",", ".").split(";")[:9] for line in lines])[:, [0, 1, 5, 6, 7]].astype(float)
    assert cells[:, 0].tolist() == list(range(2, 42))
    assert cells[:, 1].sum() == 28
    away = 1e3 * (site.data.points - model(site.data.q)).flatten(1).numpy()
    np.testing.assert_allclose(cells[:, 2:], away, atol=2e-4)


def test_rows_that_repeat_or_are_wrong(site: Site, path: Path, command: Command, tmp_path: Path) -> None:
    (train, test), copies = site.data.split(0.7, seed=0), site.data[[0, 1, 1]]
    q, points = site.data.q.round(decimals=4), site.data.points
    for one, own, count in ((q, points, len(train)), (test.q, test.points, 0)):
        done = command("evaluate", path, written(site, tmp_path / "t.csv", one, own), *TABLE)
        assert (f"{count} of 40 rows repeat joint values of the fit" in " ".join(done.out.split())) == bool(count)
    done = command("evaluate", path, written(site, tmp_path / "t.csv", copies.q, copies.points), *TABLE)
    assert "1 of 3 rows repeat an earlier row exactly: first row 4, of row 3" in done.warnings[0]
    points = site.data.points.clone()
    points[3] += 0.05
    points[30:] += torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)
    done = command.ran("evaluate", path, written(site, tmp_path / "t.csv", site.data.q, points), *TABLE)
    assert "11 of 40 rows look wrong (numbers are lines of the file):" in done.out
    (warning,) = done.warnings
    assert "10 rows look wrong that follow one another: lines 32 to 41 to the end of the table" in warning
    assert "moving the measuring device by 200 mm" in warning


def test_predict(site: Site, path: Path, model: dc.CalibratedKinematics, command: Command, tmp_path: Path) -> None:
    command.monkeypatch.setattr("diffeo_calib.cli.commands.evaluate.ROWS_AT_ONCE", 7)
    done = command.ran("predict", path, site.csv, *TABLE[2:], "-o", tmp_path / "p.csv", silent=True)
    assert [words in done.out for words in ("40 predictions written", f"; note: {NOTE}")] == [True, True]
    header, values = numbers_in(tmp_path / "p.csv")
    assert header == [*site.arm.nominal.joint_names, "x", "y", "z", "std_x", "std_y", "std_z"]
    mean, covariance = model.predict(site.data.q)
    deviations = np.sqrt(np.diagonal(covariance[:, 0].numpy(), axis1=1, axis2=2))
    np.testing.assert_allclose(values[:, :6], np.rad2deg(site.data.q.numpy()), rtol=1e-14)
    np.testing.assert_allclose(values[:, 6:9], 1e3 * mean[:, 0].numpy(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(values[:, 9:], 1e3 * deviations, rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "columns"),
    [
        ([], ["rx", "ry", "rz"]),
        (["--rotation-angle", "rad"], ["rx", "ry", "rz"]),
        (["--convention", "quat_wxyz"], ["qw", "qx", "qy", "qz"]),
        (["--convention", "XYZ"], ["euler1", "euler2", "euler3"]),
    ],
)
def test_predicted_poses(options: list[str], columns: list[str], command: Command, tmp_path: Path) -> None:
    kind, path = kind_named("poses"), tmp_path / "p.csv"
    done = command.ran("predict", kind.file, kind.table("new")[0], *UNITS, *options, "-o", path, silent=True)
    printed = re.search(r"`evaluate` and `fit` read these poses with (--.*)", done.out)
    assert printed is not None
    command.ran("evaluate", kind.file, path, *UNITS, *shlex.split(printed[1]), "--json", tmp_path / "e.json")
    assert json.loads((tmp_path / "e.json").read_text())["results"]["errors"]["all"]["rms_m"] < 1e-6
    header, *rows = path.read_text().splitlines()
    places, deviations = ["x", "y", "z", "std_x", "std_y", "std_z"], ["std_rx", "std_ry", "std_rz"]
    assert header.split(",") == [*kind.robot.joint_names, *places, *columns, *deviations]
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    poses, covariance = kind.model.predict_poses(kind.new.q)
    std = np.sqrt(np.diagonal(covariance.numpy(), axis1=1, axis2=2))
    unit = "rad" if "rad" in options else "deg"
    convention = options[1] if "--convention" in options else "rotvec"
    turned = rotation_matrices(values[:, 12:-3], convention, angle=unit)
    assert float(angle_between(turned, poses[:, :3, :3]).max()) < 1e-10
    np.testing.assert_allclose(values[:, 6:9], 1e3 * poses[:, :3, 3].numpy(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(values[:, 9:12], 1e3 * std[:, :3], rtol=1e-6)
    np.testing.assert_allclose(values[:, -3:], std[:, 3:] if unit == "rad" else np.degrees(std[:, 3:]), rtol=1e-6)


MOVE = twist_transform(torch.tensor([0.01, -0.02, 0.005, 0.004, -0.003, 0.006], dtype=torch.float64))
HERE = torch.eye(4, dtype=torch.float64)


def table(site: Site, path: Path, T: Tensor, rows: int, *, marker: float = 0.0, seed: int = 9) -> Path:
    """New measurements of the site's arm, seen from another place, the marker moved by so many metres."""
    q, points = site.arm.measure(rows, seed=seed)
    points = points + marker * site.arm.truth.poses(q)[:, None, :3, 0]
    return written(site, path, q, points @ T[:3, :3].mT + T[:3, 3])


MOVED = {
    0.0: r"moving the measuring device by (\S+) mm and 0\.4\d+ degrees explains (\S+) % of the squared error; ",
    0.01: r"moving the marker on the flange by (\S+) mm explains (\S+) % of the squared error; ",
}
"""By how far the marker moved, m: else the device did."""


@pytest.mark.parametrize("marker", MOVED)
def test_what_moved_is_named(marker: float, site: Site, path: Path, command: Command, tmp_path: Path) -> None:
    new = table(site, tmp_path / "a", HERE if marker else MOVE, 12, marker=marker)
    done = command("evaluate", path, new, *TABLE)
    (line,) = done.warnings
    advice = r"register the model first: `model.registered`, evaluate --free both\."
    found = re.fullmatch(f"warning: {MOVED[marker]}{advice}", line)
    assert done.code == 0
    assert found is not None, line
    assert float(found[1]) == pytest.approx(10.0, abs=0.4) if marker else float(found[1]) > 10.0
    assert float(found[2]) > 99.0


def test_registered(site: Site, path: Path, model: dc.CalibratedKinematics, command: Command, tmp_path: Path) -> None:
    new, output = table(site, tmp_path / "new.csv", MOVE, 8), tmp_path / "there.safetensors"
    done = command.ran("evaluate", path, new, *TABLE, "--free", "both", "-o", output, silent=True)
    assert done.numbers("8 with the places of the fit")[0] > 10.0
    assert done.numbers("8 with places found anew")[0] < 0.5
    for words in (
        *("8 rows took part: RMS ", "with each row left out in turn", "marker in the frame of 'flange': "),
        *("the measuring frame of the model, seen from the new one: ", "unmoved with probability"),
        f"registered model: {output}",
    ):
        assert words in done.out
    there = dc.load(output)
    assert isinstance(there, dc.CalibratedKinematics)
    assert there.registration is not None
    torch.testing.assert_close(there.registration.transform, MOVE, rtol=0, atol=3e-3)
    worn: Any = SimpleNamespace(registration=replace(there.registration, excess=5.0), on=there.on)
    said = "\n".join(registration_lines(worn))
    assert ("unmoved with" in said, "what else has changed is in them" in said) == (False, True)
    assert there.provenance == model.provenance
    again = command("evaluate", output, table(site, tmp_path / "rest.csv", MOVE, 30, seed=10), *TABLE)
    assert again.numbers("30 in all")[0] < 0.5
    assert "moving " not in again.out
    assert "in the frame of 'flange'" not in command.ran("evaluate", path, new, *TABLE, "--free", "base").out
