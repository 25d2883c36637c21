"""Models evaluated by NumPy, by programs of torch and by generated C: values of the torch model; what C files are."""

import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import two_arms_bank
from c_bank import C99, COMPILER, CPLUSPLUS, STRICT, CModel, c_model, compiled, needs_compiler
from deformation_bank import deformation_of, model_of
from robots_bank import CHAINS, draw
from scipy.spatial.transform import Rotation

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop import CFiles, write_c
from diffeo_calib.interop.c_source import array, number
from diffeo_calib.interop.torch_program import _ConstantPoints
from diffeo_calib.kernels.profiles import PROFILES
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.provenance import Provenance
from diffeo_calib.kinematics.tool import program_of
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.robots.dh import DHRow
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime import build
from diffeo_calib.runtime.program import Program
from diffeo_calib.runtime.tables import JointTables, PeriodicSum, tabulate

ROWS = 5
TOOL = twist_transform(draw(6, seed=6)).numpy()


def made(deformation: GeodesicDeformation, tip: str | None = None) -> Program:
    program = program_of(deformation)
    assert program is not None
    return program if tip is None else program.at(tip)


def agree(by: str, deformation: Any, folder: Path, tolerance: float = 1e-12, *, tip: str | None = None) -> None:
    """Values to 1e-12, slopes to 1e-9 (the derivative of tables) of the torch model; ``tip``: carries the tool."""
    program = made(deformation, tip)
    q = draw(ROWS, program.chain.n, seed=5, size=3.0)
    expected, expected_slopes = (found.unflatten(1, (-1, 3)) for found in (deformation(q), deformation.jacobian(q)))
    if by == "torch":
        near(_ConstantPoints(program)(q).reshape(expected.shape).numpy(), expected.numpy(), tolerance)
        return
    model = program if by == "numpy" else c_model(program, folder, TOOL)
    points, slopes = model.points_and_jacobian(q.numpy())
    near(points, expected.numpy(), tolerance)
    near(slopes, expected_slopes.numpy(), 1e-9)
    near(model.points(q.numpy()), points, 0.0 if by == "c" else tolerance)
    if isinstance(model, CModel):
        near(slopes, program.points_and_jacobian(q.numpy())[1], 1e-10)
        poses, slopes = model.poses_and_jacobian(q.numpy())
        expected, expected_slopes = program.poses_and_jacobian(q.numpy(), TOOL, "measuring")
        near(poses, expected, tolerance)
        near(slopes, expected_slopes, 1e-9)
        np.testing.assert_array_equal(model.poses(q.numpy()), poses)


