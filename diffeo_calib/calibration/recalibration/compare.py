"""`compare`: what has changed between a model and new rows, or between two models of one robot."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan, sqrt
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.recalibration.changes import LEVEL, Changes, find_changes
from diffeo_calib.calibration.recalibration.new_set_up import (
    Marker,
    check_arguments,
    place_again,
    warn_of_places,
)
from diffeo_calib.calibration.recalibration.offsets import HiddenOffset, changed_offsets, hidden_offsets
from diffeo_calib.calibration.recalibration.recalibrate import weighed
from diffeo_calib.common.checks import check_count, check_number, check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.re_registration.register_again import find_place
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap, Registration, moved
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.payload import common_mass, under_mass, words_of_mass
from diffeo_calib.sensors.errors import Evaluations

GEODESIC_ROWS = 80
"""Configurations that the geodesic from one model to the other carries along."""
OFFSET_ROWS = 60
"""Configurations that show which joint offsets differ between two models."""
CHUNK = 200
"""Configurations whose joint covariance is computed at once."""
MOST_CONFIGURATIONS = 100_000
MOST_USUAL = 100
"""Rows of the fit that show how certain a model is there."""
UNKNOWN_PER_USUAL = 5.0
"""Expected errors of rows, relative to those at the rows of the fit, from which rows do not tell whether it changed."""


@dataclass(frozen=True, repr=False)
class Comparison:
    """A model and new rows of its robot.

    Args:
        moved: where measuring device and markers are now; None where no device measured coordinates.
        changes: what has changed in the robot itself.
        errors: of the rows from the model, devices and markers found anew, kind by kind and in the unit of each.
        expectations: what the model's own uncertainty and noise lead to expect of them. Of each ``rms`` and
            ``expected`` are the RMS of measured positions, m, see :attr:`Evaluations.rms`.
        usual: what was expected of them where the old model is as certain as at the rows of its fit.
        hidden: offsets that explain new places of device or markers as well.
    """

    moved: Registration | None
    changes: Changes
    errors: Evaluations
    expectations: Evaluations
    usual: Evaluations
    hidden: tuple[HiddenOffset, ...] = ()

    rms = property(lambda self: self.errors.rms)
    expected = property(lambda self: self.expectations.rms)

    @property
    def telling(self) -> bool:
        """Whether the old model is certain enough at these rows: what it does not know there hides changes."""
        return any(one.rms < UNKNOWN_PER_USUAL * self.usual[kind].rms for kind, one in self.expectations.items())

    def __str__(self) -> str:
        if self.telling or self.changes.found:
            return "; ".join(map(str, self.hidden)) if self.hidden and not self.changes.found else str(self.changes)
        return (
            "these rows cannot tell whether anything has changed: the old model expects errors of them "
            f"({self.expectations.rms_text}) far above those at the rows of its fit ({self.usual.rms_text}); measure "
            "poses like those of the fit, or recalibrate with these rows"
        )

    def __repr__(self) -> str:
        return f"Comparison(rms: {self.errors.rms_text}; expected: {self.expectations.rms_text}: {self})"


@dataclass(frozen=True, eq=False, repr=False)
class ModelComparison:
    """Two models of one robot over a workspace, after the second was brought into place of the first.

    Args:
        q: (N, n) configurations. difference: (N, P, 3) second minus first, m.
        deviation: (N, P) standard deviation of the length of this difference as both models claim it, m, if they are of
            an unchanged robot and share no rows.
        transmissions: name of each joint -> RMS difference of its transmission errors over its range, rad or m.
        geodesic_length: length of the geodesic of deformations that leads from the first to the second: the root of the
            sum of squares of its parts in units of their prior standard deviations. Zero for equal models.
        changes: joint offsets that have changed.
        payload: mass that both carry, in the unit of the first model's measurements; None if neither knows payloads.
    """

    q: Tensor
    difference: Tensor
    deviation: Tensor
    transmissions: dict[str, float]
    geodesic_length: float
    changes: Changes
    payload: float | None = None

    @property
    def rms(self) -> float:
        """RMS length of the difference, m."""
        return float(self.difference.square().sum(-1).mean().sqrt())

    @property
    def expected(self) -> float:
        """The RMS length that both models' uncertainties lead to expect, m: too large where they share rows."""
        return float(self.deviation.square().mean().sqrt())

    @property
    def largest(self) -> float:
        """Largest length of the difference, m."""
        return float(self.difference.norm(dim=-1).max())

    def __str__(self) -> str:
        offsets = "; ".join(map(str, self.changes.found))
        usual = "about 1 if nothing has changed, less if they share rows; no change of a joint offset was found"
        differ = f"the models differ by {1e3 * self.rms:.3f} mm RMS (at most {1e3 * self.largest:.3f} mm)"
        explained = f"{self.rms / self.expected:.1f} times the {1e3 * self.expected:.3f} mm that uncertainties explain"
        why = f"beyond chance: {offsets}" if offsets else usual
        length = f"geodesic length {self.geodesic_length:.2f}"
        return f"{words_of_mass(self.payload)}{differ}, {explained} ({why}); {length}"

    def __repr__(self) -> str:
        return f"ModelComparison({len(self.q)} configurations: {self})"


