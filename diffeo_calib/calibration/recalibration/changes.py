"""What has changed since a robot was calibrated: likelihood ratios for every joint, for its load and its geometry.

The residuals r of new rows are N(0, K_0) if only device and markers have moved; if part k has changed, too, they are
N(0, K_0 + s^2 G_k), with G_k the covariance of that part in the old model and s^2 the variance of the change relative
to it. The noise may have changed by a factor f. Part k is named if

    LR_k = 2 max_{s, f} log N(r; 0, K_0(f) + s^2 G_k) - 2 max_f log N(r; 0, K_0(f))

is larger than for all but 1 % of samples from K_0, in each of which the largest ratio of all parts counts and s and f
are found anew. Rows are weighted twice, as if everything might have changed and as if nothing had, so that neither a
change counts as outliers nor outliers as a change; the larger probability counts. What was named may then drift, and
the test is repeated for the rest. Rows outside the joint ranges of the old rows take no part: errors there are
extrapolation, not change.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.recalibration.changed_parts import ChangedPart, Transmission, parts_of
from diffeo_calib.calibration.recalibration.likelihood_ratios import Ratio, likelihood_ratios
from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.maps.noise import Noise

LEVEL = 0.01
"""Probability that anything is named although nothing has changed."""
FEWEST_ROWS = 5
RANGE_MARGIN = 0.02
"""Rows may lie outside of the old joint ranges by this share of them."""


@dataclass(frozen=True)
class Change:
    """Something that has changed.

    Args:
        part: name of the joint, "gravity" or "geometry".
        size: RMS of the change over the new rows: rad or m of a joint, m of the markers for other parts.
        angle: whether the size is in rad.
        displacement: RMS displacement of the markers by it, m.
        probability: that chance makes any likelihood ratio as large.
    """

    part: str
    size: float
    angle: bool
    displacement: float
    probability: float

    def __str__(self) -> str:
        size = f"{1e3 * self.size:.2g} mm"
        if self.angle:
            size = f"{1e3 * self.size:.2g} mrad ({degrees(self.size):.2g} degrees)"
        by = f", which moves the markers by {1e3 * self.displacement:.2g} mm" if self.angle else ""
        return f"{self.part} has changed by {size}{by} (by chance with a probability of at most {self.probability:.2g})"


@dataclass(frozen=True)
class Changes:
    """What has changed, the clearest first.

    Args:
        found: the changes.
        probabilities: name of every part -> that chance makes any likelihood ratio as large as this part's.
        noise: standard deviation of the new rows' noise relative to that of the old rows.
        rows: number of rows that were tested: those within the old joint ranges.
        level: probability of a false alarm; None if nothing was tested on request.
    """

    found: tuple[Change, ...]
    probabilities: dict[str, float]
    noise: float
    rows: int
    level: float | None

    @classmethod
    def untested(cls) -> Changes:
        """No test was wanted."""
        return cls((), {}, 1.0, 0, None)

    def __str__(self) -> str:
        if self.level is None:
            return "changes of the robot were not tested"
        if not self.probabilities:
            return f"only {self.rows} rows lie within the joint ranges that the model knows: changes were not tested"
        if not self.found:
            return f"no change was found but the places of device and markers (tested at {100 * self.level:g} %)"
        return "; ".join(map(str, self.found))


class Drift(NamedTuple):
    """A part that has changed, and the variance of its change relative to its old variance."""

    part: ChangedPart
    variance: float


def find_changes(rows: NewRows, *, level: float = LEVEL, seed: int = 0) -> tuple[Changes, list[Drift]]:
    """Test new rows for changes.

    Args:
        rows: seen by the old model. level: see :class:`Changes`. seed: of the samples.

    Returns:
        what was found, and what may drift.
    """
    rows = rows.kept(within_old_range(rows))
    if len(rows) < FEWEST_ROWS:
        return Changes((), {}, 1.0, len(rows), level), []
    parts = {part.name: part for part in parts_of(rows)}
    roots = {name: part.root(rows.at) for name, part in parts.items()}
    rows = rows.changed(tails=rows.if_drifting(list(roots.values())).tails)
    base, drifts, found = rows.posterior, [], {}
    first, noise = {}, 1.0
    while roots:
        ratios, factor = likelihood_ratios(rows, base, roots, seed)
        # A few outliers look like a change, and a change looks like outliers: it must stand out with either weights.
        unchanged = rows.with_posterior(base).with_weights()
        strict, _ = likelihood_ratios(unchanged, base, roots, seed)
        ratios = {name: each.least_certain(strict[name]) for name, each in ratios.items()}
        if not first:
            first, noise = ratios, factor
        name = min(ratios, key=lambda each: (ratios[each].probability, -ratios[each].value))
        if ratios[name].probability > level:
            break
        root = roots.pop(name).flatten(0, 1)
        base = base + ratios[name].variance * (root @ root.T)
        drifts.append(Drift(parts[name], ratios[name].variance))
        found[name] = ratios[name]
    mu = torch.linalg.solve(Noise(rows.weighted_noise).add_to(base), rows.residual.flatten()).view_as(rows.y)
    changes = tuple(_change(rows, mu, drift, found[drift.part.name]) for drift in drifts)
    probabilities = {name: ratio.probability for name, ratio in first.items()}
    return Changes(changes, probabilities, noise, len(rows), level), drifts


def within_old_range(rows: NewRows) -> Tensor:
    """(k,) numbers of the rows within the ranges of the joints in the old rows."""
    low, high = rows.fitted.x.amin(0), rows.fitted.x.amax(0)
    margin = RANGE_MARGIN * (high - low)
    return ((rows.q >= low - margin) & (rows.q <= high + margin)).all(1).nonzero()[:, 0]


def _change(rows: NewRows, mu: Tensor, drift: Drift, ratio: Ratio) -> Change:
    """The change with its expected size."""
    part, scaled = drift.part, drift.variance * mu
    kinds = rows.points.fitted.geometry.chain.kinds
    angle = isinstance(part, Transmission) and kinds[part.joint] != "prismatic"
    whole = rows.seen[1]
    size, displacement = part.size(rows.at, whole, scaled), part.displacement(rows.at, whole, scaled)
    return Change(part.name, size, angle, displacement, ratio.probability)
