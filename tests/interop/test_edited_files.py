"""Edited model files with a correct checksum: wrong entries and tensors are refused with one clear sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from model_file_bank import Editor, refused, set_entry, set_tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import ModelFileError
from diffeo_calib.interop import model_header


def test_an_edit_needs_a_new_checksum(editor: Editor) -> None:
    edit = set_entry("report", "rows", value=10)
    assert "damaged or edited: its checksum does not match" in refused(editor.write(edit, sign=False))
    model = dc.load(editor.write(edit))
    assert isinstance(model, dc.CalibratedKinematics)
    assert model.report["rows"] == 10


WRONG_ENTRIES: dict[str, tuple[tuple[Any, ...], Any, str]] = {
    "other format": (("format",), 1, "format version 1: expected 3; read it with the version that wrote it"),
    "the format before": (("format",), 2, "format version 2: expected 3; read it with the version that wrote it"),
    "extra entry": (("surprise",), 1, "header of the model file is not understood"),
    "other unit": (("units", "length"), "mm", "header of the model file is not understood"),
    "kernel option": (("joint_kernel", 0, "surprise"), 1, "do not fit together"),
    "no kernel": (("task_kernel",), [], "do not fit together"),
    "kernel is a word": (("task_kernel",), "gaussian", "do not fit together"),
    "negative length": (("joint_kernel", 0, "lengthscale"), -1.0, "positive"),
    "negative variance": (("task_kernel", 0, "variance"), -1.0, "non-negative"),
    "kernel of another joint": (("joint_kernel", 0, "columns"), [6], "6 coordinates"),
    "no steps": (("integrator", "steps"), 0, "at least 1"),
    "too many steps": (("integrator", "steps"), 2000, "at most 1024"),
    "unknown integrator": (("integrator", "kind"), "euler", "euler"),
    "dimension of a word": (("task_dim",), "three", "do not fit together"),
    "dimension zero": (("task_dim",), 0, "task_dim"),
    "lever of a model of points": (("lever",), 0.1, "a model of poses: expected three points for each, got 1"),
    "negative lever": (("lever",), -0.1, "`lever`"),
    "lever is true": (("lever",), True, "`lever`"),
    "other kind": (("nominal", "kind"), "planet", "robot or function"),
    "no robot": (("nominal",), None, "do not fit together"),
    "no joints": (("nominal", "joints"), [], "no moving joint"),
    "joints of words": (("nominal", "joints"), "six", "do not fit together"),
    "axis of length zero": (("nominal", "joints", 0, "axis"), [0, 0, 0], "axis of joint 'waist_joint'"),
    "origin not rigid": (("nominal", "joints", 0, "origin"), np.diag([2.0, 1, 1, 1]).tolist(), "rigid"),
    "unknown joint": (("nominal", "joints", 0, "kind"), "ball", "kind of joint"),
    "one joint less": (("nominal", "joints", 0, "kind"), "fixed", "joint_errors"),
    "mimic of no joint": (("nominal", "joints", 0, "mimic"), {"nose": 1.0}, "mimics 'nose'"),
    "one active joint less": (("nominal", "joints", 1, "mimic"), {"waist_joint": 1.0}, "expected 5 active joints"),
    "elastic of a word": (("nominal", "elastic"), "no", "the entry elastic: expected true or false, got no"),
    "rigid, with elastic coefficients": (("nominal", "elastic"), False, "`theta` has the wrong shape"),
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


@pytest.mark.parametrize("key", ["lower", "mimic", "mimic_offset", "elastic"])
def test_missing_entries_of_a_joint_and_of_elasticity(key: str, editor: Editor) -> None:
    def without(header: Any, _: Any) -> None:
        (header["nominal"] if key == "elastic" else header["nominal"]["joints"][0]).pop(key)

    edited = editor.write(without)
    assert f"do not fit together ('{key}')" in refused(edited)


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
    "one elastic prior less": ("prior_variance", lambda t: t[:-1]),
    "one elastic prior nothing": ("prior_variance", lambda t: t * (torch.arange(len(t)) < len(t) - 1)),
    "one row less in x": ("x", lambda t: t[:-1]),
    "one row less in b": ("momenta_x", lambda t: t[:-1]),
    "one row less in p": ("momenta_y", lambda t: t[:-1]),
    "one row less in the noise": ("noise", lambda t: t[:-1]),
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


@pytest.mark.parametrize(("key", "value"), [("task_dim", 2), ("task_dim", 1), ("report", []), ("integrator", True)])
def test_entries_that_do_not_match_the_tensors(key: str, value: object, editor: Editor) -> None:
    refused(editor.write(set_entry(key, value=value)))


@pytest.mark.parametrize("steps", [0, 0.5, True, 10**5, 10**30])
def test_the_reader_without_torch_bounds_the_time_steps(steps: object, editor: Editor) -> None:
    """Its work grows with them: 10^5 steps would take minutes."""
    with pytest.raises(ModelFileError, match="the number of time steps: expected an integer of at least 1"):
        dc.interop.load_numpy(editor.write(set_entry("integrator", "steps", value=steps)))


def test_a_forged_flow_has_no_predictions(editor: Editor) -> None:
    """With so large a variance its flow folds or its numbers overflow: rounding decides, and so what the error says."""
    folding = editor.write(set_entry("joint_kernel", 0, "variance", value=1e4))
    with pytest.raises(dc.DiffeoCalibError):
        dc.load(folding).predict(torch.zeros(3, 6, dtype=torch.float64, device="cpu"))
