"""The paper's own discretisation: k, P and Dk followed at FIXED points x_i, equations (17), (19), (20).

    k_i'  = w(k_i) - Dk_i v(x_i)                                              (17), first line
    P_i'  = -Dw(k_i)^T P_i - div(P v^T)(x_i)                                  (17), second line
    Dk_i' = Dw(k_i) Dk_i - Dk_i Dv(x_i) - D^2k(x_i)[v(x_i)]                   (19)
    v(x)  = -sum_j K_V(x, x_j) Dk_j^T P_j,   w(y) = sum_j K_W(y, k_j) P_j     (17), last lines

(R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach",
2025.) Neither DP nor D^2k is known at the points, so this remains an approximation with any number of time steps.
The exact model (maps/geodesic.py) lets the points move instead and needs neither. :class:`Eulerian` describes the
errata of the paper. Away from the data, k1 is (20), (21). The only unknown is P0, found by minimising (16): the
joint-space momentum b = Dk0^T P0 of the tangent model is implied.

A descent starts with a few steps of shooting at the end condition (12), R P_1 = y - k1. The matrix of the tangent
model replaces the sensitivities, which have no closed form here:

    P0 <- P0 + (G + R)^-1 (y - k1 - R P_1)

The first step from zero is the tangent solution. Shooting continues as long as the energy falls, on the RR test bed
for five steps, from E = 1.8e4 to 0.066. (More would diverge, since G does not depend on the deformation.) With the
printed sign v works against w, so that the tangent step raises the energy and the descent starts at zero. It still
fits where one kernel dominates, but slowly: on the test bed to E = 0.0593 in 766 evaluations, where the corrected sign
needs 68 to reach 0.0574.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, NumericalError, as_written
from diffeo_calib.fitting.problem import Problem, tangent
from diffeo_calib.flows.geodesic import energy
from diffeo_calib.flows.integrators import RK4, Integrator, Run
from diffeo_calib.maps.deformation import Deformation, ModelSpec, Momenta, finite
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.conjugate_gradients import ConjugateGradientRegression


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


class EulerianDeformation(Deformation):
    """k1 for given P0: (17) and (19) solved once from t = 0 to 1, then (20) at any configuration.

    Args:
        spec: nominal map, kernels, prior.
        x: (N, n) configurations of the data, the fixed points.
        momenta: P0 (and theta); the joint-space momenta are empty.
        integrator: time stepping.
        equations: the errata to keep.

    Attributes:
        nodes: the states (N, 2 m + m n) at the nodes of the time grid: k, P and Dk, concatenated. z1: (N, m) k1(x).

    Raises:
        NumericalError: the flow overflows.
    """

    formulation = "eulerian"

    def __init__(
        self, spec: ModelSpec, x: Tensor, momenta: Momenta, integrator: Integrator, equations: Eulerian
    ) -> None:
        self.spec, self.x, self.momenta, self.integrator = spec, x, momenta, integrator
        self.equations = equations
        value, jacobian, self._curvature = self._start(x)
        p = momenta.task.reshape(value.shape)
        self._run = Run(integrator, self.rates, torch.cat([value, p, jacobian.flatten(1)], 1))
        self.nodes = self._run.nodes
        self.z1 = self.unpack(finite(self.nodes[-1], "the flow at fixed points (17) overflows"))[0]

    def __call__(self, x: Tensor) -> Tensor:
        """k1(x) by (20), (21): (M, n) -> (M, m), differentiable by autograd; for derivatives in x, see `jacobian`."""
        return self._passive(x)[0]

    def jacobian(self, x: Tensor) -> Tensor:
        """Dk1(x), transported by (20): (M, m, n). It is NOT the derivative of :meth:`__call__`.

        (18), (19) hold along points that move with v. Used at fixed points, their Jacobian is about 6 % off on the
        paper's RR test bed (erratum 2; 0.4 % with ``printed_jacobian=False``). The derivative of the call is given by
        central differences, or by autograd with the equations as printed and without torchdiffeq's adjoint. In the
        exact model both Jacobians are equal.
        """
        return self._passive(x)[1]

    def _passive(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(20): k1 (M, m) and the transported Dk1 (M, m, n) at points x (M, n)."""
        value, jacobian, bend = self._start(x)
        m, shape = value.shape[1], jacobian.shape[1:]

        def field(state: Tensor, controls: Tensor) -> Tensor:
            at = Kinematics(state[:, :m], state[:, m:].unflatten(1, shape), bend)
            return torch.cat(self._transport(at, x, controls)[:2], 1)

        end = self._run.alongside(field, torch.cat([value, jacobian.flatten(1)], 1), self.rates)[-1]
        return end[:, :m], end[:, m:].unflatten(1, shape)

    def unpack(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """k (N, m), P (N, m) and Dk (N, m, n) of a state."""
        n = self.x.shape[1]
        m = state.shape[1] // (n + 2)
        return state[:, :m], state[:, m : 2 * m], state[:, 2 * m :].unflatten(1, (m, n))

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
        z, q, p = (t.reshape(-1, self.spec.task_dim) for t in (k, values, momenta))
        v, dv = self.spec.joint_kernel.field_and_jacobian(x, self.x, self._joint_momenta(controls))
        w, dw = self.spec.task_kernel.field_and_jacobian(None if x is None else z, q, p)
        by_task_field = (dw @ jacobian.reshape(len(dw), self.spec.task_dim, jacobian.shape[-1])).reshape(jacobian.shape)
        dj = by_task_field - jacobian @ dv
        if curvature is not None:
            dj = dj - torch.einsum("imab,ib->ima", curvature, v)
        return w.reshape(k.shape) - (jacobian @ v[:, :, None])[:, :, 0], dj.flatten(1), dv, dw

    def _joint_momenta(self, state: Tensor) -> Tensor:
        """L_V v at the points, with the corrected sign -Dk^T P: (N, n)."""
        _, momenta, jacobian = self.unpack(state)
        return self.equations.sign * torch.einsum("imn,im->in", jacobian, momenta)

    def field_energies(self) -> tuple[Tensor, Tensor]:
        return self._energies(self.nodes[0])

    @property
    def task_controls(self) -> Tensor:
        return self.unpack(self.nodes[0])[0].reshape(self.momenta.task.shape)

    @property
    def end_momenta(self) -> Tensor:
        return self.unpack(self.nodes[-1])[1].reshape(self.momenta.task.shape)

    def coupling_residual(self) -> float:
        """NaN: (17) computes v from L_V v = -Dk^T P, so that the coupling holds by construction."""
        return float("nan")

    def energy_drift(self) -> float:
        """Relative drift of 1/2 |v|^2 + 1/2 |w|^2, an error of this formulation that small time steps do not remove."""
        start, end = (float(sum(self._energies(node))) for node in (self.nodes[0], self.nodes[-1]))
        return abs(end - start) / start if start > 0 else 0.0

    def to(self, device: torch.device | str) -> EulerianDeformation:
        moved = self.spec.to(device), self.x.to(device), self.momenta.to(device)
        return EulerianDeformation(*moved, self.integrator, self.equations)

    def _energies(self, state: Tensor) -> tuple[Tensor, Tensor]:
        k, p, _ = self.unpack(state)
        points, momenta = (t.reshape(self.momenta.task.shape) for t in (k, p))
        return (
            energy(self.spec.joint_kernel, self.x, self._joint_momenta(state)),
            energy(self.spec.task_kernel, points, momenta),
        )

    def _start(self, x: Tensor) -> Kinematics:
        """k0, Dk0 and, if the equations need it, D^2k0 at points (M, n)."""
        nominal, theta = self.spec.nominal, self.momenta.theta
        second = None if self.equations.printed_jacobian else curvature(nominal, x, theta)
        return Kinematics(nominal(x, theta), nominal.jacobian(x, theta), second)


def curvature(nominal: NominalMap, x: Tensor, theta: Tensor) -> Tensor:
    """D^2k0 by m n backward passes through the Jacobian: (M, n) -> (M, m, n, n), a constant for autograd."""
    with torch.enable_grad():
        of_all = torch.autograd.functional.jacobian(lambda at: nominal.jacobian(at, theta.detach()).sum(0), x.detach())
    return of_all.movedim(2, 0)  # pyright: ignore[reportAttributeAccessIssue]


MAX_SHOTS = 20  # largest number of shooting steps; few suffice where shooting converges
SHORTEST_SHOT = 0.5  # smallest fraction of a shooting step that is tried


class EulerianProblem(Problem):
    """A problem's data, kernels and noise under the paper's equations; the unknown is P0 alone.

    Args:
        exact: the problem in the exact formulation.
        equations: the errata to keep; by default those of :class:`Eulerian`.

    Raises:
        InputError: fewer control points than data, or a problem with ``observe``.
    """

    certified = False

    def __init__(self, exact: Problem, equations: Eulerian | None = None) -> None:
        if exact.reduced:
            what = "the Eulerian formulation has a momentum at every measurement: fewer `controls` are not possible"
            raise InputError.of(what, fix='leave `controls` out, or pass formulation="exact"')
        if exact.observe is not None:
            fix = 'leave `observe` out, or pass formulation="exact"'
            raise InputError.of("`observe` in the Eulerian formulation", expected="measured coordinates", fix=fix)
        vars(self).update(vars(exact))
        self.exact, self.equations = exact, equations or Eulerian()

    @classmethod
    def with_errata(cls, exact: Problem, switches: Mapping[str, object]) -> EulerianProblem:
        """The problem with selected errata kept as printed.

        Args:
            exact: the problem in the exact formulation.
            switches: arguments of :class:`Eulerian` by name.

        Raises:
            InputError: an unknown switch, or fewer control points than data.
        """
        names = list(Eulerian.__dataclass_fields__)
        unknown = [name for name in switches if name not in names]
        if unknown:
            expected = f"{', '.join(names)} of the Eulerian formulation"
            raise InputError.of("keywords of `fit`", expected=expected, got=", ".join(unknown))
        return cls(exact, Eulerian(**switches))  # pyright: ignore[reportArgumentType]

    def zero(self) -> Momenta:
        return self.unknowns(self.exact.zero())

    def unknowns(self, momenta: Momenta) -> Momenta:
        return Momenta(momenta.joint[:0], momenta.task, momenta.theta)

    def deform(self, momenta: Momenta, integrator: Integrator) -> EulerianDeformation:  # pyright: ignore[reportIncompatibleMethodOverride]
        return EulerianDeformation(self.spec, self.x, momenta, integrator, self.equations)

    def preconditioner(self, momenta: Momenta, integrator: Integrator) -> Process:
        """G + R of the tangent model, for any momenta."""
        return self._factor

    @cached_property
    def _factor(self) -> Process:
        conditional = self._conditional
        return conditional if isinstance(conditional, Process) else self.exact.preconditioner(self.exact.zero(), RK4(1))

    @cached_property
    def _conditional(self) -> Process | ConjugateGradientRegression:
        return tangent(self.exact).conditional

    def start(self, integrator: Integrator) -> tuple[Momenta, int]:
        """Shoot at (12) from P0 = 0 as long as the energy falls."""
        at, evaluations = self.zero(), 1
        deformation = self.deform(at, integrator)
        best = float(self.energy(deformation).total)
        for _ in range(MAX_SHOTS):
            end = deformation.end_momenta.view_as(self.y)  # P_1
            miss = self.y - deformation.z1 - self.noise.multiply(end[:, :, None])[:, :, 0]
            change = self.unknowns(self._conditional.momenta(miss))
            step, better = 1.0, None
            while better is None and step >= SHORTEST_SHOT:
                trial = at.unflatten(at.flatten() + step * change.flatten())
                better, evaluations, step = self._better(trial, integrator, best), evaluations + 1, 0.5 * step
            if better is None:
                break
            at, (deformation, best) = trial, better
        return at, evaluations

    def _better(self, at: Momenta, integrator: Integrator, best: float) -> tuple[EulerianDeformation, float] | None:
        """The deformation of these momenta and its energy; None unless the energy is below ``best``."""
        try:
            deformation = self.deform(at, integrator)
        except NumericalError:
            return None
        value = float(self.energy(deformation).total)
        return (deformation, value) if value < best else None
