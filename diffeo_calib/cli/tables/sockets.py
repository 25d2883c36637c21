"""What is printed about rows in sockets. Imports torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from torch import Tensor

from diffeo_calib.calibration.expected_errors import expected_errors, workspace_deviation
from diffeo_calib.calibration.placing.sockets import FLATTERY
from diffeo_calib.cli.record import record
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.sensors.errors import Evaluation


def socket_lines(errors: Evaluation, rows: str) -> Iterator[str]:
    """Known distances and those found, for some rows."""
    for one in errors.distances:
        between = f"distance of '{one.first}' and '{one.second}' ({rows})"
        yield f"{between}: {1e3 * one.found:.3f} mm, known {1e3 * one.known:.3f}, error {1e3 * one.error:+.3f}"


def stage_line(model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]]) -> str:
    """The absolute errors that a model of sockets or readings expects of every stage; they go into the record too."""
    found = expected_errors(model, stages)
    record.add(expected_error_by_stage_m=found)
    listed = ", ".join(f"{name} {1e3 * value:.3f}" for name, value in found.items())
    return f"expected absolute error by stage, in mm: {listed}"


def expectation_lines(model: CalibratedKinematics, flattery: str = FLATTERY) -> Iterator[str]:
    """The absolute error that a model of sockets or readings expects, and what does not show it without a device."""
    alone, expected = model.map.workspace is not None, 1e3 * workspace_deviation(model.map)
    fitted = ", after a rigid fit" * alone
    yield f"expected absolute error over the joint ranges of the fit{fitted}: {expected:.3f} mm RMS"
    yield from [flattery] * alone
