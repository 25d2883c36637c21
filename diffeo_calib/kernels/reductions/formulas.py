"""The kernel sums that the package needs, each written once on the scalars of a pair of points.

Every result of a formula is a sum of terms  sum_j w_ij b_j  or  sum_j w_ij b_j (e_i - e_j)^T:

    weights   pairwise scalars w_ij, computed from squared distances and dot products by exp, sqrt and
              arithmetic, so that the same lines run on matrices and on symbols
    terms     which vectors b and differences of which vectors e they multiply

All weights are symmetric in the points: where rows and columns are the same points, w_ij = w_ji, and a backend may
visit each pair once. Backends that multiply matrices expand the differences, by :meth:`Formula.summands` and
:meth:`Formula.finish`.

Symbols: E, F features of row and column points, (M, D) and (N, D); u (N, r) reduced momenta of the
column points (and of the row points, where a formula needs them).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, reduce
from itertools import chain
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.kernels.profiles import Profile

Leaf = Callable[[str], Any]  # one of the :data:`LEAVES` by its name, as a matrix or a symbol
Summand = tuple[str | None, str | None]
"""A field b of :class:`Points`, or None for 1, and one that it is multiplied by, e."""


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


class Term(NamedTuple):
    """factor sum_j w_ij b_j (M, k), or factor sum_j w_ij b_j (e_i - e_j)^T (M, k, D); (M, D) without b."""

    weight: int  # the number of the weight w
    vector: str | None = None  # the field of :class:`Points` that b is
    apart: str | None = None  # the field of :class:`Points` that e is
    factor: float = 1.0  # a number


@dataclass(frozen=True, eq=False)
class Formula:
    """Kernel sums; see the module's docstring."""

    name: str  # for messages
    weigh: Callable[[Leaf, Profile], list[Any]]  # the pairwise scalars w_ij from those of :data:`LEAVES` and a profile
    results: tuple[tuple[Term, ...], ...]  # the terms that every result is the sum of
    reads: tuple[str, ...] = ("features", "momenta")  # the fields of :class:`Points` that it needs of the columns
    _expanded: list[list[Summand]] = field(init=False)  # the summands of every weight, without repetitions

    def __post_init__(self) -> None:
        parts: dict[int, dict[Summand, None]] = {}
        for term in chain.from_iterable(self.results):
            keys = [(term.vector, term.apart)] if term.apart else []
            parts.setdefault(term.weight, {}).update(dict.fromkeys([*keys, (term.vector, None)]))
        object.__setattr__(self, "_expanded", [list(parts[weight]) for weight in sorted(parts)])

    def summands(self, j: Points) -> list[Tensor]:
        """Factors of every weight: (N, k) each, the vectors b_j and products b_j e_j^T of all its terms."""
        return [torch.cat([_summand(j, *key) for key in keys], -1) for keys in self._expanded]

    def finish(self, sums: list[Tensor], i: Points) -> tuple[Tensor, ...]:
        """The results, from the sums (M, k) over all columns."""
        dim = i.features.shape[-1]
        parts = [_split(s, keys, dim) for s, keys in zip(sums, self._expanded, strict=True)]
        return tuple(reduce(torch.add, [_finished(t, parts[t.weight], i) for t in terms]) for terms in self.results)


def _summand(j: Points, vector: str | None, apart: str | None) -> Tensor:
    """b_j or b_j e_j^T, flat: (N, k)."""
    b = torch.ones_like(j.features[:, :1]) if vector is None else getattr(j, vector)
    return b if apart is None else (b[:, :, None] * getattr(j, apart)[:, None, :]).flatten(1)


def _split(total: Tensor, keys: list[Summand], dim: int) -> dict[Summand, Tensor]:
    """The sums of every summand."""
    sizes = [dim if apart else 1 for _, apart in keys]
    open_ = sum(size for size, (vector, _) in zip(sizes, keys, strict=True) if vector)
    width = (total.shape[1] - sum(sizes) + open_) // max(open_, 1)  # of the vectors b
    widths = [size * width if vector else size for size, (vector, _) in zip(sizes, keys, strict=True)]
    return dict(zip(keys, total.split(widths, 1), strict=True))


def _finished(term: Term, parts: dict[Summand, Tensor], i: Points) -> Tensor:
    """A term from its sums: w b, or e_i w b - w b e_j."""
    total = parts[term.vector, None]
    if term.apart is not None:
        moment, e = parts[term.vector, term.apart], getattr(i, term.apart)
        if term.vector is not None:
            moment, total, e = moment.unflatten(1, (-1, e.shape[1])), total[:, :, None], e[:, None]
        total = e * total - moment
    return total if term.factor == 1.0 else term.factor * total


def _gradient(leaf: Leaf, profile: Profile) -> list[Any]:
    kappa, kappa1 = profile.derivatives(leaf("r2"), 1)
    return [kappa, kappa1 * leaf("s")]


def _hessian_product(leaf: Leaf, profile: Profile) -> list[Any]:
    kappa, kappa1, kappa2 = profile.derivatives(leaf("r2"), 2)
    rho, s, ds = leaf("rho"), leaf("s"), leaf("ds")
    return [kappa, kappa1 * rho, kappa1 * s, kappa2 * rho * s + kappa1 * ds]


