"""First-order effect of fields and parameters on k1, used by Gauss-Newton steps and Gaussian regression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.threads import large_work
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.maps.deformation import ModelSpec, Momenta

GRAM_ROWS = 64
"""Configurations whose covariances with those before them are computed at a time: their blocks fit into the cache."""


@dataclass(frozen=True)
class NodeSensitivity:
    """One node of the time grid: field values at ``points`` move the end by ``effect``."""

    weight: float  # quadrature weight c of the node
    points: Tensor  # (L Q, k) points at which the field acts
    # (L, r, Q k) derivative of L ends by the field's values at Q consecutive points each; Q = 1, except in
    # linearisations of functions of several markers (:meth:`Linearisation.projected`)
    effect: Tensor

    @property
    def together(self) -> int:
        """Q, the points that act together on one end."""
        return len(self.points) // max(len(self.effect), 1)

    def response(self, values: Tensor) -> Tensor:
        """weight * effect @ values: (L, k) -> (L, r)."""
        return self.weight * (self.effect @ values[:, :, None])[:, :, 0]

    def pulled(self, mu: Tensor) -> Tensor:
        """effect^T mu at every point: ends' values (N, m, c), m of all ends of a configuration -> (L Q, k, c)."""
        shaped = mu.reshape(len(self.effect), -1, mu.shape[-1])  # (N, m, c) or (N P, d, c)
        return (self.effect.mT @ shaped).reshape(len(self.points), -1, mu.shape[-1])

    def gram(self, kernel: Kernel, other: NodeSensitivity) -> Tensor:
        """weight * effect K other.effect^T: (L r, L' r')."""
        if self.together == 1:
            return kernel.gram(self.points, self.weight * self.effect, other.points, other.effect)
        (L, _, width), k = self.effect.shape, self.points.shape[1]
        single = torch.eye(k, dtype=self.effect.dtype, device=self.effect.device).expand(len(self.points), k, k)
        each = kernel.gram(self.points, single, other.points, other.effect)  # (L Q k, L' r)
        return (self.weight * self.effect @ each.unflatten(0, (L, width))).flatten(0, 1)

    def rows(self, rows: Tensor) -> NodeSensitivity:
        """The sensitivity of the selected ends."""
        points = self.points.view(len(self.effect), -1, self.points.shape[1])[rows].flatten(0, 1)
        return NodeSensitivity(self.weight, points, self.effect[rows])

    @classmethod
    def joined(cls, parts: Sequence[NodeSensitivity]) -> NodeSensitivity:
        """The sensitivities of several groups of ends, in order."""
        points, effects = ([getattr(part, name) for part in parts] for name in ("points", "effect"))
        return cls(parts[0].weight, torch.cat(points), torch.cat(effects))

    def projected(self, directions: Tensor) -> NodeSensitivity:
        """The sensitivity of M linear functions of ends, (M, r, m): those of m consecutive coordinates of the ends."""
        count, wanted, _ = directions.shape
        together = self.effect.view(count, -1, *self.effect.shape[1:])  # (M, ends, coordinates, k)
        parts = directions.view(count, wanted, *together.shape[1:3]).transpose(1, 2) @ together
        return NodeSensitivity(self.weight, self.points, parts.transpose(1, 2).flatten(2))


