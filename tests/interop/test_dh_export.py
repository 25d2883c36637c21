"""Denavit-Hartenberg tables of any chain: the same poses, few numbers, and no offsets of hundreds of metres."""

import csv
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from export_bank import configurations, own_poses, wrong
from robots_bank import CHAIN, CHAINS, FOLDER, draw
from scipy.spatial.transform import Rotation
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.cli.commands.export import HASH
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.interop.dh import dh_table, write_dh, write_ur_kinematics
from diffeo_calib.robots import Chain, Geometry, Joint, SimulatedArm

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
        ({"length": "foot"}, "`length`: expected 'm' or 'mm' or 'cm' or 'um' or 'inch', got 'foot'"),
        ({"angle": "grad"}, "`angle`: expected 'rad' or 'deg', got 'grad'"),
    ):
        with pytest.raises(InputError, match=message):
            write_dh(geometry, tmp_path / "dh.csv", **options)
    assert not (tmp_path / "dh.csv").exists()


LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
UR10 = (FOLDER / "ur10.urdf").read_text()
"""As its description had it before the transforms were in a file of their own, and a tool."""


def load(path: Path, text: str, tip: str = "tool0", base: str = "base_link") -> Chain:
    path.write_text(text, encoding="utf-8")
    return dc.load_urdf(path, base, tip)


def read_yaml(path: Path) -> tuple[dict[str, list[float]], str]:
    """The numbers of each link, and the hash; every line is checked against the grammar of YAML 1.1."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "kinematics:"
    assert len(lines) == 1 + 6 * 7 + 1
    number = r"[-+]?[0-9]+\.[0-9]*(?:[eE][-+][0-9]+)?"  # of PyYAML and yaml-cpp: a point, and a sign of the exponent
    found: dict[str, list[float]] = {}
    for k, link in enumerate(LINKS):
        block = lines[1 + 7 * k : 8 + 7 * k]
        assert block[0] == f"  {link}:"
        found[link] = []
        for line, entry in zip(block[1:], ("x", "y", "z", "roll", "pitch", "yaw"), strict=True):
            match = re.fullmatch(rf"    {entry}: ({number})", line)
            assert match, line
            found[link].append(float(match[1]))
    assert lines[-1].startswith("  hash: ")
    return found, lines[-1].removeprefix("  hash: ")


def their_poses(links: dict[str, list[float]], q: Tensor) -> Tensor:
    """Poses of tool0 in base_link by the formula of ur_description: urdf/ur_macro.xacro."""
    poses = []
    for row in q.numpy():
        T = np.diag([-1.0, -1.0, 1.0, 1.0])  # base_link -> base_link_inertia: rpy="0 0 pi"
        for link, value in zip(LINKS, row, strict=True):
            origin, turn = np.eye(4), np.eye(4)
            origin[:3, 3] = links[link][:3]
            origin[:3, :3] = Rotation.from_euler("xyz", links[link][3:]).as_matrix()
            turn[:3, :3] = Rotation.from_rotvec([0, 0, value]).as_matrix()
            T = T @ origin @ turn
        poses.append(T)
    return torch.from_numpy(np.stack(poses))


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.05])
@pytest.mark.parametrize("prefix", ["", "left_"])
def test_their_formula_gives_the_geometry_s_poses(prefix: str, size: float, tmp_path: Path) -> None:
    robot = load(
        tmp_path / "ur.urdf",
        re.sub(r'(<link name|<joint name|link)="', rf'\1="{prefix}', UR10),
        f"{prefix}fingers",
        f"{prefix}base_link",
    )
    tool = dc.load_urdf(tmp_path / "ur.urdf", f"{prefix}base_link", f"{prefix}tool0")
    zero = torch.zeros(1, 6, dtype=torch.float64)
    flange = torch.linalg.inv(tool(zero)[0])
    for tip, rest in ((tool, flange @ tool(zero)[0]), (robot, flange @ robot(zero)[0])):
        geometry, q = wrong(tip, size), configurations(tip)
        write_ur_kinematics(geometry, tmp_path / "ur.yaml")
        links, _ = read_yaml(tmp_path / "ur.yaml")
        torch.testing.assert_close(their_poses(links, q) @ rest, own_poses(geometry, q), rtol=0, atol=1e-12)


def test_the_hash_and_robots_that_are_refused(tmp_path: Path) -> None:
    geometry = Geometry.nominal(load(tmp_path / "ur.urdf", UR10))
    write_ur_kinematics(geometry, tmp_path / "ur.yaml", hash="calib_4890363623803256388")
    assert read_yaml(tmp_path / "ur.yaml")[1] == "calib_4890363623803256388"
    assert [own[1] for own in HASH.finditer((tmp_path / "ur.yaml").read_text())] == ["calib_4890363623803256388"]
    write_ur_kinematics(geometry, tmp_path / "ur.yaml")
    assert HASH.search((tmp_path / "ur.yaml").read_text()) is None
    for text in ("two words", "a: b", "", "a\nb", "'quoted'", "# none"):
        with pytest.raises(InputError, match=r"`hash`: expected letters, digits and _"):
            write_ur_kinematics(geometry, tmp_path / "ur.yaml", hash=text)
    new, path = tmp_path / "new.yaml", tmp_path / "ur.urdf"
    with pytest.raises(RobotError, match=r"the joints of robot 'simulated_arm': expected shoulder_pan_joint, .*--urdf"):
        write_ur_kinematics(Geometry.nominal(SimulatedArm().nominal), new)
    for change, tip, base, message in (
        (("", ""), "tool0", "shoulder_link", r"expected shoulder_pan_joint"),
        (('name="elbow_joint" type="revolute"', 'name="elbow_joint" type="prismatic"'), "tool0", "base_link", "joints"),
        (("tool0", "tcp"), "fingers", "base_link", r"has no link 'tool0' below 'base_link'.*--robot URDF"),
        (("base_link", "ground"), "tool0", "ground", r"the base of robot 'ur10': expected base_link, got ground"),
        (("0 0.0922 0", "0.001 0.0922 0"), "tool0", "base_link", r"'tool0' .*on the axis of the last joint"),
    ):
        robot = load(path, UR10.replace(*change), tip, base)
        with pytest.raises(RobotError, match=message):
            write_ur_kinematics(Geometry.nominal(robot), new)
    assert not new.exists()
