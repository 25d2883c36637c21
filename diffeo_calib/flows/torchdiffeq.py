"""Integration by torchdiffeq: its fixed-step and adaptive methods, and its continuous adjoint.

The adjoint needs the vector-Jacobian product of the right-hand side, which is one more kernel sum
(flows/geodesic.py), so both ``odeint`` and ``odeint_adjoint`` are cheap here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number, wrapped
from diffeo_calib.common.errors import InputError, NumericalError, as_written
from diffeo_calib.flows.integrators import MOST_STEPS, Integrator, RightHandSide

FIXED = {"midpoint": 2, "rk4": 4}  # methods with a fixed step, and their orders
ADAPTIVE = ("bosh3", "dopri5", "dopri8")  # methods that choose their steps by tolerances
MAX_ADAPTIVE_STEPS = 10_000  # largest number of adaptive steps between two nodes
FINEST_RTOL, FINEST_ATOL = 1e-13, 1e-16  # smallest tolerances that float64 can meet
REFINED_TOLERANCE_RATIO = 100.0  # factor by which the tolerances of an adaptive method shrink when it is refined


@dataclass(frozen=True)
class TorchDiffEq(Integrator):
    """``torchdiffeq.odeint`` or ``odeint_adjoint``.

    Args:
        method: "rk4" (the 3/8 rule) or "midpoint" with a fixed step; "bosh3", "dopri5" or "dopri8" with steps
            chosen by the tolerances.
        adjoint: whether gradients come from the adjoint equation, solved backwards in the memory of one state (exact
            only in the limit of small steps), or from backpropagation through the steps.
        step_size: 1, 1/2, 1/3, ...: the fixed step, or for an adaptive method the spacing of the nodes at which
            solvers evaluate the path.
        rtol, atol: tolerances of adaptive methods, relative and absolute (rad, m).
    """

    method: str = "rk4"
    adjoint: bool = False
    step_size: float = 0.25
    rtol: float = 1e-9
    atol: float = 1e-12
    kind: ClassVar[str] = "torchdiffeq"
    replayable: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.method not in (*FIXED, *ADAPTIVE):
            names = ", ".join((*FIXED, *ADAPTIVE))
            raise InputError.of("`method` of TorchDiffEq", expected=names, got=as_written(self.method))
        if not isinstance(self.adjoint, bool):
            raise InputError.of("`adjoint` of TorchDiffEq", expected="True or False", got=as_written(self.adjoint))
        check_number(self.step_size, "`step_size` of TorchDiffEq", above=0.0)
        check_number(self.rtol, "`rtol` of TorchDiffEq", above=0.99 * FINEST_RTOL, below=1.0)
        check_number(self.atol, "`atol` of TorchDiffEq", above=0.99 * FINEST_ATOL, below=1.0)
        step = self.step_size
        if not 0.999 / MOST_STEPS <= step <= 1.0 or abs(1.0 / step - round(1.0 / step)) > 1e-6:
            expected = f"1, 1/2, 1/3, ..., 1/{MOST_STEPS}"
            raise InputError.of("`step_size` of TorchDiffEq", expected=expected, got=step)

    @property
    def intervals(self) -> int:
        return round(1.0 / self.step_size)

    @property
    def error_per_change(self) -> float:
        """By the order of a fixed-step method; 1 for an adaptive one."""
        return 1.0 / (1.0 - 2.0 ** -FIXED[self.method]) if self.method in FIXED else 1.0

    def refined(self) -> TorchDiffEq:
        """Half the step, and tolerances 100 times tighter."""
        rtol = max(self.rtol / REFINED_TOLERANCE_RATIO, FINEST_RTOL)
        atol = max(self.atol / REFINED_TOLERANCE_RATIO, FINEST_ATOL)
        return TorchDiffEq(self.method, self.adjoint, 0.5 * self.step_size, rtol, atol)

    def nodes(self, field: RightHandSide, state: Tensor) -> list[Tensor]:
        """The states at multiples of the step size.

        Raises:
            InputError: inside a torch.func transform.
            NumericalError: an adaptive method needs too many or too short steps.
        """
        if wrapped(state) and not torch.compiler.is_compiling():
            what = "torch.func transforms and recorded programs need a method with fixed stages"
            raise InputError.of(what, expected="dc.RK4 or dc.RK8", got=as_written(self), fix="fit with one of these")
        import torchdiffeq  # noqa: PLC0415  # slow to import, and not the default

        times = torch.linspace(0.0, 1.0, self.intervals + 1, dtype=state.dtype, device=state.device)
        if self.method in FIXED:
            options: dict[str, object] = {"step_size": 1.0 / self.intervals}
        else:  # steps that end at the nodes, since interpolation between steps is less accurate than the steps
            options = {"step_t": times, "max_num_steps": MAX_ADAPTIVE_STEPS}
        arguments = {"method": self.method, "rtol": self.rtol, "atol": self.atol, "options": options}
        try:
            if self.adjoint:
                path = torchdiffeq.odeint_adjoint(
                    lambda t, y: field(0, y),
                    state,
                    times,
                    adjoint_params=(),
                    adjoint_options=dict(options),
                    **arguments,
                )
            else:
                path = torchdiffeq.odeint(lambda t, y: field(0, y), state, times, **arguments)
        except AssertionError as error:  # torchdiffeq asserts that steps neither underflow nor are too many
            raise NumericalError.of(
                f"the adaptive integration broke down ({error})",
                fix="the momenta are too large: start nearer (from zero or Gauss-Newton), or loosen the tolerances",
            ) from error
        return [*path]  # pyright: ignore[reportReturnType]
