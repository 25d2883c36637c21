"""New rows as a calibrated model expects them: residuals, and their covariance. Everything is in the model's frame.

They are residuals y - h(k1(q; m)) of what was measured, h, from devices and markers that were found before
(new_set_up.py), and whose places are known by their prior deviations (linear_rows.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import log
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.placing.lens import CameraErrors
from diffeo_calib.calibration.placing.place import Told, stacked
from diffeo_calib.calibration.placing.placement import DeviceSet, Placement, SeenRows
from diffeo_calib.calibration.placing.readings import ReadingDevices
from diffeo_calib.calibration.placing.sockets import SocketDevices
from diffeo_calib.calibration.recalibration.new_set_up import Before
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.re_registration.linear_rows import LinearRows
from diffeo_calib.kinematics.re_registration.registered_map import marker_slopes, place_columns
from diffeo_calib.kinematics.re_registration.usual_noise import larger, noise_of_rows, typical_noise
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise, mean_block, without_hidden
from diffeo_calib.maps.observation import Observation
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.process.tails import Tails, reweight
from diffeo_calib.regression.regions import OTHER_DATE, region_factor, region_scale
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.coordinates import errors_of_kinds
from diffeo_calib.sensors.errors import Evaluations
from diffeo_calib.sensors.places import fitting_devices

ROUNDS = 20
WEIGHT_CHANGE = 0.01
"""Largest relative change of a weight at which it has converged."""
OUTLIER_WEIGHT = 0.2
"""Rows with a smaller weight hardly count."""
NOISE_LEVELS = 10.0 ** torch.linspace(-2, 2, 17, dtype=torch.float64, device="cpu")
"""Factors on the variance of the noise of devices that the old fit does not know."""
NOISE_EFOLDS = 2.0
"""Prior standard deviation of their logarithm: wide."""


@dataclass(frozen=True, eq=False)
class NewRows:
    """Rows of a new set-up, brought into the frame of the old model.

    Args:
        before: the old map, and where devices and markers are.
        q: (M, n) configurations. y: (M, R) measured numbers, m; as predicted where markers are hidden.
        noise_model: how they were measured.
        points: the nominal map of the registered markers, under the payloads of the rows.
        noise: (M, R, R) covariance of the rows, m^2. marker_deviation: prior of the markers around their place, m.
        tails: weights of the rows.
        observe: what was measured of the markers; their coordinates by default.
        placement: devices that stand around the old model; what is not known of them, rows share.
        drifts: (M R, c) columns of unit variance of what has changed in the robot since, m.
    """

    before: Before
    q: Tensor
    y: Tensor
    noise_model: NoiseModel
    points: FlangePoints
    noise: Tensor
    marker_deviation: float
    tails: Tails
    observe: Observation | None = None
    placement: Placement = Placement()  # noqa: RUF009  # frozen
    drifts: Tensor | None = None

    @classmethod
    def of(cls, before: Before, markers: Tensor, marker_deviation: float) -> NewRows:
        """The rows with the noise of a typical old row, or their own where it is larger, all weights 1.

        Args:
            before: see the class. markers: (P, 3) near which they are, in the frames of their tips, m.
            marker_deviation: see the class.
        """
        points = FlangePoints(before.nominal.under(before.data.payload), markers, same=True)
        seen = before.fitted.geodesic.with_nominal(points)(before.data.q).detach()
        model, noise, known = _measured(before, seen)
        tails = Tails.none(len(seen), model.bodies, device=seen.device)
        return cls(
            before,
            before.data.q,
            noise_model=model,
            points=points,
            noise=noise,
            marker_deviation=marker_deviation,
            tails=tails,
            **known,
        )

    def __len__(self) -> int:
        return len(self.q)

    @property
    def fitted(self) -> FittedMap:
        """The old map."""
        return self.before.fitted

    @cached_property
    def seen(self) -> tuple[Tensor, Linearisation]:
        """The points (M, 3 P) by the old model, m, and their linearisation."""
        return self.fitted.geodesic.with_nominal(self.points).linearised_value(self.q)

    @cached_property
    def slopes(self) -> Tensor | None:
        """(M, R, 3 P) of what was measured; None for all coordinates."""
        return None if self.observe is None else self.observe.slope(self.seen[0]).detach()

    @cached_property
    def at(self) -> Linearisation:
        """Linearised prediction of the old model for the measured numbers."""
        return self.seen[1] if self.slopes is None else self.seen[1].projected(self.slopes)

    @cached_property
    def residual(self) -> Tensor:
        """(M, R) measured minus predicted, m."""
        return self.y - (self.seen[0] if self.observe is None else self.observe.value(self.seen[0]))

    @cached_property
    def centre(self) -> Tensor:
        """(3,) the middle of the rows, m."""
        return self.seen[0].unflatten(1, (-1, 3)).flatten(0, 1).mean(0)

    @cached_property
    def shifts(self) -> Tensor:
        """(M, R, c) effect of frame, markers and devices, each with unit prior variance, m."""
        deformation = self.fitted.geodesic.with_nominal(self.points)
        places, free = self.seen[0].unflatten(1, (-1, 3)), self.marker_deviations
        found = place_columns(deformation, self.seen[1], places, self.centre, frame=self.frame_deviation, free=free)
        return torch.cat([found if self.slopes is None else self.slopes @ found, self.by_devices], 2)

    @property
    def frame_deviation(self) -> float:
        """Prior deviation of the measuring frame, m and rad: it may have moved where a device measured coordinates."""
        return 0.0 if self.before.place is None else PLACES.found_m_rad

    @property
    def marker_deviations(self) -> Tensor:
        """(3 P,) those of the markers, m: of those that old and new rows show."""
        return self.marker_deviation * self.before.seen_before.repeat_interleave(3).to(self.y)

    @cached_property
    def by_devices(self) -> Tensor:
        """(M, R, c) effect of the devices that stand around the old model."""
        tool = self.before.nominal.geometry.slices["tool"]
        S = marker_slopes(self.fitted.geodesic, self.points, self.seen[1])
        S = torch.nn.functional.pad(S if self.slopes is None else self.slopes @ S, (tool.start, 0))
        shown = SeenRows(self.before.nominal, self.y, self.seen[0], self.slopes, S)
        found = self.placement.shared(shown)
        return self.y.new_zeros(*self.y.shape, 0) if found is None else found

    @cached_property
    def by_fit(self) -> Tensor:
        """(M R, M R) covariance of the old model at the rows, m^2."""
        return self.fitted.covariance_between(self.at)

    @cached_property
    def given(self) -> LinearRows:
        """The rows to first order, with their weights."""
        k = self.shifts.shape[2]
        C = self.by_fit if self.drifts is None else self.by_fit + self.drifts @ self.drifts.T
        seen, none = self.noise_model.coordinates(self.y), C.new_zeros(k, k)
        prior = torch.eye(k, dtype=C.dtype, device=C.device)
        return LinearRows(self.residual, self.shifts, C, self.weighted_noise, seen, prior, none[0], none)

    @property
    def posterior(self) -> Tensor:
        """(M R, M R) covariance of the rows without noise, devices and markers free, m^2."""
        total = self.given.C + self.given.slopes @ self.given.slopes.T
        return 0.5 * (total + total.T)

    @property
    def weighted_noise(self) -> Tensor:
        """(M, m, m) covariance of the rows with their weights, m^2."""
        return self.noise_model.weighted(self.noise, self.tails)

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
        if len(index) == len(self):
            return self
        own = {"q": self.q[index], "y": self.y[index], "noise_model": self.noise_model.rows(index)}
        observe = None if self.observe is None else self.observe.rows(index)
        other = replace(self, **own, noise=self.noise[index], tails=self.tails.rows(index), observe=observe)
        points, at = self.seen
        vars(other).update(seen=(points[index], at.rows(index)), shifts=self.shifts[index])
        return other

    def drifting(self, roots: Sequence[Tensor]) -> NewRows:
        """The rows where parts with these columns (M, R, c) of their covariance drift, m."""
        own = [] if self.drifts is None else [self.drifts]
        return self.changed(drifts=torch.cat([*own, *(root.flatten(0, 1) for root in roots)], 1)) if roots else self

    def if_drifting(self, roots: Sequence[Tensor]) -> NewRows:
        """The same with weights that hold then: a change is no outlier."""
        return self.drifting(roots).with_weights()

    def changed(self, **changes: object) -> NewRows:
        """The same rows with other noise, weights or drifts; what does not change is kept."""
        other = replace(self, **changes)
        keep = "seen", "slopes", "at", "residual", "centre", "by_devices", "shifts", "by_fit"
        vars(other).update({name: vars(self)[name] for name in keep if name in vars(self)})
        return other

    @property
    def new_noise(self) -> Tensor:
        """Covariance (m, m) of a new measurement in the new set-up, m^2, inflated for heavy tails.

        Few rows seldom show the tails: it is no smaller than that of the old set-up.
        """
        old = self.fitted.new_noise
        if self.observe is not None or self.fitted.slopes is not None:
            return old
        found = self._mean_noise * region_factor(self.tails.freedom, self.noise_model.largest_freedom)
        return found if float(found.trace()) > float(old.trace()) else old

    @property
    def _mean_noise(self) -> Tensor:
        """(R, R) the mean of the rows' noise, m^2."""
        return mean_block(self.noise, self.noise_model.coordinates(self.y))

    @property
    def inflation(self) -> float:
        """Factor on all variances with which 95 % regions hold rows that took no part, at least one.

        The scales were chosen for another session, with few rows of other places, temperatures or loads. The errors of
        every new row as predicted by the old model and all others judge them, see :func:`region_scale`.
        """
        covariance, noise = torch.linalg.inv(self.given.precisions), self.noise
        error = covariance @ self.given.solved[..., None]
        if self.observe is None and self.fitted.slopes is None:
            noise = noise * (self.new_noise.trace() / self._mean_noise.trace())
        squares = self.noise_model.squares(covariance - self.weighted_noise + noise, error @ error.mT)
        return max(1.0, region_scale(squares, self.noise_model.freedom, prior=OTHER_DATE))

    def _expected_squares(self) -> Tensor:
        """Expected squared distances of the errors in units of the noise without weights: (M, bodies)."""
        noise, given = self.weighted_noise, self.given
        error = noise @ given.solved[..., None]
        return self.noise_model.squares(self.noise, error @ error.mT + noise - noise @ given.precisions @ noise)

    @property
    def placed_residual(self) -> Tensor:
        """(M, R) residuals with devices and markers where the rows put them, m; NaN where hidden."""
        return self.given.shown(self.given.after_placing @ self.given.target)

    @property
    def expected_residual(self) -> Tensor:
        """(M, R) standard deviations of these that model and noise lead to expect, m; NaN where hidden."""
        placed = self.given.after_placing
        variances = ((placed @ Noise(self.noise).add_to(self.given.C)) * placed).sum(1).clamp(min=0.0)
        return self.given.shown(variances.sqrt())

    def by_kind(self, errors: Tensor) -> Evaluations:
        """Errors (M, R) of the numbers of all rows, m, NaN where nothing was measured, in the unit of each kind."""
        readings = [own for own in self.placement if isinstance(own, ReadingDevices)]
        return errors_of_kinds(errors, self.before.coordinates, readings)

    @property
    def excess(self) -> float:
        """Root mean square of the left-out errors of the better half of the rows in units of the expected ones."""
        squares = (self.given.solved * self.given.left_out).nansum(1) / self.given.visible.sum(1)
        return float(squares.median().sqrt())

    def levelled(self, roots: list[Tensor]) -> NewRows:
        """The rows with the likeliest noise of every kind of device that the old fit does not know.

        Args:
            roots: (M, R, c) columns of parts that may have changed: a change is no noise.
        """
        kinds = self.noise_model.kinds
        kinds = torch.zeros_like(self.tails.weights, dtype=torch.int64) if kinds is None else kinds
        rows = self.drifting(roots)
        for kind in range(int(self.fitted.slopes is None), int(kinds.max()) + 1):
            own = (kinds == kind).repeat_interleave(self.y.shape[1] // kinds.shape[1], 1)
            own = own & self.noise_model.coordinates(self.y)
            levels = [rows.changed(noise=_scaled(rows.noise, own, float(f))) for f in NOISE_LEVELS]
            prior = [-0.5 * (log(float(f)) / NOISE_EFOLDS) ** 2 for f in NOISE_LEVELS]
            logs = [each.given.log_evidence() + p for each, p in zip(levels, prior, strict=True)]
            rows = levels[logs.index(max(logs))]
        return self.changed(noise=rows.noise)


def _scaled(noise: Tensor, own: Tensor, factor: float) -> Tensor:
    """Noise (M, R, R) with the variances of some numbers (M, R) multiplied by a factor."""
    root = torch.where(own, factor**0.5, 1.0)
    return root[:, :, None] * noise * root[:, None, :]


def _measured(before: Before, seen: Tensor) -> tuple[NoiseModel, Tensor, dict[str, Any]]:
    """How rows in the model's frame were measured, their noise, and what; the devices around its points (M, 3 P), m."""
    told, noise, sets = None, None, list[DeviceSet]()
    if before.coordinates is not None:
        told, noise, sets = _coordinates(before, *before.coordinates, seen)
    sets += before.sessions
    points, readings = seen.unflatten(1, (-1, 3)), list[ReadingDevices]()
    for table, own in before.readings:
        numbers = torch.arange(table.values.shape[1], device=own.device)
        readings.append(ReadingDevices(table, fitting_devices(table, points[own]), own, numbers))
    if told is not None and noise is not None and len(told.rows) == len(seen):
        return told.noise_model, noise, {"y": told.y, "placement": Placement(sets)}
    rows = stacked(before.data.q, told, readings, seen.shape[1])
    visible = rows.noise_model.coordinates(rows.y)
    old = before.fitted.noise
    usual = old.covariance.diagonal(dim1=1, dim2=2)[old.visible].median()  # variance of what was measured, m^2
    total = torch.diag_embed(usual.expand_as(rows.y))
    if told is not None and noise is not None:
        own = total[told.rows]
        own[:, : noise.shape[1], : noise.shape[1]] = noise
        total[told.rows] = own
    if rows.noise_model.known is not None:
        total = larger(total, rows.noise_model.known)
    model = replace(rows.noise_model, known=None)
    known = {"y": rows.y, "observe": rows.observe, "placement": Placement((*sets, *readings))}
    return model, without_hidden(total, visible), known


def _coordinates(before: Before, new: Measurements, rows: Tensor, seen: Tensor) -> tuple[Told, Tensor, list[DeviceSet]]:
    """Rows (M,) that tell coordinates, in the model's frame; their noise, sockets, and errors of cameras."""
    T, fitted = before.transform, before.fitted
    table = new.in_frames(torch.linalg.inv(T).expand(len(new), -1, -1))
    block = typical_noise(fitted.noise) if fitted.slopes is None else fitted.new_noise
    noise = noise_of_rows(fitted, new, T, block, 1.0)
    sets, table = SocketDevices.around_model(table, rows, seen)
    y = table.points.flatten(1)
    sensor = replace(NoiseModel.of(table, 0.0), known=None)
    if sensor.visible is not None:
        y = torch.where(y.isnan(), seen[rows], y)
        noise = without_hidden(noise, sensor.coordinates(y))
    return Told(rows, y, sensor), noise, [*sets, *CameraErrors.around(table, rows)]