def near(found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def scaled(deformation: GeodesicDeformation, joint: float, task: float, errors: float = 1.0) -> GeodesicDeformation:
    b, p, theta = deformation.momenta.tensors
    momenta = Momenta(joint * b, task * p, errors * theta)
    return GeodesicDeformation(deformation.spec, deformation.x, momenta, deformation.integrator)


def far_away(chain: dc.Chain) -> GeodesicDeformation:
    """Surveyors' coordinates: kilometres from the origin, where squared distances would cancel."""
    deformation = deformation_of(chain)
    nominal = deformation.spec.nominal
    assert isinstance(nominal, GeometryMap)
    base = nominal.geometry.base.clone()
    base[:3, 3] += 1e3
    spec = replace(deformation.spec, nominal=GeometryMap(replace(nominal.geometry, base=base), elastic=True))
    return GeodesicDeformation(spec, deformation.x, deformation.momenta, deformation.integrator)


CASES: dict[str, Callable[[], GeodesicDeformation]] = {
    **{f"{name} with sag": lambda chain=chain: deformation_of(chain) for name, chain in CHAINS.items()},
    **{
        f"{profile} on {where}": lambda p=profile, chain=CHAINS[robot]: deformation_of(chain, p, integrator=dc.RK8(1))
        for profile in PROFILES
        for robot, where in (("gantry", "lines"), ("arm", "circles"))  # the second in tables
    },
    "rigid": lambda: deformation_of(CHAINS["mimic slides"], elastic=False),
    "waves of the arm": lambda: deformation_of(CHAINS["arm"], waves=True),
    "waves, no sag": lambda: deformation_of(CHAINS["mimic slides"], elastic=False, waves=True),
    "no momenta": lambda: scaled(deformation_of(CHAINS["serial"]), 0, 0),
    "psi alone, with waves": lambda: scaled(deformation_of(CHAINS["mimic joints"], waves=True), 0, 1),
    "phi alone": lambda: scaled(deformation_of(CHAINS["serial"]), 1, 0),
    "large sag": lambda: scaled(deformation_of(CHAINS["serial"]), 1, 1, 20.0),  # rotations are no longer a series
    "far away": lambda: far_away(CHAINS["serial"]),
}
QUICK = ("slides with sag", "rigid", "matern52 on lines", "waves of the arm", "no momenta", "psi alone, with waves")
QUICK += ("phi alone", "large sag")
"""Those that are compiled in a default run."""


def cases() -> list:
    found = [pytest.param(by, case) for by in ("numpy", "torch") for case in CASES]
    slow = {case: [] if case in QUICK else [pytest.mark.slow] for case in CASES}
    return found + [pytest.param("c", case, marks=[needs_compiler, *slow[case]]) for case in CASES]


@pytest.mark.parametrize(("by", "case"), cases())
def test_points_slopes_and_poses(by: str, case: str, tmp_path: Path) -> None:
    deformation = CASES[case]()
    agree(by, deformation, tmp_path, 1e-11 if case in ("large sag", "far away") else 1e-12)
    if by == "c":  # without what vanishes
        text = (tmp_path / "generated.c").read_text()
        flows = "psi alone" not in case and case != "no momenta", case not in ("no momenta", "phi alone")
        assert tuple(f"{name}_flow" in text for name in ("joint", "task")) == flows
        assert [name in text for name in ("add_gears", "axis_waves")] == ["waves" in case] * 2


@needs_compiler
def test_sums_in_place_of_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "MOST_TABULATED", 0)
    agree("c", deformation_of(CHAINS["mimic slides"]), tmp_path)
    assert "interpolate" not in (tmp_path / "generated.c").read_text()


def test_maps_without_program_or_table() -> None:
    assert program_of(deformation_of(CHAINS["arm"], integrator=dc.TorchDiffEq())) is None
    assert tabulate([periodic_sum("gaussian", lengthscale=1e-4, count=400)]) is None


BRANCH = DHRow(0.2, 0.7, 0.1, parent=1), DHRow(0.1, 0.2, 0.3, mimic={"j2": 0.5})
TREES = {
    "two arms": lambda robot: robot,
    "hand to hand": lambda robot: robot.reversed("left"),
    "slides on a torso": lambda _: dc.from_dh(
        [DHRow(0.1, 0.4, 0.3, 0.0, "prismatic"), (0.2, 0.3, 0.1), (0.3, -0.5, 0.0, 0.2, "prismatic"), *BRANCH],
        **{"names": ["j1", "j2", "left_slide", "j4", "j5"], "tips": {"left": 2, "right": 4}},
    ),
}


@needs_compiler
@pytest.mark.parametrize("name", [pytest.param(k, marks=[pytest.mark.slow] * (k != "two arms")) for k in TREES])
def test_branches_bend_a_common_torso(name: str, tmp_path: Path) -> None:
    """Every branch weighs on the joints before it; a joint of another branch moves the tip by its sag alone."""
    robot = TREES[name](two_arms_bank.robot(tmp_path))
    agree("c", deformation_of(robot, integrator=dc.RK4(1)), tmp_path, tip=robot.tips[-(name == "two arms")])
    assert "on_path" in (tmp_path / "generated.c").read_text()


@needs_compiler
def test_a_branch_that_only_weighs(tmp_path: Path) -> None:
    two_arms_bank.robot(tmp_path)
    robot = dc.load_urdf(tmp_path / "two_arms.urdf", "base", "left", load=["right"])
    deformation = deformation_of(robot, integrator=dc.RK4(1))
    agree("c", deformation, tmp_path)
    slopes = c_model(made(deformation), tmp_path, TOOL).points_and_jacobian(draw(1, robot.n, seed=5).numpy())[1]
    assert np.abs(slopes[..., robot.joint_names.index("right_shoulder")]).max() > 1e-6


