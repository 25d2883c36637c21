"""Periodic errors of joints at one frequency each, such as those of reduction gears at multiples of their ratio.

    x_l + C cos(w x_l) + S sin(w x_l)

in place of x_l, for active joint l. The joint's value is taken on a line, not on a circle: w need not be an integer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.runtime.chain import Waves, turned, wave_slopes


@dataclass(frozen=True)
class GearWaves:
    """K waves; their coefficients are C and S of each wave in turn, (2 K,) in the unit of the joint.

    Raises InputError: a negative joint number, or a frequency that is not positive.
    """

    joints: tuple[int, ...] = ()  # numbers l of the active joints, K of them; a joint may have several waves
    frequencies: tuple[float, ...] = ()  # w, rad per unit of the joint; for an angle, periods per turn

    def __post_init__(self) -> None:
        for joint, frequency in zip(self.joints, self.frequencies, strict=True):
            if joint < 0 or not (isfinite(frequency) and frequency > 0):
                expected = "joint numbers of 0 or more and positive frequencies"
                raise InputError.of("the waves of gears", expected=expected, got=(joint, frequency))

    @property
    def size(self) -> int:
        """2 K, number of coefficients."""
        return 2 * len(self.joints)

    def to_config(self) -> list[list[float]]:
        """Joint and frequency of every wave, as model files hold them."""
        return [[joint, frequency] for joint, frequency in zip(self.joints, self.frequencies, strict=True)]

    @classmethod
    def from_config(cls, config: Sequence[Sequence[float]]) -> GearWaves:
        """The inverse of :meth:`to_config`."""
        return cls(tuple(int(joint) for joint, _ in config), tuple(float(frequency) for _, frequency in config))

    def check(self, n: int) -> None:
        """Raise InputError unless all joints are among n active ones."""
        if any(joint >= n for joint in self.joints):
            raise InputError.of("the joints of gear waves", expected=f"numbers below {n}", got=list(self.joints))

    def columns(self, x: Tensor) -> Tensor:
        """cos(w x_l) and sin(w x_l) of every wave: (N, n) -> (N, 2 K)."""
        angles = x[:, list(self.joints)] * x.new_tensor(self.frequencies)
        return torch.stack([angles.cos(), angles.sin()], -1).flatten(1)

    def turned(self, x: Tensor, coefficients: Tensor) -> Tensor:
        """The joint values with their waves: (N, n) -> (N, n)."""
        return turned(self._waves(x, coefficients), x, torch)

    def slopes(self, x: Tensor, coefficients: Tensor) -> Tensor:
        """Derivative of :meth:`turned`, which is diagonal: (N, n) -> (N, n)."""
        return wave_slopes(self._waves(x, coefficients), x, torch)

    def _waves(self, x: Tensor, coefficients: Tensor) -> Waves:
        own = torch.nn.functional.one_hot(torch.tensor(self.joints, dtype=torch.int64, device=x.device), x.shape[1])
        return Waves(self.joints, own.to(x.dtype), x.new_tensor(self.frequencies), coefficients.view(-1, 2))
