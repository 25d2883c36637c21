"""Lenses and board of images: errors that all of them share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.hypotheses import BASE, MARKERS
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.placing.placement import (
    DeviceSet,
    Elsewhere,
    OtherRows,
    Placement,
    Seen,
    Sessions,
    Settled,
)
from diffeo_calib.cameras.board import LENS, BoardPrior
from diffeo_calib.cameras.images import expected, sees
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.measurements.images import SharedErrors
from diffeo_calib.measurements.poses import inverse_poses, pose_jacobian, poses_from_marks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.board_camera import BoardCamera, BoardCameras, Explained
from diffeo_calib.sensors.devices import OUTLIER_MEDIANS, ROW, Hypothesis, median_weights
from diffeo_calib.sensors.set_ups import TRANSFORMS

EXACT_SIZE = 1e-4
"""Standard deviation of the size of a board that was made or measured with care, a share."""
SIZE_WARNED = 0.006
"""Shares by which lengths of a board may differ from the robot's. Simulated arms with errors of a mm: below 0.004."""
FOCUS = "lock focus and zoom of the camera; until then this counts as noise of the images"
ON_TOOL = {MARKERS: "the camera on the tool", BASE: "the board, or the robot's base"}
FIXED = {MARKERS: "the board on the tool", BASE: "the camera, or the robot's base"}
"""What is on the tool and what stands."""
ROUNDS = 5
PARTS = slice(0, len(LENS)), slice(len(LENS), None)  # lens and board among the unknowns of a camera


@dataclass(frozen=True, eq=False)
class CameraErrors(DeviceSet):
    """Errors of lenses, and of the board that all of the cameras saw."""

    devices: BoardCameras
    # the cameras as images alone show them, and what their c errors do to the points of the M poses, m
    shared: SharedErrors

    @classmethod
    def around(cls, data: Measurements, rows: Tensor) -> list[Any]:
        """Cameras of the images of a table beside a model, none for other tables; arguments as of :meth:`of_table`."""
        return [cls(BoardCameras.of_rows(rows, shared.seen_by), shared) for shared in data.shared_errors()]

    def effects(self, data: Seen) -> Tensor:
        effects = data.y.new_zeros(*data.y.shape, self.shared.slopes.shape[2])
        effects[self.rows, : self.shared.slopes.shape[1]] = self.shared.slopes
        return effects

    def with_rows(self, other: OtherRows) -> Any:
        if other.aligned is None:
            raise MeasurementError.of("rows of a camera", expected="images", got="none")
        (shared,) = other.aligned.table.shared_errors()
        return replace(self, shared=shared).measuring(other.aligned.rows, shared.seen_by)


@dataclass(frozen=True, eq=False)
class BoardSize(DeviceSet):
    """The size of a board whose poses a camera on the tool measured: it is as large as the detector was told.

    Args:
        devices: without names, a model keeps what rows share. larger: (M, 9, 1) effects of one standard deviation, m.
        found: what a fit says of it, in standard deviations of its prior, and how well. std: of its prior, a share.
    """

    devices: BoardCameras
    larger: Tensor
    found: tuple[float, float] = (0.0, 1.0)
    std: float = BoardPrior().scale

    @classmethod
    def of_table(cls, data: Any, rows: Tensor) -> list[Any]:
        """Of a table of such poses, none for others; ``rows`` (M,) are its numbers in the whole table."""
        origin, images = data.board, data.cameras
        if origin is None or images:
            return []
        shift = torch.cat([origin, torch.zeros_like(origin)], 1)[..., None]
        larger = BoardPrior().scale * pose_jacobian(data.frames, data.lever, origin)[:, 0] @ shift
        return [cls(BoardCameras.of_rows(rows, torch.zeros_like(rows)), larger)]

    def effects(self, data: Seen) -> Tensor:
        effects = data.y.new_zeros(*data.y.shape, 1)
        effects[self.rows, : self.larger.shape[1]] = self.larger
        return effects

    def with_rows(self, other: OtherRows) -> Any:
        (again,) = [] if other.aligned is None else self.of_table(other.aligned.table, other.aligned.rows)
        return replace(again.of_std(self.std), found=self.found)

    def of_std(self, std: float) -> BoardSize:
        """With another prior."""
        return replace(self, larger=self.larger * (std / self.std), std=std)

    def settled(self, fit: Settled) -> BoardSize:
        return replace(self, found=(float(fit.shifts[0]), float(fit.covariance[0, 0]) ** 0.5))

    def sentences(self) -> list[str]:
        size, std = (1e6 * self.std * value for value in self.found)
        return [f"board: scale {size:+.0f} +- {std:.0f} ppm against the size that its detector was told"]


