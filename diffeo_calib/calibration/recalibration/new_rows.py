"""New rows beside an old model, linearised where device and markers are: what later verbs condition on.

Everything is in the frame of the old map. Residuals y - h(k1(q; m)) of what was measured, h, are errors of the map,
places of devices and markers that are open since, and what has drifted: see :class:`LinearRows`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffeo_calib.calibration.placing.lens import CameraErrors
from diffeo_calib.calibration.placing.place import Told, stacked
from diffeo_calib.calibration.placing.placement import DeviceSet, Placement, Sessions
from diffeo_calib.calibration.placing.readings import ReadingDevices, reading_sets
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.common.device import HOST
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.registered_map import Registration, place_slopes, robot_map, turned
from diffeo_calib.maps.linearisation import Linearisation, Numbers
from diffeo_calib.maps.noise import mean_block, without_hidden
from diffeo_calib.maps.observation import Stacked
from diffeo_calib.measurements.poses import block_diagonal, own_blocks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.linear_rows import Evidence, LinearRows
from diffeo_calib.regression.regions import OTHER_DATE, region_factor, region_scale
from diffeo_calib.regression.tails import Tails, estimated, gross_weights
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.sensors.coordinates import errors_of_kinds, fitting_devices
from diffeo_calib.sensors.errors import Evaluations
from diffeo_calib.sensors.kinds import Coordinates, OtherReadings

MAX_STEPS = 100
SMALL_STEP = 1e-2  # below such a step of the markers, m, C hardly changes
SETTLED = 1e-9  # the search for places ends with a step below this, m and rad
ROUNDS = 20
OUTLIER_WEIGHT = 0.2  # rows with a smaller weight hardly count
LINEARISED = "seen", "at", "residual", "by_places", "fit_covariance"  # without noise and priors


class UsualNoise(NamedTuple):
    """Usual noise of a row that tells coordinates."""

    block: Tensor  # (m, m) m^2
    factor: float  # on the variances of poses of the fit; 0 where the fit or the rows have other bodies


@dataclass(frozen=True, eq=False)
class NewSetUp:
    """New rows of any kinds, and the old map that is to explain them."""

    fitted: FittedMap  # the old map, with the ball of the new rows
    data: Any  # the new rows
    # those that tell coordinates, with the markers of the map, in the frame of the largest set-up
    coordinates: Coordinates | None
    readings: Sequence[OtherReadings] = ()  # the others
    sessions: Sequence[Sessions] = ()  # frames of the set-ups, if there are several: a set of devices
    # of the device that measured coordinates: the record, and its rows around the places; None without such a device
    registration: Registration | None = None
    registered: NewRows | None = None
    ball: Tensor | None = None  # (3,) where the new rows by themselves put the ball on its tip, m; None without one
    new_ball: bool = False  # whether the old model does not know it

    @property
    def transform(self) -> Tensor:
        """(4, 4) from the frame of the map to that of the new rows, m."""
        record = self.registration
        return torch.eye(4, dtype=self.data.q.dtype, device=HOST) if record is None else record.transform

    @property
    def seen_before(self) -> Tensor:
        """(P,) boolean: the markers that new rows show and that old rows showed."""
        shown = torch.zeros(robot_map(self.fitted).geometry.markers, dtype=torch.bool, device=HOST)
        if self.coordinates is not None:
            shown |= ~self.coordinates.table.points.isnan().any(2).all(0)
        shown[-1] |= self.ball is not None
        shown[-1] &= not self.new_ball
        return shown

    def rows(
        self,
        places: tuple[Tensor, Tensor],
        usual: UsualNoise,
        deviations: Tensor,
        *,
        same: bool = True,
        marker: str = "",
    ) -> NewRows:
        """The rows, weights 1, around T (4, 4) from the map's frame to theirs and markers (P, 3) on their tips, m."""
        (T, markers), q = places, self.data.q
        marks = FlangePoints(robot_map(self.fitted).under(self.data.payload), markers, same=same)
        points, at = self.fitted.geodesic.with_nominal(marks).linearised_value(q)
        points, nothing = points.detach(), torch.diag(0.0 * deviations)
        y, observe, sensor, noise, placement = self._measured(T, points, usual)
        rows = NewRows(
            set_up=self,
            marks=marks,
            transform=T,
            q=q,
            y=y,
            noise=noise,
            noise_model=sensor,
            tails=Tails.none(len(q), sensor.bodies, device=q.device),
            observe=observe,
            placement=placement,
            shared=noise[..., :0],
            deviations=deviations,
            away=nothing[0],
            known=nothing,
            by_fit=nothing[6:, 6:],
            centre=points.view(-1, 3).mean(0),
            drifts=noise[..., :0].flatten(0, 1),
            marker=marker,
        )
        vars(rows)["seen"] = points, at
        return rows.changed(shared=placement.shared(rows))

    def _measured(
        self, T: Tensor, predicted: Tensor, usual: UsualNoise
    ) -> tuple[Tensor, Stacked | None, NoiseModel, Tensor, Placement]:
        """Numbers, what these are of the points (M, 3 P), m, how they were measured, their noise, and the devices."""
        numbers, noise, sets = None, predicted[:0, :, None], list[DeviceSet]()
        if self.coordinates is not None:
            new, index = self.coordinates
            table = new.in_frames(torch.linalg.inv(T).expand(len(new), -1, -1))
            y, sensor = table.points.flatten(1), NoiseModel.of(table, 0.0).without_known
            numbers = Told(index, torch.where(y.isnan(), predicted[index], y), sensor)
            noise = without_hidden(noise_of_rows(self.fitted, new, table, T, usual), sensor.visible)
            sets += CameraErrors.around(table, index)
        sets += self.sessions
        points = predicted.unflatten(1, (-1, 3))
        devices = [fitting_devices(table, points[part]) for table, part in self.readings]
        readings = reading_sets(self.readings, devices)
        if numbers is not None and len(numbers.rows) == len(predicted):
            return numbers.y, None, numbers.noise_model, noise, Placement(sets)
        (y, sensor, observe), old = stacked(self.data.q, numbers, readings, predicted.shape[1]), self.fitted.noise
        variance = old.covariance.diagonal(dim1=1, dim2=2)[old.visible].median()  # of what was measured, m^2
        total = torch.diag_embed(variance.expand_as(y))
        if numbers is not None:
            total[numbers.rows, : noise.shape[1], : noise.shape[1]] = noise
        if sensor.stated:
            total = larger(total, sensor.known)
        sensor = sensor.without_known
        return y, observe, sensor, without_hidden(total, sensor.visible), Placement((*sets, *readings))


