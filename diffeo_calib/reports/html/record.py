"""The last section of a report: everything needed to make the model again."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite

from torch import Tensor

from diffeo_calib.common.errors import PACKAGE, printable
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.model_views import measured_words
from diffeo_calib.kinematics.provenance import Provenance
from diffeo_calib.measurements.pose_frames import POINTS, by_frame
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.reports.analysis.findings import Findings
from diffeo_calib.reports.html.document import Section
from diffeo_calib.reports.plots.joints import joint_values


def record(found: Findings, data_sha256: str | None) -> Section:
    """Everything needed to make the model again."""
    return Section(
        "record", "Record", "Everything needed to make this model again.", text=list(_lines(found, data_sha256))
    )


def _lines(found: Findings, data_sha256: str | None) -> Iterator[str]:
    yield from _origin(found.model.provenance, None if found.predictions.left_out else data_sha256)
    yield from _fit(found.model)
    yield from _places(found.model)


def _origin(made: Provenance | None, data_sha256: str | None) -> Iterator[str]:
    """When the model was made, how, and of which table."""
    if made is not None:
        yield f"fitted        {made.date} (UTC) with {PACKAGE} {made.version}"
        if made.command:
            yield f"command       {printable(made.command)}"
        yield f"table         sha256 {made.table_sha256}"
        if made.note:
            yield f"note          {printable(made.note)}"
    if data_sha256 is not None:
        same = made is not None and data_sha256 == made.table_sha256
        yield f"data shown    {'the same table, rows of the fit left out' if same else 'sha256 ' + data_sha256}"


def _fit(model: CalibratedKinematics) -> Iterator[str]:
    """Robot, rows and ranges of the fit, and how it ended."""
    robot, limits = model.robot, (model.configurations.amin(0), model.configurations.amax(0))
    points = f"positions of {model.markers} marker" + "s" * (model.markers > 1)
    what = points if model.lever is None else measured_words(model)
    yield f"robot         {printable(robot.base)} to {printable(robot.tip)}, {robot.n} joints"
    yield f"fitted to     {len(model.configurations)} rows, {what}"
    for joint, name in enumerate(robot.joint_names):
        low, high = (float(joint_values(robot, joint, end[joint])) for end in limits)
        yield f"  {printable(name)}: {low:.2f} to {high:.2f} {'mm' if robot.kinds[joint] == 'prismatic' else 'deg'}"
    summary = model.summary
    if summary is not None:
        residuals = f"coupling {summary.coupling_residual:.1e}, end {summary.end_residual:.1e} (residuals)"
        certified = isfinite(summary.coupling_residual) and isfinite(summary.end_residual)
        yield f"optimum       {residuals if certified else 'without certificate: fewer control points than rows'}"
        yield f"status        {summary.status}; scales: {summary.scales}"


def _places(model: CalibratedKinematics) -> Iterator[str]:
    """Where the base and the markers, or the measured frame, were found."""
    geometry = model.geometry
    yield "robot base in the measuring frame, 4 x 4 [m]:"
    yield from _matrix(geometry.base)
    if model.lever is not None:
        for tip, frame in zip(geometry.on[::POINTS], by_frame(model.measured_frame[None])[0], strict=True):
            yield f"measured frame in the frame of {printable(tip)}, 4 x 4 [m]:"
            yield from _matrix(frame)
        return
    for number, (tip, marker) in enumerate(zip(geometry.on, geometry.tool.tolist(), strict=True)):
        place = " ".join(f"{value:.6f}" for value in marker)
        yield f"marker {number} in the frame of {printable(tip)} [m]: {place}"


def _matrix(transform: Tensor) -> Iterator[str]:
    """A transform as a matrix, and as a place and a rotation vector."""
    for row in transform.tolist():
        yield "  " + " ".join(f"{value: .8f}" for value in row)
    turn = rotation_numbers(transform[None, :3, :3], "rotvec")[0]
    numbers = (*transform[:3, 3].tolist(), *turn.tolist())
    yield "  x y z rx ry rz [m, rad]: " + " ".join(f"{value:.6f}" for value in numbers)
