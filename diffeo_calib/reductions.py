"""The one door to kernel sums.

A formula is written once, on *pairwise symbols*: scalars w_ij for every pair (row point i, column
point j), made from squared distances and dot products, and reduced as sum_j w_ij b_j. A backend
decides what a symbol is:

    dense   the materialised (M, N) matrix; fastest when it fits the cache
    tiled   the same on blocks of rows: memory O(N) instead of O(M N)

Nobody outside this module knows which one runs. A further backend (symbolic lazy matrices) is one
more subclass of :class:`Pairs`.

Distances use the expansion |E_i|^2 + |F_j|^2 - 2 E_i . F_j, i.e. one matrix product, on features
shifted to a common centre so that no digits are lost far from the origin.

Symbols: E, F features of row and column points, (M, D) and (N, D); u (N, r) reduced momenta of the
column points (and of the row points, where a formula is about the points themselves).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.profiles import Profile

BLOCK_ELEMENTS = 1 << 22
"""Largest number of pairs that `auto` materialises at once (32 MiB in float64)."""


class Points(NamedTuple):
    """Points on one side of a kernel sum: features, reduced momenta, and directions of both."""

    features: Any
    momenta: Any = None
    d_features: Any = None
    d_momenta: Any = None

    def take(self, rows: slice) -> Points:
        """The points of some rows."""
        return Points(*(None if t is None else t[rows] for t in self))


class DensePairs:
    """Pairwise symbols as materialised (M, N) tensors."""

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """a_i . b_j: (M, k), (N, k) -> (M, N)."""
        return a @ b.T

    def squared_distance(self, e: Tensor, f: Tensor) -> Tensor:
        """|e_i - f_j|^2: (M, D), (N, D) -> (M, N)."""
        squares = (e * e).sum(-1)[:, None] + (f * f).sum(-1)[None, :]
        return torch.addmm(squares, e, f.T, alpha=-2.0).relu()

    def difference_dot(self, e: Tensor, de: Tensor, f: Tensor, df: Tensor) -> Tensor:
        """(e_i - f_j) . (de_i - df_j): the half derivative of the squared distance, (M, N)."""
        squares = (e * de).sum(-1)[:, None] + (f * df).sum(-1)[None, :]
        return squares - torch.cat([e, de], -1) @ torch.cat([df, f], -1).T

    def sums(self, *terms: tuple[Tensor, Tensor]) -> list[Tensor]:
        """[sum_j w_ij b_j for (w, b) in terms]: (M, N), (N, k) -> (M, k) each."""
        return [w @ b for w, b in terms]


Formula = Callable[[DensePairs, Profile, Points, Points], tuple[Tensor, ...]]


def run(formula: Formula, profile: Profile, rows: Points, columns: Points) -> tuple[Tensor, ...]:
    """Evaluate a formula for all rows, on blocks of rows when the pair matrix would be large.

    Args:
        formula: one of the functions below.
        profile: the radial profile kappa.
        rows: the M points where sums are evaluated.
        columns: the N points that are summed over.

    Returns:
        the formula's tensors, each with M rows.
    """
    rows, columns = _centred(rows, columns)
    m, n = len(rows.features), len(columns.features)
    block = max(1, BLOCK_ELEMENTS // max(n, 1))
    if m <= block:
        return formula(DensePairs(), profile, rows, columns)
    parts = [formula(DensePairs(), profile, rows.take(slice(i, i + block)), columns) for i in range(0, m, block)]
    return tuple(torch.cat(column) for column in zip(*parts, strict=True))


def _centred(rows: Points, columns: Points) -> tuple[Points, Points]:
    """Shift all features by the columns' mean: every formula depends on differences only."""
    if len(columns.features) == 0:
        return rows, columns
    centre = columns.features.detach().mean(0)
    return rows._replace(features=rows.features - centre), columns._replace(features=columns.features - centre)


def profile_matrix(pairs: Any, profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    """kappa_ij, materialised: (M, N)."""
    return (profile.derivatives(pairs.squared_distance(i.features, j.features), 0)[0],)


def field(pairs: Any, profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    """V_i = sum_j kappa_ij u_j: (M, r)."""
    (kappa,) = profile.derivatives(pairs.squared_distance(i.features, j.features), 0)
    return tuple(pairs.sums((kappa, j.momenta)))


def field_and_jacobian(pairs: Any, profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    """V (M, r) and its feature Jacobian sum_j 2 kappa'_ij u_j (E_i - F_j)^T (M, r, D)."""
    kappa, kappa1 = profile.derivatives(pairs.squared_distance(i.features, j.features), 1)
    outer = (j.momenta[:, :, None] * j.features[:, None, :]).flatten(1)  # (N, r D)
    v, slope, moment = pairs.sums((kappa, j.momenta), (kappa1, j.momenta), (kappa1, outer))
    moment = moment.unflatten(1, (slope.shape[-1], j.features.shape[-1]))  # (M, r D) -> (M, r, D)
    return v, 2.0 * (slope[:, :, None] * i.features[:, None, :] - moment)


def gradient(pairs: Any, profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    """Gradient of H = 1/2 sum_ij kappa_ij u_i . u_j in (u, F): V (M, r) and (M, D).

    The second is sum_j 2 kappa'_ij (u_i . u_j) (F_i - F_j).
    """
    kappa, kappa1 = profile.derivatives(pairs.squared_distance(i.features, j.features), 1)
    weight = kappa1 * pairs.dot(i.momenta, j.momenta) * 2.0
    v, weighted, total = pairs.sums((kappa, j.momenta), (weight, j.features), (weight, _ones(j.features)))
    return v, i.features * total - weighted


def hessian_product(pairs: Any, profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    """Derivative of :func:`gradient` along (d_momenta, d_features), and its feature part itself.

    Returns dV (M, r), dG (M, D), G (M, D). With rho = d r2 = 2 (F_i - F_j) . (dF_i - dF_j), s = u_i . u_j and
    ds = du_i . u_j + u_i . du_j:

        dV_i = sum_j kappa' rho u_j + kappa du_j
        dG_i = sum_j 2 (kappa'' rho s + kappa' ds) (F_i - F_j) + 2 kappa' s (dF_i - dF_j)
    """
    kappa, kappa1, kappa2 = profile.derivatives(pairs.squared_distance(i.features, j.features), 2)
    rho = pairs.difference_dot(i.features, i.d_features, j.features, j.d_features) * 2.0
    s = pairs.dot(i.momenta, j.momenta)
    ds = pairs.dot(torch.cat([i.d_momenta, i.momenta], -1), torch.cat([j.momenta, j.d_momenta], -1))
    weight = kappa1 * s * 2.0
    d_weight = (kappa2 * rho * s + kappa1 * ds) * 2.0
    ones = _ones(j.features)
    dv, dv2, moment, d_moment, total, d_total = pairs.sums(
        (kappa1 * rho, j.momenta),
        (kappa, j.d_momenta),
        (weight, torch.cat([j.features, j.d_features], -1)),
        (d_weight, j.features),
        (weight, ones),
        (d_weight, ones),
    )
    weighted, d_weighted = moment.chunk(2, dim=-1)
    dg = i.features * d_total - d_moment + i.d_features * total - d_weighted
    return dv + dv2, dg, i.features * total - weighted


def _ones(like: Tensor) -> Tensor:
    return torch.ones(len(like), 1, dtype=like.dtype, device=like.device)
