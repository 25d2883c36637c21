"""New rows as a calibrated model expects them: residuals, and their covariance. Everything is in the model's frame.

    r = y - k1(q; m) = S u + e + noise,    cov(r) = C(q, q) + S diag(sd^2) S^T + R,

C the posterior covariance of the old fit, u the errors of the place of the measuring device and of the markers, which
a registration has found (kinematics/re_registration), sd their prior deviations, R the noise of the old rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.noise_model import NoiseModel, pose_modes
from diffeo_calib.calibration.student_t import Tails, region_factor, reweight
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.flange_points import FlangePoints
from diffeo_calib.kinematics.re_registration.registered_map import frame_slopes, marker_slopes
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.measurements.table import Measurements

BASE_DEVIATION = 0.1
"""Prior standard deviation of the measuring device around its registration, m and rad: no constraint."""
PRIOR_ROWS = 20.0
"""Rows that count as much as the prior belief that the old scales hold for a new session."""
ROUNDS = 20
WEIGHT_CHANGE = 0.01
"""Largest relative change of a weight at which it has converged."""


@dataclass(frozen=True, eq=False)
class NewRows:
    """Rows of a new set-up, brought into the frame of the old model.

    Args:
        q: (M, n) configurations. y: (M, m) measured coordinates, m; as predicted where markers are hidden.
        noise_model: how they were measured.
        fitted: the old model. points: the nominal map of the registered markers.
        noise: (M, m, m) covariance of the rows, m^2. marker_deviation: prior of the markers around their place, m.
        tails: weights of the rows.
    """

    q: Tensor
    y: Tensor
    noise_model: NoiseModel
    fitted: FittedMap
    points: FlangePoints
    noise: Tensor
    marker_deviation: float
    tails: Tails

    @classmethod
    def of(
        cls, new: Measurements, T: Tensor, fitted: FittedMap, points: FlangePoints, marker_deviation: float
    ) -> NewRows:
        """The rows with the noise of a typical old row, or their own where it is larger, all weights 1.

        Args:
            new: the rows in the new measuring frame. T: (4, 4) leads there from the old one, m.
            fitted, points, marker_deviation: see the class.
        """
        noise = typical_noise(fitted.noise).expand(len(new), -1, -1)
        if new.covariance is not None:
            turn = torch.block_diag(*[T[:3, :3]] * new.markers)
            noise = larger(noise, turn.mT @ new.covariance @ turn)
        frames = None if new.frames is None else torch.linalg.inv(T) @ new.frames
        modes = pose_modes(frames, new.lever, new.board)
        y = ((new.points - T[:3, 3]) @ T[:3, :3]).flatten(1)
        sensor = replace(NoiseModel.of(new, 0.0), known=None, modes=modes)
        visible = sensor.visible
        tails = Tails.none(len(new), sensor.bodies, device=new.q.device)
        if visible is not None:
            y = torch.where(y.isnan(), fitted.geodesic.with_nominal(points)(new.q).detach(), y)
            noise = without_hidden(noise, sensor.coordinates(y))
        return cls(new.q, y, sensor, fitted, points, noise, marker_deviation, tails)

    def __len__(self) -> int:
        return len(self.q)

    @cached_property
    def _seen(self) -> tuple[Tensor, Linearisation]:
        return self.fitted.geodesic.with_nominal(self.points).linearised_value(self.q)

    @property
    def at(self) -> Linearisation:
        """The old model, linearised at the rows."""
        return self._seen[1]

    @cached_property
    def residual(self) -> Tensor:
        """(M, m) measured minus predicted, m."""
        return self.y - self._seen[0]

    @cached_property
    def centre(self) -> Tensor:
        """(3,) the middle of the rows, m."""
        return self._seen[0].unflatten(1, (-1, 3)).flatten(0, 1).mean(0)

    @cached_property
    def shifts(self) -> Tensor:
        """(M, m, 6 + 3 P) effect of device and markers, each with unit prior variance, m."""
        places = self._seen[0].unflatten(1, (-1, 3))
        around = {"centre": self.centre, "marker_deviation": self.marker_deviation}
        return device_shifts(self.fitted, self.points, self.q, places=places, **around)

    @cached_property
    def posterior(self) -> Tensor:
        """(M m, M m) covariance of the old model at the rows, device and markers free, m^2."""
        flat = self.shifts.flatten(0, 1)
        total = self.fitted.covariance_between(self.at) + flat @ flat.T
        return 0.5 * (total + total.T)

    @property
    def weighted_noise(self) -> Tensor:
        """(M, m, m) covariance of the rows with their weights, m^2."""
        return self.noise_model.weighted(self.noise, self.tails)

    @cached_property
    def covariance(self) -> Tensor:
        """(M m, M m) of the residuals, m^2."""
        return Noise(self.weighted_noise).add_to(self.posterior)

    @property
    def log_evidence(self) -> float:
        """log N(r; 0, covariance), but for a constant."""
        factor, r = torch.linalg.cholesky(self.covariance), self.residual.flatten()[:, None]
        white = torch.linalg.solve_triangular(factor, r, upper=False)
        return float(-0.5 * white.square().sum() - factor.diagonal().log().sum())

    def with_weights(self) -> NewRows:
        """The same rows with the weights of Student's t, by expectation maximisation."""
        rows = self
        for _ in range(ROUNDS):
            tails = reweight(rows._expected_squares(), rows.noise_model.freedom)
            change = float((tails.weights / rows.tails.weights - 1.0).abs().max())
            rows = rows.changed(tails=tails)
            if change < WEIGHT_CHANGE:
                break
        return rows

    def kept(self, index: Tensor) -> NewRows:
        """Some of the rows."""
        own = {"q": self.q[index], "y": self.y[index], "noise_model": self.noise_model.rows(index)}
        return replace(self, **own, noise=self.noise[index], tails=self.tails.rows(index))

    def if_drifting(self, roots: list[Tensor]) -> NewRows:
        """The rows where parts with these covariances drift, with weights that hold then: a change is no outlier.

        Args:
            roots: (M, m, c) columns of each part's covariance, m.
        """
        together = torch.cat(roots, 2).flatten(0, 1)
        return self.with_posterior(self.posterior + together @ together.T).with_weights()

    def with_posterior(self, posterior: Tensor) -> NewRows:
        """The same rows with another covariance (M m, M m) without noise, m^2."""
        other = self.changed()
        vars(other)["posterior"] = posterior
        return other

    def changed(self, **changes: object) -> NewRows:
        """The same rows with other noise, weights or deviation of the markers; what does not change is kept."""
        other = replace(self, **changes)
        keep = ("_seen", "residual", *(() if "marker_deviation" in changes else ("shifts", "posterior")))
        vars(other).update({name: vars(self)[name] for name in keep if name in vars(self)})
        return other

    @property
    def left_out(self) -> Tensor:
        """(M, m) how far each row is from its prediction by the old model and the other rows, m; NaN where hidden."""
        inverse, own = self._inverse()
        mu = (inverse @ self.residual.flatten()).view(*self.y.shape, 1)
        errors = torch.linalg.solve(own, mu)[..., 0]
        return errors.masked_fill(~self.noise_model.coordinates(errors), nan)

    @property
    def inflation(self) -> float:
        """Factor on all variances with which 95 % regions hold rows that took no part, at least one.

        The scales were chosen for another session, with few rows of other places, temperatures or loads. The factor is
        the mean of the squared leave-one-out errors of these rows in units of their predicted covariance, with a prior
        around one that counts as much as :data:`PRIOR_ROWS` rows, and the width of Student's t for its uncertainty. All
        coordinates of a row count as one, for they err together.
        """
        inverse, own = self._inverse()
        mu = (inverse @ self.residual.flatten()).view(*self.y.shape, 1)
        covariance = torch.linalg.inv(own)
        error = covariance @ mu
        squares = self.noise_model.squares(covariance - self.weighted_noise + self.noise, error @ error.mT)
        each = squares / self.noise_model.of_freedom(float, squares)
        rows = float((self.tails.weights * each).nanmean(1).sum())
        freedom = PRIOR_ROWS + len(self)
        return max(1.0, (PRIOR_ROWS + rows) / freedom * region_factor(freedom, 3))

    def _inverse(self) -> tuple[Tensor, Tensor]:
        """covariance^-1 (M m, M m) and its blocks (M, m, m)."""
        M, m = self.y.shape
        inverse, index = torch.linalg.inv(self.covariance), torch.arange(M, device=self.y.device)
        return inverse, inverse.view(M, m, M, m)[index, :, index, :]

    def _expected_squares(self) -> Tensor:
        """Expected squared distances of the errors in units of the noise without weights: (M, bodies)."""
        noise = self.weighted_noise
        inverse, own = self._inverse()
        mu = (inverse @ self.residual.flatten()).view(*self.y.shape, 1)
        error = noise @ mu
        return self.noise_model.squares(self.noise, error @ error.mT + noise - noise @ own @ noise)


