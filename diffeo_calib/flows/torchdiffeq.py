"""Integration by torchdiffeq: its methods, its adaptive steps, its continuous adjoint.

The adjoint needs the vector-Jacobian product of the right-hand side, which is one more kernel sum
(flows/hamiltonian.py), so both ``odeint`` and ``odeint_adjoint`` are cheap here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from diffeo_calib.errors import InputError, NumericalError, sentence
from diffeo_calib.flows.integrate import Field, Integrator

FIXED = {"midpoint": 2, "rk4": 4}
"""Methods with a fixed step, and their orders."""
ADAPTIVE = ("bosh3", "dopri5", "dopri8")
MAX_STEPS = 10_000
"""Steps of an adaptive method between two nodes after which it has broken down."""
TIGHTER = 100.0
"""By how much the tolerances of an adaptive method shrink when it is refined."""


@dataclass(frozen=True)
class TorchDiffEq(Integrator):
    """``torchdiffeq.odeint`` or ``odeint_adjoint``.

    Args:
        method: "rk4" (the 3/8 rule) or "midpoint" with a fixed step; "bosh3", "dopri5" or "dopri8" with steps
            chosen by the tolerances.
        adjoint: whether gradients come from the adjoint equation solved backwards (memory of one state; the
            exact gradient only as the step goes to 0) or from backpropagation through the steps.
        step_size: 1, 1/2, 1/3, ...: the fixed step; for an adaptive method the spacing of the nodes where the
            solvers look at the path.
        rtol, atol: tolerances of adaptive methods, relative and absolute (rad, m).
    """

    method: str = "rk4"
    adjoint: bool = False
    step_size: float = 0.25
    rtol: float = 1e-9
    atol: float = 1e-12
    replayable: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.method not in (*FIXED, *ADAPTIVE):
            raise InputError(
                sentence("`method` of TorchDiffEq", expected=", ".join((*FIXED, *ADAPTIVE)), got=self.method)
            )
        numbers = {"step_size": self.step_size, "rtol": self.rtol, "atol": self.atol}
        for name, value in numbers.items():
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise InputError(sentence(f"`{name}` of TorchDiffEq", expected="a number", got=repr(value)))
        if not isinstance(self.adjoint, bool):
            raise InputError(sentence("`adjoint` of TorchDiffEq", expected="True or False", got=repr(self.adjoint)))
        step = self.step_size
        if not 0.0 < step <= 1.0 or abs(1.0 / step - round(1.0 / step)) > 1e-6:
            raise InputError(sentence("`step_size` of TorchDiffEq", expected="1, 1/2, 1/3, 1/4, ...", got=step))
        if not (0.0 < self.rtol < 1.0 and 0.0 < self.atol < 1.0):
            got = (self.rtol, self.atol)
            raise InputError(sentence("`rtol` and `atol` of TorchDiffEq", expected="between 0 and 1", got=got))

    @property
    def intervals(self) -> int:
        """1 / step_size."""
        return round(1.0 / self.step_size)

    @property
    def error_per_change(self) -> float:
        """By the order of a fixed-step method; 1 for tolerances."""
        return 1.0 / (1.0 - 2.0 ** -FIXED[self.method]) if self.method in FIXED else 1.0

    def refined(self) -> TorchDiffEq:
        """Half the step, and tolerances 100 times tighter."""
        rtol, atol = (max(t / TIGHTER, 1e-14) for t in (self.rtol, self.atol))
        return TorchDiffEq(self.method, self.adjoint, 0.5 * self.step_size, rtol, atol)

    def nodes(self, field: Field, state: Tensor) -> list[Tensor]:
        """The states at multiples of the step size.

        Raises:
            NumericalError: an adaptive step shrank to nothing.
        """
        import torchdiffeq  # noqa: PLC0415  # slow to import, and not the default

        times = torch.linspace(0.0, 1.0, self.intervals + 1, dtype=state.dtype, device=state.device)
        if self.method in FIXED:
            options: dict[str, object] = {"step_size": 1.0 / self.intervals}
        else:  # steps that end at the nodes: interpolation between steps is less accurate than the steps
            options = {"step_t": times, "max_num_steps": MAX_STEPS}
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
        except AssertionError as error:  # how torchdiffeq says that its steps underflow or are too many
            raise NumericalError(
                sentence(
                    f"the adaptive integration broke down ({error})",
                    fix="the momenta are too large: start nearer (from zero or Gauss-Newton), or loosen the tolerances",
                )
            ) from error
        return [*path]  # pyright: ignore[reportReturnType]
