"""Sums that torch follows: transforms, forward-mode derivatives, parameters of profiles; and any profile of a user."""

from collections.abc import Callable

import pytest
import torch
from math_bank import normal
from sum_bank import Formulated, torch_backends
from torch import Tensor
from torch.autograd import forward_ad

import diffeo_calib as dc
from diffeo_calib.kernels.profiles import GaussianProfile, Profile
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kernels.reductions.backends import Backend

X, Q, A, C = (normal(count, 3, seed=seed) for seed, count in enumerate((30, 40, 40, 30)))
KERNEL = dc.Gaussian(0.7)


def squared_distances(x: Tensor, q: Tensor) -> Tensor:
    return (x[:, None] - q[None]).square().sum(-1)


def field(x: Tensor, q: Tensor, a: Tensor) -> Tensor:
    return (-squared_distances(x, q) / (2 * 0.7**2)).exp() @ a


def same(found: Tensor | None, expected: Tensor) -> None:
    assert found is not None
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@torch_backends
def test_several_sums_by_vmap_over_any_argument(backend: Backend) -> None:
    kernel = KERNEL.using(backend)
    for place in range(3):
        several = normal(4, *(X, Q, A)[place].shape, seed=7)
        axes = tuple(0 if k == place else None for k in range(3))
        arguments = [several if k == place else t for k, t in enumerate((X, Q, A))]
        same(torch.vmap(kernel.field, axes)(*arguments), torch.vmap(field, axes)(*arguments))
    several = normal(4, *C.shape, seed=8)
    slopes = torch.vmap(lambda c: kernel.gradient(X, c, Q, A)[1])(several)
    expected = [torch.func.grad(lambda x, c=c: (c * field(x, Q, A)).sum())(X) for c in several]
    same(slopes, torch.stack(expected))


@torch_backends
@pytest.mark.parametrize("zero", [False, True])
@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")  # of torch itself
def test_forward_mode_derivatives(backend: Backend, zero: bool) -> None:
    """At zero momenta too, where the field is known to vanish without a sum, but its derivative does not."""
    kernel = KERNEL.using(backend)
    arguments = (X, Q, torch.zeros_like(A) if zero else A)

    def tangent(function: Callable[..., Tensor], place: int) -> Tensor | None:
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(arguments[place], normal(*arguments[place].shape, seed=9))
            found = function(*[dual if k == place else t for k, t in enumerate(arguments)])
            return forward_ad.unpack_dual(found).tangent

    for place in (2,) if zero else (0, 1, 2):
        expected = tangent(field, place)
        assert expected is not None
        same(tangent(kernel.field, place), expected)


class Hidden(Profile):
    """exp(-alpha r2), whose parameter is no attribute."""

    name = "hidden"  # pyright: ignore[reportAssignmentType]

    def __init__(self, alpha: Tensor) -> None:
        self.where = [alpha]

    def derivative(self, r2: Tensor, order: int) -> Tensor:
        return (-(r2 * self.where[0])).exp() * (-self.where[0]) ** order


@torch_backends
@pytest.mark.parametrize("points_too", [False, True])
@pytest.mark.parametrize("accuracy", [None, 1e-3])
def test_a_parameter_of_a_profile_has_a_gradient(backend: Backend, points_too: bool, accuracy: float | None) -> None:
    alpha = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    q, c = normal(150, 3, seed=1).requires_grad_(points_too), normal(150, 3, seed=2)
    value = (c * RadialKernel(Hidden(alpha)).using(backend, accuracy).field(None, q, c)).sum()
    expected = (c * ((-squared_distances(q, q) * alpha).exp() @ c)).sum()
    wanted = (alpha, q) if points_too else (alpha,)
    for one, other in zip(torch.autograd.grad(value, wanted), torch.autograd.grad(expected, wanted), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    "difference": lambda r2: (1.0 - r2 * 0.1) * (-r2).exp(),
    "root by a power": lambda r2: (1.0 + r2) ** 0.5 * (-r2).exp(),
    "function of torch": lambda r2: torch.exp(-r2) * torch.cos(r2),
    "where": lambda r2: torch.where(r2 < 4.0, 1.0 - r2 / 4.0, 0.0) ** 2,
    "mask": lambda r2: (r2 != 0.25) * (-r2).exp(),
    "branch": lambda r2: (-r2).exp() if (r2 > 1.0).any() else -r2,
    "several exponents": lambda r2: (r2[..., None] * torch.tensor([-0.1, -0.9], dtype=torch.float64)).exp().mean(-1),
}


@torch_backends
@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS.keys())
def test_a_profile_may_use_any_operation_of_tensors(function: Callable[..., Tensor], backend: Backend) -> None:
    """Operations that a backend's symbols lack must not be guessed: those of tensors replace them."""
    q = torch.cartesian_prod(*[torch.arange(6.0, dtype=torch.float64) / 2] * 3)  # squared distances without rounding
    a = normal(len(q), 3, seed=1)
    kernel = RadialKernel(GaussianProfile()).using(backend)
    kernel.profile = Formulated(function)  # not all are smooth profiles with kappa(0) = 1, as a kernel asks for
    same(kernel.field(None, q, a), function(squared_distances(q, q)) @ a)
