"""Matrix-valued reproducing kernels K(x, x') of vector fields, and sums of them.

Flows and solvers use only the methods of :class:`Kernel`. A new kernel needs a single method, the matrix of its values.
All other methods have defaults that differentiate this matrix by autograd; they can be overridden by closed forms, or
by sums that never materialise the matrix (radial.py does both).

Shapes: x (M, n) evaluation points; q, a (N, n) control points and their momenta.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from functools import cache, reduce
from inspect import Parameter, signature
from itertools import chain
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, as_written, sentence, warn_user
from diffeo_calib.kernels.reductions.backends import Backend, check_accuracy, check_backend

PROBE_POINTS = 3  # number of points at which the default check evaluates a kernel's matrix
ROUNDING_RATIO = 1e-8
"""Asymmetry and negative eigenvalues of a kernel matrix, relative to its largest entry, that count as rounding."""


class Kernel(ABC):
    """A reproducing kernel of vector fields on an n-dimensional space.

    A subclass must implement :meth:`matrix`, differentiable by torch. To be saved in model files, it must also keep its
    constructor arguments as attributes of the same names, or override :meth:`to_config`.
    """

    @abstractmethod
    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        """K(x_i, y_j) as one matrix: (M, n), (N, n) -> (M n, N n), coordinates of one point adjacent.

        It must be symmetric, K(x, y) = K(y, x)^T, positive semi-definite, and twice differentiable by torch in x and y,
        at x = y too.
        """

    @property
    def terms(self) -> tuple[Kernel, ...]:
        """The kernels that add up to this one: just itself, except for a :class:`SumKernel`."""
        return (self,)

    @property
    def scales(self) -> int:
        """Number of scales that :meth:`rescaled` changes: none of a kernel that is not radial."""
        return 0

    def rescaled(self, logs: Tensor) -> Kernel:
        """The kernel with length scales, then amplitudes, times exp(logs); differentiable in ``logs``."""
        return self

    def field(self, x: Tensor | None, q: Tensor, a: Tensor) -> Tensor:
        """v(x) = sum_j K(x, q_j) a_j: (M, n). Differentiable by autograd.

        Args:
            x: (M, n), or None for the control points q themselves: each pair is then visited once.
            q: (N, n).
            a: (N, n); momenta (N, k, n) give k fields at once, (M, k, n).
        """
        check_points(x, q, a)
        x = q if x is None else x
        n = q.shape[1]
        columns = a.reshape(len(q), -1, n).mT.reshape(len(q) * n, -1)  # (N n, k)
        values = (self.matrix(x, q) @ columns).view(len(x), n, -1).mT  # (M, k, n)
        return values.reshape(len(x), *a.shape[1:])

    def field_and_jacobian(self, x: Tensor | None, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """v(x) (M, n) and Dv(x) (M, n, n); arguments as :meth:`field`."""
        x, graph = (q if x is None else x), _recorded(x, q, a)
        with torch.enable_grad():
            at = _copy_of(x, graph)
            v = self.field(at, q, a)
            rows = [_slope(v[:, k].sum(), at, graph) for k in range(v.shape[1])]
        return (v if graph else v.detach()), torch.stack(rows, 1)

    def gradient(self, x: Tensor | None, c: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of sum_ij c_i^T K(x_i, q_j) a_j in c, which is v(x), and in x: (M, n) each.

        Args:
            x: (M, n), or None for the control points q themselves, with c = a. c: (M, n). q, a: as :meth:`field`.
        """
        x, graph = (q if x is None else x), _recorded(x, c, q, a)
        with torch.enable_grad():
            at = _copy_of(x, graph)
            v = self.field(at, q, a)
            slope = _slope((c * v).sum(), at, graph)
        return (v if graph else v.detach()), slope

    def hamiltonian_gradient(self, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of H(q, a) = 1/2 sum_ij a_i^T K(q_i, q_j) a_j in a, which is v(q), and in q: (N, n) each."""
        return self.gradient(None, a, q, a)

    def hessian_product(self, q: Tensor, a: Tensor, dq: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        """Derivative of H's gradient (dH/da, dH/dq) along (dq, da): (N, n) each."""
        with torch.enable_grad():
            point, momentum = (t.detach().clone().requires_grad_() for t in (q, a))
            energy = 0.5 * (momentum * self.field(None, point, momentum)).sum()
            by_q, by_a = torch.autograd.grad(energy, (point, momentum), create_graph=True)
            along = (by_q * dq.detach()).sum() + (by_a * da.detach()).sum()
            change_q, change_a = torch.autograd.grad(along, (point, momentum), materialize_grads=True)
        return change_a, change_q

    def gram(self, x: Tensor, left: Tensor, y: Tensor, right: Tensor) -> Tensor:
        """The matrix of blocks left_i K(x_i, y_j) right_j^T.

        Args:
            x: (M, n). left: (M, k, n).
            y: (N Q, n). right: (N, l, Q n); the Q consecutive points of a block act together, usually Q = 1.

        Returns:
            (M k, N l), differentiable by autograd, in the kernel's hyper-parameters too.
        """
        (M, k, n), (N, r, width) = left.shape, right.shape
        half = left @ self.matrix(x, y).view(M, n, N * width)  # (M, k, N Q n)
        return torch.einsum("ikjb,jlb->ikjl", half.view(M, k, N, width), right).reshape(M * k, N * r)

    def diagonal_components(self, x: Tensor, y: Tensor) -> Iterator[tuple[int, Tensor]] | None:
        """For every component k that is not always zero, k and K(x_i, y_j)_kk (N, M), differentiable.

        None for a kernel whose values are not diagonal matrices. Sums of kernels add theirs before :meth:`gram`.
        """
        return None

    def own_blocks(self, x: Tensor, effect: Tensor) -> Tensor:
        """The blocks of effect K(x, x) effect^T on its diagonal: x (N Q, n), effect (N, k, Q n) -> (N, k, k)."""
        n, together = x.shape[1], x.view(len(effect), -1, x.shape[1])
        eye = torch.eye(n, dtype=x.dtype, device=x.device).expand(together.shape[1], n, n)
        blocks = [e @ self.gram(q, eye, q, e[None]) for q, e in zip(together, effect, strict=True)]
        return torch.stack(blocks) if blocks else effect @ effect.mT

    def check(self, dim: int, name: str) -> None:
        """Raise InputError unless the kernel acts on vectors of ``dim`` coordinates.

        The default evaluates :meth:`matrix` at a few points and checks its shape, symmetry and eigenvalues.
        """
        x = torch.linspace(-0.5, 0.7, PROBE_POINTS * dim, dtype=torch.float64, device=HOST).sin().view(-1, dim)
        expected = f"a symmetric positive semi-definite float64 matrix ({len(x) * dim}, {len(x) * dim})"
        try:
            values = self.to(x.device).matrix(x, x).detach()
            got = f"shape {tuple(values.shape)}, {values.dtype}"
            good = values.shape == (len(x) * dim, len(x) * dim) and values.dtype == torch.float64
        except (RuntimeError, ValueError, IndexError, TypeError, AttributeError) as error:
            values, got, good = x, f"the error {error}", False
        if good:
            level = ROUNDING_RATIO * float(values.abs().max().clamp(min=1e-300))
            skew, least = float((values - values.T).abs().max()), float(torch.linalg.eigvalsh(values).min())
            good = skew <= level and least >= -level
            got = f"an asymmetry of {skew:.1e}, a smallest eigenvalue of {least:.1e}"
        if not good:
            what = f"`{name}`: the matrix of {type(self).__name__} at {len(x)} points of {dim} coordinates"
            fix = "match the number of joints or task coordinates, and return (M n, N n)"
            raise InputError.of(what, expected=expected, got=got, fix=fix)

    def scaled(self, factor: float) -> Kernel:
        """The kernel factor * K, factor > 0; InputError for a kernel of your own without this method."""
        raise InputError.of(f"{type(self).__name__} cannot be scaled", fix="write its method `scaled(factor)`")

    def using(self, backend: Backend, accuracy: float | None = None) -> Kernel:
        """Return the kernel with its sums evaluated by this backend.

        A kernel of your own always uses the dense matrix, and warns of another backend. If it is radial, make it a
        :class:`~diffeo_calib.kernels.radial.RadialKernel` of a :class:`~diffeo_calib.kernels.profiles.Profile`: it then
        has all backends.

        Args:
            backend: "auto", "dense", "fused", "tiled", "keops" or "distributed": see the table in
                :mod:`diffeo_calib.kernels.reductions.backends`.
            accuracy: error that large sums may have, relative to the sum of the momenta's absolute values.
        """
        if check_backend(backend) not in ("auto", "dense") or check_accuracy(accuracy) is not None:
            _warn_of_dense_sums(type(self).__name__)
        return self

    def backends(self, count: int, device: torch.device) -> set[str]:
        """Names of the backends that evaluate sums over ``count`` points."""
        return {"dense"}

    def to(self, device: torch.device | str) -> Kernel:
        """Return the kernel with all its tensor attributes on a device."""
        moved = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(moved, name, value.to(device))
        return moved

    def to_config(self) -> dict[str, Any]:
        """The constructor's arguments by name, as JSON values: what model files record of a kernel.

        Raises:
            InputError: an argument is not kept as an attribute of the same name, or cannot be written as JSON.
        """
        config: dict[str, Any] = {}
        for name, parameter in signature(type(self)).parameters.items():
            if parameter.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD) or not hasattr(self, name):
                what = f"the kernel {type(self).__name__} cannot be saved: its argument `{name}` is not an attribute"
                raise InputError.of(what, fix=f"keep it as `self.{name}`, or write a `to_config`")
            config[name] = _plain(getattr(self, name), f"`{name}` of the kernel {type(self).__name__}")
        return config

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Kernel:
        """Call the constructor with the arguments that :meth:`to_config` recorded."""
        return cls(**config)

    def __add__(self, other: Kernel) -> Kernel:
        return SumKernel([self, other])


