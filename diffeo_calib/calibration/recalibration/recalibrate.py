"""`recalibrate`: a calibrated model and new rows in a new set-up become one model that knows both.

    1 place       where the measuring device stands and the markers sit now (kinematics/re_registration)
    2 rows        weights of the new rows, seen by the old model; whether the markers moved, by their evidence
    3 changes     what else has changed: named parts may drift (changes.py)
    4 fit         the exact model of old and new rows, with the old scales

The model is that of the robot as it is now. Old rows differ from it by shifts that they share: the places of device and
markers in their session, and what has drifted since. These are part of their noise (:class:`Noise`): nothing but the
rows' covariance knows of sessions. The old rows follow from the old momenta (:meth:`FittedMap.measured`).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from math import log
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.findings import parts
from diffeo_calib.calibration.recalibration.changes import Changes, find_changes
from diffeo_calib.calibration.recalibration.changes import Drift as Drifted
from diffeo_calib.calibration.recalibration.checks import (
    OUTLIER_WEIGHT,
    Marker,
    check_arguments,
    check_other_table,
    check_place,
    check_rows,
    check_size,
    warn_of_moved_markers,
    warn_of_scale,
)
from diffeo_calib.calibration.recalibration.new_rows import NewRows, device_shifts
from diffeo_calib.calibration.robot_problem import RESIDUAL_TOLERANCE
from diffeo_calib.calibration.student_t import Tails, region_factor
from diffeo_calib.common.checks import check_seed
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import Fit, Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.flange_points import FlangePoints
from diffeo_calib.kinematics.new_frame import moved
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.provenance import Provenance, check_note
from diffeo_calib.kinematics.re_registration.register_again import OTHER_MARKER, FoundPlace, find_place, warn_about
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap, Registration
from diffeo_calib.kinematics.re_registration.session import with_lever
from diffeo_calib.kinematics.session_markers import SessionMarkers
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.noise import Noise, mean_block
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.choose import MAX_DENSE

LOG = logging.getLogger(__name__)
MARKER_DEVIATIONS = {"same": 5e-5, "moved": 1e-3, "other": 0.1}
"""Prior standard deviations, m, of the markers around where they were, or around where they were registered."""
UNMOVED_LOG_ODDS = log(10.0)
"""Before the rows are seen: markers that nobody names as moved have not been touched."""
Drift = Literal["tested", "none"]


@dataclass(frozen=True, repr=False)
class Recalibration:
    """A model that was calibrated anew with a few rows, and what has changed.

    Attributes:
        model: the calibrated kinematics in the new set-up.
        moved: where device and markers are now, see :class:`Registration`; ``moved.transform`` leads from the old
            measuring frame to the new one.
        marker: whether the markers are the "same", have "moved" a little, or are "other" ones.
        changes: what has changed in the robot itself.
        tails: weights of the new rows; about 1 for inliers. outliers: lines of those that hardly count.
        rms_before: RMS distance of the new rows from the old model, registered to them, m; outliers left out.
        rms_after: the same from the new model, m.
        left_out_rms: the same, each new row predicted by the old ones and the other new ones, m.
        inflation: factor on all variances of the old scales with which regions hold the new rows, at least one.
        fit: the exact model's fit with its certificates.
    """

    model: CalibratedKinematics
    moved: Registration
    marker: str
    changes: Changes
    tails: Tails
    outliers: tuple[int, ...]
    rms_before: float
    rms_after: float
    left_out_rms: float
    inflation: float
    fit: Fit

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
    new: Measurements,
    *,
    marker: Marker = "evidence",
    drift: Drift = "tested",
    seed: int = 0,
    progress: Progress = silent,
    note: str = "",
) -> Recalibration:
    """Calibrate a robot anew with a few rows, starting from what an old calibration knew.

    Twenty rows do what about a hundred do without the old model. The measuring device may stand anywhere.

    Args:
        model: the old calibrated model, itself recalibrated or not.
        new: M configurations with as many markers as before, or poses where there were poses.
        marker: whether the markers on the tool are the "same" (within 0.05 mm), have "moved" by about a millimetre, or
            are "other" ones; by default the evidence of the rows decides.
        drift: "tested": parts of the robot that have changed, by a test at 1 %, may differ from what they were.
            "none": nothing but device and markers may.
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
    before = place_again(model, new)
    LOG.info("registration: RMS %.4f mm on %d new rows", 1e3 * before.place.registration.rms_after, len(new))
    rows = weighed(before, marker)
    progress("changes", 0, 1)
    changes, drifts = find_changes(rows, seed=seed) if drift == "tested" else (Changes.untested(), [])
    LOG.info("changes: %s", changes)
    warn_about(before.place.registration, outliers=False, excess=not drifts)
    warn_of_scale(rows)
    if drifts:
        rows = rows.if_drifting([each.variance**0.5 * each.part.root(rows.at) for each in drifts])
    check_rows(rows, before.place.registration)
    warn_of_moved_markers(before.place.registration, marker)
    fitted = _fit(before, rows, drifts, progress)
    if fitted.solution.interrupted:
        raise KeyboardInterrupt  # half-way the covariance would be that of the optimum: nothing is worth keeping
    return _result(model, before, rows, changes, fitted=fitted, note=note)


