"""The kinematics that a model is compared with: nominal, and the geometric calibration that is its classical rival."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping

from torch import Tensor

from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.robust_registration import register_robustly
from diffeo_calib.interop.rigid import geometric_kinematics, nominal_kinematics
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.errors import Evaluation
from diffeo_calib.kinematics.evaluation import evaluate
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.fit_rows import FitRows

NOMINAL, GEOMETRIC, CALIBRATED = "nominal", "geometric", "calibrated"
Kinematics = Callable[[Tensor], Tensor]


def stages_of(model: CalibratedKinematics, rows: FitRows | None = None) -> dict[str, Kinematics]:
    """The stages of a model's calibration: nominal robot, geometric calibration, and the model itself.

    The first two are calibrated once more from the rows of the fit, which gives the same numbers as then. Where these
    rows are not known, or stand in several places (models with control points, registered or recalibrated models), base
    and markers are those that fit the model best.
    """
    rows = FitRows(model) if rows is None else rows

    if rows.in_one_place and model.registration is None and model.rigid_errors is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they were shown when the model was fitted
            registration = register_robustly(model.robot, rows.measurements)
            geometric = identify(registration.geometry, rows.q, rows.points)
        return {NOMINAL: registration.geometry.points, GEOMETRIC: geometric.geometry.points, CALIBRATED: model}
    return {**placed_stages(model), CALIBRATED: model}


def placed_stages(model: CalibratedKinematics) -> dict[str, Kinematics]:
    """The stages of a calibration with base and markers where they fit the model best."""
    return {
        NOMINAL: nominal_kinematics(model).geometry.points,
        GEOMETRIC: geometric_kinematics(model).geometry.points,
        CALIBRATED: model,
    }


def errors_by_stage(stages: Mapping[str, Kinematics], data: Measurements) -> dict[str, Evaluation]:
    """Errors of every stage on the same rows."""
    return {name: evaluate(kinematics, data) for name, kinematics in stages.items()}
