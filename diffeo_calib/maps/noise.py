"""Covariance of the measurements: one block per configuration, and shifts that several rows share."""

from __future__ import annotations

from copy import copy
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, NumericalError

HIDDEN_VARIANCE = 1e8  # variance, m^2, of a coordinate that was not measured: it carries no information


def measured_coordinates(covariance: Tensor) -> Tensor:
    """Which coordinates were measured, by their blocks (N, m, m), perhaps turned and weighed: (N, m) boolean."""
    return covariance.diagonal(dim1=1, dim2=2) < 1e-3 * HIDDEN_VARIANCE


def without_hidden(covariance: Tensor, visible: Tensor) -> Tensor:
    """Blocks (N, m, m) in which coordinates that are not visible, (N, m) boolean, carry no information."""
    both = visible[:, :, None] & visible[:, None, :]
    return covariance * both + torch.diag_embed(HIDDEN_VARIANCE * (~visible).to(covariance))


def mean_block(covariance: Tensor, visible: Tensor) -> Tensor:
    """The mean (m, m) of blocks (N, m, m), of every coordinate over the rows in which it is visible, (N, m) boolean.

    The scaled sum of positive definite matrices stays one, whatever is hidden where.
    """
    there = visible.to(covariance)
    roots = there.sum(0).clamp(min=1.0).rsqrt()
    total = torch.einsum("im,imk,ik->mk", there, covariance, there)
    return roots[:, None] * total * roots


class Noise:
    """R = blockdiag(R_i) + Z Z^T.

    A coordinate that was not measured has the variance ``HIDDEN_VARIANCE`` and no covariance with the other ones.

    Args:
        covariance: (N, m, m) blocks R_i, m^2.
        shared: (N, m, c) columns of Z, m: effects of c independent shifts of unit variance that rows share, such as
            the place of the measuring device in one session; none by default.

    Raises:
        InputError: a block is not symmetric positive definite.
    """

    def __init__(self, covariance: Tensor, shared: Tensor | None = None) -> None:
        self.covariance = covariance
        self.shared = covariance.new_zeros(*covariance.shape[:2], 0) if shared is None else shared
        factor, info = torch.linalg.cholesky_ex(covariance)
        deviations = covariance.diagonal(dim1=1, dim2=2).abs().sqrt()  # a correlation of rounding errors is none
        near = (covariance - covariance.mT).abs() <= 1e-9 * deviations[:, :, None] * deviations[:, None]
        bad = (info > 0) | ~near.flatten(1).all(1)
        if bool(bad.any()):
            raise InputError.of(
                "`noise`",
                expected="symmetric positive definite blocks (N, m, m) in m^2",
                got=f"{int(bad.sum())} invalid block(s), the first at row {int(bad.nonzero()[0])}",
            )
        self._factor = factor

    def to(self, device: torch.device | str) -> Noise:
        """Return the noise on a device."""
        moved = copy(self)
        moved.covariance, moved._factor = self.covariance.to(device), self._factor.to(device)
        moved.shared = self.shared.to(device)
        vars(moved).pop("_core", None)
        return moved

    def rows(self, rows: Tensor) -> Noise:
        """The noise of some configurations."""
        return Noise(self.covariance[rows], self.shared[rows])

    @property
    def visible(self) -> Tensor:
        """(N, m) boolean: the coordinates that were measured; all of them in units so small that none would be."""
        measured = measured_coordinates(self.covariance)
        return measured if bool(measured.any()) else ~measured

    @property
    def mean(self) -> Tensor:
        """The mean block (m, m) of what was measured, m^2."""
        return mean_block(self.covariance, self.visible)

    @property
    def own(self) -> Noise:
        """The blocks alone, without what rows share."""
        return Noise(self.covariance) if self.shared.shape[2] else self

    def solve(self, values: Tensor) -> Tensor:
        """R^-1 values: (N, m) or (N, m, k), of the same shape."""
        alone = torch.cholesky_solve(values.view(*values.shape[:2], -1), self._factor)
        if self.shared.shape[2]:
            inner = self.shared.flatten(0, 1).T @ alone.flatten(0, 1)
            shift = torch.cholesky_solve(inner, self._core)
            alone = alone - torch.cholesky_solve(self.shared @ shift, self._factor)
        return alone.view_as(values)

    def multiply(self, values: Tensor) -> Tensor:
        """R values: (N, m, k) -> (N, m, k)."""
        return self.covariance @ values + self.shared @ torch.einsum("imc,imk->ck", self.shared, values)

    def whiten(self, values: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """C_i^-1 values with R_i = C_i C_i^T, for all configurations or for ``rows``: (N, m, k) -> (N, m, k)."""
        return torch.linalg.solve_triangular(self._factor[rows], values, upper=False)

    def add_to(self, gram: Tensor) -> Tensor:
        """G + R: (N m, N m)."""
        n, m, _ = self.covariance.shape
        out, flat = gram.clone(), self.shared.flatten(0, 1)
        index = torch.arange(n, device=gram.device)
        out.view(n, m, n, m)[index, :, index, :] += self.covariance
        return out.addmm_(flat, flat.T) if flat.shape[1] else out

    @cached_property
    def _core(self) -> Tensor:
        """Cholesky factor of 1 + Z^T blockdiag(R_i)^-1 Z."""
        white = self.whiten(self.shared).flatten(0, 1)
        eye = torch.eye(white.shape[1], dtype=white.dtype, device=white.device)
        factor, info = torch.linalg.cholesky_ex(eye + white.T @ white)
        if int(info):
            raise NumericalError.of("what rows share is too large beside their noise", fix="raise `noise`")
        return factor
