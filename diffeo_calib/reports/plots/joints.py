"""Panels against the joints: transmission errors with their bands, what explains how much, expected errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.result import Part
from diffeo_calib.common.errors import shown
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.transmission import smooth_transmission
from diffeo_calib.reports.analysis.predictions import FitRows
from diffeo_calib.reports.analysis.stages import Deviations
from diffeo_calib.reports.plots.style import BLUE, GREY, INK, LOOKS, dots, finish, legend, literal
from diffeo_calib.robots.tree import Tree

if TYPE_CHECKING:
    from matplotlib.axes import Axes


POINTS = 120
"""Values of a joint at which its transmission error is drawn."""
HISTOGRAM_BINS = 24
"""Intervals of the measured values below it."""
WIDE_RATIO = 20.0
"""Ratio of the largest to the smallest deviation from which they are drawn on a logarithmic axis."""
BINS, FEWEST_IN_BIN = 10, 3
PART_WIDTH = 4.7
"""Width of the figure of the parts, inches."""
TWO_SIDED_95 = 1.96
LONGEST_NAME = 36
"""Letters of a name in a panel."""


def draw_transmission(axes: Axes, model: CalibratedKinematics, rows: FitRows, joint: int) -> None:
    """Transmission error of one joint without gear lines, its mean over the measured range left out."""
    robot, name = model.robot, model.robot.joint_names[joint]
    measured, share = rows.q[:, joint], torch.linspace(0.0, 1.0, POINTS, dtype=torch.float64, device=rows.q.device)
    values = torch.lerp(measured.min(), measured.max(), share)
    error = smooth_transmission(model.map.deformation, robot, name, values.to(model.configurations.device)).cpu()
    error = 1e3 * (error - error.mean())
    band = 1e3 * TWO_SIDED_95 * rows.transmission_deviation(joint, values)
    x = joint_values(robot, joint, values).numpy()
    axes.fill_between(x, error - band, error + band, color=BLUE, alpha=0.2, lw=0)
    axes.plot(x, error, color=BLUE, lw=1.8)
    most = max(float((error.abs() + band).max()), 1e-6)
    counts, edges = np.histogram(joint_values(robot, joint, measured), HISTOGRAM_BINS)
    heights, bottom = 0.5 * most * counts / counts.max(), -1.75 * most
    axes.stairs(bottom + heights, edges, baseline=bottom, fill=True, color=GREY, alpha=0.6, lw=0)
    axes.set_ylim(-1.75 * most, 1.15 * most)
    finish(axes, x=joint_label(robot, joint), y=f"transmission error [{joint_unit(robot, joint, 'mrad')}]")


def draw_parts(axes: Axes, found: Sequence[Part]) -> None:
    """Bars of the parts of a model, in mm."""
    lengths = [1e3 * part.displacement for part in found]
    places = np.arange(len(found))[::-1]
    axes.barh(places, lengths, color=BLUE, height=0.62)
    for place, length in zip(places, lengths, strict=True):
        axes.text(length, place, f" {length:.3f}", va="center", fontsize=8, color=INK)
    names = [literal(short(part.name)) for part in found]
    axes.set_yticks(places, names)
    axes.set_xlim(0, 1.15 * max([*lengths, 1e-9]))
    ticks = list(axes.get_yticks())
    finish(axes, x="RMS displacement [mm]", y="")
    axes.set_yticks(ticks, names)
    axes.grid(visible=False, axis="y")


def draw_expected(axes: Axes, robot: Tree, joint: int, found: Deviations, *, key: bool = True) -> None:
    """Deviations that a model claims against one joint: anywhere in its ranges, and where it was measured.

    ``key``: whether the lines are named.
    """
    values, lengths = joint_values(robot, joint, found.q[:, joint]), 1e3 * found.deviation
    near, short = joint_values(robot, joint, found.measured[:, joint]), 1e3 * found.measured_deviation
    dots(axes, values, lengths, colour=GREY, size=2.2)
    dots(axes, near, short, colour=BLUE, size=2.2)
    anywhere = values, lengths, LOOKS[1], "anywhere in the ranges"
    for x, y, look, label in (anywhere, (near, short, LOOKS[2], "as measured")):
        axes.plot(*rms_in_bins(x, y), color=look.colour, ls=look.line, lw=look.width, label=label)
    wide = float(lengths.max()) > WIDE_RATIO * float(short.min())
    if not wide:
        axes.set_ylim(0, 1.3 * float(lengths.max()))
    finish(axes, x=joint_label(robot, joint), y="expected error [mm]", logarithmic="y" if wide else "")
    if wide:
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.25)
    if key:
        legend(axes, loc="upper left", ncols=2)


def in_bins(values: Tensor, lengths: Tensor) -> Iterator[tuple[float, float, Tensor]]:
    """Ends of intervals of values, and the lengths there: none where there are fewer than three."""
    edges = torch.linspace(float(values.min()), float(values.max()), BINS + 1, dtype=values.dtype, device=values.device)
    number = torch.bucketize(values, edges[1:-1])
    for k, (low, high) in enumerate(pairwise(edges.tolist())):
        group = lengths[number == k]
        yield low, high, group if len(group) >= FEWEST_IN_BIN else group[:0]


def rms_in_bins(values: Tensor, lengths: Tensor) -> tuple[list[float], list[float]]:
    """Middles of intervals of values, and the RMS of the lengths there."""
    found = [((low + high) / 2, float(group.square().mean().sqrt())) for low, high, group in in_bins(values, lengths)]
    return [middle for middle, _ in found], [rms for _, rms in found]


def short(name: str) -> str:
    """A name that fits into a panel."""
    return shown(name, LONGEST_NAME)


def joint_values(robot: Tree, joint: int, values: Tensor) -> Tensor:
    """Values of a joint in degrees, or in mm for a slide."""
    return values.rad2deg() if robot.periodic[joint] else 1e3 * values


def joint_unit(robot: Tree, joint: int, turn: str = "deg") -> str:
    """Unit in which values of a joint are shown: ``turn``, or mm for a slide."""
    return turn if robot.periodic[joint] else "mm"


def joint_label(robot: Tree, joint: int) -> str:
    """Name and unit of a joint."""
    return f"{short(robot.joint_names[joint])} [{joint_unit(robot, joint)}]"
