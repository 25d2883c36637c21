"""Small benchmarks: every way gives the same answer, known answers are found, and the programs run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import compensation
import generated_c
import numpy as np
import ours
import peers
import pytest
import queries
import torch
from c_bank import needs_compiler
from covariates import Split
from deformation_bank import model_of
from landmarks import Landmarks, Method, exact, landmarks
from product_bank import Case
from robots_bank import CHAINS, draw
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm


def test_queries_of_a_saved_model(arm: Case, tmp_path: Path) -> None:
    dc.save(arm.model, tmp_path / "model.safetensors")
    out = tmp_path / "queries.json"
    queries.run(queries.arguments(["--quick", "--models", str(tmp_path / "model.safetensors"), "--out", str(out)]))
    records = json.loads(out.read_text())["records"]
    assert {record["way"] for record in records} >= {"package", "formula, 64 rows at once"}
    for record in records:
        assert set(queries.COLUMNS) == set(record)
        assert record["difference"] < 1e-6


# --- generated C ----------------------------------------------------------------------------------------------------


@needs_compiler
def test_generated_c_of_a_saved_model(tmp_path: Path) -> None:
    dc.save(model_of(CHAINS["serial"]), tmp_path / "model.safetensors")
    out = tmp_path / "records.json"
    plan = ["--quick", "--models", str(tmp_path / "model.safetensors"), "--out", str(out)]
    generated_c.run(generated_c.arguments(plan))
    records = json.loads(out.read_text())["records"]
    assert [record["query"] for record in records] == list(generated_c.CALLS)
    for record in records:
        assert set(record) == set(generated_c.COLUMNS)
        assert 0 < record["c_us"] < (record["numpy_us"] or np.inf)
        assert 0 < record["object_mb"] < record["source_mb"]


@pytest.mark.parametrize("name", ["slides", "wrist in one point"])
def test_pinocchio_computes_the_nominal_robot(name: str) -> None:
    pytest.importorskip("pinocchio")
    robot, q = CHAINS[name], draw(1, CHAINS[name].n, seed=5)
    tool = np.eye(4)
    tool[:3, 3] = 0.1, 0.2, 0.3
    queries = generated_c.pinocchio_queries(robot, tool)
    pose: Any = queries["tool pose"](q[0].numpy())
    np.testing.assert_allclose(pose.homogeneous, robot(q)[0].numpy() @ tool, rtol=0, atol=1e-12)
    slopes: Any = queries["tool pose and Jacobian"](q[0].numpy())
    assert slopes[0].shape == (6, robot.n)


# --- kernel sums ----------------------------------------------------------------------------------------------------

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

ROWS = slice(0, 20)
METHODS: tuple[type[Method], ...] = (ours.Ours, ours.Dense, ours.Tiled, peers.NaiveDense, peers.DenseAutograd)


@pytest.fixture(scope="module")
def data() -> Landmarks:
    """More points than a tile has rows."""
    return landmarks(300, 3)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", ["sum", "rhs", "adjoint"])
def test_results_are_exact(data: Landmarks, method: type[Method], task: str) -> None:
    if task not in method.tasks:
        pytest.skip("not offered")
    for found, expected in zip(method(data).function(task, 1)(), exact(task, data, ROWS), strict=True):
        assert float((found[ROWS] - expected).norm() / expected.norm()) < 1e-11


# --- compensation ---------------------------------------------------------------------------------------------------


def test_true_errors_of_perfect_commands_are_zero() -> None:
    """Targets where the true arm is anyway."""
    bench = compensation.Bench("poses", 20)
    tool = compensation.mark_points(bench.tool(bench.arm.truth.tool)[None], compensation.LEVER)[0]
    bench.arm.truth = compensation.replace(bench.arm.truth, tool=tool)
    there = compensation.poses_from_marks(bench.arm.true_points(bench.start), compensation.LEVER)
    again = compensation.Bench("poses", 20)
    again.targets = there
    found = again.true_errors(again.start, torch.ones(len(there), dtype=torch.bool))
    assert max(float(str(found[name])) for name in ("rms_mm", "max_mm", "rms_deg")) < 1e-6


@pytest.mark.slow
def test_the_true_tool_is_as_good_as_the_held_out_frame() -> None:
    """0.25 m from the measured frame: little worse than there, and far better than geometry."""
    records = {
        str(record["method"]): record for record in compensation.compared(compensation.Bench("poses", 60), "poses")
    }
    rms = {name: float(str(record["rms_mm"])) for name, record in records.items()}
    assert rms["registration"] > 2 * rms["geometry"] > 10 * rms["diffeo_calib"]
    ours = records["diffeo_calib"]
    assert rms["diffeo_calib"] < 1.5 * float(str(ours["held_out_mm"]))
    assert float(str(ours["rms_deg"])) < 1.15 * float(str(ours["held_out_deg"]))
    assert int(str(ours["rows"])) > 500


# --- covariates -----------------------------------------------------------------------------------------------------


def drifting() -> tuple[Split, Tensor, Tensor]:
    """An arm whose tracker moves by 0.2 mm, the time of the rows, and a shuffled one."""
    arm, time = SimulatedArm(0), torch.linspace(-1.0, 1.0, 90, dtype=torch.float64)
    q, points = arm.measure(90, seed=1)
    seen = points + 1e-4 * time[:, None, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    order, other = (torch.randperm(90, generator=generator) for _ in range(2))
    data = dc.Measurements(q, seen).rows(order)
    return Split(arm.nominal, data[:60], data[60:]), time[order], time[other]


@pytest.mark.slow
def test_a_drift_is_found_and_a_shuffled_time_is_not() -> None:
    model, time, shuffled = drifting()
    ratio, further = model.likeliest("frame, linear", time)
    assert ratio > 30.0
    assert model.likeliest("frame, linear", shuffled)[0] < 10.0
    assert model.predicted(further, known=True)[0] < 0.9 * model.without[0]
    # densities of torch, and the normal equations of the regression, are the second way
    whole = model.prior + model.noise
    matrices = [(whole + scale * further)[model.fit, model.fit].contiguous() for scale in (0.0, 1.0)]
    target = model.target[model.fit]
    normals = (torch.distributions.MultivariateNormal(torch.zeros_like(target), matrix) for matrix in matrices)
    plain, drifting_too = (float(one.log_prob(target)) for one in normals)
    assert ratio == pytest.approx(2 * (drifting_too - plain), rel=1e-8)
    for known in (True, False):
        across = (model.prior + known * further)[model.new, model.fit]
        mean = across @ torch.linalg.solve(matrices[1], model.target[model.fit])
        away = (model.target[model.new] - mean).view(-1, 3)
        rms, _ = model.predicted(further, known=known)
        assert rms == pytest.approx(1e6 * float(away.square().sum(1).mean().sqrt()), rel=1e-6)
