"""Learning curves of sample_efficiency.py: RMS against measurements, one panel per noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from harness import Record
from learning_curves import check_place

from diffeo_calib.common.errors import InputError
from diffeo_calib.reports.plots.panels import LOOKS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OWN = {"linewidth": 2.4, "zorder": 5}
DASHED = {"linestyle": (0, (4, 2)), "markerfacecolor": "white"}
STYLES = {
    "geometry, gravity, phi, psi: flow": {"color": LOOKS[2].colour, "marker": "o", **OWN},
    "geometry, phi, psi: flow": {"color": "#7b4fa3", "marker": "D", **OWN},
    "geometry, phi, psi: tangent": {"color": "#7b4fa3", "marker": "D", **DASHED},
    "phi, psi, residual field: tangent": {"color": "#2a7fb8", "marker": "s", **DASHED},
    "phi, psi: flow": {"color": "#5c6773", "marker": "s"},
    "phi, psi: tangent": {"color": "#5c6773", "marker": "s", **DASHED},
    "geometry": {"color": LOOKS[1].colour, "marker": "o"},
    "geometry, gravity": {"color": LOOKS[1].colour, "marker": "^"},
    "GP": {"color": LOOKS[3].colour, "marker": "P", **DASHED},
    "geometry + GP": {"color": LOOKS[3].colour, "marker": "P"},
    "geometry, gravity + GP": {"color": LOOKS[3].colour, "marker": "X"},
    "geometry + radial basis functions": {"color": "#8c6d31", "marker": "<"},
    "geometry + neural network": {"color": "#b5525c", "marker": "v"},
}
"""Drawn methods; `geometry, gravity, phi, psi: tangent` coincides with its flow and is omitted."""
BAND = 0.15


def draw(rows: Sequence[Record], path: Path) -> None:
    """Draw :func:`curves` to a file.

    Raises:
        InputError: nothing to draw, another format, or a folder that does not exist.
    """
    check_place(path)
    curves(rows).savefig(path, dpi=200)


def curves(rows: Sequence[Record]) -> Figure:
    """Medians of the protocol `samples`, a panel per noise, with a band between quartiles.

    Args:
        rows: records of `sample_efficiency.summary`.

    Raises:
        InputError: nothing to draw.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

    good = [row for row in rows if row["protocol"] == "samples" and row.get("rms") is not None]
    noises = sorted({float(row["noise"] or 0.0) for row in good})
    if not noises:
        what = "learning curves cannot be drawn"
        raise InputError.of(what, expected="records of the protocol samples", got="none")
    columns = min(2, len(noises))
    lines = -(-len(noises) // columns)
    figure = Figure(figsize=(1.0 + 4.8 * columns, 1.6 + 3.9 * lines), layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, noise in zip(panels, noises, strict=False):
        _panel(axes, [row for row in good if row["noise"] == noise], noise)
    for axes in panels[len(noises) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns + 1, frameon=False, fontsize=8.5)
    return figure


def _panel(axes: Axes, rows: Sequence[Record], noise: float) -> None:
    """Curves of one noise."""
    from matplotlib.ticker import FixedLocator, FuncFormatter  # noqa: PLC0415

    for method, style in STYLES.items():
        points = sorted(
            tuple(float(row[n] or 0.0) for n in ("train", "rms", "lower", "upper"))
            for row in rows
            if row["method"] == method
        )
        if not points:
            continue
        x, y, low, high = zip(*points, strict=True)
        axes.plot(x, y, label=method, **{"linewidth": 1.4, "markersize": 5, **style})
        axes.fill_between(x, low, high, color=style["color"], alpha=BAND, linewidth=0)
    if noise > 0:
        axes.axhline(noise, color="0.4", linewidth=0.9, linestyle=":")
        axes.annotate(
            "noise",
            (1.0, noise),
            xycoords=("axes fraction", "data"),
            xytext=(-4, 2),
            textcoords="offset points",
            ha="right",
            fontsize=8,
            color="0.3",
        )
    axes.set(xscale="log", yscale="log", xlabel="measurements", ylabel="held-out RMS error [length units; reach 1.5]")
    axes.set_title(f"noise {noise:g}" if noise else "no noise", fontsize=11)
    sizes = sorted({float(row["train"] or 0) for row in rows})
    axes.xaxis.set_major_locator(FixedLocator(sizes))
    axes.xaxis.set_minor_locator(FixedLocator([]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
