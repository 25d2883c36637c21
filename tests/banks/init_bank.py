"""Tables of a simulated arm for `init`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.robots.simulated_arm import SimulatedArm

ARM, ROWS = SimulatedArm(seed=3), 40
NAMES, XYZ = list(ARM.nominal.joint_names), ["x", "y", "z"]
SERIES = [f"j{k}" for k in range(1, 7)]
Proposed = Callable[..., tuple[dict[str, Any], str]]


def rows() -> tuple[Tensor, Tensor]:
    """Joint values, deg, and places, mm."""
    q, points = ARM.measure(ROWS, seed=0)
    return q.rad2deg(), 1e3 * points[:, 0]


def noise(*shape: int, size: float) -> Tensor:
    return size * torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def reasons(text: str) -> dict[str, str]:
    """What stands beside each entry."""
    lines = [line.partition("  # ") for line in text.splitlines() if not line.startswith("#")]
    return {line.partition(" = ")[0]: why for line, _, why in lines}
