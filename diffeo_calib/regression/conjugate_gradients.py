"""Conditioning without the matrix: conjugate gradients on kernel sums, memory O(N m rank).

The product with G is a few kernel sums (linearisation.py). The preconditioner is F F^T + R with F from a
randomly pivoted partial Cholesky factorisation of G (Chen, Epperly, Tropp, Webber, "Randomly pivoted
Cholesky", 2023): blocks of configurations are drawn with probabilities proportional to their unexplained
variance. Smooth kernels have few directions above the noise, so F captures nearly all of G that matters,
and few iterations are needed.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import NOISE_ADVICE, DataConditional, Features, of_parameters

BLOCK_CONFIGURATIONS = 64  # number of configurations that are drawn together
NEGLIGIBLE_VARIANCE_RATIO = 0.03
"""Mean unexplained variance, relative to the noise's, at which the factor is accurate enough."""
ROUNDING_EIGENVALUE_RATIO = 1e-11  # eigenvalues of a block below this fraction of the largest one are rounding errors
MAX_RANK = 3000  # largest rank of the preconditioner
MAX_EXACT_COORDINATES = 8000  # largest number of measured coordinates for which covariances are computed by iteration
CG_TOLERANCE = 1e-11  # default tolerance of the relative residual
MAX_ITERATIONS = 300
ACCEPTABLE_RESIDUAL = 1e-6  # relative residual that is accepted where rounding keeps it above the tolerance


