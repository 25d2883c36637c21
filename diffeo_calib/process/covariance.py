"""The prior covariance of any numbers with any numbers by the fields of joints and space, and its derivatives.

    cov(i, j) = J_i K_V(q, q') J_j^T + A_i K_W(z, z') A_j^T

Distances are computed once, for a search that needs it for many scales. What unknowns add, S P S^T, is not in it: the
process keeps unknowns explicit, so that a wide prior P costs no digits.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.kernels.spaces import Space
from diffeo_calib.process.numbers import Numbers
from diffeo_calib.process.scales import Hyperparameters, KernelValues


class Values(NamedTuple):
    """K_V at pairs of configurations, and kappa of K_W = kappa I at pairs of points."""

    joint: KernelValues
    task: KernelValues


class Covariance:
    """Of numbers ``a`` with numbers ``b``."""

    def __init__(self, a: Numbers, b: Numbers, space: Space) -> None:
        self.a, self.b = a, b
        self._joints = space.squared_distances(a.q, b.q)
        self._points = torch.cdist(a.z, b.z, compute_mode="donot_use_mm_for_euclid_dist").square_()

    def values(self, scales: Hyperparameters) -> Values:
        """The kernels at all pairs of configurations and of points, for :meth:`matrix` and :meth:`inner`."""
        return Values(scales.joint_kernel_values(self._joints), scales.task_kernel_values(self._points))

    def matrix(self, values: Values) -> Tensor:
        """(Ma, Mb), without a graph."""
        joint, task = values.joint.values.transpose(0, 1), values.task.values[0]  # (Na, n, Nb), (Ta, Tb)
        by_joint = torch.cat([_times(joint[..., part.rows], part.J) for part in self.b.parts], 2)  # (Na, n, Mb)
        by_point = torch.cat([_times_points(task[:, part.points], part.A) for part in self.b.parts], 2)  # (Ta, 3, Mb)
        total = by_joint.new_empty(len(self.a.target), len(self.b.target))
        for part in self.a.parts:
            N, _, P, _ = part.A.shape
            space = by_point[part.points].reshape(N, 3 * P, total.shape[1])
            own = torch.baddbmm(part.A.flatten(2) @ space, part.J, by_joint[part.rows])
            total[part.numbers] = own.flatten(0, 1)
        return total

    def inner(self, values: Values, weights: Tensor) -> Tensor:
        """sum(weights * matrix) for weights (Ma, Mb), differentiable in the scales: scalar.

        With the gradient of a function of the matrix as weights, its derivative is that of the function, but autograd
        records no matrix of this size.
        """
        joint = joint_weights(self.a, self.b, weights).transpose(0, 1).contiguous()
        rows = []
        for part in self.a.parts:
            half = part.A.flatten(2).mT @ weights[part.numbers].view(*part.cells.shape, -1)
            half = half.view(-1, 3, half.shape[2])  # (N P, 3, Mb)
            rows.append(torch.cat([_summed_points(half[..., other.numbers], other.A) for other in self.b.parts], 1))
        return values.joint.inner(joint) + values.task.inner(torch.cat(rows)[None])


def joint_weights(a: Numbers, b: Numbers, weights: Tensor) -> Tensor:
    """The weights (Na, n, Nb) of the values of K_V in a sum of weights (Ma, Mb) times the covariance: J^T W J."""
    rows = []
    for part in a.parts:
        half = part.J.mT @ weights[part.numbers].view(*part.cells.shape, -1)
        own = [
            torch.einsum("icjr,jrc->icj", half[..., other.numbers].unflatten(2, other.cells.shape), other.J)
            for other in b.parts
        ]
        rows.append(torch.cat(own, 2))
    return torch.cat(rows)


def _times(values: Tensor, J: Tensor) -> Tensor:
    """Values (Na, n, N) of every component times J^T of N rows (N, r, n): (Na, n, N r)."""
    return (values[..., None] * J.permute(2, 0, 1)).flatten(2)


def _times_points(values: Tensor, A: Tensor) -> Tensor:
    """Values (Ta, N P) times A^T of N rows (N, r, P, 3): (Ta, 3, N r)."""
    return torch.einsum("tjp,jrpc->tcjr", values.unflatten(1, A.shape[::2]), A).flatten(2)


def _summed_points(half: Tensor, A: Tensor) -> Tensor:
    """The weights of the values in :func:`_times_points`: (Ta, 3, N r) -> (Ta, N P)."""
    return torch.einsum("tcjr,jrpc->tjp", half.unflatten(2, A.shape[:2]), A).flatten(1)
