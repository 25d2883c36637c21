"""Panels of errors, and of what explains them, with the colours and lines of all figures.

They differ in grey and for colour-blind eyes, in light and in dark pages: colours are those of M. Okabe and K. Ito,
"Color universal design", 2008; stages also differ in line style and width.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.result import Part
from diffeo_calib.common.errors import printable, shown
from diffeo_calib.common.quantiles import known, largest_known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.transmission import transmission
from diffeo_calib.reports.analysis.findings import Deviations
from diffeo_calib.reports.analysis.predictions import SHARES, FitRows, Predictions
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.errors import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, FAINT, GRID = "#2b2f36", "#6b7280", "#d5d9e0"  # colours of text and axes, of notes, and of grids
GREY, ORANGE, BLUE, GREEN, PURPLE = "#8b9099", "#d55e00", "#0072b2", "#009e73", "#a05a8c"
PANEL = (4.4, 3.0)  # width and height of one panel in inches: a page of 390 pixels shows it at full size

SHORTEST_STROKE = 2e-4  # length of the stroke of a dot, in units of the values' range


class Look(NamedTuple):
    """How a stage is drawn."""

    colour: str
    line: Any
    width: float


LOOKS = (
    Look(GREY, ":", 1.8),
    Look(ORANGE, "--", 1.8),
    Look(BLUE, "-", 2.4),
    Look(GREEN, "-.", 1.8),
    Look(PURPLE, (0, (6, 2, 1, 2, 1, 2)), 1.8),
)
"""Nominal, geometric and calibrated, then others, in this order."""


class Frame(NamedTuple):
    """Size and margins of a single panel, inches: drawn faster than one whose layout is solved."""

    size: tuple[float, float] = PANEL
    left: float = 0.6
    top: float = 0.12
    bottom: float = 0.48
    right: float = 0.1


FRAME = Frame()


def finish(axes: Axes, *, x: str, y: str, logarithmic: Sequence[str] = ()) -> None:
    """Labels, a light grid, and ticks in plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator  # noqa: PLC0415

    axes.set_xlabel(literal(x), color=INK, fontsize=9)
    axes.set_ylabel(literal(y), color=INK, fontsize=9)
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if name in logarithmic:
            getattr(axes, f"set_{name}scale")("log")
            low, high = sorted(axis.get_view_interval())
            wide = high > 300 * max(low, 1e-300)
            axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
            axis.set_minor_locator(NullLocator())
            axis.set_minor_formatter(NullFormatter())
        else:
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "\u2212")))
    axes.tick_params(colors=INK, labelsize=8, length=3)
    axes.grid(color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in {"left", "bottom"})
        spine.set_color(FAINT)


def legend(axes: Axes, **options: Any) -> None:
    """A legend without a frame."""
    shown = axes.legend(frameon=False, fontsize=8, labelcolor=INK, **options)
    shown.set_zorder(5)


def literal(text: str) -> str:
    """Text of the user, in which matplotlib finds no formula."""
    return printable(text).replace("$", r"\$")


