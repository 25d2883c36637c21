"""The package under another default device and type: every tensor states its own, so that the results are the same.

Any operation that mixes the "meta" device, whose tensors hold no numbers, with real ones fails. Half precision, unlike
torch's own default, would show. The source is in tests/test_stated_places.py.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kind_bank import kind_named
from product_bank import Case, simulated, usual_scales
from robots_bank import crooked, draw
from section_5 import section_5
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.robots import Chain, Geometry, SimulatedArm, elastic_rr, from_dh, load_urdf, se3
from diffeo_calib.robots.gravity import GravitySag

URDF = Path(se3.__file__).with_name("simulated_arm.urdf")
Q = draw(3, 3)


@contextmanager
def elsewhere() -> Iterator[None]:
    """Tensors are made on the meta device and in half precision, unless they state theirs."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float16)
    try:
        with torch.device("meta"):
            yield
    finally:
        torch.set_default_dtype(before)


def parts(found: Any) -> list[Any]:
    if isinstance(found, (list, tuple)):
        return [inner for part in found for inner in parts(part)]
    return [found]


def same(work: Callable[[], Any]) -> list[Any]:
    """The results of the work, which are the same whatever the default device is."""
    expected = parts(work())
    with elsewhere():
        found = parts(work())
    for one, other in zip(found, expected, strict=True):
        if isinstance(other, Tensor | np.ndarray):
            assert_close(one, other, rtol=1e-9, atol=1e-12)  # the device and the type are compared too
        elif isinstance(other, float):  # of a search that sums in any order
            assert one == pytest.approx(other, rel=1e-4, nan_ok=True)
        else:
            assert one == other
    return expected


def test_the_meta_device_would_be_noticed() -> None:
    with elsewhere(), pytest.raises((RuntimeError, NotImplementedError)):
        draw(3).add(torch.zeros(3))


# --- robots -----------------------------------------------------------------------------------------------------------


def mixed() -> Chain:
    """Turns, a slide, a fixed joint and a mimic joint."""
    return crooked(["revolute", "prismatic", "fixed", "revolute", "revolute"], {4: {"j0": -1.0}})


def geometry() -> Geometry:
    chain = mixed()
    errors = se3.twist_transform(draw(chain.moving, 6, seed=1, size=0.1))
    return replace(Geometry.nominal(chain, 2), joint_errors=errors)


def derivatives() -> list[Tensor]:
    made = geometry()
    theta = draw(made.size, seed=3, size=0.1)
    at = made.points(Q, theta), made.jacobian(Q, theta), made.sensitivities(Q, theta)
    return [made.poses(Q), made.points(Q), *at, made.absorb(theta).points(Q)]


def sag() -> list[Tensor]:
    made = GravitySag(mixed())
    terms = draw(made.size, seed=4)
    at = made.features(Q), made.twists(Q, terms), made.twist_slopes(Q, terms)
    return [*at, made.sensitivities(Q, draw(3, 2, 4, 6, seed=5)), made.joints, made.own, made.components]


def measured() -> list[Tensor]:
    arm = SimulatedArm(seed=1, markers=2)
    q, points = arm.measure(4, seed=2)
    found = arm.components(q)
    return [q, points, arm.gravity_torques(q), found.transmission, found.gravity, found.geometry]


def constants(chain: dc.Tree) -> list[Tensor]:
    described = chain.limits, chain.coupling, chain.coupling_offset, chain.axes, chain.offsets, chain.tip_offsets[0]
    return [*described, chain.motion_terms, torch.tensor(chain.reach, dtype=torch.float64, device="cpu")]


def urdf_and_tables() -> list[Tensor]:
    craig = from_dh([(0.1, 0.2, 0.3), (0.4, 0.5, 0.6, 0.7, "prismatic")], "craig")
    chains = load_urdf(URDF, "base_link", "flange"), craig, from_dh([(0.1, 0.2, 0.3)]), mixed()
    return [part for chain in chains for part in constants(chain)]


ROBOTS: dict[str, Callable[[], Any]] = {
    "chain": lambda: [mixed()(Q), mixed().jacobian(Q), mixed().joint_frames(Q)],
    "chain of lists": lambda: mixed()(Q.tolist()),  # pyright: ignore[reportArgumentType]
    "URDF and DH tables": urdf_and_tables,
    "geometry": derivatives,
    "gravity": sag,
    "simulated arm": measured,
    "elastic arm": lambda: [elastic_rr.grid(3), elastic_rr.real_links(Q[:, :2]), elastic_rr.nominal(Q[:, :2])],
    "rotations": lambda: [se3.nearest_rotations(draw(4, 3, 3, seed=6)), se3.right_jacobian(Q)],
}


@pytest.mark.parametrize("name", ROBOTS)
def test_robots(name: str) -> None:
    same(ROBOTS[name])


# --- fits -------------------------------------------------------------------------------------------------------------

