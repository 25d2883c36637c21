"""A calibrated model as notebooks show it, and its predictions as a data frame."""

from __future__ import annotations

from typing import Any

from diffeo_calib.common.data_frames import data_frame, is_data_frame
from diffeo_calib.common.errors import printable
from diffeo_calib.common.notebook import facts_html
from diffeo_calib.measurements.pose_frames import kind_of_points


def measured_words(model: Any) -> str:
    """What a model was calibrated with, such as "poses" or "2 marker(s)"."""
    return kind_of_points(model.markers, model.lever)


def model_html(model: Any) -> str:
    """Robot, measurements, errors at the fit and provenance of a model."""
    robot, made, found = model.robot, model.provenance, model.summary
    facts: dict[str, object] = {
        "robot": f"{printable(robot.name)}, {printable(robot.base)} to {printable(robot.tip)}, {robot.n} joints",
        "measured": measured_words(model),
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


def predicted_frame(model: Any, q: Any) -> Any:
    """Predicted markers with the standard deviations of a new measurement, as a pandas.DataFrame in m.

    Args:
        model: the calibrated model. q: (N, n) joint values, rad or m, or a data frame, whose index is kept.

    Returns:
        columns x, y, z, std_x, std_y, std_z; marker1_x, ... with several markers, ball_x, ... of a ball beside them.
        Poses: the origin of their frame, and a rotation vector rx, ry, rz [rad] with deviations about the axes of the
        measuring frame; TIP_x, ... of several.

    Raises:
        ImportError: pandas is not installed.
    """
    found = model.bodies.predicted(model, q)
    names = [f"{prefix}{name}" for prefix in model.bodies.prefixes(model) for name in found.names]
    mean, std = found.mean.flatten(1), found.covariance.diagonal(dim1=-2, dim2=-1).sqrt().flatten(1)
    columns = dict(zip([*names, *(f"std_{name}" for name in names)], [*mean.T, *std.T], strict=True))
    return data_frame(columns, getattr(q, "index", None) if is_data_frame(q) else None)
