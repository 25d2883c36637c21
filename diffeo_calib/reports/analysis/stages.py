"""The kinematics that a model is compared with: nominal, and the geometric calibration that is its classical rival."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from diffeo_calib.interop.rigid import geometric_kinematics, nominal_kinematics
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import Evaluation, evaluate
from diffeo_calib.measurements.table import Measurements

NOMINAL, GEOMETRIC, CALIBRATED = "nominal", "geometric", "calibrated"
Kinematics = Callable[[Tensor], Tensor]


def stages_of(model: CalibratedKinematics) -> dict[str, Kinematics]:
    """Nominal robot and geometric calibration, base and markers where they fit best, and the model itself."""
    return {
        NOMINAL: nominal_kinematics(model).geometry.points,
        GEOMETRIC: geometric_kinematics(model).geometry.points,
        CALIBRATED: model,
    }


def errors_by_stage(stages: Mapping[str, Kinematics], data: Measurements) -> dict[str, Evaluation]:
    """Errors of every stage on the same rows."""
    return {name: evaluate(kinematics, data) for name, kinematics in stages.items()}
