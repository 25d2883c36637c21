"""Time stepping on t in [0, 1]: the interface of integrators, and Runge-Kutta methods with few fixed steps.

H is not separable, so symplectic schemes have no advantage here. Classical RK4 with 1 or 2 steps is accurate
enough for deformations of robots, one step of order 8 for large deformations. Backpropagation through the
steps is the exact discrete adjoint.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_count
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.runtime.arrays import MOST_STEPS, TABLEAUS

RightHandSide = Callable[[int, Tensor], Tensor]
"""``field(stage, state)``: time derivative of the state at the numbered stage of the run."""
Rate = Callable[[Tensor], Tensor]


class Integrator(ABC):
    """A method of time stepping that reports the state at equally spaced nodes.

    Attributes:
        kind: name in model files.
        intervals: number of intervals between the nodes.
        replayable: whether the stages of every run are at the same times, so that passive points can be integrated
            with the recorded stages of an earlier run.
        error_per_change: the error of a run divided by its change when it is :meth:`refined`.
    """

    kind: ClassVar[str]
    replayable: ClassVar[bool]

    def to_config(self) -> dict[str, Any]:
        """Kind and constructor arguments, as model files record them.

        Raises:
            InputError: not an integrator of this package (a dataclass with a kind).
        """
        if not is_dataclass(self) or not hasattr(self, "kind"):
            expected = "dc.RK4, dc.RK8 or dc.TorchDiffEq"
            raise InputError.of("the integrator cannot be saved", expected=expected, got=as_written(self))
        return {"kind": self.kind, **asdict(self)}

    @property
    @abstractmethod
    def intervals(self) -> int:
        """Number of intervals of the time grid."""

    @property
    @abstractmethod
    def error_per_change(self) -> float:
        """By Richardson extrapolation: 1 / (1 - 2^-order) if the step is halved."""

    @abstractmethod
    def nodes(self, field: RightHandSide, state: Tensor) -> list[Tensor]:
        """Integrate ``state' = field(stage, state)`` and return the states at the intervals + 1 nodes.

        Args:
            field: right-hand side. With a replayable method it can use the stage number to look up a recorded run.
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


class Run:
    """A run of controls that others follow with the same stages.

    Args:
        integrator: time stepping. field: right-hand side of the controls. start: their initial state, any shape.

    Attributes:
        nodes: the controls' states at the nodes of the time grid.
        stages: what is ``kept`` of them at every stage; empty if the method is not replayable.
    """

    def __init__(self, integrator: Integrator, field: Rate, start: Tensor, kept: Rate = lambda state: state) -> None:
        self.integrator, self.stages = integrator, (stages := list[Tensor]())

        def recorded(_: int, state: Tensor) -> Tensor:
            if integrator.replayable:
                stages.append(kept(state))
            return field(state)

        self.nodes = integrator.nodes(recorded, start)

    def alongside(self, field: Callable[[Tensor, Tensor], Tensor], start: Tensor, rate: Rate) -> list[Tensor]:
        """The states at the nodes of ``state' = field(state, controls)``, from any state.

        The controls' stages are replayed; if the method is not replayable, the controls follow their ``rate`` again.
        """
        if self.integrator.replayable:
            return self.integrator.nodes(lambda stage, state: field(state, self.stages[stage]), start)
        controls = self.nodes[0]
        size = controls.numel()

        def packed_field(_: int, packed: Tensor) -> Tensor:
            live, state = packed[:size].view_as(controls), packed[size:].view_as(start)
            return torch.cat([rate(live).flatten(), field(state, live).flatten()])

        nodes = self.integrator.nodes(packed_field, torch.cat([controls.flatten(), start.flatten()]))
        return [node[size:].view_as(start) for node in nodes]


_TENSORS: dict[str, tuple[Tensor, Tensor]] = {}  # tableaus that were used, by the kinds of their methods


@dataclass(frozen=True)
class RungeKutta(Integrator):
    """An explicit Runge-Kutta method with a fixed number of equal steps.

    Args:
        steps: number of steps on [0, 1]; the end point's error falls as steps^-order.
    """

    steps: int = 1
    order: ClassVar[int]
    replayable: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_count(self.steps, f"`steps` of {type(self).__name__}", most=MOST_STEPS)

    @classmethod
    def tableau(cls) -> tuple[Tensor, Tensor]:
        """Coefficients A (s, s), strictly lower triangular, and weights (s,)."""
        if cls.kind not in _TENSORS:  # not functools.cache, of which torch.compile warns
            coefficients, weights = TABLEAUS[cls.kind]()
            _TENSORS[cls.kind] = torch.from_numpy(coefficients), torch.from_numpy(weights)
        return _TENSORS[cls.kind]

    @property
    def intervals(self) -> int:
        return self.steps

    @property
    def error_per_change(self) -> float:
        """For twice the steps, by the order of the method."""
        return 1.0 / (1.0 - 2.0**-self.order)

    def nodes(self, field: RightHandSide, state: Tensor) -> list[Tensor]:
        coefficients, weights = (t.to(state) / self.steps for t in self.tableau())
        states = [state]
        for step in range(self.steps):
            y, first, slopes = states[-1], step * len(weights), []
            for stage, row in enumerate(coefficients):
                slopes.append(field(first + stage, _advanced(y, row, slopes)))
            states.append(_advanced(y, weights, slopes))
        return states

    def refined(self) -> RungeKutta:
        return type(self)(2 * self.steps)


def _advanced(y: Tensor, coefficients: Tensor, slopes: list[Tensor]) -> Tensor:
    """y + sum_k c_k slope_k."""
    if not slopes:
        return y
    return y + torch.tensordot(coefficients[: len(slopes)], torch.stack(slopes), 1)


@dataclass(frozen=True)
class RK4(RungeKutta):
    """The classical method of order 4: 4 stages per step, accurate enough for deformations of millimetres.

    Args:
        steps: number of steps on [0, 1].
    """

    steps: int = 2
    kind: ClassVar[str] = "rk4"
    order: ClassVar[int] = 4


@dataclass(frozen=True)
class RK8(RungeKutta):
    """The method of order 8 by Dormand and Prince (as in Hairer's DOP853): 12 stages per step.

    One step costs as much as three steps of RK4 and is more accurate than twenty.

    Args:
        steps: number of steps on [0, 1].
    """

    kind: ClassVar[str] = "rk8"
    order: ClassVar[int] = 8
