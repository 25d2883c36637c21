"""A calibrated model as constants for NumPy (runtime/program.py): queries without the overhead of torch."""

from __future__ import annotations

from typing import cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from diffeo_calib.common.checks import wrapped
from diffeo_calib.flows.geodesic import Flow
from diffeo_calib.flows.integrators import RungeKutta
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.maps.deformation import Deformation
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.runtime.arrays import Array
from diffeo_calib.runtime.build import calibrated_chain, recorded_flow
from diffeo_calib.runtime.flow import RecordedFlow
from diffeo_calib.runtime.program import Program

_PROGRAMS: WeakKeyDictionary[Deformation, Program | None] = WeakKeyDictionary()
"""Programs that have been made: copies of a model with another tool share its deformation."""


def takes_program(q: Tensor) -> bool:
    """Whether a query can be answered by NumPy: on the CPU, and no derivative or trace of it is wanted."""
    plain = q.device.type == "cpu" and not (q.requires_grad and torch.is_grad_enabled())
    return plain and not wrapped(q) and not torch.compiler.is_compiling()


def program_of(deformation: Deformation, q: Tensor | None = None) -> Program | None:
    """The program of a robot's calibrated map, made at its first use; None where torch must answer the query ``q``.

    None for maps without constant stages: adaptive time steps, users' kernels, the Eulerian formulation, and maps on
    another device than the CPU.
    """
    if q is not None and not takes_program(q):
        return None
    if deformation not in _PROGRAMS:
        _PROGRAMS[deformation] = _program(deformation)
    return _PROGRAMS[deformation]


def _program(deformation: Deformation) -> Program | None:
    if not isinstance(deformation, GeodesicDeformation):
        return None
    asked, theta = deformation.spec.nominal, deformation.momenta.theta
    other = asked if isinstance(asked, FlangePoints) else None
    nominal = asked if other is None else other.fitted
    if not isinstance(nominal, GeometryMap) or nominal.load.by_row:
        return None
    flows = deformation.joint_flow, deformation.task_flow
    radial = all(isinstance(term, RadialKernel) for flow in flows for term in flow.kernel.terms)
    if not radial or not isinstance(deformation.integrator, RungeKutta) or deformation.x.device.type != "cpu":
        return None
    geometry, (errors, coefficients) = nominal.geometry, nominal.split(theta)
    chain = calibrated_chain(
        geometry.chain.arrays,
        _array(geometry.base),
        _array(geometry.joint_errors),
        _array(errors),
        None if nominal.elasticity is None else _array(nominal.elasticity.folded(coefficients)),
        waves=(nominal.own.waves, _array(theta[nominal.parts["waves"]])),
        axes=(nominal.own.axes, _array(theta[nominal.parts["axes"]])),
    )
    joint, task = (_recorded(flow, deformation.integrator) for flow in flows)
    points = geometry.absorb(errors.detach().cpu()).tool if other is None else other.points
    tips, on = geometry.chain.tips, geometry.on if other is None else other.map.geometry.on
    return Program(joint, chain, task, _array(points), tuple(map(tips.index, on)), tips)


def _recorded(flow: Flow, integrator: RungeKutta) -> RecordedFlow:
    kernel = [cast(RadialKernel, term).to_config() for term in flow.kernel.terms]
    coefficients, weights = integrator.tableau()
    return recorded_flow(kernel, _array(torch.stack(flow.stages)), _array(coefficients), _array(weights))


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy()
