"""A page of sections: what it is made of, figures as drawings inside it, and its text as HTML by a template."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor

from diffeo_calib.reports.plots import panels as style
from diffeo_calib.reports.plots.panels import joint_label, joint_values
from diffeo_calib.robots.tree import Tree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = Path(__file__).parent
VARIABLES = ("ink", "faint", "grid", "grey", "orange", "blue", "green", "purple")
"""Variables of the page's style that replace the colours of this name."""


class Picture:
    """One panel, drawn by ``draw(axes, *what, **how)``.

    Args:
        name: distinguishes its elements from those of other panels. label: what it shows, in words.
    """

    def __init__(
        self, name: str, label: str, draw: Callable[..., None], *what: Any, frame: style.Frame = style.FRAME, **how: Any
    ) -> None:
        self.name, self.label, self._draw, self._frame = name, label, partial(draw, **how), frame
        self._what = what

    def figure(self) -> Figure:
        """As a figure of matplotlib, which touches neither pyplot nor any window."""
        from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

        (width, height), left, top, bottom, right = self._frame
        figure = Figure(figsize=self._frame.size)
        share = (left / width, bottom / height, 1 - (left + right) / width, 1 - (bottom + top) / height)
        self._draw(figure.add_axes(share), *self._what)
        return figure

    def svg(self) -> str:
        """As a drawing inside a page."""
        from matplotlib import rc_context  # noqa: PLC0415

        text, name = io.StringIO(), self.name
        with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
            self.figure().savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        svg = text.getvalue()
        svg = svg[svg.index("<svg") :]
        svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
        svg = re.sub(r'\bid="(?!(?:m|p|C)[0-9a-f_]{8,})[^"]*"', "", svg)
        svg = re.sub(r'(id="|url\(#|xlink:href="#)', rf"\g<1>{name}-", svg)
        svg = re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', svg, count=1)
        svg = svg.replace("xlink:href", "href")
        for variable in VARIABLES:
            svg = re.sub(getattr(style, variable.upper()), f"var(--{variable})", svg, flags=re.IGNORECASE)
        svg = re.sub(r"font: ([0-9.]+)px [^;\"]*", r"font-size: \1px", svg)
        svg = re.sub(r'\b(?:d|x|y|transform)="[^"]*"', lambda match: re.sub(r"(\.\d{2})\d+", r"\1", match[0]), svg)
        return re.sub(r"\s*\n\s*", "\n", svg)


class Table(NamedTuple):
    """Rows of text under the names of their columns; ``numeric``: all but the first hold numbers."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: bool = True


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    name: str  # its anchor
    title: str  # its heading
    see: str  # one sentence about what to see here; then follow tables, the scene, pictures, notes and text
    tables: Sequence[Table] = ()
    # points (N, 3) in m, and errors of each stage as arrows there (N, 3) in m, drawn with one scale
    scene: Mapping[str, Any] | None = None
    pictures: Sequence[Picture] = ()
    notes: Sequence[str] = ()
    text: Sequence[str] = ()  # lines to be shown as they are


def page(**parts: Any) -> str:
    """A report as HTML, with its styles and scripts inside; ``parts`` are what the template names."""
    from jinja2 import Environment, FileSystemLoader  # noqa: PLC0415  # needed here only

    made = Environment(loader=FileSystemLoader(FOLDER), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    for name, file in (("style", "report.css"), ("script", "scene.js")):
        parts[name] = (FOLDER / file).read_text(encoding="utf-8")
    text = made.get_template("report.html.jinja").render(parts)
    return re.sub(r"(?<=\d) (?=(?:%|mm|m)\b|%)", "\u00a0", text)  # numbers stay with their units


def millimetres(metres: float) -> str:
    """A length in mm, as text."""
    return f"{1e3 * metres:.3f}"


def joint_values_by_row(robot: Tree, q: Tensor) -> list[list[str]]:
    """Joint values (M, n), a line of a table for each joint: its name and unit, then its M values (no -0.0)."""
    values = [joint_values(robot, joint, own).tolist() for joint, own in enumerate(q.mT)]
    return [[joint_label(robot, joint), *(f"{round(x, 1) + 0.0:.1f}" for x in own)] for joint, own in enumerate(values)]


def rough_millimetres(metres: float) -> str:
    """A length in mm of which two digits are enough, as text without an exponent."""
    return f"{float(f'{1e3 * metres:.2g}'):.10g}"
