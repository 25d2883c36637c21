"""A second device on machines without an accelerator: its tensors hold numbers, and mix with the CPU's as little.

Tensors of the second device say that they lie on "meta"; each wraps a tensor on the CPU that holds its numbers. Every
operation of torch, forwards and backwards, checks that all its operands lie on one device (numbers without dimensions
excepted, as on a GPU), computes on the CPU and wraps the results. What runs here makes no tensor on a device that it
did not state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from typing import Any, NamedTuple
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

SECOND, CPU = torch.device("meta"), torch.device("cpu")
MOVES = {"aten._to_copy.default", "aten.copy_.default", "aten.to.device"}
"""Operations between devices."""


class There(Tensor):
    """A tensor on the second device."""

    inner: Tensor
    is_meta = False  # pyright: ignore[reportAssignmentType]  # it holds numbers

    @staticmethod
    def __new__(cls, inner: Tensor) -> There:
        return torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=SECOND,
            requires_grad=inner.requires_grad,
        )

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    def __repr__(self, **_: Any) -> str:
        return f"There({self.inner!r})"

    def tolist(self) -> list[Any]:
        """The numbers, which torch refuses to give for such tensors."""
        return self.inner.tolist()

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function in (Tensor.__getitem__, Tensor.__setitem__):
            args = (args[0], brought(args[1]), *args[2:])
        with torch._C.DisableTorchFunctionSubclass():
            return function(*args, **(kwargs or {}))

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatched(function, args, kwargs or {})


class _Operations(TorchDispatchMode):
    """Counts operations on the second device, and makes tensors there."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.calls += any(isinstance(t, There) for t in tensors_in((args, kwargs)))
        return dispatched(function, args, kwargs or {})


class SecondDevice(ExitStack):
    """While it is entered, tensors can be made on the second device; `operations.calls` counts operations there."""

    def __enter__(self) -> SecondDevice:
        # The compiler keeps a list of torch's functions from its first use on: it must not find those replaced below.
        torch.compile(torch.neg, backend="eager")(torch.zeros(1, device=CPU))
        self.operations = self.enter_context(_Operations())
        for name in ("tensor", "as_tensor", "asarray"):
            self.enter_context(mock.patch.object(torch, name, _literal(getattr(torch, name))))
        # Backward passes must not run inside of There.__torch_function__, which looks after indices.
        self.enter_context(mock.patch.object(torch.autograd, "has_torch_function", return_value=False))
        return self


def _literal(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A function that makes tensors of Python's numbers, which torch does without an operation."""

    def made(data: Any, **options: Any) -> Tensor:
        place = options.get("device")
        if isinstance(data, Tensor) or place is None or torch.device(place).type != SECOND.type:
            return make(data, **options)
        return There(make(data, **{**options, "device": CPU}))

    return made


def dispatched(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """One operation of torch."""
    tensors = list(tensors_in((args, kwargs)))
    there = any(isinstance(t, There) for t in tensors)
    wanted = kwargs.get("device")
    if there and str(function) not in MOVES:
        strangers = [tuple(t.shape) for t in tensors if not isinstance(t, There) and t.ndim]
        if strangers:
            raise RuntimeError(f"{function} mixes devices: tensors {strangers} lie on the CPU")
    if not there and (wanted is None or torch.device(wanted).type != SECOND.type):
        return function(*args, **kwargs)
    home = there if wanted is None else torch.device(wanted).type == SECOND.type
    if wanted is not None:
        kwargs = {**kwargs, "device": CPU}
    found = function(*mapped(unwrapped, args), **mapped(unwrapped, kwargs))
    if function._schema.is_mutable:
        return kwargs.get("out", args[0])
    return mapped(There, found) if home else found


def brought(index: Any) -> Any:
    """An index with lists and tensors of the CPU on the second device: torch brings them to every device itself."""
    parts = index if isinstance(index, tuple) else (index,)
    made = (
        torch.tensor(p, dtype=torch.long, device=CPU) if isinstance(p, list | tuple | range) and len(p) else p
        for p in parts
    )
    found = tuple(There(p) if isinstance(p, Tensor) and not isinstance(p, There) else p for p in made)
    return found if isinstance(index, tuple) else found[0]


def unwrapped(value: Tensor) -> Tensor:
    """The tensor that holds the numbers."""
    return value.inner if isinstance(value, There) else value


def tensors_in(value: Any) -> Iterator[Tensor]:
    """All tensors among arguments or results."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, list | tuple | dict):
        for part in value.values() if isinstance(value, dict) else value:
            yield from tensors_in(part)


def mapped(change: Callable[[Tensor], Tensor], value: Any) -> Any:
    """The same arguments or results with every tensor changed."""
    if isinstance(value, Tensor):
        return change(value)
    if isinstance(value, dict):
        return {name: mapped(change, part) for name, part in value.items()}
    return type(value)(mapped(change, part) for part in value) if isinstance(value, list | tuple) else value


class Place(NamedTuple):
    """A device for tests."""

    name: str
    exact: bool
    entered: Callable[[], AbstractContextManager[Any]]

    def bring(self, value: Tensor) -> Tensor:
        """The numbers of a tensor that must lie here, on the CPU."""
        if value.device.type != torch.device(self.name).type:
            raise TypeError(f"the tensor lies on {value.device}")
        return value.inner.detach() if isinstance(value, There) else value.detach().cpu()

    def compare(self, value: Tensor, expected: Tensor, atol: float = 1e-9) -> None:
        """Fail unless a tensor that must lie here has these numbers."""
        tolerance = 1e-15 if self.exact else atol  # sums may be taken in another order
        torch.testing.assert_close(self.bring(value), expected.detach(), rtol=tolerance, atol=tolerance)


def _accelerators() -> list[Place]:
    found = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
    return [Place(found.type, False, nullcontext)] if found is not None and found.type != "mps" else []  # no float64


PLACES = [Place("meta", True, SecondDevice), *_accelerators()]
"""The second device, and the accelerator of this machine."""


@contextmanager
def at(place: Place) -> Iterator[str]:
    """Enter the place; its name for ``.to``."""
    with place.entered():
        yield place.name