FIELD = Formula("field", lambda leaf, profile: profile.derivatives(leaf("r2"), 0), ((Term(0, "momenta"),),))
"""V_i = sum_j kappa_ij u_j: (M, r)."""
FIELD_AND_JACOBIAN = Formula(
    "field and Jacobian",
    lambda leaf, profile: profile.derivatives(leaf("r2"), 1),
    ((Term(0, "momenta"),), (Term(1, "momenta", "features", 2.0),)),
)
"""V (M, r) and its feature Jacobian sum_j 2 kappa'_ij u_j (E_i - F_j)^T (M, r, D)."""
GRADIENT = Formula("gradient", _gradient, ((Term(0, "momenta"),), (Term(1, None, "features", 2.0),)))
"""Gradient of H = sum_ij kappa_ij u_i . u_j in the row points' (u, E): V (M, r) and (M, D).

The second result is sum_j 2 kappa'_ij (u_i . u_j) (E_i - F_j). Where rows and columns are the same points, both are
gradients of H / 2."""
HESSIAN_PRODUCT = Formula(
    "Hessian product",
    _hessian_product,
    (
        (Term(0, "d_momenta"), Term(1, "momenta")),
        (Term(3, None, "features", 2.0), Term(2, None, "d_features", 2.0)),
        (Term(2, None, "features", 2.0),),
    ),
    Points._fields,
)
"""Derivative of :data:`GRADIENT` along (d_momenta, d_features), and the gradient in the features.

Results: dV (M, r), dG (M, D), G (M, D). With rho = d r2 = 2 (F_i - F_j) . (dF_i - dF_j), s = u_i . u_j and
ds = du_i . u_j + u_i . du_j:

    dV_i = sum_j kappa' rho u_j + kappa du_j
    dG_i = sum_j 2 (kappa'' rho s + kappa' ds) (F_i - F_j) + 2 kappa' s (dF_i - dF_j)
    G_i  = sum_j 2 kappa' s (F_i - F_j)
"""
LEAVES = ("r2", "rho", "s", "ds")
"""Scalars of a pair of points that weights are made of: |E_i - F_j|^2, 2 (E_i - F_j) . (dE_i - dF_j), u_i . u_j and
du_i . u_j + u_i . du_j."""


def factors(leaf: str, i: Points, j: Points) -> tuple[Tensor, Tensor]:
    """Vectors (M, k) and (N, k) whose dot products are one of the :data:`LEAVES`, differences up to rounding."""
    if leaf == "s":
        return i.momenta, j.momenta
    if leaf == "ds":
        return torch.cat([i.d_momenta, i.momenta], -1), torch.cat([j.momenta, j.d_momenta], -1)
    (e, de), (f, df) = (i.features, i.d_features), (j.features, j.d_features)
    if leaf == "r2":
        left, right, e2, f2 = [-2.0 * e], [f], _dots(e, e), _dots(f, f)
    else:
        left, right, e2, f2 = [-2.0 * e, -2.0 * de], [df, f], 2.0 * _dots(e, de), 2.0 * _dots(f, df)
    one_i, one_j = torch.ones_like(e2), torch.ones_like(f2)
    return torch.cat([*left, e2, one_i], -1), torch.cat([*right, one_j, f2], -1)


def _dots(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def matrices(i: Points, j: Points) -> Callable[[str], Tensor]:
    """The leaves as materialised (M, N) tensors, differentiable by autograd."""

    def leaf(name: str) -> Tensor:
        left, right = factors(name, i, j)
        return left @ right.T

    return leaf


def weighted_sums(weights: Sequence[Tensor], summands: list[Tensor]) -> list[Tensor]:
    """[sum_j w_ij b_j], transposed: weights (M, N) and summands (k, N) -> (k, M) each.

    On a CPU the product of a large matrix with a few columns is 2 to 3 times faster in this orientation.
    """
    return [b @ w.T for w, b in zip(weights, summands, strict=True)]


class SumBackend:
    """How kernel sums are evaluated.

    Attributes:
        differentiable: whether autograd can differentiate the sums. Tiled sums replace a backend that cannot where
            gradients are needed.
        failure: why it failed once, as a sentence; it is not tried again then.
    """

    differentiable: ClassVar[bool] = False
    failure = ""

    def trouble(self) -> str:
        """Why it cannot evaluate sums on this machine, as a sentence; empty where it can."""
        return self.failure

    def usable(self) -> bool:
        """Whether the backend is expected to work on this machine; warns once if not."""
        if trouble := self.trouble():
            _warn(trouble)
        return not trouble

    def failed(self, failure: str) -> None:
        """Note a failure, and warn that tiled sums replace this backend from now on."""
        self.failure = failure
        _warn(failure)

    def reduce(
        self, formula: Formula, profile: Profile, rows: Points | None, columns: Points
    ) -> tuple[Tensor, ...] | None:
        """The results of a formula, M rows each; None where the backend cannot evaluate it: tiled sums replace it.

        Args:
            profile: the radial profile kappa.
            rows: the M points at which sums are evaluated; None for the columns themselves, where the weights are
                symmetric.
            columns: the N points of the sum.
        """
        raise NotImplementedError


@cache
def _warn(reason: str) -> None:
    """Warn, once per reason, that the fallback runs."""
    text = f"{reason} Kernel sums run in torch instead (backend 'tiled'): slower, the same numbers."
    warnings.warn(text, DiffeoCalibWarning, stacklevel=2)  # not warn_user: models do not record it


class Dense(SumBackend):
    """Evaluates all pairs at once."""

    differentiable = True

    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
        at = columns if rows is None else rows
        weights = formula.weigh(matrices(at, columns), profile)
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        return formula.finish([s.T for s in weighted_sums(weights, summands)], at)
