"""Model files: exact round trips of robots, functions, kernels and coarse models; the contents of the header.

Read by NumPy alone, against the torch model of the same file; and files that earlier versions wrote: those in data/
were written at commit 29d55d1, before the package had its present folders and names.

Where a model comes from, and its summary: kept by every copy, saved and loaded, from files of every age.
"""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from deformation_bank import model_of
from math_bank import constant_kernel
from model_file_bank import planar
from product_bank import Case
from robots_bank import CHAINS, draw

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.interop.numpy_model import load_numpy
from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.kinematics.provenance import Provenance
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import elastic_rr
from diffeo_calib.robots.se3 import twist_transform


def test_robot_models_come_back_bit_for_bit(arm: Case, tmp_path: Path) -> None:
    """Of the other kinds: tests/test_laws_of_kinds.py."""
    model, q = arm.model, arm.test.q[:50]
    dc.save(model, tmp_path / "model.safetensors")
    again = dc.load(tmp_path / "model.safetensors")
    assert isinstance(again, dc.CalibratedKinematics)
    assert torch.equal(again.jacobian(q), model.jacobian(q))
    for mine, theirs in zip(again.predict(q), model.predict(q), strict=True):
        assert torch.equal(mine, theirs)
    assert again.report == model.report
    assert again.robot.to_config() == model.robot.to_config()
    assert again.rigid_errors is not None
    assert torch.equal(again.rigid_errors, arm.result.identification.geometry.joint_errors)
    dc.save(again, tmp_path / "again.safetensors")
    assert torch.equal(dc.load(tmp_path / "again.safetensors")(q), model(q))


