"""The stages that a model is compared with, its deviations anywhere, and what repeated configurations show.

Repeats show accuracy and repeatability in the sense of ISO 9283. For one pose with n >= 2 attainments at positions p_j,
their mean m and the commanded position c,

    accuracy AP = |m - c|,    repeatability RP = mean(l_j) + 3 S_l,   l_j = |p_j - m|,

S_l the standard deviation of l_j. The standard asks for 30 attainments of five poses at full load and speed; fewer are
reported with their number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register_inliers, with_large_offsets
from diffeo_calib.calibration.planning.plan import Plan, drawn, plan
from diffeo_calib.calibration.planning.sensors import sensor_of
from diffeo_calib.calibration.result import CALIBRATED, GEOMETRIC, NOMINAL
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.quantiles import largest_known
from diffeo_calib.interop.rigid import rigid_kinematics, with_errors
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import at_payloads
from diffeo_calib.kinematics.nominal import SessionMarkers
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.predictions import FitRows

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

    Args:
        data: the rows. stages: name -> kinematics, the best one last. noise: of one measured coordinate, m.
    """
    copies = {row for _, row in data.copies()}
    data = data.rows([row for row in range(len(data)) if row not in copies])
    labels = data.groups()
    repeated = torch.bincount(labels)[labels] > 1
    if not bool(repeated.any()):
        return None
    data = data.rows(repeated)
    at_rows = {name: at_payloads(kinematics, data)(data.q).detach() for name, kinematics in stages.items()}
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