def partial_cholesky(linearisation: Linearisation, max_rest: float, rank: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """F (N m, r) with F F^T ~ G, and the diagonal (N m,) of G - F F^T.

    Args:
        linearisation: whose prior covariance G to factorise.
        max_rest: the trace of G - F F^T at which to stop.
        rank: bound on r.
        seed: of the random pivots.
    """
    run = _PartialCholesky(linearisation, seed)
    while float(run.rest.sum()) > max_rest and run.factor.shape[1] < rank:
        if not run.extend(min(BLOCK_CONFIGURATIONS, max(1, (rank - run.factor.shape[1]) // run.m))):
            break
    return run.factor, run.rest


def pivots(linearisation: Linearisation, count: int, seed: int = 0) -> Tensor:
    """Row numbers of ``count`` configurations that together explain most of G: (count,)."""
    run = _PartialCholesky(linearisation, seed)
    while len(run.rows) < count and run.extend(min(BLOCK_CONFIGURATIONS // 4, count - len(run.rows))):
        pass
    unused = torch.ones(run.n, dtype=torch.bool, device=run.rows.device)
    unused[run.rows] = False
    return torch.cat([run.rows, unused.nonzero()[:, 0][: count - len(run.rows)]])


class _PartialCholesky:
    """G ~ F F^T, extended by one block of configurations at a time.

    Attributes:
        factor: F (N m, r).
        rest: (N m,) diagonal of G - F F^T.
        rows: row numbers of the configurations drawn so far.
    """

    def __init__(self, linearisation: Linearisation, seed: int) -> None:
        self.linearisation = linearisation
        self.n, self.m, _ = linearisation.sensitivity.shape
        self.rest = _diagonal(linearisation)
        self.factor = self.rest.new_zeros(len(self.rest), 0)
        self.rows = torch.zeros(0, dtype=torch.long, device=self.rest.device)
        self._generator = seeded(seed)

    def extend(self, count: int) -> bool:
        """Draw up to ``count`` more configurations; return False if no variance is unexplained."""
        weight = self.rest.view(self.n, self.m).sum(1)
        count = min(count, int((weight > 0).sum()))
        if count == 0:
            return False
        rows = torch.multinomial(weight.to(HOST), count, generator=self._generator).to(self.rest.device)
        index = (rows[:, None] * self.m + torch.arange(self.m, device=rows.device)).flatten()
        columns = self.linearisation.gram(self.linearisation.rows(rows)) - self.factor @ self.factor[index].T
        core = columns[index]
        values, vectors = torch.linalg.eigh(0.5 * (core + core.T))
        keep = values > ROUNDING_EIGENVALUE_RATIO * values[-1].clamp(min=0.0)
        new = columns @ (vectors[:, keep] * values[keep].rsqrt())
        self.factor = torch.cat([self.factor, new], 1)
        self.rest = (self.rest - new.square().sum(1)).clamp(min=0.0)
        self.rest[index] = 0.0
        self.rows = torch.cat([self.rows, rows])
        return True


def _diagonal(linearisation: Linearisation) -> Tensor:
    """diag(G), (N m,), computed in small blocks."""
    n = len(linearisation.sensitivity)
    rows = torch.arange(n, device=linearisation.sensitivity.device).split(BLOCK_CONFIGURATIONS)
    return torch.cat([linearisation.rows(block).gram().diagonal() for block in rows])


class Preconditioner:
    """(F F^T + R + diag(rest))^-1 by Woodbury's identity, in coordinates in which the noise is white."""

    def __init__(self, factor: Tensor, rest: Tensor, noise: Noise) -> None:
        n, m, _ = noise.covariance.shape
        self.noise = Noise(noise.covariance + torch.diag_embed(rest.view(n, m)))
        self.white = self.noise.whiten(factor.view(n, m, -1)).flatten(0, 1)  # (N m, r)
        eye = torch.eye(self.white.shape[1], dtype=factor.dtype, device=factor.device)
        self.core, info = torch.linalg.cholesky_ex(eye + self.white.T @ self.white)
        if int(info):
            what = "the preconditioner of the conjugate gradients is singular"
            raise NumericalError.of(what, fix=NOISE_ADVICE)

    def apply(self, values: Tensor) -> Tensor:
        """(N, m, k) -> (N, m, k)."""
        white = self.noise.whiten(values).flatten(0, 1)
        white = white - self.white @ torch.cholesky_solve(self.white.T @ white, self.core)
        return self.noise.unwhiten(white.view_as(values))

    def quadratic(self, cross: Tensor) -> Tensor:
        """cross (F F^T + R + diag(rest))^-1 cross^T for several matrices: (M, r, N m) -> (M, r, r).

        With wide priors, Woodbury's identity is a small difference of large numbers. With [W; I] = [Q1; Q2] T, where W
        is the factor in coordinates of white noise, |c - Q1 Q1^T c|^2 + |Q2 Q1^T c|^2 is the same without cancellation.
        """
        columns = cross.flatten(0, 1).T.reshape(*self.noise.covariance.shape[:2], -1)
        white = self.noise.whiten(columns).flatten(0, 1)  # (N m, M r)
        upper, lower = self._orthogonal
        inside = upper.T @ white
        parts = torch.cat([white - upper @ inside, lower @ inside]).T.view(*cross.shape[:2], -1)
        return parts @ parts.mT

    @cached_property
    def _orthogonal(self) -> tuple[Tensor, Tensor]:
        """Q1 (N m, r) and Q2 (r, r)."""
        eye = torch.eye(self.white.shape[1], dtype=self.white.dtype, device=self.white.device)
        upper, lower = torch.linalg.qr(torch.cat([self.white, eye]))[0].split([len(self.white), len(eye)])
        return upper, lower


class ConjugateGradientRegression(DataConditional):
    """Preconditioned conjugate gradients on (G + R) mu = target.

    Args:
        linearisation: first-order response of k1 at the data.
        noise: R.
        rank: bound on the preconditioner's rank.
        tolerance: of the relative residual.
    """

    def __init__(
        self, linearisation: Linearisation, noise: Noise, *, rank: int = MAX_RANK, tolerance: float = CG_TOLERANCE
    ) -> None:
        super().__init__(linearisation)
        self.noise, self.tolerance = noise.own, tolerance
        ones = noise.shared.new_ones(noise.shared.shape[2])
        self.spec = replace(linearisation.spec, prior_variance=torch.cat([linearisation.spec.prior_variance, ones]))
        whole = torch.cat([linearisation.sensitivity, noise.shared], 2)
        self.whole = self._with_shifts(replace(linearisation, sensitivity=whole))
        max_rest = NEGLIGIBLE_VARIANCE_RATIO * float(noise.covariance.diagonal(dim1=1, dim2=2)[noise.visible].sum())
        self.preconditioner = Preconditioner(*partial_cholesky(self.whole, max_rest, rank), self.noise)
        self.iterations = 0

    def _with_shifts(self, at: Linearisation) -> Linearisation:
        """A linearisation by all parameters, of which the last are the shifts that rows share."""
        return replace(at, spec=self.spec, sensitivity=of_parameters(at, len(self.spec.prior_variance)))

    @property
    def rank(self) -> int:
        """Rank of the preconditioner."""
        return self.preconditioner.white.shape[1]

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k), all k columns together.

        Raises:
            NumericalError: the iteration did not converge.
        """
        x = torch.zeros_like(values)
        residual, size = values, _norm(values)
        z = self.preconditioner.apply(residual)
        direction, rz = z, _dot(residual, z)
        for _ in range(MAX_ITERATIONS):
            if bool((_norm(residual) <= self.tolerance * size).all()):
                break
            self.iterations += 1
            image = self.whole.product(direction) + self.noise.multiply(direction)
            step = _ratio(rz, _dot(direction, image))
            x = x + step * direction
            residual = residual - step * image
            z = self.preconditioner.apply(residual)
            rz, before = _dot(residual, z), rz
            direction = z + _ratio(rz, before) * direction
        worst = float((_norm(residual) / size.clamp(min=1e-300)).max())
        if worst > ACCEPTABLE_RESIDUAL:
            raise NumericalError.of(
                f"conjugate gradients did not converge in {MAX_ITERATIONS} iterations",
                expected=f"a relative residual below {ACCEPTABLE_RESIDUAL:.0e}",
                got=f"{worst:.0e}",
                fix="raise `noise`, lower the kernels' variances, or fit with control points (`controls=500`)",
            )
        return x

    def features(self, at: Linearisation) -> Features:
        what = f"the model has {self.size} measured coordinates, too many for covariances between configurations"
        raise InputError.of(what, fix="calibrate with fewer control points (`controls=200`)")

    def posterior(self, at: Linearisation) -> Tensor:
        at = self._with_shifts(at)
        cross = self.whole.gram(at).T.reshape(*at.sensitivity.shape[:2], -1)
        return at.own_blocks() - self.explained(cross)

    def covariance_between(self, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        at, other = self._with_shifts(at), None if other is None else self._with_shifts(other)
        both = [at] if other is None else [at, other]
        cross = torch.cat([self.whole.gram(points) for points in both], 1)
        explained = self.explained(cross.T[None])[0]
        split = 0 if other is None else at.sensitivity.shape[0] * at.sensitivity.shape[1]
        return at.gram(other) - explained[: split or None, split:]

    def explained(self, cross: Tensor) -> Tensor:
        """The same; for large problems with the preconditioner's matrix in place of G + R.

        That matrix treats the part of G that F does not explain as noise: on average at most
        :data:`NEGLIGIBLE_VARIANCE_RATIO` of the noise's variance. Iterating on hundreds of columns would take minutes.
        """
        return super().explained(cross) if self.size <= MAX_EXACT_COORDINATES else self.preconditioner.quadratic(cross)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum((0, 1))


def _norm(a: Tensor) -> Tensor:
    return _dot(a, a).sqrt()


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    """a / b; 0 where b is 0, in columns that have converged exactly."""
    return torch.where(b != 0.0, a / torch.where(b != 0.0, b, torch.ones_like(b)), torch.zeros_like(a))
