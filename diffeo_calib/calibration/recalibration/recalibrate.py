"""`recalibrate`: a calibrated model and new rows in a new set-up become one model that knows both.

1 place       where the measuring device stands and the markers sit now (find_place.py)
2 rows        weights of the new rows, seen by the old model; whether the markers moved, by their evidence
3 changes     what else has changed: named parts may drift (changes.py), and everything a little
4 fit         the exact model of old and new rows, with the old scales (register.py)
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any, Literal

from torch import Tensor

from diffeo_calib.calibration.choose_scales import RESIDUAL_TOLERANCE
from diffeo_calib.calibration.findings import parts
from diffeo_calib.calibration.placing.placement import Placement
from diffeo_calib.calibration.recalibration.changes import Changes, Offset, hidden_offsets
from diffeo_calib.calibration.recalibration.find_changes import find_changes, usual_drift
from diffeo_calib.calibration.recalibration.new_rows import OUTLIER_WEIGHT, NewRows, NewSetUp
from diffeo_calib.calibration.recalibration.new_set_up import (
    Marker,
    check_arguments,
    check_other_table,
    knows_ball,
    place_again,
    warn_of_places,
    weighed,
)
from diffeo_calib.calibration.recalibration.register import both_dates, carried_devices, devices_beside
from diffeo_calib.common.checks import check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import InputError, as_written, sentence, warn_user
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.result import Fit, Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.provenance import Provenance, check_note
from diffeo_calib.kinematics.registered_map import Registration, fitted_markers, moved
from diffeo_calib.process.tails import Tails
from diffeo_calib.sensors.errors import Evaluations
from diffeo_calib.sensors.places import mounted_of

LOG = logging.getLogger(__name__)
CERTIFICATES = "coupling_residual", "end_residual", "energy", "status"
"""Of a fit that the summary of a model has, too."""


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
            geometry, load and transmissions by as much as the rows say. "none": nothing but device and markers may.
        seed: of the samples of that test.
        progress: called as ``progress(task, done, total)``.
        note: text that is kept with the model.

    Returns:
        a :class:`Recalibration`; ``.model`` is a model like that of a calibration.

    Raises:
        InputError: arguments of another kind, joints in another order, another number of markers.
            The table of the model's own fit.
        MeasurementError: too few rows, rows that leave the place of the device open, or rows that cannot belong to
            this robot: other units, or half of them contradicting the model.
        KeyboardInterrupt: Ctrl-C; nothing is kept, since it takes seconds.

    Warns:
        DiffeoCalibWarning: as :meth:`CalibratedKinematics.registered`; distances of another scale; ``marker="same"``
            although the rows say otherwise.
    """
    check_arguments(model, new, marker)
    check_other_table(model, new)
    if not isinstance(drift, str) or drift not in ("tested", "none"):
        raise InputError.of("`drift`", expected="'tested' or 'none'", got=as_written(drift))
    check_note(note)
    check_seed(seed)
    progress("registration", 0, 1)
    before = place_again(model, new, marker)
    rows = weighed(before, marker)
    LOG.info("registration: RMS %s of %d new rows", rows.by_kind(rows.placed_residual).rms_text, len(new))
    progress("changes", 0, 1)
    changes, drifts = find_changes(rows, seed=seed) if drift == "tested" else (Changes(), [])
    LOG.info("changes: %s", changes)
    if groups := dict.fromkeys(one.where for one in changes.found if one.where):  # no model holds for all of them
        what = f"the new rows do not belong to one robot: only {' and '.join(groups)} deviates from the old model"
        warn_user(sentence(what, fix="check what happened between them, and recalibrate with the rows since then"))
    warn_of_places(before, marker, outliers=False, excess=not drifts)
    if drift == "tested":
        drifts = [*drifts, *usual_drift(rows, drifts)]
    if drifts:
        rows = rows.drifting([each.root(rows.at) for each in drifts]).with_weights()
    warn_of_contradictions(rows, rows.excess if before.registration is None else before.registration.excess)
    problem, start = both_dates(rows, rows.inflation, [each.root for each in drifts])
    solver, integrator = GaussNewton(tolerance=RESIDUAL_TOLERANCE), rows.fitted.geodesic.integrator
    fitted = fit(problem, solver, integrator, start=start, progress=progress)
    if fitted.solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum: nothing is worth keeping
    return _result(model, before, rows, changes, fitted=fitted, note=note)


def _result(
    model: CalibratedKinematics, place: NewSetUp, rows: NewRows, changes: Changes, *, fitted: Fit, note: str
) -> Recalibration:
    """The model in the new frame, and everything that was found."""
    found, new = place.registration, place.data
    fitted_map = fitted.model
    if found is not None:
        fitted_map = moved(fitted_map, found.transform)
    elif place.fitted.stands_free:  # still no device says where the robot stands
        fitted_map = fitted_map.without_rigid_motions()
    own, shared = place.coordinates, fitted.problem.noise.shared[-len(rows) :]
    # a ball that a device measured is none in an unknown place any more
    measured = place.ball is None and own is not None and not bool(own.table.points[:, -1].isnan().all())
    ball = place.new_ball or (knows_ball(model) and not measured)
    made = Provenance.now(new, note)
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
        known = {"diffeomorphic_rms": after.positions_rms, "leave_one_out_rms": left_out.positions_rms}
        certificates = {name: getattr(fitted, name) for name in CERTIFICATES}
        explained = {part.name: part.displacement for part in parts(again)}
        count = len(again.configurations)
        again.summary = replace(
            model.summary, **known, **certificates, outliers=int(small.sum()), rows=count, parts=explained
        )
    away = again.geometry.tool - fitted_markers(place.fitted)
    return Recalibration(
        model=again,
        moved=found,
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
        shift=None if found is None else away * place.seen_before[:, None],
        hidden=hidden_offsets(model.robot, place, changes),
    )


LARGEST_OUTLIER_PART = 0.5
"""Part of the rows that may hardly count: with more of them it is not clear which rows are wrong."""
LARGEST_EXCESS = 10.0
"""Residuals by this factor above the expected ones are not those of a worn joint."""


def warn_of_contradictions(rows: NewRows, excess: float) -> None:
    """Warn if half of the rows hardly count, and errors are larger than those of worn joints."""
    bad = int((rows.tails.weights < OUTLIER_WEIGHT).any(1).sum())
    if bad >= LARGEST_OUTLIER_PART * len(rows) and excess > LARGEST_EXCESS:
        what = f"{bad} of {len(rows)} new rows contradict the old model"
        fix = "check that the table belongs to this robot; if it was damaged or rebuilt, calibrate it afresh"
        warn_user(sentence(what, expected="rows of the same robot, most of them right", fix=fix))
