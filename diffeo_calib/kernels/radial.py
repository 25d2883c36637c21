"""Matrix-valued reproducing kernels K(x, x') of vector fields, and sums of them.

A kernel here is a sum of terms kappa(|F(x) - F(x')|^2) L L^T: a radial profile, a feature map
(spaces.py) and an output matrix A = L L^T. Scalar kernels have L = a I; per-joint amplitudes make L
diagonal; a kernel for the field component of one joint has L = a e_l.

Flows and solvers talk to kernels through the methods of :class:`Kernel` only. A kernel that is not
radial (a finite-rank one, say) implements the same methods and drops in.

Shapes: x (M, n) evaluation points; q, a (N, n) control points and their momenta.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from functools import cached_property, reduce

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, positive
from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.kernels.profiles import CauchyProfile, ConstantProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends as door
from diffeo_calib.kernels.reductions.backends import Backend, check_backend
from diffeo_calib.kernels.reductions.formulas import (
    FIELD,
    FIELD_AND_JACOBIAN,
    GRADIENT,
    HESSIAN_PRODUCT,
    Formula,
    Points,
)
from diffeo_calib.kernels.spaces import FeatureMap, Space


class Kernel(ABC):
    """A reproducing kernel of vector fields on an n-dimensional space."""

    @abstractmethod
    def field(self, x: Tensor, q: Tensor, a: Tensor) -> Tensor:
        """v(x) = sum_j K(x, q_j) a_j: (M, n). Differentiable by autograd.

        Momenta (N, k, n) give k fields at once, (M, k, n).
        """

    @abstractmethod
    def field_and_jacobian(self, x: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """v(x) (M, n) and Dv(x) (M, n, n)."""

    @abstractmethod
    def gradient(self, x: Tensor, c: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of sum_ij c_i^T K(x_i, q_j) a_j in c, which is v(x), and in x: (M, n) each.

        ``gradient(q, a, q, a)`` is the gradient of H(q, a) = 1/2 sum_ij a_i^T K(q_i, q_j) a_j in a and q.
        """

    @abstractmethod
    def hessian_product(self, q: Tensor, a: Tensor, dq: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        """Derivative of H's gradient (dH/da, dH/dq) along (dq, da): (N, n) each."""

    @abstractmethod
    def gram(self, x: Tensor, left: Tensor, y: Tensor, right: Tensor) -> Tensor:
        """The matrix of blocks left_i K(x_i, y_j) right_j^T.

        Args:
            x: (M, n). left: (M, k, n). y: (N, n). right: (N, l, n).

        Returns:
            (M k, N l), differentiable by autograd, in the kernel's hyper-parameters too.
        """

    @abstractmethod
    def inner(self, x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
        """sum_ijk weights_ikj K(x_i, y_j)_kk, differentiable in the hyper-parameters: scalar.

        Args:
            x: (M, n). y: (N, n).
            weights: (M, n, N); the output matrices A of all kernels here are diagonal.
        """

    @abstractmethod
    def check(self, dim: int, name: str) -> None:
        """Raise InputError unless the kernel acts on vectors of ``dim`` coordinates."""

    @abstractmethod
    def using(self, backend: Backend) -> Kernel:
        """The same kernel, its sums run by this backend ("auto", "dense", "tiled" or "keops")."""

    @abstractmethod
    def backends(self, count: int, device: torch.device) -> set[str]:
        """What runs sums between so many points."""

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        """K(x_i, y_j) as one matrix: (M, n), (N, n) -> (M n, N n)."""
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        return self.gram(x, eye.expand(len(x), -1, -1), y, eye.expand(len(y), -1, -1))

    def __add__(self, other: Kernel) -> Kernel:
        return SumKernel([self, other])


def check_kernel(kernel: object, dim: int, name: str) -> None:
    """Raise InputError unless it is a kernel that acts on vectors of ``dim`` coordinates."""
    if not isinstance(kernel, Kernel):
        expected = "a kernel such as dc.Gaussian(lengthscale)"
        raise InputError(sentence(f"`{name}`", expected=expected, got=repr(kernel)))
    kernel.check(dim, name)


class RadialKernel(Kernel):
    """kappa(|F(x) - F(x')|^2) L L^T.

    Args:
        profile: the radial profile kappa.
        lengthscale: scalar or one positive value per column of the feature map (ARD).
        variance: output matrix A: a positive scalar (A = variance I), one non-negative value per
            coordinate (A = diag), or with ``output`` a scalar.
        periodic: one flag for all coordinates, or one per coordinate (True: angle in rad).
        columns: the coordinates that the profile sees; all of them by default.
        output: if given, the field has this component only (A = variance e e^T).
    """

    def __init__(
        self,
        profile: Profile,
        *,
        lengthscale: object = 1.0,
        variance: object = 1.0,
        periodic: bool | Sequence[bool] = False,
        columns: Sequence[int] | None = None,
        output: int | None = None,
    ) -> None:
        self.profile = profile
        self.lengthscale = positive(lengthscale, "lengthscale", _scalar_or_vector(lengthscale))
        self.variance = _non_negative(variance)
        self.periodic = periodic if isinstance(periodic, bool) else tuple(bool(p) for p in periodic)
        self.columns = None if columns is None else tuple(int(c) for c in columns)
        self.output = output
        self.backend: Backend = "auto"
        self._maps: dict[int, FeatureMap] = {}
        if output is not None and self.variance.ndim:
            raise InputError(
                sentence("`variance` of a kernel with one output", expected="a scalar", got=tuple(self.variance.shape))
            )

    def __repr__(self) -> str:
        name = type(self.profile).__name__.removesuffix("Profile")
        return (
            f"{name}(lengthscale={self.lengthscale.tolist()}, variance={self.variance.tolist()}, output={self.output})"
        )

    def check(self, dim: int, name: str) -> None:
        """Raise InputError unless the kernel acts on vectors of ``dim`` coordinates."""
        sizes = [] if isinstance(self.periodic, bool) else [len(self.periodic)]
        sizes += [self.variance.numel()] if self.variance.ndim else []
        out_of_range = [c for c in (*(self.columns or ()), self.output or 0) if not 0 <= c < dim]
        if any(s != dim for s in sizes) or out_of_range:
            raise InputError(
                sentence(
                    f"`{name}`",
                    expected=f"a kernel on {dim} coordinates",
                    got=repr(self),
                    fix="match the number of joints or task coordinates",
                )
            )
        self._features(dim)

    def using(self, backend: Backend) -> RadialKernel:
        """The same kernel, its sums run by this backend."""
        other = copy(self)
        other.backend = check_backend(backend)
        return other

    def _rests(self, a: Tensor) -> bool:
        """Whether momenta (N, ...) make no field at all: a fit starts there, and its sums need not be run."""
        return self.vanishes or not (a.requires_grad or bool(a.any()))

    def backends(self, count: int, device: torch.device) -> set[str]:
        """What runs sums between so many points."""
        return {door.choose(self.backend, count, count, device)}

    def _run(self, formula: Formula, rows: Points, columns: Points) -> tuple[Tensor, ...]:
        return door.run(formula, self.profile, rows, columns, self.backend)

    def _features(self, dim: int) -> FeatureMap:
        if dim not in self._maps:
            periodic = (self.periodic,) * dim if isinstance(self.periodic, bool) else self.periodic
            columns = tuple(range(dim)) if self.columns is None else self.columns
            self._maps[dim] = FeatureMap(columns, tuple(periodic[c] for c in columns), self.lengthscale)
        return self._maps[dim]

    def _amplitude(self, like: Tensor) -> Tensor:
        return (self.variance.sqrt() if self.variance.requires_grad else self._fixed_amplitude).to(like)

    @cached_property
    def _fixed_amplitude(self) -> Tensor:
        return self.variance.sqrt()

    @cached_property
    def vanishes(self) -> bool:
        """Whether the kernel is zero: its sums need not be run."""
        return not self.variance.requires_grad and not bool(self.variance.any())

    def _reduce(self, a: Tensor) -> Tensor:
        """L^T a on the last axis: (..., n) -> (..., r)."""
        scaled = a * self._amplitude(a)
        return scaled if self.output is None else scaled[..., self.output : self.output + 1]

    def _expand(self, u: Tensor, dim: int) -> Tensor:
        """L u on the last axis: (..., r) -> (..., n)."""
        scaled = u * self._amplitude(u)
        if self.output is None:
            return scaled
        return torch.nn.functional.pad(scaled, (self.output, dim - 1 - self.output))

    def field(self, x: Tensor, q: Tensor, a: Tensor) -> Tensor:
        """v(x) = sum_j K(x, q_j) a_j: (M, n); several fields at once with (N, k, n) -> (M, k, n)."""
        if self._rests(a):
            return a.new_zeros(len(x), *a.shape[1:])
        features = self._features(x.shape[-1])
        u = self._reduce(a)
        columns = Points(features.lift(q), u.flatten(1))
        (v,) = self._run(FIELD, columns if x is q else Points(features.lift(x)), columns)
        v = v.unflatten(1, u.shape[1:])
        return self._expand(v, x.shape[-1])

    def field_and_jacobian(self, x: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """v(x) (M, n) and Dv(x) (M, n, n)."""
        if self._rests(a):
            return torch.zeros_like(x), x.new_zeros(*x.shape, x.shape[-1])
        features = self._features(x.shape[-1])
        columns = Points(features.lift(q), self._reduce(a))
        rows = columns if x is q else Points(features.lift(x))
        v, slope = self._run(FIELD_AND_JACOBIAN, rows, columns)
        dv = features.pull(x[:, None, :], slope)  # (M, r, D) -> (M, r, n)
        return self._expand(v, x.shape[-1]), self._expand(dv.mT, x.shape[-1]).mT

    def gradient(self, x: Tensor, c: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of sum_ij c_i^T K(x_i, q_j) a_j in c and in x: (M, n) each."""
        if self._rests(a):
            return torch.zeros_like(x), torch.zeros_like(x)
        features = self._features(x.shape[-1])
        columns = Points(features.lift(q), self._reduce(a))
        same = x is q and c is a
        v, g = self._run(GRADIENT, columns if same else Points(features.lift(x), self._reduce(c)), columns)
        return self._expand(v, x.shape[-1]), features.pull(x, g)

    def hessian_product(self, q: Tensor, a: Tensor, dq: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        """Derivative of H's gradient along (dq, da): (N, n) each."""
        if self.vanishes:
            return torch.zeros_like(q), torch.zeros_like(q)
        features = self._features(q.shape[-1])
        points = Points(features.lift(q), self._reduce(a), features.push(q, dq), self._reduce(da))
        dv, dg, g = self._run(HESSIAN_PRODUCT, points, points)
        return self._expand(dv, q.shape[-1]), features.pull(q, dg) + features.pull_derivative(q, dq, g)

    def gram(self, x: Tensor, left: Tensor, y: Tensor, right: Tensor) -> Tensor:
        """Blocks left_i K(x_i, y_j) right_j^T: (M k, N l)."""
        if self.vanishes:
            return left.new_zeros(len(x) * left.shape[1], len(y) * right.shape[1])
        lift = self._features(x.shape[-1]).lift
        kappa = door.profile_matrix(self.profile, lift(x), lift(y))
        left, right = self._reduce(left), self._reduce(right)  # (M, k, r), (N, l, r)
        out = left.flatten(0, 1) @ right.flatten(0, 1).T  # (M k, r) @ (r, N l)
        blocks, kappa = out.view(len(x), left.shape[1], len(y), right.shape[1]), kappa[:, None, :, None]
        if out.requires_grad or kappa.requires_grad:
            return (blocks * kappa).reshape(out.shape)
        blocks.mul_(kappa)  # the largest matrix of a fit: no second copy
        return out

    def diagonal(self, x: Tensor, y: Tensor) -> Iterator[tuple[int, Tensor]]:
        """The components k whose K(x_i, y_j)_kk is not zero, and those (N, M); differentiable by autograd."""
        if self.vanishes:
            return
        n = x.shape[-1]
        lift = self._features(n).lift
        kappa = door.profile_matrix(self.profile, lift(y), lift(x))
        variances = self.variance.to(x).expand(n)
        for component in range(n) if self.output is None else (self.output,):
            yield component, variances[component] * kappa

    def inner(self, x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
        """sum_ijk weights_ikj K(x_i, y_j)_kk: scalar."""
        lift = self._features(x.shape[-1]).lift
        kappa = door.profile_matrix(self.profile, lift(x), lift(y))
        if self.output is not None:
            return self.variance * (weights[:, self.output] * kappa).sum()
        if not self.variance.ndim:
            return self.variance * (weights.sum(1) * kappa).sum()
        return (torch.einsum("k,ikj->ij", self.variance, weights) * kappa).sum()


class SumKernel(Kernel):
    """The sum of kernels: their fields superpose."""

    def __init__(self, terms: Sequence[Kernel]) -> None:
        if not terms:
            raise InputError(sentence("a sum of kernels", expected="at least one term", got=0))
        self.terms: tuple[Kernel, ...] = tuple(
            t for k in terms for t in (k.terms if isinstance(k, SumKernel) else (k,))
        )

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.terms))

    def check(self, dim: int, name: str) -> None:
        """Raise InputError unless every term acts on vectors of ``dim`` coordinates."""
        for term in self.terms:
            term.check(dim, name)

    def using(self, backend: Backend) -> SumKernel:
        """The same kernel, its sums run by this backend."""
        return SumKernel([term.using(backend) for term in self.terms])

    def backends(self, count: int, device: torch.device) -> set[str]:
        """What runs sums between so many points."""
        return set().union(*(term.backends(count, device) for term in self.terms))

    def field(self, x: Tensor, q: Tensor, a: Tensor) -> Tensor:
        """v(x) (M, n)."""
        return _total(t.field(x, q, a) for t in self.terms)

    def field_and_jacobian(self, x: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """v(x) (M, n) and Dv(x) (M, n, n)."""
        return _total_pair(t.field_and_jacobian(x, q, a) for t in self.terms)

    def gradient(self, x: Tensor, c: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of sum_ij c_i^T K(x_i, q_j) a_j in c and in x: (M, n) each."""
        return _total_pair(t.gradient(x, c, q, a) for t in self.terms)

    def hessian_product(self, q: Tensor, a: Tensor, dq: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        """Derivative of H's gradient along (dq, da): (N, n) each."""
        return _total_pair(t.hessian_product(q, a, dq, da) for t in self.terms)

    def gram(self, x: Tensor, left: Tensor, y: Tensor, right: Tensor) -> Tensor:
        """Blocks left_i K(x_i, y_j) right_j^T: (M k, N l)."""
        if len(self.terms) == 1 or not all(isinstance(t, RadialKernel) for t in self.terms):
            return _total(t.gram(x, left, y, right) for t in self.terms)
        # All K(x_i, y_j) are diagonal: their sum first, then one product per y_j instead of a matrix per term.
        (M, k, n), (N, r, _) = left.shape, right.shape
        diagonals = [x.new_zeros(N, M)] * n
        for term in self.terms:
            for component, values in term.diagonal(x, y) if isinstance(term, RadialKernel) else ():
                diagonals[component] = diagonals[component] + values
        spread = torch.stack([(d[..., None] * left[..., c]).reshape(-1, M * k) for c, d in enumerate(diagonals)], 1)
        return (right @ spread).view(N * r, M * k).T

    def inner(self, x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
        """sum_ijk weights_ikj K(x_i, y_j)_kk: scalar."""
        return _total(t.inner(x, y, weights) for t in self.terms)


def Gaussian(lengthscale: object = 1.0, variance: object = 1.0, *, space: Space | None = None) -> RadialKernel:
    """variance exp(-|F - F'|^2 / 2); on lines exp(-|x - x'|^2 / (2 lengthscale^2)).

    Args:
        lengthscale: scalar or one per coordinate (ARD); unit of the coordinate (m, rad); on a
            circle a pure number, concentration = lengthscale^-2.
        variance: squared amplitude of the field, (unit of the field)^2; scalar or one per coordinate.
        space: lines and circles; all lines by default.
    """
    return _scalar_kernel(GaussianProfile(), lengthscale, variance, space)


def Matern(
    lengthscale: object = 1.0, nu: float = 2.5, variance: object = 1.0, *, space: Space | None = None
) -> RadialKernel:
    """Matern kernel with nu = 1.5, 2.5 or 3.5; arguments as :func:`Gaussian`."""
    return _scalar_kernel(MaternProfile(nu), lengthscale, variance, space)


def Cauchy(lengthscale: object = 1.0, variance: object = 1.0, *, space: Space | None = None) -> RadialKernel:
    """variance / (1 + |F - F'|^2); arguments as :func:`Gaussian`."""
    return _scalar_kernel(CauchyProfile(), lengthscale, variance, space)


def Constant(variance: object = 1.0) -> RadialKernel:
    """K = variance: one common translation of all points (a constant joint offset)."""
    return _scalar_kernel(ConstantProfile(), 1.0, variance, None)


def VonMises(concentration: object = 1.0, variance: object = 1.0) -> RadialKernel:
    """variance exp(sum_l b_l (cos(x_l - x'_l) - 1)) on a torus (paper section 5).

    Args:
        concentration: b, scalar or one positive value per joint.
        variance: squared amplitude in rad^2; scalar or one per joint.
    """
    b = positive(concentration, "concentration", _scalar_or_vector(concentration))
    return RadialKernel(GaussianProfile(), lengthscale=b.rsqrt(), variance=variance, periodic=True)


def PerJoint(lengthscale: object, variance: object, space: Space, profile: Profile | None = None) -> SumKernel:
    """diag_l(variance_l kappa(|F_l(x_l) - F_l(x'_l)|^2)): each joint's own error, seen by that joint alone.

    Args:
        lengthscale: (n,) one per joint; on circles concentration = lengthscale^-2.
        variance: (n,) squared amplitudes, rad^2 (m^2 for a prismatic joint).
        space: the joint space, n coordinates.
        profile: Gaussian by default (von Mises on circles).
    """
    scales = positive(lengthscale, "lengthscale", (space.dim,))
    variances = as_tensor(variance, "variance", (space.dim,))
    return SumKernel(
        [
            RadialKernel(
                profile or GaussianProfile(),
                lengthscale=scales[joint],
                variance=variances[joint],
                periodic=space.periodic,
                columns=[joint],
                output=joint,
            )
            for joint in range(space.dim)
        ]
    )


def _scalar_kernel(profile: Profile, lengthscale: object, variance: object, space: Space | None) -> RadialKernel:
    periodic: bool | tuple[bool, ...] = False if space is None else space.periodic
    return RadialKernel(profile, lengthscale=lengthscale, variance=variance, periodic=periodic)


def _scalar_or_vector(value: object) -> tuple[str, ...]:
    if isinstance(value, Tensor):
        return ("n",) * min(value.ndim, 1)
    return ("n",) if isinstance(value, Sequence) or getattr(value, "ndim", 0) else ()


def _non_negative(variance: object) -> Tensor:
    tensor = as_tensor(variance, "variance", _scalar_or_vector(variance))
    if bool((tensor < 0).any()):
        raise InputError(sentence("`variance`", expected="non-negative numbers", got=tensor.detach().tolist()))
    return tensor


def _total(parts: Iterable[Tensor]) -> Tensor:
    return reduce(torch.add, parts)


def _total_pair(pairs: Iterable[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    return reduce(lambda total, part: (total[0] + part[0], total[1] + part[1]), pairs)
