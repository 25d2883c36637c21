"""Errors of every stage of a calibration on rows of any kinds, each kind in its own unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from diffeo_calib.calibration.result import CalibrationResult
from diffeo_calib.kinematics.evaluation import residuals
from diffeo_calib.sensors.errors import Evaluation


@dataclass(frozen=True)
class KindErrors:
    """Errors of the rows of one kind.

    Args:
        stages: name of the stage -> its errors. rows: the table, measured positions in the frame of the model.
    """

    stages: dict[str, Evaluation]
    rows: Any

    @property
    def one(self) -> Evaluation:
        """The errors of the last stage."""
        return list(self.stages.values())[-1]


def errors_by_kind(result: CalibrationResult, data: Any) -> dict[str, KindErrors]:
    """Errors of a table by the kind of its rows.

    Args:
        result: the calibration. data: rows of the devices that it knows, in the measuring frames of its sessions.
    """
    found = {name: residuals(kinematics, result.places(name), data) for name, kinematics in result.stages.items()}
    first = next(iter(found.values()))
    return {
        kind: KindErrors({name: own[kind] for name, own in found.items()}, _rows(result, data, first, kind))
        for kind in first
    }


def _rows(result: CalibrationResult, data: Any, errors: Any, kind: str) -> Any:
    """The rows of a kind as a table of their own."""
    (own,) = data.rows(errors.index[kind].tolist()).parts
    return result.aligned(own.device_rows()) if errors[kind] is errors.positions else own
