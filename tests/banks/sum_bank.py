"""Kernel sums for tests: points, profiles, formulas."""

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import Any

import pytest
import torch
from math_bank import normal
from torch import Tensor

from diffeo_calib.kernels.profiles import CauchyProfile, ConstantProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions.formulas import FIELD, FIELD_AND_JACOBIAN, GRADIENT, HESSIAN_PRODUCT, Points

ROWS, COLUMNS, FEATURES, OUTPUTS = 7, 5, 3, 2
FAR = float(1 << 20)
PROFILES = (GaussianProfile(), CauchyProfile(), ConstantProfile(), *(MaternProfile(nu) for nu in (1.5, 2.5, 3.5)))

needs_llvmlite = pytest.mark.skipif(find_spec("llvmlite") is None, reason="llvmlite is not installed")
torch_backends = pytest.mark.parametrize("backend", ["dense", "tiled", pytest.param("fused", marks=needs_llvmlite)])


class Formulated(Profile):
    """A profile of a user: a function of r2, of which fields need no derivative."""

    name = "formulated"  # pyright: ignore[reportAssignmentType]

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function

    def derivative(self, r2: Any, order: int) -> Any:
        return self.function(r2)


def representable(*shape: int, seed: int) -> Tensor:
    """Random numbers with 20 binary digits, so that adding 2^20 loses nothing."""
    return (normal(*shape, seed=seed) * 2**20).round() / 2**20


def points(count: int, seed: int) -> Points:
    return Points(
        representable(count, FEATURES, seed=seed),
        normal(count, OUTPUTS, seed=seed + 1),
        normal(count, FEATURES, seed=seed + 2),
        normal(count, OUTPUTS, seed=seed + 3),
    )


def apart() -> tuple[Points, Points]:
    """Rows and columns."""
    return points(ROWS, 10), points(COLUMNS, 20)


def sides(same: bool) -> tuple[Points | None, Points]:
    """Rows and columns; rows None for sums over the columns themselves."""
    return (None, points(ROWS, 10)) if same else apart()


def mapped(p: Points, change: Callable[[Tensor], Tensor]) -> Points:
    return Points(*(change(t) for t in p.tensors))


def assert_same(actual: Iterable[Tensor], expected: Iterable[Tensor], atol: float = 1e-13) -> None:
    for one, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=atol, atol=atol)


FORMULAS = {formula.name: formula for formula in (FIELD, FIELD_AND_JACOBIAN, GRADIENT, HESSIAN_PRODUCT)}
every_formula = pytest.mark.parametrize("formula", FORMULAS.values(), ids=FORMULAS.keys())