@dataclass(frozen=True, eq=False)
class NewRows:
    """M rows of a new set-up in the frame of a fit: frame, markers and devices are open, and parts may have drifted."""

    set_up: NewSetUp  # the rows as they were measured, and the old map
    marks: FlangePoints  # k0 of the markers where they are now, under the payloads of the rows
    transform: Tensor  # (4, 4) from the frame of the fit to that in which the rows were measured, m
    q: Tensor  # (M, n)
    y: Tensor  # (M, R) measured numbers, m; any where hidden
    noise: Tensor  # (M, R, R) m^2, with weights of 1
    noise_model: NoiseModel  # how they were measured
    tails: Tails  # their weights
    observe: Stacked | None  # what was measured of the markers; None for their coordinates
    placement: Placement  # devices that stand around the old model; what is not known of them, rows share
    shared: Tensor  # (M, R, c) effects of errors of unit variance that they share, m
    # (6 + 3 P,) of the device's frame and of the markers' coordinates before the rows, m and rad; 0 of what has not
    # moved
    deviations: Tensor
    away: Tensor  # (6 + 3 P,) from here to where they are most probable before the rows
    known: Tensor  # (6 + 3 P, 6 + 3 P) their covariance by an earlier registration
    by_fit: Tensor  # (3 P, 3 P) B of the markers
    centre: Tensor  # (3,) about which the frame turns, m
    drifts: Tensor  # (M R, c) columns of unit variance of what has changed in the robot since, m
    marker: str  # which the markers are: "same", "moved", "other", or "stated" for a prior of a user
    changed_among: str = ""  # what has changed among the rows, in a sentence

    def __len__(self) -> int:
        return len(self.q)

    @property
    def fitted(self) -> FittedMap:
        """The old map."""
        return self.set_up.fitted

    @property
    def nominal(self) -> GeometryMap:
        """Nominal map of the old model."""
        return robot_map(self.fitted)

    @property
    def visible(self) -> Tensor:
        """(M, R) boolean, the numbers that were measured."""
        return self.noise_model.visible

    @property
    def of_coordinates(self) -> bool:
        """Whether old and new rows are coordinates of markers alone."""
        return self.observe is None and self.fitted.slopes is None

    # --- the linearisation ---

    @cached_property
    def seen(self) -> tuple[Tensor, Linearisation]:
        """The points (M, 3 P) by the fit, m, and their linearisation."""
        points, at = self.fitted.geodesic.with_nominal(self.marks).linearised_value(self.q)
        return points.detach(), at

    @property
    def points(self) -> Tensor:
        """(M, 3 P) by the fit, m."""
        return self.seen[0]

    @property
    def slopes(self) -> Tensor:
        """(M, R, 3 P) of what was measured."""
        m = self.points.shape[1]
        eye = torch.eye(m, dtype=self.points.dtype, device=self.points.device).expand(len(self), m, m)
        return eye if self.observe is None else self.observe.slope(self.points).detach()

    @cached_property
    def at(self) -> Linearisation:
        """Linearised prediction of the fit for the measured numbers."""
        return self.seen[1] if self.observe is None else self.seen[1].projected(self.slopes)

    @cached_property
    def residual(self) -> Tensor:
        """(M, R) measured minus predicted, m; zero where hidden."""
        away = self.y - (self.points if self.observe is None else self.observe.value(self.points))
        return away.masked_fill(~self.visible, 0.0)

    @cached_property
    def by_places(self) -> Tensor:
        """(M, R, 6 + 3 P) derivatives by frame and markers."""
        deformation = self.fitted.geodesic.with_nominal(self.marks)
        return self.slopes @ place_slopes(deformation, self.seen[1], self.points, self.centre)

    @property
    def by_tool(self) -> Tensor:
        """(M, R, 3 P) derivatives by the places of the markers on their tips."""
        return self.by_places[..., 6:]

    @cached_property
    def fit_covariance(self) -> Tensor:
        """(M R, M R) posterior covariance of the fit at the rows, m^2."""
        return self.fitted.conditional.covariance_between(self.at)

    # --- conditioning ---

    @property
    def weighted_noise(self) -> Tensor:
        """(M, R, R) R with the noise of every body divided by its weight, m^2."""
        return self.noise_model.weighted(self.noise, self.tails)

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

    def evidence(self, root: Tensor) -> Evidence:
        """Evidence of unknowns with these effects (M, R, c)."""
        return Evidence.of(root.flatten(0, 1), self.process)

    @property
    def old_markers(self) -> Tensor:
        """(P, 3) where the markers are most probable before the rows, in the frames of their tips, m."""
        return self.marks.points + self.away[6:].view(-1, 3)

    @property
    def mean_noise(self) -> Tensor:
        """(R, R) mean covariance of the rows, m^2: that of the fit for points that no row shows."""
        mean, unseen = mean_block(self.noise, self.visible), ~self.visible.any(0)
        both = unseen[:, None] & unseen
        return torch.where(both, self.fitted.new_noise, mean) if bool(unseen.any()) else mean

    @property
    def new_noise(self) -> Tensor:
        """Covariance (m, m) of a new measurement in the new set-up, m^2, inflated for heavy tails.

        Few rows seldom show the tails: it is no smaller than that of the old set-up, if this had the same markers.
        """
        old = self.fitted.new_noise
        if not self.of_coordinates:
            return old
        block = self.mean_noise * region_factor(self.tails.freedom, int(self.noise_model.freedom.max()))
        return block if not self.marks.same or float(block.trace()) > float(old.trace()) else old

    @cached_property
    def inflation(self) -> float:
        """Factor on all variances with which 95 % regions hold rows that took no part, at least one.

        The scales were chosen for another session, with few rows of other places, temperatures or loads. The errors of
        every new row as predicted by the old model and all others judge them, see :func:`region_scale`.
        """
        ratio = float(self.new_noise.trace() / self.mean_noise.trace()) if self.of_coordinates else 1.0
        squares, dim = self._left_out_squares(ratio * self.noise), self.noise_model.freedom
        if (weights := gross_weights(squares, dim)) is not None:  # gross rows are named, and say nothing of the robot
            squares = squares.masked_fill(weights < OUTLIER_WEIGHT, torch.nan)
        return max(1.0, region_scale(squares, dim, efolds=OTHER_DATE))

    def _left_out_squares(self, noise: Tensor) -> Tensor:
        """(M, bodies) squared errors of new rows with this noise, as the old model and all other rows predict them."""
        covariance = torch.linalg.inv(self.given.precisions)
        error = covariance @ self.given.solved[..., None]
        return self.noise_model.squares(covariance - self.weighted_noise + noise, error @ error.mT)

    @property
    def placed_residual(self) -> Tensor:
        """(M, R) residuals with devices and markers where the rows put them, m; NaN where hidden."""
        return self.given.shown(self.given.after_placing @ self.given.target)

    @property
    def process(self) -> Process:
        """What is known by the rows: of the old map too, with the covariance of its errors."""
        rows = self.given
        numbers, alpha = Numbers.of(self.at, rows.target.view_as(self.y)), rows.factor.white(rows.target[:, None])[:, 0]
        return Process(self.fitted.conditional, numbers, alpha.new_zeros(len(alpha), 0), rows.factor, alpha)

    def by_kind(self, errors: Tensor) -> Evaluations:
        """Errors (M, R) of the numbers of all rows, m, NaN where nothing was measured, in the unit of each kind."""
        readings = [devices for devices in self.placement if isinstance(devices, ReadingDevices)]
        return errors_of_kinds(errors, self.set_up.coordinates, readings)

    # --- the same rows otherwise ---

    def changed(self, **changes: object) -> NewRows:
        """Change the noise or the prior; what does not change is computed once."""
        other = replace(self, **changes)
        vars(other).update({name: getattr(self, name) for name in LINEARISED})
        if changes.keys() <= {"noise", "tails"}:
            vars(other)["given"] = replace(self.given, noise=other.weighted_noise)
        return other

    def kept(self, index: Tensor) -> NewRows:
        """Some of the rows (k,), with their weights."""
        if len(index) == len(self):
            return self
        fields: dict[str, Any] = {name: getattr(self, name)[index] for name in ("q", "y", "noise", "shared")}
        fields |= {name: getattr(self, name).rows(index) for name in ("marks", "noise_model", "tails")}
        fields["drifts"] = self.drifts.unflatten(0, self.y.shape)[index].flatten(0, 1)
        other = replace(self, **fields, observe=None if self.observe is None else self.observe.rows(index))
        vars(other).update(seen=(self.points[index], self.seen[1].rows(index)), by_places=self.by_places[index])
        return other

    def drifting(self, roots: Sequence[Tensor]) -> NewRows:
        """The rows where parts with these columns (M, R, c) of their covariance drift, m."""
        return self.changed(drifts=torch.cat([self.drifts, *(root.flatten(0, 1) for root in roots)], 1))

    def with_weights(self) -> NewRows:
        """Weigh the rows by Student's t, by expectation maximisation, or as good and gross ones."""
        rows = self

        def squares(tails: Tails, *, left_out: bool) -> Tensor:
            nonlocal rows
            rows = rows if rows.tails is tails else self.changed(tails=tails)
            if left_out:
                return rows._left_out_squares(rows.noise)
            noise, given = rows.weighted_noise, rows.given
            error = noise @ given.solved[..., None]
            moments = error @ error.mT + noise - noise @ given.precisions @ noise
            return rows.noise_model.squares(rows.noise, moments)

        tails = estimated(self.tails, self.noise_model.freedom, squares, ROUNDS)
        return rows if rows.tails is tails else self.changed(tails=tails)

    def moved(self, step: Tensor) -> NewRows:
        """The rows of coordinates around other places, after a step (6 + 3 P,) of frame and markers, m and rad."""
        turn, markers = rotation(step[3:6]), step[6:].view(-1, 3)
        motion = transforms(turn, self.centre + step[:3] - turn @ self.centre)
        other = replace(
            self,
            marks=FlangePoints(self.marks.fitted, self.marks.points + markers, same=self.marks.same),
            transform=self.transform @ motion,
            y=((self.y.unflatten(1, (-1, 3)) - motion[:3, 3]) @ turn).flatten(1),
            away=self.away - pad(step[6:], (6, 0)),
        )
        if "fit_covariance" in vars(self) and float(markers.abs().max()) < SMALL_STEP:
            vars(other)["fit_covariance"] = self.fit_covariance
        return other

    def settled(self) -> NewRows:
        """The rows of coordinates around the best places, by Gauss-Newton."""
        rows = self
        for _ in range(MAX_STEPS):
            step = rows.given.step[: len(rows.free)]
            if float(step.abs().max()) < SETTLED:
                break
            rows = rows.moved(step.new_zeros(len(self.deviations)).index_copy(0, rows.free, step))
        return rows


