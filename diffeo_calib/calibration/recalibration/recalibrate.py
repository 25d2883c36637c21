"""`recalibrate`: a calibrated model and new rows in a new set-up become one model that knows both.

1 place       where the measuring device stands and the markers sit now (kinematics/re_registration)
2 rows        weights of the new rows, seen by the old model; whether the markers moved, by their evidence
3 changes     what else has changed: named parts may drift (changes.py), and everything a little
4 fit         the exact model of old and new rows, with the old scales (both_dates.py)
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Any, Literal

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import RESIDUAL_TOLERANCE
from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.findings import parts
from diffeo_calib.calibration.placing.placement import Placement
from diffeo_calib.calibration.recalibration.changes import ChangedPart, Changes, Drift, find_changes, parts_of
from diffeo_calib.calibration.recalibration.new_rows import OUTLIER_WEIGHT, WeighedRows
from diffeo_calib.calibration.recalibration.new_set_up import (
    Before,
    Marker,
    check_arguments,
    check_other_table,
    knows_ball,
    place_again,
    warn_of_places,
)
from diffeo_calib.calibration.recalibration.offsets import HiddenOffset, hidden_offsets
from diffeo_calib.common.checks import check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import InputError, as_written, sentence, warn_user
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.result import Fit, Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.provenance import Provenance, check_note
from diffeo_calib.kinematics.re_registration.both_dates import both_dates
from diffeo_calib.kinematics.re_registration.find_place import MARKER_DEVIATIONS, UNMOVED_LOG_ODDS
from diffeo_calib.kinematics.re_registration.register_again import carried_devices, devices_beside
from diffeo_calib.kinematics.re_registration.registered_map import Registration, moved
from diffeo_calib.process.tails import Tails
from diffeo_calib.sensors.errors import Evaluations
from diffeo_calib.sensors.places import PlacedDevices
from diffeo_calib.sensors.set_ups import mounted_of

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
    hidden: tuple[HiddenOffset, ...] = ()

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
    changes, drifts = find_changes(rows, seed=seed) if drift == "tested" else (Changes.untested(), [])
    LOG.info("changes: %s", changes)
    warn_of_groups(changes)
    warn_of_places(before, marker, outliers=False, excess=not drifts)
    if drift == "tested":
        drifts = [*drifts, *usual_drift(rows, drifts)]
    if drifts:
        rows = rows.if_drifting([each.variance**0.5 * each.part.root(rows.at) for each in drifts])
    warn_of_contradictions(rows, rows.excess if before.registration is None else before.registration.excess)
    fitted = fit_both(rows, drifts, progress)
    if fitted.solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum: nothing is worth keeping
    return _result(model, before, rows, changes, fitted=fitted, note=note)


def fit_both(rows: WeighedRows, drifts: list[Drift], progress: Progress) -> Fit:
    """The exact model of old and new rows with the old scales."""
    old, drifted = rows.fitted, list[Tensor]()
    if drifts:
        at = old.geodesic.linearise(None if old.data is None else old.x)
        at = at if old.slopes is None else at.projected(old.slopes)
        drifted = [each.variance**0.5 * each.part.root(at) for each in drifts]
    problem, start = both_dates(rows.before.nominal, rows, rows.new_noise, drifted, rows.inflation)
    solver = GaussNewton(tolerance=RESIDUAL_TOLERANCE)
    return fit(problem, solver, old.geodesic.integrator, start=start, progress=progress)


def _result(
    model: CalibratedKinematics, place: Before, rows: WeighedRows, changes: Changes, *, fitted: Fit, note: str
) -> Recalibration:
    """The model in the new frame, and everything that was found."""
    found, new = place.registration, place.data
    fitted_map = fitted.model
    if place.stands_free:
        fitted_map = fitted_map.without_rigid_motions()
    if found is not None:
        fitted_map = moved(fitted_map, found.transform)
    ball = place.new_ball or (knows_ball(model) and not _ball_measured(place))
    again = model.with_fit(fitted_map, Provenance.now(new, note), ball=ball)
    small = (rows.tails.weights < OUTLIER_WEIGHT).any(1)
    again.placement = carried_devices(model, again, place.transform)
    again.placement = _with_settled(devices_beside(again, new), model, place, rows, fitted)
    before, after, left_out = map(rows.by_kind, (rows.placed_residual, _left_over(fitted, rows), rows.given.left_out))
    if model.summary is not None:
        known = {"diffeomorphic_rms": after.positions_rms, "leave_one_out_rms": left_out.positions_rms}
        certificates = {name: getattr(fitted, name) for name in CERTIFICATES}
        explained = {part.name: part.displacement for part in parts(again)}
        count = len(again.configurations)
        again.summary = replace(
            model.summary, **known, **certificates, outliers=int(small.sum()), rows=count, parts=explained
        )
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
        shift=None if found is None else (again.geometry.tool - place.own_markers) * place.seen_before[:, None],
        hidden=hidden_offsets(model.robot, place, changes),
    )


def _with_settled(
    placement: tuple[PlacedDevices, ...], model: CalibratedKinematics, place: Before, rows: WeighedRows, fitted: Fit
) -> tuple[PlacedDevices, ...]:
    """The devices with the new rows that each measured, set-ups where the fit puts them."""
    first, found = len(fitted.problem.y) - len(rows), list(placement)
    at = fitted.model, rows.centre, place.transform
    for one in rows.placement.settled(fitted, *at, known=mounted_of(model)).placed():
        own = replace(one, rows=one.rows + first)
        for k, other in enumerate(found):
            if own.same_set(other) and own.set_ups is not None:
                found[k] = own.beside(other)
            elif own.same_set(other):
                number = torch.tensor([other.names.index(name) for name in own.names], dtype=torch.int64, device=HOST)
                device = torch.cat([other.device, number[own.device]])
                found[k] = replace(other, rows=torch.cat([other.rows, own.rows]), device=device)
    return tuple(found)


def _ball_measured(before: Before) -> bool:
    """Whether a device measured the last marker: it is no ball in an unknown place any more."""
    own = before.coordinates
    return before.ball is None and own is not None and not bool(own.table.points[:, -1].isnan().all())


def _left_over(fitted: Fit, rows: WeighedRows) -> Tensor:
    """(M, R) residuals of the new rows after the fit, their devices where it puts them, m; NaN where hidden."""
    shared = fitted.problem.noise.shared[-len(rows) :]
    left = (fitted.residual[-len(rows) :] - shared @ fitted.shifts)[:, : rows.y.shape[1]]
    return left.masked_fill(~rows.visible, nan)


def weighed(before: Before, marker: str) -> WeighedRows:
    """The new rows with their weights, and with the markers as free as is asked or as is most probable."""
    own, place, ball = before.own_markers, before.place, None if before.new_ball else before.ball
    if place is None and ball is None:
        return _rows(before, own, "same").with_weights()
    other, known = own.clone(), slice(len(own) - before.new_ball)
    if place is not None:
        other[known] = place.registration.markers[known]
    elif ball is not None:
        other[-1] = ball
    places = {"same": own, "moved": own, "other": other}
    if marker != "evidence":
        return _rows(before, places[marker], marker).with_weights()
    if place is not None:
        name = next(name for name, (first, _) in MARKER_DEVIATIONS.items() if first == place.metres)
        return _rows(before, places[name], name).with_weights()
    every = {name: _rows(before, at, name).with_weights() for name, at in places.items()}
    return max(every.items(), key=lambda each: each[1].given.log_evidence() + UNMOVED_LOG_ODDS * (each[0] == "same"))[1]


def _rows(before: Before, markers: Tensor, marker: str) -> WeighedRows:
    """The new rows with all weights 1, the markers near these places (P, 3)."""
    rows = WeighedRows.of(before, markers, marker)
    if rows.observe is None and before.fitted.slopes is None:
        return rows
    return rows.levelled([part.root(rows.at) for part in parts_of(rows)])


LARGEST_OUTLIER_PART = 0.5
"""Part of the rows that may hardly count: with more of them it is not clear which rows are wrong."""
LARGEST_EXCESS = 10.0
"""Residuals by this factor above the expected ones are not those of a worn joint."""


def warn_of_groups(changes: Changes) -> None:
    """Warn of changes that only a part of the new rows shows: no model holds for all of them."""
    groups = dict.fromkeys(one.where for one in changes.found if one.where)
    if groups:
        what = f"the new rows do not belong to one robot: only {' and '.join(groups)} deviates from the old model"
        warn_user(sentence(what, fix="check what happened between them, and recalibrate with the rows since then"))


def warn_of_contradictions(rows: WeighedRows, excess: float) -> None:
    """Warn if half of the rows hardly count, and errors are larger than those of worn joints."""
    bad = int((rows.tails.weights < OUTLIER_WEIGHT).any(1).sum())
    if bad >= LARGEST_OUTLIER_PART * len(rows) and excess > LARGEST_EXCESS:
        what = f"{bad} of {len(rows)} new rows contradict the old model"
        fix = "check that the table belongs to this robot; if it was damaged or rebuilt, calibrate it afresh"
        warn_user(sentence(what, expected="rows of the same robot, most of them right", fix=fix))


USUAL_LOG, EFOLDS = -6.0, 2.5
"""Log-normal prior of s^2: the logarithm of its centre, and the standard deviation of its logarithm."""
LOG_SIZES = torch.linspace(-12.0, 4.0, 65, dtype=torch.float64, device="cpu")
"""Logarithms of the s^2 that are tried."""
ROUNDS = 10


def usual_drift(rows: WeighedRows, named: Sequence[Drift]) -> list[Drift]:
    """What may differ between the dates, besides what a test named: temperature, wear and screws change everything.

    In each of three groups, the geometry, the load and the transmissions of all joints, errors may differ from the old
    ones by s^2 times their old prior variance; the sizes s^2 maximise the evidence of the new rows with a wide prior
    below one percent.

    Args:
        rows: the new rows as the old model sees them. named: parts that have changed, which are free already.
    """
    free = {each.part.name for each in named}
    groups: dict[str, list[ChangedPart]] = {}
    for part in parts_of(rows):
        if part.name not in free:
            groups.setdefault(part.name if part.joint is None else "transmissions", []).append(part)
    if not groups:
        return []
    roots = [torch.cat([part.root(rows.at) for part in parts], 2) for parts in groups.values()]
    known = [each.variance**0.5 * each.part.root(rows.at) for each in named]
    doubted, sizes = rows.if_drifting([*known, *roots]), list[float]()
    for weighed, least in ((rows, gates.DRIFT_ODDS_OF_INLIERS), (doubted, gates.DRIFT_ODDS)):
        sizes, odds = _likeliest(rows.changed(tails=weighed.tails).drifting(known), roots)
        if odds < least:
            return []
    return [Drift(part, size) for parts, size in zip(groups.values(), sizes, strict=True) for part in parts]


def _likeliest(rows: WeighedRows, roots: list[Tensor]) -> tuple[list[float], float]:
    """The sizes s^2 of changes with these columns (M, R, c), each in turn the likeliest beside the others; log odds."""
    sizes, chosen = LOG_SIZES.exp().to(rows.y), [0] * len(roots)
    prior = -0.5 * ((LOG_SIZES.to(rows.y) - USUAL_LOG) / EFOLDS).square()

    def scaled(k: int) -> Tensor:
        return sizes[chosen[k]].sqrt() * roots[k]

    every = range(len(roots))
    for _ in range(ROUNDS):
        before = list(chosen)
        for k in every:
            beside = rows.drifting([scaled(j) for j in every if j != k])
            chosen[k] = int((beside.evidence(roots[k]).log_odds(sizes) + prior).argmax())
        if chosen == before:
            break
    together = torch.cat([scaled(k) for k in every], 2)
    odds = rows.evidence(together).log_odds(sizes.new_ones(1)) + prior[chosen].sum()
    return sizes[chosen].tolist(), float(odds)
