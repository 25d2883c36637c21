"""Model files: exact round trips, and files with every kind of damage in them."""

from __future__ import annotations

import copy
import json
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from product_bank import Case, simulated
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, ModelFileError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.interop import model_file, model_header
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.named import Constant
from diffeo_calib.robots import elastic_rr


@pytest.fixture(scope="module")
def small() -> dc.CalibratedKinematics:
    """A model of nine poses: its file is short enough to be damaged at every byte."""
    arm, train, _ = simulated(9)
    with pytest.warns(DiffeoCalibWarning, match="9 poses are too few"):
        return dc.calibrate(arm.nominal, train).model


@pytest.fixture(scope="module")
def sound(small: dc.CalibratedKinematics, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    dc.save(small, path)
    return path.read_bytes()


def planar(kernel_x: Kernel | None = None, kernel_y: Kernel | None = None, rows: int = 20) -> dc.Fit:
    """A fit of the planar elastic robot, a plain function."""
    x = torch.from_numpy(np.random.default_rng(0).uniform(-1.5, 1.5, (rows, 2)))
    problem = dc.Problem(
        elastic_rr.nominal,
        x,
        elastic_rr.real(x),
        joint_kernel=kernel_x or dc.VonMises((1.0, 2.0), 0.1),
        task_kernel=kernel_y or dc.Gaussian(0.5, 0.01),
        noise=0.02,
    )
    return dc.fit(problem, integrator=dc.RK4(2))


def header_of(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()[model_file.ENTRY])


def refused(path: Path) -> str:
    """The one clear sentence with which a file is refused."""
    with pytest.raises(ModelFileError) as caught:
        dc.load(path)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".")
    assert len(text) < 800
    return text


