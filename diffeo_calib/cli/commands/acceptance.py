"""Whether errors are small enough: `evaluate --fail-above`."""

from __future__ import annotations

from math import inf

import typer

from diffeo_calib.cli.console import say
from diffeo_calib.cli.record import record
from diffeo_calib.common.errors import InputError

EXIT_ABOVE = 4
"""The errors are larger than --fail-above."""
UNITS = {"mm": 1e3, "um": 1e6, "m": 1.0}


def limit_m(text: str | None) -> float | None:
    """A length with its unit, such as 0.15mm, in m; None without one."""
    if text is None:
        return None
    unit = next((unit for unit in UNITS if text.endswith(unit)), "")
    try:
        value = float(text.removesuffix(unit)) if unit else -1.0
    except ValueError:
        value = -1.0
    if not 0.0 < value < inf:
        raise InputError.of(f"--fail-above {text}", expected="a length above zero with its unit, such as 0.15mm")
    return value / UNITS[unit]


def accept(rms: float, limit: float, rows: str) -> None:
    """Say whether errors are within the limit, m; exit with a code of its own if they are not."""
    record.add(rms_m=rms, limit_m=limit, accepted=rms <= limit)
    within = "within" if rms <= limit else "above"
    say(f"RMS {1e3 * rms:.4f} mm on {rows}: {within} the limit of {1e3 * limit:g} mm")
    if rms > limit:
        raise typer.Exit(EXIT_ABOVE)
