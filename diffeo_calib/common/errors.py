"""One exception family and one message grammar for the whole package.

Every error that a user can cause is one sentence: *what* is wrong and *where*, what was expected, what was found,
and after the semicolon what to do. :func:`sentence` builds it, so that all messages look alike. Wrong input raises an
error. A solver that stops early does not: it returns a result whose ``status`` gives the reason.

This module imports nothing heavy: the command line uses it before it loads torch.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from math import inf
from reprlib import Repr
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Self

_SHORT = Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80
MOST_NAMES = 12  # most names that a message lists
LONGEST_LIST = 1200  # most characters of one part of a message: more than the longest list of names
LONGEST_NAME = 80  # most characters of a name in a list
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


_KEPT: ContextVar[list[str] | None] = ContextVar("kept", default=None)  # where texts of warnings are kept too


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """A list to which every text of :func:`warn_user` inside is added once, however warnings are filtered."""
    texts = list[str]()
    before = _KEPT.set(texts)
    try:
        yield texts
    finally:
        _KEPT.reset(before)


def warn_user(text: str) -> None:
    """Issue a :class:`DiffeoCalibWarning` that points at the line outside this package which led here."""
    kept = _KEPT.get()
    if kept is not None and printable(text) not in kept:
        kept.append(printable(text))
    level, frame = 1, sys._getframe()
    skipped = PACKAGE, "contextlib"  # which the decorators of threads.py come from
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in skipped:
        level, frame = level + 1, frame.f_back
    warnings.warn(printable(text), DiffeoCalibWarning, stacklevel=level)


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
        parts.append(f"expected {shown(expected, LONGEST_LIST)}")
    if got is not None:
        parts.append(f"got {shown(got, LONGEST_LIST)}")
    text = shown(what, LONGEST_LIST) + (": " + ", ".join(parts) if parts else "")
    return f"{text}; {shown(fix, LONGEST_LIST)}." if fix else f"{text}."


def as_written(value: object) -> str:
    """The value as Python writes it, cut where it is long or deep: for messages about wrong arguments."""
    try:
        return _SHORT.repr(value)
    except Exception:  # any object, with any __repr__
        return f"an object of type {type(value).__name__}"


def few(items: Sequence[object], limit: int = 5) -> str:
    """The first items, and how many more there are: ``2, 5 and 7 more``."""
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(shown(item, LONGEST_NAME) for item in items[:limit]) + more


def listed(items: Sequence[str]) -> str:
    """The first names in quotes, and how many more there are: ``['x', 'y' and 3 more]``."""
    return f"[{few([repr(item) for item in items], MOST_NAMES)}]"


def shown(value: object, most: int = LONGEST_NAME) -> str:
    """A value as a message shows it: one line of at most ``most`` characters, without control characters.

    Names and cells come from files: they may be long, and hold escape sequences that a terminal would obey.
    """
    text = printable(value if isinstance(value, str) else " ".join(str(value).split()))
    half = (most - 3) // 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


def with_deviation(value: float, deviation: float) -> str:
    """A signed value with as many digits as its deviation tells: ``+1.000 +- 0.004``, ``-12 +- 3``."""
    if not 0.0 < deviation < inf:
        return f"{value:+.2g} +- {deviation:.2g}"
    leading = f"{deviation:.1e}"  # 1.4e-03: two digits of a deviation that begins with 1
    digits = max(0, (leading[0] == "1") - int(leading[4:]))
    return f"{value:+.{digits}f} +- {deviation:.{digits}f}"


def printable(text: str) -> str:
    """The text with control, formatting and other invisible characters as escapes, such as ``\\x1b``."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
