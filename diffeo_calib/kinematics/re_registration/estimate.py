"""Find where the measuring device stands and where the markers sit, from a few rows and a calibrated model.

With everything else kept, the rows y_i see the model through a small motion D(u) of the measuring frame and of the
markers, after a start in closed form (robots/placement.py):

    T^-1 y_i - k1(q_i; m) = S_i u + e_i + noise_i,    cov(e_i, e_j) = C(q_i, q_j),

C the posterior covariance of the fit, R that of the noise, V = C + R. With a prior N(mu, P) of u,

    u = mu + A (r - S mu),    A = ((P + B)^-1 + S^T R^-1 S)^-1 S^T R^-1,    U = (1 - A S) P (1 - A S)^T + A V A^T.

B is the covariance of the markers' old places by the fit, a part of C: where the fit hardly knew a marker, as along the
axis of a tool that was never tilted, the rows place it, though it stayed; or zero. Errors of rows left out choose. R in
place of V in the weights costs 1 % where the model is right. Where the robot has changed since its fit, errors are not
correlated as C says, and weights by V do harm: on another series of a UR10 more rows hurt. The covariance U, the test
for outliers and the marginal likelihood take all of V.

Leaving rows J out lowers the quadratic form of the residuals by mu_J^T (K^-1)_JJ^-1 mu_J with K = V + S P S^T and
mu = K^-1 (r - S mu). Compared with what remains, this is an F test (externally studentised residuals), so that an
outlier does not hide itself. Single rows are tried first, then pairs, which may hide each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import nan

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.kinematics.re_registration.session import Place
from diffeo_calib.maps.noise import measured_coordinates
from diffeo_calib.measurements.pose_frames import own_blocks
from diffeo_calib.regression.factor import Factor
from diffeo_calib.regression.regions import OTHER_DATE, region_scale
from diffeo_calib.robots.placement import PLACES

MAX_STEPS = 100
SETTLED = 1e-9
"""The iteration ends with a step below this, m and rad."""
PRIOR_FREEDOM = 10.0
"""The model's own covariance counts as an estimate of the scale with so many degrees of freedom."""
FALSE_ALARM_PROBABILITY = 0.001
"""Probability that clean rows have an outlier."""
MOST_PAIRS = 800


