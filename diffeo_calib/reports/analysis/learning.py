"""What more rows of this robot would bring, from its own learning curve."""

from __future__ import annotations

from collections.abc import Sequence

import torch


def forecast(curve: Sequence[tuple[int, float]], limit: float) -> tuple[int, float] | None:
    """Twice the rows of the last point of a learning curve and the error there, by the slope of its last part.

    Above the repeatability ``limit`` [m] errors fall like a power of the number of rows; None if they do not fall.
    """
    if len(curve) < 3:
        return None
    counts = torch.tensor([count for count, _ in curve[-4:]], dtype=torch.float64, device="cpu").log()
    above = torch.tensor([max(e**2 - limit**2, 0.0) ** 0.5 for _, e in curve[-4:]], dtype=torch.float64, device="cpu")
    if float(above.min()) <= 0:
        return None
    x, y = counts - counts.mean(), above.log()
    slope = float((x * y).sum() / x.square().sum())
    if slope >= 0:
        return None
    rows, _ = curve[-1]
    return 2 * rows, float((above[-1] * 2.0**slope).square() + limit**2) ** 0.5
