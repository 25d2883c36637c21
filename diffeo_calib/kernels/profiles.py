"""Radial profiles kappa(r2) of kernels, with closed-form derivatives in r2 = |F - F'|^2.

A profile is positive definite in every dimension. Its formulas use only ``exp``, ``sqrt`` and arithmetic,
so that the same lines run on tensors and on symbolic (lazy) matrices.

Matern profiles are written in r2 with r = sqrt(2 nu r2). Differentiating sqrt at 0 would give NaN, so
autograd goes through :func:`_derivative`, whose backward pass is the next closed-form derivative.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import gamma, pi
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import wrapped
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.runtime.arrays import FORMULAS

MAX_ORDER = 3  # highest derivative that every profile provides
METHODS = SimpleNamespace(exp=lambda a: a.exp(), sqrt=lambda a: a.sqrt(), relu=lambda a: a.relu())
"""Functions of the formulas in runtime/arrays.py for tensors, symbols and lazy matrices."""


class Profile(ABC):
    """kappa: [0, inf) -> R with kappa(0) = 1.

    Profiles of your own work with every backend. Sums are compiled where they use ``exp``, ``sqrt``, ``relu``,
    arithmetic and numbers, and run on tensors else, also where a parameter requires gradients.
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the profile in model files."""

    @abstractmethod
    def derivative(self, r2: Any, order: int) -> Any:
        """The ``order``-th derivative of kappa in r2, elementwise (order 0 to 3).

        Args:
            r2: squared feature distances, tensor or lazy matrix, any shape.
            order: 0 is kappa itself.
        """

    def spectral_density(self, w2: Tensor, dim: int) -> Tensor | None:
        """S(|w|^2) with kappa(|x|^2) = integral S exp(i w . x) dw over ``dim`` dimensions; None if it is not known."""
        return None

    def derivatives(self, r2: Any, order: int) -> list[Any]:
        """[kappa, kappa', ..., kappa^(order)], differentiable by autograd when r2 is a tensor."""
        if isinstance(r2, Tensor) and (r2.requires_grad or wrapped(r2)) and not self.followed:
            return [_derivative(r2, self, k) for k in range(order + 1)]
        return [self.derivative(r2, k) for k in range(order + 1)]

    @property
    def followed(self) -> bool:
        """Whether autograd or a transform of torch.func follows a parameter, wherever the profile has it from."""
        if type(self) in SHIPPED:
            return False
        r2 = torch.zeros((), dtype=torch.float64, device=HOST)
        kappa = self.derivative(r2, 0)
        return isinstance(kappa, Tensor) and (kappa.requires_grad or wrapped(kappa) > wrapped(r2))


class _Derivative(torch.autograd.Function):
    """The k-th derivative of a profile; its gradient is the (k + 1)-th."""

    @staticmethod
    def forward(r2: Tensor, profile: Profile, order: int) -> Tensor:
        return profile.derivative(r2, order)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Profile, int], output: Tensor) -> None:
        r2, ctx.profile, ctx.order = inputs
        ctx.save_for_backward(r2)
        ctx.save_for_forward(r2)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        return grads[0] * _next_derivative(ctx), None, None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int, None, None], r2: Tensor, profile: Profile, order: int
    ) -> tuple[Tensor, int]:
        return _derivative(r2, profile, order), in_dims[0]


