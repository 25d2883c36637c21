"""Rows out of step: found where they are, at any lag, with rows missing; nothing in tables that are right."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.row_order import out_of_step

NOISE = 1e-3
TYPICAL = 1.5 * NOISE
"""Median length of three coordinates."""


def draw(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def table(rows: int, first: int, last: int, lag: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Predictions, measured values of which the rows first ... last - 1 belong ``lag`` rows below, and line numbers."""
    predicted, wanted = draw(rows, 1, 3, seed=seed), torch.arange(rows)
    wanted[first:last] += lag
    kept = (wanted >= 0) & (wanted < rows)
    measured = predicted[wanted.clamp(0, rows - 1)] + NOISE * draw(rows, 1, 3, seed=seed + 1)
    return predicted[kept], measured[kept], torch.arange(2, rows + 2)[kept]


@pytest.mark.parametrize("lag", [-5, -1, 1, 2])
@pytest.mark.parametrize("first", [5, 25])
def test_from_a_line_on(first: int, lag: int) -> None:
    (step,) = out_of_step(*table(40, first, 40, lag), typical=TYPICAL)
    assert (step.first, step.lag, step.to_the_end) == (first + 2, lag, True)
    there = 40 - first - 2 * max(lag, 0)  # the last rows have lost their measured values
    assert there - 2 <= step.rows <= there


def test_a_block_in_the_middle() -> None:
    (step,) = out_of_step(*table(40, 10, 22, -1), typical=TYPICAL)
    assert (step.first, step.last, step.lag, step.to_the_end) == (12, 23, -1, False)
    assert step.sentence().startswith("in lines 12 to 23 the measured values belong to the joints 1 line above")


def test_rows_in_any_order_and_with_gaps() -> None:
    """As after a split: 70 % of the rows, and thus half of the pairs."""
    tables = table(100, 50, 100, -1)
    rows = torch.randperm(100, generator=torch.Generator().manual_seed(3))[:70]
    (step,) = out_of_step(*(part[rows] for part in tables), typical=TYPICAL)
    assert step.lag == -1
    assert abs(step.first - 52) <= 2
    assert step.to_the_end


@pytest.mark.parametrize("rows", [4, 15, 60, 300])
def test_nothing_in_tables_that_are_right(rows: int) -> None:
    """With heavy tails, with every fifth row far off, and with a pair of rows exchanged."""
    for seed in range(10):
        predicted, measured, lines = table(rows, 0, 0, 0, seed=seed)
        assert out_of_step(predicted, measured, lines, TYPICAL) == []
        measured = measured + NOISE * draw(rows, 1, 3, seed=seed + 50) / draw(rows, 1, 1, seed=seed + 60).abs()
        measured[::5] += 0.2
        measured[[1, 2]] = measured[[2, 1]]
        assert out_of_step(predicted, measured, lines, TYPICAL) == []


def test_nothing_on_a_slow_path() -> None:
    """Where the next row is nearer than the error of the nominal robot."""
    t = torch.linspace(0, 1, 200, dtype=torch.float64)
    predicted = torch.stack([t.cos(), t.sin(), t], 1)[:, None]
    measured = predicted + 5e-3 * torch.stack([(3 * t).sin(), (2 * t).cos(), t], 1)[:, None]
    typical = float((predicted - measured).norm(dim=-1).median())
    assert out_of_step(predicted, measured, torch.arange(200), typical) == []
