"""Time stepping on t in [0, 1] with few fixed steps.

H is not separable, so symplectic schemes buy nothing here; classical RK4 with 1 to 4 steps reaches
the accuracy that deformations of robots need. Backpropagation through the steps is the exact
discrete adjoint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from diffeo_calib.errors import InputError, sentence

Field = Callable[[int, Tensor], Tensor]
"""``field(stage, state)``: time derivative of the state at the numbered stage of the run."""

STAGES = 4
"""Right-hand sides per RK4 step; stage number s of step k is 4 k + s."""


@dataclass(frozen=True)
class RK4:
    """Classical Runge-Kutta method of order 4 with a fixed number of equal steps.

    Args:
        steps: number of steps on [0, 1]; the end point's error falls as steps^-4.
    """

    steps: int = 2

    def __post_init__(self) -> None:
        if not isinstance(self.steps, int) or self.steps < 1:
            raise InputError(sentence("`steps` of RK4", expected="an integer of at least 1", got=self.steps))

    def nodes(self, field: Field, state: Tensor) -> list[Tensor]:
        """Integrate ``state' = field(stage, state)`` and return the states at the steps + 1 nodes.

        Args:
            field: right-hand side; the stage number lets it look up a recorded path.
            state: initial state, any shape.
        """
        states = [state]
        for step in range(self.steps):
            states.append(self._step(field, STAGES * step, states[-1]))
        return states

    def weights(self) -> list[float]:
        """Quadrature weights of the nodes: Simpson for an even number of steps, else trapezoid."""
        if self.steps % 2:
            return [(0.5 if k in (0, self.steps) else 1.0) / self.steps for k in range(self.steps + 1)]
        inner = [4.0 if k % 2 else 2.0 for k in range(1, self.steps)]
        return [w / (3.0 * self.steps) for w in (1.0, *inner, 1.0)]

    def refined(self) -> RK4:
        """The same method with twice the steps."""
        return RK4(2 * self.steps)

    def _step(self, field: Field, stage: int, y: Tensor) -> Tensor:
        h = 1.0 / self.steps
        k1 = field(stage, y)
        k2 = field(stage + 1, y + 0.5 * h * k1)
        k3 = field(stage + 2, y + 0.5 * h * k2)
        k4 = field(stage + 3, y + h * k3)
        return y + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
