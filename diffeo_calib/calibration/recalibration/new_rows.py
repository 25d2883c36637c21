"""New rows as a calibrated model expects them: residuals, and their covariance. Everything is in the model's frame.

They are residuals y - h(k1(q; m)) of what was measured, h, from devices and markers that were found before
(new_set_up.py), and whose places are known by their prior deviations (kinematics/re_registration/new_rows.py).

Parts of a robot that may have changed since its calibration: hypotheses whose priors are those of the old model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, nan
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffeo_calib.calibration.placing.lens import CameraErrors
from diffeo_calib.calibration.placing.place import Told, stacked
from diffeo_calib.calibration.placing.placement import DeviceSet, Placement, SeenRows
from diffeo_calib.calibration.placing.readings import ReadingDevices, reading_sets
from diffeo_calib.calibration.placing.sockets import SocketDevices
from diffeo_calib.calibration.recalibration.new_set_up import Before
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.re_registration.find_place import MARKER_DEVIATIONS, UNMOVED_LOG_ODDS
from diffeo_calib.kinematics.re_registration.new_rows import NewRows, larger, noise_of_rows, typical_noise
from diffeo_calib.kinematics.re_registration.registered_map import fitted_markers, robot_map
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.process.evidence import Evidence
from diffeo_calib.process.tails import Tails, gross_weights, reweight
from diffeo_calib.regression.regions import OTHER_DATE, region_factor, region_scale
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.coordinates import errors_of_kinds
from diffeo_calib.sensors.errors import Evaluations
from diffeo_calib.sensors.places import fitting_devices

SMALLEST_AMPLITUDE_SHARE = 0.5
"""A small transmission error counts with this share of the largest joint's amplitude: it may have grown."""
OFFSET_DEVIATION_RAD_M = 3e-4
"""Of a joint offset, to which the sizes of changes are relative: they span 0.05 to 5 mrad."""
NEGLIGIBLE_EIGENVALUE_SHARE = 1e-6
"""Eigenvalues of a transmission's covariance below this share of the largest are left out."""


@dataclass(frozen=True, eq=False)
class ChangedPart:
    """A part of a model that may have changed.

    Args:
        name: of the joint, or "gravity" or "geometry".
        joint: the column of the joint whose error or offset it is; None for parameters of the nominal map.
        kernel: that of the joint's error; None for its offset, which all readings lack since then.
        deviations: (K,) prior standard deviations of the parameters, zero of those that it leaves alone.
        variance: of the change, relative to the old variance of the part.
    """

    name: str
    joint: int | None = None
    kernel: RadialKernel | None = None
    deviations: Tensor | None = None
    variance: float = 1.0

    @property
    def offset(self) -> bool:
        """Whether it is the offset of a joint."""
        return self.joint is not None and self.kernel is None

    def shapes(self, at: Linearisation) -> Tensor:
        """(M, c) columns whose products are the covariance of the change of the joint's errors, rad or m."""
        points, size = at.joint[0].points, self.variance**0.5
        if self.kernel is None:
            return torch.full_like(points[:, :1], size * OFFSET_DEVIATION_RAD_M)
        one = points.new_zeros(len(points), 1, points.shape[1])
        one[:, 0, self.joint] = 1.0
        values, vectors = torch.linalg.eigh(self.kernel.gram(points, one, points, one))
        kept = values > NEGLIGIBLE_EIGENVALUE_SHARE * values[-1]
        return size * vectors[:, kept] * values[kept].sqrt()

    def root(self, at: Linearisation) -> Tensor:
        """(M, m, c) columns whose products are the covariance of the change at M configurations, m."""
        if self.deviations is not None:
            return self.variance**0.5 * (at.sensitivity * self.deviations)[..., self.deviations > 0]
        return at.joint_to_start[:, :, self.joint, None] * self.shapes(at)[:, None]


def offsets_of(fitted: FittedMap) -> list[ChangedPart]:
    """The offsets of all joints, which are tested beside the parts: the geometry has them, among much else."""
    names = robot_map(fitted).geometry.chain.joint_names
    return [ChangedPart(f"the offset of {name}", joint) for joint, name in enumerate(names)]


