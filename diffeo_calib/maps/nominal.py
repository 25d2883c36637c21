"""The nominal kinematics k0 as the rest of the package uses it: any smooth map, with its derivatives.

A map may have parameters theta (geometric errors, for example) with closed-form sensitivities; theta = 0
gives the map without corrections.

Shapes: x (N, n) configurations; values (N, m) with m = d * P for P markers in R^d; theta (K,).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from diffeo_calib.common.checks import wrapped
from diffeo_calib.common.errors import InputError


class NominalMap(ABC):
    """k0(.; theta): (N, n) -> (N, m), differentiable by torch in x and theta."""

    parameters: int = 0
    """K, the number of entries of theta."""
    turns: tuple[int, ...] = ()
    """Entries of theta that turn all points together, rad; coordinates are then in triples."""
    places: tuple[int, ...] = ()
    """Entries of theta that say where the base and the points on the last link are, m and rad."""

    @abstractmethod
    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        """k0(x; theta): (N, m)."""

    @abstractmethod
    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """Dk0(x; theta): (N, m, n)."""

    @abstractmethod
    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        """d k0 / d theta: (N, m, K)."""

    def rows(self, index: Tensor | slice) -> NominalMap:
        """The map at some of the rows that it was made for; the same one where all rows have one map."""
        return self


class SmoothMap(NominalMap):
    """Any torch function (N, n) -> (N, m) that maps every row independently.

    Args:
        function: differentiable by torch, without coupling between rows (no batch statistics).
    """

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        self.function = function

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        value = self.function(x)
        if not isinstance(value, Tensor) or value.dtype != torch.float64:
            got = f"a {value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
            fix = "write it with torch operations on its input"
            raise InputError.of("the value of `nominal`", expected="a float64 torch tensor", got=got, fix=fix)
        return value

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """Dk0(x) by m backward passes: (N, m, n)."""
        if wrapped(x):  # torch.autograd.grad knows no torch.func transforms
            return torch.func.vmap(torch.func.jacrev(lambda row: self.function(row[None])[0]))(x)
        with torch.enable_grad():
            wanted = x.requires_grad
            point = x if wanted else x.detach().requires_grad_()
            try:
                values = self.function(point)
            except RuntimeError as error:  # numpy refuses tensors that require gradients
                raise _not_differentiable(str(error)) from error
            if not values.requires_grad:
                raise _not_differentiable("its value does not depend on its input")
            rows = [
                torch.autograd.grad(values[:, k].sum(), point, create_graph=wanted, retain_graph=True)[0]
                for k in range(values.shape[1])
            ]
        return torch.stack(rows, 1)

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        return x.new_zeros(len(x), self(x, theta).shape[1], 0)


def _not_differentiable(reason: str) -> InputError:
    return InputError.of(
        f"the nominal map is not differentiable by torch ({reason})",
        expected="a function written with torch operations",
        fix="avoid numpy, .item() and .detach() inside it",
    )


def as_nominal(function: NominalMap | Callable[[Tensor], Tensor]) -> NominalMap:
    """Return a :class:`NominalMap` unchanged, or wrap a plain function.

    Raises:
        InputError: not callable.
    """
    if isinstance(function, NominalMap):
        return function
    if not callable(function):
        raise InputError.of("`nominal`", expected="a function (N, n) -> (N, m)", got=type(function).__name__)
    return SmoothMap(function)
