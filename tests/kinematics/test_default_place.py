"""Queries, files, compensation, fits and the paper under another default device and type: the same results, bit by bit.

The meta device holds no numbers: any operation that mixes it with real tensors fails. The calibration itself is in
tests/calibration/test_default_device.py, the source in tests/test_stated_places.py.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from product_bank import Case
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import elastic_rr
from diffeo_calib.robots.simulated_arm import SimulatedArm

pytestmark = pytest.mark.slow  # several calibrations

WORK = ("queries", "files", "compensation", "registration", "rows", "robots", "exports")
SOLVERS = (None, dc.LBFGS(max_iterations=3), dc.GradientDescent(1e-6, max_iterations=3))


def parts(found: Any) -> list[Any]:
    if isinstance(found, (list, tuple)):
        return [inner for part in found for inner in parts(part)]
    return [found]


def same(work: Callable[[], Any]) -> None:
    expected, before = parts(work()), torch.get_default_dtype()
    torch.set_default_dtype(torch.float16)
    try:
        with torch.device("meta"):
            found = parts(work())
    finally:
        torch.set_default_dtype(before)
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        if isinstance(other, Tensor):
            assert one.device == other.device
            assert one.dtype == other.dtype
            assert torch.equal(one, other)
        else:
            np.testing.assert_array_equal(one, other)


def works(arm: Case, folder: Path) -> dict[str, Callable[[], Any]]:
    q, path = arm.test.q[:4], folder / "model.safetensors"
    poses = arm.model.tool_poses(q)

    def model() -> dc.CalibratedKinematics:
        dc.save(arm.model, path)
        read = dc.load(path)
        if not isinstance(read, dc.CalibratedKinematics):
            raise TypeError(read)
        return read

    def queries() -> Any:
        m, live = model(), q.clone().requires_grad_()
        slopes = torch.autograd.grad(m(live).sum(), live)
        at = m.predict_tool_poses(q), m.tool_jacobian(q), m.transmission(arm.robot.joint_names[1], q[:, 1])
        return m(q), m.jacobian(q), m.predict(q), slopes, at, m.inverse(m(q), q + 0.01), m.geometry.tool

    def registration() -> Any:
        found = model().registered(arm.test[:6])
        return found(q), found.predict(q)

    def rows() -> Any:
        data = dc.Measurements(q, arm.test.points[:4], std=1e-4)
        return data.q, data[1:3].std, data.split(0.5)[0].q, data.groups(), dc.evaluate(arm.model, data).errors

    def robots() -> Any:
        arm_2, chain = SimulatedArm(seed=3), dc.from_dh([(0.1, 0.2, 0.3), (0.2, 0.1, 0.0)])
        return arm_2.measure(3), chain(q[:, :2]), chain.jacobian(q[:, :2]), elastic_rr.grid(3)

    def exports() -> Any:
        plain = dc.interop.load_numpy(path)
        return plain(q.numpy()), plain.tool_poses(q.numpy())

    return {
        "queries": queries,
        "files": lambda: model()(q),
        "compensation": lambda: [dc.compensate(model(), poses, q).q, dc.compensate(model(), poses[:, :3, 3], q).q],
        "registration": registration,
        "rows": rows,
        "robots": robots,
        "exports": exports,
    }


@pytest.mark.parametrize("name", WORK)
def test_a_robot(name: str, arm: Case, tmp_path: Path) -> None:
    dc.save(arm.model, tmp_path / "model.safetensors")
    same(works(arm, tmp_path)[name])


def problem() -> dc.Problem:
    x = elastic_rr.grid(4)
    kernels = {"joint_kernel": dc.VonMises((1.0, 1.0)), "task_kernel": dc.Gaussian(0.5)}
    return dc.Problem(elastic_rr.nominal, x, elastic_rr.real(x), noise=0.01, **kernels)  # pyright: ignore


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("backend", ["dense", "tiled"])
def test_fits(solver: Any, backend: Any) -> None:
    def work() -> Any:
        fit = dc.fit(problem(), solver, dc.RK4(1), backend=backend)
        return fit.model(elastic_rr.grid(3)), fit.model.jacobian(elastic_rr.grid(3)), fit.energy

    same(work)


def test_predictions_control_points_and_other_time_stepping() -> None:
    def work() -> Any:
        coarse = dc.fit(problem(), integrator=dc.RK8(1), controls=6)
        adaptive = dc.fit(problem(), dc.GaussNewton(max_iterations=1), dc.TorchDiffEq("rk4", step_size=0.5))
        return coarse.model.predict(elastic_rr.grid(3)), adaptive.model(elastic_rr.grid(3))

    same(work)


def test_the_paper_s_own_equations() -> None:
    def work() -> Any:
        fit = dc.fit(problem(), dc.LBFGS(max_iterations=2), dc.RK4(2), formulation="eulerian")
        return fit.model(elastic_rr.grid(3)), fit.model.jacobian(elastic_rr.grid(3))

    same(work)
