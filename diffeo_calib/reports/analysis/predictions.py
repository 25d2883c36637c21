"""Measured rows beside predictions that have not seen them: new rows, or rows of the fit predicted by all others."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.findings import Outlier, excluded, found_outliers
from diffeo_calib.common.quantiles import chi2_above, known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import place, residuals
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.fit_rows import FitRows
from diffeo_calib.sensors.coordinates import sensor_of
from diffeo_calib.sensors.errors import Evaluation

SHARES = torch.linspace(0.05, 0.95, 19, dtype=torch.float64, device="cpu")
"""Claimed shares at which a model's uncertainty is compared with the errors found."""


@dataclass(frozen=True, eq=False)
class Predictions:
    """N measured rows of B bodies each: markers, or the origins of measured frames.

    Args:
        data: the rows.
        measured: (N, B, 3) positions, m, NaN where hidden.
        predicted: (N, B, 3) of a model that has not seen the row, m.
        covariance: (N, B, 3, 3) of a new measurement as the model claims it, m^2.
        errors: distances, and angles where poses were measured.
        left_out: whether these are rows of the fit, each predicted by all others.
    """

    data: Measurements
    measured: Tensor
    predicted: Tensor
    covariance: Tensor
    errors: Evaluation
    left_out: bool

    @classmethod
    def of(cls, model: CalibratedKinematics, data: Measurements) -> Predictions:
        """Predictions of rows that took no part in the fit."""
        sensor_of(data).check(data, model)
        seen = data.bodies.predicted(model.at_payloads(data.payload), data.q)
        return cls(data, data.origins, seen.origins, seen.places, _errors(seen.points, data), left_out=False)

    @classmethod
    def of_fit(cls, rows: FitRows) -> Predictions:
        """Rows of a fit, each predicted by all others."""
        data, (errors, covariance) = rows.measurements, rows.left_out
        points = rows.points - errors.unflatten(1, (-1, 3))
        found = _errors(points, data)
        predicted, covariance = data.bodies.claimed(points, covariance, rows.predicted)
        return cls(data, data.origins, predicted, covariance, found, left_out=True)

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

    def found_shares(self) -> Tensor:
        """Shares of errors inside the regions that claim :data:`SHARES`."""
        return SHARES.new_tensor([self.coverage(share) for share in SHARES.tolist()])

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
        return found_outliers(model, self.data, excluded(self.squares, 3), self.errors.errors)


def _errors(points: Tensor, data: Measurements) -> Evaluation:
    """Errors of predicted points (N, P, 3), m."""

    def predicted(_: Tensor) -> Tensor:
        return points

    return residuals(predicted, place(predicted, data), data).main
