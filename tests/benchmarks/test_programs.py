"""Small benchmarks: every way gives the same answer, known answers are found, and the programs run."""

from __future__ import annotations

import json
from pathlib import Path

import compensation
import generated_c
import numpy as np
import ours
import peers
import pytest
import queries
from c_bank import needs_compiler
from deformation_bank import model_of
from landmarks import Landmarks, Method, exact, landmarks
from product_bank import Case
from robots_bank import CHAINS

import diffeo_calib as dc


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
