"""Figures of a calibration. matplotlib is imported when the first figure is drawn."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffeo_calib.common.errors import InputError
from diffeo_calib.common.images import IMAGE_SUFFIXES, write_figure
from diffeo_calib.kinematics.evaluation import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST_ERROR_MM = 1e-9
"""Smaller errors are drawn as this one: a logarithmic axis has no zero."""
COLOURS = ("#9aa5b1", "#e08e45", "#1f6f8b", "#5b8c5a", "#7d5ba6")
"""Colours of the stages, in order."""


def stages_figure(evaluations: dict[str, Evaluation], path: str | os.PathLike[str], title: str) -> None:
    """Write :func:`draw_stages` to an image file.

    Args:
        evaluations, title: arguments of :func:`draw_stages`.
        path: image file; its suffix selects the format.

    Raises:
        InputError: an unknown format, a folder that does not exist, or a file that cannot be written.
    """
    if Path(path).suffix.lower() not in IMAGE_SUFFIXES or not Path(path).parent.is_dir():
        expected = f"a file ending in {', '.join(IMAGE_SUFFIXES)} in an existing folder"
        raise InputError.of(f"the figure cannot be written to {path}", expected=expected)
    write_figure(draw_stages(evaluations, title), path, dpi=160)


def draw_stages(evaluations: dict[str, Evaluation], title: str) -> Figure:
    """Draw errors by stage: their distributions, and the last stage against the one before it.

    Args:
        evaluations: name of each stage -> its errors on the same rows, in order; at least two.
        title: one line that names the measurements.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

    figure = Figure(figsize=(10.0, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    _distributions(left, evaluations)
    _before_after(right, evaluations)
    figure.suptitle(title, fontsize=11)
    return figure


def _distributions(axes: Axes, evaluations: dict[str, Evaluation]) -> None:
    """Share of measurements whose error is at most a value, one curve per stage."""
    for (name, evaluation), colour in zip(evaluations.items(), COLOURS, strict=False):
        errors = np.sort(_millimetres(evaluation))
        share = np.arange(1, len(errors) + 1) / len(errors)
        axes.step(errors, share, where="post", color=colour, lw=2, label=f"{name}: {1e3 * evaluation.rms:.3f} mm RMS")
    axes.set(xscale="log", xlabel="position error [mm]", ylabel="share of measurements", ylim=(0, 1.01))
    axes.grid(alpha=0.25, which="both")
    axes.legend(frameon=False, fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 1.0))


def _before_after(axes: Axes, evaluations: dict[str, Evaluation]) -> None:
    """Error of every measurement in the last stage against its error in the stage before."""
    (before_name, before), (after_name, after) = list(evaluations.items())[-2:]
    x, y = _millimetres(before), _millimetres(after)
    low, high = 0.8 * min(x.min(), y.min()), 1.25 * max(x.max(), y.max())
    axes.plot([low, high], [low, high], color=COLOURS[0], lw=1, zorder=1)
    axes.scatter(x, y, s=12, color=COLOURS[2], alpha=0.6, edgecolors="none")
    axes.text(0.03, 0.97, "worse", transform=axes.transAxes, va="top", fontsize=9, color="#5c6773")
    axes.text(0.97, 0.03, "better", transform=axes.transAxes, ha="right", fontsize=9, color="#5c6773")
    axes.set_title(f"better for {100 * float((y < x).mean()):.0f} % of the measurements", fontsize=10)
    axes.set(
        xscale="log",
        yscale="log",
        xlim=(low, high),
        ylim=(low, high),
        xlabel=f"error after {before_name} [mm]",
        ylabel=f"error after {after_name} [mm]",
        aspect="equal",
    )
    axes.grid(alpha=0.25, which="both")


def _millimetres(evaluation: Evaluation) -> np.ndarray:
    """Errors in mm, raised to a positive minimum for a logarithmic axis."""
    return np.maximum(1e3 * evaluation.errors.flatten().numpy(), SMALLEST_ERROR_MM)
