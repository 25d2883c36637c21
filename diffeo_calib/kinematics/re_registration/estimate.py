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
from diffeo_calib.process.factor import Factor
from diffeo_calib.regression.regions import OTHER_DATE, region_scale
from diffeo_calib.robots.placement import PLACES

MAX_STEPS = 100
SETTLED = 1e-9
"""The iteration ends with a step below this, m and rad."""
SETTLED_WEIGHT = 1e-6
FREEDOM = 4.0
"""Degrees of freedom nu of Student's t: errors of real robots have heavy tails, which few rows cannot average out."""
PRIOR_FREEDOM = 10.0
"""The model's own covariance counts as an estimate of the scale with so many degrees of freedom."""
FALSE_ALARM_PROBABILITY = 0.001
"""Probability that clean rows have an outlier."""
MOST_PAIRS = 800


@dataclass(frozen=True, eq=False)
class Estimate:
    """The best place under one prior, and what the rows say about it.

    Args:
        place: where rows, frame and body are linearised. weights: (M,) of the rows.
        metres: prior deviation of the body from its old place, m.
        opened: whether B is the covariance of that place by the fit, or zero.
    """

    place: Place
    weights: Tensor
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
        """(M m, M m), the covariance of doubted rows enlarged, what is not free as an earlier registration knows it."""
        own, M = self.place.session, len(self.weights)
        Z = own.shared.flatten(0, 1)
        held = self.place.by_unknowns.flatten(0, 1) * ~own.free
        V = self.place.C + torch.block_diag(*own.noise) + Z @ Z.mT + held @ own.earlier @ held.mT
        V = 0.5 * (V + V.mT)
        return V + torch.block_diag(*(row_blocks(V, M) * (doubt(self.weights) - 1.0)[:, None, None]))

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
    def usual_blocks(self) -> Tensor:
        """(M, m, m) the covariance of each row, as if none was doubted."""
        return row_blocks(self.V, len(self.weights)) / doubt(self.weights)[:, None, None]

    @cached_property
    def gain(self) -> Tensor:
        """A (f, M m)."""
        weighted = torch.linalg.solve(self.place.session.noise / self.weights[:, None, None], self.S)  # (M, m, f)
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

    @property
    def student_t_weights(self) -> Tensor:
        """(M,) weights of Student's t: (nu + m) / (nu + r^T V^-1 r) of each row's residual after the step."""
        left = self.left[..., None]
        squares = (left.mT @ torch.linalg.solve(self.usual_blocks, left))[:, 0, 0]
        return (FREEDOM + self.visible.sum(1)) / (FREEDOM + squares)

    @property
    def log_evidence(self) -> float:
        """log N(r; S mu, K)."""
        return self.factor.log_density(self.target, self.solved)

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
        covariance = row_blocks(whole, M) - row_blocks(self.V, M) + self.usual_blocks  # a new row is not doubted
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


def doubt(weights: Tensor) -> Tensor:
    """Factors (M,), one or more, by which rows of these weights vary more than model and noise lead to expect.

    A row that fits well has a weight above one, and is no better known for that. What a row varies more is its own, so
    that errors of the model which rows share keep their covariance C: with less of them the covariance of a prediction
    would not be positive.
    """
    return (1.0 / weights).clamp(min=1.0)


def row_blocks(V: Tensor, rows: int) -> Tensor:
    """The blocks (M, m, m) of a matrix (M m, M m) on its diagonal."""
    each = torch.arange(rows, device=V.device)
    return V.view(rows, -1, rows, len(V) // rows)[each, :, each]


def estimate(start: Place, metres: float, weights: Tensor | None = None) -> Estimate:
    """The better estimate with B and without, by errors of rows left out, of which those that fit badly count less.

    Args:
        start: where to begin. metres: prior deviation of the markers from their old places, m.
        weights: (M,) of the rows; by default those of Student's t, by iteration.
    """

    def left_out(found: Estimate) -> float:
        squares, counts = found.left_out.square().nanmean(1), found.weights.clamp(max=1.0)
        return float((counts * squares).nansum() / counts.sum())

    session = start.session
    known_well = max(metres**2, float(session.fitted.new_noise.diagonal().mean()))
    may = float(session.by_fit.diagonal().max()) > known_well and bool(session.free[6:].any())
    return min((_estimate(start, metres, weights, opened=opened) for opened in (True, False)[: 1 + may]), key=left_out)


def _estimate(place: Place, metres: float, weights: Tensor | None, *, opened: bool) -> Estimate:
    """Gauss-Newton from a start; arguments as of :func:`estimate`."""
    given = place.C.new_ones(len(place.points)) if weights is None else weights
    for _ in range(MAX_STEPS):
        found = Estimate(place, given, metres, opened)
        again = given if weights is not None else found.student_t_weights
        if float(found.step.abs().max()) < SETTLED and float((again - given).abs().max()) < SETTLED_WEIGHT:
            if place.exact:
                break
            place = Place.of(place.session, place.T, place.body, place.C)
            continue
        step = place.C.new_zeros(len(place.session.free)).index_copy(0, found.free, found.step)
        place, given = place.stepped(step), again
    return found
