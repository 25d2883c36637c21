"""Radial kernels kappa(|F(x) - F(x')|^2) L L^T: a radial profile, a feature map, an output matrix A = L L^T.

Scalar kernels have L = a I; per-joint amplitudes make L diagonal; a kernel of a single field component l has
L = a e_l. Kernel sums are evaluated by the backends of `reductions`; all derivatives are closed forms.

Shapes: x (M, n) evaluation points; q, a (N, n) control points and their momenta.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, positive, wrapped
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kernels.base import Kernel, SumKernel, check_points, diagonal_gram
from diffeo_calib.kernels.profiles import (
    PROFILES,
    SHIPPED,
    CauchyProfile,
    GaussianProfile,
    MaternProfile,
    Profile,
    check_profile,
    probe,
)
from diffeo_calib.kernels.reductions import backends
from diffeo_calib.kernels.reductions.backends import Backend, check_accuracy, check_backend
from diffeo_calib.kernels.reductions.formulas import (
    FIELD,
    FIELD_AND_JACOBIAN,
    GRADIENT,
    HESSIAN_PRODUCT,
    Formula,
    Points,
)
from diffeo_calib.kernels.spaces import FeatureMap, Space

PROBE = "profile_probe"  # entry of a kernel whose profile is a user's: its values, see :func:`probe`


class RadialKernel(Kernel):
    """kappa(|F(x) - F(x')|^2) L L^T.

    Args:
        profile: the radial profile kappa.
        lengthscale: scalar or one positive value per column of the feature map (ARD).
        variance: output matrix A: a positive scalar (A = variance I), one non-negative value per
            coordinate (A = diag), or with ``output`` a scalar.
        periodic: one flag for all coordinates, or one per coordinate (True: angle in rad).
        columns: the coordinates that the profile depends on; all of them by default.
        output: the only non-zero component of the field (A = variance e e^T), if given.

    Raises:
        InputError: numbers that are no scales, or a profile of your own whose derivatives are not those of its kappa.
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
        check_profile(profile)
        self.profile = profile
        self.lengthscale = positive(lengthscale, "lengthscale", scalar_or_vector(lengthscale))
        self.variance = as_tensor(variance, "variance", scalar_or_vector(variance))
        if bool((self.variance < 0).any()):
            raise InputError.of("`variance`", expected="non-negative numbers", got=self.variance.detach().tolist())
        self.periodic = periodic if isinstance(periodic, bool) else tuple(bool(p) for p in periodic)
        self.columns = None if columns is None else tuple(int(c) for c in columns)
        self.output = output
        self.backend: Backend = "auto"
        self.accuracy: float | None = None
        self._maps: dict[int, FeatureMap] = {}
        if output is not None and self.variance.ndim:
            raise InputError.of(
                "`variance` of a kernel with one output", expected="a scalar", got=tuple(self.variance.shape)
            )

    def __repr__(self) -> str:
        name = type(self.profile).__name__.removesuffix("Profile")
        return (
            f"{name}(lengthscale={self.lengthscale.tolist()}, variance={self.variance.tolist()}, output={self.output})"
        )

    def check(self, dim: int, name: str) -> None:
        sizes = [] if isinstance(self.periodic, bool) else [len(self.periodic)]
        sizes += [self.variance.numel()] if self.variance.ndim else []
        out_of_range = [c for c in (*(self.columns or ()), self.output or 0) if not 0 <= c < dim]
        if any(s != dim for s in sizes) or out_of_range:
            raise InputError.of(
                f"`{name}`",
                expected=f"a kernel on {dim} coordinates",
                got=as_written(self),
                fix="match the number of joints or task coordinates",
            )
        self._features(dim)

    def using(self, backend: Backend, accuracy: float | None = None) -> RadialKernel:
        other = copy(self)
        other.backend, other.accuracy = check_backend(backend), check_accuracy(accuracy)
        return other

    def _with(self, lengthscale: Tensor, variance: Tensor) -> RadialKernel:
        other = copy(self)
        other.lengthscale, other.variance, other._maps = lengthscale, variance, {}
        for cached in ("_fixed_amplitude", "vanishes"):
            vars(other).pop(cached, None)
        return other

    def scaled(self, factor: float) -> RadialKernel:
        return self._with(self.lengthscale, factor * self.variance)

    @property
    def scales(self) -> int:
        return self.lengthscale.numel() + self.variance.numel()

    def rescaled(self, logs: Tensor) -> RadialKernel:
        lengths, amplitudes = logs.exp().split([self.lengthscale.numel(), self.variance.numel()])
        variance = self.variance * amplitudes.square().view_as(self.variance)
        return self._with(self.lengthscale * lengths.view_as(self.lengthscale), variance)

    def _field_vanishes(self, a: Tensor) -> bool:
        """Whether the field of momenta (N, ...) is zero, as at the start of a fit, so that no sum is needed."""
        return self.vanishes or not (wrapped(a) or a.requires_grad or bool(a.any()))

    def backends(self, count: int, device: torch.device) -> set[str]:
        name = backends.choose(self.backend, count, count, device)
        return {name if self.accuracy is None else f"{name} within {self.accuracy:g}"}

    def to(self, device: torch.device | str) -> RadialKernel:
        return self._with(self.lengthscale.to(device), self.variance.to(device))

    def to_config(self) -> dict[str, Any]:
        """The constructor's arguments as JSON values, the profile by its name, and if it is a user's by some values."""
        probed = {} if type(self.profile) in SHIPPED else {PROBE: probe(self.profile)}
        return probed | {
            "profile": self.profile.name,
            "lengthscale": self.lengthscale.tolist(),
            "variance": self.variance.tolist(),
            "periodic": self.periodic,
            "columns": self.columns,
            "output": self.output,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any], own: Callable[[str], Profile] | None = None) -> RadialKernel:
        """The inverse of :meth:`to_config`.

        Args:
            config: its output.
            own: a user's profile by its name, for one that is not part of the package.

        Raises:
            InputError: an unknown profile.
        """
        arguments = dict(config)
        name, values = arguments.pop("profile"), arguments.pop(PROBE, None)
        if values is None and name in PROFILES:
            return cls(PROFILES[name], **arguments)
        if own is None:
            raise InputError.of("the profile of a kernel", expected=", ".join(PROFILES), got=as_written(name))
        return cls(own(name), **arguments)

    def _sum(self, formula: Formula, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
        return backends.evaluate(formula, self.profile, rows, columns, backend=self.backend, accuracy=self.accuracy)

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
        with torch.inference_mode(False):  # kept, and used in derivatives later
            return self.variance.sqrt()

    @cached_property
    def vanishes(self) -> bool:
        """Whether the kernel is zero, so that no sum is needed."""
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

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        return self.gram(x, eye.expand(len(x), -1, -1), y, eye.expand(len(y), -1, -1))

    def field(self, x: Tensor | None, q: Tensor, a: Tensor) -> Tensor:
        check_points(x, q, a)
        n, rows = q.shape[-1], (q if x is None else x).shape[0]
        if self._field_vanishes(a):
            return a.new_zeros(rows, *a.shape[1:])
        features = self._features(n)
        u = self._reduce(a)
        columns = Points(features.lift(q), u.flatten(1))
        (v,) = self._sum(FIELD, None if x is None else Points(features.lift(x)), columns)
        return self._expand(v.unflatten(1, u.shape[1:]), n)

    def field_and_jacobian(self, x: Tensor | None, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        check_points(x, q, a)
        at, n = (q if x is None else x), q.shape[-1]
        if self._field_vanishes(a):
            return torch.zeros_like(at), at.new_zeros(*at.shape, n)
        features = self._features(n)
        columns = Points(features.lift(q), self._reduce(a))
        v, slope = self._sum(FIELD_AND_JACOBIAN, None if x is None else Points(features.lift(x)), columns)
        dv = features.pull(at[:, None, :], slope)  # (M, r, D) -> (M, r, n)
        return self._expand(v, n), self._expand(dv.mT, n).mT

    def gradient(self, x: Tensor | None, c: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        check_points(x, q, a)
        at, n = (q if x is None else x), q.shape[-1]
        check_points(None, at, c)
        if self._field_vanishes(a):
            return torch.zeros_like(at), torch.zeros_like(at)
        features = self._features(n)
        rows = None if x is None else Points(features.lift(x), self._reduce(c))
        v, g = self._sum(GRADIENT, rows, Points(features.lift(q), self._reduce(a)))
        return self._expand(v, n), features.pull(at, g)

    def hessian_product(self, q: Tensor, a: Tensor, dq: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        check_points(None, q, a)
        check_points(dq, q, da)
        if self.vanishes:
            return torch.zeros_like(q), torch.zeros_like(q)
        features = self._features(q.shape[-1])
        points = Points(features.lift(q), self._reduce(a), features.push(q, dq), self._reduce(da))
        dv, dg, g = self._sum(HESSIAN_PRODUCT, None, points)
        return self._expand(dv, q.shape[-1]), features.pull(q, dg) + features.pull_derivative(q, dq, g)

    def gram(self, x: Tensor, left: Tensor, y: Tensor, right: Tensor) -> Tensor:
        (M, k, n), (N, r, _) = left.shape, right.shape
        if self.vanishes:
            return left.new_zeros(M * k, N * r)
        lift = self._features(n).lift
        kappa = backends.profile_matrix(self.profile, lift(y), lift(x))
        left, right = self._reduce(left), self._reduce(right.reshape(N, r, -1, n)).flatten(2)
        return diagonal_gram(kappa[:, None].expand(-1, left.shape[2], -1), left, right)

    def own_blocks(self, x: Tensor, effect: Tensor) -> Tensor:
        (N, k, _), n = effect.shape, x.shape[1]
        if self.vanishes:
            return effect.new_zeros(N, k, k)
        features = self._features(n).lift(x.view(N, -1, n))  # (N, Q, D)
        kappa = self.profile.derivatives((features[:, :, None] - features[:, None]).square().sum(-1), 0)[0]
        reduced = self._reduce(effect.reshape(N, k, -1, n))  # (N, k, Q, r)
        half = torch.einsum("npq,nkqr->nkpr", kappa, reduced)
        return reduced.flatten(2) @ half.flatten(2).mT

    def diagonal_components(self, x: Tensor, y: Tensor) -> Iterator[tuple[int, Tensor]]:
        if self.vanishes:
            return
        n = x.shape[-1]
        lift = self._features(n).lift
        kappa = backends.profile_matrix(self.profile, lift(y), lift(x))
        variances = self.variance.to(x).expand(n)
        for component in range(n) if self.output is None else (self.output,):
            yield component, variances[component] * kappa


def scalar_or_vector(value: object) -> tuple[str, ...]:
    """Shape pattern for a value that may be one number or a vector of any length."""
    if isinstance(value, Tensor):
        return ("n",) * min(value.ndim, 1)
    return ("n",) if isinstance(value, Sequence) or getattr(value, "ndim", 0) else ()


def Gaussian(lengthscale: object = 1.0, variance: object = 1.0, *, space: Space | None = None) -> RadialKernel:
    """variance exp(-|F - F'|^2 / 2); on lines variance exp(-|x - x'|^2 / (2 lengthscale^2)).

    Args:
        lengthscale: scalar or one per coordinate (ARD), in the unit of the coordinate (m, rad); on a
            circle a pure number, concentration = lengthscale^-2.
        variance: squared amplitude of the field, (unit of the field)^2; scalar or one per coordinate.
        space: which coordinates are lines and which are circles; all lines by default.
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


def VonMises(concentration: object = 1.0, variance: object = 1.0) -> RadialKernel:
    """variance exp(sum_l b_l (cos(x_l - x'_l) - 1)) on a torus (paper section 5).

    Args:
        concentration: b, scalar or one positive value per joint.
        variance: squared amplitude in rad^2; scalar or one per joint.
    """
    b = positive(concentration, "concentration", scalar_or_vector(concentration))
    return RadialKernel(GaussianProfile(), lengthscale=b.rsqrt(), variance=variance, periodic=True)


def PerJoint(lengthscale: object, variance: object, space: Space, profile: Profile | None = None) -> SumKernel:
    """diag_l(variance_l kappa(|F_l(x_l) - F_l(x'_l)|^2)): an error of each joint that depends on that joint alone.

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
