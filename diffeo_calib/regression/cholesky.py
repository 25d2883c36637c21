"""Conditioning by one Cholesky factor of G + R: momenta, leave-one-out errors."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import HIDDEN_VARIANCE, Noise
from diffeo_calib.regression.conditional import NOISE_ADVICE, DataConditional, diagonal_blocks


class CholeskyRegression(DataConditional):
    """Conditioning by a Cholesky factor of G + R. Coordinates that were not measured take no part.

    Args:
        linearisation: first-order response of k1 at the data.
        factor: (S, S) lower Cholesky factor of G + R, of the S coordinates that were measured.
        seen: (S,) their numbers among the N m; None if all were measured.
    """

    def __init__(self, linearisation: Linearisation, factor: Tensor, seen: Tensor | None = None) -> None:
        super().__init__(linearisation)
        self.factor, self.seen = factor, seen

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k); zero where nothing was measured."""
        flat = values.flatten(0, 1)
        return self.spread(torch.cholesky_solve(self.measured(flat), self.factor)).view_as(values)

    def explained(self, cross: Tensor) -> Tensor:
        """cross (G + R)^-1 cross^T = |L^-1 cross^T|^2, half the work of a solution: (M, r, N m) -> (M, r, r)."""
        cross = cross if self.seen is None else cross[..., self.seen]
        with large_work(cross.numel()):
            white = torch.linalg.solve_triangular(self.factor.T, cross.flatten(0, 1), upper=True, left=False)
            white = white.view_as(cross)
            return white @ white.mT

    def measured(self, flat: Tensor) -> Tensor:
        """The measured ones of rows: (N m, ...) -> (S, ...)."""
        return flat if self.seen is None else flat[self.seen]

    def spread(self, flat: Tensor) -> Tensor:
        """The inverse of :meth:`measured`, zero elsewhere: (S, ...) -> (N m, ...)."""
        return flat if self.seen is None else flat.new_zeros(self.size, *flat.shape[1:]).index_copy(0, self.seen, flat)

    def of_white(self, values: Tensor) -> Tensor:
        """L^-T values: (S,) -> (N m,)."""
        return self.spread(torch.linalg.solve_triangular(self.factor.T, values[:, None], upper=True)[:, 0])

    @cached_property
    def inverse(self) -> Tensor:
        """(G + R)^-1, kept from then on: (N m, N m)."""
        return self._inverted()

    def inverse_blocks(self, rows: int) -> Tensor:
        """[(G + R)^-1]_ii for each of N = ``rows`` configurations: (N, m, m)."""
        return diagonal_blocks(self.inverse if "inverse" in vars(self) else self._inverted(), rows)

    def matrix(self) -> Tensor:
        """G + R, in which coordinates that were not measured have their variance alone: (N m, N m)."""
        return self._whole(self.factor @ self.factor.T, HIDDEN_VARIANCE)

    def _inverted(self) -> Tensor:
        with large_work(self.factor.numel()):
            return self._whole(torch.cholesky_inverse(self.factor), 1.0 / HIDDEN_VARIANCE)

    def _whole(self, matrix: Tensor, hidden: float) -> Tensor:
        """A matrix (S, S) of the measured coordinates as one of all, with the same number for each other one."""
        if self.seen is None:
            return matrix
        whole = torch.diag(matrix.new_full((self.size,), hidden))
        whole[self.seen[:, None], self.seen] = matrix
        return whole


def factorise(linearisation: Linearisation, noise: Noise, gram: Tensor | None = None) -> CholeskyRegression:
    """Build G + R and its Cholesky factor; pass ``gram`` if G is known already.

    Raises:
        NumericalError: G + R is not positive definite in float64.
    """
    matrix = noise.add_to(linearisation.gram() if gram is None else gram)
    seen = seen_numbers(noise.visible)
    matrix = matrix if seen is None else matrix[seen[:, None], seen]
    with large_work(matrix.numel()):
        factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        raise NumericalError.of(
            "the matrix G + R of the Gauss-Newton step is not positive definite",
            expected="noise that float64 can resolve beside the kernels' amplitudes",
            fix=NOISE_ADVICE,
        )
    return CholeskyRegression(linearisation, factor, seen)


def seen_numbers(visible: Tensor) -> Tensor | None:
    """Numbers (S,) of the coordinates that were measured, (N, m) boolean; None if all were."""
    return None if bool(visible.all()) else visible.flatten().nonzero()[:, 0]