def device_shifts(
    fitted: FittedMap, points: FlangePoints, q: Tensor, *, places: Tensor, centre: Tensor, marker_deviation: float
) -> Tensor:
    """Effect of shifts and turns of the measuring device about a centre, and of the markers on the flange.

    Args:
        fitted: the map. points: nominal map of the markers. q: (N, n). places: (N, P, 3) where they are, m.
        centre: (3,) m. marker_deviation: prior standard deviation, m.

    Returns:
        (N, 3 P, 6 + 3 P) columns of unit prior variance, m.
    """
    frame = BASE_DEVIATION * frame_slopes(places, centre)
    return torch.cat([frame, marker_deviation * marker_slopes(fitted.geodesic, points, q)], 2)


def typical_noise(noise: Noise) -> Tensor:
    """The block (m, m) of median size among the rows that show everything: outliers have larger ones.

    If no row does, the blocks of median size of every marker, as if their errors were independent.
    """
    whole = noise.visible.all(1)
    if bool(whole.any()):
        return _of_median_size(noise.covariance[whole])
    own = noise.covariance.unflatten(2, (-1, 3)).unflatten(1, (-1, 3)).diagonal(dim1=1, dim2=3).movedim(-1, 0)
    seen = noise.visible[:, ::3].T  # (P, N)
    return torch.block_diag(*[_of_median_size(blocks[rows]) for blocks, rows in zip(own, seen, strict=True)])


def _of_median_size(blocks: Tensor) -> Tensor:
    sizes = blocks.diagonal(dim1=1, dim2=2).sum(1)
    return blocks[int(sizes.argsort()[(len(sizes) - 1) // 2])]


def larger(first: Tensor, second: Tensor) -> Tensor:
    """A covariance (M, m, m) that is nowhere smaller than either of two."""
    values, vectors = torch.linalg.eigh(second - first)
    total = first + (vectors * values.clamp(min=0.0)[:, None]) @ vectors.mT
    return 0.5 * (total + total.mT)