def parts_of(fitted: FittedMap) -> list[ChangedPart]:
    """The parts of a robot's map: every joint with a transmission term, gravity, geometry."""
    spec, nominal = fitted.geodesic.spec, robot_map(fitted)
    names = nominal.geometry.chain.joint_names
    own = {t.output: t for t in spec.joint_kernel.terms if isinstance(t, RadialKernel) and t.output is not None}
    least = SMALLEST_AMPLITUDE_SHARE**2 * max((float(term.variance) for term in own.values()), default=0.0)
    found: list[ChangedPart] = []
    for joint, term in own.items() if least > 0 else ():
        kernel = RadialKernel.from_config(term.to_config() | {"variance": max(float(term.variance), least)})
        found.append(ChangedPart(names[joint], joint, kernel))
    for name, columns in (("gravity", nominal.sag), ("geometry", nominal.geometry.slices["joints"])):
        deviations = torch.zeros_like(spec.prior_variance)
        deviations[columns] = spec.prior_variance[columns].sqrt()
        found += [ChangedPart(name, deviations=deviations)] if bool(deviations.any()) else []
    return found


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
class WeighedRows(NewRows):
    """Rows of a new set-up of any kinds, brought into the frame of the old model, with their weights.

    Args:
        before: the old map, and where devices and markers are. noise_model: how the rows were measured.
        marker: which the markers are, see MARKER_DEVIATIONS. tails: weights of the rows.
        placement: devices that stand around the old model; what is not known of them, rows share.
    """

    before: Before
    noise_model: NoiseModel
    marker: str
    tails: Tails
    placement: Placement

    @classmethod
    def of(cls, before: Before, markers: Tensor, marker: str) -> WeighedRows:
        """The rows with the noise of a typical old row, or their own where it is larger, all weights 1.

        Args:
            before, marker: see the class. markers: (P, 3) near which they are, in the frames of their tips, m.
        """
        points = FlangePoints(before.nominal.under(before.data.payload), markers, same=True)
        seen = before.fitted.geodesic.with_nominal(points)(before.data.q).detach()
        model, noise, measured = _measured(before, seen)
        frame = seen.new_full((6,), 0.0 if before.place is None else PLACES.found_m_rad)
        moved = MARKER_DEVIATIONS[marker][1] * before.seen_before.repeat_interleave(3).to(frame)
        nothing = torch.diag(0.0 * torch.cat([frame, moved]))
        rows = cls(
            fitted=before.fitted,
            points=points,
            transform=before.transform,
            q=before.data.q,
            noise=noise,
            visible=model.visible,
            shared=noise[..., :0],
            deviations=torch.cat([frame, moved]),
            away=nothing[0],
            known=nothing,
            by_fit=nothing[6:, 6:],
            centre=seen.view(-1, 3).mean(0),
            drifts=noise[..., :0].flatten(0, 1),
            before=before,
            noise_model=model,
            marker=marker,
            tails=Tails.none(len(seen), model.bodies, device=seen.device),
            **measured,
        )
        by_tool = pad(rows.by_places[..., 6:], (before.nominal.geometry.slices["tool"].start, 0))
        at = SeenRows(before.nominal, rows.y, rows.seen[0], rows.slopes, by_tool)
        return rows.changed(shared=rows.placement.shared(at))

    @property
    def weighted_noise(self) -> Tensor:
        """(M, R, R) R with the noise of every body divided by its weight, m^2."""
        return self.noise_model.weighted(self.noise, self.tails)

    def with_weights(self) -> WeighedRows:
        """The same rows with the weights of Student's t, by expectation maximisation."""
        rows = self
        for _ in range(ROUNDS):
            tails = reweight(rows._expected_squares(), rows.noise_model.freedom)
            change = float((tails.weights / rows.tails.weights - 1.0).abs().max())
            rows = rows.changed(tails=tails)
            if change < WEIGHT_CHANGE:
                break
        return rows

    def kept(self, index: Tensor) -> WeighedRows:
        """Some of the rows (k,), with their weights."""
        if len(index) == len(self):
            return self
        own = {"noise_model": self.noise_model.rows(index), "tails": self.tails.rows(index)}
        return super().kept(index).changed(**own)

    def drifting(self, roots: Sequence[Tensor]) -> WeighedRows:
        """The rows where parts with these columns (M, R, c) of their covariance drift, m."""
        return self.changed(drifts=torch.cat([self.drifts, *(root.flatten(0, 1) for root in roots)], 1))

    def evidence(self, root: Tensor) -> Evidence:
        """Of unknowns with these effects (M, R, c)."""
        E = root.flatten(0, 1)
        return Evidence(E.T @ self.given.solved.flatten(), E.T @ self.given.factor.solve(E))

    @property
    def new_noise(self) -> Tensor:
        """Covariance (m, m) of a new measurement in the new set-up, m^2, inflated for heavy tails.

        Few rows seldom show the tails: it is no smaller than that of the old set-up.
        """
        old = self.fitted.new_noise
        if self.observe is not None or self.fitted.slopes is not None:
            return old
        found = self.mean_noise * region_factor(self.tails.freedom, int(self.noise_model.freedom.max()))
        return found if float(found.trace()) > float(old.trace()) else old

    @property
    def inflation(self) -> float:
        """Factor on all variances with which 95 % regions hold rows that took no part, at least one.

        The scales were chosen for another session, with few rows of other places, temperatures or loads. The errors of
        every new row as predicted by the old model and all others judge them, see :func:`region_scale`.
        """
        covariance, noise = torch.linalg.inv(self.given.precisions), self.noise
        error = covariance @ self.given.solved[..., None]
        if self.observe is None and self.fitted.slopes is None:
            noise = noise * (self.new_noise.trace() / self.mean_noise.trace())
        squares = self.noise_model.squares(covariance - self.weighted_noise + noise, error @ error.mT)
        dim = self.noise_model.freedom
        if (weights := gross_weights(squares, dim)) is not None:  # gross rows are named, and say nothing of the robot
            squares = squares.masked_fill(weights < OUTLIER_WEIGHT, nan)
        return max(1.0, region_scale(squares, dim, prior=OTHER_DATE))

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

    def levelled(self) -> WeighedRows:
        """The rows with the likeliest noise of every kind of device that the old fit does not know."""
        kinds, known = self.noise_model.kinds, self.fitted.slopes is None
        unknown = range(int(known), int(kinds.max()) + 1) if self.observe is not None or not known else ()
        rows = self.drifting([part.root(self.at) for part in parts_of(self.fitted)] if unknown else [])  # no noise
        for kind in unknown:
            own = (kinds == kind).repeat_interleave(self.y.shape[1] // kinds.shape[1], 1) & self.visible
            levels = [rows.changed(noise=_scaled(rows.noise, own, float(f))) for f in NOISE_LEVELS]
            prior = [-0.5 * (log(float(f)) / NOISE_EFOLDS) ** 2 for f in NOISE_LEVELS]
            logs = [each.given.log_evidence() + p for each, p in zip(levels, prior, strict=True)]
            rows = levels[logs.index(max(logs))]
        return self.changed(noise=rows.noise)


def weighed(before: Before, marker: str) -> WeighedRows:
    """The new rows with their weights, and with the markers as free as is asked or as is most probable.

    Args:
        before: the old map, and where devices and markers are. marker: see :func:`diffeo_calib.recalibrate`.
    """
    own, place, ball = fitted_markers(before.fitted), before.place, None if before.new_ball else before.ball
    other, known = own.clone(), slice(len(own) - before.new_ball)
    if place is not None:
        other[known] = place.registration.markers[known]
    elif ball is not None:
        other[-1] = ball
    places = {"same": own, "moved": own, "other": other}
    if place is None and ball is None:
        names = ["same"]
    elif marker != "evidence":
        names = [marker]
    else:
        names = [name for name, (first, _) in MARKER_DEVIATIONS.items() if place is None or first == place.metres]
    found = [WeighedRows.of(before, places[name], name).levelled().with_weights() for name in names]
    return max(found, key=lambda one: one.given.log_evidence() + UNMOVED_LOG_ODDS * (one.marker == "same"))


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
    points = seen.unflatten(1, (-1, 3))
    devices = [fitting_devices(table, points[own]) for table, own in before.readings]
    readings = reading_sets(before.readings, devices)
    if told is not None and noise is not None and len(told.rows) == len(seen):
        return told.noise_model, noise, {"y": told.y, "observe": None, "placement": Placement(sets)}
    rows = stacked(before.data.q, told, readings, seen.shape[1])
    old = before.fitted.noise
    usual = old.covariance.diagonal(dim1=1, dim2=2)[old.visible].median()  # variance of what was measured, m^2
    total = torch.diag_embed(usual.expand_as(rows.y))
    if told is not None and noise is not None:
        own = total[told.rows]
        own[:, : noise.shape[1], : noise.shape[1]] = noise
        total[told.rows] = own
    if rows.noise_model.stated:
        total = larger(total, rows.noise_model.known)
    model = rows.noise_model.without_known
    known = {"y": rows.y, "observe": rows.observe, "placement": Placement((*sets, *readings))}
    return model, without_hidden(total, model.visible), known


def _coordinates(before: Before, new: Measurements, rows: Tensor, seen: Tensor) -> tuple[Told, Tensor, list[DeviceSet]]:
    """Rows (M,) that tell coordinates, in the model's frame; their noise, sockets, and errors of cameras."""
    T, fitted = before.transform, before.fitted
    table = new.in_frames(torch.linalg.inv(T).expand(len(new), -1, -1))
    block = typical_noise(fitted.noise) if fitted.slopes is None else fitted.new_noise
    noise = noise_of_rows(fitted, new, T, block, 1.0)
    sets, table = SocketDevices.around_model(table, rows, seen)
    y = table.points.flatten(1)
    sensor = NoiseModel.of(table, 0.0).without_known
    y, noise = torch.where(y.isnan(), seen[rows], y), without_hidden(noise, sensor.visible)
    return Told(rows, y, sensor), noise, [*sets, *CameraErrors.around(table, rows)]
