"""Find where the measuring device stands and where the markers sit, from a few rows and a calibrated model.

With everything else kept, the rows y_i see the model through a small motion D(u) of the measuring frame and of the
markers, after a start in closed form (robots/placement.py): T^-1 y_i - k1(q_i; m) are the residuals of linear_rows.py.

Leaving rows J out lowers their quadratic form by mu_J^T (K^-1)_JJ^-1 mu_J. Compared with what remains, this is an F
test (externally studentised residuals), so that an outlier does not hide itself. Single rows are tried first, then
pairs, which may hide each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import nan

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.re_registration.linear_rows import LinearRows, NewDate
from diffeo_calib.kinematics.re_registration.session import Session
from diffeo_calib.maps.noise import measured_coordinates
from diffeo_calib.measurements.poses import own_blocks
from diffeo_calib.regression.regions import OTHER_DATE, region_scale
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import rotation, transforms

MAX_STEPS = 100
SMALL_STEP = 1e-2
"""Below such a step of the markers, m, C hardly changes."""
SETTLED = 1e-9
"""The iteration ends with a step below this, m and rad."""
PRIOR_FREEDOM = 10.0
"""The model's own covariance counts as an estimate of the scale with so many degrees of freedom."""
FALSE_ALARM_PROBABILITY = 0.001
"""Probability that clean rows have an outlier."""
MOST_PAIRS = 800


@dataclass(frozen=True, eq=False)
class Estimate:
    """A frame T (4, 4), m, and markers on their tips, and what the rows say from there.

    Args:
        metres: prior deviation of the markers from their old places. date: the rows, seen from there.
    """

    session: Session
    metres: float
    T: Tensor
    date: NewDate

    @classmethod
    def at(cls, session: Session, metres: float, T: Tensor, markers: Tensor) -> Estimate:
        """With the markers (P, 3) there, m."""
        visible, free = measured_coordinates(session.noise), session.free
        date = NewDate(
            fitted=session.fitted,
            points=FlangePoints(session.nominal, markers, same=session.same),
            q=session.data.q,
            y=session.seen(T).flatten(1).nan_to_num(0.0),
            noise=session.noise,
            visible=visible,
            shared=session.shared,
            deviations=free * markers.new_tensor([PLACES.sought_base_m_rad] * 6 + [metres] * (len(free) - 6)),
            centre=session.centre,
            observe=None,
        )
        return cls(session, metres, T, date)

    @property
    def markers(self) -> Tensor:
        """(P, 3) m."""
        return self.date.points.points

    def settled(self, metres: float) -> Estimate:
        """The best one under a prior, by Gauss-Newton."""
        found, centre = Estimate.at(self.session, metres, self.T, self.markers), self.session.centre
        found = replace(found, date=self.date.changed(deviations=found.date.deviations))
        for _ in range(MAX_STEPS):
            step = centre.new_zeros(len(self.session.free)).index_copy(0, self.free, found.rows.step)
            if float(step.abs().max()) < SETTLED:
                break
            turn, before = rotation(step[3:6]), found.date
            T = found.T @ transforms(turn, centre + step[:3] - turn @ centre)
            found = Estimate.at(self.session, metres, T, found.markers + step[6:].view(-1, 3))
            if float(step[6:].abs().max()) < SMALL_STEP:
                vars(found.date)["fit_covariance"] = before.fit_covariance
        return found

    @cached_property
    def free(self) -> Tensor:
        """(k,) numbers of the unknowns that are free."""
        return self.session.free.nonzero()[:, 0]

    @cached_property
    def rows(self) -> LinearRows:
        """By the free unknowns; what is held is as an earlier registration knows it."""
        own, date, both = self.session, self.date, (self.free[:, None], self.free)
        Z, held = date.shared.flatten(0, 1), date.by_places.flatten(0, 1) * ~own.free
        return LinearRows(
            residual=date.residual,
            S=date.by_places[..., self.free],
            C=date.fit_covariance + Z @ Z.mT + held @ own.earlier @ held.mT,
            noise=date.noise,
            visible=date.visible,
            prior=(own.earlier + torch.diag(date.deviations.square()))[both],
            mean=torch.cat([own.centre.new_zeros(6), (own.old - self.markers).flatten()])[self.free],
            by_fit=own.by_fit[both],
        )

    @cached_property
    def inflation(self) -> float:
        """Factor on all variances, one or more, with which 95 % regions hold the rows as predicted by all others."""
        markers, errors = self.rows.S.shape[1] // 3, self.rows.left_out.unflatten(1, (-1, 3))
        covariance = own_blocks(torch.linalg.inv(self.rows.precisions), markers)
        away = errors.nan_to_num(0.0)[..., None]
        squares = (away.mT @ torch.linalg.solve(covariance, away))[..., 0, 0]
        squares = squares.masked_fill(errors.isnan().any(2), nan)
        return max(1.0, region_scale(squares, 3, torch.full_like(squares, 1.0 / markers), OTHER_DATE))

    def scale(self, falls: Tensor | float = 0.0, coordinates: Tensor | int = 0) -> tuple[Tensor, Tensor]:
        """Square of the residuals' scale in units of what model and noise lead to expect, and degrees of freedom.

        Args:
            falls: of the quadratic form by rows that are left out. coordinates: how many these have.
        """
        rows = self.rows
        determined = len(self.free) - torch.cholesky_inverse(rows.factor.B).trace()
        freedom = (rows.visible.sum() - coordinates - determined).clamp(min=0.0) + PRIOR_FREEDOM
        return ((rows.target @ rows.solved.flatten() - falls).clamp(min=0.0) + PRIOR_FREEDOM) / freedom, freedom

    def worst_rows(self) -> list[int]:
        """The one or two rows that contradict all others, or none."""
        from scipy.special import fdtrc  # noqa: PLC0415  # slow to import, not needed to use a model

        (M, m), visible = self.rows.residual.shape, self.rows.visible
        for size in (1, 2):
            sets = torch.combinations(torch.arange(M, device=visible.device), size)
            if M - size < 3 or len(sets) > MOST_PAIRS:
                continue
            at = (sets[..., None] * m + torch.arange(m, device=sets.device)).flatten(1)  # (K, size m)
            blocks, chosen = self.rows.factor.inverse[at[:, :, None], at[:, None, :]], self.rows.solved.flatten()[at]
            falls = (chosen * torch.linalg.solve(blocks, chosen[..., None])[..., 0]).sum(1)
            coordinates = visible.sum(1)[sets].sum(1).to(falls)
            variances, freedom = self.scale(falls, coordinates)
            numbers = (each.numpy(force=True) for each in (coordinates, freedom, falls / coordinates / variances))
            chances = fdtrc(*numbers)
            best = int(np.lexsort((-falls.numpy(force=True), chances))[0])  # of equal chances the largest fall
            if chances[best] * len(sets) < FALSE_ALARM_PROBABILITY:
                return sets[best].tolist()
        return []
