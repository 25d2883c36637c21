"""Methods that calibrate the RR arm from the same measurements: our models with fewer or more parts, and peers.

Our models (names end in `tangent` or `flow`):

    phi, psi                       the paper's model
    phi, psi, residual field       plus a field on the arm's base that depends on the joint angles
    geometry, phi, psi             plus the six geometric parameters, under a prior
    geometry, gravity, phi, psi    plus coefficients of gravity sag: everything that `dc.calibrate` fits

Peers: the six geometric parameters alone; a Gaussian process on the residual of the nominal arm (torus von Mises
kernel, a length scale per joint, an amplitude per coordinate); the same with the geometric parameters as part of the
process (universal kriging), and with the coefficients of gravity; radial basis functions and neural networks on the
residual of the geometric parameters, with cos and sin of the joint angles as inputs.

The Gaussian processes are our models with a field on the base only: same code, same prior, same search for scales.
Radial basis functions and networks use the best settings of a grid by cross-validation on the data.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from rr_arm import BASE, JOINTS, ExtendedArm, extended
from rr_calibrations import Predict, calibrate, geometric_fit
from rr_models import LONGEST_FLOW, LONGEST_FLOW_TASK, Recipe
from torch import Tensor

PAPER = Recipe((JOINTS,), task=True)
PAPER_FLOW = replace(PAPER, longest=1.0, longest_task=1.0)
"""Without parameters the deformation is large and needs shorter length scales than the other flows."""
GEOMETRY = Recipe((JOINTS,), task=True, geometry=True, longest=LONGEST_FLOW, longest_task=LONGEST_FLOW_TASK)
PROCESS = Recipe((BASE,))
TANGENT, FLOW = ": tangent", ": flow"

FOLDS = 3
RADIAL: tuple[dict[str, Any], ...] = (
    *({"kernel": "gaussian", "epsilon": epsilon} for epsilon in (0.1, 0.3, 0.5, 0.7, 1.0)),
    *({"kernel": "multiquadric", "epsilon": epsilon} for epsilon in (0.3, 1.0)),
    {"kernel": "thin_plate_spline", "degree": 1},
    {"kernel": "cubic", "degree": 1},
)
SMOOTHING = (0.0, 1e-6, 1e-3)
NETWORKS: tuple[dict[str, Any], ...] = tuple(
    {"hidden_layer_sizes": size, "alpha": alpha} for size in ((16,), (32, 32)) for alpha in (1e-5, 1e-3, 1e-1)
)
NETWORK_STEPS, AVERAGED = 400, 3

Fitted = tuple[str, Predict, str | None]
"""Name, predictions, and a remark if the fit did not converge."""


def model(recipe: Recipe, names: tuple[str, ...], x: Tensor, y: Tensor, seed: int) -> Iterator[Fitted]:
    """A recipe's tangent model, and its flow with the same scales for names that end in `flow`."""
    found = calibrate(recipe, x, y, seed)
    for name in names:
        predict, note = found.flow() if name.endswith(FLOW) else (found.tangent(), None)
        yield name, predict, note


def geometry(x: Tensor, y: Tensor, seed: int) -> Iterator[Fitted]:
    """The six geometric parameters."""
    yield "geometry", _geometric(x, y), None


def radial(x: Tensor, y: Tensor, seed: int) -> Iterator[Fitted]:
    """Radial basis functions on the residual of the geometry."""
    from scipy.interpolate import RBFInterpolator  # noqa: PLC0415  # slow to import

    def fit(inputs: np.ndarray, targets: np.ndarray, options: dict[str, Any]) -> Callable[[np.ndarray], np.ndarray]:
        scale = max(float(np.abs(targets).max()), 1e-300)
        found = RBFInterpolator(inputs, targets / scale, **options)
        return lambda at: scale * found(at)

    grid = [settings | {"smoothing": smoothing} for settings in RADIAL for smoothing in SMOOTHING]
    yield "geometry + radial basis functions", _corrected(x, y, seed, fit, grid), None


