"""Conditioning in the momenta of control points: normal equations of size M (n + d P) + K.

Around a deformation, k1(x_i) = A (b, p, theta) to first order, where momenta b of the controls act at
time s as Mx_s^-T b, and the energy of the fields is 1/2 (b, p, theta)^T Q (b, p, theta):

    A = [sum_s c_s Theta_s K_V Mx_s^-T,  sum_t c_t Phi_t K_W My_t^-T,  Dpsi S]
    Q = diag(sum_s c_s Mx_s^-1 K_V Mx_s^-T,  sum_t c_t My_t^-1 K_W My_t^-T,  Lambda)
    H = Q + A^T R^-1 A

H itself is too ill-conditioned for float64. In the coordinates u = L^T (b, p, theta) with Q = L L^T, in which
the prior is white, it becomes I + B^T B with B = R^-1/2 A L^-T. Shifts that rows share are unknowns with a white prior.

Processes that share kernel sums (backend "distributed") share the rows of A too.

If the controls are the data, this gives the same momenta as G + R, at a higher cost.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.reductions.distributed import ranks_of
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import NOISE_ADVICE, Conditional, Features

JITTER_RATIO = 1e-13
"""Added to the diagonal of the controls' kernel matrices, relative to its largest entry: the level of rounding."""
BLOCK_ENTRIES = 1 << 23
"""Number of entries of A that are computed together (64 MiB)."""
INFORMED_SHARE = 1e-9
"""Directions of the momenta about which the data say less than this share of what they say about the best known."""
MAX_KEPT_ENTRIES = 1 << 27
"""Largest number of entries for which A is kept for the right-hand side (1 GiB) instead of being computed twice."""