@dataclass(frozen=True)
class Linearisation:
    """First-order effect on k1 of the fields at every time node and of theta.

    At zero momenta this is the tangent model k1 = k0 + Dk0 K_V b + K_W p + S theta.
    """

    spec: ModelSpec  # kernels and prior
    joint: list[NodeSensitivity]  # sensitivities to v_s at M configurations, effects Theta_s (M, m, n)
    task: list[NodeSensitivity]  # sensitivities to w_t at M P marker points, effects Phi_t (M P, d, d)
    sensitivity: Tensor  # Dpsi S (M, m, K)

    @property
    def sides(self) -> tuple[tuple[Kernel, list[NodeSensitivity]], tuple[Kernel, list[NodeSensitivity]]]:
        """The kernels of joint and task space with the sensitivities to their fields."""
        return (self.spec.joint_kernel, self.joint), (self.spec.task_kernel, self.task)

    @property
    def joint_to_start(self) -> Tensor:
        """Theta_0 (M, m, n)."""
        return self.joint[0].effect

    @property
    def xi(self) -> Tensor:
        """phi^-1 of the configurations (M, n), where the nominal map is evaluated."""
        return self.joint[-1].points

    @property
    def fields(self) -> Linearisation:
        """The effect of the fields alone, without parameters."""
        spec = replace(self.spec, prior_variance=self.spec.prior_variance[:0])
        return replace(self, spec=spec, sensitivity=self.sensitivity[..., :0])

    def gram(self, other: Linearisation | None = None) -> Tensor:
        """Prior covariance between k1 at these configurations and at those of ``other``: (M m, N m).

        G = sum_s c_s Theta_s K_V Theta_s^T + sum_t c_t Phi_t K_W Phi_t^T + (Dpsi S) Lambda^-1 (Dpsi S)^T
        """
        if other is None or other is self:
            return self._own_gram()
        left, right = self.sensitivity.flatten(0, 1), other.sensitivity.flatten(0, 1)
        with large_work(len(left) * len(right)):
            total = (right * self.spec.prior_variance @ left.T).T
            for (kernel, mine), (_, theirs) in zip(self.sides, other.sides, strict=True):
                for a, b in zip(mine, theirs, strict=True):
                    total += a.gram(kernel, b)
        return total

    def _own_gram(self) -> Tensor:
        """Prior covariance with itself: the blocks on and below the diagonal, and their transposes."""
        count, m, _ = self.sensitivity.shape
        rows = torch.arange(count, device=self.sensitivity.device)
        if count <= GRAM_ROWS:
            return self.gram(replace(self))
        total = self.sensitivity.new_empty(count * m, count * m)
        for start in range(0, count, GRAM_ROWS):
            stop = min(start + GRAM_ROWS, count)
            part = self.rows(rows[:stop]).gram(self.rows(rows[start:stop])).T
            total[start * m : stop * m, : stop * m] = part
            total[: start * m, start * m : stop * m] = part[:, : start * m].T
        return total

    def own_blocks(self) -> Tensor:
        """Prior covariance of every configuration of a projected linearisation with itself: (M, r, r)."""
        total = self.sensitivity * self.spec.prior_variance @ self.sensitivity.mT
        for kernel, nodes in self.sides:
            for node in nodes:
                total = total + node.weight * kernel.own_blocks(node.points, node.effect)
        return total

    def rows(self, rows: Tensor) -> Linearisation:
        """The linearisation at the configurations with these row numbers."""
        markers = len(self.task[0].effect) // max(len(self.sensitivity), 1)  # one in a projected linearisation
        points = (rows[:, None] * markers + torch.arange(markers, device=rows.device)).flatten()
        joint, task = [node.rows(rows) for node in self.joint], [node.rows(points) for node in self.task]
        return Linearisation(self.spec, joint, task, self.sensitivity[rows])

    @classmethod
    def joined(cls, parts: Sequence[Linearisation]) -> Linearisation:
        """Linearisations of one map at several groups of configurations, in order."""
        joint, task = (
            [NodeSensitivity.joined(nodes) for nodes in zip(*(getattr(part, side) for part in parts), strict=True)]
            for side in ("joint", "task")
        )
        return cls(parts[0].spec, joint, task, torch.cat([part.sensitivity for part in parts]))

    def projected(self, directions: Tensor) -> Linearisation:
        """The linearisation of linear functions of k1 at every configuration, for covariances: (M, r, m) -> r for m.

        With the linear functions A_i that were measured, it is the first-order effect on these.
        """
        joint, task = ([node.projected(directions) for node in nodes] for nodes in (self.joint, self.task))
        return Linearisation(self.spec, joint, task, directions @ self.sensitivity)

    def with_columns(self, columns: Tensor, first: int) -> Linearisation:
        """With derivatives (M, r, k) by unknowns beside those of the nominal map, numbers ``first`` to first + k."""
        count = max(self.sensitivity.shape[2], first + columns.shape[2])
        whole = torch.nn.functional.pad(self.sensitivity, (0, count - self.sensitivity.shape[2]))
        whole[..., first : first + columns.shape[2]] = columns
        return replace(self, sensitivity=whole)

    def product(self, mu: Tensor) -> Tensor:
        """G mu without the matrix G: (N, m, k) -> (N, m, k), by kernel sums."""
        prior = self.spec.prior_variance[:, None] * torch.einsum("imt,imk->tk", self.sensitivity, mu)
        total = torch.einsum("imt,tk->imk", self.sensitivity, prior)
        for kernel, nodes in self.sides:
            for node in nodes:
                values = kernel.field(None, node.points, node.pulled(mu).mT).mT  # (L Q, n, k)
                values = values.reshape(len(node.effect), -1, mu.shape[-1])
                total = total + (node.weight * node.effect @ values).reshape(mu.shape)
        return total

    def momenta(self, mu: Tensor) -> Momenta:
        """Momenta with end value mu (N, m): b = Theta_0^T mu, p = Phi_0^T mu, theta = Lambda^-1 (Dpsi S)^T mu."""
        b, p = (nodes[0].pulled(mu[:, :, None])[:, :, 0] for nodes in (self.joint, self.task))
        theta = self.spec.prior_variance * torch.einsum("imk,im->k", self.sensitivity, mu)
        return Momenta(b, p, theta)


