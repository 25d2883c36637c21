"""The paper's own discretisation: k, P and Dk followed at FIXED points x_i, equations (17), (19), (20).

    k_i'  = w(k_i) - Dk_i v(x_i)                                              (17), first line
    P_i'  = -Dw(k_i)^T P_i - div(P v^T)(x_i)                                  (17), second line
    Dk_i' = Dw(k_i) Dk_i - Dk_i Dv(x_i) - D^2k(x_i)[v(x_i)]                   (19)
    v(x)  = -sum_j K_V(x, x_j) Dk_j^T P_j,   w(y) = sum_j K_W(y, k_j) P_j     (17), last lines

(R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach",
2025.) Neither DP nor D^2k is known at the points, so this remains an approximation with any number of time steps.
The exact model (maps/geodesic.py) lets the points move instead and needs neither.
:class:`Eulerian` describes the errata of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.flows.integrators import Integrator, integrate_alongside
from diffeo_calib.kernels.base import Kernel


@dataclass(frozen=True)
class Eulerian:
    """The errata of (16)-(20) to keep as printed, for comparison.

    Results of L-BFGS on the paper's RR test bed (section 5; sigma = 0.01, RK4 with two steps); the exact model reaches
    E = 0.05696 with a Jacobian that is exact to 1e-10:

        printed_jacobian   printed_divergence   E         Jacobian off by   field energy drifts by
        True               False                0.05741   6.2 %             0.005 %
        True               True                 0.06796   6.2 %             28 %
        False              False                0.05667   0.35 %            1.6 %
        False              True                 0.06665   0.35 %            25 %

    Keeping P div v is less accurate than omitting it, so it is omitted by default. -D^2k0[v] improves the Jacobian and
    makes the error of k1 third instead of second order, but needs second derivatives of k0. Since this formulation
    represents the paper's method, (19) is as printed by default.

    Args:
        printed_sign: (11) and (17) print L_V v = Dk^T P. With k' = w(k) - Dk v the momentum map is
            L_V v = -Dk^T P; with the printed sign v works against w.
        printed_jacobian: (18), (19) without -D^2k[v]: the evolution of Dk along points that move with v, not at fixed
            points. If False, D^2k of k0 is used at all times: its error is of second order in the deformation, where
            the printed equation has one of first order.
        printed_divergence: keep P_i div v(x_i), the part of div(P v^T) = P div v + DP v that can be computed at the
            points. If False, omit the whole term, as for a momentum that is transported as point masses.

    Raises:
        InputError: a switch that is not True or False.
    """

    printed_sign: bool = False
    printed_jacobian: bool = True
    printed_divergence: bool = False

    def __post_init__(self) -> None:
        for switch in fields(self):
            value = getattr(self, switch.name)
            if not isinstance(value, bool):
                raise InputError.of(f"`{switch.name}`", expected="True or False", got=as_written(value))

    @property
    def sign(self) -> float:
        """The sign in L_V v = sign Dk^T P."""
        return 1.0 if self.printed_sign else -1.0


class Kinematics(NamedTuple):
    """k0 at some points: values (N, m), Jacobians (N, m, n) and, if needed, second derivatives (N, m, n, n)."""

    value: Tensor
    jacobian: Tensor
    curvature: Tensor | None


class EulerianFlow:
    """The solution of (17) with (19) from t = 0 to 1, and of (20) at any other point.

    Args:
        equations: the errata to keep.
        kernels: K_V on joint space, K_W on R^d.
        x: (N, n) fixed points.
        start: k0 at these points.
        momenta: (N, m) P0.
        integrator: time stepping. task_dim: d, a divisor of m.

    Attributes:
        nodes: the states (N, 2 m + m n) at the nodes of the time grid: k, P and Dk, concatenated.
    """

    def __init__(
        self,
        equations: Eulerian,
        kernels: tuple[Kernel, Kernel],
        x: Tensor,
        start: Kinematics,
        momenta: Tensor,
        *,
        integrator: Integrator,
        task_dim: int,
    ) -> None:
        self.equations, self.integrator, self.x, self.task_dim = equations, integrator, x, task_dim
        self.joint_kernel, self.task_kernel = kernels
        self._curvature = start.curvature
        self._stages: list[Tensor] = []
        packed = torch.cat([start.value, momenta, start.jacobian.flatten(1)], 1)
        self.nodes = integrator.nodes(self._recorded, packed)

    def __call__(self, start: Kinematics, x: Tensor) -> tuple[Tensor, Tensor]:
        """(20): k1 (M, m) and the transported Dk1 (M, m, n) at points x (M, n), from k0 there (``start``)."""
        m = start.value.shape[1]

        def field(state: Tensor, controls: Tensor) -> Tensor:
            k, jacobian = state[:, :m], state[:, m:].unflatten(1, start.jacobian.shape[1:])
            return torch.cat(self._transport(Kinematics(k, jacobian, start.curvature), x, controls)[:2], 1)

        packed = torch.cat([start.value, start.jacobian.flatten(1)], 1)
        controls = {"stages": self._stages, "controls": self.nodes[0], "control_field": self.rates}
        end = integrate_alongside(self.integrator, field, packed, **controls)[-1]
        return end[:, :m], end[:, m:].unflatten(1, start.jacobian.shape[1:])

    def unpack(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """k (N, m), P (N, m) and Dk (N, m, n) of a state."""
        n = self.x.shape[1]
        m = state.shape[1] // (n + 2)
        return state[:, :m], state[:, m : 2 * m], state[:, 2 * m :].unflatten(1, (m, n))

    def joint_momenta(self, state: Tensor) -> Tensor:
        """L_V v at the points, with the corrected sign -Dk^T P: (N, n)."""
        _, momenta, jacobian = self.unpack(state)
        return self.equations.sign * torch.einsum("imn,im->in", jacobian, momenta)

    def _recorded(self, _: int, state: Tensor) -> Tensor:
        if self.integrator.replayable:
            self._stages.append(state)
        return self.rates(state)

    def rates(self, state: Tensor) -> Tensor:
        """Right-hand side of (17) and (19) for a state: (N, 2 m + m n)."""
        k, momenta, jacobian = self.unpack(state)
        dk, dj, dv, dw = self._transport(Kinematics(k, jacobian, self._curvature), None, state)
        pushed = (dw.mT @ momenta.reshape(len(dw), -1, 1)).reshape(momenta.shape)
        change = -pushed  # (17): -Dw(k)^T P
        if self.equations.printed_divergence:
            change = change - momenta * dv.diagonal(dim1=1, dim2=2).sum(1, keepdim=True)  # -P div v
        return torch.cat([dk, change, dj], 1)

    def _transport(self, at: Kinematics, x: Tensor | None, controls: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """k' (17) and Dk' (19), flattened, in the fields of a state; also Dv (M, n, n) and Dw (M P, d, d).

        Args:
            at: current k, Dk and D^2k at the points.
            x: (M, n) points; None for the controls themselves, whose kernel sums visit each pair once.
            controls: the state of the controls.
        """
        (k, jacobian, curvature), (values, momenta, _) = at, self.unpack(controls)
        z, q, p = (t.reshape(-1, self.task_dim) for t in (k, values, momenta))
        v, dv = self.joint_kernel.field_and_jacobian(x, self.x, self.joint_momenta(controls))
        w, dw = self.task_kernel.field_and_jacobian(None if x is None else z, q, p)
        by_task_field = (dw @ jacobian.reshape(len(dw), self.task_dim, jacobian.shape[-1])).reshape(jacobian.shape)
        dj = by_task_field - jacobian @ dv
        if curvature is not None:
            dj = dj - torch.einsum("imab,ib->ima", curvature, v)
        return w.reshape(k.shape) - (jacobian @ v[:, :, None])[:, :, 0], dj.flatten(1), dv, dw
