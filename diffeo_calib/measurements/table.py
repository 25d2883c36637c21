"""Measured pairs (joint configuration, marker positions or pose): the table, its subsets, splits and folds.

Everything is SI and float64: radians for revolute joints, metres for prismatic joints and for points. A measured pose
is stored as a pose and as the three points that represent it (:mod:`diffeo_calib.measurements.poses`).
:mod:`diffeo_calib.measurements.csv.files` reads and writes files in other units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.images import Camera
from diffeo_calib.common.device import HOST
from diffeo_calib.common.inference_mode import methods_outside_inference_mode
from diffeo_calib.measurements.frozen import set_attributes, with_attributes
from diffeo_calib.measurements.image_columns import KnownCamera, image_columns
from diffeo_calib.measurements.mixtures import device_rows, of_one_layout, socket_rows
from diffeo_calib.measurements.observations import Observations, joined_tables
from diffeo_calib.measurements.pose_columns import pose_columns
from diffeo_calib.measurements.pose_frames import POINTS, by_frame
from diffeo_calib.measurements.poses import LEVER
from diffeo_calib.measurements.row_table import RowTable
from diffeo_calib.measurements.sockets import NO_SOCKET, Distances, Sockets, socket_numbers
from diffeo_calib.measurements.splits import exact_copies
from diffeo_calib.measurements.table_checks import (
    check_rows,
    check_size,
    joint_table,
    known_covariance,
    measured_sha256,
    session_numbers,
    tip_names,
    unique_names,
    warn_if_suspicious,
)
from diffeo_calib.measurements.table_frame import measurements_frame
from diffeo_calib.measurements.table_html import measurements_html, measurements_text
from diffeo_calib.measurements.visibility import (
    check_every_marker_seen,
    marker_deviations,
    marker_places,
    visible_markers,
)

if TYPE_CHECKING:
    from diffeo_calib.measurements.readings import Readings


@methods_outside_inference_mode
@dataclass(frozen=True, init=False, repr=False, eq=False)
class Measurements(RowTable):
    """N joint configurations and measured positions of P markers; see also :meth:`from_poses`, :meth:`from_sockets`.

    Args:
        q: (N, n) joint configurations, rad (revolute) or m (prismatic), or a data frame with the columns
            ``joint_names``, by default all of its columns.
        points: (N, P, 3) measured positions of the P markers, m; (N, 3) means one marker. NaN for all three
            coordinates of a marker that is hidden in a row, behind the arm for instance; every row shows some marker.
        joint_names: n names, in the order of the columns of ``q``.
        marker_names: P names.
        on: names of the tips that carry the markers, P of them, for a robot with several tips; one may carry several.
        std: known standard deviations of the measured coordinates, m: one for all, (N,), (N, P) or (N, P, 3).
        doubt: whether to warn about rows and values that look wrong.

    Attributes:
        poses: (N, 4, 4) measured poses, m, or (N, T, 4, 4) on T tips; None for points. ``points`` are then the three
            points of each pose, and ``on`` their tips.
        lever: distance of these points from the pose's origin, m.
        board: (N, 3) for a camera on the tool, place of the board in its frame, m; deviations are along its axes then.
        std: (N, P, 3) known standard deviations of the measured positions, m, NaN where hidden; (N, T, 3) for poses.
        rotation_std: (N, 3) or (N, T, 3) known standard deviations of the orientations, rad, about the measuring axes.
        corners: (N, K, 5) of images, see :meth:`from_images`; None otherwise. camera: lens and board that they show.
        pose_covariance: (N, 6, 6) of the errors of the poses in them. pose_shared: (N, 6, c) effects of c errors of
            unit variance that all images share: of lens and board.
        session: (N,) int64, the set-up of the measuring device in which every row was measured, -1 for none; or None.
        session_names: their names.
        payload: (N,) known masses that the robot carried, in any unit; None where they are not known.
        payload_at: name of the link that carried them; None for the robot's tip.
        socket: (N,) int64, where the ball, the last marker, rested, -1 if a device measured. sockets: names, distances.
        line_numbers: (N,) int64, where every row comes from: its line in the file, or its row number in the original
            table. Subsets keep the line numbers of their rows.
        file_sha256: SHA-256 of the file that the rows were read from; None for arrays.
        origin: that file and how it was read, see :class:`~diffeo_calib.measurements.csv.origin.TableOrigin`; None for
            arrays.

    The tensors are detached float64 copies: later changes to the arguments do not affect them.

    Raises:
        MeasurementError: wrong shape, no row, different numbers of rows, NaN (but for hidden markers), infinite or
            impossibly large values (the first is named), a number of names that does not match, a standard deviation
            that is not positive.

    Warns:
        DiffeoCalibWarning: exact repeats of a row; joint values so large that they look like degrees.
            Nothing is dropped.
    """

    BY_ROW = ("q", "points", "poses", "board", "std", "rotation_std", "corners", "pose_covariance", "pose_shared")
    BY_ROW = (*BY_ROW, "line_numbers", "session", "payload", "socket")
    ALIKE = ("joint_names", "marker_names", "on", "lever", "session_names", "payload_at", "sockets", "n", "markers")
    ALIKE = (*ALIKE, "camera")

    q: Tensor
    points: Tensor
    joint_names: tuple[str, ...] | None
    marker_names: tuple[str, ...] | None
    on: tuple[str, ...] | None
    poses: Tensor | None
    lever: float | None
    board: Tensor | None
    std: Tensor | None
    rotation_std: Tensor | None
    corners: Tensor | None
    camera: Camera | None
    pose_covariance: Tensor | None
    pose_shared: Tensor | None
    session: Tensor | None
    session_names: tuple[str, ...]
    payload: Tensor | None
    payload_at: str | None
    socket: Tensor | None
    sockets: Sockets | None
    line_numbers: Tensor
    file_sha256: str | None
    origin: object | None

    def __init__(
        self,
        q: object,
        points: object,
        joint_names: Sequence[str] | None = None,
        marker_names: Sequence[str] | None = None,
        *,
        on: Sequence[str] | None = None,
        std: object = None,
        doubt: bool = True,
    ) -> None:
        angles, joints = joint_table(q, joint_names)
        places = marker_places(points).to(angles.device)
        check_rows(angles, places, "points")
        check_size(places, "points")
        markers = unique_names(marker_names, "marker_names", places.shape[1], "marker in `points`")
        known = marker_deviations(std, places)
        tips = tip_names(on, places.shape[1])
        set_attributes(self, q=angles, points=places, joint_names=joints, marker_names=markers, on=tips, std=known)
        set_attributes(self, poses=None, lever=None, board=None, rotation_std=None)
        set_attributes(self, corners=None, camera=None, pose_covariance=None, pose_shared=None)
        set_attributes(self, line_numbers=torch.arange(len(angles), device=HOST))
        set_attributes(self, session=None, session_names=(), socket=None, sockets=None, payload=None, payload_at=None)
        set_attributes(self, file_sha256=None, origin=None)
        if doubt:
            check_every_marker_seen(self)
            warn_if_suspicious(self)

    @classmethod
    def from_poses(
        cls,
        q: object,
        poses: object,
        joint_names: Sequence[str] | None = None,
        *,
        on: Sequence[str] | None = None,
        lever: float = LEVER,
        position_std: object = None,
        rotation_std: object = None,
        camera_on_tool: bool = False,
        doubt: bool = True,
    ) -> Measurements:
        """N joint configurations and the measured poses of a frame fixed on the tool, or of one on each of T tips.

        Args:
            q: as in the constructor.
            poses: (N, 4, 4) or (N, T, 4, 4) rigid transforms from the tool's frame to the measuring frame, m. Rotations
                may be off by 0.001, since files have few digits: the nearest rotations are used. Of several frames one
                that is hidden in a row is NaN; every row shows some frame.
            joint_names: n names, in the order of the columns of ``q``.
            on: names of the tips that carry the frames, T of them, for a robot with several tips.
            lever: distance from the frame's origin to the three points that represent a pose, m. It weighs
                orientation against position: with 0.1 m, an error of 1 mrad counts as much as one of 0.1 mm.
            position_std: known standard deviations of the positions, m: one for all, (N,) or (N, 3); of several frames
                one for all, (N,), (N, T) or (N, T, 3).
            rotation_std: known standard deviations of the orientations, rad, about the axes of the measuring frame,
                in the same shapes.
            camera_on_tool: the poses are those of a fixed board in the frame of a camera on the tool, as detectors of
                boards return them, and deviations are along the camera's axes. They are kept inverted, as the camera's
                poses in the board's frame, see :mod:`~diffeo_calib.measurements.tool_camera`.
            doubt: whether to warn about rows and values that look wrong.

        Raises:
            MeasurementError: as the constructor; a transform that is not rigid (its row is named); a lever or a
                standard deviation that is not positive.
        """
        angles, joints = joint_table(q, joint_names)
        columns = pose_columns(angles, poses, lever, position_std, rotation_std, camera_on_tool=camera_on_tool)
        data = cls(angles, columns["points"], joints, doubt=False)
        data = with_attributes(data, **columns, lever=float(lever)).with_tips(on)
        if doubt:
            check_every_marker_seen(data)
            warn_if_suspicious(data)
        return data

    @classmethod
    def from_images(
        cls,
        q: object,
        corners: object,
        size: tuple[int, int],
        joint_names: Sequence[str] | None = None,
        *,
        camera_on_tool: bool = True,
        camera: Camera | None = None,
        board: BoardPrior | None = None,
        on: Sequence[str] | None = None,
        lever: float = LEVER,
        doubt: bool = True,
    ) -> Measurements:
        """N joint configurations and images of a printed board, taken by a camera on the tool or by a fixed one.

        Lens, board and the board's pose in every image are found together, see :mod:`~diffeo_calib.cameras.images`;
        what the images leave open of lens and board is estimated with the robot.

        Args:
            q: as in the constructor.
            corners: (N, K, 5) x, y, z of the board's corners in its plane, m, and their pixels u, v (column and row, 0
                in the middle of the first pixel); NaN for corners that an image does not show.
            size: width and height of the images, pixels.
            joint_names: n names, in the order of the columns of ``q``.
            camera_on_tool: whether the camera is on the tool and the board stands; otherwise the board is on the tool.
            camera: what is known of lens and board, such as ``measurements.camera`` of an earlier calibration; None if
                nothing is.
            board: prior of a board that is not known yet.
            on, lever, doubt: see :meth:`from_poses`. The board's frame is in its middle.

        Raises:
            MeasurementError: as the constructor; too few corners in an image, or corners that are not in a plane.
        """
        angles, joints = joint_table(q, joint_names)
        seen = image_columns(angles, corners, KnownCamera(size, camera, board), camera_on_tool=camera_on_tool)
        named = {"on": on, "lever": lever, "camera_on_tool": camera_on_tool, "doubt": doubt}
        return with_attributes(cls.from_poses(angles, seen.pop("poses"), joints, **named), **seen)

    @classmethod
    def from_sockets(
        cls,
        q: object,
        sockets: Sequence[str],
        joint_names: Sequence[str] | None = None,
        *,
        distances: Distances | None = None,
        distance_std: float | None = None,
        doubt: bool = True,
    ) -> Measurements:
        """N joint configurations in which a ball on the tool rested in sockets. No position was measured.

        Args:
            q: as in the constructor.
            sockets: name of the socket of each row (N,), such as "front/0": the place where the block stood, a slash,
                and the socket in the block. Splits hold out whole places.
            joint_names: n names, in the order of the columns of ``q``.
            distances: known distances, m, by the names of two sockets: ``("front/0", "front/1")``, or ``("0", "1")`` at
                every place that has both. Without one, the size of the robot is that of its description.
            distance_std: standard deviation of the known distances, m.
            doubt: whether to warn about rows and values that look wrong.

        Returns:
            measurements whose ``points`` are NaN, and whose ``socket`` (N,) holds numbers of ``sockets.names``.

        Raises:
            MeasurementError: not one name per row; a distance that is not positive, or between unknown sockets; a
                distance without a standard deviation, or the other way round; else as the constructor.
        """
        angles, joints = joint_table(q, joint_names)
        numbers, known = socket_numbers(sockets, len(angles), distances, distance_std)
        nowhere = torch.zeros(len(angles), 1, 3, dtype=torch.float64, device=angles.device)
        data = cls(angles, nowhere, joints, doubt=doubt)
        return with_attributes(data, points=torch.full_like(nowhere, torch.nan), socket=numbers, sockets=known)

    @classmethod
    def joined(cls, parts: Sequence[Measurements | Readings | Observations]) -> Any:
        """The rows of several tables, in order: :class:`Measurements` if one table can hold them.

        These are rows with the same columns, and measured positions beside rows in sockets, of one tool, whose ball is
        then the last marker. Rows of other kinds become :class:`Observations`.

        Raises:
            MeasurementError: tables that differ in joints, payloads, markers or known deviations.
        """
        return joined_tables(parts)

    @property
    def covariance(self) -> Tensor | None:
        """The known part of the noise: (N, 3 P, 3 P) in m^2, zero for hidden markers; None if unknown.

        Coordinates of a marker are adjacent. An error dt of a pose's position and a small error w of its orientation
        move the point at arm a by dt + w x a: the covariance of its nine coordinates has rank 6, or 3 if only one of
        these errors is known. A camera on the tool errs about the board, see measurements/tool_camera.py.
        """
        return known_covariance(self)

    @property
    def sha256(self) -> str:
        """SHA-256 of the file that the rows were read from, or of the arrays if they come from Python."""
        return self.file_sha256 or measured_sha256(self)

    @property
    def frames(self) -> Tensor | None:
        """(N, T, 4, 4) the measured poses, T = 1 included, m; NaN where hidden; None for points."""
        return None if self.poses is None else by_frame(self.poses)

    @property
    def markers(self) -> int:
        """Number of markers P; 3 for every pose of a row, because three points represent a pose."""
        return self.points.shape[1]

    @property
    def visible(self) -> Tensor:
        """(N, P) boolean: which markers were seen in which rows."""
        return visible_markers(self)

    @property
    def kind(self) -> str:
        """What the rows are: "position", "pose" or "socket"; "mixture" for positions and sockets."""
        if self.sockets is not None:
            return "socket" if self.without_device and self.markers == 1 else "mixture"
        return "position" if self.poses is None else "pose"

    @property
    def column_kind(self) -> object:
        """What tables that can be joined into one table have in common."""
        return self.kind

    @property
    def ball_tip(self) -> str | None:
        """Name of the tip that carries the ball in sockets; None without one."""
        return None if self.sockets is None or self.on is None else self.on[-1]

    @property
    def without_device(self) -> bool:
        """Whether no position was measured: the ball of every row rested in a socket."""
        return self.socket is not None and bool((self.socket != NO_SOCKET).all())

    @property
    def socket_numbers(self) -> Tensor | None:
        """(N,) int64, number of each row's socket, -1 for other rows; None without sockets."""
        return self.socket

    @property
    def places(self) -> Tensor | None:
        """(N,) int64, number of the place of each row's socket, -1 where a device measured; None without sockets."""
        if self.socket is None or self.sockets is None:
            return None
        return torch.where(self.socket == NO_SOCKET, NO_SOCKET, self.sockets.place[self.socket])

    @property
    def device_names(self) -> list[str]:
        """(N,) name of the set-up in which each row was measured, "" without one."""
        numbers = [-1] * len(self) if self.session is None else self.session.tolist()
        return ["" if number < 0 else self.session_names[number] for number in numbers]

    def copies(self) -> list[tuple[int, int]]:
        """Return (earlier row, row) for every row that repeats an earlier one exactly: real repeats differ by noise."""
        return exact_copies(torch.cat([self.q, self.points.flatten(1)], dim=1))

    device_rows, socket_rows, beside_one_another = device_rows, socket_rows, staticmethod(of_one_layout)
    __repr__, _repr_html_, to_frame = measurements_text, measurements_html, measurements_frame

    def with_tips(self, on: Sequence[str] | None) -> Measurements:
        """Return the same measurements with markers or poses on these tips, a name for each, else MeasurementError."""
        points = 1 if self.poses is None else POINTS
        return with_attributes(self, on=tip_names(on, self.markers // points, points))

    def with_sessions(self, names: Sequence[str] | None) -> Measurements:
        """Return the same measurements in several set-ups of the measuring device, a name for each row (N,).

        A calibration gives each set-up its own measuring frame; its model is in that of the largest.

        Raises:
            MeasurementError: not one name per row.
        """
        numbers, known = session_numbers(names, len(self))
        return with_attributes(self, session=numbers, session_names=known)