class ControlPointRegression(Conditional):
    """Factorised normal equations around a deformation.

    Args:
        deformation: the deformation to linearise, whose controls carry the momenta.
        data: its linearisation at the N data.
        noise: R, (N, m, m) blocks.
    """

    def __init__(self, deformation: GeodesicDeformation, data: Linearisation, noise: Noise) -> None:
        self.spec: ModelSpec = deformation.spec
        self.like, self.data, self.noise = deformation.momenta, data, noise
        self.joint, self.task = deformation.momentum_sensitivities()
        self._roots = [
            _root(kernel, nodes)
            for kernel, nodes in ((self.spec.joint_kernel, self.joint), (self.spec.task_kernel, self.task))
        ]
        self._shifts = noise.shared.shape[2]
        size = sum(t.numel() for t in self.like.tensors) + self._shifts
        self._ranks = ranks_of(deformation.backends)
        hessian = torch.eye(size, dtype=deformation.x.dtype, device=deformation.x.device) / self._ranks.count
        n, m, _ = data.sensitivity.shape
        self._kept: list[Tensor] | None = [] if size * n * m <= MAX_KEPT_ENTRIES else None
        with large_work(size * n * m):
            for rows in self._ranks.mine(self._blocks(size)):
                white = self._white_rows(rows)
                hessian.addmm_(white, white.T)
                if self._kept is not None:
                    self._kept.append(white)
            (hessian,) = self._ranks.total([hessian])
            self.core, info = torch.linalg.cholesky_ex(hessian)  # its smallest eigenvalue is 1
        if int(info):
            what = "the normal equations of the control points are singular"
            raise NumericalError.of(what, fix=NOISE_ADVICE)

    def momenta(self, target: Tensor) -> Momenta:
        """H^-1 A^T R^-1 target."""
        size = len(self.core)
        total = target.new_zeros(size, 1)
        white = self.noise.whiten(target[:, :, None])
        for number, rows in enumerate(self._ranks.mine(self._blocks(size))):
            columns = self._white_rows(rows) if self._kept is None else self._kept[number]
            total += columns @ white[rows].reshape(-1, 1)
        (total,) = self._ranks.total([total])
        found = self._whiten(torch.cholesky_solve(total, self.core), transposed=True)[:, 0]
        return self.like.unflatten(found[: size - self._shifts])

    def response(self, momenta: Momenta) -> Tensor:
        """A (b, p, theta): (N, m)."""
        vector = torch.nn.functional.pad(momenta.flatten(), (0, self._shifts))
        found = vector.new_zeros(self.data.sensitivity.shape[:2])
        for rows in self._ranks.mine(self._blocks(len(vector))):
            found[rows] = (self._rows(self.data.rows(rows)) @ vector).view(len(rows), -1)
        return self._ranks.total([found])[0]

    def weighted_residual(self) -> Tensor:
        """R^-1 (y - k1) (N, m) of the smallest residuals for which the deformation's momenta are the optimum.

        In coordinates in which their prior is white these momenta are u = B^T R^-1/2 (y - k1), whose least-squares
        solution is R^-1/2 (y - k1) = B (B^T B)^+ u.
        """
        b, p, theta = self.like.tensors
        roots = zip(self._roots, (b, p), strict=True)
        u = torch.cat([*(root.T @ part.flatten() for root, part in roots), theta / self.spec.prior_variance.sqrt()])
        size = len(u)
        informed = (self.core @ self.core.T)[:size, :size]
        informed.diagonal().sub_(1.0)
        values, vectors = torch.linalg.eigh(informed)
        seen = values > INFORMED_SHARE * values[-1]
        solved = vectors[:, seen] @ ((vectors[:, seen].T @ u) / values[seen])
        padded = torch.nn.functional.pad(solved, (0, self._shifts))[:, None]
        momenta = self.like.unflatten(self._whiten(padded, transposed=True)[:size, 0])
        return self.noise.own.solve(self.response(momenta))

    @property
    def size(self) -> int:
        """Number of momenta, parameters and shared shifts."""
        return len(self.core)

    def posterior(self, at: Linearisation) -> Tensor:
        """Prior minus the part that the controls can express, plus the posterior of that part: (M, r, r)."""
        rows = self._rows(at)
        with large_work(rows.numel()):
            expressed = self._whiten(rows.T)  # (size, M r)
            left = torch.linalg.solve_triangular(self.core, expressed, upper=False)
        before, after = (part.T.reshape(*at.sensitivity.shape[:2], -1) for part in (expressed, left))
        return at.own_blocks() - before @ before.mT + after @ after.mT

    def covariance_between(self, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        """The same between two linearisations: (M m, M' m')."""
        mine, theirs = (self._whiten(self._rows(points or at).T) for points in (at, other))
        left, right = (torch.linalg.solve_triangular(self.core, part, upper=False) for part in (mine, theirs))
        return at.gram(other) - mine.T @ theirs + left.T @ right

    def features(self, at: Linearisation) -> Features:
        """What the controls can express of the fields, and its posterior together with that of the parameters."""
        expressed = self._whiten(self._rows(at).T)
        fields = len(expressed) - self.like.theta.numel()
        left = torch.linalg.solve_triangular(self.core, expressed, upper=False)
        return Features.of((expressed[:fields], -1), (left, 1))

    def _blocks(self, size: int) -> tuple[Tensor, ...]:
        n, m, _ = self.data.sensitivity.shape
        return torch.arange(n, device=self.data.sensitivity.device).split(max(1, BLOCK_ENTRIES // (size * m)))

    def _rows(self, at: Linearisation) -> Tensor:
        """Rows of A for the configurations of a linearisation, which take part in no shared shift: (M m, size)."""
        columns = []
        for kernel, points, controls in (
            (self.spec.joint_kernel, at.joint, self.joint),
            (self.spec.task_kernel, at.task, self.task),
        ):
            terms = [
                kernel.gram(c.points, c.effect, a.points, a.weight * a.effect).T
                for a, c in zip(points, controls, strict=True)
            ]
            columns.append(torch.stack(terms).sum(0) if len(terms) > 1 else terms[0])
        slopes = at.sensitivity.flatten(0, 1)
        return torch.cat([*columns, slopes, slopes.new_zeros(len(slopes), self._shifts)], 1)

    def _white_rows(self, rows: Tensor) -> Tensor:
        """Columns of B^T for the data with these row numbers: (size, M m)."""
        a = self._rows(self.data.rows(rows))
        a[:, a.shape[1] - self._shifts :] = self.noise.shared[rows].flatten(0, 1)
        return self._whiten(self.noise.whiten(a.view(len(rows), -1, a.shape[1]), rows).flatten(0, 1).T)

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
