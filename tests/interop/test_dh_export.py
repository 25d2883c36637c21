"""Denavit-Hartenberg tables of any chain: the same poses, few numbers, and no offsets of hundreds of metres."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from export_bank import configurations, own_poses, wrong
from robots_bank import CHAIN, CHAINS, draw
from scipy.spatial.transform import Rotation
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.dh import dh_table, write_dh
from diffeo_calib.robots import Chain, Geometry, Joint

EVERY = {**CHAINS, "every kind of mimic joint": CHAIN}
both_conventions = pytest.mark.parametrize("convention", ["standard", "craig"])


@both_conventions
@pytest.mark.parametrize("chain", EVERY.values(), ids=EVERY.keys())
def test_the_table_has_the_geometry_s_poses(chain: Chain, convention: str) -> None:
    for size in (0.0, 1e-3, 0.1):
        geometry, q = wrong(chain, size), configurations(chain)
        table = dh_table(geometry, convention)
        torch.testing.assert_close(table.poses(q), own_poses(geometry, q), rtol=0, atol=1e-12)
        assert table.names == chain.moving_names
        assert [row.kind == "revolute" for row in table.rows] == chain.revolute.tolist()


def test_rows_have_four_numbers() -> None:
    """alpha, a and theta, and either d or, next to a parallel axis, beta; a controller without beta is told where."""
    rows = dh_table(wrong(EVERY["arm"], 1e-3)).rows
    assert [row.beta != 0 for row in rows] == [False, True, False, False, False, False]
    assert [row.d == 0 for row in rows] == [row.beta != 0 for row in rows]


def planar(angle: float) -> Geometry:
    """Three axes that are parallel but for an angle of the second."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor(Rotation.from_rotvec([angle, angle / 3, 0]).as_matrix())
    turn[:3, 3] = torch.tensor([0.5, 0.0, 0.0])
    back = torch.linalg.inv(turn)
    back[:3, 3] = torch.tensor([0.5, 0.1, 0.0])
    joints = [Joint(f"j{k}", "revolute", T) for k, T in enumerate((torch.eye(4, dtype=torch.float64), turn, back))]
    return Geometry.nominal(Chain("planar", "base", "tip", joints))


@both_conventions
@pytest.mark.parametrize("angle", [0.0, 1e-15, 1e-9, 1e-6, 1e-3, 0.02, 0.04, 0.06, math.pi, math.pi - 1e-3, -2.0])
def test_nearly_parallel_axes(angle: float, convention: str) -> None:
    geometry = planar(angle)
    table, q = dh_table(geometry, convention), draw(30, 3)
    torch.testing.assert_close(table.poses(q), own_poses(geometry, q), rtol=0, atol=1e-12)
    assert all(abs(value) < 20 for row in table.rows for value in (row.a, row.d))
    assert all(abs(row.beta) < 0.06 for row in table.rows)


def test_a_ur10_has_its_maker_s_table(ur10_folder: Path) -> None:
    robot = dc.load_urdf(ur10_folder / "ur10_robot.urdf", "base_link", "ee_link")
    table = dh_table(Geometry.nominal(robot))
    found = np.abs([[row.a, row.d, row.alpha, row.theta, row.beta] for row in table.rows])
    quarter = math.pi / 2
    lengths = [[0, 0.1273], [0.612, 0], [0.5723, 0], [0, 0.163941], [0, 0.1157], [0, 0.0922]]
    twists = [quarter, 0, 0, quarter, quarter, quarter]  # the last one to the x axis of ee_link
    expected = [[*pair, twist, 0, 0] for pair, twist in zip(lengths, twists, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
    assert torch.equal(table.base, torch.eye(4, dtype=torch.float64))


def read_back(path: Path, length: str, angle: str, convention: str) -> tuple[Tensor, Chain, Tensor]:
    """Base, chain and tool of a file, read without the package's own code for it."""
    scale, turn = {"m": 1.0, "mm": 1e-3}[length], {"rad": 1.0, "deg": math.pi / 180}[angle]
    with path.open(newline="", encoding="utf-8") as file:
        first, *joints, last = csv.DictReader(file)
    fixed = []
    for row, name in ((first, "base"), (last, "tool")):
        assert (row["frame"], row["kind"], row[f"a_{length}"]) == (name, "fixed", "")
        T = np.eye(4)
        T[:3, 3] = [scale * float(row[f"{axis}_{length}"]) for axis in "xyz"]
        angles = [turn * float(row[f"{name}_{angle}"]) for name in ("roll", "pitch", "yaw")]
        T[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        fixed.append(torch.from_numpy(T))
    rows = [
        dc.DHRow(
            scale * float(row[f"a_{length}"]),
            turn * float(row[f"alpha_{angle}"]),
            scale * float(row[f"d_{length}"]),
            turn * float(row[f"theta_{angle}"]),
            row["kind"],
            {by: float(slope) for slope, by in (part.split() for part in row["mimic"].split(" + "))}
            if row.get("mimic")
            else None,
            float(row.get("mimic_offset (rad or m)") or 0.0),
            beta=turn * float(row[f"beta_{angle}"]),
        )
        for row in joints
    ]
    return fixed[0], dc.from_dh(rows, convention, [row["frame"] for row in joints]), fixed[1]


@pytest.mark.parametrize(("units", "convention"), [(("m", "rad"), "craig"), (("mm", "deg"), "standard")])
@pytest.mark.parametrize("name", ["arm", "slides", "every kind of mimic joint"])
def test_files_are_read_back(name: str, units: tuple[str, str], convention: str, tmp_path: Path) -> None:
    chain = EVERY[name]
    geometry, q = wrong(chain), configurations(chain)
    write_dh(geometry, tmp_path / "dh.csv", convention, length=units[0], angle=units[1])
    base, again, tool = read_back(tmp_path / "dh.csv", *units, convention)
    torch.testing.assert_close(base @ again(q) @ tool, own_poses(geometry, q), rtol=0, atol=1e-12)
    assert (again.joint_names, again.moving_names) == (chain.joint_names, chain.moving_names)


def test_wrong_options(tmp_path: Path) -> None:
    geometry = wrong(EVERY["arm"])
    for options, message in (
        ({"convention": "khalil"}, "`convention`: expected 'standard' or 'craig', got 'khalil'"),
        ({"length": "foot"}, "`length`: expected 'm' or 'mm' or 'cm' or 'inch', got 'foot'"),
        ({"angle": "grad"}, "`angle`: expected 'rad' or 'deg', got 'grad'"),
    ):
        with pytest.raises(InputError, match=message):
            write_dh(geometry, tmp_path / "dh.csv", **options)
    with pytest.raises(InputError, match="cannot be written"):
        write_dh(geometry, tmp_path / "none" / "dh.csv")
    assert not (tmp_path / "dh.csv").exists()
