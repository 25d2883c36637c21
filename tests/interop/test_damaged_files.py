"""Damaged and edited model files, files of other kinds, failing saves: each is refused with one clear sentence."""

import json
import os
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from model_file_bank import Editor, refused, set_entry, set_tensor
from safetensors.torch import save_file
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, ModelFileError
from diffeo_calib.interop import model_file


def test_cut_short_or_flipped(sound: bytes, tmp_path: Path) -> None:
    path, start = tmp_path / "cut.safetensors", 8 + struct.unpack("<Q", sound[:8])[0]
    for length in [*range(64), *range(64, len(sound), 307), len(sound) - 8, len(sound) - 1]:
        path.write_bytes(sound[:length])
        assert "copy or save it again" in refused(path), length
    for other in (
        sound + b"\0",
        *(sound[:k] + bytes([sound[k] ^ 32]) + sound[k + 1 :] for k in range(start, len(sound), 101)),
    ):
        path.write_bytes(other)
        refused(path)


def test_files_of_other_kinds(tmp_path: Path) -> None:
    path, weight = tmp_path / "other", {"weight": torch.zeros(3)}
    assert "there is no model file" in refused(path)
    assert "there is no model file" in refused(tmp_path)
    for content in (
        b"",
        b"robot: ur10\n",
        b"\x89PNG\r\n\x1a\n" + bytes(100),
        pickle.dumps({"model": 1}),
        bytes([255] * 8),
    ):
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


def test_torch_s_own_files_are_not_unpickled(tmp_path: Path) -> None:
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
def test_a_failing_save_leaves_the_old_file(
    where: str, error: BaseException, editor: Editor, sound: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    "no kernel": (("task_kernel",), [], "do not fit together"),
    "negative length": (("joint_kernel", 0, "lengthscale"), -1.0, "positive"),
    "kernel of another joint": (("joint_kernel", 0, "columns"), [6], "6 coordinates"),
    "no steps": (("integrator", "steps"), 0, "at least 1"),
    "unknown integrator": (("integrator", "kind"), "euler", "euler"),
    "dimension of the plane": (("task_dim",), 2, "task_dim"),
    "integrator is true": (("integrator",), True, "do not fit together"),
    "lever of a model of points": (("lever",), 0.1, "a model of poses: expected three points for each, got 1"),
    "negative lever": (("lever",), -0.1, "`lever`"),
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


@pytest.mark.parametrize("name", WRONG_ENTRIES)
def test_wrong_entries(name: str, editor: Editor) -> None:
    keys, value, message = WRONG_ENTRIES[name]
    assert message in refused(editor.write(set_entry(*keys, value=value)))


NOT_UNDERSTOOD = ("units", "nominal", "joint_kernel", "task_kernel", "task_dim", "integrator", "report", "lever")
MISSING: dict[str, Callable[[Any, Any], object]] = {
    **{k: lambda header, _, k=k: header.pop(k) for k in NOT_UNDERSTOOD},
    **{k: lambda header, _, k=k: header["nominal"]["joints"][0].pop(k) for k in ("lower", "mimic", "mimic_offset")},
    "elastic": lambda header, _: header["nominal"].pop("elastic"),
    **{k: lambda _, tensors, k=k: tensors.pop(k) for k in (*model_file.MOMENTA, *model_file.GEOMETRY)},
}
"""Entries of the header, of a joint and of elasticity, and tensors."""


@pytest.mark.parametrize("name", MISSING)
def test_missing_parts(name: str, editor: Editor) -> None:
    expected = "not understood" if name in NOT_UNDERSTOOD else f"do not fit together ('{name}')"
    assert expected in refused(editor.write(MISSING[name]))


WRONG_TENSORS: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
    "base not rigid": ("base", lambda t: -t),
    "base of another shape": ("base", lambda t: t[:3]),
    "no markers": ("tool", lambda t: t[:0]),
    "one joint error less": ("joint_errors", lambda t: t[:-1]),
    "configurations not finite": ("x", lambda t: t * float("nan")),
    "noise negative": ("noise", lambda t: -t),
    "new noise negative": ("new_noise", lambda t: -t),
    "new noise not symmetric": ("new_noise", lambda t: t + 0.1 * t.max() * torch.ones_like(t).triu(1)),
    "new noise of another size": ("new_noise", lambda t: t[:2, :2]),
    "one elastic prior less": ("prior_variance", lambda t: t[:-1]),
    "one row less in x": ("x", lambda t: t[:-1]),
    "one row less in the noise": ("noise", lambda t: t[:-1]),
    "parameters of a million metres": ("theta", lambda t: t + 2e6),
    "rigid errors of other joints": ("rigid_errors", lambda t: t[:2]),
    "rigid errors not rigid": ("rigid_errors", lambda t: 2 * t),
    "integers": ("noise", lambda t: t.long()),
}


@pytest.mark.parametrize("name", WRONG_TENSORS)
def test_wrong_tensors(name: str, editor: Editor) -> None:
    assert "do not fit together" in refused(editor.write(set_tensor(*WRONG_TENSORS[name])))


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
