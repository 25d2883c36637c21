"""Sums in single precision, added up in double precision."""

from __future__ import annotations

import pytest
import torch
from math_bank import normal
from sum_bank import assert_same, every_formula, every_profile

from diffeo_calib.kernels.profiles import GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends, single
from diffeo_calib.kernels.reductions.formulas import FIELD, Formula, Points

COUNT = 1500


def cloud(seed: int, size: float = 1.0) -> Points:
    kinds = (2.0 * size, 1.0, 1.0, 1.0)
    return Points(*(k * normal(COUNT, 3, seed=seed + n).clamp(-1, 1) for n, k in enumerate(kinds)))


@every_profile
@every_formula
@pytest.mark.parametrize("same", [True, False])
def test_errors_are_those_of_single_precision(profile: Profile, formula: Formula, same: bool) -> None:
    rows, columns = None if same else cloud(1), cloud(7)
    found = single.sums(formula, profile, rows, columns, 1e-4)
    if profile == MaternProfile(1.5):  # its second derivative is infinite at zero distance
        assert found is None
        return
    assert found is not None
    exact = backends.evaluate(formula, profile, rows, columns, backend="tiled")
    assert all(t.dtype == torch.float64 for t in found)
    assert_same(found, exact, 1e-5 * COUNT)
    assert not torch.equal(found[0], exact[0]) or profile.name == "constant"


def test_many_tiles_add_up_in_double_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sum of equal numbers: in single precision its error would grow with the number of tiles."""
    monkeypatch.setattr(single, "CPU_ELEMENTS", 1 << 11)
    ones = torch.ones(COUNT, 1, dtype=torch.float64)
    columns = Points(torch.zeros(COUNT, 3, dtype=torch.float64), ones * (1.0 + 2.0**-17))
    for rows in (None, columns):
        found = single.sums(FIELD, GaussianProfile(), rows, columns, 1e-6)
        assert found is not None
        torch.testing.assert_close(found[0], ones * COUNT * (1.0 + 2.0**-17), rtol=1e-12, atol=0)


@pytest.mark.parametrize(("size", "accuracy"), [(1.0, 1e-7), (30.0, 1e-4)])
def test_double_precision_where_rounding_would_count(size: float, accuracy: float) -> None:
    assert single.sums(FIELD, GaussianProfile(), None, cloud(1, size), accuracy) is None


@pytest.mark.parametrize(("size", "taken"), [(1e45, False), (1e-50, False), (1e10, True), (0.0, True)])
def test_momenta_beyond_single_precision(size: float, taken: bool) -> None:
    points = Points(normal(2000, 3, seed=1), size * normal(2000, 3, seed=2))
    found = single.sums(FIELD, GaussianProfile(), None, points, 1e-4)
    assert (found is not None) == taken
