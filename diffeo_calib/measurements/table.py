"""Measured pairs (joint configuration, marker positions or pose). SI and float64: radians, metres.

A measured pose is stored as a pose and as the three points that represent it (:mod:`diffeo_calib.measurements.poses`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, methods_outside_inference_mode
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.measurements import checks
from diffeo_calib.measurements import poses as pose_math
from diffeo_calib.measurements.bodies import BALL, Bodies
from diffeo_calib.measurements.images import ONE_SESSION, ImageTable
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.readings import KIND, Distances, SocketReadings, as_readings, checked_distances
from diffeo_calib.measurements.rows import set_attributes, with_attributes
from diffeo_calib.measurements.table_format import LEVER

XYZ, TURNS = ("x", "y", "z"), ("rx", "ry", "rz")


@methods_outside_inference_mode
@dataclass(frozen=True, init=False, repr=False, eq=False)
class Measurements(ImageTable):
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
            points of each pose, at the distance ``lever``, m, from its origin, and ``on`` their tips.
        board: (N, 3) for a camera on the tool, place of the board in its frame, m; deviations are along its axes then.
        std: (N, P, 3) known standard deviations of the measured positions, m, NaN where hidden; (N, T, 3) for poses.
        rotation_std: (N, 3) or (N, T, 3) known standard deviations of the orientations, rad, about the measuring axes.
        session: (N,) int64, the set-up of the measuring device in which every row was measured, -1 for none; or None.
        session_names: their names. remounted: whether the device stayed, and markers were mounted anew between them.
        payload: (N,) known masses that the robot carried, in any unit; None where they are not known.
        payload_at: name of the link that carried them; None for the robot's tip.
        line_numbers: (N,) int64, of every row in the file or the original table, also in subsets.
        file_sha256, origin: of the file that the rows were read from, see
            :class:`~diffeo_calib.measurements.csv.tables.TableOrigin`; None for arrays.

    The tensors are detached float64 copies: later changes to the arguments do not affect them.

    Raises:
        MeasurementError: wrong shape, no row, different numbers of rows, NaN (but for hidden markers), infinite or
            impossibly large values, a number of names that does not match, a standard deviation that is not positive.

    Warns:
        DiffeoCalibWarning: exact repeats of a row, joint values so large that they look like degrees; none is dropped.
    """

    BY_ROW = ("q", "points", "poses", "board", "std", "rotation_std", "line_numbers", "session", "payload")
    BY_ROW = (*BY_ROW, "covariates", *ImageTable.BY_IMAGE)
    ALIKE = ("joint_names", "marker_names", "on", "lever", "session_names", "payload_at", "n", "markers")
    ALIKE = (*ALIKE, "covariate_names", "cameras", "remounted")
    NUMBERED, COMPARED = ("session", "session_names"), ("q", "points")

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
        angles, joints = checks.joint_table(q, joint_names)
        places = checks.marker_places(points).to(angles.device)
        checks.check_rows(angles, places, "points")
        checks.check_size(places, "points")
        markers = checks.checked_names(marker_names, "marker_names", places.shape[1], "marker in `points`")
        spread = checks.deviations(std, "std", places)
        tips = checks.tip_names(on, places.shape[1])
        set_attributes(self, q=angles, points=places, joint_names=joints, marker_names=markers, on=tips, std=spread)
        set_attributes(self, line_numbers=torch.arange(len(angles), device=HOST))
        self.doubted(doubt)

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
            q, joint_names, doubt: as in the constructor.
            poses: (N, 4, 4) or (N, T, 4, 4) rigid transforms from the tool's frame to the measuring frame, m. Rotations
                may be off by 0.001, since files have few digits: the nearest rotations are used. Of several frames one
                that is hidden in a row is NaN; every row shows some frame.
            on: names of the tips that carry the frames, T of them, for a robot with several tips.
            lever: distance from the frame's origin to the three points that represent a pose, m. It weighs
                orientation against position: with 0.1 m, an error of 1 mrad counts as much as one of 0.1 mm.
            position_std: known standard deviations of the positions, m, in shapes that begin (N, T, 3), with several
                frames, or (N, 3), or one for all. rotation_std: of the orientations, rad, about the measuring axes.
            camera_on_tool: the poses are those of a fixed board in the frame of a camera on the tool, as detectors of
                boards return them, and deviations are along the camera's axes. They are kept inverted, as the camera's
                poses in the board's frame, see :func:`~diffeo_calib.measurements.poses.pose_jacobian`.

        Raises:
            MeasurementError: as the constructor; a transform that is not rigid; a lever that is not positive.
        """
        angles, joints = checks.joint_table(q, joint_names)
        with checks.of_measurements():
            frames, board = pose_math.checked_frames(poses).to(angles.device), None
            if camera_on_tool:
                if frames.shape[1] > 1:
                    fix = "calibrate each arm with its own camera, or give the cameras' poses in the board's frame"
                    what, got = "poses of a camera on the tool", frames.shape[1]
                    raise MeasurementError.of(what, expected="one tip", got=got, fix=fix)
                frames, board = pose_math.inverse_poses(frames), frames[:, 0, :3, 3]
            points = pose_math.points_of_frames(frames, lever)
        checks.check_rows(angles, frames, "poses")
        places = frames[..., :3, 3]
        like = places if places.shape[1] > 1 else places[:, 0]
        spread = checks.deviations(position_std, "position_std", like)
        columns = {"poses": pose_math.of_frames(frames), "lever": float(lever), "board": board}
        columns["std"] = spread if spread is None else spread.view(places.shape)
        columns["rotation_std"] = checks.deviations(rotation_std, "rotation_std", like)
        data = cls(angles, points, joints, doubt=False)
        return with_attributes(data, **columns).with_tips(on).doubted(doubt)

    @classmethod
    def of_points(cls, q: Tensor, points: Tensor, on: Sequence[str] | None, lever: float | None) -> Measurements:
        """Rows of markers (N, P, 3), m, or of the frames that these points stand for with a lever, m; NaN: hidden."""
        if lever is None:
            return cls(q, points, on=on, doubt=False)
        poses = pose_math.of_frames(pose_math.frames_of_points(points, lever))
        tips = None if on is None else on[:: pose_math.POINTS]
        return cls.from_poses(q, poses, on=tips, lever=lever, doubt=False)

    @staticmethod
    def from_sockets(
        q: object,
        sockets: Sequence[str],
        joint_names: Sequence[str] | None = None,
        *,
        distances: Distances | None = None,
        distance_std: float | None = None,
        doubt: bool = True,
    ) -> SocketReadings:
        """N joint configurations in which a ball on the tool rested in sockets. No position was measured.

        Args:
            q, joint_names, doubt: as in the constructor.
            sockets: name of the socket of each row (N,), such as "front/0": the place where the block stood, a slash,
                and the socket in the block. Splits hold out whole places.
            distances: known distances, m, by the names of two sockets: ``("front/0", "front/1")``, or ``("0", "1")`` at
                every place that has both. Without one, the size of the robot is that of its description.
            distance_std: standard deviation of the known distances, m.

        Returns:
            readings, whose ``device`` (N,) holds numbers of the sockets ``names``.

        Raises:
            MeasurementError: as the constructor; a distance that is not positive, between unknown sockets, or without a
                standard deviation.
        """
        angles, joints = checks.joint_table(q, joint_names)
        numbers, names = checks.numbered(sockets, len(angles), "`sockets`")
        zeros = torch.zeros(len(angles), 3, dtype=torch.float64, device=angles.device)
        apart = checked_distances(names, distances, distance_std)
        how: Any = {"joint_names": joints, "distances": apart, "distance_std": distance_std and float(distance_std)}
        return SocketReadings(KIND, angles, zeros, numbers.to(HOST), names, **how).doubted(doubt)

    joined = staticmethod(joined_tables)

    def beside_images(self) -> list[tuple[Any, Tensor]]:
        """See :class:`RowGroups`; poses stay."""
        return super().beside_images() if self.lever is not None else as_readings(self)

    @property
    def covariance(self) -> Tensor | None:
        """The known part of the noise: (N, 3 P, 3 P) in m^2, zero for hidden markers; None if unknown.

        Coordinates of a marker are adjacent. An error dt of a pose's position and a small error w of its orientation
        move the point at arm a by dt + w x a: the covariance of its nine coordinates has rank 6, or 3 if only one of
        these errors is known. A camera on the tool errs about the board, see measurements/poses.py.
        """
        frames, std, turn_std = self.frames, self.std, self.rotation_std
        if frames is None or self.lever is None:
            return None if std is None else torch.diag_embed(std.nan_to_num(0.0).flatten(1).square())
        slopes = pose_math.pose_jacobian(frames, self.lever, self.board)
        if self.pose_covariance is not None:
            return slopes[:, 0] @ self.pose_covariance @ slopes[:, 0].mT
        if std is None and turn_std is None:
            return None
        zero = torch.zeros_like(frames[..., :3, 3])
        spread = torch.cat([zero if part is None else part.view_as(zero) for part in (std, turn_std)], dim=-1)
        factor = (slopes * spread[..., None, :]).nan_to_num(0.0)  # hidden frames
        return pose_math.block_diagonal(factor @ factor.mT)

    @property
    def frames(self) -> Tensor | None:
        """(N, T, 4, 4) the measured poses, T = 1 included, m; NaN where hidden; None for points."""
        return None if self.poses is None else pose_math.by_frame(self.poses)

    @property
    def visible(self) -> Tensor:
        """(N, P) boolean: which markers were seen in which rows."""
        return checks.seen_markers(self.points)

    @property
    def bodies(self) -> Bodies:
        """Bodies in the rows: markers, or frames."""
        return Bodies(self.lever)

    @property
    def origins(self) -> Tensor:
        """(N, B, 3) the measured markers, or the origins of the measured frames, m; NaN where hidden."""
        return self.points if self.frames is None else self.frames[..., :3, 3]

    @property
    def seen_bodies(self) -> Tensor:
        """(N, P) or (N, T) boolean: which markers, or measured frames, were seen."""
        return self.visible[:, :: self.bodies.points]

    @property
    def body_names(self) -> list[str]:
        """Names of markers or frames in messages, such as "marker 0", "the frame on 'hand'"."""
        if self.lever is None:
            return [f"marker {name}" for name in self.marker_names or range(self.markers)]
        frames = self.markers // pose_math.POINTS
        tips = pose_math.frame_tips(self.on, frames)
        return ["the frame"] if frames == 1 else [f"the frame on '{tip}'" for tip in tips]

    @property
    def kind(self) -> str:
        """Kind of the rows: "position" or "pose"."""
        return "position" if self.poses is None else "pose"

    def __repr__(self) -> str:
        counts = (len(self), "row"), (self.n, "joint"), (self.markers, "marker")
        parts = [f"{count} {thing}" + "s" * (count != 1) for count, thing in counts]
        hidden = int((~self.seen_bodies).sum())
        if self.frames is not None:
            parts[2] = pose_math.kind_of_points(self.markers, self.lever)
        parts += [f"{hidden} of {self.seen_bodies.numel()} sightings hidden"] * bool(hidden)
        return f"Measurements({', '.join(parts)})"

    @property
    def prefixes(self) -> list[str]:
        """Beginnings of the columns of each marker or frame: none for a single one, else NAME_, TIP_."""
        if self.frames is not None:
            frames = self.frames.shape[1]
            return [""] if frames == 1 else [f"{tip}_" for tip in pose_math.frame_tips(self.on, frames)]
        plain = [""] if self.markers == 1 else [f"marker{k + 1}_" for k in range(self.markers)]
        return plain if self.marker_names is None else [f"{name}_" for name in self.marker_names]

    def measured(self) -> dict[str, Any]:
        """Positions and rotation vectors rx, ry, rz, known standard deviations as std_x, ..., and sessions.

        Poses seen by a camera on the tool are those of the camera in the board's frame, with the deviations along the
        camera's axes.
        """
        columns = dict[str, Any]()
        names, turns = ([f"{prefix}{name}" for prefix in self.prefixes for name in axes] for axes in (XYZ, TURNS))
        columns |= zip(names, self.origins.flatten(1).T, strict=False)
        if self.frames is not None:
            vectors = pose_math.rotation_numbers(self.frames[..., :3, :3], "rotvec")
            columns |= zip(turns, vectors.flatten(1).T, strict=False)
        for std, axes in ((self.std, names), (self.rotation_std, turns)):
            columns |= {} if std is None else zip([f"std_{name}" for name in axes], std.flatten(1).T, strict=False)
        return columns if self.session is None else columns | {"session": self.device_names}

    def with_tips(self, on: Sequence[str] | None) -> Measurements:
        """Return the same measurements with markers or poses on these tips, a name for each, else MeasurementError."""
        points = 1 if self.poses is None else pose_math.POINTS
        return with_attributes(self, on=checks.tip_names(on, self.markers // points, points))

    def with_markers(self, count: int) -> Measurements:
        """The rows with this many markers, the last one a ball that none of them shows if it is one more."""
        if self.markers != count - 1:
            return self

        def padded(values: Tensor) -> Tensor:
            return torch.nn.functional.pad(values, (0, 0, 0, 1), value=torch.nan)

        names, tips = self.marker_names and (*self.marker_names, BALL), self.on and (*self.on, self.on[-1])
        std = None if self.std is None else padded(self.std)
        return with_attributes(self, points=padded(self.points), std=std, marker_names=names, on=tips)

    def explained(self) -> tuple[Tensor, Tensor, str | None]:
        """Rows (M,), columns (M, c) that explain each coordinate of a point of the robot there by a sum, and its tip.

        They do wherever the device stands: the marker that most rows show is an affine function of its positions.
        """
        marker = int(self.visible.sum(0).argmax())
        rows = self.visible[:, marker].nonzero()[:, 0]
        at = self.points[rows, marker]
        return rows, torch.nn.functional.pad(at - at.mean(0), (1, 0), value=1.0), self.on and self.on[marker]

    def with_sessions(self, names: Sequence[str] | None, *, remounted: bool = False) -> Measurements:
        """Return the same measurements in several set-ups of the measuring device, a name for each row (N,).

        A calibration gives each set-up its own measuring frame; its model is in that of the largest.

        Args:
            names: of the set-ups; None for one.
            remounted: whether the device stayed instead, and the markers were mounted anew for each set-up: all have
                one measuring frame, and each its own places of the markers, or of cameras that see one board.

        Raises:
            MeasurementError: not one name per row, poses with markers mounted anew, but for those of a camera on the
                tool; several cameras on the tool, in several set-ups.
        """
        names = self.set_ups(names, remounted=remounted)
        numbers, texts = (None, ()) if names is None else checks.numbered(names, len(self))
        if remounted and self.lever is not None and self.board is None:
            fix = "give their positions alone (leave the rotation out)"
            raise MeasurementError.of("markers that were mounted anew", expected="positions", got="poses", fix=fix)
        return with_attributes(self, session=numbers, session_names=texts, remounted=remounted and numbers is not None)

    def doubted(self, doubt: bool = True) -> Measurements:
        """See :class:`RowGroups`; MeasurementError for a marker, or frame, that no row shows."""
        if doubt:
            self.check_every_marker_seen()
        return super().doubted(doubt)

    def check_every_marker_seen(self) -> None:
        """Raise MeasurementError for a marker, or frame, that no row shows: nothing can be found out about it."""
        never = (~self.seen_bodies).all(0).nonzero()[:, 0].tolist()
        if never:
            what, fix = few([self.body_names[body] for body in never]), "leave it out, or use rows that show it"
            raise MeasurementError.of(f"{what}: hidden in all {len(self)} rows", fix=fix)

    @property
    def present_sessions(self) -> tuple[str, ...]:
        """Names of the sessions that have rows here: a part of a table keeps the names of all."""
        return tuple(name for name in dict.fromkeys(self.device_names) if name)

    def largest_session(self) -> Measurements:
        """The rows of the session with most of them; all rows if there is one."""
        if self.session is None or len(self.present_sessions) < 2:
            return self
        largest = torch.bincount(self.session[self.session >= 0]).argmax()
        return self.rows(self.session == largest).with_sessions(None)

    def shifted(self, shifts: Tensor) -> Measurements:
        """The rows with their first markers moved, (N, P, 3) m, as one session."""
        rest = self.points[:, shifts.shape[1] :]
        points = torch.cat([self.points[:, : shifts.shape[1]] + shifts, rest], 1)
        return with_attributes(self, points=points, **ONE_SESSION)

    def in_frames(self, transforms: Tensor) -> Measurements:
        """The rows moved by rigid transforms (N, 4, 4) from each row's frame to a new one [m], as one session.

        Standard deviations along axes are those along the new axes, as if the errors of the coordinates were
        independent; those of a camera on the tool are along its own axes.
        """
        T = transforms.to(self.points)
        R, shift = T[:, :3, :3], T[:, None, :3, 3]
        changes = ONE_SESSION | {"points": self.points @ R.mT + shift}
        changes |= {} if self.board is not None else self.errors_along(R)
        if self.poses is not None:
            changes["poses"] = (T if self.poses.ndim == 3 else T[:, None]) @ self.poses
        return with_attributes(self, **changes)
