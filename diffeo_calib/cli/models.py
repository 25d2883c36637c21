"""Model files that the commands read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.model_file import load
from diffeo_calib.kinematics.calibrated import CalibratedKinematics


def load_kinematics(path: Path) -> CalibratedKinematics:
    """Load the model of a robot.

    Raises:
        InputError: the file cannot be read, or holds the model of another map.
    """
    model = load(path)
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of(f"{path} is not a robot's model", fix="pass a file written by `diffeo-calib fit`")
    return model


def provenance_lines(model: CalibratedKinematics) -> Iterator[str]:
    """When the model was fitted and to what, if its file says so."""
    if model.provenance is not None:
        yield model.provenance.sentence(model.robot.name, len(model.configurations))
