"""Conditioning by one Cholesky factor of G + R."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import DataConditional, diagonal_blocks
from diffeo_calib.regression.factor import Factor


class CholeskyRegression(DataConditional):
    """Conditioning by a :class:`Factor` of G + R. Coordinates that were not measured take no part.

    Args:
        linearisation: first-order response of k1 at the data. noise: R.

    Attributes:
        seen: the S coordinates that were measured, among the N m. factor: of these, (S, S).

    Raises:
        NumericalError: F + R is not positive definite in float64.
    """

    def __init__(self, linearisation: Linearisation, noise: Noise) -> None:
        super().__init__(linearisation, noise)
        visible = noise.visible
        self.seen = slice(None) if bool(visible.all()) else visible.flatten().nonzero()[:, 0]
        matrix = noise.own.add_to(linearisation.fields.gram())
        self.factor = Factor.of(matrix[self.seen][:, self.seen], self.slopes[self.seen])

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k); zero where nothing was measured."""
        return self._spread(self.factor.solve(values.flatten(0, 1)[self.seen])).view_as(values)

    def white(self, values: Tensor) -> Tensor:
        return self.factor.white(values[self.seen])

    @property
    def apart(self) -> tuple[Tensor, Tensor]:
        return self.factor.W, self.factor.B

    def momenta(self, target: Tensor) -> Momenta:
        """Fields by mu, transported back to time 0; parameters apart, since S^T mu would lose their digits."""
        mu, shift = self.factor.solved(target.flatten()[self.seen, None])
        found = self.linearisation.fields.momenta(self._spread(mu[:, 0]).view_as(target))
        return replace(found, theta=(self.deviations * shift[:, 0])[: len(self.linearisation.spec.prior_variance)])

    def of_white(self, values: Tensor) -> Tensor:
        """C values with C C^T = (G + R)^-1: (S,) -> (N m,)."""
        return self._spread(self.factor.of_white(values))

    def left_out(self, target: Tensor) -> tuple[Tensor, Tensor]:
        """Errors (N, m) of every configuration predicted by all others, [(G + R)^-1]_ii^-1 mu_i, and their covariance.

        The covariance (N, m, m) holds the noise of the configuration itself; it is one where nothing was measured.
        """
        inverse = torch.eye(self.size, dtype=target.dtype, device=target.device)
        at = torch.arange(self.size, device=target.device)[self.seen]
        inverse[at[:, None], at] = self.factor.inverse
        own = torch.linalg.inv(diagonal_blocks(inverse, len(target)))
        return (own @ self.mu(target)[:, :, None])[:, :, 0], own

    def _spread(self, flat: Tensor) -> Tensor:
        """Values (S, ...) of what was measured as those of all, zero elsewhere: (N m, ...)."""
        if isinstance(self.seen, slice):
            return flat
        return flat.new_zeros(self.size, *flat.shape[1:]).index_copy(0, self.seen, flat)
