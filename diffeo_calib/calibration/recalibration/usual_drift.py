"""Small changes of everything between two dates, whose sizes the new rows choose.

A test names what has changed clearly. Temperature, wear and new screws change everything a little. In each of three
groups, the geometry, the load and the transmissions of all joints, errors may differ from the old ones by s^2 times
their old prior variance; the sizes s^2 maximise the evidence of the new rows with a wide prior below one percent.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.recalibration.changed_parts import ChangedPart, parts_of
from diffeo_calib.calibration.recalibration.changes import Drift
from diffeo_calib.calibration.recalibration.new_rows import NewRows

USUAL_LOG, EFOLDS = -6.0, 2.5
"""Log-normal prior of s^2: the logarithm of its centre, and the standard deviation of its logarithm."""
LOG_SIZES = torch.linspace(-12.0, 4.0, 65, dtype=torch.float64, device="cpu")
"""Logarithms of the s^2 that are tried."""
ROUNDS = 10


def usual_drift(rows: NewRows, named: Sequence[Drift]) -> list[Drift]:
    """What may differ between the dates, besides what a test named.

    Args:
        rows: the new rows as the old model sees them. named: parts that have changed, which are free already.
    """
    free = {each.part.name for each in named}
    groups: dict[str, list[ChangedPart]] = {}
    for part in parts_of(rows):
        if part.name not in free:
            groups.setdefault(part.name if part.joint is None else "transmissions", []).append(part)
    if not groups:
        return []
    roots = [torch.cat([part.root(rows.at) for part in parts], 2) for parts in groups.values()]
    known = [each.variance**0.5 * each.part.root(rows.at) for each in named]
    doubted, sizes = rows.if_drifting([*known, *roots]), list[float]()
    for weighed, least in ((rows, gates.DRIFT_ODDS_OF_INLIERS), (doubted, gates.DRIFT_ODDS)):
        sizes, odds = _likeliest(rows.changed(tails=weighed.tails).drifting(known), roots)
        if odds < least:
            return []
    return [Drift(part, size) for parts, size in zip(groups.values(), sizes, strict=True) for part in parts]


def _likeliest(rows: NewRows, roots: list[Tensor]) -> tuple[list[float], float]:
    """The sizes s^2 of changes with these columns (M, R, c), each in turn the likeliest beside the others; log odds."""
    sizes, chosen = LOG_SIZES.exp().to(rows.y), [0] * len(roots)
    prior = -0.5 * ((LOG_SIZES.to(rows.y) - USUAL_LOG) / EFOLDS).square()

    def scaled(k: int) -> Tensor:
        return sizes[chosen[k]].sqrt() * roots[k]

    every = range(len(roots))
    for _ in range(ROUNDS):
        before = list(chosen)
        for k in every:
            beside = rows.drifting([scaled(j) for j in every if j != k])
            chosen[k] = int((beside.evidence(roots[k]).log_odds(sizes) + prior).argmax())
        if chosen == before:
            break
    together = torch.cat([scaled(k) for k in every], 2)
    odds = rows.evidence(together).log_odds(sizes.new_ones(1)) + prior[chosen].sum()
    return sizes[chosen].tolist(), float(odds)