# --- round trips --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["arm", "posed", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pair", "slider"))]
)
def test_robot_models_come_back_bit_for_bit(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    case: Case = request.getfixturevalue(name)
    model, q = case.model, case.test.q[:50]
    dc.save(model, tmp_path / "model.safetensors")
    again = dc.load(tmp_path / "model.safetensors")
    assert isinstance(again, dc.CalibratedKinematics)
    assert torch.equal(again(q), model(q))
    assert torch.equal(again.jacobian(q), model.jacobian(q))
    for mine, theirs in zip(again.predict(q), model.predict(q), strict=True):
        assert torch.equal(mine, theirs)
    assert torch.equal(again.geometry.points(q), model.geometry.points(q))
    assert torch.equal(again.map.new_noise, model.map.new_noise)
    theta = model.map.deformation.momenta.theta
    assert torch.equal(again.nominal(q, theta), model.nominal(q, theta))  # with the deflection under gravity
    for joint in model.robot.joint_names:
        assert torch.equal(again.transmission(joint, q[:, 0]), model.transmission(joint, q[:, 0]))
    assert again.report == model.report
    assert again.lever == model.lever == case.train.lever
    assert again.robot.joint_names == model.robot.joint_names
    assert (again.robot.name, again.robot.base, again.robot.tip) == (case.robot.name, case.robot.base, case.robot.tip)
    assert again.robot.kinds == model.robot.kinds
    assert torch.equal(again.robot.limits, model.robot.limits)
    dc.save(again, tmp_path / "again.safetensors")
    assert torch.equal(dc.load(tmp_path / "again.safetensors")(q), model(q))


@pytest.mark.slow
def test_robots_with_mimic_joints_come_back_bit_for_bit(tmp_path: Path) -> None:
    follow: dict[str, float] = {"tilt": -1.0, "bend": -0.25, "pan": 0.1}
    rows = [
        (0.1, 1.6, 0.3),
        (0.0, -1.5, 0.1),
        (0.5, 0.2, 0.0, 0.1, "revolute", follow, 0.3),
        (0.4, 1.2, 0.1),
        (0.1, 0, 0.2),
    ]
    robot = dc.from_dh(rows, names=["pan", "tilt", "level", "bend", "turn"])
    q = torch.from_numpy(np.random.default_rng(0).uniform(-1.5, 1.5, (60, 4)))
    points = robot(q + 1e-3 * (2 * q).sin())[:, None, :3, 3]
    points = points + 1e-5 * torch.from_numpy(np.random.default_rng(1).standard_normal((60, 1, 3)))
    result = dc.calibrate(robot, dc.Measurements(q[:30], points[:30], robot.joint_names))
    errors = [dc.evaluate(stage, dc.Measurements(q[30:], points[30:])).rms for stage in result.stages.values()]
    assert errors[-1] < errors[0] / 5
    dc.save(result.model, tmp_path / "model.safetensors")
    again = dc.load(tmp_path / "model.safetensors")
    assert isinstance(again, dc.CalibratedKinematics)
    assert [joint.mimic for joint in again.robot.joints] == [joint.mimic for joint in robot.joints]
    assert torch.equal(again.robot.coupling, robot.coupling)
    assert torch.equal(again.robot.coupling_offset, robot.coupling_offset)
    assert (again.robot.joint_names, again.robot.moving_names) == (robot.joint_names, robot.moving_names)
    assert torch.equal(again(q), result.model(q))
    assert torch.equal(again.jacobian(q), result.model.jacobian(q))


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


def test_a_robot_s_file_takes_no_function(sound: bytes, tmp_path: Path) -> None:
    (tmp_path / "model").write_bytes(sound)
    with pytest.raises(InputError, match="`nominal` was given, but the file holds its robot"):
        dc.load(tmp_path / "model", nominal=elastic_rr.nominal)


@pytest.mark.parametrize("other", [lambda x: x[:, :1], lambda x: x, elastic_rr.real])
def test_another_function_is_noticed(other: Callable[[Tensor], Tensor], tmp_path: Path) -> None:
    path = tmp_path / "plain.safetensors"
    dc.save(planar().model, path)
    with pytest.raises(InputError, match="`nominal` is not the map that the model was fitted to"):
        dc.load(path, nominal=other)


KERNELS: dict[str, Callable[[], Kernel]] = {
    "gaussian": lambda: dc.Gaussian((0.7, 1.1), 0.02),
    "matern32": lambda: dc.Matern(0.9, 1.5, 0.02),
    "matern52": lambda: dc.Matern(0.9, 2.5, 0.02),
    "matern72": lambda: dc.Matern(0.9, 3.5, 0.02, space=dc.Space((True, False))),
    "cauchy": lambda: dc.Cauchy(0.8, (0.01, 0.02)),
    "constant": lambda: Constant(0.05),
    "von mises": lambda: dc.VonMises((1.0, 2.0), (0.02, 0.01)),
    "per joint": lambda: dc.PerJoint((0.5, 0.9), (0.01, 0.02), dc.Space((True, False))),
    "sum": lambda: dc.PerJoint((0.5, 0.9), (0.01, 0.0), dc.Space((True, True))) + dc.Cauchy(1.0, 0.01) + Constant(1e-3),
}


@pytest.mark.parametrize("name", KERNELS)
def test_every_kernel_comes_back(name: str, tmp_path: Path) -> None:
    fit, path = planar(KERNELS[name](), KERNELS[name]()), tmp_path / "model.safetensors"
    dc.save(fit.model, path)
    x = torch.linspace(-2, 2, 24, dtype=torch.float64).reshape(12, 2)
    again = dc.load(path, nominal=elastic_rr.nominal)
    assert torch.equal(again(x), fit.model(x))
    assert torch.equal(again.predict(x)[1], fit.model.predict(x)[1])
    nominal = elastic_rr.nominal(x)
    assert float((fit.model(x) - nominal).abs().max()) > 1e-3  # a file without its kernel would show


def test_the_header_says_what_the_file_is(arm: Case, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    dc.save(arm.model, path)
    header = header_of(path)
    assert header["format"] == model_header.FORMAT
    assert header["units"] == {"length": "m", "angle": "rad"}
    robot = header["nominal"]
    assert (robot["name"], robot["base"], robot["tip"]) == ("simulated_arm", "base_link", "flange")
    moving = [joint["name"] for joint in robot["joints"] if joint["kind"] != "fixed"]
    assert tuple(moving) == arm.robot.joint_names
    assert [term["profile"] for term in header["joint_kernel"]] == ["matern52"] * 6 + ["gaussian"]
    assert [term["output"] for term in header["joint_kernel"]] == [0, 1, 2, 3, 4, 5, None]
    assert len(header["task_kernel"]) == 1
    report = header["report"]
    assert report["coupling residual"] <= 1e-4
    assert report["end residual"] <= 1e-4
    assert report["diffeomorphic rms [m]"] < report["geometry rms [m]"] < report["registration rms [m]"]
    assert report["status"] == arm.result.fit.status
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    assert all(t.dtype == torch.float64 for t in tensors.values())
    assert tensors["x"].shape == (60, 6)


def test_models_of_poses_give_the_same_poses(posed: Case, tmp_path: Path) -> None:
    path, q = tmp_path / "posed.safetensors", posed.test.q[:20]
    dc.save(posed.model, path)
    assert header_of(path)["lever"] == 0.1
    again = dc.load(path)
    assert isinstance(again, dc.CalibratedKinematics)
    assert torch.equal(again.poses(q), posed.model.poses(q))
    assert torch.equal(again.predict_poses(q)[1], posed.model.predict_poses(q)[1])
    assert repr(dc.evaluate(again, posed.test)) == repr(dc.evaluate(posed.model, posed.test))


def test_a_plain_function_has_no_lever(tmp_path: Path) -> None:
    path = tmp_path / "plain.safetensors"
    dc.save(planar().model, path)
    assert header_of(path)["lever"] is None
    editor = Editor(path.read_bytes(), tmp_path)
    with pytest.raises(ModelFileError, match=r"entry lever: expected null for a plain function, got 0.1"):
        dc.load(editor.write(set_entry("lever", value=0.1)), elastic_rr.nominal)


# --- damaged files ------------------------------------------------------------------------------------------------


def test_cut_short(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.safetensors"
    for length in [*range(64), *range(64, len(sound), 61), len(sound) - 8, len(sound) - 1]:
        path.write_bytes(sound[:length])
        assert "copy or save it again" in refused(path), length
    path.write_bytes(sound + b"\0")
    refused(path)


@pytest.mark.parametrize(("part", "stride"), [("header", 13), ("tensors", 29)])
def test_flipped_bits(part: str, stride: int, small: dc.CalibratedKinematics, sound: bytes, tmp_path: Path) -> None:
    """Refused, or without any effect: e-05 may become E-05, or the 17th digit another one of the same number."""
    path, q = tmp_path / "flipped.safetensors", simulated(1)[2].q[:3]
    expected, start = small(q), 8 + struct.unpack("<Q", sound[:8])[0]
    places = range(0, start, stride) if part == "header" else range(start, len(sound), stride)
    harmless = 0
    for count, place in enumerate(places):
        flipped = bytearray(sound)
        flipped[place] ^= (0x01, 0x20, 0x80, 0xFF)[count % 4]
        path.write_bytes(flipped)
        try:
            model = dc.load(path)
        except ModelFileError:
            continue
        harmless += 1
        assert part == "header", place
        assert torch.equal(model(q), expected), place
    assert harmless < 0.02 * len(places)


def test_files_of_other_kinds(tmp_path: Path) -> None:
    path = tmp_path / "other"
    for content, message in (
        (b"", "cannot be read as a model file"),
        (b"robot: ur10\n", "cannot be read as a model file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "cannot be read as a model file"),
        (pickle.dumps({"model": 1}), "cannot be read as a model file"),
        (bytes([255] * 8), "cannot be read as a model file"),
    ):
        path.write_bytes(content)
        assert message in refused(path)
    save_file({"weight": torch.zeros(3)}, path)
    assert "is not a diffeo_calib model" in refused(path)
    save_file({"weight": torch.zeros(3)}, path, metadata={"format": "pt"})
    assert "is not a diffeo_calib model" in refused(path)
    for text in ("[]", "null", "3", '"model"'):
        save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: text})
        assert "is not a diffeo_calib model" in refused(path)
    save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: "{"})
    assert "cannot be read" in refused(path)
    save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: "{}"})
    assert "format version None" in refused(path)
    header = json.dumps({"format": model_header.FORMAT})
    save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: header})
    assert "checksum" in refused(path)


