"""The tangent model: calibration as Gaussian-process regression.

To first order k1 = k0 + Dk0 K_V b + K_W p + S theta: a Gaussian process with the prior covariance

    G(x, x') = Dk0(x) K_V(x, x') Dk0(x')^T + K_W(k0(x), k0(x')) + S(x) Lambda^-1 S(x')^T

One Cholesky factor of G + R answers everything: the momenta, the marginal likelihood, exact
leave-one-out errors. The same linear algebra, around a deformation instead of zero, is one
Gauss-Newton step.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi

import torch
from torch import Tensor

from diffeo_calib.calibration.problem import Problem
from diffeo_calib.deformation import Deformation, Linearisation, Momenta
from diffeo_calib.errors import InputError, NumericalError, sentence
from diffeo_calib.flows.integrate import RK4

MAX_DENSE = 20_000
"""Largest N m whose matrix (3.2 GB in float64) is factorised densely."""


@dataclass(frozen=True)
class Regression:
    """The Gaussian conditional of one linearisation.

    Args:
        linearisation: how k1 at the data moves with fields and parameters.
        target: (N, m) measured minus linearised model at zero fields, m.
        factor: (N m, N m) lower Cholesky factor of G + R.
    """

    linearisation: Linearisation
    target: Tensor
    factor: Tensor

    @property
    def mu(self) -> Tensor:
        """(G + R)^-1 target, the momentum at time 1: (N, m)."""
        return torch.cholesky_solve(self.target.reshape(-1, 1), self.factor).reshape(self.target.shape)

    def momenta(self) -> Momenta:
        """Posterior mode of b, p, theta."""
        return self.linearisation.momenta(self.mu)

    def log_marginal_likelihood(self) -> Tensor:
        """log N(target; 0, G + R), scalar."""
        quadratic = (self.target * self.mu).sum()
        log_det = 2.0 * torch.diagonal(self.factor).log().sum()
        return -0.5 * (quadratic + log_det + self.target.numel() * log(2.0 * pi))

    def leave_one_out(self) -> Tensor:
        """Errors (N, m) in m at each configuration when it is left out: [(G+R)^-1]_ii^-1 mu_i."""
        n, m = self.target.shape
        inverse = torch.cholesky_inverse(self.factor).view(n, m, n, m)
        index = torch.arange(n, device=inverse.device)
        blocks = inverse[index, :, index, :]  # (N, m, m)
        return torch.linalg.solve(blocks, self.mu[:, :, None])[:, :, 0]


def regress(problem: Problem, deformation: Deformation) -> Regression:
    """Linearise a problem around a deformation and factorise G + R.

    Raises:
        InputError: N m is too large for a dense factorisation.
        NumericalError: G + R is not positive definite in float64.
    """
    size = problem.y.numel()
    if size > MAX_DENSE:
        raise InputError(
            sentence(
                f"{size} measured coordinates are too many for a dense solver",
                expected=f"at most {MAX_DENSE} (rows x coordinates)",
                fix=f"it would take {8e-9 * size**2:.0f} GB per matrix; fit a subset of the rows",
            )
        )
    lin = deformation.linearise()
    target = problem.y - deformation.z1 + lin.response(deformation)
    factor, info = torch.linalg.cholesky_ex(problem.noise.add_to(lin.gram()))
    if int(info):
        raise NumericalError(
            sentence(
                "the matrix G + R of the Gauss-Newton step is not positive definite",
                expected="noise large enough for float64 against the kernels' amplitudes",
                fix="raise `noise` or lower the kernels' variances",
            )
        )
    return Regression(lin, target, factor)


def tangent(problem: Problem) -> Regression:
    """The tangent model at zero deformation."""
    return regress(problem, problem.deform(problem.zero(), RK4(1)))
