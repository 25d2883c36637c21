"""Everything that a report says about a calibration, as numbers: of rows of any kinds, each in its own unit.

Repeats show accuracy and repeatability in the sense of ISO 9283. For one pose with n >= 2 attainments at positions p_j,
their mean m and the commanded position c,

    accuracy AP = |m - c|,    repeatability RP = mean(l_j) + 3 S_l,   l_j = |p_j - m|,

S_l the standard deviation of l_j. The standard asks for 30 attainments of five poses at full load and speed; fewer are
reported with their number.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.judged_rows import Outlier, common_cause, flagged, judge
from diffeo_calib.calibration.expected_errors import Accuracy, ExpectedError, accuracy, expected_errors
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register_inliers, with_large_offsets
from diffeo_calib.calibration.planning.plan import Plan, drawn, plan
from diffeo_calib.calibration.planning.sensors import sensor_of
from diffeo_calib.calibration.result import CALIBRATED, GEOMETRIC, NOMINAL, Part, parts
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.quantiles import largest_known
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.interop.rigid import rigid_kinematics, with_errors
from diffeo_calib.kinematics import evaluation
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import SessionMarkers
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.predictions import FitRows, Predictions, forecast
from diffeo_calib.sensors.coordinates import Places
from diffeo_calib.sensors.errors import ERRORS, Evaluation, Evaluations
from diffeo_calib.sensors.kinds import divided, measured_positions

Kinematics = Callable[[Tensor], Tensor]


def stages_of(model: CalibratedKinematics, rows: FitRows | None = None) -> dict[str, Kinematics]:
    """The stages of a model's calibration: nominal robot, geometric calibration, and the model itself.

    The first two are calibrated once more from the rows of the fit, which gives the same numbers as then. Where these
    rows are not known, or stand in several places (models with control points, registered or recalibrated models), base
    and markers are those that fit the model best.
    """
    rows = rows or FitRows(model)
    mounted_anew = isinstance(rows.map.geodesic.spec.at_controls, SessionMarkers)
    if not rows.known or mounted_anew or model.registration is not None or model.rigid_errors is None:
        errors = model.rigid_errors
        geometric = rigid_kinematics(model) if errors is None else with_errors(model, errors)
        geometries = with_errors(model, None).geometry, geometric.geometry
    else:
        data = rows.measurements
        with quiet():  # they were shown when the model was fitted
            registered = with_large_offsets(data, *register_inliers(model.robot, data)).geometry
            geometries = registered, identify(registered, rows.q, rows.points).geometry
    return {NOMINAL: geometries[0].points, GEOMETRIC: geometries[1].points, CALIBRATED: model}


CONFIGURATIONS, TARGETS, MEASURED, NEXT = 360, 100, 150, 5
"""Random configurations, those of them over which the plan counts, configurations of the fit, and planned poses."""


@dataclass(frozen=True, eq=False)
class Deviations:
    """Deviations that a model claims over the joint ranges of its fit, without the noise of a measurement."""

    q: Tensor  # (M, n) random configurations in these ranges, rad or m
    deviation: Tensor  # (M,) RMS distance of the markers that the model claims there, m
    measured: Tensor  # (K, n) configurations of the fit
    measured_deviation: Tensor  # (K,) the same there, m
    error: ExpectedError  # what the model expects in all, as every command says it

    # poses that would lower the deviations most, in the order of the moves; None if it is not known what measured
    next: Plan | None = None

    @classmethod
    def of(cls, model: CalibratedKinematics) -> Deviations:
        """The deviations of a model at random configurations."""

        def claimed(q: Tensor) -> Tensor:
            predicted = model.bodies.predicted(model, q.to(model.configurations.device), noise=False)
            return predicted.claimed.square().mean(1).sqrt().to(HOST)

        fitted = model.configurations.to(HOST)
        low, high = (torch.clamp(end, *model.robot.limits.unbind(1)) for end in (fitted.amin(0), fitted.amax(0)))
        draws = torch.rand(CONFIGURATIONS, len(low), generator=seeded(0), dtype=low.dtype, device=HOST)
        q, fitted = low + draws * (high - low), fitted[:: -(-len(fitted) // MEASURED)]
        deviations = cls(q, claimed(q), fitted, claimed(fitted), ExpectedError.of(model))
        try:
            somewhere = [sensor for sensor in sensor_of(model) if sensor.reached(model.geometry.base)]
        except InputError:  # a file of an early version
            return deviations
        options = [q]
        try:
            options += [drawn(model, somewhere, CONFIGURATIONS, model.geometry.tool)] if somewhere else []
        except InputError:  # such as of a camera, which cannot see everywhere
            options.append(model.configurations.to(HOST))
        return replace(deviations, next=plan(model, torch.cat(options), NEXT, target=q[:TARGETS]))


FEWEST_REPEATS = 5
"""Measurements beyond the first of every pose from which their deviation says something about the robot."""
STANDARD_REPEATS = 30  # attainments of every pose that ISO 9283 asks for


@dataclass(frozen=True, eq=False)
class Repeats:
    """Configurations that were measured several times."""

    lines: Tensor  # (G,) line number of the first measurement of each
    counts: Tensor  # (G,) measurements of each
    repeatability: Tensor  # (G,) RP of each, the largest of all markers, m
    accuracy: Mapping[str, Tensor]  # name of each stage -> (G,) AP of each configuration, the largest of all markers, m
    deviation: float  # pooled RMS distance of a measurement from the mean of its configuration, unbiased, m

    @property
    def telling(self) -> bool:
        """Whether there are enough repeats for one number that speaks of the robot."""
        return int((self.counts - 1).sum()) >= FEWEST_REPEATS


def repeats_of(data: Measurements, stages: Mapping[str, Kinematics], noise: float) -> Repeats | None:
    """Accuracy and repeatability of the configurations that rows repeat; None if no row does.

    Rows that differ so much that the robot moves by more than the noise are neighbours, not repeats. Exact copies of a
    row, which no measurement gives, count once.
    data: the rows. stages: name -> kinematics, the best one last. noise: of one measured coordinate, m.
    """
    copies = {row for _, row in data.copies()}
    data = data.rows([row for row in range(len(data)) if row not in copies])
    labels = data.groups()
    repeated = torch.bincount(labels)[labels] > 1
    if not bool(repeated.any()):
        return None
    data = data.rows(repeated)
    at_rows = {name: evaluation.at_payloads(kinematics, data)(data.q).detach() for name, kinematics in stages.items()}
    predicted = {name: data.bodies.origins(at) for name, at in at_rows.items()}  # (N, B, 3) m
    *_, best = predicted.values()
    points, labels, squares, freedom = data.origins, data.groups(), 0.0, 0
    first, counts, repeatability = list[int](), list[int](), list[Tensor]()
    accuracy: dict[str, list[Tensor]] = {name: [] for name in stages}
    for label in labels.unique().tolist():
        rows = (labels == label).nonzero()[:, 0]
        middle = points[rows].nanmean(0)
        distances = (points[rows] - middle).norm(dim=-1)  # (n, B), NaN for hidden markers
        attained = (~distances.isnan()).sum(0)
        if int(attained.max()) < 2 or float((best[rows] - best[rows[:1]]).norm(dim=-1).max()) >= noise:
            continue
        variances = (distances - distances.nanmean(0)).square().nansum(0) / (attained - 1).clamp(min=1)
        repeatability.append((distances.nanmean(0) + 3.0 * variances.sqrt())[attained > 1].max())
        squares += float(distances.square().nansum())
        freedom += int((attained - 1).clamp(min=0).sum())
        first.append(int(rows[0]))
        counts.append(len(rows))
        for name, places in predicted.items():
            accuracy[name].append(largest_known((middle - places[rows].mean(0)).norm(dim=-1), 0))
    if not first:
        return None
    return Repeats(
        data.line_numbers[first],
        torch.tensor(counts, dtype=torch.int64, device=HOST),
        torch.stack(repeatability),
        {name: torch.stack(values) for name, values in accuracy.items()},
        (squares / freedom) ** 0.5,
    )


LOG = logging.getLogger(__name__)
STEPS = 4  # of the analysis, as they are told
FAR_RATIO = 3.0  # ratio of expected errors anywhere to those like the measured ones from which the reason is told
COLUMN_WORDS = ("temp", "time", "stamp", "date", "hour")
"""Parts of the names of columns against which errors are shown without being asked."""


class RowsOfKind(NamedTuple):
    """N rows of one kind: their errors by stage, the model last, and joint values (N, n)."""

    stages: Mapping[str, Evaluation]
    q: Tensor

    @property
    def errors(self) -> Evaluation:
        """Errors of the model."""
        return list(self.stages.values())[-1]

    lines = property(lambda self: self.errors.line_numbers)


@dataclass(frozen=True, eq=False, repr=False)
class Findings:
    """Numbers of a report."""

    model: CalibratedKinematics
    stages: Mapping[str, Kinematics]  # kinematics to compare: nominal, geometric, calibrated
    rows: FitRows  # those of the fit
    kinds: Mapping[str, RowsOfKind]  # the rows that the report shows, by kind; empty without rows
    new: bool  # whether the model has not seen them
    # measured positions among them, predicted by a model that has not seen them; None without any
    predictions: Predictions | None
    outliers: Sequence[Outlier]  # rows that look wrong
    moved: Sequence[str]  # what else happened to the rows
    repeats: Repeats | None  # what repeated configurations show; None if there are none
    # number of rows -> error of others, m; empty if the rows of the fit are not known
    learning_curve: Sequence[tuple[int, float]]
    columns: Mapping[str, Tensor]  # further columns of the table that errors are shown against, by name
    # stage -> RMS error of positions that the model expects over the joint ranges of its rows, m
    expected: Mapping[str, float]
    deviations: Deviations  # what it expects at random configurations there, and at those of the fit
    devices: Sequence[str]  # where devices are, and what was found from the rows shown

    @property
    def parts(self) -> Sequence[Part]:
        """What explains how much."""
        return parts(self.model)

    @property
    def errors(self) -> Mapping[str, Evaluation]:
        """Errors of measured positions by stage, of a model that has not seen them; empty without any."""
        kinds = [] if self.predictions is None else self.kinds.values()
        return next((rows.stages for rows in kinds if rows.errors.what == ERRORS), {})

    @property
    def calibrated(self) -> Evaluation | None:
        """The last of these: errors of the model."""
        return list(self.errors.values())[-1] if self.errors else None

    @property
    def rms(self) -> Mapping[str, float]:
        """RMS error of positions by stage, m: measured, or the expected one where none were."""
        return {name: errors.rms for name, errors in self.errors.items()} or self.expected

    @property
    def unlike(self) -> bool:
        """Whether poses unlike the measured ones are much less certain than these."""
        return self.deviations.error.whole >= FAR_RATIO * self.deviations.error.measured

    @property
    def count(self) -> int:
        """Number of rows shown."""
        return sum(len(rows.q) for rows in self.kinds.values())

    @property
    def judged(self) -> Accuracy:
        """The RMS error that is compared with a tolerance."""
        fitted = not self.new and self.predictions is None
        errors = [] if fitted else [rows.errors for rows in self.kinds.values()]
        return accuracy(self.model, errors, "m", self.deviations.error)

    @property
    def forecast(self) -> tuple[int, float] | None:
        """Twice the rows of the fit and the error there, m; None if it cannot be told."""
        return forecast(self.learning_curve, self.limit)

    @property
    def telling(self) -> Repeats | None:
        """Repeated configurations, if they are enough for one number that speaks of the robot."""
        return self.repeats if self.repeats is not None and self.repeats.telling else None

    @property
    def limit(self) -> float:
        """RMS distance, m, below which no model of the positions can come: repeatability, or the noise of the fit."""
        if self.telling is not None:
            return self.telling.deviation
        return self.model.bodies.noise_rms(self.model.map.new_noise)


def find(
    model: CalibratedKinematics,
    data: Any = None,
    *,
    stages: Mapping[str, Kinematics] | None = None,
    places: Mapping[str, Places] | None = None,
    against: Sequence[str] = (),
    progress: Progress = silent,
) -> Findings:
    """Compute everything that a report shows; arguments and errors as of :func:`write_report`."""
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of("`model`", expected="a calibrated model of a robot", got=type(model).__name__)
    if data is not None:
        evaluation.check_rows(model, data)
    placed = (
        Places() if data is None else evaluation.place(model, data) if places is None else list(places.values())[-1]
    )
    measured = None if data is None else evaluation.positions_of(model, placed, data)
    if measured is not None and measured.markers != model.markers:
        fix = "pass the markers that the model predicts, in the same order"
        raise InputError.of("the markers of `data`", expected=model.markers, got=measured.markers, fix=fix)
    progress("analysis", 0, STEPS)
    rows = FitRows(model, measured)
    kinematics = stages_of(model, rows) if stages is None else stages
    progress("analysis", 1, STEPS)
    if data is not None and (bool((new := _new_rows(model, data, rows)).any()) or not rows.of_positions):
        shown = _of_table(
            model, data, new, measured, placed, stages=kinematics, places=places, of_positions=rows.of_positions
        )
    else:
        shown = _left_out(model, rows, kinematics) if rows.of_positions else NOTHING
    progress("analysis", 2, STEPS)
    noise, curve = float(model.map.new_noise.diagonal().mean().sqrt()), rows.learning_curve() if rows.known else []
    repeats = None if measured is None else repeats_of(measured, kinematics, noise)
    if repeats is None and model.registration is None and rows.known:
        repeats = repeats_of(rows.measurements, kinematics, noise)
    predicted: Predictions | None = shown["predictions"]
    columns = _columns(None if predicted is None else predicted.data, against)
    progress("analysis", 3, STEPS)
    deviations = Deviations.of(model)
    progress("analysis", STEPS, STEPS)
    return Findings(
        model,
        kinematics,
        rows,
        repeats=repeats,
        learning_curve=curve,
        columns=columns,
        expected=expected_errors(model, kinematics, deviations.error),
        deviations=deviations,
        devices=[*shown.pop("devices", ()), *evaluation.placement_sentences(model)],
        **shown,
    )


NOTHING: dict[str, Any] = {"kinds": {}, "new": False, "predictions": None, "outliers": (), "moved": ()}
"""What a report shows of rows without any; of others with these entries."""


def _new_rows(model: CalibratedKinematics, data: Any, rows: FitRows) -> Tensor:
    """(N,) which rows took no part in the fit, nor in a registration: those of other kinds than its rows never did."""
    new = evaluation.unseen(model, data.q)
    if rows.of_positions and model.registration is None:
        other = torch.ones_like(new)
        positions = divided(data)[0]
        if positions is not None:
            other[positions.rows.to(HOST)] = False
        new |= other
    return new


def _by_kind(errors: Mapping[str, Evaluations], q: Tensor) -> dict[str, RowsOfKind]:
    """Errors by stage, of rows with these joint values (N, n), by kind."""
    each = next(iter(errors.values())).index.items()
    return {kind: RowsOfKind({name: own[kind] for name, own in errors.items()}, q[rows.cpu()]) for kind, rows in each}


def _of_table(
    model: CalibratedKinematics,
    data: Any,
    mask: Tensor,
    measured: Measurements | None,
    placed: Places,
    *,
    of_positions: bool,
    stages: Mapping[str, Kinematics],
    places: Mapping[str, Places] | None,
) -> dict[str, Any]:
    """Rows that the model has not seen, of a ``mask`` (N,); if there are none, all as fitted.

    ``measured``: positions of all in the frame of the model, without its drift. If there are no other rows, they are
    placed beside every stage; else devices are where ``placed`` has them, or in ``places`` beside that stage.
    """
    new, (*before, last), errors = bool(mask.any()), stages, dict[str, Evaluations]()
    LOG.info("judged by %d rows it has not seen, %d were used before", int(mask.sum()), int((~mask).sum()))
    mask = mask if new else ~mask
    alone = of_positions and measured is not None and len(measured) == len(data)
    for name in before:
        rows = measured if alone else data
        at = evaluation.place(stages[name], rows) if alone or places is None else places[name]
        at = at if alone else replace(at, devices={**placed.devices, **at.devices}, ball=placed.ball)
        errors[name] = evaluation.residuals(stages[name], at, rows).rows(mask)
    errors[last] = evaluation.residuals(stages[last], placed, data).rows(mask)
    shown = NOTHING | {"kinds": _by_kind(errors, data.q[mask]), "new": new, "devices": placed.found}
    raw = measured_positions(data)  # as read: those of `measured` are moved by a drift that the model knows
    if measured is None or raw is None or not new or not bool((fresh := evaluation.unseen(model, raw.q)).any()):
        return shown
    judged = judge(model, placed, data.rows(mask), errors[last])
    moved = judged.causes if judged.refusal is None else [judged.refusal]
    predictions = Predictions.of(model, measured.rows(fresh))
    return shown | {"predictions": predictions, "outliers": predictions.outliers(model), "moved": moved}


def _left_out(model: CalibratedKinematics, rows: FitRows, stages: Mapping[str, Kinematics]) -> dict[str, Any]:
    """The rows of the fit, each predicted by all others."""
    fitted = model.nominal.geometry.markers
    if model.registration is not None and model.markers != fitted:
        got = f"a model registered with {model.markers} marker(s), fitted with {fitted}"
        fix = "pass rows that it has not seen, neither in the fit nor in the registration"
        raise InputError.of("a report of the rows of the fit", expected="the markers of the fit", got=got, fix=fix)
    predicted = Predictions.of_fit(rows)
    LOG.info("judged by the %d rows of the fit, each predicted by all others", len(predicted))
    data, (*before, last) = predicted.data, stages
    errors = {name: evaluation.residuals(stages[name], evaluation.place(stages[name], data), data) for name in before}
    errors[last] = Evaluations.of([(predicted.errors, torch.arange(len(predicted), device=HOST))])
    outliers = predicted.outliers(model)
    wrong = flagged(len(data), outliers)
    cause = common_cause(model, data, wrong) if model.registration is None else None  # else they are elsewhere
    kinds, moved = _by_kind(errors, data.q), [cause] if cause else []
    return {"kinds": kinds, "new": False, "predictions": predicted, "outliers": outliers, "moved": moved}


def _columns(data: Measurements | None, against: Sequence[str]) -> dict[str, Tensor]:
    """Columns of the table that were asked for, and those whose names speak of time or temperature."""
    columns = dict[str, Tensor]()
    if data is not None and isinstance(data.origin, TableOrigin):
        columns = data.origin.numeric_columns(data.line_numbers, gaps=True)
    missing = [name for name in against if name not in columns]
    if missing:
        alone = "a table of positions or poses alone, read from a file"
        expected = f"columns of numbers: {', '.join(columns)}" if columns else alone
        raise InputError.of("`against`", expected=expected, got=", ".join(missing))
    words = [name for name in columns if any(word in name.lower() for word in COLUMN_WORDS) and name not in against]
    chosen = [*against, *words]
    there = {name: columns[name][columns[name].isfinite()] for name in chosen}  # NaN where a cell has no number
    return {name: columns[name] for name, cells in there.items() if not bool(torch.isclose(cells, cells[:1]).all())}
