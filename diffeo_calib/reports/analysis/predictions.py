"""Measured rows beside predictions that have not seen them: new rows, or rows of the fit predicted by all others.

What a model was fitted to, and the errors of each row left out, follow from the model alone.
Around its optimum a model is linear in fields and parameters. With G their prior covariance at the rows, R the noise,

    y - k1 + response = (G + R) mu,    error of row i predicted by all others = [(G + R)^-1]_ii^-1 mu_i.

Of very many rows, random blocks are treated one by one, each with a Cholesky factor of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, hypot, log, nan
from statistics import linear_regression
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.judged_rows import Outlier, excluded, found_outliers
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.quantiles import chi2_above, known
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import place, residuals
from diffeo_calib.kinematics.registered_map import robot_map
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.poses import POINTS
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conditional import Process
from diffeo_calib.sensors.errors import Evaluation

WHOLE_COORDINATES = 4500  # measured coordinates up to which each row is predicted by all others
BLOCK_COORDINATES = 1500
"""Measured coordinates of one block: a few hundred poses predict another pose nearly as well as thousands do."""
LEARNING_SUBSETS = 5  # random orders of the rows over which a learning curve is averaged
LEARNING_SHARES = (0.1, 0.15, 0.25, 0.4, 0.6, 0.8)
FEWEST_LEARNED = 15  # rows from which a learning curve starts
OUTLIER_NOISE = 4.0  # variance, in typical ones, above which the noise of a row is that of an outlier
SHARES = torch.linspace(0.05, 0.95, 19, dtype=torch.float64, device="cpu")
"""Claimed shares at which a model's uncertainty is compared with the errors found."""


