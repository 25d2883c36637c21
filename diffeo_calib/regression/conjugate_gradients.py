"""Conditioning without the matrix: conjugate gradients on kernel sums, memory O(N m rank).

The product with G is a few kernel sums (deformation.py). The preconditioner is F F^T + R with F from a
randomly pivoted partial Cholesky factorisation of G (Chen, Epperly, Tropp, Webber, "Randomly pivoted
Cholesky", 2023): blocks of configurations are drawn in proportion to the variance that is not
explained yet. Smooth kernels have few directions above the noise, so F catches nearly all of G that
matters, and a few iterations remove the rest.
"""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import NumericalError, sentence
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import DataConditional

BLOCK = 64
"""Configurations that are drawn at once."""
NEGLIGIBLE = 0.03
"""Unexplained variance, in units of the noise's, at which the factor is good enough."""
SINGULAR = 1e-11
"""Directions of a block below this part of its largest variance are rounding errors."""
MAX_RANK = 3000
MOST_EXACT = 8000
"""Measured coordinates up to which covariances are iterated, too."""
TOO_SMALL = "raise `noise` or lower the kernels' variances"
TOLERANCE = 1e-11
MAX_ITERATIONS = 300
ACCEPTABLE = 1e-6
"""Residual that is still good enough where rounding keeps it above the tolerance."""


