"""KeOps, really compiled, against the torch backends.

Every formula is compiled with one profile, and profiles with all operations of :class:`Node` with the one formula that
holds all derivatives: 7 times about 7 s, by two processes at once where KeOps' cache folder is empty.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from math_bank import Case, case_named, normal
from torch import Tensor

from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.reductions import backends
from diffeo_calib.kernels.reductions.backends import Backend

pytestmark = pytest.mark.slow

HERE = ("matern-1.5",)
THERE = ("constant", "output", "gaussian")
"""Kernels that this process and its helper compile; no profile is in both, so that they never write the same file."""
CHOSEN = [case_named(name) for name in (*HERE, *THERE)]
WITH_EVERY_FORMULA, *_ = CHOSEN
SINGLE = case_named("gaussian")

Method = Callable[[Kernel, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, ...]]
METHODS: dict[str, Method] = {
    "field": lambda k, x, c, q, a, dq, da: (k.field(x, q, a),),
    "field of the controls": lambda k, x, c, q, a, dq, da: (k.field(None, q, a),),
    "field_and_jacobian": lambda k, x, c, q, a, dq, da: k.field_and_jacobian(x, q, a),
    "gradient of the controls": lambda k, x, c, q, a, dq, da: k.hamiltonian_gradient(q, a),
    "gradient": lambda k, x, c, q, a, dq, da: k.gradient(x, c, q, a),
    "hessian_product": lambda k, x, c, q, a, dq, da: k.hessian_product(q, a, dq, da),
}
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())


def methods_of(name: str) -> list[str]:
    """The methods that are compiled for a kernel."""
    if name == WITH_EVERY_FORMULA.name:
        return list(METHODS)
    return ["field"] if name == SINGLE.name else ["hessian_product"]


every_compiled_sum = pytest.mark.parametrize(
    ("case", "method"),
    [pytest.param(case, METHODS[name], id=f"{case.name}-{name}") for case in CHOSEN for name in methods_of(case.name)],
)


def inputs(case: Case, rows: int = 6, columns: int = 5) -> tuple[Tensor, ...]:
    """x, c; q, a and their directions."""
    dq, da = normal(2, columns, case.dim, seed=5)
    x, c = case.points(rows, seed=1), normal(rows, case.dim, seed=4)
    return x, c, case.points(columns, seed=2), normal(columns, case.dim, seed=3), dq, da


def compile_all(names: tuple[str, ...]) -> None:
    """Run every chosen formula of these kernels once."""
    for case in map(case_named, names):
        for name in methods_of(case.name):
            METHODS[name](case.kernel.using("keops"), *inputs(case))
    if SINGLE.name in names:
        METHODS["field"](SINGLE.kernel.using("keops"), *(t.float() for t in inputs(SINGLE)))
    assert np.float64(1e-310) * 0.5 > 0.0  # flags of the compiler must not flush denormals to zero


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    """Compile in two processes in parallel."""
    command = [
        sys.executable,
        "-c",
        f"import sys; sys.path[:] = {sys.path}; import {__name__} as t; t.compile_all({THERE})",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as helper:
        compile_all(HERE)
        output, _ = helper.communicate(timeout=900)
    assert (helper.returncode, output) == (0, ""), "import, compilation and sums are silent"


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch) -> Callable[[Backend], None]:
    """Remove all other backends, so that none can replace this one."""

    def remove(backend: Backend) -> None:
        for name in set(backends.BACKENDS) - {backend}:
            monkeypatch.delitem(backends.BACKENDS, name)

    return remove


def assert_close(actual: tuple[Tensor, ...], expected: tuple[Tensor, ...], relative: float = 1e-12) -> None:
    for one, other in zip(actual, expected, strict=True):
        assert one.dtype == other.dtype
        torch.testing.assert_close(one, other, rtol=0, atol=relative * float(other.abs().max()))


@every_compiled_sum
@pytest.mark.parametrize("backend", ["tiled", "keops"])
@pytest.mark.parametrize("size", [(6, 5), (300, 280)])
def test_backends_agree(
    case: Case, method: Method, backend: Backend, size: tuple[int, int], only: Callable[[Backend], None]
) -> None:
    expected = method(case.kernel.using("dense"), *inputs(case, *size))
    only(backend)
    assert_close(method(case.kernel.using(backend), *inputs(case, *size)), expected)


@every_method
@pytest.mark.parametrize("size", [(6, 5), (0, 5), (6, 0), (0, 0)])
def test_strided_and_empty_inputs(method: Method, size: tuple[int, int]) -> None:
    case = WITH_EVERY_FORMULA
    strided = [torch.stack([t, t], -1)[..., 0] for t in inputs(case, *size)]
    expected = method(case.kernel.using("dense"), *inputs(case, *size))
    torch.testing.assert_close(method(case.kernel.using("keops"), *strided), expected, rtol=1e-12, atol=1e-12)


def test_single_precision(only: Callable[[Backend], None]) -> None:
    single = [t.float() for t in inputs(SINGLE)]
    expected = METHODS["field"](SINGLE.kernel.using("dense"), *single)
    only("keops")
    assert_close(METHODS["field"](SINGLE.kernel.using("keops"), *single), expected, 1e-6)


@every_method
@pytest.mark.parametrize("live", range(6))
def test_tiled_sums_replace_keops_where_gradients_are_needed(method: Method, live: int) -> None:
    """For each input. Under no_grad KeOps runs, and nothing is recorded."""
    case, gradients = WITH_EVERY_FORMULA, []
    for backend in ("dense", "keops"):
        tensors = [t.clone().requires_grad_(k == live) for k, t in enumerate(inputs(case))]
        results = method(case.kernel.using(backend), *tensors)
        loss = sum(((normal(*t.shape, seed=k) * t).sum() for k, t in enumerate(results)), 0.0 * tensors[live].sum())
        gradients.append(torch.autograd.grad(loss, tensors[live]))
        with torch.no_grad():
            again = method(case.kernel.using(backend), *tensors)
        assert not any(t.requires_grad for t in again)
        assert_close(again, tuple(t.detach() for t in results))
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-12, atol=1e-12)


def test_denormal_numbers_are_not_flushed_to_zero() -> None:
    """With `-ffast-math`, loading a compiled formula would flush them to zero in the whole process."""
    assert np.float64(1e-310) * 0.5 == 5e-311
    assert float(torch.tensor(1e-310, dtype=torch.float64) * 0.5) == 5e-311
