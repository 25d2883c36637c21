"""Conditioning in the momenta of control points: normal equations of size M (n + d P) + K.

Around a deformation, k1(x_i) = A (b, p, theta) to first order, where momenta b of the controls act at
time s as Mx_s^-T b, and the energy of the fields is 1/2 (b, p, theta)^T Q (b, p, theta):

    A = [sum_s c_s Theta_s K_V Mx_s^-T,  sum_t c_t Phi_t K_W My_t^-T,  Dpsi S]
    Q = diag(sum_s c_s Mx_s^-1 K_V Mx_s^-T,  sum_t c_t My_t^-1 K_W My_t^-T,  Lambda)
    H = Q + A^T R^-1 A

H itself is too ill-conditioned for float64. In the coordinates u = L^T (b, p, theta) with Q = L L^T, in which
the prior is white, it becomes I + B^T B with B = R^-1/2 A L^-T. Shifts that rows share are unknowns with a white prior.

Processes that share kernel sums (backend "distributed") share the rows of A too.

A is computed block by block over the data and never kept: memory does not grow with the number of data. In these
coordinates the optimum is u + H^-1 (B^T R^-1/2 (y - k1) - u), so that one pass over the data gives H and the step.

If the controls are the data, this gives the same momenta as G + R, at a higher cost.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_memory
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.reductions.distributed import Ranks, ranks
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import NOISE_ADVICE
from diffeo_calib.regression.conditional import Conditional, Features, of_parameters

JITTER_RATIO = 1e-13
"""Added to the diagonal of the controls' kernel matrices, relative to its largest entry: the level of rounding."""
BLOCK_ENTRIES = 1 << 22  # number of entries of A that are computed together (32 MiB)
COPIES_OF_BLOCK = 5  # matrices of the size of one such block that exist at a time
SHARED_ENTRIES = 1 << 24
"""Number of entries of A from which several processes share its blocks: with fewer, some would have nothing to do."""
STRIPS = 8
"""Strips in which the lower triangle of a symmetric product is computed: 56 % of the work of the whole product."""
INFORMED_SHARE = 1e-9
"""Directions of the momenta about which the data say less than this share of what they say about the best known."""