@dataclass(frozen=True, eq=False)
class LensAndBoard(CameraErrors):
    """Lenses and board of a calibration.

    Args:
        devices: the cameras, with what each explains at the tool by its rows: before a fit nothing.
        lever: of the poses, m.
        apart: (M, 9, c) the same effects apart from the places of the robot and of what is on the tool.
        larger: how much longer lengths in the images are than those of the robot, as a share.
    """

    size_advice = "measure the printed squares with a caliper and give `images --board-std`"
    lever: float
    apart: Tensor
    larger: float

    @classmethod
    def of_table(
        cls, data: Measurements, rows: Tensor, registration: Identification, sessions: Sequence[Sessions] = ()
    ) -> list[Any]:
        """Cameras of the images of a table, none for other tables.

        Warns:
            DiffeoCalibWarning: a board of another size than was said.
        """
        sets: list[Any] = []
        for shared in data.shared_errors():
            away = (data.points - registration.geometry.points(data.q)).norm(dim=2)
            cameras, on_tool = dict[str, BoardCamera](), data.board is not None
            for number, (name, camera) in enumerate(shared.cameras.items()):
                nominal = _rms(away[shared.seen_by == number])
                cameras[name] = BoardCamera(camera, on_tool, Explained(nominal, *[0.0] * 4, _corners(shared, number)))
            places = _places(data, rows, registration, sessions)
            larger, free = _relative_size(data, registration, places), places.flatten(0, 1)
            effects = shared.slopes.flatten(0, 1)
            apart = effects - free @ torch.linalg.lstsq(free, effects, driver="gelsd").solution
            devices = BoardCameras.of_rows(rows, shared.seen_by).with_cameras(cameras)
            sets.append(cls(devices, shared, data.bodies.pose_lever(), apart.view_as(shared.slopes), larger))
            if abs(larger) >= SIZE_WARNED:
                got = f"lengths in the images {100 * abs(larger):.1f} % {'larger' if larger > 0 else 'smaller'}"
                fix = (
                    "measure the printed squares with a caliper (printers scale to fit the page), and check their unit"
                )
                warn_user(sentence("the size of the board does not fit that of the robot", got=got, fix=fix))
        return sets

    def settled(self, fit: Settled) -> LensAndBoard:
        spread, cameras = torch.linalg.cholesky(fit.covariance), dict[str, BoardCamera]()
        for number, (name, device) in enumerate(self.devices.cameras.items()):
            camera = self.shared.cameras[name]
            change, root = camera.root @ fit.shifts[:, None], camera.root @ spread
            effects = self.apart[self.shared.seen_by == number] @ torch.linalg.pinv(camera.root)
            lens, board, lens_std, board_std = (
                _rms((effects[..., part] @ errors[part]).unflatten(1, (-1, 3)).square().sum((2, 3)).sqrt())
                for errors in (change, root)
                for part in PARTS
            )
            camera = replace(camera, unknowns=camera.unknowns + change[:, 0], root=root)
            explained = Explained(device.explained.nominal, lens, board, lens_std, board_std, device.explained.corners)
            cameras[name] = BoardCamera(camera, device.on_tool, explained)
        shared = self.shared._replace(cameras={name: device.camera for name, device in cameras.items()})
        return replace(self, shared=shared, devices=self.devices.with_cameras(cameras))

    def hypotheses(self, data: Seen) -> Iterator[Hypothesis]:
        effects = data.points.new_zeros(*data.points.shape, 1)
        for number, camera in enumerate(self.shared.cameras.values()):
            mask = self.shared.seen_by == number
            effects[self.rows[mask], : self.shared.slopes.shape[1]] = self.shared.slopes[mask] @ camera.longer[:, None]
        effects = data.slopes @ effects
        yield Hypothesis("the focal length of the images", effects, ("%", 1e-2), FOCUS, about=ROW)

    @property
    def bodies(self) -> Mapping[str, str]:
        return ON_TOOL if self.on_tool else FIXED

    @property
    def on_tool(self) -> bool:
        """Whether the camera is on the tool, else the board."""
        return next(iter(self.devices.cameras.values())).on_tool

    def widened(self, table: Measurements) -> LensAndBoard:
        """Take the noise of the images from a table."""
        (shared,) = table.shared_errors()
        cameras = {
            name: replace(device, explained=replace(device.explained, corners=_corners(shared, number)))
            for number, (name, device) in enumerate(self.devices.cameras.items())
        }
        return replace(self, shared=shared, devices=self.devices.with_cameras(cameras))

    def elsewhere(self, row: int, points: Tensor, devices: Placement) -> Elsewhere:
        """With the errors of images there; where the board is not seen, as at another place."""
        number = self.shared.seen_by[self.rows == row].tolist()
        if not number:
            return super().elsewhere(row, points, devices)
        name, camera = [*self.shared.cameras.items()][number[0]]
        poses = poses_from_marks(points, self.lever)
        for set_ups in (part.devices for part in devices if part.devices.kind in TRANSFORMS):
            last = [k for k, set_up in enumerate(set_ups.names) if set_up.partition("/")[0] == name][-1:]
            poses = set_ups.view(last[0], poses) if last else poses
        boards = inverse_poses(poses) if self.on_tool else poses
        there = sees(camera, boards)

        def images(copies: Any) -> Any:
            if camera.view is None or not bool(there.any()):
                return copies
            shown = torch.where(there[:, None, None], boards, boards[there][0])
            covariance, effects = expected(camera, shown)
            return copies.with_board_at(copies.q, shown, (covariance, effects @ camera.root))

        return Elsewhere(there, points.new_zeros(0, 3), images)

    def sentences(self) -> list[str]:
        lines = super().sentences()
        if abs(self.larger) >= SIZE_WARNED:
            lines.append(
                f"not decided: lengths that differ by {100 * abs(self.larger):.1f} % are counted with the arm, but the "
                "board's size explains them as well, until its squares are measured"
            )
        return lines

    def entry(self) -> dict[str, object]:
        entries = {
            name: device.camera.entry() | {"explained_m": vars(device.explained) | {"arm": device.explained.arm}}
            for name, device in self.devices.cameras.items()
        }
        return {"cameras": entries} if len(entries) > 1 else {"camera": next(iter(entries.values()))}