@needs_compiler
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


def periodic_sum(profile: str, lengthscale: float = 0.3, count: int = 40) -> PeriodicSum:
    """A sum with angles over several turns, some of them equal."""
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-7, 7, count - 2), [1.0, 1.0]])
    return PeriodicSum(profile, lengthscale, angles, 1e-3 * rng.normal(size=count))


@pytest.mark.parametrize("profile", [name for name in PROFILES if name != "matern32"])
def test_tables_interpolate_sums_of_several_kernels(profile: str) -> None:
    """Everywhere, also across 0 and at the controls, not only midway between the knots."""
    exact = [periodic_sum(profile), periodic_sum("gaussian", 0.5)]
    table = tabulate(exact)
    assert table is not None
    tables, x = JointTables.of((1,), ((table,),), 2), np.concatenate([np.linspace(-9.0, 9.0, 5001), exact[0].angles])
    values, slopes = tables.velocity_and_jacobian(0, np.stack([np.zeros_like(x), x], axis=1))
    wanted = sum(one.derivatives(x) for one in exact)
    near(values[:, 1], wanted[:, 0], 3e-13)
    near(slopes[:, 1, 1], wanted[:, 1], 1e-9)
    assert not values[:, 0].any()


FUNCTIONS = ("markers", "tool_pose", "newton_step")
HOME = np.array([0.3, -0.8, 1.1, 0.4, 0.9, -0.2])
LIMIT = 1.2
MAIN = """
#include <stdio.h>
#include "robot.h"
{functions}
int main(void)
{{
{body}
    return 0;
}}
"""
CORRECTED = """
    double start[6] = {0.3, -0.8, 1.1, 0.4, 0.9, -0.2}, q[6], T[16];
    robot_tool_pose(start, T, NULL);
    T[3] += 1e-3;
    if (!correct(start, T, q)) return 1;
    T[3] += 1e3;
    if (correct(start, T, q)) return 2;
"""


@pytest.fixture(scope="module")
def model() -> dc.CalibratedKinematics:
    model = model_of(CHAINS["arm"]).with_tool(TOOL)
    limited = [replace(joint, lower=-LIMIT, upper=LIMIT) for joint in model.robot.joints]
    model.robot = dc.Chain("limited", model.robot.base, model.robot.tip, limited)
    return model


@pytest.fixture(scope="module")
def files(model: dc.CalibratedKinematics, tmp_path_factory: pytest.TempPathFactory) -> CFiles:
    return write_c(model, tmp_path_factory.mktemp("c") / "robot.c")


@pytest.fixture(scope="module")
def arm(files: CFiles) -> CModel:
    return CModel(files.source, 6, 2)


