"""The parts of a calibrated model as torch modules: straight-line code on buffers, without choices by values or sizes.

They hold the constants of runtime/program.py and repeat its formulas with operations that torch.export, torch.compile,
torch.jit.trace and ONNX understand, in double or single precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from diffeo_calib.common.device import HOST
from diffeo_calib.kernels.profiles import PROFILES
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.chain import CalibratedChain, Operations, Sag, Waves, tip_poses
from diffeo_calib.runtime.flow import RadialTerm, RecordedFlow
from diffeo_calib.runtime.tables import JointTables

SMALLEST_SQUARE = 1e-30
"""Floor under squared distances: the root of 0 has no derivative. Kernels are 1 there to the last digit."""
CIRCLE_SPACING_RAD = 8.0
"""Distance between the circles of two joints on the line where cells are searched; more than 2 pi."""


def constant(array: np.ndarray, dtype: torch.dtype | None = torch.float64) -> Tensor:
    """A copy of an array as a tensor."""
    return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=HOST)


class KernelSum(nn.Module):
    """v_s(x) = sum_j kappa(|F(x) - F(q_sj)|^2) w_sj for every stage s; see :class:`RadialTerm`.

    Args:
        term: controls and weights at every stage.
    """

    right: Tensor
    weights: Tensor
    scales: Tensor
    centre: Tensor

    def __init__(self, term: RadialTerm) -> None:
        super().__init__()
        self.profile = PROFILES[term.profile]
        self.lines, self.circles = list(term.lines), list(term.circles)
        self.register_buffer("scales", constant(term.scales))
        self.register_buffer("centre", constant(term.centre))
        self.register_buffer("weights", constant(term.weights))
        features = constant(term.features)  # (S, C, D)
        squares = features.square().sum(-1, keepdim=True)
        right = torch.cat([-2.0 * features, torch.ones_like(squares), squares], -1)
        self.register_buffer("right", right.mT.contiguous())  # (S, D + 2, C)

    def lift(self, x: Tensor) -> Tensor:
        """F(x): (..., n) -> (..., D), lines first, then cosines and sines."""
        count, parts = len(self.lines), []
        if self.lines:
            parts.append((_columns(x, self.lines) - self.centre) * self.scales[:count])
        if self.circles:
            angles = _columns(x, self.circles)
            parts += [angles.cos() * self.scales[count:], angles.sin() * self.scales[count:]]
        return torch.cat(parts, -1)

    def forward(self, stage: int, x: Tensor) -> Tensor:
        """(N, n) -> (N, n)."""
        F = self.lift(x)
        square = F.square().sum(-1, keepdim=True)
        r2 = torch.cat([F, square, torch.ones_like(square)], -1) @ self.right[stage]  # (N, C)
        return self.profile.derivative(r2.clamp(min=SMALLEST_SQUARE), 0) @ self.weights[stage]


class TransmissionTables(nn.Module):
    """Functions of single joints at every stage as piecewise polynomials; see :class:`JointTables`.

    Args:
        tables: of the joints.
        size: number n of all joints.
    """

    shifts: Tensor
    first: Tensor
    selection: Tensor

    def __init__(self, tables: JointTables, size: int) -> None:
        super().__init__()
        self.joints = list(tables.joints)
        self.stages, self.halvings = len(tables.stages), []
        self.register_buffer(
            "shifts", CIRCLE_SPACING_RAD * torch.arange(len(self.joints), dtype=torch.float64, device=HOST)
        )
        self.register_buffer("selection", torch.eye(size, dtype=torch.float64, device=HOST)[self.joints])
        for stage, row in enumerate(tables.stages):
            counts = [len(table.knots) - 1 for table in row]
            starts = [table.knots[:-1] + CIRCLE_SPACING_RAD * k for k, table in enumerate(row)]
            self.halvings.append(int(max(counts)).bit_length())
            padding = np.full(2 << self.halvings[-1], CIRCLE_SPACING_RAD * (len(row) + 1))  # beyond every angle
            cells = np.concatenate([np.concatenate(starts)[None], np.concatenate([t.coefficients for t in row], 1)])
            self.register_buffer(f"starts{stage}", constant(np.concatenate([*starts, padding])))
            self.register_buffer(f"cells{stage}", constant(cells.T))  # (K, 7): start, coefficients
            self.register_buffer(f"first{stage}", constant(np.cumsum([0, *counts[:-1]]), torch.int64))

    def forward(self, stage: int, x: Tensor) -> Tensor:
        """(N, n) -> (N, n), zero for joints without a table."""
        angle = _columns(x, self.joints)
        t = angle - 2.0 * torch.pi * (angle * (0.5 / torch.pi)).floor() + self.shifts
        starts: Tensor = getattr(self, f"starts{stage}")
        place = getattr(self, f"first{stage}") + torch.zeros_like(t, dtype=torch.int64)
        for power in reversed(range(self.halvings[stage])):
            further = place + (1 << power)
            place = torch.where(starts[further] <= t, further, place)
        start, *c = embedding(place, getattr(self, f"cells{stage}")).unbind(-1)
        u = t - start
        values = ((((c[5] * u + c[4]) * u + c[3]) * u + c[2]) * u + c[1]) * u + c[0]
        return values @ self.selection


class FlowProgram(nn.Module):
    """The time-1 map of a recorded geodesic.

    Args:
        flow: its constants.
    """

    coefficients: Tensor
    weights: Tensor

    def __init__(self, flow: RecordedFlow) -> None:
        super().__init__()
        self.sums = nn.ModuleList(KernelSum(term) for term in flow.terms)
        if flow.tables is not None:
            self.sums.append(TransmissionTables(flow.tables, flow.size))
        self.steps = flow.steps if len(self.sums) else 0
        self.register_buffer("coefficients", constant(flow.coefficients / flow.steps))
        self.register_buffer("weights", constant(flow.weights / flow.steps))

    def forward(self, x: Tensor) -> Tensor:
        """(N, n) -> (N, n)."""
        for step in range(self.steps):
            slopes: list[Tensor] = []
            for row in self.coefficients.unbind(0):
                at, stage = _combined(x, row, slopes), step * self.weights.shape[0] + len(slopes)
                parts = [part(stage, at) for part in self.sums]
                slopes.append(parts[0] if len(parts) == 1 else torch.stack(parts).sum(0))
            x = _combined(x, self.weights, slopes)
        return x


class Constants(nn.Module):
    """A record of runtime/ as its formulas take it: floating-point arrays as buffers, other arrays as lists.

    Args:
        record: a chain, its sag or its waves.
    """

    def __init__(self, record: CalibratedChain | Sag | Waves) -> None:
        super().__init__()
        for field in fields(record):
            value = getattr(record, field.name)
            if isinstance(value, np.ndarray) and value.dtype == np.float64:
                self.register_buffer(field.name, constant(value))
            elif isinstance(value, np.ndarray):
                setattr(self, field.name, value.tolist())
            else:
                setattr(self, field.name, Constants(value) if isinstance(value, (Sag, Waves)) else value)


class ChainProgram(Constants):
    """Poses of the tips of a robot with its errors and gravity sag; see :class:`CalibratedChain`."""

    def forward(self, q: Tensor) -> Tensor:
        """(N, n) -> (N, T, 4, 4) [m]."""
        return tip_poses(self, q, TORCH)


def rigid_inverse(poses: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    R = poses[..., :3, :3].mT
    top = torch.cat([R, -R @ poses[..., :3, 3:]], -1)
    return torch.cat([top, poses[..., 3:, :]], -2)


TORCH = Operations(torch.sin, torch.cos, torch.stack, torch.broadcast_to, twist_transform, rigid_inverse)


def _columns(x: Tensor, columns: list[int]) -> Tensor:
    """Some columns of x; consecutive ones as a slice."""
    first = columns[0]
    if columns == list(range(first, first + len(columns))):
        return x[..., first : first + len(columns)]
    return torch.stack([x[..., column] for column in columns], -1)


def _combined(x: Tensor, coefficients: Tensor, slopes: Sequence[Tensor]) -> Tensor:
    """x + sum_k c_k slope_k. (Not with single numbers: onnxruntime rounds those beside a product of matrices.)"""
    if not slopes:
        return x
    return x + (torch.stack(list(slopes)) * coefficients[: len(slopes), None, None]).sum(0)
