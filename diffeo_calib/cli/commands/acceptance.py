"""Whether errors are small enough: `evaluate --fail-above`."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import typer

from diffeo_calib.calibration.judgement import Accuracy
from diffeo_calib.cli.console import say
from diffeo_calib.cli.record import record
from diffeo_calib.common.errors import InputError
from diffeo_calib.sensors.errors import shown_unit
from diffeo_calib.sensors.kinds import known_kinds

EXIT_ABOVE = 4
"""The errors are larger than --fail-above."""
UNITS = {"mm": ("m", 1e3), "um": ("m", 1e6), "m": ("m", 1.0), "px": ("px", 1.0)}
"""Unit of a limit -> unit in which it is compared, and how many are one of these; own kinds of readings have others."""


class Limit(NamedTuple):
    """Largest error that is good enough, in ``unit``: m, px, or that of a kind of readings."""

    value: float
    unit: str


def parsed_limit(text: str | None, option: str = "--fail-above") -> Limit | None:
    """A length with its unit, such as 0.15mm, or pixels; None without one."""
    if text is None:
        return None
    units = {kind.unit[0]: (kind.unit[0], 1.0) for kind in known_kinds().values()} | UNITS
    name = max((name for name in units if text.endswith(name)), key=len, default="")
    try:
        value = float(text.removesuffix(name)) if name else -1.0
    except ValueError:
        value = -1.0
    if not 0.0 < value < inf:
        expected = "a length above zero with its unit, such as 0.15mm, or pixels, such as 0.5px"
        raise InputError.of(f"{option} {text}", expected=expected)
    unit, per_unit = units[name]
    return Limit(value / per_unit, unit)


def parsed_length(text: str | None, option: str) -> float | None:
    """A length with its unit in m; None without one."""
    limit = parsed_limit(text, option)
    if limit is not None and limit.unit != "m":
        raise InputError.of(f"{option} {text}", expected="a length, such as 0.15mm")
    return None if limit is None else limit.value


def accept(found: Accuracy, limit: Limit) -> None:
    """Say whether errors are within the limit; exit with a code of its own if they are not."""
    good = found.value <= limit.value
    record.add(**{f"rms_{found.unit}": found.value, f"limit_{found.unit}": limit.value}, accepted=good)
    unit, per_unit = shown_unit(found.unit)
    within = "within" if good else "above"
    say(f"RMS {per_unit * found.value:.4f} {unit} {found.of}: {within} the limit of {per_unit * limit.value:g} {unit}")
    if not good:
        raise typer.Exit(EXIT_ABOVE)