@pytest.mark.parametrize(
    ("text", "dtype"), [("[" * 100_000, torch.float64), (json.dumps({"format": model_header.FORMAT}), torch.bfloat16)]
)
def test_odd_files_of_other_kinds(text: str, dtype: torch.dtype, tmp_path: Path) -> None:
    save_file({"weight": torch.zeros(3, dtype=dtype)}, tmp_path / "odd", metadata={model_file.ENTRY: text})
    refused(tmp_path / "odd")


def test_missing_files(tmp_path: Path) -> None:
    assert "there is no model file" in refused(tmp_path / "nowhere.safetensors")
    assert "there is no model file" in refused(tmp_path)


def test_torch_s_own_files_are_not_unpickled(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return (Path.touch, (Path(tmp_path / "executed"),))  # pyright: ignore[reportReturnType]

    torch.save({"model": Trap()}, tmp_path / "trap.pt")
    (tmp_path / "trap.pkl").write_bytes(pickle.dumps(Trap()))
    for name in ("trap.pt", "trap.pkl"):
        refused(tmp_path / name)
    assert not (tmp_path / "executed").exists()


# --- edited files, signed again ------------------------------------------------------------------------------------


class Editor:
    """Edits a sound file and signs it again, so that the checks behind the checksum are reached."""

    def __init__(self, sound: bytes, folder: Path) -> None:
        self.path = folder / "edited.safetensors"
        self.path.write_bytes(sound)
        self.header, self.tensors = model_file.read(self.path)

    def write(self, edit: Callable[[dict[str, Any], dict[str, Tensor]], object], *, sign: bool = True) -> Path:
        header, tensors = copy.deepcopy(self.header), {name: t.clone() for name, t in self.tensors.items()}
        digest = model_file.digest(header, tensors)
        edit(header, tensors)
        header["digest"] = model_file.digest(header, tensors) if sign else digest
        save_file(tensors, self.path, metadata={model_file.ENTRY: json.dumps(header)})
        return self.path


@pytest.fixture
def editor(sound: bytes, tmp_path: Path) -> Editor:
    return Editor(sound, tmp_path)


def set_entry(*keys: Any, value: Any) -> Callable[[Any, Any], None]:
    def edit(header: Any, _: Any) -> None:
        for key in keys[:-1]:
            header = header[key]
        header[keys[-1]] = value

    return edit


def set_tensor(name: str, change: Callable[[Tensor], Tensor | None]) -> Callable[[Any, Any], None]:
    def edit(_: Any, tensors: dict[str, Tensor]) -> None:
        new = change(tensors.pop(name))
        if new is not None:
            tensors[name] = new.contiguous()

    return edit


def test_signing_again_is_what_lets_an_edit_pass(editor: Editor) -> None:
    edit = set_entry("report", "rows", value=10)
    assert "damaged or edited: its checksum does not match" in refused(editor.write(edit, sign=False))
    model = dc.load(editor.write(edit))
    assert isinstance(model, dc.CalibratedKinematics)
    assert model.report["rows"] == 10


@pytest.mark.parametrize("name", [*model_header.MOMENTA, *model_header.GEOMETRY])
def test_one_changed_number_is_noticed(name: str, editor: Editor) -> None:
    def edit(tensor: Tensor) -> Tensor:
        tensor.view(-1)[-1] += 1e-12
        return tensor

    assert "checksum" in refused(editor.write(set_tensor(name, edit), sign=False))


WRONG_ENTRIES: dict[str, tuple[tuple[Any, ...], Any, str]] = {
    "other format": (("format",), 1, "format version 1: expected 3; read it with the version that wrote it"),
    "the format before": (("format",), 2, "format version 2: expected 3; read it with the version that wrote it"),
    "format in words": (("format",), "one", "format version 'one'"),
    "extra entry": (("surprise",), 1, "header of the model file is not understood"),
    "other unit": (("units", "length"), "mm", "header of the model file is not understood"),
    "unknown kernel": (("joint_kernel", 0, "profile"), "wavelet", "the profile of a kernel"),
    "kernel option": (("joint_kernel", 0, "surprise"), 1, "do not fit together"),
    "no kernel": (("task_kernel",), [], "do not fit together"),
    "kernel is a word": (("task_kernel",), "gaussian", "do not fit together"),
    "negative length": (("joint_kernel", 0, "lengthscale"), -1.0, "positive"),
    "negative variance": (("task_kernel", 0, "variance"), -1.0, "non-negative"),
    "kernel of another joint": (("joint_kernel", 0, "columns"), [6], "6 coordinates"),
    "kernel of other joints": (("joint_kernel", 6, "periodic"), [True], "6 coordinates"),
    "no steps": (("integrator", "steps"), 0, "at least 1"),
    "half steps": (("integrator", "steps"), 1.5, "an integer"),
    "too many steps": (("integrator", "steps"), 2000, "at most 1024"),
    "unknown integrator": (("integrator", "kind"), "euler", "euler"),
    "dimension of a word": (("task_dim",), "three", "do not fit together"),
    "dimension zero": (("task_dim",), 0, "task_dim"),
    "lever of a model of points": (("lever",), 0.1, "a model of poses: expected three points for each, got 1"),
    "negative lever": (("lever",), -0.1, "`lever`"),
    "lever of a word": (("lever",), "far", "`lever`"),
    "lever is true": (("lever",), True, "`lever`"),
    "lever is a list": (("lever",), [0.1], "`lever`"),
    "other kind": (("nominal", "kind"), "planet", "robot or function"),
    "no robot": (("nominal",), None, "do not fit together"),
    "no joints": (("nominal", "joints"), [], "no moving joint"),
    "joints of words": (("nominal", "joints"), "six", "do not fit together"),
    "axis of length zero": (("nominal", "joints", 0, "axis"), [0, 0, 0], "axis of joint 'waist_joint'"),
    "axis in the plane": (("nominal", "joints", 0, "axis"), [0, 1], "axis of joint 'waist_joint'"),
    "origin not rigid": (("nominal", "joints", 0, "origin"), np.diag([2.0, 1, 1, 1]).tolist(), "rigid"),
    "ragged origin": (("nominal", "joints", 0, "origin"), [[1, 0], [0]], "do not fit together"),
    "unknown joint": (("nominal", "joints", 0, "kind"), "ball", "kind of joint"),
    "one joint less": (("nominal", "joints", 0, "kind"), "fixed", "joint_errors"),
    "mimic of a word": (("nominal", "joints", 0, "mimic"), "elbow", "mimic of joint 'waist_joint'"),
    "mimic of no joint": (("nominal", "joints", 0, "mimic"), {"nose": 1.0}, "mimics 'nose'"),
    "mimic offset of a word": (("nominal", "joints", 0, "mimic_offset"), "much", "mimic offset of joint"),
    "one active joint less": (
        ("nominal", "joints", 1, "mimic"),
        {"waist_joint": 1.0},
        "expected 5 active joints, got 6",
    ),
    "elastic of a word": (("nominal", "elastic"), "no", "the entry elastic: expected true or false, got no"),
    "elastic is a number": (("nominal", "elastic"), 1, "the entry elastic: expected true or false, got 1"),
    "elastic is nothing": (("nominal", "elastic"), None, "the entry elastic: expected true or false"),
    "rigid, with elastic coefficients": (("nominal", "elastic"), False, "`theta` has the wrong shape"),
    "limits that cross": (("nominal", "joints", 0, "lower"), 99.0, "limits of joint"),
}


@pytest.mark.parametrize("name", WRONG_ENTRIES)
def test_wrong_entries(name: str, editor: Editor) -> None:
    keys, value, message = WRONG_ENTRIES[name]
    assert message in refused(editor.write(set_entry(*keys, value=value)))


@pytest.mark.parametrize(
    "key", ["units", "nominal", "joint_kernel", "task_kernel", "task_dim", "integrator", "report", "lever"]
)
def test_missing_entries(key: str, editor: Editor) -> None:
    assert "not understood" in refused(editor.write(lambda header, _: header.pop(key)))


@pytest.mark.parametrize("key", ["lower", "mimic", "mimic_offset"])
def test_missing_entries_of_a_joint(key: str, editor: Editor) -> None:
    edited = editor.write(lambda header, _: header["nominal"]["joints"][0].pop(key))
    assert f"do not fit together ('{key}')" in refused(edited)


def test_missing_entry_of_elasticity(editor: Editor) -> None:
    edited = editor.write(lambda header, _: header["nominal"].pop("elastic"))
    assert "do not fit together ('elastic')" in refused(edited)


@pytest.mark.parametrize("name", [*model_header.MOMENTA, *model_header.GEOMETRY])
def test_missing_tensors(name: str, editor: Editor) -> None:
    assert f"('{name}')" in refused(editor.write(set_tensor(name, lambda _: None)))


WRONG_TENSORS: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
    "base not rigid": ("base", lambda t: -t),
    "base of another shape": ("base", lambda t: t[:3]),
    "no markers": ("tool", lambda t: t[:0]),
    "markers not finite": ("tool", lambda t: t * float("nan")),
    "one joint error less": ("joint_errors", lambda t: t[:-1]),
    "one parameter less": ("theta", lambda t: t[:-1]),
    "configurations not finite": ("x", lambda t: t * float("nan")),
    "noise negative": ("noise", lambda t: -t),
    "new noise negative": ("new_noise", lambda t: -t),
    "new noise of nothing": ("new_noise", lambda t: 0 * t),
    "new noise not symmetric": ("new_noise", lambda t: t + 0.1 * t.max() * torch.ones_like(t).triu(1)),
    "new noise not finite": ("new_noise", lambda t: t * float("inf")),
    "new noise of another size": ("new_noise", lambda t: t[:2, :2]),
    "new noise of one number": ("new_noise", lambda t: t[0, 0]),
    "new noise in single precision": ("new_noise", lambda t: t.float()),
    "one elastic coefficient less": ("theta", lambda t: t[:-1]),
    "one elastic prior less": ("prior_variance", lambda t: t[:-1]),
    "one elastic prior nothing": ("prior_variance", lambda t: t * (torch.arange(len(t)) < len(t) - 1)),
}
UNCHECKED_TENSORS: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
    "one row less in x": ("x", lambda t: t[:-1]),
    "one row less in b": ("momenta_x", lambda t: t[:-1]),
    "one row less in p": ("momenta_y", lambda t: t[:-1]),
    "one row less in the noise": ("noise", lambda t: t[:-1]),
    "prior too short": ("prior_variance", lambda t: t[:-1]),
    "prior negative": ("prior_variance", lambda t: -t),
    "momenta not finite": ("momenta_y", lambda t: t * float("nan")),
    "x flat": ("x", lambda t: t.flatten()),
    "noise flat": ("noise", lambda t: t.flatten()),
    "single precision": ("x", lambda t: t.float()),
    "integers": ("noise", lambda t: t.long()),
}