def dots(axes: Axes, x: Any, y: Any, *, colour: str, size: float = 2.6) -> None:
    """Many points on a linear axis x as one path of short strokes with round ends: faster and far smaller than markers.

    Strokes of no length at all would be left out.
    """
    from matplotlib.patches import PathPatch  # noqa: PLC0415
    from matplotlib.path import Path  # noqa: PLC0415  # slow to import, needed for figures only

    places = np.repeat(np.stack([np.asarray(x, float), np.asarray(y, float)], 1), 2, axis=0)
    places[1::2, 0] += SHORTEST_STROKE * (np.ptp(places[:, 0]) or 1.0)
    path = Path(places, np.tile([Path.MOVETO, Path.LINETO], len(places) // 2))
    path.should_simplify = False
    axes.add_artist(PathPatch(path, fill=False, ec=colour, lw=size, alpha=0.7, capstyle="round", snap=False))
    axes.update_datalim(places)  # add_patch would look at every stroke as at a Bezier curve
    axes.autoscale_view()


def note(axes: Axes, x: float, y: float, text: str, **options: Any) -> None:
    """A short text, placed in shares of the axes."""
    axes.text(x, y, text, transform=axes.transAxes, fontsize=8, color=FAINT, **options)


POINTS = 120  # values of a joint at which its transmission error is drawn
HISTOGRAM_BINS = 24  # intervals of the measured values below it
WIDE_RATIO = 20.0  # ratio of the largest to the smallest deviation from which they are drawn on a logarithmic axis
BINS, FEWEST_IN_BIN = 10, 3
PART_WIDTH = 4.7  # width of the figure of the parts, inches
TWO_SIDED_95 = 1.96
LONGEST_NAME = 36  # letters of a name in a panel


def draw_transmission(axes: Axes, model: CalibratedKinematics, rows: FitRows, joint: int) -> None:
    """Transmission error of one joint without gear lines, its mean over the measured range left out."""
    robot, name = model.robot, model.robot.joint_names[joint]
    measured, share = rows.q[:, joint], torch.linspace(0.0, 1.0, POINTS, dtype=torch.float64, device=rows.q.device)
    values = torch.lerp(measured.min(), measured.max(), share)
    error = transmission(model.map.deformation, robot, name, values.to(model.configurations.device), lines=False).cpu()
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


def draw_parts(axes: Axes, parts: Sequence[Part]) -> None:
    """Bars of the parts of a model, in mm."""
    lengths = [1e3 * part.displacement for part in parts]
    places = np.arange(len(parts))[::-1]
    axes.barh(places, lengths, color=BLUE, height=0.62)
    for place, length in zip(places, lengths, strict=True):
        axes.text(length, place, f" {length:.3f}", va="center", fontsize=8, color=INK)
    names = [literal(short(part.name)) for part in parts]
    axes.set_yticks(places, names)
    axes.set_xlim(0, 1.15 * max([*lengths, 1e-9]))
    ticks = list(axes.get_yticks())
    finish(axes, x="RMS displacement [mm]", y="")
    axes.set_yticks(ticks, names)
    axes.grid(visible=False, axis="y")


def draw_expected(axes: Axes, robot: Tree, joint: int, deviations: Deviations, *, key: bool = True) -> None:
    """Deviations that a model claims against one joint: anywhere in its ranges, and where it was measured.

    ``key``: whether the lines are named.
    """
    values, lengths = joint_values(robot, joint, deviations.q[:, joint]), 1e3 * deviations.deviation
    near, short = joint_values(robot, joint, deviations.measured[:, joint]), 1e3 * deviations.measured_deviation
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
    bins = [((low + high) / 2, float(group.square().mean().sqrt())) for low, high, group in in_bins(values, lengths)]
    return [middle for middle, _ in bins], [rms for _, rms in bins]


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


SMALLEST_ERROR = 1e-9  # smaller errors in mm, px or deg are drawn as this one: a logarithmic axis has no zero


def draw_distributions(
    axes: Axes, evaluations: Mapping[str, Evaluation], *, repeatability: float | None = None
) -> None:
    """Share of measurements whose error is at most a value, one curve for each stage."""
    first = next(iter(evaluations.values()))
    unit, per_unit = first.shown
    for (name, sizes), look in zip(evaluations.items(), LOOKS, strict=False):
        errors = np.sort(_sizes(sizes))
        share = np.arange(1, len(errors) + 1) / len(errors)
        label = f"{name}: {per_unit * sizes.rms:.3g} {unit} RMS"
        axes.step(errors, 100 * share, where="post", color=look.colour, ls=look.line, lw=look.width, label=label)
    if repeatability is not None:
        axes.axvline(1e3 * repeatability, color=INK, lw=0.8, label=f"repeatability: {1e3 * repeatability:.3g} mm RMS")
    axes.set_ylim(0, 101)
    finish(axes, x=f"{first.label} [{unit}]", y="measurements [%]", logarithmic="x")
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
    return np.maximum(evaluation.shown[1] * known(evaluation.errors).numpy(), SMALLEST_ERROR)


FEWEST_BINNED = 30  # values from which a line of RMS errors is drawn through residuals


def draw_coverage(axes: Axes, predictions: Predictions) -> None:
    """Found against claimed shares, with the range that chance allows to a perfect model."""
    from scipy.stats import binom  # noqa: PLC0415  # slow to import, needed for figures only

    claimed = 100 * SHARES
    count = len(predictions)
    low, high = (100 / count * binom.ppf(p, count, SHARES.numpy()) for p in (0.025, 0.975))
    axes.fill_between(claimed, low, high, color=GREY, alpha=0.3, lw=0, label="chance (rows independent)")
    axes.plot([0, 100], [0, 100], color=GREY, lw=1)
    inside = [100 * predictions.coverage(share) for share in SHARES.tolist()]
    axes.plot(claimed, inside, "-o", color=BLUE, ms=3.5, lw=1.8, label="found")
    note(axes, 0.03, 0.7, "cautious", va="top")
    note(axes, 0.97, 0.25, "overconfident", ha="right")
    axes.set(xlim=(0, 100), ylim=(0, 101))
    finish(axes, x="claimed share of errors [%]", y="found share [%]")
    legend(axes, loc="upper left")


def draw_residuals(axes: Axes, values: Tensor, errors: Evaluation, label: str, *, key: bool = True) -> None:
    """Errors of N rows against a column of numbers (N,); with ``key`` lines are named.

    Rows without a value, NaN, are left out.
    """
    unit, per_unit = errors.shown
    lengths = per_unit * largest_known(errors.errors)
    there = values.isfinite() & lengths.isfinite()
    values, lengths = values[there], lengths[there]
    dots(axes, values, lengths, colour=BLUE)
    if len(values) >= FEWEST_BINNED and float(values.max()) > float(values.min()):
        axes.plot(*rms_in_bins(values, lengths), color=ORANGE, ls="--", lw=1.8, label="RMS")
        if key:
            legend(axes, loc="upper right")
    axes.set_ylim(bottom=0)
    finish(axes, x=label, y=f"error [{unit}]")


def draw_learning_curve(
    axes: Axes,
    curve: Sequence[tuple[int, float]],
    forecast: tuple[int, float] | None = None,
    limit: float | None = None,
) -> None:
    """Errors [m] by number of rows, with a forecast for more rows and the repeatability [m] if they are known."""
    counts, errors = zip(*curve, strict=True)
    axes.plot(counts, [1e3 * error for error in errors], "-o", color=BLUE, ms=4, lw=1.8, label="this robot, left out")
    if forecast is not None:
        count, error = forecast
        axes.plot([counts[-1], count], [1e3 * errors[-1], 1e3 * error], ":D", color=GREEN, ms=4, label="forecast")
    if limit is not None:
        axes.axhline(1e3 * limit, color=ORANGE, ls="--", lw=1.2, label="repeatability")
    finish(axes, x="rows", y="RMS error [mm]", logarithmic="xy")
    legend(axes, loc="upper right")
