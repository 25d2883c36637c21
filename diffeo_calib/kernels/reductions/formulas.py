"""The kernel sums that the package needs, each written once on pairwise symbols.

Every formula has the form  sum_j w_ij b_j:

    weights   pairwise scalars w_ij, computed from squared distances and dot products by exp, sqrt and
              arithmetic, so that the same lines run on matrices and on symbolic (lazy) ones
    summands  vectors b_j of the column points, one tensor per weight
    finish    the results, computed from the sums and the row points

Where rows and columns are the same points, all weights are symmetric, w_ij = w_ji, and a backend may
visit each pair once.

Symbols: E, F features of row and column points, (M, D) and (N, D); u (N, r) reduced momenta of the
column points (and of the row points, where a formula needs them).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.kernels.profiles import Profile


class Points(NamedTuple):
    """Points on one side of a kernel sum: features, reduced momenta, and directions of both."""

    features: Any
    momenta: Any = None
    d_features: Any = None
    d_momenta: Any = None

    def rows(self, rows: slice) -> Points:
        """The points of some rows."""
        return Points(*(None if t is None else t[rows] for t in self))

    @property
    def tensors(self) -> list[Tensor]:
        """The fields that are not None."""
        return [t for t in self if t is not None]


class Formula(ABC):
    """A kernel sum; see the module's docstring."""

    @abstractmethod
    def weights(self, pairs: Any, profile: Profile, i: Points, j: Points) -> list[Any]:
        """The pairwise scalars w_ij, computed by ``pairs`` as matrices or as lazy symbols."""

    @abstractmethod
    def summands(self, j: Points) -> list[Tensor]:
        """b_j for every weight: (N, k) each."""

    @abstractmethod
    def finish(self, sums: list[Tensor], i: Points) -> tuple[Tensor, ...]:
        """The results, from the sums (M, k) over all columns."""


class Field(Formula):
    """V_i = sum_j kappa_ij u_j: (M, r)."""

    def weights(self, pairs: Any, profile: Profile, i: Points, j: Points) -> list[Any]:
        """kappa."""
        return profile.derivatives(pairs.squared_distance(i.features, j.features), 0)

    def summands(self, j: Points) -> list[Tensor]:
        """u."""
        return [j.momenta]

    def finish(self, sums: list[Tensor], i: Points) -> tuple[Tensor, ...]:
        """V."""
        return tuple(sums)


class FieldAndJacobian(Formula):
    """V (M, r) and its feature Jacobian sum_j 2 kappa'_ij u_j (E_i - F_j)^T (M, r, D)."""

    def weights(self, pairs: Any, profile: Profile, i: Points, j: Points) -> list[Any]:
        """kappa, kappa'."""
        return profile.derivatives(pairs.squared_distance(i.features, j.features), 1)

    def summands(self, j: Points) -> list[Tensor]:
        """u; u and u F^T."""
        outer = (j.momenta[:, :, None] * j.features[:, None, :]).flatten(1)  # (N, r D)
        return [j.momenta, torch.cat([j.momenta, outer], -1)]

    def finish(self, sums: list[Tensor], i: Points) -> tuple[Tensor, ...]:
        """V and 2 (sum kappa' u) E_i^T - 2 sum kappa' u F^T."""
        v, both = sums
        r = v.shape[-1]
        slope, moment = both[:, :r], both[:, r:].unflatten(1, (r, i.features.shape[-1]))  # (M, r D) -> (M, r, D)
        return v, 2.0 * (slope[:, :, None] * i.features[:, None, :] - moment)


class Gradient(Formula):
    """Gradient of H = sum_ij kappa_ij u_i . u_j in the row points' (u, E): V (M, r) and (M, D).

    The second result is sum_j 2 kappa'_ij (u_i . u_j) (E_i - F_j). Where rows and columns are the same points,
    both are gradients of H / 2.
    """

    def weights(self, pairs: Any, profile: Profile, i: Points, j: Points) -> list[Any]:
        """kappa, kappa' s with s = u_i . u_j."""
        kappa, kappa1 = profile.derivatives(pairs.squared_distance(i.features, j.features), 1)
        return [kappa, kappa1 * pairs.dot(i.momenta, j.momenta)]

    def summands(self, j: Points) -> list[Tensor]:
        """u; F and 1."""
        return [j.momenta, torch.cat([j.features, _ones(j.features)], -1)]

    def finish(self, sums: list[Tensor], i: Points) -> tuple[Tensor, ...]:
        """V and 2 E_i sum kappa' s - 2 sum kappa' s F."""
        v, weighted = sums
        return v, 2.0 * (i.features * weighted[:, -1:] - weighted[:, :-1])