class ControlPointRegression(Conditional):
    """Factorised normal equations around a deformation.

    Args:
        deformation: the deformation to linearise, whose controls carry the momenta.
        x: (N, n) configurations of the data. noise: R, (N, r, r) blocks.
        slopes: (N, r, m) linear functionals that were measured; None for all coordinates, r = m.
        residual: for :meth:`mode`, of row numbers (M,) and of k1 at these rows (M, m): measured minus predicted (M, r).

    Raises:
        InputError: the normal equations need more memory than is free. NumericalError: they are singular.
    """

    def __init__(
        self,
        deformation: GeodesicDeformation,
        x: Tensor,
        noise: Noise,
        slopes: Tensor | None = None,
        residual: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:
        self.spec: ModelSpec = deformation.spec
        self.deformation, self.like = deformation, deformation.momenta
        self.x, self.noise, self.slopes = x, noise, slopes
        self._shifts = noise.shared.shape[2]
        self.size = size = sum(t.numel() for t in self.like.tensors) + self._shifts
        check_memory(8 * (3 * size**2 + COPIES_OF_BLOCK * BLOCK_ENTRIES), f"normal equations of {size} momenta")
        self.controls = deformation.momentum_sensitivities()
        kernels = self.spec.joint_kernel, self.spec.task_kernel
        self._roots = [_root(kernel, nodes) for kernel, nodes in zip(kernels, self.controls, strict=True)]
        large = len(x) * size * noise.covariance.shape[1] >= SHARED_ENTRIES
        distributed = large and any("distributed" in name for name in deformation.backends)
        self._ranks = ranks() if distributed else Ranks()
        if self._ranks.count > 1:
            # Each process has blocks of its own, and shares no sum in them.
            self.deformation = deformation.using("auto")
        hessian = torch.eye(size, dtype=x.dtype, device=x.device) / self._ranks.count
        pull = x.new_zeros(size, 1)
        with large_work(size * noise.covariance.shape[:2].numel()):
            for rows in self._blocks(size):
                value, at = self._linearised(rows)
                a = self._rows(at)
                a[:, size - self._shifts :] = self.noise.shared[rows].flatten(0, 1)
                white = self._whiten(self.noise.whiten(a.view(len(rows), -1, size), rows).flatten(0, 1).T)  # of B^T
                for first, last in pairwise(k * size // STRIPS for k in range(STRIPS + 1)):  # the lower triangle alone
                    hessian[first:last, :last].addmm_(white[first:last], white[:last].T)
                if residual is not None:
                    pull += white @ self.noise.whiten(residual(rows, value)[:, :, None], rows).reshape(-1, 1)
            hessian, pull = self._ranks.total([hessian, pull])
            self.core, info = torch.linalg.cholesky_ex(hessian)  # its smallest eigenvalue is 1
        self._pull = pull
        if int(info):
            what = "the normal equations of the control points are singular"
            raise NumericalError.of(what, fix=NOISE_ADVICE)

    def mode(self) -> tuple[Momenta, float]:
        """Posterior mode of b, p, theta by the residual, and how far the linearised energy falls to it."""
        u = self._white_momenta()
        slope = self._pull - u
        step = torch.cholesky_solve(slope, self.core)
        return self._of_white(u + step), 0.5 * float(slope.T @ step)

    def response(self, momenta: Momenta) -> Tensor:
        """A (b, p, theta): (N, m)."""
        vector = torch.nn.functional.pad(momenta.flatten(), (0, self._shifts))
        total = vector.new_zeros(self.noise.covariance.shape[:2])
        for rows in self._blocks(len(vector)):
            total[rows] = (self._rows(self._linearised(rows)[1]) @ vector).view(len(rows), -1)
        return self._ranks.total([total])[0]

    def weighted_residual(self) -> Tensor:
        """R^-1 (y - k1) (N, m) of the smallest residuals for which the deformation's momenta are the optimum.

        In coordinates in which their prior is white these momenta are u = B^T R^-1/2 (y - k1), whose least-squares
        solution is R^-1/2 (y - k1) = B (B^T B)^+ u.
        """
        size = self.size - self._shifts
        u = self._white_momenta()[:size, 0]
        informed = (self.core @ self.core.T)[:size, :size]
        informed.diagonal().sub_(1.0)
        values, vectors = torch.linalg.eigh(informed)
        kept = values > INFORMED_SHARE * values[-1]
        solved = vectors[:, kept] @ ((vectors[:, kept].T @ u) / values[kept])
        momenta = self._of_white(torch.nn.functional.pad(solved, (0, self._shifts))[:, None])
        return self.noise.own.solve(self.response(momenta))

    def features(self, at: Linearisation) -> Features:
        """Part of the fields that the controls can express, and its posterior together with that of the parameters."""
        rows = self._rows(at)
        with large_work(rows.numel()):
            expressed = self._whiten(rows.T)  # (size, M r)
            left = torch.linalg.solve_triangular(self.core, expressed, upper=False)
        fields = self.size - self.like.theta.numel() - self._shifts  # momenta
        return Features(at, expressed[:fields], left)

    def _blocks(self, size: int) -> list[Tensor]:
        """Row numbers of the blocks of data that this process works on."""
        count, r = self.noise.covariance.shape[:2]
        return self._ranks.mine(torch.arange(count, device=self.x.device).split(max(1, BLOCK_ENTRIES // (size * r))))

    def _linearised(self, rows: Tensor) -> tuple[Tensor, Linearisation]:
        """k1 (M, m) and the linearisation at the data with these row numbers."""
        value, at = self.deformation.linearised_value(self.x[rows])
        return value, at if self.slopes is None else at.projected(self.slopes[rows])

    def _rows(self, at: Linearisation) -> Tensor:
        """Rows of A for the configurations of a linearisation: (M m, size)."""
        columns = []
        for (kernel, points), controls in zip(at.sides, self.controls, strict=True):
            terms = [
                kernel.gram(c.points, c.effect, a.points, a.weight * a.effect).T
                for a, c in zip(points, controls, strict=True)
            ]
            columns.append(torch.stack(terms).sum(0) if len(terms) > 1 else terms[0])
        return torch.cat([*columns, of_parameters(at, self.like.theta.numel() + self._shifts).flatten(0, 1)], 1)

    def _white_momenta(self) -> Tensor:
        """L^T of the deformation's momenta, without shared shifts: (size, 1)."""
        b, p, theta = self.like.tensors
        fields = (root.T @ part.flatten() for root, part in zip(self._roots, (b, p), strict=True))
        shifts = theta.new_zeros(self._shifts)
        return torch.cat([*fields, theta / self.spec.prior_variance.sqrt(), shifts])[:, None]

    def _of_white(self, values: Tensor) -> Momenta:
        """The momenta L^-T values, without shared shifts: (size, 1)."""
        values_of_momenta = self._whiten(values, transposed=True)[:, 0]
        return self.like.unflatten(values_of_momenta[: len(values_of_momenta) - self._shifts])

    def _whiten(self, values: Tensor, *, transposed: bool = False) -> Tensor:
        """L^-1 values, or L^-T values if transposed."""
        b, p, theta, shifts = torch.split(values, [*(t.numel() for t in self.like.tensors), self._shifts])
        solved = [
            torch.linalg.solve_triangular(root.T if transposed else root, part, upper=transposed)
            for root, part in zip(self._roots, (b, p), strict=True)
        ]
        return torch.cat([*solved, theta * self.spec.prior_variance.sqrt()[:, None], shifts])


def _root(kernel: Kernel, nodes: list[NodeSensitivity]) -> Tensor:
    """Cholesky factor of the block of Q that belongs to one kernel."""
    terms = [kernel.gram(n.points, n.weight * n.effect, n.points, n.effect) for n in nodes]
    matrix = torch.stack(terms).sum(0)
    matrix = 0.5 * (matrix + matrix.T)
    matrix.diagonal().add_(JITTER_RATIO * float(matrix.diagonal().max().clamp(min=1e-300)) * len(matrix))
    factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        raise NumericalError.of(
            "the kernel matrix of the control points is not positive definite", fix="use fewer control points"
        )
    return factor