def test_plain_functions_must_be_passed_again(tmp_path: Path) -> None:
    fit, path = planar(), tmp_path / "plain.safetensors"
    dc.save(fit.model, path)
    x = torch.rand(30, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    again = dc.load(path, nominal=elastic_rr.nominal)
    assert isinstance(again, FittedMap)
    assert torch.equal(again(x), fit.model(x))
    assert torch.equal(again.predict(x)[1], fit.model.predict(x)[1])
    with pytest.raises(InputError, match=r"`nominal` is missing.*same function again"):
        dc.load(path)
    for other in (lambda x: x[:, :1], lambda x: x, elastic_rr.real):
        with pytest.raises(InputError, match="`nominal` is not the map that the model was fitted to"):
            dc.load(path, nominal=other)


def test_every_kernel_comes_back(tmp_path: Path) -> None:
    mixed = dc.Space((True, False))
    kernels = (
        *(dc.Gaussian((0.7, 1.1), 0.02), dc.Matern(0.9, 1.5, 0.02), dc.Matern(0.9, 2.5, 0.01)),
        *(dc.Matern(0.9, 3.5, 0.02, space=mixed), dc.Cauchy(0.8, (0.01, 0.02)), constant_kernel(0.05)),
        *(dc.VonMises((1.0, 2.0), (0.02, 0.01)), dc.PerJoint((0.5, 0.9), (0.01, 0.0), mixed)),
    )
    fit, path = planar(SumKernel(kernels), SumKernel(kernels[::-1])), tmp_path / "model.safetensors"
    dc.save(fit.model, path)
    x = torch.linspace(-2, 2, 24, dtype=torch.float64).reshape(12, 2)
    again = dc.load(path, nominal=elastic_rr.nominal)
    assert torch.equal(again(x), fit.model(x))
    assert torch.equal(again.predict(x)[1], fit.model.predict(x)[1])


@pytest.mark.parametrize(
    "integrator",
    [dc.RK8(1), dc.TorchDiffEq("dopri5", adjoint=True, step_size=0.5, rtol=1e-6, atol=1e-9)],
    ids=["rk8", "torchdiffeq"],
)
def test_coarse_models_keep_their_data_and_integrator(integrator: dc.RK8 | dc.TorchDiffEq, tmp_path: Path) -> None:
    """Fewer control points than measurements: the covariance needs the measured configurations too."""
    x = elastic_rr.grid(5)
    kernels = {"joint_kernel": dc.VonMises(1.0, 0.1), "task_kernel": dc.Gaussian(0.7, 0.1)}
    problem = dc.Problem(elastic_rr.nominal, x, elastic_rr.real(x), noise=0.05, **kernels)  # pyright: ignore[reportArgumentType]
    model = dc.fit(problem, dc.GaussNewton(max_iterations=2), integrator, controls=12).model
    dc.save(model, tmp_path / "coarse.safetensors")
    again = dc.load(tmp_path / "coarse.safetensors", elastic_rr.nominal)
    assert isinstance(again, FittedMap)
    assert again.deformation.integrator == integrator
    assert (len(again.deformation.x), len(again.x)) == (12, 25)
    for actual, expected in zip(again.predict(x[:3]), model.predict(x[:3]), strict=True):
        torch.testing.assert_close(actual, expected, rtol=0, atol=0)


@pytest.mark.parametrize(("name", "waves"), [("arm", True), ("mimic slides", False), ("wrist in one point", False)])
def test_same_values_as_the_torch_model(name: str, waves: bool, tmp_path: Path) -> None:
    tool, chain, path = twist_transform(draw(6, seed=6)), CHAINS[name], tmp_path / "model.safetensors"
    model = model_of(chain, waves=waves).with_tool(tool)
    dc.save(model, path)
    found, again, q = load_numpy(path), dc.load(path), draw(5, chain.n, seed=5, size=3.0)
    assert torch.equal(again(q), model(q))
    assert found.joint_names == chain.joint_names
    np.testing.assert_array_equal(found.limits, chain.limits.numpy())
    np.testing.assert_allclose(found(q), model.map.deformation(q).unflatten(1, (-1, 3)), rtol=0, atol=1e-12)
    jacobian = model.map.deformation.jacobian(q).unflatten(1, (-1, 3))
    np.testing.assert_allclose(found.jacobian(q), jacobian, rtol=0, atol=1e-9)
    for frame in ("base", "measuring"):
        np.testing.assert_allclose(found.tool_poses(q, frame=frame), model.tool_poses(q, frame=frame), atol=1e-12)
        slopes = model.tool_jacobian(q, [0.1, 0.2, 0.3], frame)
        np.testing.assert_allclose(found.tool_jacobian(q, [0.1, 0.2, 0.3], frame), slopes, rtol=0, atol=1e-9)


def test_loads_no_torch(tmp_path: Path) -> None:
    dc.save(model_of(CHAINS["arm"]), tmp_path / "model.safetensors")
    code = (
        "import sys; from diffeo_calib.interop.numpy_model import load_numpy; "
        f"print(load_numpy({str(tmp_path / 'model.safetensors')!r})([[0.1] * 6]).shape, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[0] == "(1, 2, 3) False"


def test_models_that_need_torch(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    dc.save(planar().model, path)
    with pytest.raises(InputError, match=r"expected that of a robot.*use `dc.load`"):
        load_numpy(path)
    dc.save(model_of(CHAINS["arm"], dc.TorchDiffEq()), path)
    with pytest.raises(InputError, match="expected fixed steps"):
        load_numpy(path)


def test_arguments(tmp_path: Path) -> None:
    """Data frames are taken by the names of their columns."""
    path, chain = tmp_path / "model.safetensors", CHAINS["arm"]
    dc.save(model_of(chain), path)
    model, q = load_numpy(path), draw(2, chain.n, seed=5).numpy()
    frame = pd.DataFrame(q, columns=list(chain.joint_names))[list(reversed(chain.joint_names))]
    for call in (model, model.jacobian, model.tool_poses, model.tool_jacobian):
        np.testing.assert_array_equal(call(frame), call(q))
    with pytest.raises(InputError, match="has no column"):
        model(frame.drop(columns=chain.joint_names[0]))
    with pytest.raises(InputError, match="cannot be read as numbers"):
        model([["far"] * chain.n])
    with pytest.raises(InputError, match=r"`q` has the wrong shape: expected \(N, 6\), got \(6,\)"):
        model(q[0])
    q[1, 2] = np.nan
    with pytest.raises(InputError, match="row 1 of `q`: expected finite numbers"):
        model.jacobian(q)
    transposed = np.eye(4)
    transposed[3, :3] = 0.2
    mirrored, far = np.diag([1.0, 1.0, -1.0, 1.0]), np.array([0.0, -2e3, 0.0])
    for tool in (np.ones(4), np.full(3, np.inf), mirrored, transposed, far):
        for own in (model, dc.load(path)):
            with pytest.raises(InputError, match="tool"):
                own.tool_poses(np.zeros((1, 6)), tool)
    with pytest.raises(InputError, match="`frame`: expected 'base' or 'measuring'"):
        model.tool_poses(np.zeros((1, 6)), frame="world")


DATA = Path(__file__).parent / "data"


@pytest.fixture
def expected() -> dict[str, Any]:
    return json.loads((DATA / "format_3.json").read_text(encoding="utf-8"))


def test_a_robot(expected: dict[str, Any], tmp_path: Path) -> None:
    model, said = dc.load(DATA / "robot_format_3.safetensors"), expected["robot"]
    assert isinstance(model, dc.CalibratedKinematics)
    for found, value in zip(model.predict(said["q"]), (said["mean"], said["covariance"]), strict=True):
        torch.testing.assert_close(found, torch.tensor(value, dtype=torch.float64), rtol=1e-9, atol=1e-13)
    q, path = torch.tensor(said["q"], dtype=torch.float64), tmp_path / "again"
    dc.save(model, path)
    assert torch.equal(dc.load(path)(q), model(q))
    np.testing.assert_allclose(load_numpy(path)(q), model(q).numpy(), rtol=0, atol=1e-12)
    assert len(repr(load_numpy(path))) < 200
    assert model.report == said["report"]
    assert model.summary is not None
    assert model.summary.rows == 20


def test_a_map_with_control_points(expected: dict[str, Any]) -> None:
    model, said = dc.load(DATA / "map_format_3.safetensors", elastic_rr.nominal), expected["map"]
    x, y = (torch.tensor(said[name], dtype=torch.float64) for name in ("x", "y"))
    torch.testing.assert_close(model(x), y, rtol=0, atol=1e-13)
    assert len(model.x) == 16  # pyright: ignore[reportAttributeAccessIssue]


def test_a_calibration_says_when_and_from_what(arm: Case) -> None:
    found = arm.model.provenance
    assert found is not None
    made = datetime.fromisoformat(found.date)
    assert made.tzinfo == timezone.utc
    assert timedelta(0) <= datetime.now(timezone.utc) - made < timedelta(days=1)
    assert (found.version, found.table_sha256, found.note) == (dc.__version__, arm.train.sha256, "")


def test_every_copy_and_file_keeps_it(arm: Case, tmp_path: Path) -> None:
    provenance = Provenance("2026-11-22T10:00:00+00:00", "0.1.0", "ab" * 32, "serial 17")
    summary = replace(arm.model.summary, noise_degrees_of_freedom=inf, effective_parameters=None)
    model = dc.CalibratedKinematics(arm.robot, arm.model.map, summary, tool=[0, 0, 0.1], provenance=provenance)
    other = model.with_tool([0.1, 0, 0]).to("cpu")
    dc.save(other, tmp_path / "model")
    for copy in (other, dc.load(tmp_path / "model")):
        assert isinstance(copy, dc.CalibratedKinematics)
        assert (copy.provenance, copy.summary) == (provenance, summary)
        assert copy.tool[0, 3] == 0.1
    dc.save(arm.model.changed(summary=None), tmp_path / "model")
    again: Any = dc.load(tmp_path / "model")
    assert (again.summary, again.report) == (None, {})


def test_the_hash_is_that_of_the_file_or_of_the_arrays(arm: Case, tmp_path: Path) -> None:
    names, table = arm.robot.joint_names, TableFormat("m", "rad")
    write_measurements(tmp_path / "table.csv", arm.train, table, joints=names)
    data = dc.read_measurements(tmp_path / "table.csv", names, ["x", "y", "z"], length="m", angle="rad")
    of_the_file = hashlib.sha256((tmp_path / "table.csv").read_bytes()).hexdigest()
    assert data.sha256 == data.split(0.5)[0].sha256 == data.file_sha256 == of_the_file
    origin: Any = data.origin
    assert list(origin.texts(data.line_numbers)) == [*names, "x", "y", "z"]
    (tmp_path / "table.csv").write_text((tmp_path / "table.csv").read_text() + "\n")
    assert origin.texts(data.line_numbers) == {}  # of another file
    arrays = dc.Measurements(data.q, data.points)  # not read from a file
    assert arrays.file_sha256 is None
    assert arrays.sha256 == dc.Measurements(data.q.clone(), data.points.clone()).sha256
    shifted = dc.Measurements(data.q, data.points + 1e-12)
    others = (shifted, arrays.rows(slice(1, None)), dc.Measurements(data.q, data.points, std=1e-5))
    assert len({arrays.sha256, of_the_file, *(other.sha256 for other in others)}) == 5