def _corners(shared: SharedErrors, number: int) -> float:
    """RMS distance at the tool by the noise of one image of a camera, m."""
    variances = shared.noise[shared.seen_by == number].diagonal(dim1=1, dim2=2)
    return _rms(variances.unflatten(1, (-1, 3)).sum(2).sqrt())


def _rms(distances: Tensor) -> float:
    return float(distances.square().mean().sqrt())


def _relative_size(data: Measurements, registration: Identification, places: Tensor) -> float:
    """How much longer the distances of a board are than those of a robot as described, by robust least squares."""
    geometry, slopes = registration.geometry, torch.cat([places, data.by_board_size()], 2)
    errors, weights = (data.points - geometry.points(data.q)).flatten(1), torch.ones_like(slopes[:, :1, :1])
    shifts = slopes.new_zeros(slopes.shape[2])
    for _ in range(ROUNDS):
        matrix, target = (weights * slopes).flatten(0, 1), (weights[..., 0] * errors).flatten()
        shifts = torch.linalg.lstsq(matrix, target[:, None], driver="gelsd").solution[:, 0]
        weights = median_weights((errors - slopes @ shifts).norm(dim=1), OUTLIER_MEDIANS).sqrt()[:, None, None]
    return float(shifts[-1])


def _places(data: Measurements, rows: Tensor, registration: Identification, sessions: Sequence[Sessions]) -> Tensor:
    """Derivatives (M, 3 P, c) of points by the places of base, what is on the tool, and each session but the first."""
    geometry = registration.geometry
    slopes = geometry.sensitivities(data.q).flatten(1, 2)
    base, tool = (slopes[..., geometry.slices[name]] for name in ("base", "tool"))
    whole = torch.eye(slopes.shape[1], dtype=slopes.dtype, device=slopes.device).expand(len(slopes), -1, -1)
    at = data.points, tool, data.points.mean((0, 1))
    steps = [part.increments(*at, part.by_row(int(rows.max()) + 1)[rows], whole) for part in sessions]
    return torch.cat([base, tool, *steps], 2)