def _result(
    model: CalibratedKinematics, before: Before, rows: NewRows, changes: Changes, *, fitted: Fit, note: str
) -> Recalibration:
    """The model in the new frame, and everything that was found."""
    found, new = before.place.registration, before.new
    after = model.with_fit(moved(fitted.model, robot_map(fitted.model), found.transform), Provenance.now(new, note))
    small = (rows.tails.weights < OUTLIER_WEIGHT).any(1)
    rms, left_out = _rms(new.points.flatten(1) - after(new.q).flatten(1)), _rms(rows.left_out)
    if model.summary is not None:
        after.summary = replace(
            model.summary,
            diffeomorphic_rms=rms,
            leave_one_out_rms=left_out,
            outliers=int(small.sum()),
            coupling_residual=fitted.coupling_residual,
            end_residual=fitted.end_residual,
            energy=fitted.energy,
            status=fitted.status,
            rows=len(after.configurations),
            parts={part.name: part.displacement for part in parts(after)},
        )
    return Recalibration(
        model=after,
        moved=found,
        marker=next(name for name, deviation in MARKER_DEVIATIONS.items() if deviation == rows.marker_deviation),
        changes=changes,
        tails=rows.tails,
        outliers=tuple(new.line_numbers[small].tolist()),
        rms_before=found.rms_after,
        rms_after=rms,
        left_out_rms=left_out,
        inflation=rows.inflation,
        fit=fitted,
    )


class Before(NamedTuple):
    """The old map in its own frame, the new rows, and where device and markers are."""

    fitted: FittedMap
    nominal: GeometryMap
    new: Measurements
    place: FoundPlace


def place_again(model: CalibratedKinematics, new: Measurements) -> Before:
    """Find where device and markers are now."""
    old = model.map.fitted if isinstance(model.map, RegisteredMap) else model.map
    old, new = old.to(HOST), new.to(HOST)
    if model.lever is not None and new.lever != model.lever:
        new = with_lever(new, model.lever)
    check_size(old(new.q).unflatten(1, (-1, 3)), new.points)
    place = find_place(old, model.nominal, model.lever, new)
    check_place(place.registration)
    return Before(old, robot_map(old), new, place)


def weighed(before: Before, marker: str) -> NewRows:
    """The new rows with their weights, and with the markers as free as is asked or as is most probable."""
    most = max(before.place.odds, key=lambda metres: before.place.odds[metres])
    if marker == "other" or (marker == "evidence" and most == OTHER_MARKER):
        return _rows(before, before.place.registration.markers, "other").with_weights()
    theta, slices = before.fitted.deformation.momenta.theta, before.nominal.geometry.slices
    own = before.nominal.geometry.tool + theta[slices["tool"]].view(-1, 3)
    if marker != "evidence":
        return _rows(before, own, marker).with_weights()
    free = _rows(before, own, "moved").with_weights()
    same = free.changed(marker_deviation=MARKER_DEVIATIONS["same"])
    return same.with_weights() if same.log_evidence >= free.log_evidence - UNMOVED_LOG_ODDS else free


def _rows(before: Before, markers: Tensor, marker: str) -> NewRows:
    """The new rows with all weights 1, the markers near these places (P, 3)."""
    points = FlangePoints(before.nominal, markers, same=True)
    T = before.place.registration.transform
    return NewRows.of(before.new, T, before.fitted, points, MARKER_DEVIATIONS[marker])


