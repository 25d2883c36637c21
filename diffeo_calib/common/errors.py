"""One exception family and one message grammar for the whole package.

Every error that a user can cause is one sentence: *what* is wrong and *where*, what was expected, what was found,
and after the semicolon what to do. :func:`sentence` builds it, so that all messages look alike. Wrong input raises an
error. A solver that stops early does not: it returns a result whose ``status`` gives the reason.

This module imports nothing heavy: the command line uses it before it loads torch.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from reprlib import Repr
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Self

_SHORT = Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80
MOST_NAMES = 12
"""Most names that a message lists."""
LONGEST_SENTENCE = 1200
"""Most characters of a message; longer ones are cut in the middle."""
LONGEST_SHOWN = 400
"""Most characters of what was found that a message shows."""
PACKAGE = __name__.partition(".")[0]


class DiffeoCalibError(Exception):
    """Base of every error that this package raises on purpose."""

    @classmethod
    def of(cls, what: str, *, expected: object = None, got: object = None, fix: str = "") -> Self:
        """Return an error whose message is :func:`sentence` of the arguments."""
        return cls(sentence(what, expected=expected, got=got, fix=fix))


class InputError(DiffeoCalibError, ValueError):
    """An argument has the wrong shape, unit, range or value."""


class MeasurementError(InputError):
    """A table of measurements cannot be read or used as it is."""


class RobotError(InputError):
    """A robot description (URDF, DH table, name of a link or joint) cannot be used."""


class ModelFileError(InputError):
    """A model file is damaged, was edited, or was written by a version that this one cannot read."""


class NumericalError(DiffeoCalibError, ArithmeticError):
    """A computation failed on input that looks valid: a singular matrix, an energy that is not finite."""


class DiffeoCalibWarning(UserWarning):
    """Something looks wrong, but a result is still returned."""


def warn_user(text: str) -> None:
    """Issue a :class:`DiffeoCalibWarning` that points at the line outside this package which led here."""
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == PACKAGE:
        level, frame = level + 1, frame.f_back
    warnings.warn(text, DiffeoCalibWarning, stacklevel=level)


def sentence(what: str, *, expected: object = None, got: object = None, fix: str = "") -> str:
    """Build a message ``what: expected ..., got ...; fix.``

    Args:
        what: what is wrong and where, e.g. ``"`q`"`` or ``"row 12, column 'x'"``.
        expected: what would be right.
        got: what was found instead.
        fix: what the user should do.
    """
    parts = []
    if expected is not None:
        parts.append(f"expected {expected}")
    if got is not None:
        parts.append(f"got {_one_line(got)}")
    text = what + (": " + ", ".join(parts) if parts else "")
    return _printable(f"{text}; {fix}." if fix else f"{text}.")


def _printable(text: str) -> str:
    """In one line that can be read: names in files may hold line ends and escape sequences, or be endless."""
    text = text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return (
        text
        if len(text) <= LONGEST_SENTENCE
        else f"{text[: LONGEST_SENTENCE // 2]} ... {text[-LONGEST_SENTENCE // 4 :]}"
    )


def _one_line(value: object) -> str:
    """What was found, in one line that can be read: arrays print themselves in many."""
    text = str(value)
    text = " ".join(text.split()) if "\n" in text else text
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def as_written(value: object) -> str:
    """The value as Python writes it, cut where it is long or deep: for messages about wrong arguments."""
    try:
        return _SHORT.repr(value)
    except Exception:  # any object, with any __repr__
        return f"an object of type {type(value).__name__}"


def few(items: Sequence[object], limit: int = 5) -> str:
    """The first items, and how many more there are: ``2, 5 and 7 more``."""
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(str(item) for item in items[:limit]) + more


def listed(items: Sequence[str]) -> str:
    """The first names in quotes, and how many more there are: ``['x', 'y' and 3 more]``."""
    return f"[{few([repr(item) for item in items], MOST_NAMES)}]"
