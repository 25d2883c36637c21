"""Pieces that all sections of a report use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from diffeo_calib.common.errors import printable
from diffeo_calib.reports.html.document import Picture
from diffeo_calib.reports.html.svg import picture
from diffeo_calib.reports.plots.joints import joint_label, joint_values
from diffeo_calib.reports.plots.style import FRAME, Frame, single_panel
from diffeo_calib.robots.tree import Tree


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


def marker_name(number: int, tips: Sequence[str]) -> str:
    """A marker's number, with the tip that carries it where there are several: ``tips`` are those of all markers."""
    return f"{number} on {printable(tips[number])}" if len(set(tips)) > 1 else str(number)


def joint_values_by_row(robot: Tree, q: Tensor) -> list[list[str]]:
    """Joint values (M, n), a line of a table for each joint: its name and unit, then its M values (no -0.0)."""
    values = [joint_values(robot, joint, q[:, joint]).tolist() for joint in range(robot.n)]
    return [
        [joint_label(robot, joint), *(f"{round(value, 1) + 0.0:.1f}" for value in values[joint])]
        for joint in range(robot.n)
    ]


def rough_millimetres(metres: float) -> str:
    """A length in mm of which two digits are enough, as text without an exponent."""
    return f"{float(f'{1e3 * metres:.2g}'):.10g}"
