"""Rows of a new set-up beside a fitted model, to first order: what is open since, and what may have drifted.

    r = S u + e + noise,    u ~ N(mu, P),    cov(e) = C,    cov(noise) = R,

r measured minus predicted, u shifts of devices and markers, C the posterior covariance of the fit and of whatever has
drifted since. With V = C + R and K = V + S P S^T their evidence is that of N(S mu, K), and rows J left out are off
their prediction by (K^-1)_JJ^-1 mu_J with mu = K^-1 (r - S mu).

Places are where the rows fit best, weighed by the noise alone:

    u = mu + A (r - S mu),    A = ((P + B)^-1 + S^T R^-1 S)^-1 S^T R^-1,    U = (1 - A S) P (1 - A S)^T + A V A^T.

B is the covariance of the markers' old places by the fit, a part of C, where the fit hardly knew them, as along the
axis of a tool that was never tilted: there the rows place a marker, though it stayed. R in place of V in the weights
costs 1 % where the model is right. Where the robot has changed since its fit, errors are not correlated as C says, and
weights by V do harm: on another series of a UR10 more rows hurt, and where the model is uncertain by centimetres, as
much is left in the rows, although another place explains it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.re_registration.registered_map import place_slopes, turned
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise, mean_block
from diffeo_calib.maps.observation import Observation
from diffeo_calib.measurements.poses import block_diagonal, own_blocks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.regression.conditional import diagonal_blocks
from diffeo_calib.regression.regions import OTHER_DATE, region_scale
from diffeo_calib.robots.se3 import rotation, transforms

if TYPE_CHECKING:
    from typing_extensions import Self

MAX_STEPS = 100
SMALL_STEP = 1e-2
"""Below such a step of the markers, m, C hardly changes."""
SETTLED = 1e-9
"""The search for places ends with a step below this, m and rad."""


@dataclass(frozen=True, eq=False)
class LinearRows:
    """M rows of R numbers and k unknowns."""

    residual: Tensor  # (M, R) r, m
    S: Tensor  # (M, R, k)
    C: Tensor  # (M R, M R), m^2
    noise: Tensor  # (M, R, R) blocks of R, m^2
    visible: Tensor  # (M, R) boolean, the numbers that were measured
    prior: Tensor  # (k, k) P
    mean: Tensor  # (k,) mu
    by_fit: Tensor  # (k, k) B

    @cached_property
    def slopes(self) -> Tensor:
        """(M R, k) S."""
        return self.S.flatten(0, 1)

    @cached_property
    def V(self) -> Tensor:
        """(M R, M R), m^2."""
        V = self.C + torch.block_diag(*self.noise)
        return 0.5 * (V + V.mT)

    @cached_property
    def target(self) -> Tensor:
        """(M R,) r - S mu."""
        return self.residual.flatten() - self.slopes @ self.mean

    @cached_property
    def factor(self) -> Factor:
        """Of K."""
        return Factor.of(self.V, self.slopes @ torch.linalg.cholesky(self.prior))

    @cached_property
    def solved(self) -> Tensor:
        """(M, R) K^-1 (r - S mu)."""
        return self.factor.solve(self.target[:, None]).view(self.residual.shape)

    @cached_property
    def precisions(self) -> Tensor:
        """(M, R, R) blocks of K^-1: of each row's error as the model and all other rows predict it."""
        return diagonal_blocks(self.factor.inverse, len(self.residual))

    @cached_property
    def left_out(self) -> Tensor:
        """(M, R) how far each row is from its prediction by the model and all other rows, m; NaN where hidden."""
        return self.shown(torch.linalg.solve(self.precisions, self.solved[..., None])[..., 0])

    def shown(self, values: Tensor) -> Tensor:
        """Values (M, R) or (M R,), NaN where hidden."""
        return values.view(self.residual.shape).masked_fill(~self.visible, nan)

    def log_evidence(self, scale: float = 1.0) -> float:
        """log N(r; S mu, scale K), but for a constant."""
        return self.factor.log_density(self.target, self.solved.flatten() / scale)

    @cached_property
    def gain(self) -> Tensor:
        """A (k, M R)."""
        weighted = torch.linalg.solve(self.noise, self.S)
        inverse = torch.linalg.inv(self.prior + self.by_fit) + (weighted.mT @ self.S).sum(0)
        return torch.linalg.solve(inverse, weighted.flatten(0, 1).mT)

    @property
    def step(self) -> Tensor:
        """u (k,)."""
        return self.mean + self.gain @ self.target

    @property
    def covariance(self) -> Tensor:
        """U (k, k)."""
        missed = torch.eye(len(self.prior), dtype=self.V.dtype, device=self.V.device) - self.gain @ self.slopes
        return missed @ self.prior @ missed.mT + self.gain @ self.V @ self.gain.mT

    @cached_property
    def after_placing(self) -> Tensor:
        """(M R, M R) what becomes of errors once everything is where the rows fit best, 1 - S A."""
        eye = torch.eye(len(self.slopes), dtype=self.V.dtype, device=self.V.device)
        return eye - self.slopes @ self.gain


