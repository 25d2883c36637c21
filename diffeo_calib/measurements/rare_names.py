"""Names of devices, set-ups and sockets that few rows carry: most of them are spelling mistakes of another name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from difflib import get_close_matches

from diffeo_calib.common.errors import few


def rare_names(names: Sequence[str], lines: Sequence[int], fewest: int) -> list[str]:
    """Names with fewer rows than that, in words: with their rows, and the frequent name that they resemble.

    Args:
        names: (N,) of the rows, "" for none. lines: (N,) numbers of the rows in their file. fewest: rows of a name.
    """
    counts = Counter(name for name in names if name)
    usual = [name for name, count in counts.items() if count >= fewest]
    found = []
    for name, count in counts.items():
        if count < fewest:
            own = [line for line, other in zip(lines, names, strict=True) if other == name]
            near = get_close_matches(name, [other for other in usual if _digits(other) == _digits(name)], n=1)
            meant = "".join(f", perhaps meant as '{other}'" for other in near)
            found.append(f"'{name}' in {count} row{'s' * (count > 1)} ({few(own)}){meant}")
    return found


def _digits(name: str) -> str:
    """The digits of a name: names that differ in them, such as "0/0" and "0/1", are seldom meant for one another."""
    return "".join(character for character in name if character.isdigit())
