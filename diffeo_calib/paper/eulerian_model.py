"""The paper's own discretisation as a model: k1 by (17), (19) at the data, and by (20), (21) elsewhere.

(R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025,
with the errata of :class:`diffeo_calib.paper.eulerian_flow.Eulerian`.) The only unknown is P0: the joint-space
momentum b = Dk0^T P0 of the tangent model is implied.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.flows.geodesic import energy
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Deformation, ModelSpec, Momenta, backend_names, finite
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.paper.eulerian_flow import Eulerian, EulerianFlow, Kinematics


class EulerianDeformation(Deformation):
    """k1 for given P0: (17) and (19) solved once, then (20) at any configuration.

    Args:
        spec: nominal map, kernels, prior.
        x: (N, n) configurations of the data.
        momenta: P0 (and theta); the joint-space momenta are empty.
        integrator: time stepping.
        equations: the errata to keep.

    Attributes:
        flow: the solution of (17), (19). z1: (N, m) k1(x).

    Raises:
        NumericalError: the flow overflows.
    """

    formulation = "eulerian"

    def __init__(
        self, spec: ModelSpec, x: Tensor, momenta: Momenta, integrator: Integrator, equations: Eulerian
    ) -> None:
        self.spec, self.x, self.momenta, self.integrator = spec, x, momenta, integrator
        self.equations = equations
        start = self._start(x)
        kernels = spec.joint_kernel, spec.task_kernel
        p = momenta.task.reshape(start.value.shape)
        self.flow = EulerianFlow(equations, kernels, x, start, p, integrator=integrator, task_dim=spec.task_dim)
        self.z1 = self.flow.unpack(finite(self.flow.nodes[-1], "the flow at fixed points (17) overflows"))[0]

    def __call__(self, x: Tensor) -> Tensor:
        """k1(x) by (20), (21): (M, n) -> (M, m), differentiable by autograd; for derivatives in x, see `jacobian`."""
        return self.flow(self._start(x), x)[0]

    def jacobian(self, x: Tensor) -> Tensor:
        """Dk1(x), transported by (20): (M, m, n). It is NOT the derivative of :meth:`__call__`.

        (18), (19) hold along points that move with v. Used at fixed points, their Jacobian is about 6 % off on the
        paper's RR test bed (erratum 2; 0.4 % with ``printed_jacobian=False``). The derivative of the call is given by
        central differences, or by autograd with the equations as printed and without torchdiffeq's adjoint. In the
        exact model both Jacobians are equal.
        """
        return self.flow(self._start(x), x)[1]

    def field_energies(self) -> tuple[Tensor, Tensor]:
        """The first two terms of (16), differentiable in P0."""
        return self._energies(self.flow.nodes[0])

    @property
    def task_controls(self) -> Tensor:
        """k0 at the data, as points: (N P, d)."""
        return self.flow.unpack(self.flow.nodes[0])[0].reshape(self.momenta.task.shape)

    @property
    def end_momenta(self) -> Tensor:
        """P at time 1: (N P, d)."""
        return self.flow.unpack(self.flow.nodes[-1])[1].reshape(self.momenta.task.shape)

    def coupling_residual(self) -> float:
        """NaN: (17) computes v from L_V v = -Dk^T P, so that the coupling holds by construction."""
        return float("nan")

    def energy_drift(self) -> float:
        """Relative drift of 1/2 |v|^2 + 1/2 |w|^2, an error of this formulation that small time steps do not remove."""
        start, end = (float(sum(self._energies(node))) for node in (self.flow.nodes[0], self.flow.nodes[-1]))
        return abs(end - start) / start if start > 0 else 0.0

    @property
    def backends(self) -> tuple[str, str]:
        """Backends of the kernel sums between the data: in joint space, in task space."""
        return backend_names(self.spec.joint_kernel, self.x), backend_names(self.spec.task_kernel, self.momenta.task)

    def to(self, device: torch.device | str) -> EulerianDeformation:
        """The same deformation with its flow on a device."""
        moved = self.spec.to(device), self.x.to(device), self.momenta.to(device)
        return EulerianDeformation(*moved, self.integrator, self.equations)

    def _energies(self, state: Tensor) -> tuple[Tensor, Tensor]:
        k, p, _ = self.flow.unpack(state)
        points, momenta = (t.reshape(self.momenta.task.shape) for t in (k, p))
        return (
            energy(self.spec.joint_kernel, self.x, self.flow.joint_momenta(state)),
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
        at = x.detach().requires_grad_()
        jacobian = nominal.jacobian(at, theta.detach())  # (M, m, n)
        columns = jacobian.flatten(1).sum(0)
        rows = [
            torch.autograd.grad(column, at, retain_graph=True, allow_unused=True, materialize_grads=True)[0]
            for column in columns
            if column.requires_grad
        ]
    if not rows:  # a linear map
        return x.new_zeros(*jacobian.shape, x.shape[1])
    return torch.stack(rows, 1).view(*jacobian.shape, x.shape[1])
