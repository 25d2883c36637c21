"""The package under another default device and type: every tensor states its own, so that the results are the same.

Any operation that mixes the "meta" device, whose tensors hold no numbers, with real ones fails. Half precision, unlike
torch's own default, would show. And every line of the package that makes a tensor states its device
and its kind of numbers.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from product_bank import Case
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib
import diffeo_calib as dc


@contextmanager
def elsewhere() -> Iterator[None]:
    """Tensors are made on the meta device and in half precision, unless they state theirs."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float16)
    try:
        with torch.device("meta"):
            yield
    finally:
        torch.set_default_dtype(before)


def parts(found: Any) -> list[Any]:
    if isinstance(found, (list, tuple)):
        return [inner for part in found for inner in parts(part)]
    return [found]


def same(work: Callable[[], Any]) -> list[Any]:
    """The results of the work, which are the same whatever the default device is."""
    expected = parts(work())
    with elsewhere():
        found = parts(work())
    for one, other in zip(found, expected, strict=True):
        if isinstance(other, Tensor | np.ndarray):
            assert_close(one, other, rtol=1e-9, atol=1e-10)  # the device and the type are compared too
        elif isinstance(other, float):  # of a search that sums in any order
            assert one == pytest.approx(other, rel=1e-4, nan_ok=True)
        else:
            assert one == other
    return expected


# --- models --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_models(arm: Case, tmp_path: Path) -> None:
    q, joint, path = arm.test.q[:4], arm.robot.joint_names[1], tmp_path / "model.safetensors"

    def work() -> list[Any]:
        dc.save(arm.model, path)
        model: Any = dc.load(path)
        plain, live = dc.interop.load_numpy(path), q.clone().requires_grad_()
        slopes, poses = torch.autograd.grad(model(live).sum(), live), arm.model.tool_poses(q)
        queries = model(q), model.jacobian(q), model.predict(q), model.inverse(model(q), q + 0.01), slopes
        tools = model.predict_tool_poses(q), model.tool_jacobian(q), model.transmission(joint, q[:, 1])
        commands = [dc.compensate(model, target, q).q for target in (poses, poses[:, :3, 3])]
        found, data = model.registered(arm.test[:6]), dc.Measurements(q, arm.test.points[:4], std=1e-4)
        judged: Any = dc.evaluate(model, data)
        rows = data[1:3].std, data.split(0.5)[0].q, data.groups(), judged.errors
        return [*queries, *tools, plain(q.numpy()), commands, found(q), found.predict(q), *rows]

    same(work)


# --- the source -------------------------------------------------------------------------------------------------------

PACKAGE = Path(diffeo_calib.__file__).parent
NUMBERED = {"arange", "randint", "randperm", "tril_indices", "triu_indices", "Generator"}
"""Their kind of numbers does not follow the default type; that of `arange` follows its arguments."""
FACTORIES = NUMBERED | {
    *("as_tensor", "asarray", "empty", "empty_strided", "eye", "full", "hamming_window", "hann_window", "linspace"),
    *("logspace", "normal", "ones", "rand", "randn", "scalar_tensor", "sparse_coo_tensor", "tensor", "zeros"),
}
"""Functions of torch whose result lies on the default device, unless it is stated."""
OLD = {"Tensor", "FloatTensor", "DoubleTensor", "LongTensor", "BoolTensor", "set_default_device", "set_default_dtype"}
"""Constructors that cannot state it, and global switches."""


def silent(source: str) -> Iterator[str]:
    """Calls in a program that leave the device or the kind of numbers to a default."""
    for node in ast.walk(ast.parse(source)):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        owner, name = node.func.value, node.func.attr
        if not (isinstance(owner, ast.Name) and owner.id == "torch" and name in FACTORIES | OLD):
            continue
        stated = {keyword.arg for keyword in node.keywords}
        if name == "Generator" and node.args:
            stated.add("device")
        for option in ("device",) if name in NUMBERED else ("device", "dtype"):
            if name in OLD or option not in stated:
                yield f"line {node.lineno}: torch.{name} without {option}"


def test_a_silent_line_is_found() -> None:
    source = (
        "import torch\ntorch.zeros(3)\ntorch.eye(2, dtype=torch.float64, device='cpu')\ntorch.Tensor(3)\n"
        "torch.Generator('cpu')\ntorch.Generator()\n"
    )
    assert [text.partition(":")[0] for text in silent(source)] == ["line 2", "line 2", "line 4", "line 4", "line 6"]


def test_every_tensor_states_its_device_and_its_kind() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 100
    found = [f"{path.relative_to(PACKAGE)}, {text}" for path in files for text in silent(path.read_text())]
    assert not found, "\n".join(found)
