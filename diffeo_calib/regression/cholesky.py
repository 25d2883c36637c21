"""Conditioning by one Cholesky factor, with the parameters apart from the fields.

A parameter such as the place of the base has a prior deviation of decimetres, and predictions deviate by micrometres:
the difference G(x, x) - G(x, data) (G + R)^-1 G(data, x) loses eight digits and more. With G = F + S Lambda^-1 S^T, F
the covariance of the fields, it is

    F(x, x) - F(x, data) (F + R)^-1 F(data, x) + D (Lambda + S^T (F + R)^-1 S)^-1 D^T
    D = S(x) - F(x, data) (F + R)^-1 S

(Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006, section 2.7), in which
nothing large cancels. Shifts that rows share (:class:`Noise`) are parameters, too.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import DataConditional, Features, diagonal_blocks, of_parameters
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
        super().__init__(linearisation)
        visible, shared = noise.visible, noise.shared
        self.seen = slice(None) if bool(visible.all()) else visible.flatten().nonzero()[:, 0]
        self.deviations = linearisation.spec.prior_variance.sqrt()  # Lambda^-1/2
        matrix = noise.own.add_to(linearisation.fields.gram())
        slopes = torch.cat([linearisation.sensitivity * self.deviations, shared], 2).flatten(0, 1)
        self.deviations = torch.cat([self.deviations, shared.new_ones(shared.shape[2])])
        self.factor = Factor.of(matrix[self.seen][:, self.seen], slopes[self.seen])

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k); zero where nothing was measured."""
        return self._spread(self.factor.solve(values.flatten(0, 1)[self.seen])).view_as(values)

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

    def features(self, at: Linearisation) -> Features:
        """Information of the data about the fields (M r, S), and about the parameters without it (M r, K + c)."""
        L, W, B = self.factor.L, self.factor.W, self.factor.B
        cross = self.linearisation.fields.gram(at.fields).T[:, self.seen]
        with large_work(cross.numel()):
            known = torch.linalg.solve_triangular(L.T, cross, upper=True, left=False)  # (M r, S)
        unknown = of_parameters(at, len(B)).flatten(0, 1) * self.deviations - known @ W  # D Lambda^-1/2
        unknown = torch.linalg.solve_triangular(B.T, unknown, upper=True, left=False)
        return Features.of((known.T, -1), (unknown.T, 1))

    def _spread(self, flat: Tensor) -> Tensor:
        """Values (S, ...) of what was measured as those of all, zero elsewhere: (N m, ...)."""
        if isinstance(self.seen, slice):
            return flat
        return flat.new_zeros(self.size, *flat.shape[1:]).index_copy(0, self.seen, flat)