@needs_compiler
def test_results_are_in_the_base_frame_and_periodic(model: dc.CalibratedKinematics, arm: CModel) -> None:
    """Tables continue periodically, at their ends too."""
    q, base = draw(5, 6, seed=5), model.geometry.base
    q[:, 1] = torch.tensor([-1e-17, 0.0, 2 * np.pi, -2 * np.pi, 40.0])
    poses, slopes = arm.poses_and_jacobian(q.numpy())
    np.testing.assert_allclose(poses, model.tool_poses(q), rtol=0, atol=1e-12)
    np.testing.assert_allclose(slopes, model.tool_jacobian(q), rtol=0, atol=1e-9)
    points = arm.points(q.numpy())
    np.testing.assert_allclose(points, (model(q) - base[:3, 3]) @ base[:3, :3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(arm.points(q.numpy() + 2 * np.pi), points, rtol=0, atol=1e-12)


@needs_compiler
def test_no_numbers_from_none(arm: CModel) -> None:
    """Joint values that are not finite give results that are not finite, no position of another configuration."""
    for bad in (np.nan, np.inf, -np.inf):
        for joint in range(6):
            q = np.zeros((1, 6))
            q[0, joint] = bad
            points, slopes = arm.points_and_jacobian(q)
            assert np.isnan(points).all()
            assert np.isnan(slopes).any()
            assert np.isnan(arm.poses(q)[0, :3]).all()
            after, error = arm.newton_step(q[0], np.eye(4))
            assert np.isnan(error)
            assert np.isnan(after).all()


def pose_at(made: CModel, q: np.ndarray) -> np.ndarray:
    return made.poses(q[None])[0]


def linearised(made: CModel, q: np.ndarray, target: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
    poses, slopes = made.poses_and_jacobian(q[None])
    turn = Rotation.from_matrix(target[:3, :3] @ poses[0, :3, :3].T).as_rotvec()
    error = np.concatenate([target[:3, 3] - poses[0, :3, 3], weight * turn])
    return error, np.diag([1.0, 1.0, 1.0, weight, weight, weight]) @ slopes[0]


@needs_compiler
@pytest.mark.parametrize("weight", [0.1, 1.0])
def test_a_free_step_is_newtons(arm: CModel, weight: float) -> None:
    target = pose_at(arm, HOME + 0.02)
    e, J = linearised(arm, HOME, target, weight)
    after, error = arm.newton_step(HOME, target, weight, bound=1.0)
    np.testing.assert_allclose(error, np.linalg.norm(e), rtol=1e-12)
    np.testing.assert_allclose(after - HOME, np.linalg.solve(J, e), rtol=0, atol=1e-6)


@needs_compiler
@pytest.mark.parametrize("bound", [1e-3, 0.03])
@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_a_bounded_step_is_the_best_of_its_length(arm: CModel, weight: float, bound: float) -> None:
    """On the bound the gradient is parallel to the step."""
    target = pose_at(arm, HOME + 0.1)
    e, J = linearised(arm, HOME, target, weight)
    step = arm.newton_step(HOME, target, weight, bound)[0] - HOME
    np.testing.assert_allclose(np.linalg.norm(step), bound, rtol=1e-3)
    gradient = J.T @ (e - J @ step)
    np.testing.assert_allclose(gradient @ step, np.linalg.norm(gradient) * np.linalg.norm(step), rtol=1e-3)


@needs_compiler
@pytest.mark.parametrize("angle", [1e-9, 0.3, 3.0, np.pi - 1e-7, np.pi])
def test_errors_of_large_rotations(arm: CModel, angle: float) -> None:
    """Up to half a turn, where the rotation vector is hard to read from the matrix."""
    start = pose_at(arm, HOME)
    for axis in [*np.eye(3), *draw(10, 3, seed=2).numpy()]:
        target = start.copy()
        target[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix() @ start[:3, :3]
        np.testing.assert_allclose(arm.newton_step(HOME, target, weight=2.0)[1], 2.0 * angle, rtol=1e-7, atol=1e-14)


@needs_compiler
def test_joints_stop_at_their_limits(arm: CModel) -> None:
    """The rest of the joints then does its best: the gradient in these vanishes in the end."""
    wanted = HOME.copy()
    wanted[2] = LIMIT + 0.2
    target, q = pose_at(arm, wanted), HOME
    for _ in range(50):
        q, error = arm.newton_step(q, target)
        assert (np.abs(q) <= LIMIT).all()
    assert q[2] == LIMIT
    assert error > 1e-4
    e, J = linearised(arm, q, target, 0.1)
    gradient = J.T @ e
    assert gradient[2] > 0  # it would go on
    assert (gradient * np.sign(q))[np.abs(q) == LIMIT].min() > 0
    assert np.abs(gradient[np.abs(q) < LIMIT]).max() < 1e-9
    beyond = HOME + np.array([LIMIT + 0.01 - HOME[0], 0, 0, 0, 0, 0])  # it comes back, and the rest makes up for it
    e, J = linearised(arm, beyond, pose_at(arm, beyond + 0.001), 0.1)
    expected = np.linalg.lstsq(J[:, 1:], e + 0.01 * J[:, 0], rcond=None)[0]
    after, _ = arm.newton_step(beyond, pose_at(arm, beyond + 0.001), bound=10.0)
    assert after[0] == LIMIT
    np.testing.assert_allclose(after[1:] - beyond[1:], expected, rtol=0, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("name", ["one joint", pytest.param("gantry", marks=pytest.mark.slow)])
def test_robots_of_fewer_joints(name: str, tmp_path: Path) -> None:
    chain, tool = CHAINS[name], TOOL[:3, 3]
    model = model_of(chain)
    files = write_c(model, tmp_path / "m.c", tool=tool, frame="measuring", prefix="left_arm")
    assert files.functions == ("left_arm_markers", "left_arm_tool_pose", "left_arm_newton_step")
    made, goal = CModel(files.source, chain.n, 2, files.prefix), 0.2 * torch.ones(1, chain.n, dtype=torch.float64)
    target = made.poses(goal.numpy())
    np.testing.assert_allclose(target, model.tool_poses(goal, tool, "measuring"), rtol=0, atol=1e-12)
    np.testing.assert_allclose(made.points(goal.numpy()), model(goal), rtol=0, atol=1e-12)
    q, error = 0.1 * np.ones(chain.n), 1.0
    for _ in range(10):
        q, error = made.newton_step(q, target[0])
    assert error < 1e-13


@needs_compiler
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
def test_names_and_memory(files: CFiles) -> None:
    """Only the documented names are global; mathematics alone is needed; no data can be written, by any thread."""
    target = files.source.with_suffix(".o")
    compiled([COMPILER, *C99, "-fno-stack-protector", "-c", files.source, "-o", target])
    listing = subprocess.run(["nm", target], capture_output=True, text=True, check=True, timeout=60).stdout
    words = [line.split() for line in listing.splitlines()]
    needed = {word[1].partition("@")[0] for word in words if len(word) == 2 and word[0] == "U"}
    defined = {word[2]: word[1] for word in words if len(word) == 3}
    assert needed <= {"sin", "cos", "sincos", "exp", "sqrt", "fmod", "atan2", "fabs", "memset", "memcpy", "memmove"}
    assert {name for name, kind in defined.items() if kind.isupper() and kind != "R"} == set(files.functions)
    assert files.functions == tuple(f"robot_{name}" for name in FUNCTIONS)
    assert [name for name, kind in defined.items() if kind in "bBdDcC"] == []


@needs_compiler
@pytest.mark.skipif(CPLUSPLUS is None, reason="no C++ compiler")
def test_the_files_are_cplusplus_too(files: CFiles, tmp_path: Path) -> None:
    compiled([CPLUSPLUS, "-std=c++11", *STRICT, "-O0", "-x", "c++", "-c", files.source, "-o", tmp_path / "robot.o"])


@needs_compiler
def test_the_example_of_the_header(files: CFiles, arm: CModel, tmp_path: Path) -> None:
    text = files.header.read_text()
    example = text[text.index(" * Example") : text.index(" */\n#ifndef")]
    lines = [line[7:] for line in example.splitlines() if line.startswith(" *     ")]
    (tmp_path / "main.c").write_text(MAIN.format(functions="\n".join(lines), body=CORRECTED))
    program, here = tmp_path / "main", ["-I", files.header.parent, f"-Wl,-rpath,{arm.path.parent}"]
    compiled([COMPILER, *C99, *here, "-o", program, tmp_path / "main.c", arm.path, "-lm"])
    subprocess.run([program], check=True, timeout=60)


@pytest.mark.slow
@needs_compiler
def test_undefined_behaviour_and_addresses(files: CFiles, tmp_path: Path) -> None:
    main = """
    double q[6] = {0.1, 0.2, 0.3}, p[6], J[36], T[16], K[36];
    int step;
    for (step = 0; step < 100; ++step) {
        robot_markers(q, p, J), robot_tool_pose(q, T, K), T[3] += 1e-3;
        robot_newton_step(q, T, 0.1, 0.5, q);
        q[step % 3] += 40.0;
    }
    q[0] = q[0] / (q[0] - q[0]), robot_markers(q, p, J), robot_newton_step(q, T, 0.1, 0.5, q);
    """
    (tmp_path / "main.c").write_text(MAIN.format(functions="", body=main))
    program, sanitizers = tmp_path / "main", "-fsanitize=undefined,address"
    command = [COMPILER, *C99, "-g", sanitizers, "-fno-sanitize-recover=all", "-I", files.header.parent]
    words = [*command, "-o", program, tmp_path / "main.c", files.source, "-lm"]
    linked = subprocess.run(words, capture_output=True, text=True, check=False)
    if linked.returncode and "cannot find" in linked.stderr:
        pytest.skip("no sanitizers")
    assert linked.returncode == 0, linked.stderr[:3000]
    subprocess.run([program], check=True, timeout=120)


def test_numbers_come_back_bit_for_bit() -> None:
    bits = np.random.default_rng(0).integers(0, 2**63 - 1, 2000, dtype=np.int64)
    values = bits.view(np.float64)[np.isfinite(bits.view(np.float64))]
    values = np.concatenate([values, -values, [0.0, -0.0, 5e-324, 1.7976931348623157e308]])
    read = [float(word) for word in re.split(r"[\s,{}]+", array(values)) if word]
    np.testing.assert_array_equal(np.array(read).view(np.int64), values.view(np.int64))
    assert (number(float("inf")), number(float("-inf")), number(3)) == ("HUGE_VAL", "-HUGE_VAL", "3")


@needs_compiler
def test_the_header_tells_what_it_is_of_and_names_cannot_end_a_comment(tmp_path: Path) -> None:
    model = model_of(CHAINS["one joint"]).with_tool([0.0, 0.1, 0.2])
    joint = replace(model.robot.joints[0], name="j */ /* ??/\n\\ \u2603 /*/", lower=-1.5, upper=float("inf"))
    slide = replace(joint, kind="prismatic", name="j0", lower=-float("inf"))
    model.robot = dc.Chain("*/ #error", model.robot.base, model.robot.tip, [joint])
    model.provenance = Provenance("2026-11-22T10:00:00+00:00", "0.1", "ab" * 32, 'serial */ 17\nof "two"')
    files = write_c(model, tmp_path / "my-robot 2.c")
    assert files.prefix == "my_robot_2"
    text = files.header.read_text()
    for words in ("fitted 2026-11-22", "[rad]: -1.5 to inf", "the robot's base", "0 1 0 0.1; 0 0 1 0.2"):
        assert words in text
    compiled([COMPILER, *C99, "-c", files.source, "-o", tmp_path / "robot.o"])
    model.robot = dc.Chain("slide", model.robot.base, model.robot.tip, [slide])
    assert "q[0]  j0 [m]: no limits" in write_c(model, tmp_path / "slide.c").header.read_text()


@pytest.mark.parametrize(
    ("path", "options", "message"),
    [
        ("model.cpp", {}, "`path`: expected the name of a C file"),
        ("model.c", {"frame": "world"}, "`frame`: expected 'base' or 'measuring', got 'world'"),
        ("model.c", {"prefix": "a-b"}, "prefix of names in C"),
        ("7axes.c", {}, "pass `prefix`"),
        ("model.c", {"tool": [1.0, 2.0]}, "tool"),
        ("no/such/model.c", {}, "cannot be written"),
    ],
)
def test_refusals(path: str, options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        write_c(model_of(CHAINS["one joint"]), tmp_path / path, **options)
    with pytest.raises(InputError, match="cannot be written as C"):
        write_c(model_of(CHAINS["one joint"], dc.TorchDiffEq()), tmp_path / "model.c")
    assert list(tmp_path.iterdir()) == []


def test_files_of_other_origin_stay(tmp_path: Path) -> None:
    model, header = model_of(CHAINS["one joint"]), tmp_path / "model.h"
    header.write_text("/* mine */")
    with pytest.raises(InputError, match="was not generated"):
        write_c(model, tmp_path / "model.c")
    assert header.read_text() == "/* mine */"
    header.unlink()
    write_c(model, tmp_path / "model.c")
    write_c(model, tmp_path / "model.c")  # its own files are replaced
