"""The exact model k1 = psi o k0(.; theta) o phi^-1 for given momenta, and its linearisation.

Both diffeomorphisms are landmark geodesics run one after the other (LDDMM; Orozco & Ratajczak 2025,
(2), (4), (13)):

    xi = phi^-1(x)      geodesic of K_V from the configurations x with momenta b
    z0 = k0(xi; theta)
    z1 = psi(z0)        geodesic of K_W from z0 with momenta p        z1_i = k1(x_i)

With P markers per configuration, psi acts on R^d and moves all N P marker points.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import small_work
from diffeo_calib.flows.geodesic import Flow, energy, row_blocks
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.maps.deformation import Deformation, ModelSpec, Momenta, finite, relative
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity
from diffeo_calib.maps.nominal import NominalMap


class GeodesicDeformation(Deformation):
    """k1 for given momenta: two flows, integrated once and then evaluated anywhere.

    Args:
        spec: nominal map, kernels, prior.
        x: (N, n) control configurations.
        momenta: b, p, theta.
        integrator: time stepping of both flows.
        variational: whether to integrate the Jacobians at the controls in the same run, for :meth:`linearise`.

    Attributes:
        xi: (N, n) phi^-1(x).
        z1: (N, m) k1(x).
    """

    formulation = "exact"

    def __init__(
        self, spec: ModelSpec, x: Tensor, momenta: Momenta, integrator: Integrator, *, variational: bool = False
    ) -> None:
        self.spec, self.x, self.momenta, self.integrator = spec, x, momenta, integrator
        self.joint_flow = Flow(spec.joint_kernel, x, momenta.joint, integrator, variational=variational)
        self.xi = finite(self.joint_flow.end[0], "the joint-space flow overflows")
        self.z0 = spec.nominal_of_controls(self.xi, momenta.theta)
        start = self._points(self.z0)
        self.task_flow = Flow(spec.task_kernel, start, momenta.task, integrator, variational=variational)
        self.z1 = finite(self.task_flow.end[0], "the task-space flow overflows").reshape(self.z0.shape)
        self._nominal_of_z1 = spec.nominal_of_controls

    @small_work()
    def __call__(self, x: Tensor) -> Tensor:
        values = list[Tensor]()
        for rows in row_blocks(x):
            z0 = self.spec.nominal.rows(rows)(self.joint_flow(x[rows]), self.momenta.theta)
            values.append(self.task_flow(self._points(z0)).reshape(z0.shape))
        return torch.cat(values)

    def at_controls(self, x: Tensor) -> Tensor | None:
        same = self.spec.nominal is self._nominal_of_z1 and x.device == self.x.device and torch.equal(x, self.x)
        return self.z1.detach().clone() if same else None

    @small_work()
    def jacobian(self, x: Tensor) -> Tensor:
        """Dk1 = Dpsi Dk0 Dphi^-1, the exact derivative of :meth:`__call__`: (M, m, n)."""
        xi, d_phi = self.joint_flow.with_jacobian(x)
        z0 = self.spec.nominal(xi, self.momenta.theta)
        _, d_psi = self.task_flow.with_jacobian(self._points(z0))
        return self._apply_blocks(d_psi, self.spec.nominal.jacobian(xi, self.momenta.theta) @ d_phi)

    def field_energies(self) -> tuple[Tensor, Tensor]:
        spec, (b, p, _) = self.spec, self.momenta.tensors
        return energy(spec.joint_kernel, self.x, b), energy(spec.task_kernel, self.z0.reshape(p.shape), p)

    @property
    def task_controls(self) -> Tensor:
        return self._points(self.z0)

    @property
    def end_momenta(self) -> Tensor:
        return self.task_flow.end[1]

    def coupling_residual(self) -> float:
        p = self.momenta.task.reshape(self.z1.shape)
        b_end = self.joint_flow.end[1]
        return relative(b_end - (self._slopes.mT @ p[:, :, None])[:, :, 0], b_end)

    @cached_property
    def _slopes(self) -> Tensor:
        """Dk0(xi) at the controls: (N, m, n)."""
        return self.spec.nominal_of_controls.jacobian(self.xi, self.momenta.theta)

    def energy_drift(self) -> float:
        """The larger relative drift of the two Hamiltonians."""
        return max(self.joint_flow.energy_drift(), self.task_flow.energy_drift())

    def to(self, device: torch.device | str) -> GeodesicDeformation:
        moved = self.spec.to(device), self.x.to(device), self.momenta.to(device)
        return GeodesicDeformation(*moved, self.integrator)

    def using(self, backend: Backend) -> GeodesicDeformation:
        """Return the deformation, evaluated at given configurations by kernel sums of this backend."""
        other = copy(self)
        other.joint_flow, other.task_flow = self.joint_flow.using(backend), self.task_flow.using(backend)
        return other

    def with_spec(self, **changes: object) -> GeodesicDeformation:
        """Return the deformation with another nominal map, or other prior variances of theta for covariances."""
        other = copy(self)
        vars(other).pop("_slopes", None)
        other.spec = replace(self.spec, **changes)
        return other

    def with_nominal(self, nominal: NominalMap) -> GeodesicDeformation:
        """Return the two flows around another nominal map with the same parameters: k1 of other points of the body.

        The controls stay those of the fit; evaluate and linearise the result at given configurations only.
        """
        return self.with_spec(nominal=nominal)

    def at_rows(self, index: slice) -> GeodesicDeformation:
        """Return the deformation at some of the rows that its nominal map was made for."""
        some = self.spec.nominal.rows(index)
        return self if some is self.spec.nominal else self.with_nominal(some)

    def linearise(self, x: Tensor | None = None) -> Linearisation:
        """First-order response of k1(x) to the fields v_t, w_t and to theta.

        Args:
            x: (M, n) configurations; None for the control configurations.
        """
        return self.linearised_value(x)[1]

    @small_work()
    def linearised_value(self, x: Tensor | None = None) -> tuple[Tensor, Linearisation]:
        """k1(x) (M, m) and the linearisation at x from one run of the flows; x as in :meth:`linearise`."""
        theta = self.momenta.theta
        nominal = self.spec.nominal_of_controls if x is None else self.spec.nominal
        if x is None:
            (chi, m_x), (z, m_y) = self.joint_flow.control_path(), self.task_flow.control_path()
        else:
            chi, m_x = self.joint_flow.path(x)
            z, m_y = self.task_flow.path(self._points(nominal(chi[-1], theta)))
        # Theta_s = C Mx_1 Mx_s^-1 with C = Dpsi Dk0: transports a velocity from time s to the end.
        slopes = self._slopes if x is None else nominal.jacobian(chi[-1], theta)
        to_end = self._apply_blocks(m_y[-1], slopes) @ m_x[-1]
        sensitivity = self._apply_blocks(m_y[-1], nominal.sensitivities(chi[-1], theta))
        nodes = self._nodes(chi, m_x, to_end), self._nodes(z, m_y, m_y[-1])
        return z[-1].reshape(sensitivity.shape[:2]), Linearisation(self.spec, *nodes, sensitivity)

    def linear_response(self, at: Linearisation, *, elsewhere: bool = False) -> Tensor:
        """Linear effect of this deformation's own fields and theta on k1 at its controls: (N, m).

        Args:
            at: the linearisation of this deformation at its controls. elsewhere: whether it is at other configurations.
        """
        total = torch.einsum("imk,k->im", at.sensitivity, self.momenta.theta)
        for nodes, flow in ((at.joint, self.joint_flow), (at.task, self.task_flow)):
            for node, (q, a) in zip(nodes, flow.nodes, strict=True):
                field = flow.kernel.field(node.points if elsewhere else None, q, a)
                total = total + node.response(field).reshape(total.shape)
        return total

    def momentum_sensitivities(self) -> tuple[list[NodeSensitivity], list[NodeSensitivity]]:
        """Effect of the controls' initial momenta on the fields: at time s, b acts as Mx_s^-T b and p as My_s^-T p.

        Returns:
            nodes of the joint flow and of the task flow, with effects M_s^-1.
        """
        return self._nodes(*self.joint_flow.control_path()), self._nodes(*self.task_flow.control_path())

    def _nodes(
        self, points: list[Tensor], jacobians: list[Tensor], to_end: Tensor | None = None
    ) -> list[NodeSensitivity]:
        """The nodes of one flow, with effects M_s^-1, or to_end M_s^-1."""
        effects = [_inverse(m) if to_end is None else to_end @ _inverse(m) for m in jacobians]
        return [NodeSensitivity(*n) for n in zip(self.integrator.weights(), points, effects, strict=True)]

    def _points(self, z: Tensor) -> Tensor:
        """(M, m) -> (M P, d) marker points."""
        return z.reshape(-1, self.spec.task_dim)

    def _apply_blocks(self, blocks: Tensor, matrix: Tensor) -> Tensor:
        """Multiply the rows of every marker by its block: (M P, d, d), (M, m, k) -> (M, m, k)."""
        return (blocks @ matrix.reshape(blocks.shape[0], self.spec.task_dim, matrix.shape[-1])).reshape(matrix.shape)


def _inverse(jacobians: Tensor) -> Tensor:
    """Inverses of a flow's Jacobians (M, n, n) at a time; NumericalError for a singular one: an exact flow has none."""
    inverse, info = torch.linalg.inv_ex(jacobians)
    if bool(info.any()):
        raise NumericalError.of(
            "the deformation folds space: its Jacobian is singular",
            fix="the momenta are too large for its time steps: start nearer, or use more time steps",
        )
    return inverse
