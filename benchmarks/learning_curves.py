"""Summary of the records of real_robots.py: a table of means, and learning curves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING

from harness import Record

from diffeo_calib.common.errors import InputError
from diffeo_calib.reports.plots.panels import LOOKS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEANS = ("train", "test", "rms_mm", "median_mm", "p95_mm", "max_mm", "rms_deg", "coverage_95", "seconds")
SUMMARY = ("dataset", "protocol", "size", "method", "runs", "failed", *MEANS)

# Stages have the same colours as in the figures of the package.
STYLES = {
    "registration": {"color": LOOKS[0].colour, "marker": "s"},
    "joint offsets": {"color": "#5c6773", "marker": "D"},
    "geometry": {"color": LOOKS[1].colour, "marker": "o"},
    "geometry + network": {"color": "#b5525c", "marker": "v"},
    "geometry + boosting": {"color": LOOKS[4].colour, "marker": "^"},
    "geometry + GP": {"color": LOOKS[3].colour, "marker": "P"},
    "GP alone": {"color": LOOKS[3].colour, "marker": "P", "linestyle": (0, (4, 2)), "markerfacecolor": "white"},
    "diffeo_calib": {"color": LOOKS[2].colour, "marker": "o", "linewidth": 2.6, "markersize": 7, "zorder": 5},
}
TITLES = {"ipa_ur10": "UR10, laser tracker", "franka_fr3": "Franka FR3, camera"}
MOST_COLUMNS = 3
SUFFIXES = (".png", ".pdf", ".svg")  # of the files that figures can be written to
LABELLED = ((5.0, tuple(range(1, 10))), (1000.0, (1, 2, 5)))
"""Upper limit of (largest / smallest error) of a panel, and the leading digits labelled below it; else decades."""
CEILING = 2.0
"""Upper end of a panel, in units of the registration's error; larger errors are written there as numbers."""
NEAR_TICKS = 1.12  # a training size within this ratio of a larger one has no tick


def summary(records: Iterable[Record]) -> list[Record]:
    """Mean over seeds or folds, by data set, protocol, size and method; failures are counted, not averaged."""
    rows: list[Record] = []
    for (dataset, protocol, size, method), group in _grouped(records):
        good = [record for record in group if _number(record, "rms_mm") is not None]
        row: Record = {"dataset": dataset, "protocol": protocol, "size": size, "method": method}
        rows.append(row | {"runs": len(good), "failed": len(group) - len(good)} | _means(good))
    return rows


def _grouped(records: Iterable[Record]) -> list[tuple[tuple[str, ...], list[Record]]]:
    """Group records to be averaged: data sets and protocols by name, sizes by number, methods in a fixed order."""

    def key(record: Record) -> tuple[str, ...]:
        return tuple(str(record[name]) for name in ("dataset", "protocol", "size", "method"))

    def order(record: Record) -> tuple[str, str, float, int]:
        dataset, protocol, size, method = key(record)
        rank = list(STYLES).index(method) if method in STYLES else len(STYLES)
        return dataset, protocol, float(size) if size.isdigit() else float("inf"), rank

    return [(names, list(group)) for names, group in groupby(sorted(records, key=order), key)]


def _means(records: Sequence[Record]) -> Record:
    found = {name: [x for x in (_number(record, name) for record in records) if x is not None] for name in MEANS}
    return {name: mean(values) if values else None for name, values in found.items()}


