"""Panels of errors: by stage, in space, against row and joints, against the errors claimed, by number of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from diffeo_calib.common.quantiles import known, largest_known
from diffeo_calib.reports.analysis.predictions import SHARES, Predictions
from diffeo_calib.reports.plots import style
from diffeo_calib.reports.plots.joints import rms_in_bins
from diffeo_calib.reports.plots.style import BLUE, GREEN, GREY, INK, LOOKS, ORANGE, finish, legend, note
from diffeo_calib.sensors.errors import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SMALLEST_ERROR = 1e-9
"""Smaller errors in mm, px or deg are drawn as this one: a logarithmic axis has no zero."""


def draw_distributions(
    axes: Axes, evaluations: Mapping[str, Evaluation], *, repeatability: float | None = None
) -> None:
    """Share of measurements whose error is at most a value, one curve for each stage."""
    one = next(iter(evaluations.values()))
    unit, per_unit = one.shown
    for (name, found), look in zip(evaluations.items(), LOOKS, strict=False):
        errors = np.sort(_sizes(found))
        share = np.arange(1, len(errors) + 1) / len(errors)
        label = f"{name}: {per_unit * found.rms:.3g} {unit} RMS"
        axes.step(errors, 100 * share, where="post", color=look.colour, ls=look.line, lw=look.width, label=label)
    if repeatability is not None:
        axes.axvline(1e3 * repeatability, color=INK, lw=0.8, label=f"repeatability: {1e3 * repeatability:.3g} mm RMS")
    axes.set_ylim(0, 101)
    finish(axes, x=f"{one.label} [{unit}]", y="measurements [%]", logarithmic="x")
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


FEWEST_BINNED = 30
"""Values from which a line of RMS errors is drawn through residuals."""


def draw_coverage(axes: Axes, predictions: Predictions) -> None:
    """Found against claimed shares, with the range that chance allows to a perfect model."""
    from scipy.stats import binom  # noqa: PLC0415  # slow to import, needed for figures only

    claimed = 100 * SHARES
    count = len(predictions)
    low, high = (100 / count * binom.ppf(p, count, SHARES.numpy()) for p in (0.025, 0.975))
    axes.fill_between(claimed, low, high, color=GREY, alpha=0.3, lw=0, label="chance (rows independent)")
    axes.plot([0, 100], [0, 100], color=GREY, lw=1)
    found = [100 * predictions.coverage(share) for share in SHARES.tolist()]
    axes.plot(claimed, found, "-o", color=BLUE, ms=3.5, lw=1.8, label="found")
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
    style.dots(axes, values, lengths, colour=BLUE)
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
