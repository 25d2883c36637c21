"""Panels that say whether a model can be trusted: claimed against found errors, residuals, learning curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from diffeo_calib.common.quantiles import largest_known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.predictions import SHARES, FitRows, Predictions
from diffeo_calib.reports.plots.joints import joint_label, joint_values, rms_in_bins
from diffeo_calib.reports.plots.style import BLUE, GREEN, GREY, ORANGE, dots, finish, legend, note, panels
from diffeo_calib.sensors.errors import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEWEST_BINNED = 30
"""Values from which a line of RMS errors is drawn through residuals."""


def uncertainty(model: CalibratedKinematics, data: Measurements | None = None, title: str = "") -> Figure:
    """Shares of errors inside the model's own regions against the shares that these claim.

    Args:
        model: a calibrated model.
        data: rows that took no part in its fit; by default the rows of the fit, each predicted by all others.
        title: of the figure.
    """
    figure, (axes,) = panels(1, title=title)
    draw_coverage(axes, Predictions.of(model, data))
    return figure


def draw_coverage(axes: Axes, predictions: Predictions) -> None:
    """Found against claimed shares, with the range that chance allows to a perfect model."""
    from scipy.stats import binom  # noqa: PLC0415  # slow to import, needed for figures only

    claimed = 100 * SHARES
    count = len(predictions)
    low, high = (100 / count * binom.ppf(p, count, SHARES.numpy()) for p in (0.025, 0.975))
    axes.fill_between(claimed, low, high, color=GREY, alpha=0.3, lw=0, label="chance (rows independent)")
    axes.plot([0, 100], [0, 100], color=GREY, lw=1)
    axes.plot(claimed, 100 * predictions.found_shares(), "-o", color=BLUE, ms=3.5, lw=1.8, label="found")
    note(axes, 0.03, 0.7, "cautious", va="top")
    note(axes, 0.97, 0.25, "overconfident", ha="right")
    axes.set(xlim=(0, 100), ylim=(0, 101))
    finish(axes, x="claimed share of errors [%]", y="found share [%]")
    legend(axes, loc="upper left")


def residuals(model: CalibratedKinematics, data: Measurements | None = None, title: str = "") -> Figure:
    """Errors against row and every joint; arguments as :func:`uncertainty`."""
    predictions = Predictions.of(model, data)
    figure, grid = panels(1 + model.robot.n, columns=3, title=title)
    draw_residuals(grid[0], predictions.data.line_numbers.double(), predictions.errors, "row")
    for joint, axes in enumerate(grid[1:]):
        values = joint_values(model.robot, joint, predictions.data.q[:, joint])
        draw_residuals(axes, values, predictions.errors, joint_label(model.robot, joint))
    return figure


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


def learning_curve(model: CalibratedKinematics, title: str = "") -> Figure:
    """Error of rows that are left out against the number of rows that the model knows."""
    figure, (axes,) = panels(1, title=title)
    draw_learning_curve(axes, FitRows(model).learning_curve())
    return figure


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
