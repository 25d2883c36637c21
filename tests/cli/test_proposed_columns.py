"""What `init` makes of columns whose names leave something open, and what it says of those that it does not use."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import Command
from torch import Tensor

from diffeo_calib.robots.simulated_arm import SimulatedArm

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

ARM = SimulatedArm(seed=7)
JOINTS = [f"j{k}" for k in range(1, 7)]
ROWS = 40
Proposed = Callable[..., tuple[dict[str, Any], str]]


def rows() -> tuple[Tensor, Tensor]:
    """Joint values, deg, and places, mm."""
    q, points = ARM.measure(ROWS, seed=2)
    return q.rad2deg(), 1e3 * points[:, 0]


def nominal() -> Tensor:
    """(N, 4, 4) poses of the nominal flange, mm."""
    poses = ARM.nominal(rows()[0].deg2rad())
    poses[:, :3, 3] *= 1e3
    return poses


def noise(*shape: int, size: float) -> Tensor:
    return size * torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.fixture
def proposed(tmp_path: Path, command: Command) -> Proposed:
    """Entries that `init` proposes for columns of some names and numbers, and the text with its remarks."""

    def propose(*columns: tuple[list[str], Tensor]) -> tuple[dict[str, Any], str]:
        ARM.write_urdf(tmp_path / "arm.urdf")
        lines = torch.cat([values for _, values in columns], 1).tolist()
        cells = [",".join(f"{value:.5f}" for value in line) for line in lines]
        header = ",".join(name for names, _ in columns for name in names)
        (tmp_path / "t.csv").write_text("\n".join([header, *cells, ""]), encoding="utf-8")
        done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "c.toml", "--force")
        text = (tmp_path / "c.toml").read_text(encoding="utf-8") if done.code == 0 else done.error
        return tomllib.loads(text) if done.code == 0 else {}, text

    return propose


def test_of_equal_series_the_robot_decides(proposed: Proposed) -> None:
    q, points = rows()
    written, text = proposed(
        ([f"A{k}" for k in range(1, 7)], noise(ROWS, 6, size=40.0)), (JOINTS, q), (["x", "y", "z"], points)
    )
    assert written["joints"] == ",".join(JOINTS)
    assert "times better; not A1 to A6" in text


def test_series_that_the_robot_does_not_tell_apart_are_asked_for(
    proposed: Proposed, tmp_path: Path, command: Command
) -> None:
    q, points = rows()
    other = [f"A{k}" for k in range(1, 7)]
    written, text = proposed((other, q + noise(ROWS, 6, size=1e-4)), (JOINTS, q), (["x", "y", "z"], points))
    assert "joints" not in written
    for names in (other, JOINTS):
        assert f'# joints = "{",".join(names)}"  # uncomment the right line' in text
    assert command("fit", tmp_path / "c.toml").code == 1


def test_wished_places_are_known_by_their_numbers(proposed: Proposed) -> None:
    q, points = rows()
    names = [f"m{k}_{axis}" for k in (1, 2) for axis in "xyz"]
    written, text = proposed((JOINTS, q), (names, torch.cat([nominal()[:, :3, 3], points], 1)))
    assert written.get("position") == ["m2_x,m2_y,m2_z"], text
    assert "m1_x, m1_y, m1_z: marker 0 follows the nominal robot to 0.00" in text
    written, text = proposed((JOINTS, q), (names, torch.cat([points, points], 1)))
    assert written["position"] == ["m1_x,m1_y,m1_z"]
    assert "m2_x, m2_y, m2_z: marker 1 is a copy of marker 0 (counted from 0); not used" in text


def test_wished_places_alone_are_refused(proposed: Proposed) -> None:
    _, text = proposed((JOINTS, rows()[0]), (["goal_x", "goal_y", "goal_z"], nominal()[:, :3, 3]))
    assert "got goal_x, goal_y, goal_z: wished places" in text


@pytest.mark.parametrize("by_rows", [True, False])
def test_poses_as_sixteen_numbers(by_rows: bool, proposed: Proposed) -> None:
    q, points = rows()
    poses = nominal()
    poses[:, :3, 3] = points
    names = [f"O_T_EE[{k}]" for k in range(16)]
    written, _ = proposed((JOINTS, q), (names, (poses if by_rows else poses.mT).flatten(1)))
    order = torch.arange(16).view(4, 4) if by_rows else torch.arange(16).view(4, 4).mT
    assert written["position"] == [",".join(names[int(k)] for k in order[:3, 3])]
    assert written["rotation"] == ",".join(names[int(k)] for k in order[:3, :3].flatten())
    assert written["convention"] == "matrix"


def test_a_pose_keeps_the_last_joint_though_its_place_does_not_move(proposed: Proposed) -> None:
    q = rows()[0]
    q[:, 5] *= 0.1
    poses = ARM.nominal(q.deg2rad())
    poses[:, :3, 3] = 1e3 * poses[:, :3, 3] + noise(ROWS, 3, size=0.5)
    written, _ = proposed((JOINTS, q), ([f"T{row}{k}" for row in range(3) for k in range(4)], poses[:, :3].flatten(1)))
    assert written["joints"] == ",".join(JOINTS)
    assert written["convention"] == "matrix"


def test_units_of_names_that_the_numbers_contradict(proposed: Proposed) -> None:
    q, points = rows()
    _, text = proposed(([f"{name} [rad]" for name in JOINTS], q), (["x [mm]", "y [mm]", "z [mm]"], points))
    assert "the units that the file states exclude others" in text


def test_a_joint_without_a_column_is_named(proposed: Proposed) -> None:
    q, points = rows()
    some = [f"{name}.pos" for k, name in enumerate(ARM.nominal.joint_names) if k != 3]
    _, text = proposed((some, q[:, :5]), (["x", "y", "z"], points))
    assert f"No column is named after {ARM.nominal.joint_names[3]}" in text
