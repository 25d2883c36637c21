"""The measured workspace in space, with errors before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.fit_rows import FitRows
from diffeo_calib.reports.analysis.predictions import Predictions
from diffeo_calib.reports.analysis.stages import GEOMETRIC, stages_of
from diffeo_calib.reports.plots.style import FAINT, INK, literal

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d.axes3d import Axes3D

ARROW_SHARE = 0.12
"""Length of the longest arrow in units of the workspace."""


def workspace(model: CalibratedKinematics, data: Measurements | None = None, title: str = "") -> Figure:
    """Errors as arrows at the measured places, geometric calibration beside the model, enlarged by one factor.

    Args:
        model: a calibrated model. data: rows that took no part in its fit; by default the rows of the fit.
        title: of the figure.
    """
    rows = FitRows(model)
    seen = Predictions.of_fit(rows) if data is None else Predictions.of(model, data)
    geometric = seen.data.body_kind.origins(stages_of(model)[GEOMETRIC](seen.data.q))
    there = ~seen.measured.isnan().any(2)  # of the sightings
    places, before, after = seen.measured[there], (seen.measured - geometric)[there], seen.away[there]
    figure = Figure(figsize=(9.6, 4.8), layout="constrained")
    size = float((places.amax(0) - places.amin(0)).max())
    factor = ARROW_SHARE * size / max(float(before.norm(dim=-1).max()), float(after.norm(dim=-1).max()), 1e-12)
    for number, (errors, name) in enumerate(((before, "geometric"), (after, "calibrated")), 1):
        axes: Any = figure.add_subplot(1, 2, number, projection="3d")
        _arrows(axes, places, errors, factor)
        rms = 1e3 * float(errors.square().sum(-1).mean().sqrt())
        axes.set_title(f"{name}: {rms:.3g} mm RMS, arrows x {factor:.0f}", fontsize=9, color=INK)
    if title:
        figure.suptitle(literal(title), fontsize=11, color=INK)
    return figure


def _arrows(axes: Axes3D, places: Tensor, errors: Tensor, factor: float) -> None:
    from matplotlib import colormaps  # noqa: PLC0415

    xyz, arrows, lengths = places, factor * errors, errors.norm(dim=-1)
    colours = colormaps["viridis"]((lengths / lengths.max().clamp(min=1e-12)).numpy())
    axes.scatter(*xyz.T.numpy(), s=4, color=colours)
    axes.quiver(*xyz.T.numpy(), *arrows.T.numpy(), color=colours, linewidth=1, arrow_length_ratio=0.2)
    axes.set_box_aspect((xyz.amax(0) - xyz.amin(0)).clamp(min=1e-3).tolist())
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.tick_params(labelsize=7, colors=FAINT)
