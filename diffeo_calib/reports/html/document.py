"""A page of sections: what it is made of, and its text as HTML by a template."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Picture:
    """A drawing of the page.

    Args:
        svg: the drawing. label: what it shows, in words.
    """

    svg: str
    label: str


@dataclass(frozen=True)
class Table:
    """Rows of text under a header.

    Args:
        caption: what the table shows. header: names of the columns. rows: cells. numeric: columns of numbers.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: bool = True


@dataclass(frozen=True)
class Scene:
    """Points in space with errors as arrows, to be turned by the reader.

    Args:
        points: (N, 3) in m. errors: name of each stage -> (N, 3) in m, all drawn with one scale.
    """

    points: Sequence[Sequence[float]]
    errors: Mapping[str, Sequence[Sequence[float]]]

    @property
    def json(self) -> str:
        """The scene as the page's script reads it."""
        return json.dumps({"points": self.points, "errors": self.errors}, separators=(",", ":")).replace("</", "<\\/")


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Args:
        name: its anchor. title: its heading. see: one sentence about what to see here.
        tables, pictures, notes, text: its contents, in this order; ``scene`` comes before the pictures.
        text: lines to be shown as they are.
    """

    name: str
    title: str
    see: str
    tables: Sequence[Table] = ()
    scene: Scene | None = None
    pictures: Sequence[Picture] = ()
    notes: Sequence[str] = ()
    text: Sequence[str] = ()


@dataclass(frozen=True)
class Page:
    """A report.

    Args:
        title: of the page. subtitle: where the numbers come from. verdict: the result in one line.
        advice: what to do next. figures: name -> value, the numbers at the top.
        sections: in the order of the page.
    """

    title: str
    subtitle: str
    verdict: str
    advice: Sequence[str]
    figures: Mapping[str, str]
    sections: Sequence[Section] = field(default_factory=tuple)

    def html(self) -> str:
        """The page, with its styles and scripts inside."""
        from jinja2 import Environment, FileSystemLoader  # noqa: PLC0415  # needed here only

        made = Environment(loader=FileSystemLoader(FOLDER), autoescape=True, trim_blocks=True, lstrip_blocks=True)
        parts: dict[str, Any] = {
            name: (FOLDER / file).read_text(encoding="utf-8")
            for name, file in (("style", "report.css"), ("script", "scene.js"))
        }
        text = made.get_template("report.html.jinja").render(page=self, **parts)
        return re.sub(r"(?<=\d) (?=(?:%|mm|m)\b|%)", "\u00a0", text)  # numbers stay with their units
