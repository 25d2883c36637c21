"""Conditioning without the matrix: conjugate gradients on kernel sums, memory O(N m rank).

The product with G is a few kernel sums (linearisation.py). The preconditioner is P P^T + R and the parameters, with P
from a randomly pivoted partial Cholesky factorisation of the fields' covariance F (Chen, Epperly, Tropp, Webber,
"Randomly pivoted Cholesky", 2023): blocks of configurations are drawn with probabilities proportional to their
unexplained variance. Smooth kernels have few directions above the noise, so that P captures nearly all of F that
matters, and few iterations are needed.

Covariances take the part of F that P does not explain as noise: on average at most :data:`NEGLIGIBLE_VARIANCE_RATIO` of
the noise's variance. Iterating on hundreds of columns would take minutes.
"""

from __future__ import annotations

from functools import cached_property
from typing import Literal, get_args

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_memory
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, NumericalError, as_written
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import lower_root
from diffeo_calib.regression.conditional import BeforeData, Conditional, Features, Process

BLOCK_CONFIGURATIONS = 64  # number of configurations that are drawn together
NEGLIGIBLE_VARIANCE_RATIO = 0.03
"""Mean unexplained variance, relative to the noise's, at which the factor is accurate enough."""
ROUNDING_EIGENVALUE_RATIO = 1e-11  # eigenvalues of a block below this fraction of the largest one are rounding errors
MAX_RANK = 3000  # largest rank of the preconditioner
CG_TOLERANCE = 1e-11  # default tolerance of the relative residual
MAX_ITERATIONS = 300
ACCEPTABLE_RESIDUAL = 1e-6  # relative residual that is accepted where rounding keeps it above the tolerance


def partial_cholesky(
    linearisation: Linearisation, max_rest: float, most: int, block: int = BLOCK_CONFIGURATIONS
) -> tuple[Tensor, Tensor, Tensor]:
    """A factor of the prior covariance G of a linearisation by some of its configurations.

    Args:
        max_rest: the trace of G - P P^T at which to stop. most: number of configurations, ``block`` drawn together.

    Returns:
        P (N m, r) with P P^T ~ G, the diagonal (N m,) of G - P P^T, and the numbers of the configurations.
    """
    n, m, _ = linearisation.sensitivity.shape
    every, generator = torch.arange(n, device=linearisation.sensitivity.device), seeded(0)
    rest = torch.cat([linearisation.rows(some).gram().diagonal() for some in every.split(BLOCK_CONFIGURATIONS)])
    factor, chosen = rest.new_zeros(len(rest), 0), every[:0]
    while len(chosen) < most and float(rest.sum()) > max_rest:
        weight = rest.view(n, m).sum(1)
        count = min(block, most - len(chosen), int((weight > 0).sum()))
        rows = torch.multinomial(weight.to(HOST), count, generator=generator).to(rest.device)
        index = (rows[:, None] * m + torch.arange(m, device=rows.device)).flatten()
        columns = linearisation.gram(linearisation.rows(rows)) - factor @ factor[index].T
        core = columns[index]
        values, vectors = torch.linalg.eigh(0.5 * (core + core.T))
        keep = values > ROUNDING_EIGENVALUE_RATIO * values[-1].clamp(min=0.0)
        new = columns @ (vectors[:, keep] * values[keep].rsqrt())
        factor, chosen = torch.cat([factor, new], 1), torch.cat([chosen, rows])
        rest = (rest - new.square().sum(1)).clamp(min=0.0)
        rest[index] = 0.0
    return factor, rest, chosen


