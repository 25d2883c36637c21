"""What devices in known places will report: readings of the ball of a calibrated model, with their covariances.

A reading at q is h(z(q), d), z the ball and d what is known of the device, both found from the same rows. Their errors
belong together: whatever no row tells apart, such as the place of the whole scene, moves both and no reading. With
slopes A by the points and B by the unknowns u of the device,

    cov = A C A^T + A X B^T + B X^T A^T + B U B^T + noise,    X = cov(z, u), U = cov(u),

from the posterior of the fit. Devices that measured no row of the fit were placed around the model: X = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.fitting.fitted_map import PREDICT_ROWS, FittedMap
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.sensors.devices import Devices


@dataclass(frozen=True, eq=False)
class PredictedReadings:
    """What one device will report at N configurations.

    Args:
        kind: of its readings. device: its name. unit: of the readings.
        mean: (N, r) readings; NaN where the device cannot see the ball. covariance: (N, r, r) of these, in its square.
    """

    kind: str
    device: str
    unit: str
    mean: Tensor
    covariance: Tensor

    @property
    def deviations(self) -> Tensor:
        """(N, r) standard deviations."""
        return self.covariance.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt()


class _Seen(NamedTuple):
    """The points of a model at some configurations: values (N, 3 P), m, and their linearisation."""

    points: Tensor
    at: Linearisation
    sensitivity: Tensor | None

    @property
    def ball(self) -> Tensor:
        return self.points[:, -3:]


class _OfFit(NamedTuple):
    """What a fit knows of one device: prior deviations (k,) of its unknowns, and their columns (c,) among the shifts.

    ``noise``: (r, r) covariance of a reading, m^2.
    """

    deviations: Tensor
    columns: Tensor
    noise: Tensor


def predicted_readings(model: Any, q: Tensor, *, noise: bool = True) -> list[PredictedReadings]:
    """What every device that a model knows will report of the ball; nothing for devices that measure coordinates.

    Args:
        model: calibrated. q: (N, n) configurations. noise: whether the covariance is that of a new reading.
    """
    sets = [(own, own.devices) for own in model.placement if own.devices is not None and len(q)]
    fitted: FittedMap = model.map
    seen = [_seen(fitted, q, slice(first, first + PREDICT_ROWS)) for first in range(0, len(q), PREDICT_ROWS)]
    found = []
    for own, devices in sets:
        unit, scale, zero = own.shown_as
        for number, name in enumerate(own.names):
            of_fit = _of_fit(fitted, devices, number, own.rows[own.device == number])
            parts = [_readings(fitted, each, devices, number, of_fit, own.deviations[number], noise) for each in seen]
            factor = torch.tensor(scale).to(q) / devices.metres[number].to(q)
            mean = torch.cat([part[0] for part in parts]) * factor + torch.tensor(zero).to(q)
            covariance = torch.cat([part[1] for part in parts]) * factor[:, None] * factor
            found.append(PredictedReadings(own.kind, name, unit, mean, covariance))
    return found


def _seen(fitted: FittedMap, q: Tensor, some: slice) -> _Seen:
    geodesic = fitted.geodesic.at_rows(some)
    points, at = geodesic.linearised_value(q[some])
    return _Seen(points.detach(), at, fitted.open_sensitivity(geodesic.spec.nominal, q[some]))


def _of_fit(fitted: FittedMap, devices: Devices, number: int, rows: Tensor) -> _OfFit | None:
    """What the fit knows of a device by its rows (M,); None where it measured none, or the model was moved since."""
    if not len(rows) or fitted.registration is not None or fitted.slopes is None:
        return None
    numbers = fitted.noise.visible[rows][0]
    effects = fitted.noise.shared[rows][:, numbers]  # (M, r, c)
    columns = (effects != 0).any(1).any(0)
    ball = fitted.fitted_points[rows, -3:]
    slopes = devices.observation(torch.full_like(rows, number)).by_constants(ball)
    if int(columns.sum()) != slopes.shape[2]:
        return None
    deviations = (effects[..., columns].square().sum((0, 1)) / slopes.square().sum((0, 1))).sqrt()
    noise = fitted.noise.covariance[rows][:, numbers][:, :, numbers].median(0).values
    return _OfFit(deviations, columns, noise)


def _readings(
    fitted: FittedMap, seen: _Seen, devices: Devices, number: int, of_fit: _OfFit | None, known: Tensor, noise: bool
) -> tuple[Tensor, Tensor]:
    """Mean (N, r) and covariance (N, r, r) of the readings of a device, m; ``known``: (k,) deviations of its unknowns."""
    ball = seen.ball
    observation = devices.observation(torch.full((len(ball),), number, dtype=torch.int64, device=ball.device))
    A = torch.nn.functional.pad(observation.slope(ball), (seen.points.shape[1] - 3, 0))
    B = observation.by_constants(ball)
    if of_fit is None:
        B = B * known.to(B)
        covariance = fitted.covariance_at(seen.at, A) + B @ B.mT
    else:
        B = B * of_fit.deviations
        covariance = fitted.with_shifts(seen.at.projected(A), B, of_fit.columns)
    if seen.sensitivity is not None:
        moved = A @ (seen.sensitivity @ fitted.open_directions)
        covariance = covariance + moved @ moved.mT
    if noise:
        own = A @ fitted.new_noise @ A.mT
        covariance = covariance + (own if of_fit is None else of_fit.noise)
    return observation.value(ball), covariance
