"""Checks of arrays that come from outside: shape, finiteness, sign.

Public functions check their arguments with these functions; inside the package tensors are trusted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError

MOST_SHOWN = 12
"""Values that a message lists."""
Shape = Sequence[int | str]
"""A pattern such as ``("N", 6)``: an integer must match, a letter stands for any size."""


def as_tensor(
    value: object, name: str, shape: Shape, *, also: Sequence[Shape] = (), fix: str = "", empty: bool = False
) -> Tensor:
    """Convert ``value`` to a finite float64 tensor of the given shape.

    A tensor keeps its device and its place in an autograd graph.

    Args:
        value: tensor, array or nested sequence of numbers.
        name: the argument's name, for messages.
        shape: pattern such as ``("N", 6)``; letters stand for any size.
        also: other shapes that are accepted.
        fix: what the user should do if the shape is wrong.
        empty: whether a size of zero is allowed.

    Raises:
        InputError: not numeric, wrong shape, empty, or NaN or infinite values (first place named).
    """
    try:
        if isinstance(value, Tensor):
            tensor = value
        else:  # torch wants memory that may be written to; columns of data frames are often read-only
            if np.iscomplexobj(value):  # pyright: ignore[reportArgumentType]
                raise TypeError("complex numbers")
            tensor = torch.as_tensor(np.require(value, np.float64, ["C", "W"]), device=HOST)
        if tensor.is_complex():
            raise TypeError("complex numbers")
        tensor = tensor.to(torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError.of(
            f"`{name}` cannot be read as numbers ({error})", fix="pass a numeric array, rows of equal length"
        ) from error
    shapes = [shape, *also]
    expected = " or ".join(_words(pattern) for pattern in shapes)
    if not any(_fits(tensor, pattern) for pattern in shapes):
        raise InputError.of(f"`{name}` has the wrong shape", expected=expected, got=_words(tensor.shape), fix=fix)
    if not empty and tensor.numel() == 0:
        got = _words(tensor.shape)
        raise InputError.of(f"`{name}` is empty", expected=expected, got=got, fix="pass at least one row")
    check_finite(tensor, name)
    return tensor


def check_finite(tensor: Tensor, name: str) -> None:
    """Raise InputError naming the first NaN or infinite entry of ``tensor``; see :func:`wrapped` for the exception."""
    if wrapped(tensor):
        return
    bad = ~torch.isfinite(tensor.detach())
    if bad.any():
        where = [int(i) for i in bad.nonzero()[0]]
        value = float(tensor.detach()[tuple(where)])
        raise InputError.of(
            f"`{name}` has {int(bad.sum())} value(s) that are not finite, the first at index {where}",
            expected="finite numbers",
            got=value,
            fix="remove or repair these rows",
        )


def positive(value: object, name: str, shape: Shape = ()) -> Tensor:
    """Convert to a float64 tensor of positive finite numbers.

    Raises:
        InputError: not numeric, wrong shape, not finite, zero or negative.
    """
    tensor = as_tensor(value, name, shape)
    bad = tensor.detach() <= 0
    if bool(bad.any()):
        got: object = tensor.detach().tolist()
        if tensor.numel() > MOST_SHOWN:
            where = [int(i) for i in bad.nonzero()[0]]
            got = f"{int(bad.sum())} others, the first at index {where}: {float(tensor[tuple(where)])}"
        raise InputError.of(f"`{name}`", expected="positive numbers", got=got, fix="pass values above zero")
    return tensor


def check_count(value: object, what: str, *, least: int = 1, most: int | None = None) -> None:
    """Raise InputError unless ``value`` is an integer in range."""
    good = isinstance(value, int) and not isinstance(value, bool) and value >= least
    if not good or (most is not None and isinstance(value, int) and value > most):
        limit = f"an integer of at least {least}" + ("" if most is None else f" and at most {most}")
        raise InputError.of(what, expected=limit, got=repr(value))


def check_number(value: object, what: str, *, above: float, below: float = float("inf")) -> None:
    """Raise InputError unless ``value`` is a number strictly between two bounds."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not above < value < below:
        limit = f"a number above {above:g}" + ("" if below == float("inf") else f" and below {below:g}")
        raise InputError.of(what, expected=limit, got=repr(value))


def wrapped(tensor: Tensor) -> bool:
    """Whether code must not branch on the values of ``tensor``.

    This is so inside a ``torch.func`` transform, and while ``torch.compile``, ``torch.export`` or ``torch.jit.trace``
    record a program. Checks of values are left out there: a recorded program does not check its input.
    """
    recorded = torch.compiler.is_compiling() or torch.jit.is_tracing()  # pyright: ignore[reportPrivateImportUsage]
    return recorded or is_functorch_wrapped_tensor(tensor)


def _fits(tensor: Tensor, shape: Shape) -> bool:
    return tensor.ndim == len(shape) and all(
        isinstance(want, str) or want == size for want, size in zip(shape, tensor.shape, strict=True)
    )


def _words(shape: Sequence[int | str]) -> str:
    return "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
