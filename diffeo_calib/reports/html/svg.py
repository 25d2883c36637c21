"""Figures as drawings inside a page: small, with its fonts, in colours that follow light and dark."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING

from diffeo_calib.reports.html.document import Picture
from diffeo_calib.reports.plots.style import BLUE, FAINT, GREEN, GREY, GRID, INK, ORANGE, PURPLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOT = 0.2
"""Length of a stroke, in the units of the drawing (1/72 inch), below which it is a dot."""
VARIABLES = {
    INK: "ink",
    FAINT: "faint",
    GRID: "grid",
    GREY: "grey",
    ORANGE: "orange",
    BLUE: "blue",
    GREEN: "green",
    PURPLE: "purple",
}
"""Colour of a figure -> the variable of the page's style that replaces it."""


def picture(figure: Figure, name: str, label: str) -> Picture:
    """A figure as part of a page.

    Args:
        figure: the figure. name: distinguishes its elements from those of other figures. label: what it shows.
    """
    from matplotlib import rc_context  # noqa: PLC0415  # slow to import, needed for figures only

    text = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="(?!(?:m|p|C)[0-9a-f_]{8,})[^"]*"', "", svg)
    svg = re.sub(r'(id="|url\(#|xlink:href="#)', rf"\g<1>{name}-", svg)
    svg = re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', svg, count=1)
    svg = svg.replace("xlink:href", "href")
    for colour, variable in VARIABLES.items():
        svg = re.sub(colour, f"var(--{variable})", svg, flags=re.IGNORECASE)
    svg = re.sub(r"font: ([0-9.]+)px [^;\"]*", r"font-size: \1px", svg)
    svg = re.sub(r'\b(?:d|x|y|transform)="[^"]*"', lambda found: re.sub(r"(\.\d{2})\d+", r"\1", found[0]), svg)
    svg = re.sub(r"M (\S+) (\S+)\nL (\S+) \2\n", _dot, re.sub(r"\s*\n\s*", "\n", svg))
    return Picture(_with_classes(svg, name), label)


def _dot(stroke: re.Match[str]) -> str:
    """A stroke that is too short to be seen as one of no length, whose round ends are a dot."""
    x, y, end = stroke.groups()
    return f"M{x} {y}h0" if abs(float(end) - float(x)) < DOT else stroke[0]


def _with_classes(svg: str, name: str) -> str:
    """The same drawing, the styles of its many markers written once."""
    styles: dict[str, str] = {}

    def short(found: re.Match[str]) -> str:
        key = styles.setdefault(found[2], f"{name}-{len(styles)}")
        return f'{found[1]}class="{key}"'

    svg = re.sub(r'(<use [^>]*)style="([^"]*)"', short, svg)
    rules = "".join(f".{key}{{{style}}}" for style, key in styles.items())
    return svg.replace(">", f"><style>{rules}</style>", 1) if rules else svg
