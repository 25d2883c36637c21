"""Calibrated kinematics of a robot: markers or poses, their Jacobian, uncertainty and inverse."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, number_of
from diffeo_calib.common.data_frames import data_frame, is_data_frame
from diffeo_calib.common.device import HOST, methods_outside_inference_mode, usable
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.device_readings import PredictedReadings, predicted_readings
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.provenance import Provenance, Summary
from diffeo_calib.kinematics.registered_map import Registration, robot_map
from diffeo_calib.kinematics.tool import ToolKinematics, checked_tip, program_of, takes_program, tool_transform
from diffeo_calib.kinematics.transmission import transmission
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.poses import (
    POINTS,
    directions_of_frames,
    frames_of_points,
    kind_of_points,
    of_frames,
    own_blocks,
)
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.payload import Payload
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import Extrinsics


@methods_outside_inference_mode
class CalibratedKinematics:
    """Calibrated marker positions of a robot, or poses of its tool.

    Args:
        robot: the nominal chain.
        map: the fitted exact model; its nominal map is a :class:`GeometryMap` of the robot.
        summary: numbers and sentences about the calibration that are saved with the model; None without one.
        lever: for a model that was calibrated with poses, the distance in m of the three points of each from the origin
            of the measured frame; see :meth:`Measurements.from_poses`.
        tool: tool centre point in the tip's frame, (4, 4) or position (3,) in m, of :meth:`tool_poses`; else the tip.
        tool_tip: name of the tip that carries it, for a robot with several.
        rigid_errors: (n_all, 4, 4) the joints' error transforms of the geometric calibration alone, m, which describe
            the robot better than those of :attr:`geometry` where nothing else can be used; None if unknown.
        provenance: when the model was fitted, with what and to which table; None if that is not known.
        ball: whether the last marker is a ball whose position no device measured; so it is if none was measured at all.
        placement: devices of the fit in unknown places: measuring frames of sessions, sockets, devices of readings.
        scales: scales of kernels, priors and noise as one vector, see ``Hyperparameters.vector``; None if unknown.
        learnt: the registration whose rows the map knows as those of a fit; None without one.

    Raises:
        InputError: a lever that is not positive, or one for a number of points that is no multiple of three; error
            transforms that are not rigid.
    """

    def __init__(
        self,
        robot: Tree,
        map: FittedMap,
        summary: Summary | None = None,
        *,
        lever: float | None = None,
        tool: object = None,
        tool_tip: str | None = None,
        rigid_errors: Tensor | None = None,
        provenance: Provenance | None = None,
        ball: bool = False,
        placement: tuple[Extrinsics, ...] = (),
        scales: Tensor | None = None,
        learnt: Registration | None = None,
    ) -> None:
        self.bodies = Bodies(lever)
        self.bodies.check_points(map.m // 3)
        self.robot, self.map, self.summary, self.lever = robot, map, summary, lever
        self.tool = tool_transform(tool)
        self.tool_tip = None if tool_tip is None else checked_tip(robot, tool_tip)
        rigid = rigid_errors is not None
        self.rigid_errors = replace(self.nominal.geometry, joint_errors=rigid_errors).joint_errors if rigid else None
        self.provenance, self.placement, self.scales, self.learnt = provenance, placement, scales, learnt
        self.ball = ball or map.workspace is not None

    def with_tool(self, tool: object, tip: str | None = None) -> CalibratedKinematics:
        """Return the model with another tool centre point in the tip's frame, (4, 4) or position (3,) in m.

        For a robot with several tips, ``tip`` names the one that carries it, and commands and exports are those of it.
        """
        return self.changed(tool=tool, tool_tip=self.tool_tip if tip is None else tip)

    @property
    def own_frame(self) -> bool:
        """Whether no device measured positions, only readings or a ball in sockets: see :meth:`predict`."""
        return self.map.workspace is not None and self.registration is None

    @property
    def payload(self) -> float | None:
        """Mass that the robot carries in every query, in the unit of its measurements; None if they had no payload."""
        return self.nominal.load.mass

    def with_payload(self, mass: float) -> CalibratedKinematics:
        """Return the robot with another payload, for queries, compensation and exports.

        A model that was calibrated with payloads carries the median of them until it is told another. For measurements
        with a payload of each row there is :func:`diffeo_calib.evaluate`.

        Args:
            mass: at the tip, or where the payload was in the fit, in the unit of the measurements.

        Raises:
            InputError: a negative mass, one far above those of the fit, or a model that was calibrated without.

        Warns:
            DiffeoCalibWarning: a mass above those of the fit.
        """
        number = number_of(mass)
        if number is None or not 0 <= number < inf:
            raise InputError.of("`mass` of the payload", expected="a number of 0 or more", got=as_written(mass))
        load = self.nominal.load.weighing(torch.tensor(number, dtype=torch.float64, device=HOST))
        return self._carrying(load.checked())

    def at_payloads(self, masses: Tensor | None) -> CalibratedKinematics:
        """The model at rows, each under its payload: for queries at N configurations, one for each mass (N,).

        Raises:
            MeasurementError: payloads on one side only. InputError: masses far above those of the fit.

        Warns:
            DiffeoCalibWarning: masses above those of the fit.
        """
        return self._carrying(self.nominal.load.under(masses).checked())

    def _carrying(self, load: Payload) -> CalibratedKinematics:
        nominal = self.nominal
        return self if load is nominal.load else self.changed(map=self.map.with_nominal(nominal.with_payload(load)))

    def registered(
        self, measurements: Measurements, *, free: str = "both", marker_std: float | None = None, learn: bool = True
    ) -> CalibratedKinematics:
        """Return the robot seen by a device that has moved, with markers that have moved or other ones.

        From 4 to 10 poses the measuring frame and the markers are found anew, and what the rows say of the robot is
        learnt. Outliers take no part, predictions include what is not known, and of more than 200 rows 200 are used.

        Args:
            measurements: N configurations with markers or poses in the new measuring frame; of several sessions the
                largest gives the frame, and the others are placed beside it. The number of markers may differ from that
                of the fit, and there may be poses where there were markers or the other way round. A ball in sockets,
                or readings, of a model of such rows, alone or beside positions: the ball stays on the tool, and the
                new devices are placed around the robot. Devices that the model knows and that have no rows here stay
                where they are.
            free: what may have moved, "both", "base" (the device or the robot's foot) or "marker" (or the tool).
            marker_std: deviation of the markers from their old places on the flange, m; by default the rows decide.
            learn: False finds places alone, for rows that judge the robot afterwards. So it is for models of readings
                and where rows contradict the model, leave a place open, or show another number of markers.

        Returns:
            the model in the new measuring frame; its :attr:`registration` says what was found.

        Raises:
            InputError: arguments of another kind, joints in another order, other markers although they are not free,
                or a task kernel that is not the same in all directions.
            MeasurementError: too few rows.

        Warns:
            DiffeoCalibWarning: outliers, directions that the rows do not determine, errors that remain; devices that
                read a ball or frame that the rows' markers replace, which the model then no longer knows.
        """
        from diffeo_calib.calibration.recalibration.register import registered  # noqa: PLC0415  # it reaches up

        return registered(self, measurements, free=free, marker_std=marker_std, learn=learn)

    @property
    def registration(self) -> Registration | None:
        """Result of the registration; None for a model in the place of its fit."""
        return self.learnt or self.map.registration

    def to(self, device: torch.device | str) -> CalibratedKinematics:
        """Return the model on a device, where its joint values must be too."""
        return self.changed(map=self.map.to(usable(device)))

    @property
    def report(self) -> dict[str, float | int | str]:
        """The summary as a dictionary whose keys name their units, see :meth:`Summary.to_dict`; empty without one."""
        return {} if self.summary is None else self.summary.to_dict()

    @property
    def geometry(self) -> Geometry:
        """Base, joint errors and markers, refined together with the deformations; without gravity sag."""
        nominal = self.nominal
        refined = nominal.geometry.absorb(nominal.split(self.map.deformation.momenta.theta)[0])
        registration = self.registration
        return refined if registration is None else replace(refined, tool=registration.markers)

    def turns(self, q: Tensor) -> Tensor:
        """(N, P, 3, 3) turns of the tips that carry the points at (N, n) joint values, by the geometry."""
        return self.geometry.marker_turns(q)

    @property
    def measured_frame(self) -> Tensor:
        """(4, 4) the measured frame of a model of poses in the tip's frame, m; of those of several tips (T, 4, 4).

        A tool X relative to it, ``model.measured_frame @ X``, is known best: a shift of the markers along the last
        joint's axis cannot be told from one of that joint.
        """
        return of_frames(frames_of_points(self.geometry.tool[None], self.bodies.pose_lever()))[0]

    @property
    def nominal(self) -> GeometryMap:
        """k0 of the map: the registered robot with its parameters theta."""
        return robot_map(self.map.unregistered)

    def transmission(self, joint: str, values: object) -> Tensor:
        """Transmission error of one joint as a function of its own value, to first order in the deformation.

        This is the motion of the joint beyond its reading. A constant part is indistinguishable from the joint
        offset, which belongs to the geometry.

        Args:
            joint: its name. values: (M,) values of this joint, rad or m, or a data frame with its column.

        Returns:
            (M,) rad or m.

        Raises:
            InputError: unknown joint, wrong shape, or values that are not finite.
        """
        return transmission(self.map.deformation, self.robot, joint, values)

    @property
    def markers(self) -> int:
        """P, the number of markers; three for every frame of a model of poses."""
        return self.map.m // 3

    @property
    def on(self) -> tuple[str, ...]:
        """Names of the tips that carry the points of the model, one for each."""
        return self.geometry.on

    def __repr__(self) -> str:
        carries = f"; payload {self.payload:g}" if self.nominal.load else ""
        return (
            f"CalibratedKinematics({self.robot!r}, {measured_words(self)}, fitted to {len(self.map.x)} poses{carries})"
        )

    def to_frame(self, q: Any) -> Any:
        """Predicted markers with the standard deviations of a new measurement, as a pandas.DataFrame in m.

        Args:
            q: (N, n) joint values, rad or m, or a data frame, whose index is kept.

        Returns:
            columns x, y, z, std_x, std_y, std_z; marker1_x, ... with several markers, ball_x, ... of a ball beside
            them. Poses: the origin of their frame, and a rotation vector rx, ry, rz [rad] with deviations about the
            axes of the measuring frame; TIP_x, ... of several.

        Raises:
            ImportError: pandas is not installed.
        """
        frame = self.bodies.predicted(self, q)
        names = [f"{prefix}{name}" for prefix in self.bodies.prefixes(self) for name in frame.names]
        mean, std = frame.mean.flatten(1), frame.covariance.diagonal(dim1=-2, dim2=-1).sqrt().flatten(1)
        columns = dict(zip([*names, *(f"std_{name}" for name in names)], [*mean.T, *std.T], strict=True))
        return data_frame(columns, getattr(q, "index", None) if is_data_frame(q) else None)

    @property
    def configurations(self) -> Tensor:
        """(N, n) the configurations the model was fitted to."""
        return self.map.x

    def __call__(self, q: object) -> Tensor:
        """Marker positions in the measuring frame, or where none was measured in the model's own (:attr:`own_frame`).

        Args:
            q: (N, n) joint configurations, rad or m, in the order of ``robot.joint_names``.

        Returns:
            (N, P, 3) in m, differentiable by autograd in q.

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        q = self._joints(q)
        at_rows = self.map.deformation.at_controls(q) if takes_program(q) else None
        if at_rows is None and (program := program_of(self.map.deformation, q)) is not None:
            return torch.from_numpy(program.points(q.numpy()))
        return (self.map.deformation(q) if at_rows is None else at_rows).unflatten(1, (-1, 3))

    def poses(self, q: object) -> Tensor:
        """Poses of the measured frame in the measuring frame, by a least-squares fit to its three points.

        Joint values (N, n) -> (N, 4, 4) rigid transforms, m, or (N, T, 4, 4) of frames on T tips; detached (for
        derivatives see :meth:`jacobian`).

        Raises:
            InputError: wrong shape, values that are not finite, or a model that was not calibrated with poses.
        """
        return of_frames(frames_of_points(self(q), self.bodies.pose_lever()))

    def predict_poses(self, q: object, *, noise: bool = True) -> tuple[Tensor, Tensor]:
        """Poses and their covariances; see :meth:`predict`.

        Args:
            q: (N, n) joint configurations.
            noise: whether the covariance is that of a new measurement (default) or of the model alone.

        Returns:
            poses (N, 4, 4) in m, and covariances (N, 6, 6) of a translation in m and a small rotation vector in rad,
            both in the measuring frame: blocks in m^2, m rad and rad^2; (N, T, 4, 4) and (N, T, 6, 6) of frames on T
            tips. Raises as :meth:`poses`.
        """
        lever = self.bodies.pose_lever()

        def frames(points: Tensor) -> Tensor:
            return frames_of_points(points.unflatten(1, (-1, 3)), lever)

        mean, covariance = self.map.posterior(
            self._joints(q).detach(), noise=noise, directions=lambda points: directions_of_frames(frames(points), lever)
        )
        return of_frames(frames(mean)), of_frames(own_blocks(covariance, self.markers // POINTS))

    def jacobian(self, q: object) -> Tensor:
        """Exact derivative of the markers by the joints: (N, n) -> (N, P, 3, n), m/rad or m/m; raises like the call."""
        q = self._joints(q)
        if (program := program_of(self.map.deformation, q)) is not None:
            return torch.from_numpy(program.points_and_jacobian(q.numpy())[1])
        return self.map.deformation.jacobian(q).unflatten(1, (-1, 3))

    def predict(self, q: object, *, noise: bool = True) -> tuple[Tensor, Tensor]:
        """Markers (N, P, 3) in m and their covariances (N, P, 3, 3) in m^2; see :meth:`FittedMap.predict`.

        Positions are in the measuring frame. If no device measured one (:attr:`own_frame`), they are in the model's
        own: then neither they nor the covariances, also without noise, say where that is in your world, and regions
        hold true points only after one rigid motion of all. :meth:`registered` with positions finds it.

        Args:
            q: (N, n) joint configurations.
            noise: whether the covariance is that of a new measurement (default) or of the model alone.
        """
        mean, covariance = self.map.posterior(self._joints(q).detach(), noise=noise)
        return mean.unflatten(1, (-1, 3)), own_blocks(covariance, self.markers)

    def predict_readings(self, q: object, *, noise: bool = True) -> list[PredictedReadings]:
        """Predicted readings of the fit's devices: distances, heights, images, each in its unit.

        Args:
            q: (N, n) joint configurations.
            noise: whether the covariance is that of a new reading (default) or of the model alone.

        Returns:
            one entry for every device, and for markers that were mounted anew (their positions); none for a model of
            positions or poses alone, see :meth:`predict`.
            Devices of a kind that is not registered in this session are left out, with a warning.
        """
        return predicted_readings(self, self._joints(q).detach(), noise=noise)

    def tool_poses(self, q: object, tool: object = None, frame: str = "base", tip: str | None = None) -> Tensor:
        """Poses of a tool centre point, which need not have been measured.

        Any point of the flange moves as psi(k0(phi^-1(q))); three of them around the tool centre point give its pose.
        Models that were fitted to positions of one marker know the roll about the last axis from the prior alone.

        Args:
            q: (N, n) joint configurations, rad or m.
            tool: in the tip's frame, (4, 4) or position (3,) in m; the model's own by default.
            frame: "base" of the robot, as it was found, or "measuring".
            tip: name of the tip that carries the tool, for a robot with several; the model's own by default.

        Returns:
            (N, 4, 4) rigid transforms, m; detached, for derivatives see :meth:`tool_jacobian`.

        Raises:
            InputError: wrong shapes, values that are not finite, another frame or an unknown tip.
        """
        return self._tool(tool, frame, tip).poses(self._joints(q))

    def tool_jacobian(self, q: object, tool: object = None, frame: str = "base", tip: str | None = None) -> Tensor:
        """Exact derivative of :meth:`tool_poses`: (N, n) -> (N, 6, n), arguments as there.

        Linear velocity of the tool centre point [m/rad or m/m], then angular velocity, about the axes of the frame.
        """
        return self._tool(tool, frame, tip).jacobian(self._joints(q))

    def predict_tool_poses(
        self, q: object, tool: object = None, frame: str = "base", tip: str | None = None
    ) -> tuple[Tensor, Tensor]:
        """Poses of a tool centre point (N, 4, 4) in m and how well the model knows them; see :meth:`tool_poses`.

        The covariance (N, 6, 6) is that of shifts in m and small turns in rad about the axes of the frame. It is larger
        in the base frame than in the measuring frame: base and errors of the first joint can hardly be told apart.
        """
        return self._tool(tool, frame, tip).predict(self._joints(q).detach())

    def _tool(self, tool: object, frame: str, tip: str | None) -> ToolKinematics:
        transform = self.tool if tool is None else tool_transform(tool)
        fitted = self.map.unregistered if frame == "base" else self.map  # where the device stands does not matter there
        return ToolKinematics(fitted, self.nominal, transform, frame, tip or self.tool_tip)

    def inverse(self, points: object, start: object) -> Tensor:
        """Joint configurations that bring the markers to given positions; see :meth:`FittedMap.inverse`.

        For a robot's commands use :func:`diffeo_calib.compensate`, with limits and a status for every row. A single
        marker constrains only its position. The points of target poses are ``mark_points(poses, model.lever)``.

        Args:
            points: (N, P, 3) targets in m in the measuring frame. start: (N, n), where the search for (N, n) begins.

        Raises:
            NumericalError: a target cannot be reached from its start.
        """
        q = self._joints(start)
        return self.map.inverse(as_tensor(points, "points", (len(q), self.markers, 3), empty=True).flatten(1), q)

    def changed(self, **changes: Any) -> CalibratedKinematics:
        """A copy with other values of some of the constructor's arguments."""
        return CalibratedKinematics(**{name: value for name, value in vars(self).items() if name != "bodies"} | changes)

    def _joints(self, q: object) -> Tensor:
        return self.robot.joint_values(q)  # pyright: ignore[reportArgumentType]


def measured_words(model: Any) -> str:
    """Targets of the calibration, such as "poses" or "2 marker(s)"."""
    return kind_of_points(model.markers, model.lever)
