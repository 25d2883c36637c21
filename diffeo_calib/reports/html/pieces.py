"""Pieces that all sections of a report use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from diffeo_calib.reports.html.document import Picture
from diffeo_calib.reports.html.svg import picture
from diffeo_calib.reports.plots.style import FRAME, Frame, single_panel


def panel(name: str, label: str, draw: Callable[..., None], *what: Any, frame: Frame = FRAME, **how: Any) -> Picture:
    """A picture of one panel, drawn by ``draw(axes, *what, **how)``."""
    figure, axes = single_panel(frame)
    draw(axes, *what, **how)
    return picture(figure, name, label)


def listed(values: Tensor, digits: int) -> list[list[float]]:
    """Rows of numbers, rounded."""
    return [[round(value, digits) for value in row] for row in values.tolist()]


def millimetres(metres: float) -> str:
    """A length in mm, as text."""
    return f"{1e3 * metres:.3f}"