class _ForwardDerivative(_Derivative):
    """Derivative in forward mode too, which torch.compile refuses to record."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return tangents[0] * _next_derivative(ctx)


def _next_derivative(ctx: Any) -> Tensor:
    (r2,) = ctx.saved_tensors
    return _derivative(r2, ctx.profile, ctx.order + 1)


def _derivative(r2: Tensor, profile: Profile, order: int) -> Tensor:
    if order > MAX_ORDER:
        raise InputError.of("a kernel profile was differentiated too often", expected=f"at most {MAX_ORDER} times")
    kind = _Derivative if torch.compiler.is_compiling() else _ForwardDerivative
    return kind.apply(r2, profile, order)  # pyright: ignore[reportReturnType]


class _Shipped(Profile):
    """A profile of the package, by the formula of its name."""

    def derivative(self, r2: Any, order: int) -> Any:
        return next(FORMULAS[self.name](r2, (order,), METHODS))

    def derivatives(self, r2: Any, order: int) -> list[Any]:
        """[kappa, kappa', ...] from one root and one exponential, differentiable by autograd when r2 is a tensor."""
        if isinstance(r2, Tensor) and (r2.requires_grad or wrapped(r2)):
            return super().derivatives(r2, order)
        return self._direct(r2, order)

    def _direct(self, r2: Any, order: int) -> list[Any]:
        return list(FORMULAS[self.name](r2, range(order + 1), METHODS))


@dataclass(frozen=True)
class GaussianProfile(_Shipped):
    """kappa = exp(-r2 / 2); on circles the von Mises kernel."""

    name = "gaussian"

    def spectral_density(self, w2: Tensor, dim: int) -> Tensor:
        """(2 pi)^(-dim / 2) exp(-w2 / 2)."""
        return (w2 * -0.5).exp() * (2.0 * pi) ** (-0.5 * dim)

    def derivatives(self, r2: Any, order: int) -> list[Any]:
        """[kappa, -kappa/2, kappa/4, ...] from one exponential, which autograd follows as often as it likes."""
        return self._direct(r2, order)


@dataclass(frozen=True)
class CauchyProfile(_Shipped):
    """kappa = 1 / (1 + r2), a heavy-tailed mixture of Gaussians (rational quadratic, alpha = 1)."""

    name = "cauchy"


@dataclass(frozen=True)
class ConstantProfile(_Shipped):
    """kappa = 1: a rigid translation of all points."""

    name = "constant"


@dataclass(frozen=True)
class MaternProfile(_Shipped):
    """Matern with nu = 3/2, 5/2 or 7/2: fields that are once, twice, three times differentiable.

    With r = sqrt(2 nu r2):  nu = 3/2: (1 + r) e^-r;  5/2: (1 + r + r^2/3) e^-r;
    7/2: (1 + r + 2 r^2/5 + r^3/15) e^-r. Each derivative in r2 is a Matern of order nu - 1.
    """

    nu: float = 2.5

    @property
    def name(self) -> str:
        """ "matern32", "matern52" or "matern72"."""
        return f"matern{round(2 * self.nu)}2"

    def __post_init__(self) -> None:
        if self.nu not in (1.5, 2.5, 3.5):
            raise InputError.of("`nu` of a Matern kernel", expected="1.5, 2.5 or 3.5", got=self.nu)

    def spectral_density(self, w2: Tensor, dim: int) -> Tensor:
        """Density of Student's t: proportional to (2 nu + w2)^-(nu + dim / 2)."""
        power = self.nu + 0.5 * dim
        scale = gamma(power) / gamma(self.nu) * pi ** (-0.5 * dim) * (2.0 * self.nu) ** self.nu
        return scale * (2.0 * self.nu + w2) ** -power


PROFILES: dict[str, Profile] = {
    profile.name: profile
    for profile in (
        GaussianProfile(),
        CauchyProfile(),
        ConstantProfile(),
        MaternProfile(1.5),
        MaternProfile(2.5),
        MaternProfile(3.5),
    )
}
"""All profiles by their names in model files."""
SHIPPED = {type(profile) for profile in PROFILES.values()}
"""Their classes: unlike those of a user, they have no parameter that torch follows, and always compute the same."""
PROBED_R2 = (0.0, 0.31, 1.7, 4.3)
"""Squared distances at which a user's profile is checked, and compared with the one of a model file."""
DIFFERENCE_STEP = 1e-4  # step of finite differences, relative to r2
DERIVATIVE_TOLERANCE = 1e-4  # largest relative error of a derivative: beyond what finite differences leave, about 1e-7
ROUNDING_TOLERANCE = 1e-8
"""The same relative to the derivative before, where a derivative is so small that its differences are rounding."""


def probe(profile: Profile) -> list[float]:
    """kappa at :data:`PROBED_R2`."""
    return [float(_at(profile, r2, 0)) for r2 in PROBED_R2]


def check_profile(profile: Profile) -> None:
    """Check a user's profile: its own name, kappa(0) = 1, derivatives that are those of kappa by finite differences.

    Not for a parameter that a transform of torch.func follows, which has no numbers yet.

    Raises:
        InputError: it is not so, or one of the orders 0 to 3 is missing.
    """
    if type(profile) in SHIPPED or torch.compiler.is_compiling() or wrapped(_at(profile, 0.0, 0)):
        return
    what = f"the profile {type(profile).__name__}"
    if profile.name in PROFILES:
        raise InputError.of(
            what, got=f"`name` = {profile.name!r} of a profile of the package", fix="choose another name"
        )
    if abs(float(_at(profile, 0.0, 0)) - 1.0) > ROUNDING_TOLERANCE:
        fix = "divide it by that, and pass `variance` to the kernel"
        raise InputError.of(f"{what} at r2 = 0", expected="kappa = 1", got=float(_at(profile, 0.0, 0)), fix=fix)
    for order in range(1, MAX_ORDER + 1):
        for r2 in PROBED_R2[1:]:
            step = DIFFERENCE_STEP * r2
            below, above = (float(_at(profile, r2 + shift, order - 1)) for shift in (-step, step))
            slope, given = (above - below) / (2.0 * step), float(_at(profile, r2, order))
            allowed = DERIVATIVE_TOLERANCE * max(abs(slope), abs(given)) + ROUNDING_TOLERANCE * max(
                abs(below), abs(above)
            )
            if not abs(slope - given) <= allowed:
                raise InputError.of(
                    f"{what}: `derivative` of order {order} at r2 = {r2:g}",
                    expected=f"{slope:.6g}, the slope of order {order - 1} in r2 = |x - y|^2",
                    got=f"{given:.6g}",
                    fix=f"correct `derivative(r2, {order})` or `derivative(r2, {order - 1})`",
                )


def _at(profile: Profile, r2: float, order: int) -> Tensor:
    """A derivative of a user's profile at one squared distance, detached."""
    try:
        value = profile.derivative(torch.tensor(r2, dtype=torch.float64, device=HOST), order)
    except Exception as error:  # whatever a user's formula raises
        what = f"the profile {type(profile).__name__} has no `derivative` of order {order} ({error!r})"
        raise InputError.of(what, expected=f"orders 0 to {MAX_ORDER}") from error
    return torch.as_tensor(value, dtype=torch.float64, device=HOST).detach()
