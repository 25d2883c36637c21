"""`recalibrate`: a calibrated model and new rows in a new set-up become one model that knows both.

1 place       where the measuring device stands and the markers sit now (find_place.py)
2 rows        weights of the new rows, seen by the old model; whether the markers moved, by their evidence
3 changes     what else has changed: named parts may drift (find_changes.py), and everything a little
4 fit         the exact model of old and new rows, with the old scales (register.py)

`compare`: what has changed between a model and new rows, or between two models of one robot.

Another model is tested as rows are: what it predicts of the markers at configurations of the fits is what was measured,
and its errors there, which these rows share, are a drift of unit size.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from math import nan
from typing import Any, Literal

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import RESIDUAL_TOLERANCE
from diffeo_calib.calibration.placing.placement import Placement
from diffeo_calib.calibration.recalibration.drift import Drift
from diffeo_calib.calibration.recalibration.find_changes import (
    FEWEST_ROWS,
    LEVEL,
    Changes,
    Offset,
    find_changes,
    hidden_offsets,
)
from diffeo_calib.calibration.recalibration.find_place import OTHER_MARKER, find_place, warn_about
from diffeo_calib.calibration.recalibration.new_rows import OUTLIER_WEIGHT, NewRows, NewSetUp
from diffeo_calib.calibration.recalibration.register import (
    Marker,
    both_dates,
    carried_devices,
    check_arguments,
    check_other_table,
    devices_beside,
    knows_ball,
    place_again,
    weighed,
)
from diffeo_calib.calibration.result import parts
from diffeo_calib.common.checks import check_number, check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import InputError, as_written, sentence, warn_user
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.result import Fit, Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.provenance import Provenance, check_note
from diffeo_calib.kinematics.registered_map import RegisteredMap, Registration, fitted_markers, moved
from diffeo_calib.maps.noise import Noise
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conditional import roots
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots.cartesian import is_cartesian, pose_inputs, turns_nowhere
from diffeo_calib.robots.payload import under_mass, words_of_mass
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import mounted_of
from diffeo_calib.sensors.errors import Evaluations

LOG = logging.getLogger(__name__)
CERTIFICATES = "coupling_residual", "end_residual", "energy", "status"  # of a fit that the summary of a model has, too
LARGEST_OUTLIER_PART = 0.5  # of the rows: with more of them it is not clear which are wrong
LARGEST_EXCESS = 10.0  # residuals by this factor above the expected ones are not those of a worn joint


@dataclass(frozen=True, repr=False)
class Recalibration:
    """A model that was calibrated anew with a few rows, and what has changed.

    Attributes:
        model: the calibrated kinematics in the new set-up.
        moved: where device and markers are now, see :class:`Registration`; ``moved.transform`` leads from the old
            measuring frame to the new one, that of the largest session. None where no device measured coordinates: the
            frame is that of the old model.
        placement: sockets, devices of readings and frames of further sessions, around the old model and in its frame.
        marker: whether the markers are the "same", have "moved" a little, or are "other" ones.
        changes: what has changed in the robot itself.
        tails: weights of the new rows; about 1 for inliers. outliers: lines of those that hardly count.
        before: errors of the new rows from the old model, registered to them, kind by kind and in the unit of each.
        after: the same from the new model.
        left_out: the same, each new row predicted by the old ones and the other new ones. Of each ``rms_before``,
            ``rms_after`` and ``left_out_rms`` are the RMS of measured positions, m, see :attr:`Evaluations.rms`.
        shift: (P, 3) of the markers from where the old model has them to where the new one does, in the frames of
            their tips, m; zero for those that no device showed again. None where no device measured coordinates.
        hidden: offsets that explain new places of device or markers as well, where no change is named.
        inflation: factor on all variances of the old scales with which regions hold the new rows, at least one.
        fit: the exact model's fit with its certificates.
    """

    model: CalibratedKinematics
    moved: Registration | None
    placement: Placement
    marker: str
    changes: Changes
    tails: Tails
    outliers: tuple[int, ...]
    before: Evaluations
    after: Evaluations
    left_out: Evaluations
    inflation: float
    fit: Fit
    shift: Tensor | None = None
    hidden: tuple[Offset, ...] = ()

    rms_before = property(lambda self: self.before.rms)
    rms_after = property(lambda self: self.after.rms)
    left_out_rms = property(lambda self: self.left_out.rms)

    def __repr__(self) -> str:
        return f"Recalibration({self.model!r}: {self.status})"

    @property
    def status(self) -> str:
        """How it ended, in one sentence."""
        return f"{self.fit.status}; {self.changes}"


@small_work()
@outside_inference_mode
def recalibrate(
    model: CalibratedKinematics,
    new: Any,
    *,
    marker: Marker = "evidence",
    drift: Literal["tested", "none"] = "tested",
    seed: int = 0,
    progress: Progress = silent,
    note: str = "",
) -> Recalibration:
    """Calibrate a robot anew with a few rows, starting from what an old calibration knew.

    Twenty rows do what about a hundred do without the old model. The measuring device may stand anywhere.

    Args:
        model: the old calibrated model, itself recalibrated or not.
        new: M rows of any kinds: :class:`Measurements` with as many markers as before, or poses where there were poses,
            of one or several sessions; a ball in sockets; :class:`Readings`; or :class:`Observations` of several kinds.
            A ball that the model does not know becomes one more marker. With payloads where there were payloads.
        marker: whether the markers on the tool are the "same" (within 0.05 mm), have "moved" by about a millimetre, or
            are "other" ones; by default the evidence of the rows decides.
        drift: "tested": parts of the robot that have changed, by a test at 1 %, may differ from what they were, and
            offsets, geometry, load and transmissions by as much as the rows say. "none": only device and markers may.
        seed: of the samples of that test.
        progress: called as ``progress(task, done, total)``.
        note: text that is kept with the model.

    Returns:
        a :class:`Recalibration`; ``.model`` is a model like that of a calibration.

    Raises:
        InputError: arguments of another kind, joints in another order, another number of markers.
            The table of the model's own fit.
        MeasurementError: too few rows, rows that leave the place of the device open, or rows that cannot belong to
            this robot: other units.
        KeyboardInterrupt: Ctrl-C; nothing is kept, since it takes seconds.

    Warns:
        DiffeoCalibWarning: as :meth:`CalibratedKinematics.registered`; distances of another scale; half of the
            rows contradicting the model; ``marker="same"`` although the rows say otherwise.
    """
    check_arguments(model, new, marker)
    check_other_table(model, new)
    if not isinstance(drift, str) or drift not in ("tested", "none"):
        raise InputError.of("`drift`", expected="'tested' or 'none'", got=as_written(drift))
    check_note(note)
    check_seed(seed)
    progress("registration", 0, 1)
    before = place_again(model, new, marker)
    rows = weighed(before, marker, opens=True)
    LOG.info("registration: RMS %s of %d new rows", rows.by_kind(rows.placed_residual).rms_text, len(new))
    progress("changes", 0, 1)
    changes, drifts = find_changes(rows, seed=seed) if drift == "tested" else (Changes(), [])
    LOG.info("changes: %s", changes)
    if groups := dict.fromkeys(one.where for one in changes.found if one.where):  # no model holds for all of them
        what = f"the new rows do not belong to one robot: only {' and '.join(groups)} deviates from the old model"
        warn_user(sentence(what, fix="check what happened between them, and recalibrate with the rows since then"))
    warn_about(before.registration, outliers=False, excess=not drifts, marker=marker, among=rows.changed_among)
    if drift == "tested":
        drifts = Drift(rows, drifts).parts
    if drifts:
        rows = rows.drifting([each.root(rows.at) for each in drifts]).with_weights()
    excess = float((rows.given.left_out_squares / rows.visible.sum(1)).median().sqrt())  # of the better half
    excess = excess if before.registration is None else before.registration.excess
    bad = int((rows.tails.weights < OUTLIER_WEIGHT).any(1).sum())
    if bad >= LARGEST_OUTLIER_PART * len(rows) and excess > LARGEST_EXCESS:
        what = f"{bad} of {len(rows)} new rows contradict the old model"
        fix = "check that the table belongs to this robot; if it was damaged or rebuilt, calibrate it afresh"
        warn_user(sentence(what, expected="rows of the same robot, most of them right", fix=fix))
    problem, start = both_dates(rows, rows.inflation, drifts)
    solver, integrator = GaussNewton(tolerance=RESIDUAL_TOLERANCE), rows.fitted.geodesic.integrator
    fitted = fit(problem, solver, integrator, start=start, progress=progress)
    if fitted.solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum: nothing is worth keeping
    return _result(model, before, rows, changes, fitted=fitted, note=note)


def _result(
    model: CalibratedKinematics, place: NewSetUp, rows: NewRows, changes: Changes, *, fitted: Fit, note: str
) -> Recalibration:
    """The model in the new frame, and everything that was found."""
    record, new = place.registration, place.data
    fitted_map = replace(fitted.model, unresolved=place.fitted.inflated(rows.inflation).unresolved)
    if record is not None:
        fitted_map = moved(fitted_map, record.transform)
    elif place.fitted.stands_free:  # still no device says where the robot stands
        fitted_map = fitted_map.without_rigid_motions()
    marked, shared = place.coordinates, fitted.problem.noise.shared[-len(rows) :]
    # a ball that a device measured is none in an unknown place any more
    measured = place.ball is None and marked is not None and not bool(marked.table.points[:, -1].isnan().all())
    ball = place.new_ball or (knows_ball(model) and not measured)
    before_it = () if model.provenance is None else model.provenance.program_rows
    made = replace(Provenance.now(new, note), program_rows=before_it)
    again = model.changed(map=fitted_map, provenance=made, placement=(), learnt=None, ball=ball)
    small = (rows.tails.weights < OUTLIER_WEIGHT).any(1)
    again.placement = carried_devices(model, again, place.transform)
    settled = rows.placement.settled(fitted, fitted.model, rows, place.transform, known=mounted_of(model))
    first = len(fitted.problem.y) - len(rows)
    again.placement = devices_beside(again, new, [replace(one, rows=one.rows + first) for one in settled.placed()])
    left = (fitted.residual[-len(rows) :] - shared @ fitted.shifts)[:, : rows.y.shape[1]]  # devices where it puts them
    left = rows.given.shown(left)
    before, after, left_out = map(rows.by_kind, (rows.placed_residual, left, rows.given.left_out))
    if model.summary is not None:
        errors = {"diffeomorphic_rms": after.positions_rms, "leave_one_out_rms": left_out.positions_rms}
        certificates = {name: getattr(fitted, name) for name in CERTIFICATES}
        explained = {part.name: part.displacement for part in parts(again)}
        count = len(again.configurations)
        again.summary = replace(
            model.summary, **errors, **certificates, outliers=int(small.sum()), rows=count, parts=explained
        )
    away = again.geometry.tool - fitted_markers(place.fitted)
    return Recalibration(
        model=again,
        moved=record,
        placement=rows.placement,
        marker=rows.marker,
        changes=changes,
        tails=rows.tails,
        outliers=tuple(new.line_numbers[small.to(HOST)].tolist()),
        before=before,
        after=after,
        left_out=left_out,
        inflation=rows.inflation,
        fit=fitted,
        shift=None if record is None else away * place.seen_before[:, None],
        hidden=hidden_offsets(place, changes),
    )


# --- comparison ---

MOST_PREDICTED = 60  # configurations of two fits at which the models are compared
MOST_USUAL = 100  # rows of the fit that show how certain a model is there
UNKNOWN_PER_USUAL = 5.0  # expected errors, in those at the rows of the fit, from which rows tell of no change


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
        return any(errors.rms < UNKNOWN_PER_USUAL * self.usual[kind].rms for kind, errors in self.expectations.items())

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
    model: CalibratedKinematics, other: Any, *, marker: Marker = "evidence", level: float = LEVEL, seed: int = 0
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
        rows = weighed(place_again(model, other, marker), marker, opens=True)
    else:
        masses = model.payload, other.payload
        payload = None if masses == (None, None) else 0.0 if None in masses else masses[0]  # the first one's
        model = under_mass(model, payload).to(HOST)
        rows = _predicted_rows(model, under_mass(other, payload).to(HOST))
    changes, _ = find_changes(rows, level=level, seed=seed)
    if measured:
        unchanged = not changes.found
        warn_about(
            rows.set_up.registration, outliers=unchanged, excess=unchanged, marker=marker, among=rows.changed_among
        )
    q = model.configurations  # what is usual is expected at the rows of its fit
    _, covariance = model.predict(q[:: -(-len(q) // MOST_USUAL)], noise=False)
    variance = float(covariance.diagonal(dim1=-2, dim2=-1).mean().clamp(min=0))
    usual = (variance + rows.noise.diagonal(dim1=1, dim2=2)).sqrt()
    usual, placed = usual.masked_fill(~rows.visible, nan), rows.given.after_placing
    expected = ((placed @ Noise(rows.noise).add_to(rows.given.C)) * placed).sum(1).clamp(min=0.0).sqrt()
    return Comparison(
        moved=rows.set_up.registration if measured else None,
        changes=changes,
        errors=rows.by_kind(rows.placed_residual),
        expectations=rows.by_kind(rows.given.shown(expected)),
        usual=rows.by_kind(usual),
        hidden=hidden_offsets(rows.set_up, changes) if measured else (),
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
    low = torch.maximum(*(inputs.amin(0) for inputs in fits))
    high = torch.minimum(*(inputs.amax(0) for inputs in fits))
    q = torch.cat(fits)
    q = q[((q >= low) & (q <= high)).all(1)]
    if len(q) < FEWEST_ROWS:
        name = model.robot.joint_names[int((low - high).argmax())]
        what = f"the models hardly have configurations in common, above all of {name}"
        raise InputError.of(what, fix="compare a model with measurements")
    q = q[:: -(-len(q) // MOST_PREDICTED)]
    there = _inputs(other.robot, model.robot, q)

    def measured(source: CalibratedKinematics, q: Tensor, points: Tensor) -> Measurements:
        return Measurements.of_points(q, points.detach(), None, model.lever).with_load(source.nominal.load)

    fitted = other.map.unregistered
    record = find_place(fitted, other.lever, measured(other, there, model(q)), marker_std=OTHER_MARKER)[1]
    placed = RegisteredMap(moved(fitted, record.transform), record)
    new = measured(model, q, placed(there).unflatten(1, (-1, 3)))
    rows = weighed(place_again(model, new, "other", opens=False), "other")
    errors, _ = roots(placed.conditional.covariance_between(placed.geodesic.linearise(there)))
    return rows.drifting([errors.unflatten(0, (len(q), -1))]).with_weights()


def _inputs(robot: Tree, other: Tree, q: Tensor) -> Tensor:
    """Joint values (N, n) that mean the same for a robot as these for another: of commanded poses to each its own."""
    alike = turns_nowhere(robot) or not is_cartesian(robot)
    return q if alike else pose_inputs(robot, other(q))