class FitRows:
    """A model's fit, linearised at its rows; of rows of other kinds than positions alone, only what these show.

    Attributes:
        of_positions: whether positions, or poses, of all markers were measured in every row.
    model: calibrated kinematics. One that was registered stands for its fit: the markers are those of the fit.
    measured: the measurements that it was fitted to. A model with fewer control points than rows needs them: it
        keeps no trace of its rows' errors.
    """

    def __init__(self, model: CalibratedKinematics, measured: Measurements | None = None) -> None:
        self.map: FittedMap = model.to(HOST).map.unregistered
        posed = model.registration is None or self.map.m % (3 * POINTS) == 0
        self.q, self.on, self.lever = self.map.x, model.nominal.geometry.on, model.lever if posed else None
        self.of_positions = not model.ball and self.map.slopes is None
        self._measured = None
        if measured is not None and measured.q.shape == self.q.shape and measured.points[0].numel() == self.map.m:
            self._measured = measured if torch.equal(measured.q.to(HOST), self.q) else None

    def __len__(self) -> int:
        return len(self.q)

    @property
    def whole(self) -> bool:
        """Whether each row is predicted by all others, not by those of its block."""
        return len(self.blocks) == 1

    @property
    def known(self) -> bool:
        """Whether the measured values of the rows are known."""
        return self.of_positions and (self._measured is not None or self.map.data is None)

    @cached_property
    def points(self) -> Tensor:
        """(N, P, 3) measured markers, m; NaN where they were hidden. InputError: they are not known."""
        if self.map.data is None:
            measured = self.map.measured().detach()
            return measured.masked_fill(~self.map.noise.visible, nan).unflatten(1, (-1, 3))
        if self._measured is None:
            what = "the model has fewer control points than rows, and keeps no trace of the errors of its rows"
            raise InputError.of(what, fix="pass measurements")
        return self._measured.points.to(HOST)

    @cached_property
    def measurements(self) -> Measurements:
        """The rows as measurements; without the table their numbers are those of the rows in the fit.

        Their values are those of the fit: a table with the same configurations may have been measured in other frames.
        """
        given = self._measured
        if given is not None and self.map.data is not None:
            return given
        made = Measurements.of_points(self.q, self.points, self.on, self.lever)
        rows: Any = self.map.geodesic.spec.nominal_of_controls
        made = made.with_load(rows.load)
        return made if given is None else made.with_columns(line_numbers=given.line_numbers, origin=given.origin)

    @cached_property
    def blocks(self) -> list[tuple[Tensor, Process]]:
        """Row numbers (B,) of each block, and the model conditioned on them: on all rows the map is that at hand."""
        n, m, _ = self.map.noise.covariance.shape
        by_data = self.map.by_data if self.map.data is None and n * m <= WHOLE_COORDINATES else None
        if isinstance(by_data, Process):
            return [(torch.arange(n, device=HOST), by_data)]
        order = torch.randperm(n, generator=seeded(0), device=HOST)
        parts = [part.sort().values for part in order.tensor_split(ceil(n * m / BLOCK_COORDINATES))]
        return [(rows, Process.of_rows(self.linearised[1].rows(rows), self.map.noise.rows(rows))) for rows in parts]

    @cached_property
    def left_out(self) -> tuple[Tensor, Tensor]:
        """Every row as predicted by the others: measured minus predicted (N, m) in m, and its covariance (N, m, m).

        Where markers were hidden the errors are NaN, and the covariance is that of noise alone.
        """
        noise, visible = self.map.noise, self.map.noise.visible
        errors, covariance = torch.empty_like(self.target), torch.empty_like(noise.covariance)
        for rows, regression in self.blocks:
            errors[rows], block = regression.about(self.target[rows]).rows_left_out()
            covariance[rows] = block - noise.covariance[rows]
        both = visible[:, :, None] & visible[:, None, :]
        return errors.masked_fill(~visible, nan), torch.where(both, covariance, 0.0) + self.map.new_noise

    def learning_curve(self) -> list[tuple[int, float]]:
        """Number of rows -> RMS distance of other rows from their prediction with the scales of the whole fit, m.

        Subsets are drawn at random from one block; the last number is that of all rows that predict one. Outliers keep
        their small weights and do not count as errors.
        """
        block, m = self.blocks[0][0], self.target.shape[1]
        n = min(len(block), ceil(BLOCK_COORDINATES / m))
        sizes = sorted({max(FEWEST_LEARNED, round(share * n)) for share in LEARNING_SHARES})
        squares: dict[int, list[Tensor]] = {size: [] for size in sizes if n - size >= FEWEST_LEARNED}
        variances = self.map.noise.covariance.diagonal(dim1=1, dim2=2)
        sizes_of_noise = variances.masked_fill(~self.map.noise.visible, nan).nanmean(1)
        inliers = sizes_of_noise <= OUTLIER_NOISE * sizes_of_noise.median()  # (N,)
        for seed in range(LEARNING_SUBSETS):
            rows = block[torch.randperm(len(block), generator=seeded(seed), device=HOST)[:n]]
            target, noise = self.target[rows], self.map.noise.rows(rows)
            unseen = ~noise.visible | ~inliers[rows, None]
            # The factor of the first rows is the first part of that of all: one serves every size.
            factor = torch.linalg.cholesky(noise.add_to(self.linearised[1].rows(rows).gram()))
            white = torch.linalg.solve_triangular(factor, target.reshape(-1, 1), upper=False)
            for size, parts in squares.items():
                predicted = (factor[size * m :, : size * m] @ white[: size * m]).view(-1, m)
                error = (target[size:] - predicted).masked_fill(unseen[size:], nan)
                parts.append(error.reshape(-1, 3).square().sum(-1))
        curve = [(size, float(torch.cat(values).nanmean().sqrt())) for size, values in squares.items()]
        left_out = self.left_out[0][block][inliers[block]].reshape(-1, 3)
        return [*curve, (len(block), float(left_out.square().sum(-1).nanmean().sqrt()))]

    def transmission_deviation(self, joint: int, values: Tensor) -> Tensor:
        """Posterior standard deviation (M,) of a joint's transmission error at values (M,), rad or m; zero without one.

        The mean of the error over the values is left out.
        """
        terms = self.map.geodesic.spec.joint_kernel.terms
        kernels = [t for t in terms if isinstance(t, RadialKernel) and t.columns == (joint,) and t.output == joint]
        regression = self.blocks[0][1]
        data, q = regression.numbers.at, self.q.mean(0).repeat(len(values), 1)
        q[:, joint] = values
        along = torch.zeros_like(q)[:, None]
        along[:, :, joint] = 1.0
        centred = torch.eye(len(values), dtype=q.dtype, device=q.device) - 1.0 / len(values)
        total, cross = q.new_zeros(len(values), len(values)), q.new_zeros(*data.sensitivity.shape[:2], len(values))
        for kernel in kernels:
            for node in data.joint:
                total += kernel.gram(q, node.weight * along, q, along)
                cross += kernel.gram(node.points, node.weight * node.effect, q, along).view_as(cross)
        by_axis, variance = robot_map(self.map).along_axis(q, joint), self.map.geodesic.spec.prior_variance
        total += (by_axis * variance) @ by_axis.T
        cross += data.sensitivity[..., : len(variance)] @ (by_axis * variance).T
        cross = regression.numbers.of_table(cross)
        covariance = total - cross.T @ regression.factor.solve(cross)
        return (centred @ covariance @ centred).diagonal().clamp(min=0.0).sqrt()

    @cached_property
    def target(self) -> Tensor:
        """(N, m) measured (where hidden: predicted) minus the linear model at zero fields and parameters, m."""
        value, at = self.linearised
        measured = self.points.flatten(1)
        response = self.map.geodesic.linear_response(at, elsewhere=self.map.data is not None)
        return torch.where(measured.isnan(), value, measured) - value + response

    @cached_property
    def linearised(self) -> tuple[Tensor, Linearisation]:
        """(N, m) the markers by the fit itself, m, and the first order around them."""
        at_controls = self.map.data is None  # rows with places or payloads of their own
        value, at = self.map.geodesic.linearised_value(None if at_controls else self.q)
        return value, at if self.map.slopes is None else at.projected(self.map.slopes)


