"""Kernel sums of every backend on unusual input, and the choice of a backend. Their values: test_kernels.py."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from math_bank import torch_threads
from sum_bank import (
    FAR,
    ROWS,
    apart,
    assert_same,
    every_formula,
    every_profile,
    mapped,
    needs_llvmlite,
    points,
    sides,
    torch_backends,
)
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kernels.reductions.formulas import FIELD, GRADIENT, HESSIAN_PRODUCT, Formula


@every_formula
@torch_backends
@pytest.mark.parametrize("same", [False, True])
def test_strided_inputs(formula: Formula, backend: Backend, same: bool) -> None:
    expected = backends.evaluate(formula, GaussianProfile(), *sides(same), backend)
    i, j = (None if p is None else mapped(p, lambda t: torch.stack([t.T, t.T], -1)[..., 0].T) for p in sides(same))
    assert j is not None
    assert not j.features.is_contiguous()
    assert_same(backends.evaluate(formula, GaussianProfile(), i, j, backend), expected)


@every_profile
@every_formula
@torch_backends
@pytest.mark.parametrize("same", [False, True])
def test_centring_keeps_the_digits_far_from_the_origin(
    formula: Formula, profile: Profile, backend: Backend, same: bool
) -> None:
    i, j = sides(same)
    far_i = None if i is None else i._replace(features=i.features + FAR)
    far_j = j._replace(features=j.features + FAR)
    atol = 1e-7 if profile == MaternProfile(1.5) else 1e-12  # its third derivative is singular where points coincide
    assert_same(
        backends.evaluate(formula, profile, far_i, far_j, backend),
        backends.evaluate(formula, profile, i, j, backend),
        atol,
    )


@every_formula
@torch_backends
def test_no_rows_and_no_columns(formula: Formula, backend: Backend) -> None:
    some, none = points(ROWS, 10), points(0, 20)
    shapes = [t.shape[1:] for t in backends.evaluate(formula, GaussianProfile(), None, some)]
    for rows, columns in ((none, some), (some, none), (none, none)):
        for result, shape in zip(
            backends.evaluate(formula, GaussianProfile(), rows, columns, backend), shapes, strict=True
        ):
            torch.testing.assert_close(result, torch.zeros(len(rows.features), *shape, dtype=torch.float64))


@every_profile
@every_formula
@torch_backends
@pytest.mark.parametrize("same", [False, True])
def test_single_precision_stays_single(formula: Formula, profile: Profile, backend: Backend, same: bool) -> None:
    expected = backends.evaluate(formula, profile, *sides(same), backend)
    i, j = sides(same)
    i, j = None if i is None else mapped(i, Tensor.float), mapped(j, Tensor.float)
    for single, double in zip(backends.evaluate(formula, profile, i, j, backend), expected, strict=True):
        assert single.dtype is torch.float32
        scale = float(double.abs().max()) + 1.0
        atol = 3e-3 if profile == MaternProfile(1.5) else 1e-5
        torch.testing.assert_close(single.double(), double, rtol=0, atol=atol * scale)


@pytest.mark.parametrize("backend", ["tiled", pytest.param("fused", marks=needs_llvmlite)])
@pytest.mark.parametrize("formula", [FIELD, GRADIENT, HESSIAN_PRODUCT])
def test_the_number_of_threads_changes_no_digit(formula: Formula, backend: str) -> None:
    """2100 points, of themselves and of others: enough for several threads."""
    i, j, found = points(2100, 1), points(2100, 2), []
    for count in (1, 2, 3):
        with torch_threads(count):
            sums = [backends.BACKENDS[backend].reduce(formula, GaussianProfile(), rows, j) for rows in (None, i)]
            found.append([result for each in sums for result in each or ()])
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))
    dense = [backends.BACKENDS["dense"].reduce(formula, GaussianProfile(), rows, j) for rows in (None, i)]
    assert_same(found[0], [result for each in dense for result in each or ()], 1e-9)


# --- Dispatch ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("usable", [True, False])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_auto_chooses_by_size_and_device(
    monkeypatch: pytest.MonkeyPatch, device: str, usable: bool, compiled: bool
) -> None:
    monkeypatch.setattr(backends.BACKENDS["keops"], "usable", lambda: usable)
    monkeypatch.setattr(backends.FUSED, "trouble", lambda: "" if compiled else "not here")
    here, most, fewest = torch.device(device), backends.DENSE_PAIRS[device], backends.KEOPS_PAIRS
    least = backends.FUSED_PAIRS
    large = "keops" if usable else "tiled"
    for pairs in (0, 1, least - 1, least, most - 1, most, most + 1, fewest - 1, fewest, fewest + 1):
        expected = "keops" if usable and pairs >= fewest and device == "cuda" else "tiled" if pairs > most else "dense"
        expected = "fused" if compiled and device == "cpu" and pairs >= least else expected
        assert backends.choose("auto", 1, pairs, here) == backends.choose("auto", pairs, 1, here) == expected
    for rows in (0, 1, fewest):
        assert backends.choose("dense", rows, 7, here) == "dense"
        assert backends.choose("tiled", rows, 7, here) == "tiled"
        assert backends.choose("keops", rows, 7, here) == large


@pytest.mark.parametrize("name", ["numpy", "", "Dense", None])
def test_unknown_backends_are_refused(name: Any) -> None:
    with pytest.raises(
        InputError, match=r"^`backend`: expected auto, dense, fused, tiled, keops, distributed, got .*\.$"
    ):
        backends.check_backend(name)
    assert [backends.check_backend(known) for known in ("auto", "dense", "tiled", "keops")]


def test_small_sums_do_not_import_keops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends.BACKENDS["keops"], "usable", lambda: pytest.fail("pykeops was imported"))
    backends.evaluate(FIELD, GaussianProfile(), *apart())
    assert backends.choose("auto", 1000, 1000, torch.device("cpu")) in {"fused", "tiled"}