@dataclass(frozen=True, eq=False)
class NewRows:
    """M rows of a new set-up in the frame of a fit: frame, markers and devices are open, and parts may have drifted."""

    fitted: FittedMap  # the map of the fit
    points: FlangePoints  # k0 of the markers where they are now, under the payloads of the rows
    transform: Tensor  # (4, 4) from the frame of the fit to that in which the rows were measured, m
    q: Tensor  # (M, n)
    y: Tensor  # (M, R) measured numbers, m; any where hidden
    noise: Tensor  # (M, R, R) m^2
    visible: Tensor  # (M, R) boolean, the numbers that were measured
    shared: Tensor  # (M, R, c) effects of errors of unit variance that they share, m
    # (6 + 3 P,) of the device's frame and of the markers' coordinates before the rows, m and rad; 0 of what has not
    # moved
    deviations: Tensor
    away: Tensor  # (6 + 3 P,) from here to where they are most probable before the rows
    known: Tensor  # (6 + 3 P, 6 + 3 P) their covariance by an earlier registration
    by_fit: Tensor  # (3 P, 3 P) B of the markers
    centre: Tensor  # (3,) about which the frame turns, m
    observe: Observation | None  # what was measured of the markers; None for their coordinates
    drifts: Tensor  # (M R, c) columns of unit variance of what has changed in the robot since, m

    def __len__(self) -> int:
        return len(self.q)

    @cached_property
    def seen(self) -> tuple[Tensor, Linearisation]:
        """The points (M, 3 P) by the fit, m, and their linearisation."""
        points, at = self.fitted.geodesic.with_nominal(self.points).linearised_value(self.q)
        return points.detach(), at

    @cached_property
    def slopes(self) -> Tensor:
        """(M, R, 3 P) of what was measured."""
        points, m = self.seen[0], self.seen[0].shape[1]
        eye = torch.eye(m, dtype=points.dtype, device=points.device).expand(len(points), m, m)
        return eye if self.observe is None else self.observe.slope(points).detach()

    @cached_property
    def at(self) -> Linearisation:
        """Linearised prediction of the fit for the measured numbers."""
        return self.seen[1] if self.observe is None else self.seen[1].projected(self.slopes)

    @cached_property
    def residual(self) -> Tensor:
        """(M, R) measured minus predicted, m; zero where hidden."""
        away = self.y - (self.seen[0] if self.observe is None else self.observe.value(self.seen[0]))
        return away.masked_fill(~self.visible, 0.0)

    @cached_property
    def by_places(self) -> Tensor:
        """(M, R, 6 + 3 P) derivatives by frame and markers."""
        deformation = self.fitted.geodesic.with_nominal(self.points)
        return self.slopes @ place_slopes(deformation, self.seen[1], self.seen[0], self.centre)

    @cached_property
    def fit_covariance(self) -> Tensor:
        """(M R, M R) posterior covariance of the fit at the rows, m^2."""
        return self.fitted.conditional.covariance_between(self.at)

    @property
    def weighted_noise(self) -> Tensor:
        """(M, R, R) covariance of the rows with their weights, m^2."""
        return self.noise

    @property
    def mean_noise(self) -> Tensor:
        """(R, R) covariance of a new measurement, m^2: that of the fit for points that no row shows."""
        found, unseen = mean_block(self.noise, self.visible), ~self.visible.any(0)
        both = unseen[:, None] & unseen
        return torch.where(both, self.fitted.new_noise, found) if bool(unseen.any()) else found

    @property
    def new_noise(self) -> Tensor:
        """(m, m) covariance of a new measurement in the new set-up, m^2."""
        return self.mean_noise

    @property
    def free(self) -> Tensor:
        """(k,) numbers of what may have moved of frame and markers."""
        return self.deviations.nonzero()[:, 0]

    @cached_property
    def given(self) -> LinearRows:
        """The rows by what may have moved and by the devices; what is held is as an earlier registration knows it."""
        free, c = self.free, self.shared.shape[2]
        both, held = (free[:, None], free), self.by_places.flatten(0, 1) * (self.deviations == 0)
        prior = (self.known + torch.diag(self.deviations.square()))[both]
        return LinearRows(
            residual=self.residual,
            S=torch.cat([self.by_places[..., free], self.shared], 2),
            C=self.fit_covariance + self.drifts @ self.drifts.T + held @ self.known @ held.T,
            noise=self.weighted_noise,
            visible=self.visible,
            prior=torch.block_diag(prior, torch.eye(c, dtype=prior.dtype, device=prior.device)),
            mean=pad(self.away[free], (0, c)),
            by_fit=pad(pad(self.by_fit, (6, 0, 6, 0))[both], (0, c, 0, c)),
        )

    @property
    def old_markers(self) -> Tensor:
        """(P, 3) where the markers are most probable before the rows, in the frames of their tips, m."""
        return self.points.points + self.away[6:].view(-1, 3)

    @property
    def inflation(self) -> float:
        """Factor on all variances, one or more, with which 95 % regions hold the rows as predicted by all others."""
        markers, away = self.y.shape[1] // 3, self.given.left_out.unflatten(1, (-1, 3))
        covariance = own_blocks(torch.linalg.inv(self.given.precisions), markers)
        errors = away.nan_to_num(0.0)[..., None]
        squares = (errors.mT @ torch.linalg.solve(covariance, errors))[..., 0, 0].masked_fill(away.isnan().any(2), nan)
        return max(1.0, region_scale(squares, 3, torch.full_like(squares, 1.0 / markers), OTHER_DATE))

    def changed(self, **changes: object) -> Self:
        """The same rows with another noise or prior; what does not change is kept."""
        other = replace(self, **changes)
        keep = "seen", "slopes", "at", "residual", "by_places", "fit_covariance"
        vars(other).update({name: vars(self)[name] for name in keep if name in vars(self)})
        return other

    def kept(self, index: Tensor) -> Self:
        """Some of the rows (k,)."""
        own: dict[str, Any] = {name: getattr(self, name)[index] for name in ("q", "y", "noise", "visible", "shared")}
        own["drifts"] = self.drifts.unflatten(0, self.y.shape)[index].flatten(0, 1)
        observe = None if self.observe is None else self.observe.rows(index)
        other = replace(self, **own, points=self.points.rows(index), observe=observe)
        points, at = self.seen
        vars(other).update(seen=(points[index], at.rows(index)), by_places=self.by_places[index])
        return other

    def moved(self, step: Tensor) -> Self:
        """The rows of coordinates around other places, after a step (6 + 3 P,) of frame and markers, m and rad."""
        turn, markers = rotation(step[3:6]), step[6:].view(-1, 3)
        motion = transforms(turn, self.centre + step[:3] - turn @ self.centre)
        other = replace(
            self,
            points=FlangePoints(self.points.fitted, self.points.points + markers, same=self.points.same),
            transform=self.transform @ motion,
            y=((self.y.unflatten(1, (-1, 3)) - motion[:3, 3]) @ turn).flatten(1),
            away=self.away - pad(step[6:], (6, 0)),
        )
        if "fit_covariance" in vars(self) and float(markers.abs().max()) < SMALL_STEP:
            vars(other)["fit_covariance"] = self.fit_covariance
        return other

    def settled(self) -> Self:
        """The rows of coordinates around the best places, by Gauss-Newton."""
        rows = self
        for _ in range(MAX_STEPS):
            step = rows.given.step[: len(rows.free)]
            if float(step.abs().max()) < SETTLED:
                break
            rows = rows.moved(step.new_zeros(len(self.deviations)).index_copy(0, rows.free, step))
        return rows


