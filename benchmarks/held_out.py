"""Errors and coverage where true positions are known: shared by the benchmarks on simulated robots."""

from __future__ import annotations

from collections.abc import Mapping
from math import log

import torch
from harness import Record
from torch import Tensor

INSIDE_95 = 7.8147
"""95 % quantile of chi-square with 3 degrees of freedom."""


def rms_mm(errors: Tensor) -> float:
    """Root of the mean square of distances, from errors (..., 3) in m."""
    return 1e3 * float(errors.square().sum(-1).mean().sqrt())


def covered(errors: Tensor, covariance: Tensor) -> float:
    """Share of errors (..., 3) inside the 95 % regions of covariances (..., 3, 3)."""
    away = errors[..., None]
    squares = (away.mT @ torch.linalg.solve(covariance, away)).flatten()
    return float((squares < INSIDE_95).double().mean())


def judged(mean: Tensor, covariance: Tensor, truth: Tensor, noise: float) -> Record:
    """Errors of predicted positions (M, P, 3), and coverage of measured ones, whose noise [m] has a fixed seed."""
    draws = noise * torch.randn(truth.shape, dtype=truth.dtype, generator=torch.Generator().manual_seed(1))
    errors = mean - truth
    return {
        "mean_mm": 1e3 * float(errors.norm(dim=-1).mean()),
        "rms_mm": rms_mm(errors),
        "coverage_95": covered(errors - draws, covariance),
    }


def exponents(record: Record, last: Record, size: str, fields: Mapping[str, str]) -> Record:
    """Slopes in log-log scale between two records, for ``fields`` as {name of the slope: field}."""
    growth = log(float(record[size] or 1) / float(last[size] or 1))
    return {slope: log(float(record[field] or 1) / float(last[field] or 1)) / growth for slope, field in fields.items()}
