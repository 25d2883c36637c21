"""The benchmark of generated C: it runs on a saved model, and pinocchio computes the same nominal robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import generated_c
import numpy as np
import pytest
from c_bank import needs_compiler
from deformation_bank import model_of
from robots_bank import CHAINS, draw

import diffeo_calib as dc


@needs_compiler
def test_program_on_a_saved_model(tmp_path: Path) -> None:
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


def test_no_peer_for_mimic_joints() -> None:
    assert generated_c.pinocchio_queries(CHAINS["mimic joints"], np.eye(4)) == {}
