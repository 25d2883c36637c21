"""Generated C against the program for NumPy and the torch model that it was made of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import two_arms_bank
from c_bank import CModel, needs_compiler
from deformation_bank import deformation_of, model_of
from robots_bank import CHAINS, draw

import diffeo_calib as dc
from diffeo_calib.interop import write_c
from diffeo_calib.interop.c_source import c_source
from diffeo_calib.kernels.profiles import PROFILES
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.program import program_of
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.robots.dh import DHRow
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime import build

pytestmark = needs_compiler
ROWS = 5
TOOL = twist_transform(draw(6, seed=6)).numpy()


def mostly_slow(name: str, quick: Sequence[str], every: Iterable[str]) -> pytest.MarkDecorator:
    """A parameter with these values; each costs a run of the compiler, so few are quick."""
    values = [value if value in quick else pytest.param(value, marks=pytest.mark.slow) for value in every]
    return pytest.mark.parametrize(name, values)


def c_model(deformation: GeodesicDeformation, folder: Path, tip: str | None = None) -> CModel:
    """The deformation in C, in the measuring frame."""
    program = program_of(deformation)
    assert program is not None
    program = program if tip is None else program.at(tip)
    n = program.chain.n
    settings = {"tool": TOOL, "frame": np.eye(4), "limits": np.tile([-np.inf, np.inf], (n, 1))}
    texts = {"robot": "robot", "joints": [], "frame_name": "the measuring frame", "remarks": []}
    for suffix, text in zip((".c", ".h"), c_source(program, "generated", "robot", **settings, **texts), strict=True):
        (folder / f"generated{suffix}").write_text(text)
    return CModel(folder / "generated.c", n, len(program.markers), "robot")


def agree(deformation: GeodesicDeformation, folder: Path, tolerance: float = 1e-12, *, tip: str | None = None) -> None:
    """Values to 1e-12, slopes to 1e-9 of the torch model; nearer to the program. ``tip``: carries the tool."""
    program, made = program_of(deformation), c_model(deformation, folder, tip)
    assert program is not None
    program = program if tip is None else program.at(tip)
    q = draw(ROWS, made.n, seed=5, size=3.0)
    points, slopes = made.points_and_jacobian(q.numpy())
    near(points, deformation(q).unflatten(1, (-1, 3)).numpy(), tolerance)
    near(slopes, deformation.jacobian(q).unflatten(1, (-1, 3)).numpy(), 1e-9)
    near(slopes, program.points_and_jacobian(q.numpy())[1], 1e-10)
    np.testing.assert_array_equal(made.points(q.numpy()), points)
    poses, slopes = made.poses_and_jacobian(q.numpy())
    expected, expected_slopes = program.poses_and_jacobian(q.numpy(), TOOL, "measuring")
    near(poses, expected, tolerance)
    near(slopes, expected_slopes, 1e-9)
    np.testing.assert_array_equal(made.poses(q.numpy()), poses)


def near(found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


@mostly_slow("name", ["slides", "mimic joints"], CHAINS)
def test_every_chain_with_gravity_sag(name: str, tmp_path: Path) -> None:
    agree(deformation_of(CHAINS[name]), tmp_path)


@mostly_slow("name", ["mimic slides"], CHAINS)
def test_every_chain_without_sag(name: str, tmp_path: Path) -> None:
    agree(deformation_of(CHAINS[name], elastic=False), tmp_path)


@mostly_slow("profile", ["matern52"], PROFILES)
def test_every_profile(profile: str, tmp_path: Path) -> None:
    """On lines, where there are no tables."""
    agree(deformation_of(CHAINS["gantry"], PROFILES[profile], integrator=dc.RK8(1)), tmp_path)


@mostly_slow("profile", [], PROFILES)
def test_tables_of_every_profile(profile: str, tmp_path: Path) -> None:
    agree(deformation_of(CHAINS["arm"], PROFILES[profile], integrator=dc.RK8(1)), tmp_path)


@pytest.mark.parametrize("joint", [0, 1])
def test_waves_of_gears(joint: float, tmp_path: Path) -> None:
    agree(still(deformation_of(CHAINS["arm"], waves=True), joint, 1), tmp_path)
    assert "add_waves" in (tmp_path / "generated.c").read_text()


def test_sums_in_place_of_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with more controls than are worth tables."""
    monkeypatch.setattr(build, "MOST_TABULATED", 0)
    agree(deformation_of(CHAINS["mimic slides"]), tmp_path)
    assert "interpolate" not in (tmp_path / "generated.c").read_text()


TREES = {
    "two arms": lambda robot: robot,
    "hand to hand": lambda robot: robot.reversed("left"),
    "slides on a torso": lambda _: dc.from_dh(
        [
            (0.1, 0.4, 0.3, 0.0, "prismatic"),
            (0.2, 0.3, 0.1),
            (0.3, -0.5, 0.0, 0.2, "prismatic"),
            DHRow(0.2, 0.7, 0.1, parent=1),
            DHRow(0.1, 0.2, 0.3, mimic={"j2": 0.5}),
        ],
        names=["j1", "j2", "left_slide", "j4", "j5"],
        tips={"left": 2, "right": 4},
    ),
}


@mostly_slow("name", ["two arms"], TREES)
@pytest.mark.parametrize("tip", [0, -1])
def test_branches_bend_a_common_torso(name: str, tip: int, tmp_path: Path) -> None:
    """Every branch weighs on the joints before it; a joint of another branch moves the tip by its sag alone."""
    robot = TREES[name](two_arms_bank.robot(tmp_path))
    deformation = deformation_of(robot, integrator=dc.RK4(1))
    agree(deformation, tmp_path, tip=robot.tips[tip])
    assert "on_path" in (tmp_path / "generated.c").read_text()


