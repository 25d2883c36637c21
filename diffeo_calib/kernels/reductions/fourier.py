"""Sums of smooth kernels by plane waves: O((M + N) P) operations for P waves, instead of O(M N).

A kernel is the Fourier transform of its spectral density S (Bochner). On a lattice of frequencies w with the spacings
h_d = 2 pi / T_d that is a trapezoidal rule,

    kappa(E - F) = sum_w S(w) prod_d h_d cos(w . (E - F)) + error,

and the rows' and columns' waves separate: exp(i w . E) exp(-i w . F). The error has two parts. Frequencies beyond the
lattice are missing; and the rule repeats the kernel with periods T_d, so that points L_d apart see a copy at T_d - L_d
(Poisson's summation). Both are bounded before the sum, for the kernel and for its first two derivatives, and each sum
is checked at some rows afterwards. It pays for few dimensions and length scales that are not much smaller than the
cloud of points.

Source: Barnett, Greengard, Rachh: Uniform approximation of common Gaussian process kernels using equispaced Fourier
grids, Applied and Computational Harmonic Analysis 71 (2024).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import ceil, gamma, pi, prod

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.threads import in_parallel
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import (
    FIELD,
    FIELD_AND_JACOBIAN,
    GRADIENT,
    HESSIAN_PRODUCT,
    Formula,
    Points,
)

MOST_WAVES = 1 << 16  # largest lattice. Beyond it a sum needs more memory and time than it saves at most sizes
WAVE_COST = 0.5  # time of a wave at a point relative to that of a pair of points (measured: 0.2 to 0.5)
POINT_COST = 150.0  # time of a point beside its waves, relative to that of a pair
WAVES_TIMES_POINTS_AT_ONCE = 1 << 20  # waves times points in memory at once
CHECKED_ROWS = 24  # rows and columns at which every lattice is checked
DERIVATIVES = 2  # the highest derivative of the kernel in a formula
STEPS, FARTHEST = 4096, 60.0
GRID = torch.linspace(0.0, FARTHEST, STEPS + 1, dtype=torch.float64, device=HOST)[1:]  # distances, or frequencies


@lru_cache(maxsize=256)
def negligible_beyond(profile: Profile, dim: int, accuracy: float) -> float | None:
    """The distance beyond which the kernel of ``dim`` features and its derivatives are below an accuracy, if any.

    A factor of 3^dim is left for the copies of a kernel on a lattice.
    """
    kappa = profile.derivatives(GRID.square(), DERIVATIVES)
    second = 2 * kappa[1].abs() + 4 * GRID.square() * kappa[2].abs()
    size = torch.stack([kappa[0].abs(), 2 * GRID * kappa[1].abs(), second]).amax(0)
    return _first_below(3.0**dim * size.flip(0).cummax(0).values.flip(0), accuracy)


@lru_cache(maxsize=256)
def bandwidth(profile: Profile, dim: int, accuracy: float) -> float | None:
    """The frequency beyond which the spectral density, with its first two moments, adds up to less than an accuracy."""
    density = profile.spectral_density(GRID.square(), dim)
    if density is None:
        return None
    shell = density * (2.0 * pi ** (dim / 2) / gamma(dim / 2)) * GRID ** (dim - 1) * (FARTHEST / STEPS)
    beyond = torch.stack([shell * GRID**k for k in range(DERIVATIVES + 1)]).flip(1).cumsum(1).flip(1)
    return _first_below(beyond.amax(0), accuracy)


def _first_below(values: Tensor, level: float) -> float | None:
    """Where on the grid decreasing values fall below a level."""
    below = values < level
    return float(GRID[below][0]) if bool(below[-1]) else None


def sums(
    formula: Formula, profile: Profile, rows: Points | None, columns: Points, accuracy: float
) -> tuple[Tensor, ...] | None:
    """The results of a formula within an accuracy; None where pairs take less time, or waves do not reach it.

    The error of a field is at most ``accuracy`` times the sum of the momenta's absolute values; those of its
    derivatives likewise, in features. Arguments as of :meth:`SumBackend.reduce`. Not differentiable by autograd.
    """
    at = columns if rows is None else rows
    m, n = len(at.features), len(columns.features)
    pairs = m * n * (0.5 if rows is None else 1.0)
    if (m + n) * POINT_COST > pairs:
        return None
    low = torch.minimum(at.features.amin(0), columns.features.amin(0))
    extent = torch.maximum(at.features.amax(0), columns.features.amax(0)) - low
    with torch.no_grad():
        waves = Lattice.of(profile, extent, accuracy)
        if waves is None or (m + n) * (POINT_COST + WAVE_COST * waves.size) > pairs:
            return None
        count = min(CHECKED_ROWS, m, n)
        steps = torch.arange(count, device=low.device, dtype=torch.int64)
        apart = at.features[steps * (m - 1) // count, None] - columns.features[steps * (n - 1) // count]
        # the kernel's copies are nearest at the largest possible difference
        apart = torch.cat([apart.flatten(0, 1), extent[None], -extent[None], 0 * extent[None]])
        return None if waves.error(profile, apart) > accuracy else RESULTS[formula](waves, at, columns)


class Lattice:
    """Plane waves that reproduce a kernel between points of two clouds.

    Args:
        axes: frequencies along every dimension; along the first one from 0 on, since the others follow by symmetry.
        profile: the kernel, one with a spectral density.
    """

    def __init__(self, axes: Sequence[Tensor], profile: Profile) -> None:
        self.axes = axes
        self.frequencies = torch.stack([w.flatten() for w in torch.meshgrid(*axes, indexing="ij")], -1)  # (P, D)
        cell = torch.stack([axis[-1] - axis[-2] for axis in axes]).prod()
        twice = 1.0 + (self.frequencies[:, 0] > 0).to(cell)
        density = profile.spectral_density(self.frequencies.square().sum(-1), len(axes))
        self.weights = cell * twice if density is None else density * cell * twice  # (P,)

    @classmethod
    def of(cls, profile: Profile, extent: Tensor, accuracy: float) -> Lattice | None:
        """The lattice for points at most ``extent`` (D,) apart; None where it would be too large."""
        dim, half = len(extent), 0.5 * accuracy
        distance, highest = negligible_beyond(profile, dim, half), bandwidth(profile, dim, half)
        if distance is None or highest is None:
            return None
        spacings = 2.0 * pi / (extent + distance)
        counts = [ceil(highest / h) for h in spacings.tolist()]
        if (counts[0] + 1) * prod(2 * n + 1 for n in counts[1:]) > MOST_WAVES:
            return None
        ranges = zip([0] + [-n for n in counts[1:]], counts, strict=True)
        numbers = [torch.arange(low, high + 1, dtype=extent.dtype, device=extent.device) for low, high in ranges]
        return cls([h * k for h, k in zip(spacings, numbers, strict=True)], profile)

    @property
    def size(self) -> int:
        """Number of waves P."""
        return len(self.weights)

    def coefficients(self, at: Tensor, b: Tensor) -> Tensor:
        """sum_j exp(-i w . F_j) b_j for F (N, D), b (N, k): (P, k) complex."""
        count, k = len(self.axes[0]), b.shape[1]

        def part(rows: slice) -> Tensor:
            first, rest = self._waves(at[rows])
            return rest.mH @ (first.conj()[:, :, None] * b[rows][:, None]).flatten(1)  # (P / P1, P1 k)

        total = b.new_zeros(self.size // count, count * k, dtype=torch.complex(b[:1], b[:1]).dtype)
        for chunk in in_parallel(part, self._chunks(len(at))):
            total += chunk
        return total.view(-1, count, k).transpose(0, 1).reshape(-1, k)

    def values(self, at: Tensor, grid: Tensor) -> Tensor:
        """Re sum_w weight_w exp(i w . E_i) grid_w for E (M, D), grid (P, k): (M, k)."""
        count, k = len(self.axes[0]), grid.shape[1]
        weighted = (self.weights[:, None] * grid).view(count, -1, k).transpose(0, 1).reshape(-1, count * k)

        def part(rows: slice) -> Tensor:
            first, rest = self._waves(at[rows])
            return torch.einsum("ma,mak->mk", first, (rest @ weighted).view(-1, count, k)).real

        return torch.cat(list(in_parallel(part, self._chunks(len(at)))))

    def slopes(self, grid: Tensor) -> Tensor:
        """The grid of the gradient of a sum whose grid is (P, k): (P, k, D)."""
        return 1j * grid[:, :, None] * self.frequencies[:, None]

    def error(self, profile: Profile, apart: Tensor) -> float:
        """Largest error of kernel and gradient for differences (K, D) of points."""
        origin, unit = torch.zeros_like(apart[:1]), torch.ones_like(apart[:1, :1])
        values, slopes = _with_slopes(self, apart, self.coefficients(origin, unit))
        kappa = profile.derivatives(apart.square().sum(-1, keepdim=True), 1)
        return float(torch.cat([values - kappa[0], slopes[:, 0] - 2.0 * kappa[1] * apart], 1).abs().max())

    def _waves(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """exp(i w . E) along the first dimension, and along all others together: (M, P1), (M, P / P1)."""
        phases = [at[:, d, None] * axis for d, axis in enumerate(self.axes)]
        first, *others = [torch.polar(torch.ones_like(phase), phase) for phase in phases]
        rest = torch.ones_like(first[:, :1])
        for waves in others:
            rest = (rest[:, :, None] * waves[:, None]).flatten(1)
        return first, rest

    def _chunks(self, count: int) -> list[slice]:
        size = max(1, WAVES_TIMES_POINTS_AT_ONCE // max(self.size // len(self.axes[0]), len(self.axes[0])))
        return [slice(k, min(k + size, count)) for k in range(0, count, size)] or [slice(0, 0)]


def _gradient(waves: Lattice, i: Points, j: Points) -> tuple[Tensor, ...]:
    v, slopes = RESULTS[FIELD_AND_JACOBIAN](waves, i, j)
    return v, torch.einsum("mr,mrd->md", i.momenta, slopes)


def _hessian_product(waves: Lattice, i: Points, j: Points) -> tuple[Tensor, ...]:
    r, d = j.momenta.shape[1], j.features.shape[1]
    moved = (j.momenta[:, :, None] * j.d_features[:, None]).flatten(1)  # (N, r D)
    grids = waves.coefficients(j.features, torch.cat([j.momenta, j.d_momenta, moved], 1))
    grid, changed, moved_grid = grids.split([r, r, r * d], 1)
    d_grid = changed - 1j * (moved_grid.view(-1, r, d) * waves.frequencies[:, None]).sum(-1)
    values, slopes = _with_slopes(waves, i.features, torch.cat([d_grid, waves.slopes(grid).flatten(1)], 1))
    slope, bent = values[:, r:].unflatten(1, (r, d)), slopes[:, r:].unflatten(1, (r, d))
    dv = values[:, :r] + torch.einsum("mrd,md->mr", slope, i.d_features)
    d_slope = slopes[:, :r] + torch.einsum("mrde,me->mrd", bent, i.d_features)
    dg = torch.einsum("mr,mrd->md", i.d_momenta, slope) + torch.einsum("mr,mrd->md", i.momenta, d_slope)
    return dv, dg, torch.einsum("mr,mrd->md", i.momenta, slope)


def _with_slopes(waves: Lattice, at: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    r = grid.shape[1]
    columns = waves.values(at, torch.cat([grid, waves.slopes(grid).flatten(1)], 1))
    return columns[:, :r], columns[:, r:].unflatten(1, (r, at.shape[1]))


RESULTS: dict[Formula, Callable[[Lattice, Points, Points], tuple[Tensor, ...]]] = {
    FIELD: lambda waves, i, j: (waves.values(i.features, waves.coefficients(j.features, j.momenta)),),
    FIELD_AND_JACOBIAN: lambda waves, i, j: _with_slopes(waves, i.features, waves.coefficients(j.features, j.momenta)),
    GRADIENT: _gradient,
    HESSIAN_PRODUCT: _hessian_product,
}
"""The results of every formula, from waves."""