@cache
def _warn_of_dense_sums(name: str) -> None:
    """Warn, once for every class, that its sums have one backend."""
    fix = "if it is radial, use RadialKernel with a Profile, which have all backends"
    warn_user(sentence(f"{name} is a kernel of your own: its sums always use the dense matrix", fix=fix))


def check_points(x: Tensor | None, q: Tensor, a: Tensor) -> None:
    """Raise InputError unless points q (N, n) have momenta (N, n) or (N, k, n), and x, if given, is (M, n)."""
    if x is not None and x.shape[-1:] != q.shape[-1:]:
        expected = f"{q.shape[-1]} coordinates, as those of the points `q`"
        raise InputError.of("the points `x` of a kernel sum", expected=expected, got=f"shape {tuple(x.shape)}")
    if a.shape[:1] != q.shape[:1] or a.shape[-1:] != q.shape[-1:]:
        expected = f"a row of {q.shape[-1]} numbers for each of the {len(q)} points `q`"
        raise InputError.of("the momenta `a`", expected=expected, got=f"shape {tuple(a.shape)}")


def _added(name: str) -> Any:
    """A method that adds up the results of the terms: tensors, or tuples of tensors."""

    def method(self: SumKernel, *arguments: Any, **named: Any) -> Any:
        return reduce(_plus, (getattr(term, name)(*arguments, **named) for term in self.terms))

    return method


