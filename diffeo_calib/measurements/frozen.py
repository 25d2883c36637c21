"""Attributes of frozen objects."""

from __future__ import annotations

from copy import copy
from typing import TypeVar

T = TypeVar("T")


def with_attributes(data: T, **attributes: object) -> T:
    """A copy with other attributes."""
    changed = copy(data)
    set_attributes(changed, **attributes)
    return changed


def set_attributes(data: object, **attributes: object) -> None:
    """Fill attributes of a frozen object."""
    for name, value in attributes.items():
        object.__setattr__(data, name, value)
