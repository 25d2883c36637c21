"""The distance between two models against every joint."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

import numpy as np
import torch

from diffeo_calib.calibration.recalibration.compare import ModelComparison
from diffeo_calib.reports.plots.joints import joint_label, joint_values
from diffeo_calib.reports.plots.style import BLUE, GREY, finish, legend, panels
from diffeo_calib.robots.tree import Tree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BINS = 12
"""Intervals of a joint's range."""


def comparison(found: ModelComparison, robot: Tree, title: str = "") -> Figure:
    """Draw the distance between two models against every joint, beside what their uncertainties explain.

    Args:
        found: the comparison. robot: names and kinds of the joints. title: one line that names the models.
    """
    figure, grid = panels(robot.n, columns=min(3, robot.n), title=title)
    length = 1e3 * found.difference.square().sum(-1).mean(1).sqrt()
    expected = 1e3 * found.deviation.square().mean(1).sqrt()
    highest = 0.0
    for joint, axes in enumerate(grid):
        values = joint_values(robot, joint, found.q[:, joint])
        edges = values.new_tensor(np.linspace(float(values.min()), float(values.max()), BINS + 1))
        number = torch.bucketize(values, edges[1:-1])
        middles = 0.5 * (edges[1:] + edges[:-1])
        for what, style, colour, label in (
            (length, "-o", BLUE, "difference"),
            (expected, "--", GREY, "explained by uncertainty"),
        ):
            means = [float(what[number == k].square().mean().sqrt()) for k in range(BINS)]
            axes.plot(middles, means, style, color=colour, markersize=3, label=label)
            highest = max(highest, *[mean for mean in means if isfinite(mean)])
        finish(axes, x=joint_label(robot, joint), y="RMS distance [mm]" if joint % 3 == 0 else "")
    for axes in grid:
        axes.set_ylim(0, 1.1 * highest or 1.0)
    legend(grid[0])
    return figure