def noise_of_rows(fitted: FittedMap, new: Measurements, there: Measurements, T: Tensor, usual: UsualNoise) -> Tensor:
    """(M, m, m) noise of new rows in the model's frame, m^2: what they state, and what usual rows err by beyond it.

    Poses err by shifts and turns, which displace their points as these stand: their deviations are those of usual rows,
    each row has modes of its own. A camera's distance from its board makes errors of turns large or small.

    Args:
        fitted: a fit. new, there: the rows in their own frame and in that of the model.
        T: (4, 4) from the frame of the model to theirs, m. usual: noise of a row.
    """
    bodies, given = new.bodies, new.covariance
    total = usual.block.new_zeros(len(new), *usual.block.shape) if given is None else turned(given, T[:3, :3].mT)
    alike = usual.factor > 0.0 and fitted.slopes is None and bool(fitted.noise.visible.all())
    now, old = bodies.modes(there), bodies.modes_of(there, fitted.measured().unflatten(1, (-1, 3))) if alike else None
    if now is None or old is None:
        mean = mean_block(total, new.visible.repeat_interleave(3, 1))
        return total + larger(mean, usual.block) - mean
    blocks = own_blocks(fitted.noise.covariance, old.shape[1])  # (N, T, 9, 9)
    to_modes = torch.linalg.pinv(old)
    sizes, stated = (
        (to @ each @ to.mT).diagonal(dim1=2, dim2=3).median(0).values  # (T, 6)
        for to, each in ((to_modes, blocks), (torch.linalg.pinv(now), own_blocks(total, now.shape[1])))
    )
    rest = (blocks - old @ to_modes @ blocks).diagonal(dim1=2, dim2=3).sum(2).median(0).values
    each = (now * (usual.factor * sizes - stated).clamp(min=0.0)[:, None]) @ now.mT
    each.diagonal(dim1=2, dim2=3).add_(usual.factor * rest[:, None] / (old.shape[2] - old.shape[3]))
    return total + block_diagonal(each)


def larger(first: Tensor, second: Tensor) -> Tensor:
    """A covariance (M, m, m) that is nowhere smaller than either of two."""
    values, vectors = torch.linalg.eigh(second - first)
    total = first + (vectors * values.clamp(min=0.0)[..., None, :]) @ vectors.mT
    return 0.5 * (total + total.mT)