@dataclass(frozen=True, eq=False)
class Numbers:
    """M numbers of N linearised rows with R numbers each, of which some were not measured.

    Args:
        at: the rows. target: (M,) measured minus linearised at zero fields and parameters.
        cells: (M,) where the numbers stand in the table (N, R), flattened, in ascending order.
    """

    at: Linearisation
    target: Tensor
    cells: Tensor

    @classmethod
    def of(cls, at: Linearisation, target: Tensor | None = None, shown: Tensor | None = None) -> Numbers:
        """Numbers of a table: target (N, R), zero by default, and which are there (N, R), boolean, all by default."""
        S = at.sensitivity
        target = S.new_zeros(S.shape[:2]) if target is None else target
        shown = torch.ones_like(target, dtype=torch.bool) if shown is None else shown
        cells = shown.flatten().nonzero()[:, 0]
        return cls(at, target.flatten()[cells], cells)

    @property
    def shape(self) -> torch.Size:
        """N and R."""
        return self.at.sensitivity.shape[:2]

    @cached_property
    def all_there(self) -> bool:
        """Whether all were measured."""
        return len(self.cells) == self.shape.numel()

    @cached_property
    def S(self) -> Tensor:
        """(M, K) derivatives by the parameters, column by column, for the solvers."""
        return self.of_table(self.at.sensitivity).T.contiguous().T

    @property
    def owner(self) -> Tensor:
        """(M,) the row of each number."""
        return self.cells // self.shape[1]

    def of_table(self, values: Tensor) -> Tensor:
        """Values (N, R, ...) of the table as those of the numbers (M, ...)."""
        return self.there(values.flatten(0, 1))

    def there(self, values: Tensor) -> Tensor:
        """Pick the numbers that are there from a flattened table: (N R, ...) -> (M, ...)."""
        return values if self.all_there else values[self.cells]

    def in_table(self, values: Tensor) -> Tensor:
        """The inverse, zero where nothing was measured: (M, ...) -> (N, R, ...)."""
        if not self.all_there:
            values = values.new_zeros(self.shape.numel(), *values.shape[1:]).index_copy_(0, self.cells, values)
        return values.unflatten(0, self.shape)

    def with_noise(self, matrix: Tensor, noise: Tensor) -> Tensor:
        """(M, M) of a matrix (N R, N R) and the blocks (N, R, R) of noise on its diagonal."""
        total = matrix.clone()
        total.view(*self.shape, *self.shape).diagonal(dim1=0, dim2=2).add_(noise.permute(1, 2, 0))
        return self.there(self.there(total).T).T

    def square(self, matrix: Tensor) -> Tensor:
        """A matrix (M, M) as that of the table, zero where nothing was measured: (N R, N R)."""
        if self.all_there:
            return matrix
        wide = matrix.new_zeros(len(matrix), self.shape.numel()).index_copy_(1, self.cells, matrix)
        return self.in_table(wide).flatten(0, 1)

    def blocks(self, matrix: Tensor) -> Tensor:
        """The blocks (N, R, R) of each row in a matrix (M, M), zero where nothing was measured."""
        place = self.in_table(torch.arange(len(self.cells), device=matrix.device))
        there = self.in_table(torch.ones_like(self.cells)).to(matrix)
        return matrix[place[:, :, None], place[:, None]] * (there[:, :, None] * there[:, None])

    def rows(self, index: Tensor) -> Numbers:
        """Keep some rows."""
        shown = self.in_table(torch.ones_like(self.cells)) > 0
        return Numbers.of(self.at.rows(index), self.in_table(self.target)[index], shown[index])

    def joined(self, other: Numbers) -> Numbers:
        """These and others, in order."""
        cells = torch.cat([self.cells, other.cells + self.shape.numel()])
        return Numbers(Linearisation.joined([self.at, other.at]), torch.cat([self.target, other.target]), cells)

    def gram(self, at: Linearisation) -> Tensor:
        """Covariance by the fields of the numbers with k1 at M' configurations: (M, M' m)."""
        return self.there(self.at.fields.gram(at.fields))
