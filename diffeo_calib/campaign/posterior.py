"""Predictions of rows from the accepted ones, kept up to date one row at a time.

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

from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.process.scales import Hyperparameters
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
        asked: (R, Z) covariance with the places asked, m^2.
    """

    rows: Rows
    white: Tensor
    error: Tensor
    covariance: Tensor
    asked: Tensor

    @classmethod
    def joined(cls, first: Seen, second: Seen) -> Seen:
        """Two groups seen by the same rows, in order."""
        cross = first.covariance_with(second)
        covariance = torch.cat(
            [torch.cat([first.covariance, cross], 1), torch.cat([cross.T, second.covariance], 1)],
        )
        return cls(
            Rows.joined(first.rows, second.rows),
            torch.cat([first.white, second.white], 1),
            torch.cat([first.error, second.error]),
            covariance,
            torch.cat([first.asked, second.asked]),
        )

    def covariance_with(self, other: Seen) -> Tensor:
        """Covariance (R, R') with other rows, m^2."""
        return self.rows.covariance(other.rows) - self.white.T @ other.white

    def some(self, index: Tensor) -> Seen:
        """Some of the rows, in order."""
        mine = torch.isin(self.rows.owner, index)
        return Seen(
            self.rows.rows(index),
            self.white[:, mine],
            self.error[mine],
            self.covariance[mine][:, mine],
            self.asked[mine],
        )


class Factor:
    """L of the covariance L L^T of the accepted rows, to which rows are appended: L = (low, 0; below, corner).

    The solver copies what is not contiguous: `low` (n, n) is, and is never copied.
    """

    def __init__(self, covariance: Tensor) -> None:
        self._low = cholesky(covariance)
        self._below, self._corner = covariance.new_zeros(0, len(covariance)), covariance.new_zeros(0, 0)

    def solved(self, values: Tensor) -> Tensor:
        """L^-1 values (S, R)."""
        n = len(self._low)
        top = torch.linalg.solve_triangular(self._low, values[:n], upper=False)
        rest = values[n:] - self._below @ top
        return torch.cat([top, torch.linalg.solve_triangular(self._corner, rest, upper=False)])

    def append(self, white: Tensor, low: Tensor) -> None:
        """Append R rows: V (S, R), and the factor (R, R) of their covariance by those before."""
        n, right = len(self._low), low.new_zeros(len(self._corner), len(low))
        self._below = torch.cat([self._below, white[:n].T])
        self._corner = torch.cat([torch.cat([self._corner, right], 1), torch.cat([white[n:].T, low], 1)])


class Posterior:
    """The posterior by accepted rows.

    Args:
        rows: the accepted rows. asked: groups of places whose covariances are followed.

    Attributes:
        known: (Z, Z) covariance at these places, m^2.
    """

    def __init__(self, rows: Rows, asked: Sequence[Rows]) -> None:
        self.rows, self.asked = rows, asked
        self._factor = Factor(rows.covariance(rows) + rows.noises)
        self._values = self._factor.solved(rows.values[:, None])[:, 0]
        self._of_asked = self._factor.solved(self._with_asked(rows))
        self.known = torch.cat([self._with_asked(one) for one in asked]) - self._of_asked.T @ self._of_asked

    def see(self, rows: Rows) -> Seen:
        """Rows as they are predicted."""
        V = self._factor.solved(self.rows.covariance(rows))
        covariance = rows.covariance(rows) + rows.noises - V.T @ V
        asked = self._with_asked(rows) - V.T @ self._of_asked
        return Seen(rows, V, rows.values - V.T @ self._values, covariance, asked)

    def take(self, seen: Seen, later: Seen) -> Seen:
        """Take rows in; returns later rows as they are predicted afterwards."""
        low = cholesky(seen.covariance)
        cross, asked, values = (
            torch.linalg.solve_triangular(low, part, upper=False)
            for part in (seen.covariance_with(later), seen.asked, seen.error[:, None])
        )
        self._factor.append(seen.white, low)
        self._values = torch.cat([self._values, values[:, 0]])
        self._of_asked = torch.cat([self._of_asked, asked])
        self.known = self.known - asked.T @ asked
        self.rows = Rows.joined(self.rows, seen.rows)
        return Seen(
            later.rows,
            torch.cat([later.white, cross]),
            later.error - cross.T @ values[:, 0],
            later.covariance - cross.T @ cross,
            later.asked - cross.T @ asked,
        )

    def _with_asked(self, rows: Rows) -> Tensor:
        """Prior covariance (R, Z) with the places asked, m^2."""
        return torch.cat([rows.covariance(one) for one in self.asked], 1)


def cholesky(matrix: Tensor) -> Tensor:
    """The lower factor; NumericalError unless a covariance is positive definite."""
    factor, info = torch.linalg.cholesky_ex(0.5 * (matrix + matrix.T))
    if int(info):
        raise NumericalError.of("the covariance of the rows is not positive definite", fix=NOISE_ADVICE)
    return factor


def given(error: Tensor, covariance: Tensor, wanted: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Errors, m, and covariance, m^2, of some numbers of a Gaussian given others: masks (R,) of both."""
    cross = covariance[wanted][:, known]
    gain = torch.linalg.solve(covariance[known][:, known], cross.T).T if bool(known.any()) else cross
    return error[wanted] - gain @ error[known], covariance[wanted][:, wanted] - gain @ cross.T
