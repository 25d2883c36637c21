"""The parts of a calibrated model as torch modules: straight-line code on buffers, without choices by values or sizes.

They hold the constants of runtime/ and follow its formulas with operations that torch.export, torch.compile,
torch.jit.trace and ONNX understand, in double or single precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from diffeo_calib.common.device import HOST
from diffeo_calib.kernels.profiles import PROFILES
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.flow import Operations
from diffeo_calib.runtime.tables import TURN


class Constants(nn.Module):
    """A record of runtime/ as its formulas take it: floating-point arrays as buffers, other arrays as lists.

    Args:
        record: a flow, a chain, or a part of these.
    """

    def __init__(self, record: Any) -> None:
        super().__init__()
        for field in fields(record):
            value = getattr(record, field.name)
            if isinstance(value, np.ndarray) and value.dtype == np.float64:
                tensor = torch.tensor(np.ascontiguousarray(value), dtype=torch.float64, device=HOST)
                self.register_buffer(field.name, tensor)
            elif isinstance(value, np.ndarray):
                setattr(self, field.name, value.tolist())
            elif field.name == "terms":
                self.terms = nn.ModuleList(map(Constants, value))
            elif field.name != "stages":  # tables: their cells are buffers
                setattr(self, field.name, Constants(value) if is_dataclass(value) else value)


def rigid_inverse(poses: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    R = poses[..., :3, :3].mT
    top = torch.cat([R, -R @ poses[..., :3, 3:]], -1)
    return torch.cat([top, poses[..., 3:, :]], -2)


def _within_turn(x: Tensor) -> Tensor:
    return x - TURN * torch.floor(x * (1.0 / TURN))


def _at_least(values: Tensor, floor: float) -> Tensor:
    return values.clamp(min=floor)


def _profile(name: str, r2: Tensor) -> Tensor:
    return PROFILES[name].derivative(r2, 0)


def _cells_around(starts: Tensor, cells: Tensor, t: Tensor) -> Sequence[Tensor]:
    """See runtime/tables.py: by halving, since ONNX has no search in sorted numbers."""
    place = torch.zeros_like(t, dtype=torch.int64)
    for power in reversed(range(len(starts).bit_length() - 1)):
        further = place + (1 << power)
        place = torch.where(starts[further] <= t, further, place)
    return embedding(place, cells.mT).unbind(-1)


def _combined(x: Tensor, coefficients: Tensor, slopes: Sequence[Tensor]) -> Tensor:
    """x + sum_k c_k slope_k. (Not with single numbers: onnxruntime rounds those beside a product of matrices.)"""
    if not slopes:
        return x
    return x + (torch.stack(list(slopes)) * coefficients[: len(slopes), None, None]).sum(0)


TORCH = Operations(
    *(torch.sin, torch.cos, _within_turn, torch.stack, torch.cat, torch.ones_like, torch.broadcast_to),
    *(_at_least, _profile, _cells_around, _combined, twist_transform, rigid_inverse),
)