def _fit(before: Before, rows: NewRows, drifts: list[Drifted], progress: Progress) -> Fit:
    """The exact model of old and new rows with the old scales.

    All variances are inflated alike, which changes the uncertainty, but not the optimum.
    """
    factor = rows.inflation
    old, new, nominal = before.fitted, before.new, before.nominal
    spec, y_old = old.geodesic.spec, old.measured()
    theta = old.deformation.momenta.theta
    shared = _shared(old, rows, drifts, y_old)
    own = torch.cat([old.noise.covariance, rows.weighted_noise])
    noise = Noise(factor * own, factor**0.5 * _with_zeros(shared, len(new)))
    tool = rows.points.points - theta[nominal.geometry.slices["tool"]].view(-1, 3)
    newest = nominal.with_geometry(nominal.geometry.with_tool(tool))
    problem = Problem(
        newest,
        torch.cat([old.x, new.q]),
        torch.cat([y_old, rows.y]),
        joint_kernel=spec.joint_kernel.scaled(factor),
        task_kernel=spec.task_kernel.scaled(factor),
        noise=noise,
        markers=new.markers,
        prior_variance=factor * spec.prior_variance,
        new_noise=factor * _new_noise(rows),
    )
    problem = problem.with_nominal_of_rows(_sessions(old, nominal, newest, len(new)))
    solver = GaussNewton(tolerance=RESIDUAL_TOLERANCE)
    if old.data is not None or problem.y.numel() > MAX_DENSE:
        problem = problem.with_controls(torch.cat([old.deformation.x, new.q]))
    b, p, _ = old.deformation.momenta.tensors
    start = Momenta(_with_zeros(b, len(new)) / factor, _with_zeros(p, len(new) * new.markers) / factor, theta)
    return fit(problem, solver, old.geodesic.integrator, start=start, progress=progress)


def _new_noise(rows: NewRows) -> Tensor:
    """Covariance (m, m) of a new measurement in the new set-up, m^2, inflated for heavy tails.

    Few rows seldom show the tails: it is no smaller than that of the old set-up.
    """
    mean = mean_block(rows.noise, rows.noise_model.coordinates(rows.y))
    found = mean * region_factor(rows.tails.freedom, rows.noise_model.largest_freedom)
    old = rows.fitted.new_noise
    return found if float(found.trace()) > float(old.trace()) else old


def _shared(old: FittedMap, rows: NewRows, drifts: list[Drifted], y_old: Tensor) -> Tensor:
    """(N, m, c) shifts of the old rows: those they shared already, device and markers since, what has drifted since."""
    points = FlangePoints(rows.points.fitted, rows.points.fitted.geometry.tool, same=True)
    places = y_old.unflatten(1, (-1, 3))
    around = {"centre": rows.centre, "marker_deviation": rows.marker_deviation}
    columns = [old.noise.shared, device_shifts(old, points, old.x, places=places, **around)]
    if drifts:
        at = old.geodesic.linearise(None if old.data is None else old.x)
        columns += [each.variance**0.5 * each.part.root(at) for each in drifts]
    return torch.cat(columns, 2)


def _sessions(old: FittedMap, before: GeometryMap, newest: GeometryMap, count: int) -> SessionMarkers:
    """k0 at the controls: every session with its own markers."""
    known, x = old.geodesic.spec.at_controls, old.deformation.x
    if isinstance(known, SessionMarkers):
        session, tools = known.session, known.tools
    else:
        session, tools = torch.zeros(len(x), dtype=torch.int64, device=x.device), before.geometry.tool[None]
    latest = torch.full((count,), len(tools), dtype=torch.int64, device=x.device)
    return SessionMarkers(newest, torch.cat([session, latest]), torch.cat([tools, newest.geometry.tool[None]]))


def _with_zeros(values: Tensor, count: int) -> Tensor:
    """With rows of zeros at the end."""
    return torch.cat([values, values.new_zeros(count, *values.shape[1:])])


def robot_map(fitted: FittedMap) -> GeometryMap:
    """The nominal map of a robot's fitted map."""
    nominal = fitted.geodesic.spec.nominal
    if not isinstance(nominal, GeometryMap):
        raise InputError.of("the map of a robot model", expected="a GeometryMap", got=type(nominal).__name__)
    return nominal


def _rms(errors: Tensor) -> float:
    """Root mean square length, coordinates in triples, NaN left out."""
    return float(errors.unflatten(1, (-1, 3)).square().sum(-1).nanmean().sqrt())