@small_work()
@outside_inference_mode
def compare(
    model: CalibratedKinematics,
    other: Any,
    *,
    marker: Marker = "evidence",
    level: float = LEVEL,
    count: int = 1000,
    seed: int = 0,
) -> Comparison | ModelComparison:
    """Find what has changed since a calibration.

    Args:
        model: a calibrated model.
        other: new rows of its robot, of any kinds and in any frame, see :func:`diffeo_calib.recalibrate`; or another
            calibrated model of it, in any frame and with markers anywhere.
        marker: for measurements, see :func:`diffeo_calib.recalibrate`.
        level: probability that anything is named although nothing has changed.
        count: for models, number of configurations, drawn from the joint ranges that both models know.
        seed: of the samples.

    Returns:
        a :class:`Comparison` with measurements, a :class:`ModelComparison` with a model. A change of a joint offset is
        added to what the joint reads, by the new rows or the second model against the first: q + change is where the
        joint is if the old model has it at q.

    Raises:
        InputError: arguments of another kind, models of different robots or without a common joint range.
        MeasurementError: too few rows, or rows that cannot belong to this robot.
    """
    check_seed(seed)
    check_number(level, "`level`", above=0.0, below=1.0)
    if isinstance(other, CalibratedKinematics):
        return _models(model, other, count, seed)
    check_arguments(model, other, marker)
    before = place_again(model, other, marker)
    rows = weighed(before, marker)
    changes, _ = find_changes(rows, level=level, seed=seed)
    warn_of_places(before, marker, outliers=not changes.found, excess=not changes.found)
    usual = (_usual_deviation(model) ** 2 + rows.noise.diagonal(dim1=1, dim2=2)).sqrt()
    usual = usual.masked_fill(~rows.visible, nan)
    errors, expected, usual = map(rows.by_kind, (rows.placed_residual, rows.expected_residual, usual))
    return Comparison(
        before.registration, changes, errors, expected, usual, hidden_offsets(model.robot, before, changes)
    )


