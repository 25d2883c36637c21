"""Kernels at fixed pairs of points for many scales: values, and the derivatives of weighted sums of them by the scales.

A search needs sum(W * K) and its derivatives by a dozen scales, W fixed. With squared distances d_l at length scale 1,
rates r_l = lengthscale_l^-2 and a profile kappa these are sums over all pairs,

    d/d r_l  sum W a^2 kappa(sum_l r_l d_l) = a^2 sum W kappa' d_l,

so that autograd follows the scales only, not the pairs: one root and one exponential per pair give all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

from diffeo_calib.kernels.profiles import Profile


class SeparateKernels:
    """a_l^2 kappa(r_l d_l), a kernel for every coordinate l.

    Args:
        profile: kappa. distances: (n, M, N) d_l. amplitudes, lengthscales: (n,).

    Attributes:
        values: (n, M, N), detached.
    """

    def __init__(self, profile: Profile, distances: Tensor, amplitudes: Tensor, lengthscales: Tensor) -> None:
        self.distances, self.variances, self.rates = distances, amplitudes**2, lengthscales.pow(-2)
        scaled = distances * self.rates.detach()[:, None, None]
        self.kappa, self.slope = profile.derivatives(scaled, 1)
        self.values = self.variances.detach()[:, None, None] * self.kappa

    def inner(self, weights: Tensor) -> Tensor:
        """sum(weights * values) for weights (n, M, N), differentiable in the scales: scalar."""
        sums = (weights * self.kappa).sum((1, 2))
        slopes = (weights * self.slope).mul_(self.distances).sum((1, 2))
        return self.variances @ sums + (self.variances.detach() * slopes) @ _change(self.rates)


class JoinedKernel:
    """a_l^2 kappa(sum_l r_l d_l), one kernel of all coordinates with an amplitude for every component of the field.

    Args:
        profile: kappa. distances: (n, M, N) d_l. amplitudes: (k,) of the components. lengthscales: (n,).

    Attributes:
        values: (k, M, N), detached.
    """

    def __init__(self, profile: Profile, distances: Tensor, amplitudes: Tensor, lengthscales: Tensor) -> None:
        self.distances, self.variances, self.rates = distances, amplitudes**2, lengthscales.pow(-2)
        self.kappa, self.slope = profile.derivatives(torch.tensordot(self.rates.detach(), distances, dims=1), 1)
        self.values = self.variances.detach()[:, None, None] * self.kappa

    def inner(self, weights: Tensor) -> Tensor:
        """sum(weights * values) for weights (k, M, N), differentiable in the scales: scalar."""
        sums = weights.flatten(1) @ self.kappa.flatten()
        pooled = torch.tensordot(self.variances.detach(), weights, dims=1).mul_(self.slope)
        return self.variances @ sums + (self.distances.flatten(1) @ pooled.flatten()) @ _change(self.rates)


class SumOfKernels:
    """The sum of such kernels; attributes and methods as theirs."""

    def __init__(self, terms: Sequence[SeparateKernels | JoinedKernel]) -> None:
        self.terms = terms
        self.values = reduce(torch.add, [term.values for term in terms])

    def inner(self, weights: Tensor) -> Tensor:
        """sum(weights * values), differentiable in the scales: scalar."""
        return reduce(torch.add, [term.inner(weights) for term in self.terms])


def _change(rates: Tensor) -> Tensor:
    """Zero, with the derivative one by the rates."""
    return rates - rates.detach()
