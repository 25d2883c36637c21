"""A fitted k1 as users hold it, whatever the formulation: call, Jacobian, inverse."""

from __future__ import annotations

from typing import Generic, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import NumericalError, sentence
from diffeo_calib.maps.deformation import Deformation
from diffeo_calib.maps.noise import Noise

NEWTON_ITERATIONS = 50
LONGEST_STEP = 0.5
"""Longest step of one joint in the search for an inverse, rad or m."""
INVERSE_STEP = 1e-12
"""The search has settled when no joint moves by more, rad or m."""
INVERSE_RESIDUAL = 1e-9
"""Largest miss of a target that can be reached, m."""

D = TypeVar("D", bound=Deformation)


class DeformedMap(Generic[D]):
    """k1 with fitted momenta, in any formulation.

    Args:
        deformation: k1 for the fitted momenta.
        noise: covariance of the measurements it was fitted to.
        x: (N, n) configurations of these measurements; the deformation's control points by default.
    """

    def __init__(self, deformation: D, noise: Noise, x: Tensor | None = None) -> None:
        self.deformation = deformation
        self.noise = noise
        self.x = deformation.x if x is None else x

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.deformation.x.shape[1]

    @property
    def m(self) -> int:
        """Number of task coordinates."""
        return self.noise.covariance.shape[1]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.n} -> {self.m} coordinates, {len(self.deformation.x)} controls)"

    def __call__(self, x: object) -> Tensor:
        """Calibrated task coordinates.

        Args:
            x: (M, n) configurations, rad or m.

        Returns:
            (M, m) in m, differentiable by autograd in x.

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        return self.deformation(self._configurations(x))

    def jacobian(self, x: object) -> Tensor:
        """Dk1 as the formulation carries it: (M, n) -> (M, m, n), m/rad or m/m."""
        return self.deformation.jacobian(self._configurations(x))

    def inverse(self, y: object, start: object) -> Tensor:
        """Configurations x with k1(x) = y: compensation of a commanded target.

        Gauss-Newton with :meth:`jacobian` and the smallest change of the joints. With more joints than
        coordinates the answer is the one nearest to ``start`` to first order; with more coordinates than
        joints (several markers) it is the least-squares solution. Joint limits are not enforced.

        Args:
            y: (M, m) targets in m. start: (M, n) initial configurations, e.g. from nominal inverse kinematics.

        Returns:
            (M, n).

        Raises:
            NumericalError: some target is out of reach from its start, or the search did not settle.
        """
        x = self._configurations(start)
        target = as_tensor(y, "y", (len(x), self.m), empty=True)
        residual = target
        for _ in range(NEWTON_ITERATIONS):
            residual = target - self.deformation(x)
            step = (torch.linalg.pinv(self.deformation.jacobian(x), rtol=1e-8) @ residual[:, :, None])[:, :, 0]
            if not bool((step.abs() > INVERSE_STEP).any()):
                break
            x = x + step * (LONGEST_STEP / step.abs().amax(1, keepdim=True).clamp(min=LONGEST_STEP))
        else:
            raise NumericalError(_unreachable(residual, f"the search still moves after {NEWTON_ITERATIONS} steps"))
        if self.m <= self.n and bool((residual.abs() > INVERSE_RESIDUAL).any()):
            raise NumericalError(_unreachable(residual, "the nearest configuration misses it"))
        return x

    def _configurations(self, x: object) -> Tensor:
        return as_tensor(
            x, "x", ("M", self.n), fix=f"pass the {self.n} joints of each configuration in a row", empty=True
        )


def _unreachable(residual: Tensor, what: str) -> str:
    """Message naming the target with the largest residual."""
    miss = residual.norm(dim=1)
    row = int(miss.argmax())
    return sentence(
        f"no configuration was found for target {row}: {what}",
        got=f"a distance of {float(miss[row]):.2e} m",
        fix="start nearer to the target; it may be out of reach or singular",
    )
