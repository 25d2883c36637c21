"""Likelihood ratios of changes, and how often chance alone makes them as large (parametric bootstrap)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.maps.noise import Noise

DRAWS = 2000
NOISE_FACTORS = 0.4 * 30.0 ** (torch.arange(12, dtype=torch.float64, device="cpu") / 11)
"""Factors 0.4 to 12 on the variance of the noise: another device, another day."""
SIZES = 0.03 * 1e4 ** (torch.arange(25, dtype=torch.float64, device="cpu") / 24)
"""Variances 0.03 to 300 of a change, relative to the old variance of its part."""


class Ratio(NamedTuple):
    """The likelihood ratio of one part.

    Args:
        value: 2 log of the ratio. probability: that chance makes the largest ratio of all parts as large.
        variance: likeliest variance of the change, relative to the old variance of its part.
    """

    value: float
    probability: float
    variance: float

    def least_certain(self, other: Ratio) -> Ratio:
        """This ratio with the larger probability, and the smaller value, of both."""
        return Ratio(min(self.value, other.value), max(self.probability, other.probability), self.variance)


def likelihood_ratios(
    rows: NewRows, base: Tensor, roots: dict[str, Tensor], seed: int
) -> tuple[dict[str, Ratio], float]:
    """Ratios of all parts.

    Args:
        rows: the new rows. base: (M m, M m) covariance without noise and without further changes, m^2.
        roots: name -> (M, m, c) columns of each part's covariance, m. seed: of the samples.

    Returns:
        name -> ratio, and the likeliest standard deviation of the noise without a change, relative to that of the rows.
    """
    R = Noise(rows.weighted_noise).add_to(torch.zeros_like(base))
    seen = rows.noise_model.coordinates(rows.y).flatten()  # what was not measured has no noise whose level may change
    R, base, residual = R[seen][:, seen], base[seen][:, seen], rows.residual.flatten()[seen, None]
    factors = NOISE_FACTORS.to(base)
    likeliest = factors[int(torch.stack([_Density(base + f * R, residual).plain for f in factors]).argmax())]
    draws = torch.randn(len(R), DRAWS, generator=seeded(seed), dtype=base.dtype, device=HOST).to(base.device)
    samples = torch.cat([residual, torch.linalg.cholesky(base + likeliest * R) @ draws], 1)
    densities = [_Density(base + f * R, samples) for f in factors]
    without = torch.stack([density.plain for density in densities]).amax(0)
    ratios, variances = {}, {}
    for name, root in roots.items():
        changed = [density.with_change(root.flatten(0, 1)[seen]) for density in densities]
        best = torch.stack([value for value, _ in changed])
        ratios[name] = 2.0 * (best.amax(0) - without)
        variances[name] = changed[int(best[:, 0].argmax())][1]
    largest = torch.stack(list(ratios.values())).amax(0)[1:]
    found = {}
    for name, values in ratios.items():
        value = float(values[0])
        found[name] = Ratio(value, (1 + int((largest >= value).sum())) / (1 + DRAWS), variances[name])
    return found, float(likeliest.sqrt())


class _Density:
    """Log densities of samples (M m, k) under a covariance, but for a constant.

    Attributes:
        plain: (k,) under the covariance itself.
    """

    def __init__(self, covariance: Tensor, samples: Tensor) -> None:
        self.factor = torch.linalg.cholesky(covariance)
        self.white = torch.linalg.solve_triangular(self.factor, samples, upper=False)
        self.plain = -0.5 * self.white.square().sum(0) - self.factor.diagonal().log().sum()

    def with_change(self, root: Tensor) -> tuple[Tensor, float]:
        """The largest density (k,) with a change of any size, and the likeliest size for the first sample.

        Args:
            root: (M m, c) columns of the change's covariance.
        """
        U, s, _ = torch.linalg.svd(torch.linalg.solve_triangular(self.factor, root, upper=False), full_matrices=False)
        scaled = SIZES.to(s)[:, None] * s.square()  # (sizes, c)
        gain = 0.5 * (scaled / (1.0 + scaled) @ (U.T @ self.white).square() - scaled.log1p().sum(1)[:, None])
        return self.plain + gain.amax(0), float(SIZES[int(gain[:, 0].argmax())])
