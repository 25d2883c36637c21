"""Covariances with the parameters apart from the fields, so that their wide priors do not cancel.

A parameter such as the place of the base has a prior deviation of decimetres, and predictions deviate by micrometres:
the difference G(x, x) - G(x, data) (G + R)^-1 G(data, x) loses eight digits and more. With G = F + S Lambda^-1 S^T, F
the covariance of the fields, it is

    F(x, x) - F(x, data) (F + R)^-1 F(data, x) + D (Lambda + S^T (F + R)^-1 S)^-1 D^T
    D = S(x) - F(x, data) (F + R)^-1 S

(Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006, section 2.7), in which
nothing large cancels. Shifts that rows share (:class:`Noise`) are parameters, too, which new rows do not have.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import factorise
from diffeo_calib.regression.conditional import DataConditional, FeatureConditional, Features


class ExplicitParameterRegression(FeatureConditional, DataConditional):
    """Conditioning by a Cholesky factor of F + R and one of the parameters' precision.

    Args:
        linearisation: first-order response of k1 at the data.
        noise: R.

    Raises:
        NumericalError: F + R is not positive definite in float64.
    """

    def __init__(self, linearisation: Linearisation, noise: Noise) -> None:
        super().__init__(linearisation)
        self.fields = linearisation.fields
        self.dense = factorise(self.fields, noise.own)
        self.factor = self.dense.factor
        self.deviations = linearisation.spec.prior_variance.sqrt()  # Lambda^-1/2
        self.shifts = noise.shared.shape[2]
        slopes = torch.cat([linearisation.sensitivity * self.deviations, noise.shared], 2).flatten(0, 1)
        with large_work(self.factor.numel()):
            slopes = self.dense.measured(slopes)
            self.white = torch.linalg.solve_triangular(self.factor, slopes, upper=False)  # (S, K + c)
        eye = torch.eye(slopes.shape[1], dtype=slopes.dtype, device=slopes.device)
        self.core = torch.linalg.cholesky(eye + self.white.T @ self.white)

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k)."""
        measured = self.dense.measured(values.flatten(0, 1))
        white = torch.linalg.solve_triangular(self.factor, measured, upper=False)
        white = white - self.white @ torch.cholesky_solve(self.white.T @ white, self.core)
        found = torch.linalg.solve_triangular(self.factor.T, white, upper=True)
        return self.dense.spread(found).view_as(values)

    def inverse_blocks(self, rows: int) -> Tensor:
        """[(G + R)^-1]_ii for each of N = ``rows`` configurations: (N, m, m)."""
        with large_work(self.factor.numel()):
            fields = self.dense.inverse_blocks(rows)
            known = torch.linalg.solve_triangular(self.factor.T, self.white, upper=True)
            known = torch.linalg.solve_triangular(self.core.T, known, upper=True, left=False)
        known = self.dense.spread(known).unflatten(0, (rows, -1))
        return fields - known @ known.mT

    def features(self, at: Linearisation) -> Features:
        """Information of the data about the fields (M r, S), and about the parameters without it (M r, K + c)."""
        cross = self.fields.gram(at.fields).T
        cross = cross if self.dense.seen is None else cross[:, self.dense.seen]
        with large_work(cross.numel()):
            known = torch.linalg.solve_triangular(self.factor.T, cross, upper=True, left=False)  # (M r, S)
        scaled = at.sensitivity.flatten(0, 1) * self.deviations
        unknown = torch.nn.functional.pad(scaled, (0, self.shifts)) - known @ self.white  # D Lambda^-1/2
        unknown = torch.linalg.solve_triangular(self.core.T, unknown, upper=True, left=False)
        return Features.of((known.T, -1), (unknown.T, 1))

    def shift_features(self) -> Tensor:
        """Posterior of the shifts."""
        own = torch.eye(len(self.core), dtype=self.core.dtype, device=self.core.device)
        own = own[:, len(own) - self.shifts :]
        left = torch.linalg.solve_triangular(self.core, own, upper=False)
        return torch.cat([left.new_zeros(len(self.factor), self.shifts), left])