def _usual_deviation(model: CalibratedKinematics) -> float:
    """Standard deviation of a model per coordinate at the rows of its fit, m, noise left out."""
    q = model.configurations
    _, covariance = model.predict(q[:: -(-len(q) // MOST_USUAL)], noise=False)
    return float(covariance.diagonal(dim1=-2, dim2=-1).mean().clamp(min=0).sqrt())


def _models(first: CalibratedKinematics, second: CalibratedKinematics, count: int, seed: int) -> ModelComparison:
    if first.robot.joint_names != second.robot.joint_names:
        expected, got = ", ".join(first.robot.joint_names), ", ".join(second.robot.joint_names)
        raise InputError.of("models of one robot", expected=f"joints {expected}", got=got)
    check_count(count, "`count`", least=GEODESIC_ROWS, most=MOST_CONFIGURATIONS)
    fitted = first.nominal.geometry.markers
    if first.registration is not None and first.markers != fitted:
        got = f"a model registered with {first.markers} marker(s), fitted with {fitted}"
        fix = "pass the model as it was before its registration: places are found anew"
        raise InputError.of("the first model", expected="the markers of its fit", got=got, fix=fix)
    payload = common_mass(first.payload, second.payload)
    first, second = under_mass(first, payload), under_mass(second, payload)
    q = _common_configurations(first, second, count, seed)
    placed = _in_place_of(second, first, q[: len(q) // 5])
    other_mean, some = placed(q).detach(), slice(OFFSET_ROWS)
    difference = other_mean - first(q).detach().flatten(1)
    slopes = placed.place_slopes(q).unflatten(0, difference.shape)
    found_by = torch.linalg.pinv(slopes[some].flatten(0, 1))
    difference = difference - slopes @ (found_by @ difference[some].flatten())
    variances = _variances(first.map, placed, q, slopes @ found_by)
    transmissions = {name: _transmission(first, second, name, q) for name in first.robot.joint_names}
    length = _geodesic_length(first, q[:GEODESIC_ROWS], other_mean[:GEODESIC_ROWS])
    changes = changed_offsets(first.robot, first.map, placed, q[some], difference[some])
    deviation = variances.unflatten(1, (-1, 3)).sum(-1).sqrt()
    return ModelComparison(q, difference.unflatten(1, (-1, 3)), deviation, transmissions, length, changes, payload)


def _variances(first: FittedMap, placed: RegisteredMap, q: Tensor, places: Tensor) -> Tensor:
    """Variances (N, m) of the difference of two maps at q, m^2: of both, but for what other places take out of it.

    The covariance of the registration would not do: it is wider the more the models differ.

    Args:
        first, placed: the maps. q: (N, n).
        places: (N, m, F m) how the first F configurations move the others when device and markers are placed by them.
    """
    found, count = [], places.shape[2] // places.shape[1]
    for rows, by_places in zip(q.split(CHUNK), places.split(CHUNK), strict=True):
        x = torch.cat([q[:count], rows])
        K = first.joint_covariance(x) + FittedMap.joint_covariance(placed, x)
        own = torch.eye(by_places.shape[:2].numel(), dtype=K.dtype, device=K.device)
        A = torch.cat([-by_places.flatten(0, 1), own], 1)
        found.append(((A @ K) * A).sum(1).clamp(min=0.0).view(by_places.shape[:2]))
    return torch.cat(found)


def _in_place_of(model: CalibratedKinematics, other: CalibratedKinematics, q: Tensor) -> RegisteredMap:
    """The map of a model, with device and markers where another model of the robot has them."""
    own = model.to(HOST)
    virtual = Measurements.of_points(q, other(q), None, other.lever).with_load(own.nominal.load)
    fitted = own.map.unregistered
    found = find_place(fitted, own.nominal, own.lever, virtual).registration
    return RegisteredMap(moved(fitted, found.transform), found)


def _common_configurations(first: CalibratedKinematics, second: CalibratedKinematics, count: int, seed: int) -> Tensor:
    """(count, n) configurations in the joint ranges of both models' rows."""
    low = torch.maximum(first.configurations.amin(0), second.configurations.amin(0).to(HOST))
    high = torch.minimum(first.configurations.amax(0), second.configurations.amax(0).to(HOST))
    if bool((low > high).any()):
        name = first.robot.joint_names[int((low - high).argmax())]
        raise InputError.of(f"the models have no range of {name} in common", fix="compare a model with measurements")
    draws = torch.rand(count, len(low), generator=seeded(seed), dtype=low.dtype, device=HOST)
    return low + draws * (high - low)


def _transmission(first: CalibratedKinematics, second: CalibratedKinematics, name: str, q: Tensor) -> float:
    """RMS difference of a joint's transmission errors, constant part left out."""
    values = q[:, first.robot.joint_names.index(name)]
    change = second.transmission(name, values) - first.transmission(name, values)
    return float((change - change.mean()).square().mean().sqrt())


def _geodesic_length(model: CalibratedKinematics, q: Tensor, points: Tensor) -> float:
    """Length sqrt(2 E) of the geodesic from a model to the map with these points, in the model's own kernels."""
    spec = model.map.geodesic.spec
    problem = Problem(
        model.map.deformation.__call__,
        q,
        points.flatten(1),
        joint_kernel=spec.joint_kernel,
        task_kernel=spec.task_kernel,
        noise=(model.map.noise.mean if model.map.slopes is None else model.map.new_noise).expand(len(q), -1, -1),
        markers=model.markers,
    )
    joint, task = fit(problem).model.geodesic.field_energies()
    return sqrt(2.0 * float(joint + task))
