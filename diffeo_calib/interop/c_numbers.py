"""Numbers and arrays as C source text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf, isinf

import numpy as np

WIDTH = 120
"""Longest line of numbers."""


def number(value: float) -> str:
    """The shortest decimal text that a compiler reads back as the same number; integers stay integers."""
    if isinstance(value, int):
        return str(value)
    if isinf(value):
        return "HUGE_VAL" if value == inf else "-HUGE_VAL"
    return repr(value)


def array(values: object) -> str:
    """An initialiser with a pair of braces for every dimension."""
    given = values.tolist() if isinstance(values, np.ndarray) else values
    if not isinstance(given, Sequence):
        raise TypeError(f"no array: {given!r}")
    return _braces(given)


def pose(transform: np.ndarray) -> str:
    """An initialiser of the generated struct Pose from a transform (4, 4)."""
    return f"{{{_row(transform[:3, :3].ravel().tolist())}, {_row(transform[:3, 3].tolist())}}}"


def poses(transforms: np.ndarray) -> str:
    """An initialiser of an array of Pose from transforms (L, 4, 4)."""
    return "{\n" + ",\n".join(f"    {pose(transform)}" for transform in transforms) + "}"


def _braces(values: Sequence) -> str:
    if not isinstance(values[0], list | tuple):
        return _row(values)
    return "{" + ",\n".join(_braces(part) for part in values) + "}"


def _row(values: Sequence) -> str:
    return "{" + ",\n".join(_lines([number(value) for value in values])) + "}"


def _lines(words: Sequence[str]) -> Iterator[str]:
    line = ""
    for word in words:
        if line and len(line) + len(word) + 3 > WIDTH:
            yield line
            line = word
        else:
            line = f"{line}, {word}" if line else word
    yield line