def forecast(curve: Sequence[tuple[int, float]], limit: float) -> tuple[int, float] | None:
    """Twice the rows of the last point of a learning curve and the error there, by the slope of its last part.

    Above the repeatability ``limit`` [m] errors fall like a power of the number of rows; None if they do not fall.
    """
    counts, above = [log(count) for count, _ in curve[-4:]], [max(e**2 - limit**2, 0.0) ** 0.5 for _, e in curve[-4:]]
    if len(curve) < 3 or min(above) <= 0:
        return None
    slope = linear_regression(counts, list(map(log, above))).slope
    return None if slope >= 0 else (2 * curve[-1][0], hypot(above[-1] * 2.0**slope, limit))


@dataclass(frozen=True, eq=False)
class Predictions:
    """N measured rows of B bodies each: markers, or the origins of measured frames."""

    data: Measurements  # the rows
    measured: Tensor  # (N, B, 3) positions, m, NaN where hidden
    predicted: Tensor  # (N, B, 3) of a model that has not seen the row, m
    covariance: Tensor  # (N, B, 3, 3) of a new measurement as the model claims it, m^2
    errors: Evaluation  # distances, and angles where poses were measured

    @classmethod
    def of(cls, model: CalibratedKinematics, data: Measurements) -> Predictions:
        """Predictions of rows that took no part in the fit."""
        predicted = data.bodies.predicted(model.at_payloads(data.payload), data.q)
        return cls(data, data.origins, predicted.origins, predicted.places, _errors(predicted.points, data))

    @classmethod
    def of_fit(cls, rows: FitRows) -> Predictions:
        """Rows of a fit, each predicted by all others."""
        data, (errors, covariance) = rows.measurements, rows.left_out
        points = rows.points - errors.unflatten(1, (-1, 3))
        evaluated = _errors(points, data)
        predicted, covariance = data.bodies.claimed(points, covariance, rows.linearised[0].unflatten(1, (-1, 3)))
        return cls(data, data.origins, predicted, covariance, evaluated)

    def __len__(self) -> int:
        return len(self.measured)

    @property
    def away(self) -> Tensor:
        """(N, B, 3) measured minus predicted, m."""
        return self.measured - self.predicted

    @property
    def claimed(self) -> Tensor:
        """(N, B) RMS distance that the model claims, m; NaN for hidden markers."""
        hidden = self.measured.isnan().any(2)
        return self.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().masked_fill(hidden, nan)

    @property
    def squares(self) -> Tensor:
        """(N, B) squared errors in claimed standard deviations; chi-squared with 3 degrees of freedom if it is true.

        NaN for hidden markers, as the errors.
        """
        solved = torch.linalg.solve(self.covariance, self.away[..., None])[..., 0]
        return (self.away * solved).sum(-1)

    def inside(self, share: float = 0.95) -> tuple[int, int]:
        """Number of errors inside the regions that claim ``share``, and of all."""
        squares = known(self.squares)
        return int((squares <= chi2_above(1.0 - share, 3)).sum()), len(squares)

    def coverage(self, share: float = 0.95) -> float:
        """Share of errors inside these regions."""
        inside, count = self.inside(share)
        return inside / count

    def outliers(self, model: CalibratedKinematics) -> list[Outlier]:
        """Rows further from their prediction than the claims allow by chance in all rows, the worst first."""
        freedom = torch.full_like(self.squares, 3.0)
        bad = excluded(self.squares, freedom, by_others=False)
        return found_outliers(model, self.data, bad, self.errors.errors)


def _errors(points: Tensor, data: Measurements) -> Evaluation:
    return residuals(lambda _: points, place(lambda _: points, data), data).main
