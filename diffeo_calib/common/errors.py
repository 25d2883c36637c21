"""One exception family and one message grammar for the whole package.

Every error a user can cause reads as one sentence: *what* is wrong and *where*, what was expected,
what was got, and after the colon what to do. :func:`sentence` builds it, so that all of them look
alike. Wrong input raises; a solver that stops early does not: it returns a result whose ``status``
says why.
"""

from __future__ import annotations

from collections.abc import Sequence

MOST_NAMES = 12
"""Names that a message lists, at most."""


class DiffeoCalibError(Exception):
    """Base of every error raised on purpose by this package."""


class InputError(DiffeoCalibError, ValueError):
    """An argument has the wrong shape, unit, range or value."""


class MeasurementError(InputError):
    """A table of measurements cannot be read or used as it is."""


class RobotError(InputError):
    """A robot description (URDF, DH table, link or joint name) cannot be used."""


class ModelFileError(InputError):
    """A model file is damaged, was edited, or is not understood by this version."""


class NumericalError(DiffeoCalibError, ArithmeticError):
    """A computation broke down (singular matrix, non-finite energy) on valid-looking input."""


class DiffeoCalibWarning(UserWarning):
    """Something looks wrong but a result is still returned."""


def sentence(what: str, *, expected: object = None, got: object = None, fix: str = "") -> str:
    """Build a message ``what: expected ..., got ...; fix.``

    Args:
        what: the thing that is wrong and where it is, e.g. ``"`q`"`` or ``"row 12, column 'x'"``.
        expected: what would have been right.
        got: what was found.
        fix: what the user should do about it.
    """
    parts = []
    if expected is not None:
        parts.append(f"expected {expected}")
    if got is not None:
        parts.append(f"got {got}")
    text = what + (": " + ", ".join(parts) if parts else "")
    return f"{text}; {fix}." if fix else f"{text}."


def few(items: Sequence[object], limit: int = 5) -> str:
    """List the first items and count the others."""
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(str(item) for item in items[:limit]) + more


def listed(items: Sequence[str]) -> str:
    """The first names of a list in quotes, and how many more there are: ``['x', 'y']``."""
    return f"[{few([repr(item) for item in items], MOST_NAMES)}]"
