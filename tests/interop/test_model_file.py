"""Model files: round trips, contents, files of earlier versions; damaged and edited ones are refused by a sentence."""

import hashlib
import json
import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable
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
from model_file_bank import Editor, planar, refused, set_entry, set_tensor
from product_bank import Case
from robots_bank import CHAINS, draw
from safetensors.torch import save_file
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, ModelFileError
from diffeo_calib.interop import model_file
from diffeo_calib.interop.numpy_model import load_numpy
from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.kinematics.provenance import Provenance
from diffeo_calib.kinematics.registered_map import Registration
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import elastic_rr
from diffeo_calib.robots.se3 import twist_transform

MIXED = dc.Space((True, False))
KERNELS = (
    *(dc.Gaussian((0.7, 1.1), 0.02), dc.Matern(0.9, 1.5, 0.02), dc.Matern(0.9, 2.5, 0.01)),
    *(dc.Matern(0.9, 3.5, 0.02, space=MIXED), dc.Cauchy(0.8, (0.01, 0.02)), constant_kernel(0.05)),
    *(dc.VonMises((1.0, 2.0), (0.02, 0.01)), dc.PerJoint((0.5, 0.9), (0.01, 0.0), MIXED)),
)


def coarse(integrator: dc.RK8 | dc.TorchDiffEq) -> Any:
    """Fewer control points than measurements: the covariance needs the measured configurations too."""
    x = elastic_rr.grid(5)
    kernels: dict[str, Any] = {"joint_kernel": dc.VonMises(1.0, 0.1), "task_kernel": dc.Gaussian(0.7, 0.1)}
    problem = dc.Problem(elastic_rr.nominal, x, elastic_rr.real(x), noise=0.05, **kernels)
    model = dc.fit(problem, dc.GaussNewton(max_iterations=2), integrator, controls=12).model
    assert (len(model.deformation.x), len(model.x)) == (12, 25)
    return model


def turned(case: Case, **how: Any) -> Any:
    """Registered by held-out rows that another device saw, with a tool."""
    T = twist_transform(draw(6, seed=16))
    return case.model.registered(case.test[:12].in_frames(T.expand(12, 4, 4)), **how).with_tool([0, 0, 0.1])


