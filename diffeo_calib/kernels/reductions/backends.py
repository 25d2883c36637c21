"""Dispatch of kernel sums: choose a backend and evaluate a formula on it.

name         how it sums                                            memory     when
dense        one matrix of all pairs                                O(M N)     few points
fused        one loop compiled for the processor (extra `fused`)    O(M + N)   fastest on a CPU
tiled        matrices on tiles that fit the cache, in plain torch   O(M + N)   works everywhere
keops        LazyTensors, compiled by KeOps (needs a compiler)      O(M + N)   fastest on a GPU, for many points
distributed  tiles shared by the processes of one torchrun program  O(M + N)   several processes
auto         dense, fused, tiled or keops, by the number of pairs, the device and what is installed

With an accuracy, large sums go by plane waves (fourier.py) where these take less time, whatever the backend.

To add a backend, write a class with the methods of :class:`SumBackend` and enter it in :data:`BACKENDS`.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from diffeo_calib.common.checks import number_of, wrapped
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions import fourier
from diffeo_calib.kernels.reductions.distributed import Distributed
from diffeo_calib.kernels.reductions.formulas import Dense, Formula, Points, SumBackend, matrices
from diffeo_calib.kernels.reductions.fused import FUSED
from diffeo_calib.kernels.reductions.keops import Keops
from diffeo_calib.kernels.reductions.tiled import Tiled

Backend = Literal["auto", "dense", "fused", "tiled", "keops", "distributed"]


BACKENDS: dict[str, SumBackend] = {
    "dense": Dense(),
    "fused": FUSED,
    "tiled": Tiled(),
    "keops": Keops(),
    "distributed": Distributed(),
}
FINEST_ACCURACY = 1e-12  # below it rounding counts
FALLBACK = "tiled"  # the backend that works everywhere, for any number of points
FUSED_PAIRS = 1 << 8  # smallest number of pairs for which `auto` uses compiled loops
DENSE_PAIRS = {"cpu": 1 << 14, "cuda": 1 << 22}  # largest number of pairs for which `auto` materialises the matrix
KEOPS_PAIRS = 1 << 22
"""Smallest number of pairs for which `auto` uses KeOps on a GPU. On a CPU tiled sums, which visit each pair once, take
less time at every size."""


def check_backend(name: str) -> Backend:
    """Return ``name`` if it is a backend, else raise InputError."""
    if name not in get_args(Backend):
        raise InputError.of("`backend`", expected=", ".join(get_args(Backend)), got=as_written(name))
    return name  # pyright: ignore[reportReturnType]


def check_accuracy(accuracy: float | None) -> float | None:
    """Return ``accuracy`` if it can be that of a sum, else raise InputError."""
    number = number_of(accuracy)
    if accuracy is not None and (number is None or not FINEST_ACCURACY <= number < 1.0):
        fix = "leave it out for sums over all pairs"
        expected = f"a number between {FINEST_ACCURACY:g} and 1"
        raise InputError.of("`accuracy`", expected=expected, got=as_written(accuracy), fix=fix)
    return accuracy


def choose(backend: Backend, rows: int, columns: int, device: torch.device) -> str:
    """The backend of a sum of this size: ``backend`` itself, or the choice of `auto`.

    Tiled sums replace a backend that is not usable, with one warning.
    """
    pairs, on_cpu = rows * columns, device.type == "cpu"
    name: str = backend
    if backend == "auto":
        name = "dense" if pairs <= DENSE_PAIRS["cpu" if on_cpu else "cuda"] else "tiled"
        if on_cpu and pairs >= FUSED_PAIRS and not FUSED.trouble():
            name = "fused"
        elif not on_cpu and pairs >= KEOPS_PAIRS and BACKENDS["keops"].usable():
            name = "keops"
    return name if BACKENDS[name].usable() else FALLBACK


def evaluate(
    formula: Formula,
    profile: Profile,
    rows: Points | None,
    columns: Points,
    backend: Backend = "auto",
    *,
    accuracy: float | None = None,
) -> tuple[Tensor, ...]:
    """The results of a formula, M rows each: arguments as of :meth:`SumBackend.reduce`.

    Args:
        backend: where to evaluate it. Tiled sums replace one that autograd cannot differentiate if an input requires
            gradients.
        accuracy: error that sums may have where this saves time; None for sums over all pairs.
    """
    at = columns if rows is None else rows
    tensors = at.tensors + columns.tensors
    if wrapped(*tensors) or profile.followed or len(at.features) == 0 or len(columns.features) == 0:
        name = "dense"  # plain operations without a choice by size: torch.func, torch.compile and torch.export need it
    else:
        name = choose(backend, len(at.features), len(columns.features), at.features.device)
    followed = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    if followed and not BACKENDS[name].differentiable:
        name = FALLBACK
    # Loops compute differences of points, which need no centre.
    i, j = (rows, columns) if name == "fused" and accuracy is None else _centred(rows, columns)
    if accuracy is not None and name != "dense" and not followed:
        finite = (at.features.sum() + columns.features.sum()).isfinite()  # a flow that diverges has no extent
        sums = fourier.sums(formula, profile, i, j, accuracy) if bool(finite) else None
        if sums is not None:
            return sums
    return BACKENDS[name].reduce(formula, profile, i, j) or Tiled().reduce(formula, profile, *_centred(i, j))


def profile_matrix(profile: Profile, rows: Tensor, columns: Tensor) -> Tensor:
    """The matrix kappa_ij of features (M, D) and (N, D): (M, N), differentiable by autograd."""
    i, j = _centred(Points(rows), Points(columns))
    return profile.derivatives(matrices(j if i is None else i, j)("r2"), 0)[0]


def _centred(rows: Points | None, columns: Points) -> tuple[Points | None, Points]:
    """Shift all features by the columns' mean, since formulas depend on differences only."""
    if len(columns.features) == 0:
        return rows, columns
    centre = columns.features.detach().mean(0)
    shifted = columns._replace(features=columns.features - centre)
    return None if rows is None else rows._replace(features=rows.features - centre), shifted