def network(x: Tensor, y: Tensor, seed: int) -> Iterator[Fitted]:
    """The mean of several networks on the residual of the geometry."""
    from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415  # optional, and slow to import
    from sklearn.neural_network import MLPRegressor  # noqa: PLC0415

    def fit(inputs: np.ndarray, targets: np.ndarray, options: dict[str, Any]) -> Callable[[np.ndarray], np.ndarray]:
        settings = options | {"activation": "tanh", "solver": "lbfgs", "max_iter": NETWORK_STEPS}
        scale = max(float(targets.std()), 1e-300)
        count = settings.pop("count", 1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            start: Any = MLPRegressor(**settings)
            seeds = range(seed, seed + count)
            nets: list[Any] = [deepcopy(start).set_params(random_state=k).fit(inputs, targets / scale) for k in seeds]
        return lambda at: scale * np.mean([net.predict(at) for net in nets], axis=0)

    final = {"count": AVERAGED}
    yield "geometry + neural network", _corrected(x, y, seed, fit, list(NETWORKS), final=final), None


RECIPES: dict[tuple[str, ...], Recipe] = {
    ("phi, psi: tangent",): PAPER,
    ("phi, psi: flow",): PAPER_FLOW,
    ("phi, psi, residual field: tangent",): replace(PAPER, fields=(JOINTS, BASE)),
    ("geometry, phi, psi: tangent", "geometry, phi, psi: flow"): GEOMETRY,
    ("geometry, gravity, phi, psi: tangent", "geometry, gravity, phi, psi: flow"): replace(GEOMETRY, gravity=True),
    ("geometry, gravity",): Recipe(geometry=True, gravity=True),
    ("GP",): PROCESS,
    ("geometry + GP",): replace(PROCESS, geometry=True),
    ("geometry, gravity + GP",): replace(PROCESS, geometry=True, gravity=True),
}
METHODS: dict[tuple[str, ...], Callable[[Tensor, Tensor, int], Iterator[Fitted]]] = {
    **{names: partial(model, recipe, names) for names, recipe in RECIPES.items()},
    ("geometry",): geometry,
    ("geometry + radial basis functions",): radial,
    ("geometry + neural network",): network,
}
"""The function that fits each group of methods; methods of one group share their scales."""
NAMES = tuple(name for group in METHODS for name in group)
OURS = tuple(name for name in NAMES if name.endswith((TANGENT, FLOW)))


def _geometric(x: Tensor, y: Tensor) -> Predict:
    arm, theta = ExtendedArm(geometry=True), geometric_fit(x, y)
    return lambda at: arm(extended(at), theta)


def _corrected(
    x: Tensor,
    y: Tensor,
    seed: int,
    fit: Callable[[np.ndarray, np.ndarray, dict[str, Any]], Callable[[np.ndarray], np.ndarray]],
    grid: list[dict[str, Any]],
    *,
    final: dict[str, Any] | None = None,
) -> Predict:
    """The geometric fit plus a learner on its residual, with the best settings of a grid."""
    rigid = _geometric(x, y)
    inputs, targets = _features(x), (y - rigid(x)).numpy()
    folds = np.array_split(np.random.default_rng(seed).permutation(len(x)), min(FOLDS, len(x)))
    best = min(grid, key=lambda options: _fold_error(fit, inputs, targets, folds, options))
    learned = fit(inputs, targets, best | (final or {}))
    return lambda at: rigid(at) + torch.from_numpy(learned(_features(at)))


def _fold_error(
    fit: Callable[..., Callable[[np.ndarray], np.ndarray]],
    inputs: np.ndarray,
    targets: np.ndarray,
    folds: list[np.ndarray],
    options: dict[str, Any],
) -> float:
    """Sum of squared errors across folds; infinite if a fold cannot be fitted with these settings."""
    total = 0.0
    for fold in folds:
        rest = np.setdiff1d(np.arange(len(inputs)), fold)
        try:
            total += float(np.square(fit(inputs[rest], targets[rest], options)(inputs[fold]) - targets[fold]).sum())
        except (np.linalg.LinAlgError, ValueError):  # a singular system, or fewer data than the polynomial needs
            return float("inf")
    return total if np.isfinite(total) else float("inf")


def _features(x: Tensor) -> np.ndarray:
    """Cos and sin of the joint angles: (N, 4)."""
    return torch.cat([x.cos(), x.sin()], 1).numpy()
