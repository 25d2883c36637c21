"""Poses that `predict` writes are measurements that other commands read."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from command_bank import Command
from kind_bank import UNITS, kind_named

from diffeo_calib.measurements.poses import angle_between, rotation_matrices


@pytest.mark.parametrize(
    ("options", "columns"),
    [
        ([], ["rx", "ry", "rz"]),
        (["--rotation-angle", "rad"], ["rx", "ry", "rz"]),
        (["--convention", "quat_wxyz"], ["qw", "qx", "qy", "qz"]),
        (["--convention", "XYZ"], ["euler1", "euler2", "euler3"]),
    ],
)
def test_predict_with_poses(options: list[str], columns: list[str], command: Command, tmp_path: Path) -> None:
    kind, path = kind_named("poses"), tmp_path / "p.csv"
    done = command("predict", kind.file, kind.table("new")[0], *UNITS, *options, "-o", path)
    assert (done.code, done.err.strip()) == (0, "")
    assert "joints, poses and standard deviations" in done.out
    printed = re.search(r"`evaluate` and `fit` read these poses with (--.*)", done.out)
    assert printed is not None
    again = command("evaluate", kind.file, path, *UNITS, *shlex.split(printed[1]), "--json", tmp_path / "e.json")
    assert again.code == 0
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