class HessianProduct(Formula):
    """Derivative of :class:`Gradient` along (d_momenta, d_features), and the gradient in the features.

    Results: dV (M, r), dG (M, D), G (M, D). With rho = d r2 = 2 (F_i - F_j) . (dF_i - dF_j), s = u_i . u_j and
    ds = du_i . u_j + u_i . du_j:

        dV_i = sum_j kappa' rho u_j + kappa du_j
        dG_i = sum_j 2 (kappa'' rho s + kappa' ds) (F_i - F_j) + 2 kappa' s (dF_i - dF_j)
    """

    def weights(self, pairs: Any, profile: Profile, i: Points, j: Points) -> list[Any]:
        """kappa, kappa' rho, kappa' s, kappa'' rho s + kappa' ds."""
        kappa, kappa1, kappa2 = profile.derivatives(pairs.squared_distance(i.features, j.features), 2)
        rho = pairs.squared_distance_change(i.features, i.d_features, j.features, j.d_features)
        s = pairs.dot(i.momenta, j.momenta)
        ds = pairs.dot(torch.cat([i.d_momenta, i.momenta], -1), torch.cat([j.momenta, j.d_momenta], -1))
        return [kappa, kappa1 * rho, kappa1 * s, kappa2 * rho * s + kappa1 * ds]

    def summands(self, j: Points) -> list[Tensor]:
        """du; u; F, dF and 1; F and 1."""
        ones = _ones(j.features)
        moments = torch.cat([j.features, j.d_features, ones], -1)
        return [j.d_momenta, j.momenta, moments, torch.cat([j.features, ones], -1)]

    def finish(self, sums: list[Tensor], i: Points) -> tuple[Tensor, ...]:
        """dV, dG, G."""
        dv, dv2, moments, d_moments = sums
        d = i.features.shape[-1]
        weighted, d_weighted, total = moments[:, :d], moments[:, d:-1], moments[:, -1:]
        dg = i.features * d_moments[:, -1:] - d_moments[:, :-1] + i.d_features * total - d_weighted
        return dv + dv2, 2.0 * dg, 2.0 * (i.features * total - weighted)


FIELD, FIELD_AND_JACOBIAN, GRADIENT, HESSIAN_PRODUCT = Field(), FieldAndJacobian(), Gradient(), HessianProduct()


def _ones(like: Tensor) -> Tensor:
    return torch.ones(len(like), 1, dtype=like.dtype, device=like.device)


class MatrixPairs:
    """Pairwise symbols as materialised (M, N) tensors, differentiable by autograd."""

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """a_i . b_j: (M, k), (N, k) -> (M, N)."""
        return a @ b.T

    def squared_distance(self, e: Tensor, f: Tensor) -> Tensor:
        """|e_i - f_j|^2 up to rounding, possibly -1e-16: (M, D), (N, D) -> (M, N)."""
        return self.dot(*distance_factors(e, f))

    def squared_distance_change(self, e: Tensor, de: Tensor, f: Tensor, df: Tensor) -> Tensor:
        """2 (e_i - f_j) . (de_i - df_j), the derivative of the squared distance: (M, N)."""
        return self.dot(*distance_change_factors(e, de, f, df))


def distance_factors(e: Tensor, f: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors (M, D + 2), (N, D + 2) whose dot products are |e_i - f_j|^2."""
    e2, f2 = _dots(e, e), _dots(f, f)
    return torch.cat([-2.0 * e, e2, torch.ones_like(e2)], -1), torch.cat([f, torch.ones_like(f2), f2], -1)


def distance_change_factors(e: Tensor, de: Tensor, f: Tensor, df: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors (M, 2 D + 2), (N, 2 D + 2) whose dot products are 2 (e_i - f_j) . (de_i - df_j)."""
    ee, ff = 2.0 * _dots(e, de), 2.0 * _dots(f, df)
    left = torch.cat([-2.0 * e, -2.0 * de, ee, torch.ones_like(ee)], -1)
    return left, torch.cat([df, f, torch.ones_like(ff), ff], -1)


def _dots(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def weighted_sums(weights: list[Tensor], summands: list[Tensor]) -> list[Tensor]:
    """[sum_j w_ij b_j], transposed: weights (M, N) and summands (k, N) -> (k, M) each.

    On a CPU the product of a large matrix with a few columns is 2 to 3 times faster in this orientation.
    """
    return [b @ w.T for w, b in zip(weights, summands, strict=True)]


class Dense:
    """Evaluates all pairs at once."""

    differentiable: ClassVar[bool] = True

    def usable(self) -> bool:
        """Always."""
        return True

    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> list[Tensor]:
        """The sums of a formula, (M, k) each; rows None for the columns themselves."""
        weights = formula.weights(MatrixPairs(), profile, columns if rows is None else rows, columns)
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        return [s.T for s in weighted_sums(weights, summands)]