def partial_cholesky(linearisation: Linearisation, enough: float, rank: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """F (N m, r) with F F^T ~ G, and the diagonal (N m,) of what is left.

    Args:
        linearisation: G's.
        enough: stop when the trace of G - F F^T falls below.
        rank: bound on r.
        seed: draws the pivots.
    """
    run = _PartialCholesky(linearisation, seed)
    while float(run.rest.sum()) > enough and run.factor.shape[1] < rank:
        if not run.extend(min(BLOCK, max(1, (rank - run.factor.shape[1]) // run.m))):
            break
    return run.factor, run.rest


def pivots(linearisation: Linearisation, count: int, seed: int = 0) -> Tensor:
    """Numbers of ``count`` configurations that together explain most of G: (count,)."""
    run = _PartialCholesky(linearisation, seed)
    while len(run.rows) < count and run.extend(min(BLOCK // 4, count - len(run.rows))):
        pass
    others = torch.ones(run.n, dtype=torch.bool, device=run.rows.device)
    others[run.rows] = False
    return torch.cat([run.rows, others.nonzero()[:, 0][: count - len(run.rows)]])


class _PartialCholesky:
    """G ~ F F^T, a block of configurations at a time.

    Attributes:
        factor: F (N m, r).
        rest: (N m,) diagonal of G - F F^T.
        rows: the configurations drawn so far.
    """

    def __init__(self, linearisation: Linearisation, seed: int) -> None:
        self.linearisation = linearisation
        self.n, self.m, _ = linearisation.sensitivity.shape
        self.rest = _diagonal(linearisation)
        self.factor = self.rest.new_zeros(len(self.rest), 0)
        self.rows = torch.zeros(0, dtype=torch.long, device=self.rest.device)
        self._generator = seeded(seed)

    def extend(self, count: int) -> bool:
        """Draw up to ``count`` more configurations; False if nothing is left to explain."""
        weight = self.rest.view(self.n, self.m).sum(1)
        count = min(count, int((weight > 0).sum()))
        if count == 0:
            return False
        rows = torch.multinomial(weight.to(HOST), count, generator=self._generator).to(self.rest.device)
        index = (rows[:, None] * self.m + torch.arange(self.m, device=rows.device)).flatten()
        columns = self.linearisation.gram(self.linearisation.rows(rows)) - self.factor @ self.factor[index].T
        core = columns[index]
        values, vectors = torch.linalg.eigh(0.5 * (core + core.T))
        keep = values > SINGULAR * values[-1].clamp(min=0.0)
        new = columns @ (vectors[:, keep] * values[keep].rsqrt())
        self.factor = torch.cat([self.factor, new], 1)
        self.rest = (self.rest - new.square().sum(1)).clamp(min=0.0)
        self.rest[index] = 0.0
        self.rows = torch.cat([self.rows, rows])
        return True


def _diagonal(linearisation: Linearisation) -> Tensor:
    """diag(G), (N m,), by small blocks."""
    n = len(linearisation.sensitivity)
    rows = torch.arange(n, device=linearisation.sensitivity.device).split(BLOCK)
    return torch.cat([linearisation.rows(block).gram().diagonal() for block in rows])


class Preconditioner:
    """(F F^T + R + diag(rest))^-1 by Woodbury's identity, in coordinates where the noise is white."""

    def __init__(self, factor: Tensor, rest: Tensor, noise: Noise) -> None:
        n, m, _ = noise.covariance.shape
        self.noise = Noise(noise.covariance + torch.diag_embed(rest.view(n, m)))
        self.white = self.noise.whiten(factor.view(n, m, -1)).flatten(0, 1)  # (N m, r)
        eye = torch.eye(self.white.shape[1], dtype=factor.dtype, device=factor.device)
        self.core, info = torch.linalg.cholesky_ex(eye + self.white.T @ self.white)
        if int(info):
            raise NumericalError(sentence("the preconditioner of the conjugate gradients is singular", fix=TOO_SMALL))

    def apply(self, values: Tensor) -> Tensor:
        """(N, m, k) -> (N, m, k)."""
        white = self.noise.whiten(values).flatten(0, 1)
        white = white - self.white @ torch.cholesky_solve(self.white.T @ white, self.core)
        return self.noise.unwhiten(white.view_as(values))

    def quadratic(self, values: Tensor) -> Tensor:
        """values^T (F F^T + R + diag(rest))^-1 values: (N, m, k) -> (k, k).

        Beside wide priors the result is a tiny difference. With [W; I] = [Q1; Q2] T, W the factor in coordinates of
        white noise, it is the sum of squares |c - Q1 Q1^T c|^2 + |Q2 Q1^T c|^2, in which nothing cancels.
        """
        white = self.noise.whiten(values).flatten(0, 1)
        upper, lower = self._orthogonal
        inside = upper.T @ white
        outside, inside = white - upper @ inside, lower @ inside
        return outside.T @ outside + inside.T @ inside

    @cached_property
    def _orthogonal(self) -> tuple[Tensor, Tensor]:
        """Q1 (N m, r) and Q2 (r, r)."""
        eye = torch.eye(self.white.shape[1], dtype=self.white.dtype, device=self.white.device)
        upper, lower = torch.linalg.qr(torch.cat([self.white, eye]))[0].split([len(self.white), len(eye)])
        return upper, lower


class ConjugateGradientRegression(DataConditional):
    """Preconditioned conjugate gradients on (G + R) mu = target.

    Args:
        linearisation: how k1 at the data moves.
        noise: R.
        rank: bound on the preconditioner's rank.
        tolerance: of the residual, relative.
    """

    def __init__(
        self, linearisation: Linearisation, noise: Noise, *, rank: int = MAX_RANK, tolerance: float = TOLERANCE
    ) -> None:
        super().__init__(linearisation)
        self.noise, self.tolerance = noise, tolerance
        enough = NEGLIGIBLE * float(noise.covariance.diagonal(dim1=1, dim2=2).sum())
        self.preconditioner = Preconditioner(*partial_cholesky(linearisation, enough, rank), noise)
        self.iterations = 0

    @property
    def rank(self) -> int:
        """Of the preconditioner."""
        return self.preconditioner.white.shape[1]

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k), all k at once.

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
            image = self.linearisation.product(direction) + self.noise.multiply(direction)
            step = _ratio(rz, _dot(direction, image))
            x = x + step * direction
            residual = residual - step * image
            z = self.preconditioner.apply(residual)
            rz, before = _dot(residual, z), rz
            direction = z + _ratio(rz, before) * direction
        worst = float((_norm(residual) / size.clamp(min=1e-300)).max())
        if worst > ACCEPTABLE:
            raise NumericalError(
                sentence(
                    f"conjugate gradients did not converge in {MAX_ITERATIONS} iterations",
                    expected=f"a relative residual below {ACCEPTABLE:.0e}",
                    got=f"{worst:.0e}",
                    fix="raise `noise`, lower the kernels' variances, or fit with control points (`controls=500`)",
                )
            )
        return x

    def explained(self, cross: Tensor) -> Tensor:
        """cross^T (G + R)^-1 cross; of large problems with the preconditioner in place of G + R.

        It leaves a part of G unexplained whose mean variance is :data:`NEGLIGIBLE` of the noise's at most, and counts
        it as noise; hundreds of right-hand sides by iteration would take minutes.
        """
        if cross.shape[0] * cross.shape[1] <= MOST_EXACT:
            return super().explained(cross)
        return self.preconditioner.quadratic(cross)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum((0, 1))


def _norm(a: Tensor) -> Tensor:
    return _dot(a, a).sqrt()


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    """a / b, 0 where a column has converged to nothing."""
    return torch.where(b != 0.0, a / torch.where(b != 0.0, b, torch.ones_like(b)), torch.zeros_like(a))
