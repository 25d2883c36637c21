"""The rule that says which rows look wrong, on clean errors and beside gross ones."""

from __future__ import annotations

import pytest
import torch

from diffeo_calib.calibration.diagnostics.outliers import excluded

TABLES = 1500


@pytest.mark.parametrize("freedom", [1, 3, 6])
@pytest.mark.parametrize("rows", [5, 12, 40])
@pytest.mark.parametrize("expected", [0.05, 1.0, 20.0])
def test_one_of_a_hundred_clean_tables_is_suspected_however_few_its_rows(
    freedom: int, rows: int, expected: float
) -> None:
    """Whatever the model expects of the errors: the others tell how large they are."""
    drawn = torch.Generator().manual_seed(rows)
    squares = expected * torch.randn(TABLES, rows, freedom, generator=drawn, dtype=torch.float64).square().sum(2)
    each = torch.full((rows, 1), float(freedom), dtype=torch.float64)
    suspected = sum(bool(excluded(one[:, None], each, least=0.0).any()) for one in squares)
    assert suspected < 0.02 * TABLES


def test_a_gross_error_is_named_and_hidden_markers_are_not() -> None:
    squares = torch.randn(30, 2, 3, generator=torch.Generator().manual_seed(0)).double().square().sum(2)
    squares[4, 1], squares[7, 0] = 100.0, torch.nan
    found = excluded(squares, torch.full_like(squares, 3.0))
    assert found.nonzero().tolist() == [[4, 1]]
