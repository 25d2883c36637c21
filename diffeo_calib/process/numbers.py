"""Linearised rows as one list of numbers, whatever measured them.

To first order around a linearisation point a row reports

    target = S u + J v(q) + A w(z) + e,

with the unknowns u of robot and devices, the errors v of its joints and w of space, at points z of the robot. Rows
report as many numbers as they show: those of a hidden marker are not there. Rows that show the same are kept together,
since their arrays have one shape. Their covariance with any others by the fields of joints and space is

    cov(i, j) = J_i K_V(q, q') J_j^T + A_i K_W(z, z') A_j^T.

What unknowns add, S P S^T, is not in it: the process keeps unknowns explicit, so that a wide prior P costs no digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.kernels.spaces import Space
from diffeo_calib.process.scales import Hyperparameters, KernelValues


class Part(NamedTuple):
    """N rows that report the same r numbers, which depend on P points of the robot.

    Args:
        J: (N, r, n) and A: (N, r, P, 3), see above. cells: (N, r) where the numbers stand in the table, flattened.
        rows, points, numbers: where these rows, their points and their numbers stand among all.
    """

    J: Tensor
    A: Tensor
    cells: Tensor
    rows: slice
    points: slice
    numbers: slice


class Numbers:
    """M numbers of N rows, K unknowns, n joints.

    Attributes:
        q: (N, n) configurations, rad or m. z: (T, 3) points, m. target: (M,). S: (M, K). parts: see :class:`Part`.
        J: (M, n). row: (M,) where the row of each number stands in q. shape: (rows, numbers of a row) of the table.
    """

    def __init__(self, parts: Sequence[tuple[Tensor, ...]], shape: tuple[int, int]) -> None:
        """Parts of q (N, n), z (N, P, 3), target (N, r), S (N, r, K), J, A and cells."""
        self.shape, self.parts, rows, points, numbers = shape, list[Part](), 0, 0, 0
        for q, z, target, _, J, A, cells in parts:
            ends = rows + len(q), points + len(q) * z.shape[1], numbers + target.numel()
            own = slice(rows, ends[0]), slice(points, ends[1]), slice(numbers, ends[2])
            self.parts.append(Part(J, A, cells, *own))
            rows, points, numbers = ends
        self._given = tuple(parts)
        self.q = torch.cat([part[0] for part in parts])
        self.z = torch.cat([part[1].flatten(0, 1) for part in parts])
        self.target = torch.cat([part[2].flatten() for part in parts])
        self.S = torch.cat([part[3].flatten(0, 1).T for part in parts], 1).T  # column by column, for the solvers
        self.cells = torch.cat([part[6].flatten() for part in parts])
        self.J = torch.cat([part[4].flatten(0, 1) for part in parts])
        counts = [part.cells.shape for part in self.parts]
        rows = torch.cat([torch.full((n,), r, dtype=torch.long, device=self.q.device) for n, r in counts])
        self.row = torch.arange(len(self.q), device=self.q.device).repeat_interleave(rows)

    @classmethod
    def of(
        cls, q: Tensor, points: Tensor, shown: Tensor, *, target: Tensor, S: Tensor, J: Tensor, A: Tensor
    ) -> Numbers:
        """Those of a table of N rows with R numbers each, of which the ones ``shown`` (N, R) are there.

        Args:
            q: (N, n). points: (N, 3 P). shown: (N, R). target: (N, R). S: (N, R, K). J: (N, R, n). A: (N, R, 3 P).
        """
        (N, R), P = target.shape, points.shape[1] // 3
        patterns, kind = shown.unique(dim=0, return_inverse=True)
        parts, z, A = [], points.view(N, P, 3), A.view(N, R, P, 3)
        for number, pattern in enumerate(patterns):
            columns = pattern.nonzero()[:, 0]
            rows = (kind == number).nonzero()[:, 0]
            at = rows[:, None], columns
            own = A[at]
            used = (own != 0).any(0).any(0).any(1)
            parts.append((q[rows], z[rows][:, used], target[at], S[at], J[at], own[:, :, used], at[0] * R + at[1]))
        return cls([part for part in parts if part[2].numel()], (N, R))

    def joined(self, other: Numbers) -> Numbers:
        """These and others, in order, with as many numbers a row in their tables."""
        (N, R), (count, _) = self.shape, other.shape
        later = [(*part[:6], part[6] + N * R) for part in other._given]
        return Numbers([*self._given, *later], (N + count, R))

    def later(self, count: int) -> Numbers:
        """These without the first ``count``."""
        kept = [own for own, part in zip(self._given, self.parts, strict=True) if part.numbers.start >= count]
        return Numbers(kept, self.shape)

    @property
    def none(self) -> Numbers:
        """No numbers, of rows like these."""
        return Numbers([tuple(values[:0] for values in self._given[0])], (0, self.shape[1]))

    @property
    def owner(self) -> Tensor:
        """(M,) the row in the table of each number."""
        return self.cells // self.shape[1]

    def of_table(self, values: Tensor) -> Tensor:
        """Values (N, R, ...) of the table as those of the numbers (M, ...)."""
        return values.flatten(0, 1)[self.cells]

    def in_table(self, values: Tensor) -> Tensor:
        """The inverse, zero where nothing was measured: (M, ...) -> (N, R, ...)."""
        table = values.new_zeros(self.shape[0] * self.shape[1], *values.shape[1:])
        table[self.cells] = values
        return table.view(*self.shape, *values.shape[1:])

    def blocks_of_table(self, blocks: Tensor) -> list[Tensor]:
        """Blocks (N, R, R) of rows of the table as those of each part (N, r, r)."""
        R = self.shape[1]
        at = [(part.cells // R, part.cells % R) for part in self.parts]
        return [blocks[rows[:, :, None], columns[:, :, None], columns[:, None]] for rows, columns in at]

    def blocks_in_table(self, blocks: Sequence[Tensor]) -> Tensor:
        """The inverse, zero where nothing was measured: parts (N, r, r) -> (N, R, R)."""
        N, R = self.shape
        table = blocks[0].new_zeros(N, R, R)
        for part, own in zip(self.parts, blocks, strict=True):
            rows, columns = part.cells // R, part.cells % R
            table[rows[:, :, None], columns[:, :, None], columns[:, None]] = own
        return table

    def diagonal_blocks(self, matrix: Tensor) -> list[Tensor]:
        """The blocks (N, r, r) of every part of a matrix (M, M)."""
        found = []
        for part in self.parts:
            N, r = part.cells.shape
            own = matrix[part.numbers, part.numbers].view(N, r, N, r)
            found.append(own.diagonal(dim1=0, dim2=2).permute(2, 0, 1))
        return found

    def add_blocks(self, matrix: Tensor, blocks: Sequence[Tensor]) -> Tensor:
        """The matrix (M, M), to which the blocks (N, r, r) of every part are added in place."""
        for own, added in zip(self.diagonal_blocks(matrix), blocks, strict=True):
            own.add_(added)
        return matrix


class Values(NamedTuple):
    """K_V at pairs of configurations, and kappa of K_W = kappa I at pairs of points."""

    joint: KernelValues
    task: KernelValues


class Covariance:
    """Of numbers ``a`` with numbers ``b``; distances are computed once, for a search that needs it for many scales."""

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
        by_joint = torch.cat(
            [(joint[..., part.rows, None] * part.J.permute(2, 0, 1)).flatten(2) for part in self.b.parts], 2
        )  # (Na, n, Mb)
        of_points = ((task[:, part.points].unflatten(1, part.A.shape[::2]), part.A) for part in self.b.parts)
        by_point = torch.cat([torch.einsum("tjp,jrpc->tcjr", *each).flatten(2) for each in of_points], 2)  # (Ta, 3, Mb)
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
            each = ((half[..., other.numbers].unflatten(2, other.A.shape[:2]), other.A) for other in self.b.parts)
            rows.append(torch.cat([torch.einsum("tcjr,jrpc->tjp", *one).flatten(1) for one in each], 1))
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