TWICE, LBFGS = dc.GaussNewton(max_iterations=2), dc.LBFGS(max_iterations=3)
FITS: dict[str, Callable[[dc.Problem], dc.Fit]] = {
    "Gauss-Newton": lambda problem: dc.fit(problem, integrator=dc.RK4(2), backend="tiled"),
    "chosen steps": dc.fit,
    "adaptive": lambda problem: dc.fit(problem, TWICE, dc.TorchDiffEq("dopri5", rtol=1e-2, atol=1e-3)),
    "L-BFGS": lambda problem: dc.fit(problem, LBFGS, dc.RK4(2)),
    "descent": lambda problem: dc.fit(problem, dc.GradientDescent(1e-6, max_iterations=3), dc.RK4(1), backend="dense"),
    "conjugate gradients": lambda problem: dc.fit(problem, dc.GaussNewton(linear="cg"), dc.RK4(2)),
    "controls": lambda problem: dc.fit(problem, TWICE, dc.RK8(1), controls=20),
    "eulerian": lambda problem: dc.fit(problem, LBFGS, dc.RK4(1), formulation="eulerian"),
}


@pytest.mark.parametrize("name", FITS)
def test_fits(name: str) -> None:
    def work() -> list[Any]:
        found, x = FITS[name](section_5(k=6)), elastic_rr.grid(3)
        predicted = () if name == "eulerian" else found.model.predict(x)
        return [found.model(x), found.model.jacobian(x), found.energy, *predicted]

    same(work)


# --- calibrations -----------------------------------------------------------------------------------------------------


def calibration(robot: dc.Tree, rows: Any, scales: dc.Hyperparameters | None = None) -> list[Any]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            result = dc.calibrate(robot, rows, hyperparameters=scales)
        except dc.DiffeoCalibError as error:
            return [str(error)]
    q, report = rows.q[:5], list(result.model.report.items())
    texts = result.status, result.left_out.rms_text, *(str(one.message) for one in said)
    return [result.model(q), *result.model.predict(q), report, *result.placement.sentences(), *texts]


def of_the_arm(change: Callable[[Tensor, Tensor], Any], rows: int = 16) -> tuple[Any, ...]:
    """Joint values and positions of two markers, changed in place."""
    arm, data, _ = simulated(rows, markers=2)
    q, points = data.q.clone(), data.points.clone()
    change(q, points)
    return arm.nominal, dc.Measurements(q, points, doubt=False), usual_scales(arm.nominal)


def with_offsets(q: Tensor, points: Tensor) -> None:
    """And an outlier."""
    points[3] += 0.5
    q[:, 2] += 0.2


def known(name: str) -> tuple[Any, ...]:
    kind = kind_named(name)
    return kind.robot, kind.data, kind.scales


CALIBRATIONS: dict[str, tuple[Callable[[], tuple[Any, ...]], str]] = {
    "scales searched for": (lambda: of_the_arm(lambda q, points: None)[:2], ""),
    "wrong joint offsets": (lambda: of_the_arm(with_offsets), "joint offsets are far"),
    "another unit": (lambda: of_the_arm(lambda q, points: points.mul_(1e3)), "1000 times too large"),
    "a device that moved": (lambda: of_the_arm(lambda q, points: points[20:].add_(2e-4), 40), "near row 20"),
    **{name: (partial(known, name), "") for name in ("poses", "mixture", "several kinds", "two cameras")},
}
"""Robot, rows and scales, and what is said of them."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CALIBRATIONS)
def test_calibrations(name: str) -> None:
    made, said = CALIBRATIONS[name]
    given = made()
    found = same(lambda: calibration(*given))
    assert said or len(found) > 1  # not refused
    assert said in " ".join(text for text in found if isinstance(text, str))


# --- models -----------------------------------------------------------------------------------------------------------


def queries(model: dc.CalibratedKinematics, case: Case, path: Path) -> list[Any]:
    q = case.test.q[:4]
    live, joint = q.clone().requires_grad_(), case.robot.joint_names[1]
    slopes = torch.autograd.grad(model(live).sum(), live)
    at = model.predict_tool_poses(q), model.tool_jacobian(q), model.transmission(joint, q[:, 1])
    plain = dc.interop.load_numpy(path)
    written = plain(q.numpy()), plain.tool_poses(q.numpy())
    found = model(q), model.jacobian(q), model.predict(q), model.inverse(model(q), q + 0.01)
    return [*found, slopes, at, model.geometry.tool, written]


def compensation(model: dc.CalibratedKinematics, case: Case, _: Path) -> list[Any]:
    q = case.test.q[:4]
    poses = case.model.tool_poses(q)
    return [dc.compensate(model, target, q).q for target in (poses, poses[:, :3, 3])]


def registration(model: dc.CalibratedKinematics, case: Case, _: Path) -> list[Any]:
    found, q = model.registered(case.test[:6]), case.test.q[:4]
    return [found(q), found.predict(q)]


def rows_of_a_table(model: dc.CalibratedKinematics, case: Case, _: Path) -> list[Any]:
    data = dc.Measurements(case.test.q[:4], case.test.points[:4], std=1e-4)
    found: Any = dc.evaluate(model, data)
    return [data.q, data[1:3].std, data.split(0.5)[0].q, data.groups(), found.errors]


@pytest.mark.slow
@pytest.mark.parametrize("verb", [queries, compensation, registration, rows_of_a_table])
def test_models(verb: Callable[[dc.CalibratedKinematics, Case, Path], Any], arm: Case, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    dc.save(arm.model, path)

    def work() -> Any:
        dc.save(arm.model, path)
        read: Any = dc.load(path)
        return verb(read, arm, path)

    same(work)
