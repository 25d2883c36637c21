"""Every line of the package that makes a tensor states its device and its kind of numbers.

`torch.set_default_device` and `torch.set_default_dtype` of a user's program then change nothing.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import diffeo_calib

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
