"""Figures of a calibration. matplotlib is imported when the first one is drawn."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.common.images import IMAGE_SUFFIXES
from diffeo_calib.kinematics.evaluation import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SMALLEST = 1e-9
"""Errors below are drawn as this, mm."""
COLOURS = ("#9aa5b1", "#e08e45", "#1f6f8b", "#5b8c5a", "#7d5ba6")


def stages_figure(evaluations: dict[str, Evaluation], path: str | os.PathLike[str], title: str) -> None:
    """Draw errors by stage: their distribution, and each measurement's before and after.

    Args:
        evaluations: name of each stage -> its errors on the same rows, in order; at least two.
        path: image file, the format by its suffix.
        title: what was measured, one line.

    Raises:
        InputError: another format, or a folder that does not exist.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

    if Path(path).suffix.lower() not in IMAGE_SUFFIXES or not Path(path).parent.is_dir():
        expected = f"a file ending in {', '.join(IMAGE_SUFFIXES)} in an existing folder"
        raise InputError(sentence(f"the figure cannot be written to {path}", expected=expected))

    figure = Figure(figsize=(10.0, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    _distributions(left, evaluations)
    _before_after(right, evaluations)
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=160)


def _distributions(axes: Axes, evaluations: dict[str, Evaluation]) -> None:
    """Share of measurements whose error is below a value, one curve per stage."""
    for (name, evaluation), colour in zip(evaluations.items(), COLOURS, strict=False):
        errors = np.sort(_millimetres(evaluation))
        share = np.arange(1, len(errors) + 1) / len(errors)
        axes.step(errors, share, where="post", color=colour, lw=2, label=f"{name}: {1e3 * evaluation.rms:.3f} mm RMS")
    axes.set(xscale="log", xlabel="position error [mm]", ylabel="share of measurements", ylim=(0, 1.01))
    axes.grid(alpha=0.25, which="both")
    axes.legend(frameon=False, fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 1.0))


def _before_after(axes: Axes, evaluations: dict[str, Evaluation]) -> None:
    """Every measurement's error in the last stage against its error in the one before."""
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
    """Errors in mm for a logarithmic axis, which has no place for an error of exactly zero."""
    return np.maximum(1e3 * evaluation.errors.flatten().numpy(), SMALLEST)
