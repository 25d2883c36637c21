"""Conditioning in the momenta of control points: normal equations of size M (n + d P) + K.

Around a deformation k1(x_i) = A (b, p, theta) to first order, where momenta b of the controls act at
time s as Mx_s^-T b, and the energy of the fields is 1/2 (b, p, theta)^T Q (b, p, theta):

    A = [sum_s c_s Theta_s K_V Mx_s^-T,  sum_t c_t Phi_t K_W My_t^-T,  Dpsi S]
    Q = diag(sum_s c_s Mx_s^-1 K_V Mx_s^-T,  sum_t c_t My_t^-1 K_W My_t^-T,  Lambda)
    H = Q + A^T R^-1 A

H alone is too ill-conditioned for float64. In coordinates u = L^T (b, p, theta) where Q = L L^T is the
identity it is I + B^T B with B = R^-1/2 A L^-T: prior white, data white.

Where the controls are the data, it gives the same momenta as G + R does, at a higher price.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError, sentence
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import Conditional, diagonal_blocks

JITTER = 1e-13
"""Added to the kernel matrices of the controls, relative to their largest variance: below it directions are rounding
errors."""
BLOCK_ELEMENTS = 1 << 23
"""Entries of A that are worked on at once (64 MiB)."""
MOST_KEPT = 1 << 27
"""Entries up to which A is kept for the right-hand side (1 GiB), instead of being made twice."""


class ControlPointRegression(Conditional):
    """Factorised normal equations around a deformation.

    Args:
        deformation: where to linearise; its controls carry the momenta.
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
        size = sum(t.numel() for t in self.like.tensors)
        hessian = torch.eye(size, dtype=deformation.x.dtype, device=deformation.x.device)
        n, m, _ = data.sensitivity.shape
        self._kept: list[Tensor] | None = [] if size * n * m <= MOST_KEPT else None
        for rows in self._blocks(size):
            white = self._white_rows(rows)
            hessian.addmm_(white, white.T)
            if self._kept is not None:
                self._kept.append(white)
        self.core, info = torch.linalg.cholesky_ex(hessian)  # its smallest eigenvalue is 1
        if int(info):
            fix = "raise `noise` or lower the kernels' variances"
            raise NumericalError(sentence("the normal equations of the control points are singular", fix=fix))

    def momenta(self, target: Tensor) -> Momenta:
        """H^-1 A^T R^-1 target."""
        size = len(self.core)
        total = target.new_zeros(size, 1)
        white = self.noise.whiten(target[:, :, None])
        for number, rows in enumerate(self._blocks(size)):
            columns = self._white_rows(rows) if self._kept is None else self._kept[number]
            total += columns @ white[rows].reshape(-1, 1)
        return self.like.unflatten(self._unwhiten(torch.cholesky_solve(total, self.core))[:, 0])

    def response(self, momenta: Momenta) -> Tensor:
        """A (b, p, theta): (N, m)."""
        vector, parts = momenta.flatten(), []
        for rows in self._blocks(len(vector)):
            parts.append((self._rows(self.data.rows(rows)) @ vector).view(len(rows), -1))
        return torch.cat(parts)

    def covariance(self, at: Linearisation) -> Tensor:
        """Prior minus what the controls can express, plus what the data leave of that: (M, m, m)."""
        rows = len(at.sensitivity)
        expressed = self._whiten(self._rows(at).T)  # (size, M m)
        left = torch.linalg.solve_triangular(self.core, expressed, upper=False)
        return diagonal_blocks(at.gram() - expressed.T @ expressed + left.T @ left, rows)

    def _blocks(self, size: int) -> tuple[Tensor, ...]:
        n, m, _ = self.data.sensitivity.shape
        return torch.arange(n, device=self.data.sensitivity.device).split(max(1, BLOCK_ELEMENTS // (size * m)))

    def _rows(self, at: Linearisation) -> Tensor:
        """Rows of A at some configurations: (M m, size)."""
        columns = []
        for kernel, there, here in (
            (self.spec.joint_kernel, at.joint, self.joint),
            (self.spec.task_kernel, at.task, self.task),
        ):
            terms = [
                kernel.gram(a.points, a.weight * a.effect, c.points, c.effect) for a, c in zip(there, here, strict=True)
            ]
            columns.append(torch.stack(terms).sum(0) if len(terms) > 1 else terms[0])
        return torch.cat([*columns, at.sensitivity.flatten(0, 1)], 1)

    def _white_rows(self, rows: Tensor) -> Tensor:
        """Columns of B^T at some configurations: (size, M m)."""
        a = self._rows(self.data.rows(rows))
        return self._whiten(self.noise.whiten(a.view(len(rows), -1, a.shape[1]), rows).flatten(0, 1).T)

    def _whiten(self, values: Tensor) -> Tensor:
        """L^-1 values."""
        b, p, theta = torch.split(values, [t.numel() for t in self.like.tensors])
        first, second = (
            torch.linalg.solve_triangular(root, part, upper=False)
            for root, part in zip(self._roots, (b, p), strict=True)
        )
        return torch.cat([first, second, theta * self.spec.prior_variance.sqrt()[:, None]])

    def _unwhiten(self, values: Tensor) -> Tensor:
        """L^-T values."""
        b, p, theta = torch.split(values, [t.numel() for t in self.like.tensors])
        first, second = (
            torch.linalg.solve_triangular(root.T, part, upper=True)
            for root, part in zip(self._roots, (b, p), strict=True)
        )
        return torch.cat([first, second, theta * self.spec.prior_variance.sqrt()[:, None]])


def _root(kernel: Kernel, nodes: list[NodeSensitivity]) -> Tensor:
    """Cholesky factor of a block of Q."""
    terms = [kernel.gram(n.points, n.weight * n.effect, n.points, n.effect) for n in nodes]
    matrix = torch.stack(terms).sum(0)
    matrix = 0.5 * (matrix + matrix.T)
    matrix.diagonal().add_(JITTER * float(matrix.diagonal().max().clamp(min=1e-300)) * len(matrix))
    factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        raise NumericalError(
            sentence("the kernel matrix of the control points is not positive definite", fix="use fewer control points")
        )
    return factor
