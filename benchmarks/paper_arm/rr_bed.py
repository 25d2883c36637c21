"""The paper's RR test bed, shared by its benchmarks: held-out configurations, errors of a model, fields of a fit.

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025,
section 5: noise-free measurements of the elastic arm on a grid of [-pi, pi)^2, its kernels, 3000 random tests.
"""

from __future__ import annotations

from math import isfinite, log10, pi

import torch
from harness import Record, Value
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.robots import elastic_rr

TEST_ROWS, JACOBIAN_ROWS, SEED = 3000, 50, 0
DIFFERENCE = 1e-5  # rad


def held_out() -> Tensor:
    """Return the held-out random configurations (3000, 2) [rad]."""
    generator = torch.Generator().manual_seed(SEED)
    return pi * (2.0 * torch.rand(TEST_ROWS, 2, generator=generator, dtype=torch.float64) - 1.0)


def describe(fit: dc.Fit) -> Record:
    """Return the fields that all records of a fit share: certificates, accuracy, cost."""
    test = held_out()
    return {
        "energy": finite(fit.energy),
        "coupling_residual": finite(fit.coupling_residual),
        "end_residual": finite(fit.end_residual),
        "orders_random": orders(fit.model, test),
        "orders_grid": orders(fit.model, fit.problem.x),
        "jacobian_relative_error": jacobian_error(fit.model, test[:JACOBIAN_ROWS]),
        "iterations": fit.iterations,
        "evaluations": fit.evaluations,
        "seconds": fit.seconds,
        "status": fit.status,
    }


def finite(value: float) -> Value:
    """Return the value, or None if it is not finite."""
    return value if isfinite(value) else None


def errors(model: FittedMap, x: Tensor) -> Tensor:
    """Return the distances (M,) between a model and the real arm."""
    return (model(x) - elastic_rr.real(x)).norm(dim=1)


def orders(model: FittedMap, x: Tensor) -> Value:
    """Return log10(mean nominal error / mean error of the model)."""
    nominal = (elastic_rr.nominal(x) - elastic_rr.real(x)).norm(dim=1)
    ratio = float(nominal.mean() / errors(model, x).mean())
    return log10(ratio) if isfinite(ratio) and ratio > 0.0 else None


def jacobian_error(model: FittedMap, x: Tensor) -> float:
    """Return |J - central differences| / |J|, Frobenius norms over all x (M, n)."""
    jacobian = model.jacobian(x)  # (M, m, n)
    pushes = DIFFERENCE * torch.eye(x.shape[1], dtype=x.dtype)
    differences = torch.stack([(model(x + h) - model(x - h)) / (2.0 * DIFFERENCE) for h in pushes], dim=2)
    return float((jacobian - differences).norm() / jacobian.norm())


def autograd_error(model: FittedMap, x: Tensor) -> float:
    """Return |J - autograd of the call| / |J|: without the rounding of differences."""
    jacobian = model.jacobian(x)  # (M, m, n)
    at = x.clone().requires_grad_()
    rows = [torch.autograd.grad(column.sum(), at, retain_graph=True)[0] for column in model(at).T]
    return float((jacobian - torch.stack(rows, dim=1)).norm() / jacobian.norm())
