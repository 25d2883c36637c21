"""Time stepping on t in [0, 1]: what every integrator offers, and RK4 with few fixed steps.

H is not separable, so symplectic schemes buy nothing here; classical RK4 with 1 to 4 steps reaches
the accuracy that deformations of robots need. Backpropagation through the steps is the exact
discrete adjoint.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from diffeo_calib.errors import InputError, sentence

Field = Callable[[int, Tensor], Tensor]
"""``field(stage, state)``: time derivative of the state at the numbered stage of the run."""

STAGES = 4
"""Right-hand sides per RK4 step; stage number s of step k is 4 k + s."""


class Integrator(ABC):
    """A method of time stepping that reports the state at equally spaced nodes.

    Attributes:
        intervals: number of intervals between the nodes.
        replayable: whether the stages of every run are at the same times, so that a recorded run can be played
            back to something that rides along.
        error_per_change: the error of a run, as a multiple of what changes when it is :meth:`refined`.
    """

    replayable: ClassVar[bool]

    @property
    @abstractmethod
    def intervals(self) -> int:
        """Number of intervals of the time grid."""

    @property
    @abstractmethod
    def error_per_change(self) -> float:
        """By Richardson: 1 / (1 - 2^-order) if the step is halved."""

    @abstractmethod
    def nodes(self, field: Field, state: Tensor) -> list[Tensor]:
        """Integrate ``state' = field(stage, state)`` and return the states at the intervals + 1 nodes.

        Args:
            field: right-hand side; if the method is replayable the stage number lets it look up a recorded run.
            state: initial state, any shape.
        """

    @abstractmethod
    def refined(self) -> Integrator:
        """A more accurate version of the same method."""

    def weights(self) -> list[float]:
        """Quadrature weights of the nodes: Simpson for an even number of intervals, else trapezoid."""
        count = self.intervals
        if count % 2:
            return [(0.5 if k in (0, count) else 1.0) / count for k in range(count + 1)]
        inner = [4.0 if k % 2 else 2.0 for k in range(1, count)]
        return [w / (3.0 * count) for w in (1.0, *inner, 1.0)]


@dataclass(frozen=True)
class RK4(Integrator):
    """Classical Runge-Kutta method of order 4 with a fixed number of equal steps.

    Args:
        steps: number of steps on [0, 1]; the end point's error falls as steps^-4.
    """

    steps: int = 2
    replayable: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not isinstance(self.steps, int) or self.steps < 1:
            raise InputError(sentence("`steps` of RK4", expected="an integer of at least 1", got=self.steps))

    @property
    def intervals(self) -> int:
        """The steps."""
        return self.steps

    @property
    def error_per_change(self) -> float:
        """16/15: order 4."""
        return 16.0 / 15.0

    def nodes(self, field: Field, state: Tensor) -> list[Tensor]:
        """The states at the steps + 1 nodes."""
        states = [state]
        for step in range(self.steps):
            states.append(self._step(field, STAGES * step, states[-1]))
        return states

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