MODELS: dict[str, Callable[[Any], Any]] = {
    "a robot": lambda given: given("arm").model,
    "a registered robot": lambda given: turned(given("arm")),
    "registered poses, not learnt": lambda given: turned(given("posed"), learn=False),
    "every kernel": lambda _: planar(SumKernel(KERNELS), SumKernel(KERNELS[::-1])).model,
    "few controls": lambda _: coarse(dc.RK8(1)),
    "other steps": lambda _: coarse(dc.TorchDiffEq("dopri5", adjoint=True, step_size=0.5, rtol=1e-6, atol=1e-9)),
}
SLOW = ("a registered robot", "registered poses, not learnt")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in MODELS])
def test_models_come_back_bit_for_bit(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    model, robot = MODELS[name](request.getfixturevalue), name in list(MODELS)[:3]
    q = draw(20, 6 if robot else 2, seed=5)
    dc.save(model, tmp_path / "model")
    again: Any = dc.load(tmp_path / "model", *[elastic_rr.nominal] * (not robot))
    dc.save(again, tmp_path / "again")
    for found in (again, again.to("cpu"), dc.load(tmp_path / "again", *[elastic_rr.nominal] * (not robot))):
        assert type(found) is type(model)
        for ask in ("__call__", "jacobian", "predict", *["tool_poses"] * robot):
            ours, theirs = (getattr(one, ask)(q) for one in (found, model))
            assert all(map(torch.equal, ours, theirs)), ask
        if not robot:
            assert found.deformation.integrator == model.deformation.integrator
            continue
        assert (found.report, found.provenance, found.lever) == (model.report, model.provenance, model.lever)
        assert found.robot.to_config() == model.robot.to_config()
        assert torch.equal(found.rigid_errors, model.rigid_errors)
        for field in Registration.__dataclass_fields__ if model.registration else ():
            mine, wanted = (getattr(one.registration, field) for one in (found, model))
            assert torch.equal(mine, wanted) if isinstance(mine, Tensor) else mine == wanted
        near = load_numpy(tmp_path / "model")(q.numpy())
        np.testing.assert_allclose(near, model(q).numpy(), rtol=0, atol=1e-12)


def test_plain_functions_must_be_passed_again(tmp_path: Path) -> None:
    path = tmp_path / "plain.safetensors"
    dc.save(planar().model, path)
    with pytest.raises(InputError, match=r"`nominal` is missing.*same function again"):
        dc.load(path)
    for other in (lambda x: x[:, :1], lambda x: x, elastic_rr.real):
        with pytest.raises(InputError, match="`nominal` is not the map that the model was fitted to"):
            dc.load(path, nominal=other)


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


def test_models_without_torch(tmp_path: Path) -> None:
    dc.save(model_of(CHAINS["arm"]), tmp_path / "model.safetensors")
    code = (
        "import sys; from diffeo_calib.interop.numpy_model import load_numpy; "
        f"print(load_numpy({str(tmp_path / 'model.safetensors')!r})([[0.1] * 6]).shape, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[0] == "(1, 2, 3) False"
    path = tmp_path / "model.safetensors"
    dc.save(planar().model, path)
    with pytest.raises(InputError, match=r"expected that of a robot.*use `dc.load`"):
        load_numpy(path)
    dc.save(model_of(CHAINS["arm"], dc.TorchDiffEq()), path)
    with pytest.raises(InputError, match="expected fixed steps"):
        load_numpy(path)


def test_arguments(tmp_path: Path) -> None:
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


def test_old_files(expected: dict[str, Any], tmp_path: Path) -> None:
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
    model, said = dc.load(DATA / "map_format_3.safetensors", elastic_rr.nominal), expected["map"]
    x, y = (torch.tensor(said[name], dtype=torch.float64) for name in ("x", "y"))
    torch.testing.assert_close(model(x), y, rtol=0, atol=1e-13)
    assert len(model.x) == 16  # pyright: ignore[reportAttributeAccessIssue]


def test_where_a_calibration_comes_from(arm: Case, tmp_path: Path) -> None:
    found = arm.model.provenance
    assert found is not None
    made = datetime.fromisoformat(found.date)
    assert made.tzinfo == timezone.utc
    assert timedelta(0) <= datetime.now(timezone.utc) - made < timedelta(days=1)
    assert (found.version, found.table_sha256, found.note) == (dc.__version__, arm.train.sha256, "")
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


def test_cut_short_or_flipped(sound: bytes, tmp_path: Path) -> None:
    path, start = tmp_path / "cut.safetensors", 8 + struct.unpack("<Q", sound[:8])[0]
    for length in [*range(64), *range(64, len(sound), 307), len(sound) - 8, len(sound) - 1]:
        path.write_bytes(sound[:length])
        assert "copy or save it again" in refused(path), length
    flipped = (sound[:k] + bytes([sound[k] ^ 32]) + sound[k + 1 :] for k in range(start, len(sound), 101))
    for other in (sound + b"\0", *flipped):
        path.write_bytes(other)
        refused(path)


def test_files_of_other_kinds_are_not_unpickled(tmp_path: Path) -> None:
    path, weight = tmp_path / "other", {"weight": torch.zeros(3)}
    assert "there is no model file" in refused(path)
    assert "there is no model file" in refused(tmp_path)
    png = b"\x89PNG\r\n\x1a\n" + bytes(100)
    for content in (b"", b"robot: ur10\n", png, pickle.dumps({"model": 1}), bytes([255] * 8)):
        path.write_bytes(content)
        assert "cannot be read as a model file" in refused(path)
    header = json.dumps({"format": model_file.FORMAT})
    for metadata, message in (
        (None, "is not a diffeo_calib model"),
        ({"format": "pt"}, "is not a diffeo_calib model"),
        *(({model_file.ENTRY: text}, "is not a diffeo_calib model") for text in ("[]", "null", "3", '"model"')),
        *(({model_file.ENTRY: text}, "cannot be read") for text in ("{", "[" * 100_000)),
        ({model_file.ENTRY: "{}"}, "format version None"),
        ({model_file.ENTRY: header}, "checksum"),
    ):
        save_file(weight, path, metadata=metadata)
        assert message in refused(path)
    save_file({"weight": torch.zeros(3, dtype=torch.bfloat16)}, path, metadata={model_file.ENTRY: header})
    refused(path)

    class Trap:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return (Path.touch, (Path(tmp_path / "executed"),))  # pyright: ignore[reportReturnType]

    torch.save({"model": Trap()}, tmp_path / "trap.pt")
    (tmp_path / "trap.pkl").write_bytes(pickle.dumps(Trap()))
    for name in ("trap.pt", "trap.pkl"):
        refused(tmp_path / name)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("what", [3, "model", None, torch.zeros(3)])
def test_only_models_are_saved(what: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"`model`: expected a calibrated model, got .*result.model"):
        dc.save(what, tmp_path / "model")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failing_save(where: str, error: Any, editor: Editor, sound: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    model = dc.load(editor.path)

    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(os, where, fail)
    expected = InputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected, match="No space left.*free some space" if isinstance(error, OSError) else None):
        dc.save(model, editor.path)
    assert editor.path.read_bytes() == sound
    assert [path.name for path in editor.path.parent.iterdir()] == [editor.path.name]


def test_an_edit_needs_a_new_checksum(editor: Editor) -> None:
    edit = set_entry("report", "rows", value=10)
    assert "damaged or edited: its checksum does not match" in refused(editor.write(edit, sign=False))
    model = dc.load(editor.write(edit))
    assert isinstance(model, dc.CalibratedKinematics)
    assert model.report["rows"] == 10


WRONG_ENTRIES: dict[str, tuple[tuple[Any, ...], Any, str]] = {
    "other format": (("format",), 1, "format version 1: expected 3; read it with the version that wrote it"),
    "extra entry": (("surprise",), 1, "header of the model file is not understood"),
    "other unit": (("units", "length"), "mm", "header of the model file is not understood"),
    "kernel option": (("joint_kernel", 0, "surprise"), 1, "do not fit together"),
    "negative length": (("joint_kernel", 0, "lengthscale"), -1.0, "positive"),
    "kernel of another joint": (("joint_kernel", 0, "columns"), [6], "6 coordinates"),
    "no steps": (("integrator", "steps"), 0, "at least 1"),
    "unknown integrator": (("integrator", "kind"), "euler", "euler"),
    "dimension of the plane": (("task_dim",), 2, "task_dim"),
    "lever of a model of points": (("lever",), 0.1, "a model of poses: expected three points for each, got 1"),
    "other kind": (("nominal", "kind"), "planet", "robot or function"),
    "no joints": (("nominal", "joints"), [], "no moving joint"),
    "axis of length zero": (("nominal", "joints", 0, "axis"), [0, 0, 0], "axis of joint 'waist_joint'"),
    "origin not rigid": (("nominal", "joints", 0, "origin"), np.diag([2.0, 1, 1, 1]).tolist(), "rigid"),
    "unknown joint": (("nominal", "joints", 0, "kind"), "ball", "kind of joint"),
    "one joint less": (("nominal", "joints", 0, "kind"), "fixed", "joint_errors"),
    "mimic of no joint": (("nominal", "joints", 0, "mimic"), {"nose": 1.0}, "mimics 'nose'"),
    "one active joint less": (("nominal", "joints", 1, "mimic"), {"waist_joint": 1.0}, "must have shape (N, 5)"),
    "elastic of a word": (("nominal", "elastic"), "no", "the entry elastic: expected true or false, got no"),
    "command of a number": (("provenance", "command"), 5, "the entry 'command' is 5"),
    "urdf of a list": (("urdf",), ["<robot/>"], "the entry urdf: expected the text of a file, got list"),
    "negative payload": (("nominal", "payload"), {"mass": -1.0, "unit": 2.0}, "mass of the payload: expected a number"),
    "wave of no joint": (("nominal", "waves"), [[6, 3.0]], "gear waves: expected joints below 6, positive frequencies"),
    "axis of many terms": (("nominal", "axes"), [[0, -1.0, 1.0, 10**9]], "errors of axes: expected joints below 6"),
    "rigid, with elastic coefficients": (("nominal", "elastic"), False, "`theta` has the wrong shape"),
}


NOT_UNDERSTOOD = ("units", "nominal", "joint_kernel", "task_kernel", "task_dim", "integrator", "report", "lever")
MISSING: dict[str, Callable[[Any, Any], object]] = {
    **{k: lambda header, _, k=k: header.pop(k) for k in NOT_UNDERSTOOD},
    **{k: lambda header, _, k=k: header["nominal"]["joints"][0].pop(k) for k in ("lower", "mimic", "mimic_offset")},
    "elastic": lambda header, _: header["nominal"].pop("elastic"),
    **{k: lambda _, tensors, k=k: tensors.pop(k) for k in (*model_file.MOMENTA, *model_file.GEOMETRY)},
}
"""Entries of the header, of a joint and of elasticity, and tensors."""


WRONG_TENSORS: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
    "base not rigid": ("base", lambda t: -t),
    "no markers": ("tool", lambda t: t[:0]),
    "one joint error less": ("joint_errors", lambda t: t[:-1]),
    "configurations not finite": ("x", lambda t: t * float("nan")),
    "noise negative": ("noise", lambda t: -t),
    "new noise negative": ("new_noise", lambda t: -t),
    "new noise not symmetric": ("new_noise", lambda t: t + 0.1 * t.max() * torch.ones_like(t).triu(1)),
    "one elastic prior less": ("prior_variance", lambda t: t[:-1]),
    "one row less in x": ("x", lambda t: t[:-1]),
    "parameters of a million metres": ("theta", lambda t: t + 2e6),
    "rigid errors of other joints": ("rigid_errors", lambda t: t[:2]),
    "integers": ("noise", lambda t: t.long()),
}


EDITS: dict[str, tuple[Callable[[Any, Any], object], str]] = {
    **{name: (set_entry(*keys, value=value), message) for name, (keys, value, message) in WRONG_ENTRIES.items()},
    **{name: (set_tensor(*how), "do not fit together") for name, how in WRONG_TENSORS.items()},
    **{f"no {name}": (edit, f"do not fit together ('{name}')") for name, edit in MISSING.items()},
    **{f"no {name}": (MISSING[name], "not understood") for name in NOT_UNDERSTOOD},
}


@pytest.mark.parametrize("name", EDITS)
def test_wrong_and_missing_parts(name: str, editor: Editor) -> None:
    edit, message = EDITS[name]
    assert message in refused(editor.write(edit))


@pytest.mark.parametrize("steps", [0, 0.5, True, 10**5, 10**30])
def test_the_reader_without_torch_bounds_the_time_steps(steps: object, editor: Editor) -> None:
    """Its work grows with them: 10^5 steps would take minutes."""
    with pytest.raises(ModelFileError, match="the time steps: expected 1 to 1024"):
        dc.interop.load_numpy(editor.write(set_entry("integrator", "steps", value=steps)))


def test_a_forged_flow_has_no_predictions(editor: Editor) -> None:
    """With so large a variance its flow folds or its numbers overflow: rounding decides, and so what the error says."""
    folding = editor.write(set_entry("joint_kernel", 0, "variance", value=1e4))
    with pytest.raises(dc.DiffeoCalibError):
        dc.load(folding).predict(torch.zeros(3, 6, dtype=torch.float64, device="cpu"))