def _plus(a: Any, b: Any) -> Any:
    return a + b if isinstance(a, Tensor) else tuple(map(torch.add, a, b))


def _of_each(name: str) -> Any:
    """A method that gives the sum of what it gives of every term."""

    def method(self: SumKernel, *arguments: Any, **options: Any) -> SumKernel:
        return SumKernel([getattr(term, name)(*arguments, **options) for term in self.terms])

    return method


class SumKernel(Kernel):
    """A sum of kernels; its fields are the sums of theirs."""

    def __init__(self, terms: Sequence[Kernel]) -> None:
        if not terms:
            raise InputError.of("a sum of kernels", expected="at least one term", got=0)
        self._terms = tuple(term for kernel in terms for term in kernel.terms)

    @property
    def terms(self) -> tuple[Kernel, ...]:
        """The kernels that are added, none of them a sum itself."""
        return self._terms

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.terms))

    matrix, own_blocks, field, field_and_jacobian, gradient, hamiltonian_gradient, hessian_product = map(
        _added,
        ("matrix", "own_blocks", "field", "field_and_jacobian", "gradient", "hamiltonian_gradient", "hessian_product"),
    )
    scaled, using, to = map(_of_each, ("scaled", "using", "to"))

    @property
    def scales(self) -> int:
        return sum(term.scales for term in self.terms)

    def rescaled(self, logs: Tensor) -> SumKernel:
        each = logs.split([term.scales for term in self.terms])
        return SumKernel([term.rescaled(factors) for term, factors in zip(self.terms, each, strict=True)])

    def check(self, dim: int, name: str) -> None:
        for term in self.terms:
            term.check(dim, name)

    def backends(self, count: int, device: torch.device) -> set[str]:
        return set().union(*(term.backends(count, device) for term in self.terms))

    def gram(self, x: Tensor, left: Tensor, y: Tensor, right: Tensor) -> Tensor:
        diagonals = [term.diagonal_components(x, y) for term in self.terms]
        parts = [t.gram(x, left, y, right) for t, d in zip(self.terms, diagonals, strict=True) if d is None]
        present = [d for d in diagonals if d is not None]
        if present:
            parts.append(component_gram(chain.from_iterable(present), left, right))
        return reduce(torch.add, parts)


