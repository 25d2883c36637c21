"""Models evaluated by NumPy, by torch's programs and by generated C: points, slopes and poses of the torch model."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import two_arms_bank
from c_bank import CModel, c_model, needs_compiler
from deformation_bank import deformation_of, model_of
from robots_bank import CHAINS, draw

import diffeo_calib as dc
from diffeo_calib.interop import write_c
from diffeo_calib.interop.torch_program import _ConstantPoints
from diffeo_calib.kernels.profiles import PROFILES
from diffeo_calib.kinematics.nominal import GeometryMap
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
