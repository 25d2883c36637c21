"""Sums over one materialised matrix: fastest for few points, O(M N) memory, differentiable by autograd."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, Points
from diffeo_calib.kernels.reductions.pairs import MatrixPairs, weighted_sums


class Dense:
    """Evaluates all pairs at once."""

    differentiable: ClassVar[bool] = True

    def usable(self) -> bool:
        """Always."""
        return True

    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> list[Tensor]:
        """The sums of a formula, (M, k) each; rows None for the columns themselves."""
        weights = formula.weights(MatrixPairs(), profile, columns if rows is None else rows, columns)
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        return [s.T for s in weighted_sums(weights, summands)]
