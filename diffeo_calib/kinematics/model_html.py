"""A calibrated model as notebooks show it."""

from __future__ import annotations

from typing import Any

from diffeo_calib.common.errors import printable
from diffeo_calib.common.notebook import facts_html


def model_html(model: Any) -> str:
    """Robot, measurements, errors at the fit and provenance of a model."""
    robot, made, found = model.robot, model.provenance, model.summary
    facts: dict[str, object] = {
        "robot": f"{printable(robot.name)}, {printable(robot.base)} to {printable(robot.tip)}, {robot.n} joints",
        "measured": "poses" if model.lever is not None else f"{model.markers} marker(s)",
        "rows of the fit": len(model.configurations),
    }
    if found is not None:
        facts["geometric calibration, RMS"] = f"{1e3 * found.geometry_rms:.4f} mm on the rows of the fit"
        facts["calibrated, RMS"] = f"{1e3 * found.leave_one_out_rms:.4f} mm, each row predicted by all others"
    if model.registration is not None:
        facts["registered anew"] = f"{model.registration.rows} rows, RMS {1e3 * model.registration.rms_after:.4f} mm"
    if made is not None:
        facts["fitted"] = f"{made.date[:10]} with version {made.version}, table sha256 {made.table_sha256[:12]}"
        if made.note:
            facts["note"] = printable(made.note)
    return facts_html("Calibrated kinematics", facts)