def _number(record: Record, name: str) -> float | None:
    value = record.get(name)
    return float(value) if isinstance(value, int | float) else None


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw :func:`curves` to a file.

    Raises:
        InputError: no record of the protocol `curve`, another format, or a folder that does not exist.
    """
    check_place(path)
    curves(records).savefig(path, dpi=200)


def curves(records: Sequence[Record]) -> Figure:
    """Held-out RMS against training poses: a panel per data set, a line per method, bars from minimum to maximum.

    Raises:
        InputError: no record of the protocol `curve`.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

    good = [record for record in records if record["protocol"] == "curve" and _number(record, "rms_mm") is not None]
    names = list(dict.fromkeys(str(record["dataset"]) for record in good))
    if not names:
        what = "learning curves cannot be drawn"
        raise InputError.of(what, expected="records of the protocol curve", got="none", fix="measure them first")
    columns = min(len(names), MOST_COLUMNS)
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(1.2 + 4.6 * columns, 0.9 + 3.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flat
    for axes, name in zip(panels, names, strict=False):
        _panel(axes, [record for record in good if record["dataset"] == name], TITLES.get(name, name))
    for axes in list(panels)[len(names) :]:
        axes.set_axis_off()
    _legend(figure, 4 if columns > 1 else 3)
    return figure


def _legend(figure: Figure, columns: int) -> None:
    """One legend below all panels."""
    handles: dict[str, Artist] = {}
    for axes in figure.axes:
        found, labels = axes.get_legend_handles_labels()
        handles |= dict(zip(labels, found, strict=True))
    shown = [*(method for method in STYLES if method in handles), *(name for name in handles if name not in STYLES)]
    lines = [handles[method] for method in shown]
    figure.legend(lines, shown, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def check_place(path: Path) -> None:
    """Raise InputError unless a figure can be written to this path."""
    if path.suffix.lower() not in SUFFIXES or not path.parent.is_dir():
        expected = f"a file ending in {', '.join(SUFFIXES)} in an existing folder"
        raise InputError.of(f"the figure cannot be written to {path}", expected=expected)


def _panel(axes: Axes, records: Sequence[Record], title: str) -> None:
    """One data set's curves."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter  # noqa: PLC0415

    curves: dict[str, list[tuple[float, float, float, float]]] = {}
    for (_, _, _, method), group in _grouped(records):
        found = [value for value in (_number(record, "rms_mm") for record in group) if value is not None]
        poses = mean(value for value in (_number(record, "train") for record in group) if value is not None)
        curves.setdefault(method, []).append((poses, mean(found), min(found), max(found)))
    errors = {method: [y for _, y, *_ in points] for method, points in curves.items()}
    ceiling = CEILING * max(errors.get("registration", [float("inf")]))
    for method, points in curves.items():
        x, y, low, high = zip(*points, strict=True)
        style = {"linewidth": 1.6, "markersize": 5, **STYLES.get(method, {})}
        axes.plot(x, y, label=method, **style)
        if max(y) <= ceiling:
            axes.vlines(x, low, high, color=axes.lines[-1].get_color(), linewidth=0.9, alpha=0.6)
    axes.set(xscale="log", yscale="log", xlabel="training poses", ylabel="held-out RMS position error [mm]")
    axes.set_title(title, fontsize=11)
    axes.xaxis.set_major_locator(FixedLocator(_ticks([x for points in curves.values() for x, *_ in points])))
    axes.xaxis.set_minor_locator(FixedLocator([]))
    axes.xaxis.set_major_formatter(FuncFormatter(_plain))
    _cut(axes, {method: values for method, values in errors.items() if max(values) > ceiling}, ceiling)
    low, high = axes.get_ylim()
    digits = next((digits for ratio, digits in LABELLED if high / low < ratio), (1,))
    axes.yaxis.set_major_locator(LogLocator(subs=digits, numticks=99))
    axes.yaxis.set_major_formatter(FuncFormatter(_plain))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(which="both", labelsize=9)
    axes.grid(alpha=0.25, which="both")
    axes.spines[["top", "right"]].set_visible(False)


def _cut(axes: Axes, above: dict[str, list[float]], ceiling: float) -> None:
    """End the panel above the uncalibrated robot: a much worse method would flatten all other curves."""
    if not above:
        return
    axes.set_ylim(top=ceiling)
    lines = [f"{method}: {', '.join(f'{value:.3g}' for value in values)} mm" for method, values in above.items()]
    axes.text(0.98, 0.98, "\n".join(lines), transform=axes.transAxes, ha="right", va="top", fontsize=9)


def _ticks(sizes: Iterable[float]) -> list[float]:
    """Every training size, except those too close to a larger one."""
    ticks: list[float] = []
    for size in sorted({round(size) for size in sizes}, reverse=True):
        if not ticks or ticks[-1] / size > NEAR_TICKS:
            ticks.append(float(size))
    return ticks


def _plain(value: float, _: object) -> str:
    return f"{value:g}"
