"""Torch programs of models: the same numbers as the model, by plain calls, traced, exported and as ONNX."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from deformation_bank import bend, fitted_plain, made, model_of, queries
from robots_bank import CHAINS, draw
from torch import Tensor
from torch.func import jacfwd, jacrev, vmap

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.torch_program import TorchProgram, export_onnx, export_torch
from diffeo_calib.measurements.poses import angle_between, mark_points, poses_from_marks, poses_of_triangles
from diffeo_calib.robots.se3 import rotation, transforms

TOOL = [0.05, 0.1, 0.25]
RUN = """
import sys, torch
outputs = []
for k, inputs in enumerate(torch.load("inputs.pt")):
    program = torch.export.load(f"{k}.pt2").module()
    outputs.append([program(q) for q in inputs])
torch.save(outputs, "outputs.pt")
assert not any(name.startswith("diffeo_calib") for name in sys.modules)
"""


def same(found: Tensor, expected: Tensor, atol: float = 2e-12) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["arm", "mimic slides"])
def test_points_and_tool_poses_of_any_number_of_rows(name: str) -> None:
    model = made(name, markers=2)
    for q in (queries(model)[:1], queries(model, 40) + 7.0):
        same(TorchProgram(model)(q), model.map.deformation(q).unflatten(1, (2, 3)))
        for tool, frame in ((None, "base"), (TOOL, "measuring")):
            found = TorchProgram(model, "tool_poses", tool=tool, frame=frame)(q)
            same(found, model.tool_poses(q, tool, frame))


def test_derivatives_plain_maps_and_single_precision() -> None:
    """Derivatives at control points too; single precision is good to micrometres."""
    for name, transform in (("mimic slides", jacrev), ("one joint", jacfwd)):
        model = made(name)
        program, q = TorchProgram(model), queries(model)
        same(vmap(transform(lambda row, of=program: of(row[None])[0]))(q), model.jacobian(q), 1e-10)
    model = fitted_plain("matern52")
    same(TorchProgram(model)(queries(model)), model(queries(model)))
    model = made("arm")
    for output, expected in (("points", model), ("tool_poses", model.tool_poses)):
        found = TorchProgram(model, output, dtype=torch.float32)(queries(model).float())
        assert found.dtype == torch.float32
        same(found.double(), expected(queries(model)), 5e-6)


def test_a_pose_in_closed_form_is_that_of_least_squares() -> None:
    """Triangles of any size that are bent by up to a fifth; the third axis follows from the others."""
    R, t = rotation(draw(200, 3, seed=1, size=2.0)), draw(200, 3, seed=2)
    for lever in (1e-3, 0.1, 5.0):
        exact = mark_points(transforms(R, t), lever)
        same(poses_of_triangles(exact), transforms(R, t), 1e-12)
        bent = exact + draw(200, 3, 3, seed=3, size=0.1 * lever)
        found, expected = poses_of_triangles(bent), poses_from_marks(bent, lever)
        same(found, expected)
        assert float(angle_between(found[:, :3, :3], R).max()) > 0.05


@pytest.mark.filterwarnings("ignore")  # torch's own: it deprecates this, and mentions constants
def test_jit_trace_for_any_number_of_rows() -> None:
    model = made("one joint", markers=3)
    for output in ("points", "poses", "tool_poses"):
        program = TorchProgram(model, output)
        if output == "poses":
            same(program(queries(model)), model.poses(queries(model)))
        traced = torch.jit.trace(program, (queries(model),), check_trace=False)
        for q in (queries(model)[:1], queries(model, 50)):
            same(traced(q), program(q))  # pyright: ignore[reportCallIssue]


def test_refusals() -> None:
    one, plain = made("one joint"), fitted_plain("gaussian")
    stepped = model_of(CHAINS["one joint"], dc.TorchDiffEq("rk4"))
    x, kernel = draw(9, 2, seed=4), dc.Gaussian(1.0)
    problem = dc.Problem(bend, x, bend(x), joint_kernel=kernel, task_kernel=kernel, noise=0.01)
    refused: list[tuple[Any, dict[str, Any], str]] = [
        (one, {"output": "pose"}, "expected 'points' or 'tool_poses' or 'poses', got 'pose'"),
        (one, {"output": "poses"}, "calibrated with points"),
        (one, {"tool": TOOL}, "`tool` was given: expected output=\"tool_poses\", got 'points'"),
        (one, {"output": "tool_poses", "frame": "world"}, "`frame`: expected 'base' or 'measuring'"),
        (plain, {"dtype": torch.float32}, r"expected torch\.float64, got torch\.float32"),
        (plain, {"output": "tool_poses"}, "expected 'points', got 'tool_poses'"),
        (stepped, {}, r"expected dc\.RK4 or dc\.RK8, got TorchDiffEq"),
        (dc.fit(problem, formulation="eulerian").model, {}, "expected an exact model, got the eulerian one"),
        (CHAINS["arm"], {}, "expected a calibrated model, got Chain"),
    ]
    for model, arguments, message in refused:
        with pytest.raises(InputError, match=message):
            TorchProgram(model, **arguments)


def test_onnx_needs_its_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(InputError, match=r"a package that is not installed .*; pip install 'diffeo_calib\[onnx\]'"):
        export_onnx(made("one joint"), tmp_path / "program.onnx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_exported_and_read_by_another_process(tmp_path: Path) -> None:
    short, plain = made("one joint", markers=3), fitted_plain("matern52")
    cases = [(short, {"output": "tool_poses", "tool": TOOL}, lambda q: short.tool_poses(q, TOOL)), (plain, {}, plain)]
    inputs = [[queries(which)[:1], queries(which), queries(which, 300)] for which, _, _ in cases]
    for k, (which, arguments, _) in enumerate(cases):
        export_torch(which, tmp_path / f"{k}.pt2", **arguments)
    torch.save(inputs, tmp_path / "inputs.pt")
    subprocess.run([sys.executable, "-c", RUN], check=True, cwd=tmp_path, timeout=300)
    for (_, _, expected), asked, outputs in zip(cases, inputs, torch.load(tmp_path / "outputs.pt"), strict=True):
        for q, found in zip(asked, outputs, strict=True):
            same(found.reshape(expected(q).shape), expected(q))
    extra = {"diffeo_calib.json": ""}
    torch.export.load(tmp_path / "1.pt2", extra_files=extra)
    assert json.loads(extra["diffeo_calib.json"]) == {"output": "points", "units": "m, rad"}


@pytest.mark.slow
def test_onnx_runs_to_rounding(tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    model = made("one joint")
    q = queries(model, 40)
    export_onnx(model, tmp_path / "program.onnx", "tool_poses")
    session = runtime.InferenceSession(tmp_path / "program.onnx", providers=["CPUExecutionProvider"])
    for some in (q[:1], q):
        (found,) = session.run(["tool_poses"], {"q": some.numpy()})
        same(torch.from_numpy(found), model.tool_poses(some), 1e-11)
    assert session.get_inputs()[0].shape[1] == q.shape[1]
    described = session.get_modelmeta().custom_metadata_map
    assert described["units"] == "m, rad"
    assert described["joints"] == ", ".join(CHAINS["one joint"].joint_names)
