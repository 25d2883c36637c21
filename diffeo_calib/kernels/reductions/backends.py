"""The one door to kernel sums: chooses a backend and runs a formula on it.

dense   the materialised (M, N) matrix; fastest when it is small
tiled   the same on tiles that fit the cache; memory O(M + N)
keops   fused and compiled (pykeops); fastest for many points and on a GPU; memory O(M + N)
auto    one of them, by the number of pairs and the device
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions import keops
from diffeo_calib.kernels.reductions.dense import Dense
from diffeo_calib.kernels.reductions.formulas import Formula, Points
from diffeo_calib.kernels.reductions.pairs import MatrixPairs
from diffeo_calib.kernels.reductions.tiled import Tiled

Backend = Literal["auto", "dense", "tiled", "keops"]

DENSE, TILED, KEOPS = Dense(), Tiled(), keops.Keops()
DENSE_PAIRS = {"cpu": 1 << 14, "cuda": 1 << 22}
"""Most pairs for which `auto` materialises the matrix."""
KEOPS_PAIRS = {"cpu": 1 << 26, "cuda": 1 << 22}
"""Fewest pairs for which `auto` takes KeOps: on a CPU its compilation must pay off."""


def check_backend(name: str) -> Backend:
    """Raise InputError unless ``name`` is a backend."""
    if name not in get_args(Backend):
        raise InputError(sentence("`backend`", expected=", ".join(get_args(Backend)), got=repr(name)))
    return name  # pyright: ignore[reportReturnType]


def choose(backend: Backend, rows: int, columns: int, device: torch.device) -> Backend:
    """What runs a sum of this size: ``backend`` itself, or the choice of `auto`.

    KeOps falls back to tiled, with one warning, where it cannot run.
    """
    pairs, kind = rows * columns, "cpu" if device.type == "cpu" else "cuda"
    if backend == "auto":
        backend = "tiled" if pairs > DENSE_PAIRS[kind] else "dense"
        if pairs >= KEOPS_PAIRS[kind] and KEOPS.usable():
            backend = "keops"
    return "tiled" if backend == "keops" and not KEOPS.usable() else backend


def run(
    formula: Formula, profile: Profile, rows: Points, columns: Points, backend: Backend = "auto"
) -> tuple[Tensor, ...]:
    """Evaluate a formula for all rows.

    Args:
        formula: one of formulas.py.
        profile: the radial profile kappa.
        rows: the M points where sums are evaluated.
        columns: the N points that are summed over; the same object as ``rows`` for a sum over all pairs.
        backend: how. Where inputs are being differentiated, KeOps leaves it to the tiled sums.

    Returns:
        the formula's tensors, each with M rows.
    """
    rows, columns = _centred(rows, columns)
    m, n = len(rows.features), len(columns.features)
    choice = choose(backend, m, n, rows.features.device)
    if m == 0 or n == 0:
        choice = "dense"
    if choice == "keops" and torch.is_grad_enabled() and any(t.requires_grad for t in rows.tensors + columns.tensors):
        choice = "tiled"
    if choice == "keops":
        try:
            return formula.finish(KEOPS.reduce(formula, profile, rows, columns), rows)
        except keops.KeopsUnavailableError as error:
            keops.warn(error)
            choice = "tiled"
    method = DENSE if choice == "dense" else TILED
    return formula.finish(method.reduce(formula, profile, rows, columns), rows)


def profile_matrix(profile: Profile, rows: Tensor, columns: Tensor) -> Tensor:
    """kappa_ij, materialised, for features (M, D) and (N, D): (M, N); differentiable by autograd."""
    i, j = _centred(Points(rows), Points(columns))
    return profile.derivatives(MatrixPairs().squared_distance(i.features, j.features), 0)[0]


def _centred(rows: Points, columns: Points) -> tuple[Points, Points]:
    """Shift all features by the columns' mean: every formula depends on differences only."""
    if len(columns.features) == 0:
        return rows, columns
    centre = columns.features.detach().mean(0)
    shifted = columns._replace(features=columns.features - centre)
    return shifted if rows is columns else rows._replace(features=rows.features - centre), shifted