def noise_of_rows(fitted: FittedMap, new: Measurements, T: Tensor, block: Tensor, factor: float | None) -> Tensor:
    """(M, m, m) noise of new rows in the model's frame, m^2: a block, of poses by row; their own where it is larger.

    Poses err by shifts and turns, which displace their points as these stand: their deviations are those of usual rows,
    each row has modes of its own. A camera's distance from its board makes errors of turns large or small.

    Args:
        fitted: a fit. new: the rows. T: (4, 4) from the frame of the model to theirs, m. block: (m, m) of a row, m^2.
        factor: on the variances of poses of the fit; None where the fit or the rows have other bodies.
    """
    there = new.in_frames(torch.linalg.inv(T).expand(len(new), -1, -1))
    bodies, total = new.bodies, block.expand(len(new), -1, -1)
    known = factor is not None and fitted.slopes is None and bool(fitted.noise.visible.all())
    own, old = bodies.modes(there), bodies.modes_of(there, fitted.measured().unflatten(1, (-1, 3))) if known else None
    if own is not None and old is not None:
        blocks = own_blocks(fitted.noise.covariance, old.shape[1])  # (N, T, 9, 9)
        to_modes = torch.linalg.pinv(old)
        sizes = (to_modes @ blocks @ to_modes.mT).diagonal(dim1=2, dim2=3).median(0).values  # (T, 6)
        eye = torch.eye(old.shape[2], dtype=old.dtype, device=old.device)
        apart = eye - old @ to_modes
        slack = (apart @ blocks).diagonal(dim1=2, dim2=3).sum(2) / (old.shape[2] - old.shape[3])
        each = (own * sizes[:, None]) @ own.mT + slack.median(0).values[:, None, None] * eye
        total = factor * block_diagonal(each)
    return total if new.covariance is None else larger(total, turned(new.covariance, T[:3, :3].mT))


def typical_noise(noise: Noise) -> Tensor:
    """The block (m, m) of median size among the rows that show everything: outliers have larger ones.

    If no row does, the blocks of median size of every marker, as if their errors were independent.
    """
    whole = noise.visible.all(1)
    if bool(whole.any()):
        return _of_median_size(noise.covariance[whole])
    own, seen = own_blocks(noise.covariance, noise.visible.shape[1] // 3), noise.visible[:, ::3]
    return torch.block_diag(*[_of_median_size(own[seen[:, k], k]) for k in range(seen.shape[1])])


def _of_median_size(blocks: Tensor) -> Tensor:
    sizes = blocks.diagonal(dim1=1, dim2=2).sum(1)
    return blocks[int(sizes.argsort()[(len(sizes) - 1) // 2])]


def larger(first: Tensor, second: Tensor) -> Tensor:
    """A covariance (M, m, m) that is nowhere smaller than either of two."""
    values, vectors = torch.linalg.eigh(second - first)
    total = first + (vectors * values.clamp(min=0.0)[:, None]) @ vectors.mT
    return 0.5 * (total + total.mT)
