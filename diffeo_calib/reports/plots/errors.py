"""Panels of errors: distributions by stage, the calibrated model against geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from diffeo_calib.common.hidden_values import known
from diffeo_calib.reports.plots.style import BLUE, GREY, INK, LOOKS, finish, legend, note, panels
from diffeo_calib.sensors.errors import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST_ERROR = 1e-9
"""Smaller errors in mm, px or deg are drawn as this one: a logarithmic axis has no zero."""


def stages(
    evaluations: Mapping[str, Evaluation] | Sequence[Mapping[str, Evaluation]],
    title: str = "",
    *,
    repeatability: float | None = None,
) -> Figure:
    """Errors by stage: their distributions, the last stage against the one before it, and orientations if measured.

    Args:
        evaluations: name of each stage -> its errors on the same rows, in order; at least two. One such mapping for
            each kind of rows if there are several.
        title: one line that names the measurements.
        repeatability: RMS distance of repeated measurements from their mean, m, drawn as the limit of any model.
    """
    kinds = [evaluations] if isinstance(evaluations, Mapping) else list(evaluations)
    angles = [all(one.angles is not None for one in kind.values()) for kind in kinds]
    columns = 2 + any(angles)
    figure, axes = panels(2 * len(kinds) + sum(angles), columns=columns, title=title)
    free = iter(axes)
    for kind, turned in zip(kinds, angles, strict=True):
        draw_distributions(next(free), kind, repeatability=repeatability)
        draw_before_after(next(free), kind)
        if turned:
            draw_distributions(next(free), kind, angles=True)
    return figure


def draw_distributions(
    axes: Axes, evaluations: Mapping[str, Evaluation], *, angles: bool = False, repeatability: float | None = None
) -> None:
    """Share of measurements whose error is at most a value, one curve for each stage."""
    one = next(iter(evaluations.values()))
    unit, per_unit = ("deg", 1.0) if angles else one.shown
    for (name, found), look in zip(evaluations.items(), LOOKS, strict=False):
        errors = np.sort(_degrees(found.angles) if angles and found.angles is not None else _sizes(found))
        share = np.arange(1, len(errors) + 1) / len(errors)
        rms = found.angle_rms if angles else per_unit * found.rms
        label = f"{name}: {rms:.3g} {unit} RMS"
        axes.step(errors, 100 * share, where="post", color=look.colour, ls=look.line, lw=look.width, label=label)
    if repeatability is not None:
        axes.axvline(1e3 * repeatability, color=INK, lw=0.8, label=f"repeatability: {1e3 * repeatability:.3g} mm RMS")
    axes.set_ylim(0, 101)
    finish(axes, x=f"{'orientation error' if angles else one.label} [{unit}]", y="measurements [%]", logarithmic="x")
    legend(axes, loc="lower left", bbox_to_anchor=(0.0, 1.0))


def draw_before_after(axes: Axes, evaluations: Mapping[str, Evaluation]) -> None:
    """Error of every measurement in the last stage against its error in the stage before."""
    (before_name, before), (after_name, after) = list(evaluations.items())[-2:]
    x, y = _sizes(before), _sizes(after)
    unit = after.shown[0]
    low, high = 0.8 * min(x.min(), y.min()), 1.25 * max(x.max(), y.max())
    axes.plot([low, high], [low, high], color=GREY, lw=1, zorder=1)
    axes.scatter(x, y, s=9, color=BLUE, alpha=0.6, edgecolors="none")
    note(axes, 0.03, 0.97, "worse", va="top")
    note(axes, 0.97, 0.03, "better", ha="right")
    axes.set_title(f"better for {100 * float((y < x).mean()):.0f} % of the measurements", fontsize=9, color=INK)
    axes.set(xlim=(low, high), ylim=(low, high))
    finish(axes, x=f"{before_name}: error [{unit}]", y=f"{after_name}: error [{unit}]", logarithmic="xy")


def _sizes(evaluation: Evaluation) -> np.ndarray:
    """Known errors in the unit in which they are shown."""
    return np.maximum(evaluation.shown[1] * known(evaluation.errors).numpy(), SMALLEST_ERROR)


def _degrees(angles: Tensor) -> np.ndarray:
    return np.maximum(angles.rad2deg().numpy(), SMALLEST_ERROR)
