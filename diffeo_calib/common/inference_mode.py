"""Public names that work inside `torch.inference_mode` too.

Tensors made there can never take part in a derivative, not even outside and not even those that are kept in a cache.
Work that differentiates, and objects that will, are therefore made outside of that mode, whatever the caller's is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import isfunction
from typing import Any, TypeVar

import torch

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


def outside_inference_mode(function: F) -> F:
    """The same function, run outside of inference mode."""

    @wraps(function)
    def outside(*args: Any, **options: Any) -> Any:
        if torch.compiler.is_compiling() or not torch.is_inference_mode_enabled():
            return function(*args, **options)
        with torch.inference_mode(False):
            return function(*args, **options)

    return outside  # pyright: ignore[reportReturnType]


def methods_outside_inference_mode(cls: type[T]) -> type[T]:
    """The same class, its constructor, call and public methods run outside of inference mode."""
    for name, value in list(vars(cls).items()):
        if isfunction(value) and (not name.startswith("_") or name in ("__init__", "__post_init__", "__call__")):
            setattr(cls, name, outside_inference_mode(value))
        elif isinstance(value, classmethod):
            setattr(cls, name, classmethod(outside_inference_mode(value.__func__)))
    return cls
