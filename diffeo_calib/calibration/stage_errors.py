"""Errors of every stage of a calibration on rows of any kinds, each kind in its own unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from diffeo_calib.calibration.result import CalibrationResult
from diffeo_calib.kinematics.evaluation import Evaluation, evaluate
from diffeo_calib.kinematics.socket_errors import with_markers_of
from diffeo_calib.sensors.tables import divided


@dataclass(frozen=True)
class KindErrors:
    """Errors of the rows of one kind.

    Args:
        what: their name, such as "Position errors". unit: in which they are shown.
        per_unit: how many of it are one of the values of the evaluations: 1000 for metres that are shown in mm.
        error: whether they are errors of positions; else a spread or errors of readings, which say less.
        stages: name of the stage -> its errors. rows: the table.
    """

    what: str
    unit: str
    per_unit: float
    error: bool
    stages: dict[str, Evaluation]
    rows: Any


def errors_by_kind(result: CalibrationResult, data: Any) -> list[KindErrors]:
    """Errors of a table's coordinates, and of its readings by kind.

    Args:
        result: the calibration. data: rows of the devices that it knows, in the measuring frames of its sessions.
    """
    own, readings = divided(data)
    found = []
    if own is not None:
        table = with_markers_of(result.model, result.aligned(own.table))
        stages = {name: evaluate(kinematics, table) for name, kinematics in result.stages.items()}
        what = "Spread within sockets" if table.without_device else "Position errors"
        found.append(KindErrors(what, "mm", 1e3, not table.without_device, stages, table))
    for table, _ in readings:
        stages = {}
        for name in result.stages:
            devices, errors = result.reading_errors(table, name)
            stages[name] = Evaluation(
                devices.in_unit(table, errors).norm(dim=1, keepdim=True), line_numbers=table.lines
            )
        found.append(KindErrors(f"Errors of {table.kind}s", table.unit[0], 1.0, False, stages, table))
    return found
