"""All commands with measured poses."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import FORMAT, TABLE, Command, Outcome, Site
from product_bank import simulated_poses
from server_bank import Server
from table_bank import CONVENTIONS, read_table
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.commands.predict import reading_options
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.csv.writing import write_predictions
from diffeo_calib.measurements.poses import angle_between, rotation_matrices, transforms


@dataclass(frozen=True)
class Posed:
    """A table of measured poses with standard deviations, the command that fits it, and what it printed."""

    site: Site
    data: dc.Measurements
    table: list[str]
    fitted: Outcome

    @property
    def path(self) -> Path:
        return self.site.folder / "posed.safetensors"

    @property
    def model(self) -> dc.CalibratedKinematics:
        loaded = dc.load(self.path)
        assert isinstance(loaded, dc.CalibratedKinematics)
        return loaded


@pytest.fixture(scope="module")
def posed_site(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Posed:
    """20 poses, joints in deg, rotations as Euler angles in rad, lever 80 mm."""
    folder = tmp_path_factory.mktemp("posed")
    arm, data, _ = simulated_poses(20, lever=0.08)
    assert data.poses is not None
    known = dc.Measurements.from_poses(
        data.q, data.poses, data.joint_names, lever=0.08, position_std=2e-5, rotation_std=2e-4
    )
    site = Site(folder, arm, known)
    arm.write_urdf(site.urdf)
    written = replace(FORMAT, rotation=["ra", "rb", "rc"], convention="ZYX", rotation_angle="rad")
    write_measurements(site.csv, known, written, position=["mx", "my", "mz"])
    rotation = ["--rotation", "ra, rb ,rc", "--convention", "ZYX", "--rotation-angle", "rad", "--lever", "80"]
    std = ["--std", "std_mx,std_my,std_mz", "--rotation-std", "std_rx,std_ry,std_rz"]
    table = [*TABLE, *rotation, *std]
    path = folder / "posed.safetensors"
    options = [*site.robot(), *table, "-o", path, "--figure", folder / "e.png"]
    return Posed(site, known, table, server(["fit", site.csv, *options]))


def all_numbers(outcome: Outcome, *labels: str) -> list[float]:
    """Errors in mm and in deg of one row of a table."""
    rows = [line.split("│") for line in outcome.out.splitlines() if all(label in line for label in labels)]
    assert len(rows) == 1, outcome.out
    return [float(cell) for cell in (rows[0][-10:-2] if "expected RMS" in outcome.out else rows[0][-9:-1])]


@pytest.mark.slow
def test_fit_reads_poses_and_standard_deviations(
    posed_site: Posed, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dc.Measurements] = []

    def look(_: Any, data: dc.Measurements, **__: Any) -> None:
        seen.append(data)
        raise KeyboardInterrupt

    monkeypatch.setattr("diffeo_calib.cli.commands.fit.calibrate", look)
    site = posed_site.site
    done = command("fit", site.csv, *site.robot(), *posed_site.table, "-o", tmp_path / "m", "--holdout", 0)
    assert done.code == 130
    (found,) = seen
    assert found.joint_names == site.arm.nominal.joint_names
    assert found.lever == pytest.approx(0.08)
    for name in ("poses", "points", "std", "rotation_std", "covariance"):
        torch.testing.assert_close(getattr(found, name), getattr(posed_site.data, name), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "columns"),
    [
        ([], ["rx", "ry", "rz"]),
        (["--rotation-angle", "rad"], ["rx", "ry", "rz"]),
        (["--convention", "quat_wxyz"], ["qw", "qx", "qy", "qz"]),
        (["--convention", "XYZ"], ["euler1", "euler2", "euler3"]),
    ],
)
def test_predict_with_poses(
    options: list[str], columns: list[str], posed_site: Posed, command: Command, tmp_path: Path
) -> None:
    units = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]
    done = command("predict", posed_site.path, posed_site.site.csv, *units, *options, "-o", tmp_path / "p.csv")
    assert (done.code, done.err.strip()) == (0, "")
    assert "20 predictions written" in done.out
    assert "joints, poses and standard deviations" in done.out
    printed = re.search(r"`evaluate` and `fit` read these poses with (--.*)", done.out)
    assert printed is not None
    again = command("evaluate", posed_site.path, tmp_path / "p.csv", *units, *shlex.split(printed[1]))
    assert again.code == 0
    assert max(all_numbers(again, "20 in all")) < 1e-3
    header, *rows = (tmp_path / "p.csv").read_text().splitlines()
    deviations = ["std_rx", "std_ry", "std_rz"]
    expected = [*posed_site.site.arm.nominal.joint_names, "x", "y", "z", "std_x", "std_y", "std_z"]
    assert header.split(";") == [*expected, *columns, *deviations]
    values = np.array([[float(cell.replace(",", ".")) for cell in row.split(";")] for row in rows])
    poses, covariance = posed_site.model.predict_poses(posed_site.data.q)
    std = np.sqrt(np.diagonal(covariance.numpy(), axis1=1, axis2=2))
    unit = "rad" if "rad" in options else "deg"
    convention = options[1] if "--convention" in options else "rotvec"
    turned = rotation_matrices(values[:, 12:-3], convention, angle=unit)
    assert float(angle_between(turned, poses[:, :3, :3]).max()) < 1e-10
    np.testing.assert_allclose(values[:, 6:9], 1e3 * poses[:, :3, 3].numpy(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(values[:, 9:12], 1e3 * std[:, :3], rtol=1e-6)
    np.testing.assert_allclose(values[:, -3:], std[:, 3:] if unit == "rad" else np.degrees(std[:, 3:]), rtol=1e-6)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_predicted_poses_are_read_back_as_measurements(convention: str, tmp_path: Path) -> None:
    """In every convention, with the options that `predict` prints."""
    rng = np.random.default_rng(0)
    q, shifts = torch.from_numpy(rng.uniform(-3, 3, (9, 2))), torch.from_numpy(rng.uniform(-1, 1, (9, 3)))
    turns = rotation_matrices(torch.from_numpy(rng.uniform(-1.5, 1.5, (9, 3))), "rotvec")
    poses, std = transforms(turns, shifts), torch.full((9, 6), 1e-5, dtype=torch.float64)
    path, table = tmp_path / "p.csv", replace(FORMAT, convention=convention, rotation_angle="deg")
    write_predictions(path, [(q, poses, std)], table, joints=["a", "b"], poses=True)
    header = path.read_text().splitlines()[0].split(";")
    columns = header[header.index("std_z") + 1 : header.index("std_rx")]
    deviations = {"std": ["std_x", "std_y", "std_z"], "rotation_std": ["std_rx", "std_ry", "std_rz"]}
    data = read_table(path, ["a", "b"], ["x", "y", "z"], replace(table, rotation=columns, **deviations))
    assert_close(data.poses, poses, rtol=0, atol=1e-12)
    assert_close(data.q, q, rtol=1e-14, atol=0)
    assert_close(data.rotation_std, std[:, 3:], rtol=1e-12, atol=0)
    words = reading_options(table).split()
    assert words[words.index("--rotation") + 1] == ",".join(columns)
    assert ("--rotation-angle" in words) == (len(columns) == 3)
