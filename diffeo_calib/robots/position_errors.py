"""Errors of joints that depend on their own position.

Waves of reduction gears, at multiples of their ratio, add C cos(w x) + S sin(w x) to the value x of an active joint,
taken on a line and not on a circle: w need not be an integer. Straightness, scale, roll, pitch and yaw of a guide, or
the wobble of a bearing, shift and turn the frame before a moving joint, in addition to its constant error twist:

    tau(x) = sum_k c_k cos(k pi (x - low) / (high - low)),    k = 1 ... K.

They are smooth functions of a Gaussian process on [low, high] (A. Solin, S. Sarkka, "Hilbert space methods for
reduced-rank Gaussian process regression", 2020), constant beyond.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from diffeo_calib.common.errors import InputError


@dataclass(frozen=True)
class PositionErrors:
    """Waves of gears and errors of axes.

    Raises InputError: a negative joint number, a frequency that is not positive, or an empty range.
    """

    waves: tuple[tuple[int, float], ...] = ()  # active joint, of which there may be several; w, rad per unit of it
    axes: tuple[tuple[int, float, float, int], ...] = ()  # moving joint; low, high, rad or m; count K

    def __post_init__(self) -> None:
        for joint, frequency in self.waves:
            if joint < 0 or not (isfinite(frequency) and frequency > 0):
                expected = "joint numbers of 0 or more and positive frequencies"
                raise InputError.of("the waves of gears", expected=expected, got=(joint, frequency))
        for joint, low, high, count in self.axes:
            if joint < 0 or count < 1 or not (isfinite(high - low) and high > low):
                expected = "joint numbers of 0 or more, ranges and positive counts"
                raise InputError.of("the errors of axes", expected=expected, got=(joint, low, high, count))

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of coefficients of waves, C and S of each in turn, and of axes, c_1 of six components first."""
        return 2 * len(self.waves), sum(6 * count for *_, count in self.axes)

    def check(self, n: int, n_all: int) -> None:
        """Raise InputError unless all joints are among n active and n_all moving ones."""
        for what, each, most in (("gear waves", self.waves, n), ("axes", self.axes, n_all)):
            if any(one[0] >= most for one in each):
                raise InputError.of(f"the joints of {what}", expected=f"numbers below {most}", got=list(each))