@dataclass(frozen=True, eq=False)
class Estimate:
    """The best place under one prior, and what the rows say about it.

    Args:
        place: where rows, frame and body are linearised. metres: prior deviation of the body from its old place, m.
        opened: whether B is the covariance of that place by the fit, or zero.
    """

    place: Place
    metres: float
    opened: bool

    @property
    def residual(self) -> Tensor:
        """(M, m) r."""
        return self.place.residual

    @cached_property
    def visible(self) -> Tensor:
        """(M, m) boolean: the coordinates that were measured."""
        return measured_coordinates(self.place.session.noise)

    @cached_property
    def free(self) -> Tensor:
        """(f,) numbers of the unknowns that are free."""
        return self.place.session.free.nonzero()[:, 0]

    @cached_property
    def S(self) -> Tensor:
        """(M, m, f) by the free unknowns."""
        return self.place.by_unknowns[..., self.free]

    @cached_property
    def V(self) -> Tensor:
        """(M m, M m), with what is not free as an earlier registration knows it."""
        own = self.place.session
        Z = own.shared.flatten(0, 1)
        held = self.place.by_unknowns.flatten(0, 1) * ~own.free
        V = self.place.C + torch.block_diag(*own.noise) + Z @ Z.mT + held @ own.earlier @ held.mT
        return 0.5 * (V + V.mT)

    @cached_property
    def mean(self) -> Tensor:
        """(f,) mu."""
        back = self.place.body.from_old
        return torch.cat([back.new_zeros(6), -back])[self.free]

    @cached_property
    def prior(self) -> Tensor:
        """(f, f) P."""
        wide = self.V.new_full((6,), PLACES.sought_base_m_rad)
        deviations = torch.cat([wide, self.place.body.deviations(self.metres)])
        whole = self.place.session.earlier + torch.diag(deviations.square())
        return whole[self.free[:, None], self.free]

    @cached_property
    def target(self) -> Tensor:
        """(M m,) r - S mu."""
        return self.residual.flatten() - self.S.flatten(0, 1) @ self.mean

    @cached_property
    def factor(self) -> Factor:
        """Of K = V + S P S^T."""
        return Factor.of(self.V, self.S.flatten(0, 1) @ torch.linalg.cholesky(self.prior))

    @cached_property
    def solved(self) -> Tensor:
        """(M m,) K^-1 (r - S mu)."""
        return self.factor.solve(self.target[:, None])[:, 0]

    @cached_property
    def gain(self) -> Tensor:
        """A (f, M m)."""
        weighted = torch.linalg.solve(self.place.session.noise, self.S)  # (M, m, f)
        wide = self.prior + self.opened * self.place.session.by_fit[self.free[:, None], self.free]
        inverse = torch.linalg.inv(torch.linalg.inv(wide) + (weighted.mT @ self.S).sum(0))
        return inverse @ weighted.flatten(0, 1).mT

    @cached_property
    def covariance(self) -> Tensor:
        """U (f, f)."""
        missed = torch.eye(len(self.free), dtype=self.V.dtype, device=self.V.device) - self.gain @ self.S.flatten(0, 1)
        return missed @ self.prior @ missed.mT + self.gain @ self.V @ self.gain.mT

    @cached_property
    def step(self) -> Tensor:
        """u (f,)."""
        return self.mean + self.gain @ self.target

    @cached_property
    def left(self) -> Tensor:
        """(M, m) what remains of the residual after the step."""
        return self.residual - self.S @ self.step

    def log_evidence(self, scale: float = 1.0) -> float:
        """log N(r; S mu, scale K), but for a constant."""
        return self.factor.log_density(self.target, self.solved / scale)

    @cached_property
    def alone(self) -> Tensor:
        """(M, m, m) what makes the residual of each row one from the place that the others give."""
        own = self.S @ self.gain.view(len(self.free), len(self.S), -1).movedim(1, 0)
        return torch.linalg.inv(torch.eye(own.shape[1], dtype=own.dtype, device=own.device) - own)

    @cached_property
    def left_out(self) -> Tensor:
        """(M, m) how far every row is from its prediction by the model as the other rows place it, m.

        NaN where markers are hidden.
        """
        return (self.alone @ self.left[..., None])[..., 0].masked_fill(~self.visible, nan)

    @cached_property
    def inflation(self) -> float:
        """Factor on all variances, one or more, with which 95 % regions hold the rows as placed by all others.

        The errors that :attr:`left_out` has are linear in those of model and rows, so that their covariance is exact.
        """
        flat, (M, m) = self.S.flatten(0, 1), self.residual.shape
        to_error = torch.eye(M * m, dtype=flat.dtype, device=flat.device) - flat @ self.gain
        to_error = (self.alone @ to_error.view(M, m, -1)).flatten(0, 1)
        whole = to_error @ (self.V + flat @ self.prior @ flat.mT) @ to_error.mT
        covariance = row_blocks(whole, M)
        markers, errors = m // 3, self.left_out.unflatten(1, (-1, 3))
        away = errors.nan_to_num(0.0)[..., None]
        squares = (away.mT @ torch.linalg.solve(own_blocks(covariance, markers), away))[..., 0, 0]
        squares = squares.masked_fill(errors.isnan().any(2), nan)
        return max(1.0, region_scale(squares, 3, torch.full_like(squares, 1.0 / markers), OTHER_DATE))

    def scale(self, falls: Tensor | float = 0.0, coordinates: Tensor | int = 0) -> tuple[Tensor, Tensor]:
        """Square of the residuals' scale in units of what model and noise lead to expect, and degrees of freedom.

        Args:
            falls: of the quadratic form by rows that are left out. coordinates: how many these have.
        """
        determined = len(self.free) - torch.cholesky_inverse(self.factor.B).trace()
        freedom = (self.visible.sum() - coordinates - determined).clamp(min=0.0) + PRIOR_FREEDOM
        return ((self.target @ self.solved - falls).clamp(min=0.0) + PRIOR_FREEDOM) / freedom, freedom

    def worst_rows(self) -> list[int]:
        """The one or two rows that contradict all others, or none."""
        from scipy.special import fdtrc  # noqa: PLC0415  # slow to import, not needed to use a model

        M, m = self.residual.shape
        for size in (1, 2):
            sets = torch.combinations(torch.arange(M, device=self.V.device), size)
            if M - size < 3 or len(sets) > MOST_PAIRS:
                continue
            at = (sets[..., None] * m + torch.arange(m, device=sets.device)).flatten(1)  # (K, size m)
            blocks, chosen = self.factor.inverse[at[:, :, None], at[:, None, :]], self.solved[at]
            falls = (chosen * torch.linalg.solve(blocks, chosen[..., None])[..., 0]).sum(1)
            coordinates = self.visible.sum(1)[sets].sum(1).to(falls)
            variances, freedom = self.scale(falls, coordinates)
            numbers = (each.numpy(force=True) for each in (coordinates, freedom, falls / coordinates / variances))
            chances = fdtrc(*numbers)
            best = int(np.lexsort((-falls.numpy(force=True), chances))[0])  # of equal chances the largest fall
            if chances[best] * len(sets) < FALSE_ALARM_PROBABILITY:
                return sets[best].tolist()
        return []


def row_blocks(V: Tensor, rows: int) -> Tensor:
    """The blocks (M, m, m) of a matrix (M m, M m) on its diagonal."""
    each = torch.arange(rows, device=V.device)
    return V.view(rows, -1, rows, len(V) // rows)[each, :, each]


def estimate(start: Place, metres: float) -> Estimate:
    """The better estimate with B and without, by errors of rows left out.

    Args:
        start: where to begin. metres: prior deviation of the markers from their old places, m.
    """
    session = start.session
    known_well = max(metres**2, float(session.fitted.new_noise.diagonal().mean()))
    may = float(session.by_fit.diagonal().max()) > known_well and bool(session.free[6:].any())
    found = [_estimate(start, metres, opened=opened) for opened in (True, False)[: 1 + may]]
    return min(found, key=lambda each: float(each.left_out.square().nanmean()))


def _estimate(place: Place, metres: float, *, opened: bool) -> Estimate:
    """Gauss-Newton from a start; arguments as of :func:`estimate`."""
    for _ in range(MAX_STEPS):
        found = Estimate(place, metres, opened)
        if float(found.step.abs().max()) >= SETTLED:
            place = place.stepped(place.C.new_zeros(len(place.session.free)).index_copy(0, found.free, found.step))
        elif place.exact:
            break
        else:
            place = Place.of(place.session, place.T, place.body, place.C)
    return found
