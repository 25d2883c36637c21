"""Figures of a calibration. matplotlib is imported when the first figure is drawn."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from diffeo_calib.calibration.recalibration.compare import ModelComparison
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.images import IMAGE_SUFFIXES, write_figure
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.robots.chain import Chain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST_ERROR_MM = 1e-9
"""Smaller errors are drawn as this one: a logarithmic axis has no zero."""
BINS = 12
"""Intervals of a joint's range."""
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


def comparison_figure(found: ModelComparison, robot: Chain, path: str | os.PathLike[str], title: str) -> None:
    """Write :func:`draw_comparison` to an image file; raises as :func:`stages_figure`."""
    if Path(path).suffix.lower() not in IMAGE_SUFFIXES or not Path(path).parent.is_dir():
        expected = f"a file ending in {', '.join(IMAGE_SUFFIXES)} in an existing folder"
        raise InputError.of(f"the figure cannot be written to {path}", expected=expected)
    write_figure(draw_comparison(found, robot, title), path, dpi=160)


def draw_comparison(found: ModelComparison, robot: Chain, title: str) -> Figure:
    """Draw the distance between two models against every joint, beside what their uncertainties explain.

    Args:
        found: the comparison. robot: names and kinds of the joints. title: one line that names the models.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

    columns = min(robot.n, 3)
    lines = -(-robot.n // columns)
    figure = Figure(figsize=(3.4 * columns, 2.6 * lines + 0.6), layout="constrained")
    grid = figure.subplots(lines, columns, sharey=True, squeeze=False).ravel()
    length = 1e3 * found.difference.square().sum(-1).mean(1).sqrt()
    expected = 1e3 * found.deviation.square().mean(1).sqrt()
    for joint, axes in enumerate(grid):
        if joint >= robot.n:
            axes.set_axis_off()
            continue
        slide = robot.kinds[joint] == "prismatic"
        values = 1e3 * found.q[:, joint] if slide else found.q[:, joint].rad2deg()
        edges = values.new_tensor(np.linspace(float(values.min()), float(values.max()), BINS + 1))
        number = torch.bucketize(values, edges[1:-1])
        middles = 0.5 * (edges[1:] + edges[:-1])
        for what, style, label in ((length, "-o", "difference"), (expected, "--", "explained by uncertainty")):
            means = [float(what[number == k].square().mean().sqrt()) for k in range(BINS)]
            axes.plot(middles, means, style, color=COLOURS[2 if style == "-o" else 0], markersize=3, label=label)
        axes.set_xlabel(f"{robot.joint_names[joint]} [{'mm' if slide else 'deg'}]")
    grid[0].set_ylim(bottom=0)  # of all, which share it
    grid[0].set_ylabel("RMS distance [mm]")
    grid[0].legend(fontsize=8)
    figure.suptitle(title, fontsize=11)
    return figure


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