def check_kernel(kernel: object, dim: int, name: str) -> None:
    """Raise InputError unless ``kernel`` is a kernel that acts on vectors of ``dim`` coordinates."""
    if not isinstance(kernel, Kernel):
        expected = "a kernel such as dc.Gaussian(lengthscale)"
        raise InputError.of(f"`{name}`", expected=expected, got=as_written(kernel))
    kernel.check(dim, name)


def _recorded(*tensors: Tensor | None) -> bool:
    """Whether autograd records operations on these tensors."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def _copy_of(x: Tensor, graph: bool) -> Tensor:
    """A separate tensor to differentiate by. x may be the control points, whose own dependence must not be included."""
    return x.clone() if graph and x.requires_grad else x.detach().clone().requires_grad_()


def _slope(value: Tensor, at: Tensor, graph: bool) -> Tensor:
    """Derivative of a scalar, zero where it does not depend on ``at``."""
    if not value.requires_grad:
        return torch.zeros_like(at)
    (slope,) = torch.autograd.grad(value, at, create_graph=graph, retain_graph=True, materialize_grads=True)
    return slope


def _plain(value: object, what: str) -> Any:
    """The value as JSON: a number, text, a truth value, None, or a list of these."""
    if isinstance(value, Tensor):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item, what) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise InputError.of(f"{what} cannot be saved", expected="numbers, text or tensors", got=type(value).__name__)


def diagonal_gram(values: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """The matrix of blocks left_i K(x_i, y_j) right_j^T; consecutive points y may act together.

    Args:
        values: (N Q, n, M) the diagonals of K(x_i, y_j), a row for every point y.
        left: (M, k, n). right: (N, l, Q n), Q points per block, the coordinates of one point adjacent.

    Returns:
        (M k, N l), the transpose of a contiguous matrix.
    """
    (M, k, _), (N, r, width) = left.shape, right.shape
    spread = values[..., None] * left.permute(2, 0, 1).contiguous()  # (N Q, n, M, k)
    return (right @ spread.reshape(N, width, M * k)).view(N * r, M * k).T


def component_gram(components: Iterable[tuple[int, Tensor]], left: Tensor, right: Tensor) -> Tensor:
    """Add components first, so that no term of a sum needs a large matrix: (M k, N l).

    Args:
        components: numbers c of components and their values K(x_i, y_j)_cc, (N Q, M).
        left: (M, k, n). right: (N, l, Q n).
    """
    sums: dict[int, Tensor] = {}
    for component, values in components:
        sums[component] = sums[component] + values if component in sums else values
    (M, k, n), (N, r, _), present = left.shape, right.shape, sorted(sums)
    if not present:
        return left.new_zeros(M * k, N * r)
    effect = right.reshape(N, r, -1, n)[..., present].flatten(2)
    return diagonal_gram(torch.stack([sums[c] for c in present], 1), left[..., present], effect)
