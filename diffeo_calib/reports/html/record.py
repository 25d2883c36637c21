"""The last section of a report: everything needed to make the model again."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite

from torch import Tensor

from diffeo_calib.common.errors import PACKAGE, printable
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
    model, made = found.model, found.model.provenance
    if made is not None:
        yield f"fitted        {made.date} (UTC) with {PACKAGE} {made.version}"
        if made.command:
            yield f"command       {made.command}"
        yield f"table         sha256 {made.table_sha256}"
        if made.note:
            yield f"note          {printable(made.note)}"
    if data_sha256 is not None:
        same = made is not None and data_sha256 == made.table_sha256
        yield f"data shown    {'the same table, rows of the fit left out' if same else 'sha256 ' + data_sha256}"
    limits = model.configurations.amin(0), model.configurations.amax(0)
    what = "poses" if model.lever is not None else f"positions of {model.markers} marker" + "s" * (model.markers > 1)
    yield f"robot         {model.robot.base} to {model.robot.tip}, {model.robot.n} joints"
    yield f"fitted to     {len(model.configurations)} rows, {what}"
    for joint, name in enumerate(model.robot.joint_names):
        low, high = (float(joint_values(model.robot, joint, end[joint])) for end in limits)
        unit = "mm" if model.robot.kinds[joint] == "prismatic" else "deg"
        yield f"  {name}: {low:.2f} to {high:.2f} {unit}"
    if model.summary is not None:
        summary = model.summary
        residuals = f"coupling {summary.coupling_residual:.1e}, end {summary.end_residual:.1e} (residuals)"
        certified = isfinite(summary.coupling_residual) and isfinite(summary.end_residual)
        yield f"optimum       {residuals if certified else 'without certificate: fewer control points than rows'}"
        yield f"status        {summary.status}; scales: {summary.scales}"
    geometry = model.geometry
    yield "robot base in the measuring frame, 4 x 4 [m]:"
    yield from _matrix(geometry.base)
    place, turn = geometry.base[:3, 3], rotation_numbers(geometry.base[None, :3, :3], "rotvec")[0]
    yield "  x y z rx ry rz [m, rad]: " + " ".join(f"{value:.6f}" for value in (*place.tolist(), *turn.tolist()))
    if model.lever is not None:
        yield f"measured frame in the frame of {geometry.chain.tip}, 4 x 4 [m]:"
        frame = model.measured_frame
        yield from _matrix(frame)
        turn = rotation_numbers(frame[None, :3, :3], "rotvec")[0]
        numbers = (*frame[:3, 3].tolist(), *turn.tolist())
        yield "  x y z rx ry rz [m, rad]: " + " ".join(f"{value:.6f}" for value in numbers)
        return
    for number, marker in enumerate(geometry.tool):
        yield f"marker {number} in the frame of {geometry.chain.tip} [m]: " + " ".join(
            f"{v:.6f}" for v in marker.tolist()
        )


def _matrix(transform: Tensor) -> Iterator[str]:
    for row in transform.tolist():
        yield "  " + " ".join(f"{value: .8f}" for value in row)
