"""Any tool in any frame: poses, Jacobians and covariances of frames that were never measured.

The structure of the model holds for every point m of the flange, not only for the markers that were measured:
k1(q; m) = psi(k0(phi^-1(q); m)). Three virtual points around a tool centre point (TCP) give its pose, the same way that
measured poses are kept (measurements/poses.py).

With one marker the roll about the last joint's axis is known from the prior alone: on a UR10 measured in positions
only, orientations are off by 0.046 degrees RMS, those of its geometric calibration by 0.064.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, wrapped
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, as_written, listed
from diffeo_calib.fitting.fitted_map import PREDICT_ROWS, FittedMap
from diffeo_calib.flows.geodesic import Flow
from diffeo_calib.flows.integrators import RungeKutta
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.registered_map import marker_slopes
from diffeo_calib.maps.deformation import Deformation
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.measurements.poses import mark_points, marks, pose_directions, poses_from_marks
from diffeo_calib.robots.se3 import rigid_poses
from diffeo_calib.robots.tree import Tree
from diffeo_calib.runtime import program
from diffeo_calib.runtime.arrays import Array
from diffeo_calib.runtime.build import calibrated_chain, recorded_flow
from diffeo_calib.runtime.flow import RecordedFlow
from diffeo_calib.runtime.program import LONGEST_TOOL, TOOL_LEVER, Program, check_frame
from diffeo_calib.sensors.set_ups import frame_slopes


class ToolKinematics:
    """Poses of a tool centre point: values, exact Jacobian, covariance.

    Args:
        fitted: the calibrated map of the measured markers. nominal: its nominal map.
        tool: (4, 4) tool centre point in the tip's frame, m. frame: "base" of the robot, or "measuring".
        tip: name of the tip that carries it; the robot's only one by default.

    Raises:
        InputError: another frame, an unknown tip, or a robot with several tips and none named.
    """

    def __init__(
        self, fitted: FittedMap, nominal: GeometryMap, tool: Tensor, frame: str, tip: str | None = None
    ) -> None:
        check_frame(frame)
        self.fitted, self.nominal, self.tool, self.frame = fitted, nominal, tool, frame
        self.tip = checked_tip(nominal.geometry.chain, tip)

    @cached_property
    def deformation(self) -> GeodesicDeformation:
        """k1 of three points around the tool centre point."""
        return self.fitted.geodesic.with_nominal(FlangePoints(self.nominal, tool_points(self.tool), on=(self.tip,) * 3))

    @cached_property
    def base(self) -> Tensor:
        """(4, 4) the robot's base in the measuring frame, m."""
        theta = self.fitted.deformation.momenta.theta
        return self.nominal.geometry.absorb(self.nominal.split(theta)[0]).base

    def poses(self, q: Tensor) -> Tensor:
        """(N, n) rad or m -> (N, 4, 4) m; detached outside of torch.func transforms."""
        q = q if wrapped(q) else q.detach()
        if (constants := self._program_for(q)) is not None:
            return torch.from_numpy(constants.poses(q.numpy(), self.tool.numpy(), self.frame))
        return self._in_frame(poses_from_marks(self.deformation(q).unflatten(1, (3, 3)), TOOL_LEVER))

    def jacobian(self, q: Tensor) -> Tensor:
        """(N, 6, n): linear velocity of the TCP [m/rad or m/m], then angular velocity, about the axes of the frame."""
        q = q if wrapped(q) else q.detach()
        if (constants := self._program_for(q)) is not None:
            return torch.from_numpy(constants.poses_and_jacobian(q.numpy(), self.tool.numpy(), self.frame)[1])
        points, slopes = (t.unflatten(1, (3, 3)) for t in (self.deformation(q), self.deformation.jacobian(q)))
        return self._turned() @ pose_slopes(points, slopes)

    def predict(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (N, 4, 4), covariances (N, 6, 6) of the model: shifts [m] and turns [rad] about the axes of the frame.

        In the base frame only the base's own share is left out of the covariance; what cannot be told apart from it,
        such as an error of the first joint, is part of it.
        """
        turn, poses, blocks = self._turned(), [], []
        without_base = self.frame == "base" and self.fitted.workspace is None  # there the base carries rigid motions
        held = self.nominal.geometry.slices["base"] if without_base else slice(0)
        for rows in q.detach().split(PREDICT_ROWS):
            points, at = self.fitted.linearised_value(rows, self.deformation, held)
            nearest = poses_from_marks(points.unflatten(1, (3, 3)), TOOL_LEVER)
            poses.append(self._in_frame(nearest))
            blocks.append(self.fitted.covariance(at, turn @ pose_directions(nearest, TOOL_LEVER)))
        return torch.cat(poses), torch.cat(blocks)

    def _program_for(self, q: Tensor) -> Program | None:
        """The constants that answer a query; None where torch must."""
        constants = program_of(self.fitted.deformation, q)
        return None if constants is None else constants.at(self.tip)

    def _in_frame(self, poses: Tensor) -> Tensor:
        return poses if self.frame == "measuring" else torch.linalg.inv(self.base.to(poses.device)) @ poses

    def _turned(self) -> Tensor:
        """(6, 6) from the axes of the measuring frame to those of the frame."""
        R = self.base[:3, :3].mT if self.frame == "base" else torch.eye(3, dtype=self.base.dtype, device=HOST)
        return torch.block_diag(R, R).to(self.fitted.deformation.x.device)


def checked_tip(robot: Tree, tip: str | None) -> str:
    """The tip of a tool; raises InputError if it is unknown, or if there are several and none is named."""
    if tip is None and len(robot.tips) > 1:
        what = f"robot '{robot.name}' has several tips"
        raise InputError.of(what, fix=f"name its `tip`, {listed(robot.tips)} (model.with_tool(tool, tip=...))")
    if tip is not None and tip not in robot.tips:
        raise InputError.of("`tip`", expected=f"one of {listed(robot.tips)}", got=as_written(tip))
    return next(iter(robot.tips)) if tip is None else tip


def tool_transform(tool: object) -> Tensor:
    """A tool centre point in the tip's frame, (4, 4) m: a transform, a position (3,), or None for the tip itself.

    Raises:
        InputError: another shape, values that are not finite, or no rigid transform.
    """
    identity = torch.eye(4, dtype=torch.float64, device=HOST)
    if tool is None:
        return identity
    fix = "pass a position (3,) in m, or a transform (4, 4), in the frame of the tip"
    given = as_tensor(tool, "tool", (4, 4), also=[(3,)], fix=fix).detach().to(HOST)
    place = given[:3, 3] if given.ndim == 2 else given
    if float(place.abs().max()) > LONGEST_TOOL:
        raise InputError.of("`tool`", expected=f"at most {LONGEST_TOOL:g} m", got=place.tolist(), fix="pass metres")
    if given.ndim == 2:
        return rigid_poses(given[None], "`tool`".format)[0]
    identity[:3, 3] = given
    return identity


def tool_points(tool: Tensor) -> Tensor:
    """The three virtual points of a tool (4, 4), in the tip's frame: (3, 3) m."""
    return mark_points(tool[None], TOOL_LEVER)[0]


def pose_slopes(points: Tensor, slopes: Tensor) -> Tensor:
    """Derivatives (N, 6, n) of the poses that fit three points best, see :func:`program.pose_slopes`."""
    use = torch, marks(points.device), torch.eye(3, dtype=points.dtype, device=points.device)
    return program.pose_slopes(points, slopes, poses_from_marks(points, TOOL_LEVER)[:, :3, :3], use)


REFERENCE_ROWS = 40  # most configurations of the model over which the two motions are found
SMALLEST_MOTION = 1e-9
"""Of a motion, relative to the largest: smaller ones are the same for base and tool, as a SCARA robot's lift is."""


def covariance_without_placement(model: Any, q: Tensor, tool: Tensor, tip: str | None = None) -> Tensor:
    """Covariances (M, 6, 6) of a tool's shifts [m] and turns [rad], about the axes of the measuring frame.

    Args:
        model: the calibrated model. q: (M, n) joint values, rad or m.
        tool: (4, 4) tool centre point in the tip's frame, m. tip: that carries it, for a robot with several.
    """
    fitted = model.map.unregistered
    kinematics = ToolKinematics(fitted, model.nominal, tool, "measuring", tip or model.tool_tip)
    x_fit = model.configurations
    every = torch.linspace(0, len(x_fit) - 1, min(len(x_fit), REFERENCE_ROWS), dtype=torch.float64, device=x_fit.device)
    rows = torch.cat([x_fit[every.round().long()], q.detach()])
    points, at = kinematics.deformation.linearised_value(rows)
    covariance = fitted.covariance_between(at)  # open directions are those of both motions
    points = points.unflatten(1, (3, 3))
    base, spread = frame_slopes(points, points.mean((0, 1))), tool_points(tool).to(points)  # a motion of the base moves
    flange = FlangePoints(kinematics.nominal, spread, on=(kinematics.tip,) * 3)  # the points, one of the tool these
    by_place = marker_slopes(kinematics.deformation, flange, at) @ frame_slopes(spread[None], spread.mean(0))[0]
    motions = torch.cat([base, by_place], 2).flatten(0, 1)  # (9 (R + M), 12)
    reference, asked = motions.split([9 * len(every), 9 * len(q)])
    eye = torch.eye(len(asked), dtype=spread.dtype, device=spread.device)
    rest = torch.cat([-asked @ torch.linalg.pinv(reference, rtol=SMALLEST_MOTION), eye], 1)
    nearest = poses_from_marks(points[len(every) :], TOOL_LEVER)
    rest = pose_directions(nearest, TOOL_LEVER) @ rest.unflatten(0, (-1, 9))  # (M, 6, 9 (R + M))
    return rest @ covariance @ rest.mT


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
    geometry, elastic = nominal.geometry, nominal.elasticity is not None
    parts = (_array(part) for part in (geometry.base, geometry.joint_errors, nominal.folded(theta)))
    chain = calibrated_chain(geometry.chain.arrays, *parts, geometry.markers, elastic=elastic, **nominal.own._asdict())
    joint, task = (_recorded(flow, deformation.integrator) for flow in flows)
    points = geometry.absorb(nominal.split(theta)[0].detach().cpu()).tool if other is None else other.points
    on = geometry.on if other is None else other.map.geometry.on
    return Program(joint, chain, task, _array(points), tuple(map(geometry.chain.tips.index, on)))


def _recorded(flow: Flow, integrator: RungeKutta) -> RecordedFlow:
    kernel = [cast(RadialKernel, term).to_config() for term in flow.kernel.terms]
    coefficients, weights = integrator.tableau()
    return recorded_flow(kernel, _array(torch.stack(flow.stages)), _array(coefficients), _array(weights))


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy()
