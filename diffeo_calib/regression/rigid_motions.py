"""A conditional whose covariances leave out rigid motions of all points.

Without a measuring device nothing says where the robot stands. Errors e of the model at reference configurations X are
split into the rigid motion w = B(X)^+ e(X) that fits them best, and the rest; what counts at x is

    e(x) - B(x) w,    covariance  C(x, x') - C(x, w) B(x')^T - B(x) C(w, x') + B(x) C(w, w) B(x')^T,

with B(x) the derivatives of k1(x) by the twist of the base, columns of the sensitivity to theta.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.regression.conditional import Conditional, Features

ROWS_AT_ONCE = 64  # configurations whose covariances with the reference are computed together


class WithoutRigidMotions(Conditional):
    """The same conditional without rigid motions.

    Args:
        conditional: with them.
        reference: linearisation at the configurations X.
        base: numbers of the six parameters that move the base.
    """

    def __init__(self, conditional: Conditional, reference: Linearisation, base: Sequence[int]) -> None:
        self.size = conditional.size
        self.conditional, self.reference, self.base = conditional, reference, list(base)
        self.fit = torch.linalg.pinv(reference.sensitivity.flatten(0, 1)[:, self.base])  # (6, M m)
        self.motion = self.fit @ conditional.covariance_between(reference) @ self.fit.mT

    @property
    def inner(self) -> Conditional:
        return self.conditional

    def features(self, at: Linearisation) -> Features:
        what, fix = "covariances without rigid motions have no features", "ask for them, or use the conditional"
        raise InputError.of(what, fix=fix)

    def compared(self, points: Tensor, targets: Tensor, fit: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        T = fit(points, targets)
        return points @ T[:3, :3].mT + T[:3, 3]

    def with_motion(self, at: Linearisation) -> Tensor:
        """Covariance of points with the rigid motion w: (M r, 6)."""
        rows = torch.arange(len(at.sensitivity), device=at.sensitivity.device).split(ROWS_AT_ONCE)
        between = [self.conditional.covariance_between(self.reference, at.rows(some)) for some in rows]
        return torch.cat([part.mT @ self.fit.mT for part in between])

    def posterior(self, at: Linearisation) -> Tensor:
        B = at.sensitivity[..., self.base]  # (M, r, 6)
        cross = self.with_motion(at).view(B.shape) @ B.mT
        return self.conditional.posterior(at) - cross - cross.mT + B @ self.motion @ B.mT

    def covariance_between(self, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        second = at if other is None else other
        B, B2 = (one.sensitivity.flatten(0, 1)[:, self.base] for one in (at, second))
        first = self.with_motion(at) @ B2.mT
        return (
            self.conditional.covariance_between(at, other)
            - first
            - B @ self.with_motion(second).mT
            + B @ self.motion @ B2.mT
        )
