"""What accepted rows say about other rows, kept up to date one row at a time.

With y = G c + noise the tangent model of rows (calibration/scales/tangent_data.py) and L L^T = K + R of the accepted
ones, a row with covariances C = K(accepted, row) is known through V = L^-1 C:

    error = y - V^T L^-1 y_accepted,    covariance = K(row, row) + R - V^T V,

and taking it in appends (V^T, cholesky(covariance)) to L: one triangular solution per row, no factorisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.regression.conditional import NOISE_ADVICE


@dataclass(frozen=True, eq=False)
class Rows:
    """N rows of the tangent model, or places where it is asked.

    Args:
        at: first-order response of what they report. shared: (N, m, c) effects of devices of unit variance, m.
        noise: (N, m, m) m^2. target: (N, m) m. visible: (N, m) boolean: the numbers that exist.
    """

    at: Linearisation
    shared: Tensor
    noise: Tensor
    target: Tensor
    visible: Tensor

    @classmethod
    def of(cls, data: TangentData, scales: Hyperparameters) -> Rows:
        """Measured rows."""
        shared = data.y.new_zeros(*data.y.shape, 0) if data.shared is None else data.shared
        return cls(data.linearisation(scales), shared, data.weighted_noise(scales), data.target, data.visible)

    def __len__(self) -> int:
        return len(self.target)

    def rows(self, index: Tensor) -> Rows:
        """Some of them."""
        own = self.shared, self.noise, self.target, self.visible
        return Rows(self.at.rows(index), *(part[index] for part in own))

    @classmethod
    def joined(cls, first: Rows, second: Rows) -> Rows:
        """Two groups, in order."""
        own = [(one.shared, one.noise, one.target, one.visible) for one in (first, second)]
        return cls(Linearisation.joined([first.at, second.at]), *(torch.cat(pair) for pair in zip(*own, strict=True)))

    def covariance(self, other: Rows) -> Tensor:
        """Prior covariance of the numbers that exist: (R, R'), m^2."""
        whole = self.at.gram(other.at) + self.shared.flatten(0, 1) @ other.shared.flatten(0, 1).T
        return whole[self.visible.flatten()][:, other.visible.flatten()]

    @property
    def values(self) -> Tensor:
        """(R,) the targets that exist, m."""
        return self.target[self.visible]

    @property
    def noises(self) -> Tensor:
        """(R, R) their noise, m^2."""
        seen = self.visible.flatten()
        return torch.block_diag(*self.noise)[seen][:, seen]

    @property
    def owner(self) -> Tensor:
        """(R,) the row of each number that exists."""
        return self.visible.nonzero()[:, 0]


class Seen(NamedTuple):
    """Rows as the accepted ones predict them.

    Args:
        rows: they. white: V (S, R). error: (R,) measured minus predicted, m. covariance: (R, R) with noise, m^2.
    """

    rows: Rows
    white: Tensor
    error: Tensor
    covariance: Tensor


class Posterior:
    """The posterior by accepted rows.

    Args:
        rows: the accepted rows. asked: groups of places whose covariances are followed.

    Attributes:
        known: (Z, Z) covariance at these places, m^2.
    """

    def __init__(self, rows: Rows, asked: Sequence[Rows]) -> None:
        self.rows, self.asked = rows, asked
        self._factor = _cholesky(rows.covariance(rows) + rows.noises)
        self._size = len(self._factor)
        self._values = self._solved(rows.values[:, None])[:, 0]
        self._of_asked = self._solved(self._with_asked(rows))
        self.known = torch.cat([self._with_asked(one) for one in asked]) - self._of_asked.T @ self._of_asked

    def see(self, rows: Rows, white: Tensor | None = None) -> Seen:
        """Rows as they are predicted; ``white``: V if it is known."""
        V = self._solved(self.rows.covariance(rows)) if white is None else white
        return Seen(rows, V, rows.values - V.T @ self._values, rows.covariance(rows) + rows.noises - V.T @ V)

    def between(self, seen: Seen) -> Tensor:
        """Covariance (R, Z) of rows and the places asked, m^2."""
        return self._with_asked(seen.rows) - seen.white.T @ self._of_asked

    def take(self, seen: Seen, later: Seen) -> Tensor:
        """Take rows in; returns V of later rows afterwards."""
        low, cross = _cholesky(seen.covariance), seen.rows.covariance(later.rows) - seen.white.T @ later.white
        asked, added, size = self.between(seen), len(low), self._size
        of_asked = torch.linalg.solve_triangular(low, asked, upper=False)
        values = torch.linalg.solve_triangular(low, seen.error[:, None], upper=False)[:, 0]
        self._make_room(size + added)
        self._factor[size : size + added, :size] = seen.white.T
        self._factor[size : size + added, size : size + added] = low
        self._size += added
        self._values = torch.cat([self._values, values])
        self._of_asked = torch.cat([self._of_asked, of_asked])
        self.known = self.known - of_asked.T @ of_asked
        self.rows = Rows.joined(self.rows, seen.rows)
        return torch.cat([later.white, torch.linalg.solve_triangular(low, cross, upper=False)])

    def _with_asked(self, rows: Rows) -> Tensor:
        """Prior covariance (R, Z) with the places asked, m^2."""
        return torch.cat([rows.covariance(one) for one in self.asked], 1)

    def _solved(self, values: Tensor) -> Tensor:
        factor = self._factor[: self._size, : self._size]
        return torch.linalg.solve_triangular(factor, values, upper=False)

    def _make_room(self, size: int) -> None:
        if size > len(self._factor):
            whole = self._factor.new_zeros(2 * size, 2 * size)
            whole[: self._size, : self._size] = self._factor[: self._size, : self._size]
            self._factor = whole


def _cholesky(matrix: Tensor) -> Tensor:
    factor, info = torch.linalg.cholesky_ex(0.5 * (matrix + matrix.T))
    if int(info):
        raise NumericalError.of("the covariance of the rows is not positive definite", fix=NOISE_ADVICE)
    return factor


class Part(NamedTuple):
    """Errors and their covariance given others: e (R,), m; S (R, R), m^2."""

    error: Tensor
    covariance: Tensor


def given(error: Tensor, covariance: Tensor, wanted: Tensor, known: Tensor) -> Part:
    """Some numbers of a Gaussian given others: masks (R,) of both."""
    cross = covariance[wanted][:, known]
    gain = torch.linalg.solve(covariance[known][:, known], cross.T).T if bool(known.any()) else cross
    return Part(error[wanted] - gain @ error[known], covariance[wanted][:, wanted] - gain @ cross.T)