def pivots(linearisation: Linearisation, count: int) -> Tensor:
    """Row numbers of ``count`` configurations that together explain most of G: (count,)."""
    chosen = partial_cholesky(linearisation, 0.0, count, BLOCK_CONFIGURATIONS // 4)[2]
    unused = torch.ones(len(linearisation.sensitivity), dtype=torch.bool, device=chosen.device)
    unused[chosen] = False
    return torch.cat([chosen, unused.nonzero()[:, 0][: count - len(chosen)]])


class ConjugateGradientRegression(Conditional):
    """Preconditioned conjugate gradients on (G + R) mu = target.

    Args:
        linearisation: first-order response of k1 at the data. noise: R. tolerance: of the relative residual.
    """

    def __init__(self, linearisation: Linearisation, noise: Noise, tolerance: float = CG_TOLERANCE) -> None:
        self.linearisation, self.size = linearisation, linearisation.sensitivity.shape[:2].numel()
        self.noise, self.tolerance = noise, tolerance
        deviations, shared = linearisation.spec.prior_variance.sqrt(), noise.shared
        self.before = BeforeData(torch.cat([deviations, shared.new_ones(shared.shape[2])]))
        self.slopes = torch.cat([linearisation.sensitivity * deviations, shared], 2).flatten(0, 1)
        max_rest = NEGLIGIBLE_VARIANCE_RATIO * float(noise.covariance.diagonal(dim1=1, dim2=2)[noise.visible].sum())
        n, m, _ = noise.covariance.shape
        self.P, rest, _ = partial_cholesky(linearisation.fields, max_rest, max(1, MAX_RANK // m))
        blocks = noise.covariance + torch.diag_embed(rest.view(n, m))
        self.preconditioner = Noise(blocks, torch.cat([self.P, self.slopes], 1).view(n, m, -1))

    def momenta(self, target: Tensor) -> Momenta:
        """Posterior mode of b, p, theta by a target (N, m): mu transported back to time 0."""
        return self.linearisation.momenta(self.solve(target[:, :, None])[:, :, 0])

    def features(self, at: Linearisation) -> Features:
        (W, B), before = self._apart, self.before.features(at)
        known = self._white(self.linearisation.fields.gram(at.fields))
        return Features(at, known, torch.linalg.solve_triangular(B, before.unknown - W.T @ known, upper=False))

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k), all k columns together.

        Raises:
            NumericalError: the iteration did not converge.
        """
        x = torch.zeros_like(values)
        residual, size = values, _dot(values, values).sqrt()
        z = self.preconditioner.solve(residual)
        direction, rz = z, _dot(residual, z)
        for _ in range(MAX_ITERATIONS):
            if bool((_dot(residual, residual).sqrt() <= self.tolerance * size).all()):
                break
            image = self.linearisation.product(direction) + self.noise.multiply(direction)
            step = _ratio(rz, _dot(direction, image))
            x = x + step * direction
            residual = residual - step * image
            z = self.preconditioner.solve(residual)
            rz, before = _dot(residual, z), rz
            direction = z + _ratio(rz, before) * direction
        worst = float((_dot(residual, residual).sqrt() / size.clamp(min=1e-300)).max())
        if worst > ACCEPTABLE_RESIDUAL:
            raise NumericalError.of(
                f"conjugate gradients did not converge in {MAX_ITERATIONS} iterations",
                expected=f"a relative residual below {ACCEPTABLE_RESIDUAL:.0e}",
                got=f"{worst:.0e}",
                fix="raise `noise`, lower the kernels' variances, or fit with control points (`controls=500`)",
            )
        return x

    def _white(self, values: Tensor) -> Tensor:
        """T values (N m + r, k), with T^T T the inverse of P P^T + R and what P does not explain.

        Woodbury's identity is a small difference of large numbers. In coordinates in which the noise is white, with
        [P; 1] = [Q1; Q2] C, |c - Q1 Q1^T c|^2 + |Q2 Q1^T c|^2 is the same without cancellation.
        """
        (upper, lower), white = self._orthogonal, self._whiten(values)
        inside = upper.T @ white
        return torch.cat([white - upper @ inside, lower @ inside])

    @cached_property
    def _apart(self) -> tuple[Tensor, Tensor]:
        """W = T H of the slopes H, and the Cholesky factor B of 1 + W^T W."""
        W = self._white(self.slopes)
        return W, lower_root(torch.eye(W.shape[1], dtype=W.dtype, device=W.device) + W.T @ W)

    @cached_property
    def _orthogonal(self) -> tuple[Tensor, Tensor]:
        """Q1 (N m, r) and Q2 (r, r)."""
        white = self._whiten(self.P)
        eye = torch.eye(white.shape[1], dtype=white.dtype, device=white.device)
        upper, lower = torch.linalg.qr(torch.cat([white, eye]))[0].split([len(white), len(eye)])
        return upper, lower

    def _whiten(self, values: Tensor) -> Tensor:
        return self.preconditioner.whiten(values.view(*self.noise.covariance.shape[:2], -1)).flatten(0, 1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum((0, 1))


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    """a / b; 0 where b is 0, in columns that have converged exactly."""
    return torch.where(b != 0.0, a / torch.where(b != 0.0, b, torch.ones_like(b)), torch.zeros_like(a))


LinearSolver = Literal["auto", "cholesky", "cg"]
MAX_DENSE = 8_000
"""Largest N m for which `auto` factorises the matrix (0.5 GiB in float64, at the peak four times as much)."""
BYTES_PER_FLOAT = 8


def condition(
    linearisation: Linearisation, noise: Noise, linear: LinearSolver = "auto", tolerance: float = CG_TOLERANCE
) -> Process | ConjugateGradientRegression:
    """Condition on data that are all control points; ``tolerance`` is that of conjugate gradients.

    Raises:
        InputError: the method needs more memory than is free.
        NumericalError: F + R is not positive definite in float64.
    """
    size = noise.covariance.shape[:2].numel()
    method = choose(linear, size)
    columns = size if method == "cholesky" else min(MAX_RANK, size)  # four matrices, or factors of the preconditioner
    check_memory(4 * BYTES_PER_FLOAT * size * columns, f"{size} measured coordinates with linear={method!r}")
    if method == "cholesky":
        return Process.of_rows(linearisation, noise)
    return ConjugateGradientRegression(linearisation, noise, tolerance)


def choose(linear: LinearSolver, size: int) -> LinearSolver:
    """The method for ``size`` measured coordinates: ``linear`` itself, or the choice of `auto`.

    Raises:
        InputError: an unknown method.
    """
    if linear not in get_args(LinearSolver):
        raise InputError.of("`linear`", expected=", ".join(get_args(LinearSolver)), got=as_written(linear))
    return linear if linear != "auto" else "cholesky" if size <= MAX_DENSE else "cg"
