"""`compare`: what has changed between a model and new rows, or between two models of one robot.

Another model is tested as rows are: what it predicts of the markers at configurations of the fits is what was measured,
and its errors there, which these rows share, are a drift of unit size.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.recalibration.changes import LEVEL, Changes, Offset, hidden_offsets
from diffeo_calib.calibration.recalibration.find_changes import FEWEST_ROWS, find_changes
from diffeo_calib.calibration.recalibration.find_place import find_place
from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.calibration.recalibration.new_set_up import (
    Marker,
    check_arguments,
    place_again,
    warn_of_places,
    weighed,
)
from diffeo_calib.common.checks import check_number, check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.threads import small_work
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.registered_map import RegisteredMap, Registration, moved
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conditional import roots
from diffeo_calib.robots.cartesian import is_cartesian, pose_inputs, turns_nowhere
from diffeo_calib.robots.payload import common_mass, under_mass, words_of_mass
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.errors import Evaluations

MOST_PREDICTED = 60
"""Configurations of two fits at which the models are compared."""
MOST_USUAL = 100
"""Rows of the fit that show how certain a model is there."""
UNKNOWN_PER_USUAL = 5.0
"""Expected errors of rows, relative to those at the rows of the fit, from which rows do not tell whether it changed."""


@dataclass(frozen=True, repr=False)
class Comparison:
    """A model and new rows of its robot, or what another model predicts of it.

    Args:
        moved: where measuring device and markers are now; None where no device measured coordinates.
        changes: what has changed in the robot itself.
        errors: of the rows from the model, devices and markers found anew, kind by kind and in the unit of each.
        expectations: what the model's own uncertainty and noise lead to expect of them. Of each ``rms`` and
            ``expected`` are the RMS of measured positions, m, see :attr:`Evaluations.rms`.
        usual: what was expected of them where the old model is as certain as at the rows of its fit.
        hidden: offsets that explain new places of device or markers as well.
        payload: mass under which two models are compared, in the unit of the first one's measurements; None without.
    """

    moved: Registration | None
    changes: Changes
    errors: Evaluations
    expectations: Evaluations
    usual: Evaluations
    hidden: tuple[Offset, ...] = ()
    payload: float | None = None

    rms = property(lambda self: self.errors.rms)
    expected = property(lambda self: self.expectations.rms)

    @property
    def telling(self) -> bool:
        """Whether the old model is certain enough at these rows: what it does not know there hides changes."""
        return any(one.rms < UNKNOWN_PER_USUAL * self.usual[kind].rms for kind, one in self.expectations.items())

    def __str__(self) -> str:
        if self.telling or self.changes.found:
            words = "; ".join(map(str, self.hidden)) if self.hidden and not self.changes.found else str(self.changes)
            return words_of_mass(self.payload) + words
        return (
            "these rows cannot tell whether anything has changed: the old model expects errors of them "
            f"({self.expectations.rms_text}) far above those at the rows of its fit ({self.usual.rms_text}); measure "
            "poses like those of the fit, or recalibrate with these rows"
        )

    def __repr__(self) -> str:
        return f"Comparison(rms: {self.errors.rms_text}; expected: {self.expectations.rms_text}: {self})"


@small_work()
@outside_inference_mode
def compare(
    model: CalibratedKinematics,
    other: Any,
    *,
    marker: Marker = "evidence",
    level: float = LEVEL,
    seed: int = 0,
) -> Comparison:
    """Find what has changed since a calibration.

    Args:
        model: a calibrated model.
        other: new rows of its robot, of any kinds and in any frame, see :func:`diffeo_calib.recalibrate`; or another
            calibrated model of it, in any frame and with markers anywhere.
        marker: for measurements, see :func:`diffeo_calib.recalibrate`.
        level: probability that anything is named although nothing has changed.
        seed: of the samples.

    Returns:
        what has changed. A change of a joint offset is added to what the joint reads, by the new rows or the second
        model against the first: q + change is where the joint is if the old model has it at q.

    Raises:
        InputError: arguments of another kind, models of different robots.
        MeasurementError: too few rows, or rows that cannot belong to this robot.
    """
    check_seed(seed)
    check_number(level, "`level`", above=0.0, below=1.0)
    measured, payload = not isinstance(other, CalibratedKinematics), None
    if measured:
        check_arguments(model, other, marker)
        rows = weighed(place_again(model, other, marker), marker)
    else:
        payload = common_mass(model.payload, other.payload)
        model = under_mass(model, payload).to(HOST)
        rows = _predicted_rows(model, under_mass(other, payload).to(HOST))
    changes, _ = find_changes(rows, level=level, seed=seed)
    if measured:
        warn_of_places(rows.set_up, marker, outliers=not changes.found, excess=not changes.found)
    q = model.configurations  # what is usual is expected at the rows of its fit
    _, covariance = model.predict(q[:: -(-len(q) // MOST_USUAL)], noise=False)
    variance = float(covariance.diagonal(dim1=-2, dim2=-1).mean().clamp(min=0))
    usual = (variance + rows.noise.diagonal(dim1=1, dim2=2)).sqrt()
    usual = usual.masked_fill(~rows.visible, nan)
    return Comparison(
        moved=rows.set_up.registration if measured else None,
        changes=changes,
        errors=rows.by_kind(rows.placed_residual),
        expectations=rows.by_kind(rows.expected_residual),
        usual=rows.by_kind(usual),
        hidden=hidden_offsets(model.robot, rows.set_up, changes) if measured else (),
        payload=payload,
    )


def _predicted_rows(model: CalibratedKinematics, other: CalibratedKinematics) -> NewRows:
    """What another model predicts of the markers of a model, at configurations of both fits that both know."""
    if model.robot.joint_names != other.robot.joint_names:
        expected, got = ", ".join(model.robot.joint_names), ", ".join(other.robot.joint_names)
        raise InputError.of("models of one robot", expected=f"joints {expected}", got=got)
    markers = model.nominal.geometry.markers
    if model.registration is not None and model.markers != markers:
        got = f"a model registered with {model.markers} marker(s), fitted with {markers}"
        fix = "pass the model as it was before its registration: places are found anew"
        raise InputError.of("the first model", expected="the markers of its fit", got=got, fix=fix)
    fits = _inputs(model.robot, other.robot, other.configurations), model.configurations
    low = torch.maximum(*(own.amin(0) for own in fits))
    high = torch.minimum(*(own.amax(0) for own in fits))
    q = torch.cat(fits)
    q = q[((q >= low) & (q <= high)).all(1)]
    if len(q) < FEWEST_ROWS:
        name = model.robot.joint_names[int((low - high).argmax())]
        what = f"the models hardly have configurations in common, above all of {name}"
        raise InputError.of(what, fix="compare a model with measurements")
    q = q[:: -(-len(q) // MOST_PREDICTED)]
    there = _inputs(other.robot, model.robot, q)

    def measured(own: CalibratedKinematics, q: Tensor, points: Tensor) -> Measurements:
        return Measurements.of_points(q, points.detach(), None, model.lever).with_load(own.nominal.load)

    fitted = other.map.unregistered
    found = find_place(fitted, other.lever, measured(other, there, model(q)))[1]
    placed = RegisteredMap(moved(fitted, found.transform), found)
    new = measured(model, q, placed(there).unflatten(1, (-1, 3)))
    rows = weighed(place_again(model, new, "other"), "other")
    errors, _ = roots(placed.conditional.covariance_between(placed.geodesic.linearise(there)))
    return rows.drifting([errors.unflatten(0, (len(q), -1))]).with_weights()


def _inputs(robot: Tree, other: Tree, q: Tensor) -> Tensor:
    """Joint values (N, n) that mean the same for a robot as these for another: of commanded poses to each its own."""
    alike = turns_nowhere(robot) or not is_cartesian(robot)
    return q if alike else pose_inputs(robot, other(q))
