"""Where tensors live: one policy for the whole package.

* Constants, files, tables, robots and the front half of a calibration (registration, geometry, choice of scales) are on
  the CPU: small work, and SciPy does some of it.
* Flows and kernel sums run where their inputs are: move a problem or a model with ``.to(device)``.
* No tensor is made without a device: either that of an input or :data:`HOST`. Then ``torch.set_default_device`` of the
  user's program changes nothing here.

Public names that work inside `torch.inference_mode` too.

Tensors made there can never take part in a derivative, not even outside and not even those that are kept in a cache.
Work that differentiates, and objects that will, are therefore made outside of that mode, whatever the caller's is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import isfunction
from typing import Any, TypeVar

import torch

from diffeo_calib.common.errors import InputError

HOST = torch.device("cpu")


def usable(device: object, *, numbers: bool = True) -> torch.device:
    """A device on which tensors can be made.

    Args:
        numbers: whether it must hold numbers: "meta", which stands for any other device in tests, holds none.

    Raises:
        InputError: no device, or one that this machine or this build of torch does not have.
    """
    try:
        made = torch.empty(0, dtype=torch.float64, device=device)  # pyright: ignore[reportArgumentType, reportCallIssue]
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        what = f"the device {device!r} cannot be used ({reason})"
        raise InputError.of(what, fix="pass 'cpu', or install a build of torch for this device") from error
    if numbers and made.is_meta:
        raise InputError.of(f"the device {device!r} holds no numbers", expected="a device such as 'cpu' or 'cuda'")
    return made.device


def seeded(seed: int) -> torch.Generator:
    """A random generator on the CPU: the same numbers whatever the device of the work."""
    return torch.Generator(HOST).manual_seed(seed)


T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


def outside_inference_mode(function: F) -> F:
    """Return the function, run outside of inference mode."""

    @wraps(function)
    def outside(*args: Any, **options: Any) -> Any:
        if torch.compiler.is_compiling() or not torch.is_inference_mode_enabled():
            return function(*args, **options)
        with torch.inference_mode(False):
            return function(*args, **options)

    return outside  # pyright: ignore[reportReturnType]


def methods_outside_inference_mode(cls: type[T]) -> type[T]:
    """Return the class, its constructor, call and public methods run outside of inference mode."""
    for name, value in list(vars(cls).items()):
        if isfunction(value) and (not name.startswith("_") or name in ("__init__", "__post_init__", "__call__")):
            setattr(cls, name, outside_inference_mode(value))
        elif isinstance(value, classmethod):
            setattr(cls, name, classmethod(outside_inference_mode(value.__func__)))
    return cls
