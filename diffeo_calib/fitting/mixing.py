"""Anderson mixing: what past steps of a fixed-point iteration say about the point where it will end.

Gauss-Newton leaves out how slopes change, so that near the optimum every step repeats a share of the one before. With
the points x_k, their targets g_k and the steps f_k = g_k - x_k, the next point is

    x = g_k - sum_j c_j (g_j+1 - g_j),    c = argmin |f_k - sum_j c_j (f_j+1 - f_j)|,

which ends in the same point after fewer steps (Anderson 1965, "Iterative procedures for nonlinear integral
equations"; Walker and Ni 2011, "Anderson acceleration for fixed-point iterations").
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from diffeo_calib.maps.deformation import Momenta

DEPTH = 5
"""Number of differences between steps that are kept."""


class Mixing:
    """The last targets of a fixed-point iteration and the steps to them.

    Steps are compared by their task momenta: at the optimum these determine b and theta, and they alone have one unit.
    """

    def __init__(self) -> None:
        self._targets: list[Tensor] = []
        self._steps: list[Tensor] = []

    def forget(self) -> None:
        """Start again, after a mixed point that was rejected."""
        self._targets, self._steps = [], []

    def mixed(self, current: Momenta, target: Momenta) -> Momenta | None:
        """The mixed point.

        Args:
            current: where the iteration is. target: where its step leads.

        Returns:
            None where there is no earlier step to compare with, or none that differs.
        """
        self._targets = [*self._targets[-DEPTH:], target.flatten()]
        self._steps = [*self._steps[-DEPTH:], (target.task - current.task).flatten()]
        if len(self._steps) == 1:
            return None
        changes, moved = (
            torch.stack([after - before for before, after in pairwise(kept)], 1)
            for kept in (self._steps, self._targets)
        )
        # By singular values: differences of steps near rounding are as good as parallel.
        U, s, Vt = torch.linalg.svd(changes, full_matrices=False)
        kept = s > torch.finfo(s.dtype).eps * len(U) * s[0]
        share = Vt.T[:, kept] @ ((U.T @ self._steps[-1])[kept] / s[kept])
        mixed = self._targets[-1] - moved @ share
        return target.unflatten(mixed) if bool(kept.any()) and bool(mixed.isfinite().all()) else None
