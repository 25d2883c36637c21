"""Colours and lines of all figures: they differ in grey and for colour-blind eyes, in light and in dark pages.

Colours are those of M. Okabe and K. Ito, "Color universal design", 2008. Stages also differ in line style and width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from diffeo_calib.common.errors import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, FAINT, GRID = "#2b2f36", "#6b7280", "#d5d9e0"
"""Colours of text and axes, of notes, and of grids."""
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
    import numpy as np  # noqa: PLC0415  # as matplotlib
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
