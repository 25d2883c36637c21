"""Periodic errors of single joints at one frequency, such as those of a reduction gear at multiples of its ratio.

    K(x, x') = a^2 cos(w (x_l - x'_l)) e_l e_l^T,    v_l(x) = a^2 (C cos w x_l + S sin w x_l)

with C = sum_j cos(w q_jl) a_jl and S = sum_j sin(w q_jl) a_jl: a kernel of rank two, whose sums need no pairs of points.
The joint's value is taken on a line, not on a circle, so that w need not be an integer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kernels.base import DiagonalKernel, Kernel
from diffeo_calib.kernels.blocks import component_gram
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.runtime.waves import PROFILE


class HarmonicKernel(DiagonalKernel):
    """a^2 cos(w (x_l - x'_l)) e_l e_l^T.

    Args:
        joint: l, the coordinate that the field depends on and moves.
        frequency: w, rad per unit of the coordinate; for an angle, periods per turn.
        variance: a^2, squared amplitude, (unit of the coordinate)^2.

    Raises:
        InputError: a negative joint number, a frequency that is not positive, or a negative variance.
    """

    def __init__(self, joint: int, frequency: float, variance: object = 1.0) -> None:
        self.joint, self.frequency = int(joint), float(frequency)
        self.variance = as_tensor(variance, "variance", ())
        if self.joint < 0:
            raise InputError.of("`joint` of a harmonic kernel", expected="0 or more", got=joint)
        if not (isfinite(self.frequency) and self.frequency > 0):
            raise InputError.of("`frequency` of a harmonic kernel", expected="a positive number", got=frequency)
        if bool(self.variance < 0):
            raise InputError.of("`variance`", expected="a non-negative number", got=float(self.variance))

    def __repr__(self) -> str:
        return f"Harmonic(joint={self.joint}, frequency={self.frequency}, variance={float(self.variance)})"

    def check(self, dim: int, name: str) -> None:
        """Raise InputError unless the kernel acts on vectors of ``dim`` coordinates."""
        if self.joint >= dim:
            raise InputError.of(f"`{name}`", expected=f"a kernel on {dim} coordinates", got=as_written(self))

    def scaled(self, factor: float) -> HarmonicKernel:
        """The kernel factor * K, factor > 0."""
        return HarmonicKernel(self.joint, self.frequency, factor * self.variance)

    def backends(self, count: int, device: torch.device) -> set[str]:
        """None: there are no sums over pairs of points."""
        return set()

    def to_config(self) -> dict[str, Any]:
        """The constructor's arguments as JSON values, and the name of the kernel."""
        variance = float(self.variance.detach())
        return {"profile": PROFILE, "joint": self.joint, "frequency": self.frequency, "variance": variance}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> HarmonicKernel:
        """The inverse of :meth:`to_config`."""
        return cls(**{name: value for name, value in config.items() if name != "profile"})

    def coefficients(self, q: Tensor, a: Tensor) -> Tensor:
        """(C, S) of the module's docstring times a^2, so that v_l = C cos w x_l + S sin w x_l.

        Args:
            q: (N, n) control points. a: (N, n) or (N, k, n) momenta.

        Returns:
            (2,) or (2, k), in the unit of the coordinate.
        """
        return self.variance.to(q) * (self._waves(q).mT @ a[..., self.joint])

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        """K(x_i, y_j) as one matrix: (M, n), (N, n) -> (M n, N n)."""
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        return self.gram(x, eye.expand(len(x), -1, -1), y, eye.expand(len(y), -1, -1))

    def field(self, x: Tensor | None, q: Tensor, a: Tensor) -> Tensor:
        """v(x) (M, n); several fields at once with (N, k, n) -> (M, k, n)."""
        return self._expand(self._waves(q if x is None else x) @ self.coefficients(q, a), q.shape[-1])

    def field_and_jacobian(self, x: Tensor | None, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """v(x) (M, n) and Dv(x) (M, n, n)."""
        x, n, both = (q if x is None else x), q.shape[-1], self.coefficients(q, a)
        slope = self._expand(self._slopes(x) @ both, n)
        return self._expand(self._waves(x) @ both, n), torch.diag_embed(slope)

    def gradient(self, x: Tensor, c: Tensor, q: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of sum_ij c_i^T K(x_i, q_j) a_j in c and in x: (M, n) each."""
        both, n = self.coefficients(q, a), q.shape[-1]
        slope = c[:, self.joint] * (self._slopes(x) @ both)
        return self._expand(self._waves(x) @ both, n), self._expand(slope, n)

    def hessian_product(self, q: Tensor, a: Tensor, dq: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        """Derivative of H's gradient along (dq, da): (N, n) each."""
        n, u, du, turn = q.shape[-1], a[:, self.joint], da[:, self.joint], dq[:, self.joint]
        waves, slopes, both = self._waves(q), self._slopes(q), self.coefficients(q, a)
        change = self.coefficients(q, da) + self.variance.to(q) * (slopes.mT @ (turn * u))
        dv = turn * (slopes @ both) + waves @ change
        bend = -(self.frequency**2) * turn * (waves @ both) + slopes @ change  # derivative of v'
        return self._expand(dv, n), self._expand(du * (slopes @ both) + u * bend, n)

    def gram(self, x: Tensor, left: Tensor, y: Tensor, right: Tensor) -> Tensor:
        """Blocks left_i K(x_i, y_j) right_j^T: (M k, N l); arguments as :meth:`Kernel.gram`."""
        return component_gram(self.diagonal(x, y), left, right)

    def own_blocks(self, x: Tensor, effect: Tensor) -> Tensor:
        """The blocks of effect K(x, x) effect^T on its diagonal: (N, k, k); arguments as :meth:`Kernel.own_blocks`."""
        (N, k, _), n = effect.shape, x.shape[1]
        own = effect.reshape(N, k, -1, n)[..., self.joint]  # (N, k, Q)
        half = own @ self._waves(x).view(N, -1, 2)
        return self.variance.to(x) * half @ half.mT

    def diagonal(self, x: Tensor, y: Tensor) -> Iterator[tuple[int, Tensor]]:
        """Yield the joint and a^2 cos(w (x_i - y_j)) as a matrix (N, M)."""
        yield self.joint, self.variance.to(x) * self._waves(y) @ self._waves(x).mT

    def inner_by_component(self, x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
        """sum_ijk weights_ikj K(x_i, y_j)_kk for weights (M, n, N): scalar."""
        return self.variance.to(x) * (self._waves(x) * (weights[:, self.joint] @ self._waves(y))).sum()

    def _waves(self, x: Tensor) -> Tensor:
        """cos w x_l, sin w x_l: (M, 2)."""
        angle = self.frequency * x[..., self.joint]
        return torch.stack([angle.cos(), angle.sin()], -1)

    def _slopes(self, x: Tensor) -> Tensor:
        """Their derivatives by x_l: (M, 2)."""
        angle = self.frequency * x[..., self.joint]
        return self.frequency * torch.stack([-angle.sin(), angle.cos()], -1)

    def _expand(self, values: Tensor, n: int) -> Tensor:
        """Values of the joint's component (...) as vectors (..., n)."""
        return torch.nn.functional.pad(values[..., None], (self.joint, n - 1 - self.joint))


def own_joint(kernel: Kernel) -> int | None:
    """The coordinate that a kernel's fields depend on and move, if it is a single one and the same."""
    if isinstance(kernel, HarmonicKernel):
        return kernel.joint
    alone = isinstance(kernel, RadialKernel) and kernel.output is not None and kernel.columns == (kernel.output,)
    return kernel.output if alone else None


def kernel_from_config(config: Mapping[str, Any]) -> RadialKernel | HarmonicKernel:
    """The kernel of this package that a model file describes.

    Raises:
        InputError: an unknown profile.
    """
    kind = HarmonicKernel if config.get("profile") == PROFILE else RadialKernel
    return kind.from_config(config)