def test_a_branch_that_only_weighs(tmp_path: Path) -> None:
    two_arms_bank.robot(tmp_path)
    robot = dc.load_urdf(tmp_path / "two_arms.urdf", "base", "left", load=["right"])
    deformation = deformation_of(robot, integrator=dc.RK4(1))
    agree(deformation, tmp_path)
    slopes = c_model(deformation, tmp_path).points_and_jacobian(draw(1, robot.n, seed=5).numpy())[1]
    assert np.abs(slopes[..., robot.joint_names.index("right_shoulder")]).max() > 1e-6


def test_the_tip_of_the_tool_is_named(tmp_path: Path) -> None:
    model = model_of(two_arms_bank.robot(tmp_path))
    with pytest.raises(dc.DiffeoCalibError, match="has several tips; name its `tip`"):
        write_c(model, tmp_path / "m.c")
    files = write_c(model, tmp_path / "m.c", tip="right")
    made = CModel(files.source, model.robot.n, 2)
    q = draw(3, model.robot.n, seed=5)
    expected = model.tool_poses(q, tip="right", frame="base")
    near(made.poses(q.numpy()), expected.numpy(), 1e-12)
    assert "frame of the tip right" in files.header.read_text()


def still(deformation: GeodesicDeformation, joint: float, task: float) -> GeodesicDeformation:
    """With momenta of other size."""
    b, p, theta = deformation.momenta.tensors
    return GeodesicDeformation(
        deformation.spec, deformation.x, Momenta(joint * b, task * p, theta), deformation.integrator
    )


@pytest.mark.parametrize(("joint", "task"), [(0, 0), (0, 1), (1, 0)])
def test_flows_without_momenta_are_left_out(joint: float, task: float, tmp_path: Path) -> None:
    agree(still(deformation_of(CHAINS["serial"]), joint, task), tmp_path)
    text = (tmp_path / "generated.c").read_text()
    assert ("joint_flow" in text, "task_flow" in text) == (bool(joint), bool(task))


def test_large_sag(tmp_path: Path) -> None:
    """Angles where rotations are no longer a series."""
    deformation = deformation_of(CHAINS["serial"])
    b, p, theta = deformation.momenta.tensors
    large = Momenta(b, p, 20.0 * theta)
    agree(GeodesicDeformation(deformation.spec, deformation.x, large, deformation.integrator), tmp_path, 1e-11)


def test_points_far_from_the_measuring_frame(tmp_path: Path) -> None:
    deformation = deformation_of(CHAINS["serial"])
    nominal = deformation.spec.nominal
    assert isinstance(nominal, GeometryMap)
    base = nominal.geometry.base.clone()
    base[:3, 3] += 1e3
    spec = replace(deformation.spec, nominal=GeometryMap(replace(nominal.geometry, base=base), elastic=True))
    agree(GeodesicDeformation(spec, deformation.x, deformation.momenta, deformation.integrator), tmp_path, 1e-11)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[dc.CalibratedKinematics, CModel]:
    """A model of the six-axis arm with its tool in the base frame."""
    model, path = model_of(CHAINS["arm"]).with_tool(TOOL), tmp_path_factory.mktemp("c") / "arm-1.c"
    files = write_c(model, path)
    return model, CModel(files.source, 6, 2, files.prefix)


def test_results_in_the_base_frame(arm: tuple[dc.CalibratedKinematics, CModel]) -> None:
    model, made = arm
    q = draw(ROWS, 6, seed=5)
    poses, slopes = made.poses_and_jacobian(q.numpy())
    near(poses, model.tool_poses(q).numpy(), 1e-12)
    near(slopes, model.tool_jacobian(q).numpy(), 1e-9)
    base = model.geometry.base
    near(made.points(q.numpy()), ((model(q) - base[:3, 3]) @ base[:3, :3]).numpy(), 1e-12)


def test_results_in_the_measuring_frame(tmp_path: Path) -> None:
    model, q = model_of(CHAINS["serial"]), draw(ROWS, 4, seed=5)
    files = write_c(model, tmp_path / "m.c", tool=TOOL[:3, 3], frame="measuring", prefix="left_arm")
    assert files.functions == ("left_arm_markers", "left_arm_tool_pose", "left_arm_newton_step")
    made = CModel(files.source, 4, 2, files.prefix)
    near(made.poses(q.numpy()), model.tool_poses(q, TOOL[:3, 3], "measuring").numpy(), 1e-12)
    near(made.points(q.numpy()), model(q).numpy(), 1e-12)


def test_no_numbers_from_none(arm: tuple[dc.CalibratedKinematics, CModel]) -> None:
    """Joint values that are not finite give results that are not finite, no position of another configuration."""
    _, made = arm
    for bad in (np.nan, np.inf, -np.inf):
        for joint in range(6):
            q = np.zeros((1, 6))
            q[0, joint] = bad
            points, slopes = made.points_and_jacobian(q)
            assert np.isnan(points).all()
            assert np.isnan(slopes).any()
            assert np.isnan(made.poses(q)[0, :3]).all()
            after, error = made.newton_step(q[0], np.eye(4))
            assert np.isnan(error)
            assert np.isnan(after).all()


def test_whole_turns(arm: tuple[dc.CalibratedKinematics, CModel]) -> None:
    """Tables continue periodically, at their ends too."""
    model, made = arm
    q = torch.zeros(5, 6, dtype=torch.float64)
    q[:, 1] = torch.tensor([-1e-17, 0.0, 2 * np.pi, -2 * np.pi, 40.0])
    near(made.points(q.numpy()), made.points(q.numpy() + 2 * np.pi), 1e-12)
    base = model.geometry.base
    near(made.points(q.numpy()), ((model(q) - base[:3, 3]) @ base[:3, :3]).numpy(), 1e-12)