@pytest.mark.parametrize("name", WRONG_TENSORS)
def test_wrong_tensors(name: str, editor: Editor) -> None:
    assert "do not fit together" in refused(editor.write(set_tensor(*WRONG_TENSORS[name])))


@pytest.mark.parametrize("name", UNCHECKED_TENSORS)
def test_tensors_that_do_not_match_each_other(name: str, editor: Editor) -> None:
    refused(editor.write(set_tensor(*UNCHECKED_TENSORS[name])))


@pytest.mark.parametrize(("key", "value"), [("task_dim", 2), ("task_dim", 1), ("report", []), ("integrator", True)])
def test_entries_that_do_not_match_the_tensors(key: str, value: object, editor: Editor) -> None:
    refused(editor.write(set_entry(key, value=value)))


# --- writing ------------------------------------------------------------------------------------------------------


def test_saving_into_a_missing_folder(small: dc.CalibratedKinematics, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be written to .*none.*No such file or directory.*check the folder"):
        dc.save(small, tmp_path / "none" / "model.safetensors")
    assert not (tmp_path / "none").exists()


def test_saving_over_a_folder(small: dc.CalibratedKinematics, tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        dc.save(small, tmp_path / "model")
    assert [p.name for p in tmp_path.iterdir()] == ["model"]


@pytest.mark.parametrize("what", [3, "model", None, torch.zeros(3)])
def test_only_models_are_saved(what: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"`model`: expected a calibrated model, got .*result.model"):
        dc.save(what, tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_replaced(small: dc.CalibratedKinematics, sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_text("old")
    dc.save(small, str(path))
    assert path.read_bytes() == sound
    assert [p.name for p in tmp_path.iterdir()] == ["model.safetensors"]


@pytest.mark.parametrize("where", ["save_file", "replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failing_save_leaves_the_old_file(
    where: str, error: BaseException, editor: Editor, sound: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = dc.load(editor.path)

    def fail(first: Any, second: Any, **_: Any) -> None:
        if where == "save_file":
            Path(second).write_bytes(b"half a file")
        raise error

    monkeypatch.setattr(*((model_file, "save_file") if where == "save_file" else (model_file.os, "replace")), fail)
    expected = InputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected, match="No space left" if isinstance(error, OSError) else None):
        dc.save(model, editor.path)
    assert editor.path.read_bytes() == sound
    assert [path.name for path in editor.path.parent.iterdir()] == [editor.path.name]


def test_a_full_disk_is_an_input_error(
    small: dc.CalibratedKinematics, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise model_file.SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(model_file, "save_file", fail)
    with pytest.raises(InputError, match="cannot be written"):
        dc.save(small, tmp_path / "model.safetensors")


def test_a_model_file_has_the_usual_permissions(small: dc.CalibratedKinematics, tmp_path: Path) -> None:
    usual = tmp_path / "usual"
    usual.write_text("")
    dc.save(small, tmp_path / "model.safetensors")
    assert (tmp_path / "model.safetensors").stat().st_mode == usual.stat().st_mode


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
