"""Everything that a report says about a calibration, as numbers."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.expected_errors import expected_errors
from diffeo_calib.calibration.findings import Outlier, parts
from diffeo_calib.calibration.judgement import block_text, larger_than_expected, steps_of
from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import (
    check_rows,
    implausible,
    impossible,
    place,
    placement_sentences,
    residuals,
    rows_used_in_fit,
)
from diffeo_calib.kinematics.joint_ranges import SAME_CONFIGURATION
from diffeo_calib.kinematics.re_registration.motions import motions
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.fit_rows import FitRows, forecast
from diffeo_calib.reports.analysis.kinds import Findings
from diffeo_calib.reports.analysis.predictions import Predictions
from diffeo_calib.reports.analysis.repeats import Repeats, repeats_of
from diffeo_calib.reports.analysis.stages import Deviations, Kinematics, stages_of
from diffeo_calib.sensors.errors import Evaluation
from diffeo_calib.sensors.known_drift import KnownDrift

LOG = logging.getLogger(__name__)
UNMOVED_MEDIAN_DEVIATIONS = 1.0
"""Median error in claimed deviations below which nothing can have moved."""
STEPS = 4
"""Of the analysis, as they are told."""
PROBE_CONFIGURATIONS = 60
"""Configurations at which the share of the markers in the expected variance is judged."""
COLUMN_WORDS = ("temp", "time", "stamp", "date", "hour")
"""Parts of the names of columns against which errors are shown without being asked."""


@dataclass(frozen=True, eq=False, repr=False)
class PositionFindings(Findings):
    """Numbers of a report about measured positions, or poses, alone.

    Args:
        rows: those of the fit.
        predictions: rows that the model has not seen, or those of its fit, each predicted by all others.
        repeats: what repeated configurations show; None if there are none.
        learning_curve: number of rows -> error of others, m; empty if the rows are not known.
        outliers: rows that look wrong among those of ``predictions``, and ``moved``: what else happened to them.
        columns: further columns of the table that errors are shown against, by name.
    """

    rows: FitRows
    predictions: Predictions
    repeats: Repeats | None
    learning_curve: Sequence[tuple[int, float]]
    outliers: Sequence[Outlier]
    moved: Sequence[str]
    columns: Mapping[str, Tensor]

    @property
    def forecast(self) -> tuple[int, float] | None:
        """Twice the rows of the fit and the error there, m; None if it cannot be told."""
        return forecast(self.learning_curve, self.limit)

    @cached_property
    def share_of_tool(self) -> float:
        """Share of the expected variance that knowing the markers would remove."""
        geometry = self.model.nominal.geometry
        tool = torch.arange(geometry.size, device=self.rows.q.device)[geometry.slices["tool"]]
        return self.rows.map.explained_by(tool, self.deviations.q[:PROBE_CONFIGURATIONS])

    @property
    def repeatability(self) -> float | None:
        """As of the class above."""
        return None if self.repeats is None else self.repeats.deviation

    @property
    def errors(self) -> Mapping[str, Evaluation]:
        """Errors of each stage on the rows shown."""
        return next(iter(self.kinds.values()))

    @property
    def judged(self) -> tuple[float, str]:
        """The RMS error of the model on the rows shown, m, which is compared with a tolerance."""
        *_, own = self.errors.values()
        return own.rms, "of these rows"

    @property
    def limit(self) -> float:
        """RMS distance, m, below which no model of the positions can come: repeatability, or the noise of the fit."""
        if self.repeats is not None and self.repeats.telling:
            return self.repeats.deviation
        return self.model.bodies.noise_rms(self.model.map.new_noise)


def find(
    model: CalibratedKinematics,
    data: Measurements | None = None,
    *,
    stages: Mapping[str, Kinematics] | None = None,
    against: Sequence[str] = (),
    progress: Progress = silent,
) -> PositionFindings:
    """Compute everything that a report shows.

    Args:
        model: a calibrated model. data: measurements; rows of the fit, and of a registration, are left out. By default,
            and if no others are left, the rows of the fit are shown, each predicted by all others. A model with control
            points does not know these itself: pass them in their order.
        stages: kinematics to compare, found anew by default.
        against: further columns of the table of ``data``.
        progress: called as ``progress(task, done, total)``.

    Raises:
        InputError: arguments of another kind, joints in another order, or a column that the table does not have.
        MeasurementError: rows that another reading explains far better, or too few rows of a set-up.
    """
    check_arguments(model, data)
    if data is not None:
        check_rows(model, data)
        if data.markers != model.markers:
            fix = "pass the markers that the model predicts, in the same order"
            raise InputError.of("the markers of `data`", expected=model.markers, got=data.markers, fix=fix)
        data = _undrifted(model, place(model, data).aligned(data))
    progress("analysis", 0, STEPS)
    rows = FitRows(model, data)
    predictions = _predictions(rows, model, data)
    progress("analysis", 1, STEPS)
    kinematics = stages_of(model, rows) if stages is None else stages
    *before, own = kinematics
    seen = predictions.data
    placed = {name: place(kinematics[name], seen) for name in before}
    errors = {name: residuals(kinematics[name], at, seen).main for name, at in placed.items()}
    errors[own] = predictions.errors
    outliers = predictions.outliers(model)
    progress("analysis", 2, STEPS)
    repeats, curve = _repeats(rows, model, data, kinematics), rows.learning_curve() if rows.known else []
    progress("analysis", 3, STEPS)
    deviations = Deviations.of(model).planned(model)
    found = PositionFindings(
        model=model,
        stages=kinematics,
        kinds={predictions.errors.kind: errors},
        new=not predictions.left_out,
        devices=placement_sentences(model),
        expected=expected_errors(model, kinematics, deviations.error),
        deviations=deviations,
        parts=parts(model),
        rows=rows,
        predictions=predictions,
        repeats=repeats,
        learning_curve=curve,
        outliers=outliers,
        moved=_moved(model, predictions, outliers),
        columns=_columns(predictions.data, against),
    )
    progress("analysis", STEPS, STEPS)
    return found


def _undrifted(model: CalibratedKinematics, data: Measurements) -> Measurements | None:
    """Rows that took no part in the fit as without a drift that the model knows; None if there are no others."""
    drift = KnownDrift.of(model)
    if drift is None:
        return data
    new = data.rows(~rows_used_in_fit(model, data.q))
    return drift.aligned(new) if len(new) else None


def check_arguments(model: object, data: object) -> None:
    """Raise InputError for arguments of another kind."""
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of("`model`", expected="a calibrated model of a robot", got=type(model).__name__)
    if not (data is None or isinstance(data, RowGroups)):
        expected = "dc.Measurements, dc.Readings or Observations"
        raise InputError.of("`data`", expected=expected, got=type(data).__name__)


def _predictions(rows: FitRows, model: CalibratedKinematics, data: Measurements | None) -> Predictions:
    """Those of rows that the model has not seen; if there are none, of the rows of the fit by all others."""
    new = None if data is None else unseen(model, data)
    if data is None or new is None:
        fitted = model.nominal.geometry.markers
        if model.registration is not None and model.markers != fitted:
            got = f"a model registered with {model.markers} marker(s), fitted with {fitted}"
            fix = "pass rows that it has not seen, neither in the fit nor in the registration"
            raise InputError.of("a report of the rows of the fit", expected="the markers of the fit", got=got, fix=fix)
        found = Predictions.of_fit(rows)
        LOG.info("judged by the %d rows of the fit, each predicted by all others", len(found))
        return found
    LOG.info("judged by %d rows it has not seen, %d were used before", len(new), len(data) - len(new))
    return Predictions.of(model, new)


def _repeats(
    rows: FitRows, model: CalibratedKinematics, data: Measurements | None, stages: Mapping[str, Kinematics]
) -> Repeats | None:
    """Repeatability from repeated configurations, in the table or else in the rows of the fit."""
    noise = float(model.map.new_noise.diagonal().mean().sqrt())
    repeats = None if data is None else repeats_of(data, stages, noise)
    if repeats is None and model.registration is None and rows.known:
        repeats = repeats_of(rows.measurements, stages, noise)
    return repeats


def unseen(model: CalibratedKinematics, data: Measurements) -> Measurements | None:
    """The rows that took no part in the fit, nor in a registration; None if there are none."""
    new = ~rows_used_in_fit(model, data.q)
    if model.registration is not None:
        placed = model.registration.q.to(data.q)
        new &= torch.cdist(data.q, placed, p=inf).amin(1) > SAME_CONFIGURATION
    if not bool(new.any()):
        return None
    return data.rows(new)


def _moved(model: CalibratedKinematics, predictions: Predictions, outliers: Sequence[Outlier]) -> list[str]:
    """Sentences about devices or markers that moved, blocks of wrong rows, and errors larger than expected."""
    data = predictions.data
    if predictions.left_out and model.registration is not None:
        return []  # the rows of its fit are in another place
    large = predictions.errors.median > UNMOVED_MEDIAN_DEVIATIONS * float(predictions.claimed.nanmedian())
    steps = steps_of(model, data) if len(outliers) >= gates.LAG_ROWS else []
    named, text = [step.sentence() for step in steps[:1]], None
    if data.bodies.perhaps_moved(far=large):
        named += [sentence(motion.sentence) for motion in motions(model, data)]
        text = implausible(model, data, predictions.errors)
    if impossible(model, predictions.errors.median):
        if not named:
            refuse_mistakes(model.robot, data)
        named = [" ".join([*(named or [text or ""]), data.set_up_hint]).strip()]
    if not named:
        named = [text or block_text(model, data, list(outliers)) or ""]
    if not any(named) and not outliers and not predictions.left_out:
        named = larger_than_expected(model, data, predictions.errors)
    return [text for text in named if text]


def _columns(data: Measurements, against: Sequence[str]) -> dict[str, Tensor]:
    """Columns of the table that were asked for, and those whose names speak of time or temperature."""
    known = data.origin.numeric_columns(data.line_numbers, gaps=True) if isinstance(data.origin, TableOrigin) else {}
    missing = [name for name in against if name not in known]
    if missing:
        expected = f"columns of numbers: {', '.join(known)}" if known else "a table that was read from a file"
        raise InputError.of("`against`", expected=expected, got=", ".join(missing))
    words = [name for name in known if any(word in name.lower() for word in COLUMN_WORDS) and name not in against]
    chosen = [*against, *words]
    there = {name: known[name][known[name].isfinite()] for name in chosen}  # NaN where a cell has no number
    return {name: known[name] for name, own in there.items() if not bool(torch.isclose(own, own[:1]).all())}
