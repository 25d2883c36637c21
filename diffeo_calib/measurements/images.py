"""Images of a board as the columns of a table: poses, their errors, and what lenses and board do to all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.images import Camera, Images, Sights, sighted, sighted_by_several
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, listed, sentence, warn_user
from diffeo_calib.measurements import checks
from diffeo_calib.measurements.poses import frames_of_points, of_frames, points_of_frames, pose_jacobian
from diffeo_calib.measurements.rows import RowGroups, with_attributes

if TYPE_CHECKING:
    from typing_extensions import Self

CAMERA_WARNED, CAMERA_REFUSED = 1.05, 5.0
"""Factors between the errors of corners with the given camera and with a free one, from which the images seem to show
another camera. A focal length that is wrong by 1 % makes 1.06 of 60 images with errors of 0.2 px."""
FEWEST_IMAGES = 8  # from which a free lens is well enough known to be compared

Known = tuple[int, int] | Camera
"""Prior knowledge of a camera: width and height of its images, pixels, or lens and board too."""
ONLY_CAMERA = "camera"  # name of a camera that is alone
MOVED = 1e-3  # of a pose from that in its image, m and rad, from which a row is in another frame
OF_POSES = ("pose_covariance", "pose_shared", "pose_larger")

ONE_SESSION: dict[str, object] = {"session": None, "session_names": (), "remounted": False}


class ImageTable(RowGroups):
    """Columns of tables of positions and poses, and of images beside poses."""

    without_device = False
    ball_tip = None

    points: Tensor
    frames: Any
    poses: Tensor | None = None
    lever: float | None = None
    board: Tensor | None = None
    std: Tensor | None = None
    rotation_std: Tensor | None = None
    marker_names: tuple[str, ...] | None = None
    on: tuple[str, ...] | None = None
    session: Tensor | None = None
    session_names: tuple[str, ...] = ()
    remounted: bool = False

    @property
    def markers(self) -> int:
        """Number of markers P; 3 for every pose of a row, because three points represent a pose."""
        return self.points.shape[1]

    BY_IMAGE = ("corners", "seen_by", *OF_POSES)
    corners: Tensor | None = None  # (N, K, 5), see :meth:`from_images`; None without images
    cameras: Mapping[str, Camera] = MappingProxyType({})  # lens and board that they show, by the names of the cameras
    image_names: Mapping[int, str] = MappingProxyType({})  # by the line of the file where the image begins
    seen_by: Tensor | None = None  # (N,) int64, number of the camera of each image
    pose_covariance: Tensor | None = None  # (N, 6, 6) of the errors of the poses
    # (N, 6, c) effects of c errors of unit variance that all images share: of lenses and board
    pose_shared: Tensor | None = None
    # (N, 6, 1) effects of a board that is larger than was said, as a share. All in the axes of :func:`pose_jacobian`
    pose_larger: Tensor | None = None

    @classmethod
    def from_images(
        cls,
        q: object,
        corners: object,
        camera: Known | Mapping[str, Known],
        joint_names: Sequence[str] | None = None,
        *,
        seen_by: Sequence[str] | None = None,
        camera_on_tool: bool = True,
        board: BoardPrior | None = None,
        doubt: bool = True,
    ) -> Self:
        """N joint configurations and images of a printed board, taken by cameras on the tool or by fixed ones.

        Lenses, board and its pose in every image are found together, see :mod:`~diffeo_calib.cameras.images`; what the
        images leave open of lenses and board is estimated with the robot. Each of several fixed cameras is a set-up of
        its own, see :meth:`with_sessions`: the model is in the frame of the one with most images. Several on
        the tool share one frame, and each has its own place there: that of the one with most images is the model's.

        Args:
            q, joint_names, doubt: as in the constructor.
            corners: (N, K, 5) x, y, z of the board's corners in its plane, m, and their pixels u, v (column and row, 0
                in the middle of the first pixel); NaN for corners that an image does not show.
            camera: width and height of its images, pixels, or what is known of its lens and board, such as
                ``measurements.camera`` of an earlier calibration; of several cameras by their names.
            seen_by: name of the camera of each image (N,); None for one. All of them see the same board.
            camera_on_tool: whether the camera is on the tool and the board stands; otherwise the board is on the tool.
            board: prior of a board that is not known yet.

        Raises:
            MeasurementError: as the constructor; too few corners in an image, or corners that are not in a plane;
                a camera of which nothing is said.
        """
        angles, joints = checks.joint_table(q, joint_names)
        numbers, names = (None, ()) if seen_by is None else checks.numbered(seen_by, len(angles))
        priors = _known(names or (ONLY_CAMERA,), camera)
        given = torch.as_tensor(corners, dtype=torch.float64, device=HOST).detach().clone()
        if given.ndim != 3 or given.shape[2] != 5:
            fix = "pass x, y, z of the board's corners and their pixels u, v, NaN for corners that are not shown"
            raise MeasurementError.of("`corners`", expected="shape (N, K, 5)", got=tuple(given.shape), fix=fix)
        checks.check_rows(angles, given, "corners")
        given = given.masked_fill(given.isnan().any(2, keepdim=True), torch.nan)
        whose = torch.zeros(len(angles), dtype=torch.int64, device=HOST) if numbers is None else numbers
        sights = _sights([given[whose == number] for number in range(len(priors))], priors, board)
        order = torch.cat([(whose == number).nonzero()[:, 0] for number in range(len(priors))]).argsort()
        poses, *errors = (
            torch.cat([getattr(sight, name) for sight in sights])[order] for name in ("poses", "covariance", "shared")
        )
        named = {"camera_on_tool": camera_on_tool, "doubt": doubt}
        cameras = dict(zip(priors, (sight.camera for sight in sights), strict=True))
        columns = {"corners": given, "cameras": cameras, "seen_by": whose}
        columns |= errors_of_poses(poses, *errors, camera_on_tool=camera_on_tool)
        data = with_attributes(cls.from_poses(angles, poses, joints, **named), **columns)
        return data.with_sessions(seen_by, remounted=camera_on_tool)

    @property
    def row_names(self) -> list[str]:
        """Lines of the file, and the image of each where a table of corners names it."""
        names = self.image_names if self.file_sha256 else {}  # lines of joined files are told apart no more
        lines = zip(super().row_names, self.line_numbers.tolist(), strict=True)
        return [f"{row} ({names[line]})" if line in names else row for row, line in lines]

    @property
    def camera(self) -> Camera | None:
        """The only camera; None without images, or of several."""
        return next(iter(self.cameras.values())) if len(self.cameras) == 1 else None

    @property
    def camera_names(self) -> list[str]:
        """(N,) name of the camera of each image."""
        return [] if self.seen_by is None else checks.texts_of(self.seen_by, list(self.cameras), len(self))

    def set_ups(self, names: Sequence[str] | None, *, remounted: bool) -> Sequence[str] | None:
        """Names (N,) of set-ups: several fixed cameras, each of which has a frame of its own, come before them.

        MeasurementError for several cameras on the tool in several set-ups, which differ in one more frame.
        """
        if names is None or len(self.cameras) < 2 or len(names) != len(self):
            return names
        if self.board is not None:
            if not remounted or list(names) != self.camera_names:
                fix = "calibrate with the images of each set-up by themselves"
                raise MeasurementError.of("several cameras on the tool", expected="no set-ups", fix=fix)
            return names
        pairs = zip(self.camera_names, names, strict=True)
        return [name if f"{name}/".startswith(f"{camera}/") else f"{camera}/{name}" for camera, name in pairs]

    def shared_errors(self) -> Iterator[SharedErrors]:
        """Errors that images share; none of other rows."""
        shared, covariance, lever = self.pose_shared, self.pose_covariance, self.lever
        if self.seen_by is not None and shared is not None and covariance is not None and lever is not None:
            slopes = pose_jacobian(self.frames, lever, self.board)[:, 0]
            yield SharedErrors(self.cameras, self.seen_by, slopes @ shared, slopes @ covariance @ slopes.mT)

    def by_board_size(self) -> Tensor:
        """Effects (N, 9, 1) on the points of poses of a board that is larger than was said, as a share; m."""
        if self.pose_larger is None or self.lever is None:
            raise AssertionError("a table of images")
        return pose_jacobian(self.frames, self.lever, self.board)[:, 0] @ self.pose_larger

    def with_own_focal_lengths(self, deviation: float) -> Self:
        """The rows as if the focal length of every image had an error of its own, a share, as of an autofocus."""
        if self.pose_covariance is None or self.pose_shared is None or self.seen_by is None:
            raise AssertionError("a table of images")
        effects = torch.zeros_like(self.pose_shared[..., :1])
        for number, camera in enumerate(self.cameras.values()):
            mask = self.seen_by == number
            effects[mask] = self.pose_shared[mask] @ camera.longer[:, None]
        return with_attributes(self, pose_covariance=self.pose_covariance + deviation**2 * effects @ effects.mT)

    def errors_along(self, R: Tensor) -> dict[str, object]:
        """Known errors along axes turned by R (N, 3, 3), as if those of the coordinates were independent."""
        errors: dict[str, object] = {}
        for name in ("std", "rotation_std"):
            spread = getattr(self, name)
            if spread is not None:
                errors[name] = (spread.view(len(self), -1, 3).square() @ R.square().mT).sqrt().view_as(spread)
        if self.pose_covariance is None or self.pose_shared is None or self.pose_larger is None:
            return errors
        axes = torch.zeros_like(self.pose_covariance)
        axes[:, :3, :3] = axes[:, 3:, 3:] = R
        of_poses = axes @ self.pose_covariance @ axes.mT, axes @ self.pose_shared, axes @ self.pose_larger
        return errors | dict(zip(OF_POSES, of_poses, strict=True))

    def with_board_at(self, q: Tensor, poses: Tensor, errors: tuple[Tensor, Tensor]) -> Self:
        """The rows as if at q (N, n) the cameras had seen their board at poses (N, 4, 4), m; corners stay.

        ``errors``: as of :func:`~diffeo_calib.cameras.images.expected`, of lens and board as effects of unit variance.
        """
        on_tool = self.board is not None
        table = self.from_poses(q, poses, self.joint_names, camera_on_tool=on_tool, lever=self.lever, doubt=False)
        columns = {name: getattr(table, name) for name in ("q", "poses", "points", "board")}
        return with_attributes(self, **columns, **errors_of_poses(poses, *errors, camera_on_tool=on_tool))

    def with_earlier(self, cameras: Mapping[str, Camera]) -> Self:
        """The rows with what earlier images of the same cameras showed of lenses and board, unless these differ.

        Rows that were moved into another frame since stay there.
        """
        known = {name: cameras[name] for name in self.cameras if name in cameras}
        if not known or any(name not in known or not own.alike(known[name]) for name, own in self.cameras.items()):
            return self
        how = {"seen_by": self.camera_names, "camera_on_tool": self.board is not None, "doubt": False}
        first, again = (
            self.from_images(self.q, self.corners, each, self.joint_names, **how) for each in (self.cameras, known)
        )
        moved = self.frames[:, 0] @ torch.linalg.inv(first.frames[:, 0])
        still = torch.eye(4, dtype=moved.dtype, device=moved.device)
        again = again.in_frames(torch.where((moved - still).abs().amax((1, 2), keepdim=True) < MOVED, still, moved))
        columns = {name: getattr(again, name) for name in ("poses", "board", "cameras", *OF_POSES)}
        columns |= {"points": points_of_frames(again.frames, self.lever), "file_sha256": self.sha256}
        return with_attributes(self, **columns)

    def seen_with(self, cameras: Mapping[str, Camera]) -> Self:
        """The points by lenses and boards of other cameras, to first order and row by row, unless these differ."""
        if any(name not in cameras or not camera.alike(cameras[name]) for name, camera in self.cameras.items()):
            return self
        for shared in self.shared_errors():
            roots = torch.cat([camera.root for camera in self.cameras.values()])
            away = torch.cat([cameras[name].unknowns - camera.unknowns for name, camera in self.cameras.items()])
            errors = torch.linalg.lstsq(roots, away, driver="gelsd").solution
            points = self.points - (shared.slopes @ errors).view_as(self.points)
            moved = {name: replace(camera, unknowns=cameras[name].unknowns) for name, camera in self.cameras.items()}
            columns = {"points": points, "poses": of_frames(frames_of_points(points, self.lever)), "cameras": moved}
            return with_attributes(self, **columns)
        return self

    def on_frames(self, transforms: Tensor) -> Self:
        """The rows of cameras at (N, 4, 4) [m] in another frame on the tool as if they had been there, as one session.

        The board that a camera saw and the errors of its pose stay where they are.
        """
        if self.board is None:
            raise MeasurementError.of("frames on the tool", expected="poses of a camera on it", got="others")
        M = transforms.to(self.points)
        R, frames = M[:, :3, :3], self.frames @ torch.linalg.inv(M)[:, None]
        changes = ONE_SESSION | {"poses": of_frames(frames), "points": points_of_frames(frames, self.lever)}
        changes["board"] = (R @ self.board[..., None])[..., 0] + M[:, :3, 3]
        return with_attributes(self, **changes, **self.errors_along(R))


class SharedErrors(NamedTuple):
    """What images (N,) of cameras by name share: the number of each image's camera, and errors of the points of poses.

    ``slopes`` (N, 9, c), m, are effects of the cameras' c errors of unit variance, ``noise`` (N, 9, 9), m^2, the own.
    """

    cameras: Mapping[str, Camera]
    seen_by: Tensor
    slopes: Tensor
    noise: Tensor


def _known(names: Sequence[str], camera: Any) -> dict[str, Known]:
    """Prior knowledge of each camera; MeasurementError for one of which nothing is, or one camera for several."""
    fix = "pass a mapping from the name of each camera to what is known of it"
    if isinstance(camera, Mapping):
        missing = [name for name in names if name not in camera]
        if missing:
            got = f"those of {listed(list(camera))}"
            raise MeasurementError.of("`camera`", expected=f"that of {listed(missing)} too", got=got, fix=fix)
        return {name: camera[name] for name in names}
    if len(names) > 1 and isinstance(camera, Camera):
        raise MeasurementError.of("`camera`", expected=f"those of {listed(names)}", got="one camera", fix=fix)
    priors: dict[str, Any] = dict.fromkeys(names, camera)
    return priors


def _sights(corners: Sequence[Tensor], priors: Mapping[str, Known], board: BoardPrior | None) -> Sequence[Sights]:
    """What each camera saw, of its corners (N_i, K, 5); a warning or an error about one that saw it otherwise."""
    images = []
    for (name, prior), rows in zip(priors.items(), corners, strict=True):
        whose, size = f" of camera '{name}'" * (len(priors) > 1), prior
        if isinstance(prior, Camera):
            size = prior.width, prior.height
        shown = Images(rows[..., :3], rows[..., 3:], *size)
        if not bool(shown.seen.any()):
            raise MeasurementError.of(f"`corners`{whose}", expected="some corners", got="NaN alone")
        low, high = (torch.stack(list(shown.pixels[shown.seen].aminmax(dim=0)))).tolist()
        if min(low) < -1.0 or high[0] > shown.width or high[1] > shown.height:
            expected = f"pixels within images of {shown.width} x {shown.height}"
            got = f"({low[0]:.0f}, {low[1]:.0f}) to ({high[0]:.0f}, {high[1]:.0f})"
            fix = "pass the size of these images, or a camera calibrated at that size"
            raise MeasurementError.of(f"the corners{whose}", expected=expected, got=got, fix=fix)
        images.append(shown)
    cameras = [prior if isinstance(prior, Camera) else None for prior in priors.values()]
    sights = sighted_by_several(images, cameras, board)
    for name, camera, sight, shown in zip(priors, cameras, sights, images, strict=True):
        if camera is not None and len(sight.poses) >= FEWEST_IMAGES:
            _check_camera(sight, sighted(shown, None, board), name if len(priors) > 1 else "")
    return sights


def errors_of_poses(poses: Tensor, covariance: Tensor, shared: Tensor, *, camera_on_tool: bool) -> dict[str, Tensor]:
    """The columns ``OF_POSES`` of boards at poses (N, 4, 4), m, in the cameras: see :class:`ImageTable`."""
    sign = -1.0 if camera_on_tool else 1.0  # of inverse poses, see poses.py
    larger = torch.cat([poses[:, :3, 3], torch.zeros_like(poses[:, :3, 3])], 1)[..., None]
    return dict(zip(OF_POSES, (covariance, sign * shared, sign * larger), strict=True))


def _check_camera(sights: Sights, free: Sights, name: str) -> None:
    """Refuse, or warn of, images that the given camera explains worse than a free one."""
    factor = sights.camera.noise / free.camera.noise
    if factor < CAMERA_WARNED:
        return
    camera = f"camera '{name}'" if name else "camera"
    given, fitted = (", ".join(f"{v:.0f}" for v in each.camera.lens[:4].tolist()) for each in (sights, free))
    got = f"{sights.camera.noise:.2f} px with fx, fy, cx, cy = {given}, and {free.camera.noise:.2f} px with {fitted}"
    fix = "leave the camera out, or pass that of these images: same camera, zoom, focus and size"
    if factor > CAMERA_REFUSED:
        what = f"errors of corners with the given {camera}"
        raise MeasurementError.of(what, expected="no larger than with any other", got=got, fix=fix)
    warn_user(sentence(f"the given {camera} does not quite fit these images: errors of corners are {got}", fix=fix))
