"""Images of a board as the columns of a table: poses, their errors, and what their lens and board do to all of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.images import Camera, Images, Sights, sighted
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.measurements.checks import check_rows, joint_table
from diffeo_calib.measurements.pose_frames import pose_jacobian
from diffeo_calib.measurements.rows import RowTable, with_attributes

if TYPE_CHECKING:
    from typing_extensions import Self

CAMERA_WARNED, CAMERA_REFUSED = 1.05, 1.25
"""Factors between the errors of corners with the given camera and with a free one, from which the images seem to show
another camera. A focal length that is wrong by 1 % makes 1.06 of 60 images with errors of 0.2 px."""
FEWEST_IMAGES = 8
"""From which a free lens is well enough known to be compared."""


@dataclass(frozen=True)
class KnownCamera:
    """What is known before: the images' width and height, pixels, lens and board of a camera, prior of the board."""

    size: tuple[int, int]
    camera: Camera | None = None
    board: BoardPrior | None = None


IMAGE_COLUMNS = ("corners", "pose_covariance", "pose_shared")
NO_IMAGES = dict.fromkeys((*IMAGE_COLUMNS, "camera"))


class ImageTable(RowTable):
    """What tables of images hold beside poses.

    Attributes:
        corners: (N, K, 5), see :meth:`from_images`; None without images. camera: lens and board that they show.
        pose_covariance: (N, 6, 6) of the errors of the poses. pose_shared: (N, 6, c) effects of c errors of unit
            variance that all images share: of lens and board. Both in the axes of :func:`pose_jacobian`.
    """

    frames: Any
    board: Tensor | None
    lever: Any
    corners: Tensor | None
    camera: Camera | None
    pose_covariance: Tensor | None
    pose_shared: Tensor | None

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
        doubt: bool = True,
    ) -> Self:
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
            doubt: see :meth:`from_poses`.

        Raises:
            MeasurementError: as the constructor; too few corners in an image, or corners that are not in a plane.
        """
        angles, joints = joint_table(q, joint_names)
        seen = image_columns(angles, corners, KnownCamera(size, camera, board), camera_on_tool=camera_on_tool)
        named = {"camera_on_tool": camera_on_tool, "doubt": doubt}
        return with_attributes(cls.from_poses(angles, seen.pop("poses"), joints, **named), **seen)

    @classmethod
    def from_poses(cls, q: Any, poses: Any, joint_names: Sequence[str] | None = None, **known: Any) -> Self:
        """See :meth:`Measurements.from_poses`."""
        raise NotImplementedError

    @property
    def sees_board_from_tool(self) -> bool | None:
        """Whether the camera is on the tool, or stands; None if nothing says that a camera saw a board."""
        return True if self.board is not None else False if self.camera is not None else None

    def shared_errors(self) -> Iterator[tuple[Camera, Tensor, Tensor]]:
        """For images: the camera; effects (N, 9, c) of its errors of unit variance on the points of poses, m; and the
        covariance (N, 9, 9) of the points by the noise of each image, m^2."""
        if self.camera is not None and self.pose_shared is not None and self.pose_covariance is not None:
            slopes = self._pose_slopes()
            yield self.camera, slopes @ self.pose_shared, slopes @ self.pose_covariance @ slopes.mT

    def by_board_size(self) -> Tensor:
        """Effects (N, 9, 1) on the points of poses of a board that is larger than was said, as a share; m."""
        away = self.frames[:, 0, :3, 3] if self.board is None else -self.board
        return self._pose_slopes()[..., :3] @ away[..., None]

    def errors_along(self, R: Tensor) -> dict[str, object]:
        """Errors of poses along axes turned by R (N, 3, 3)."""
        if self.pose_covariance is None or self.pose_shared is None:
            return {}
        axes = torch.zeros_like(self.pose_covariance)
        axes[:, :3, :3] = axes[:, 3:, 3:] = R
        return {"pose_covariance": axes @ self.pose_covariance @ axes.mT, "pose_shared": axes @ self.pose_shared}

    def _pose_slopes(self) -> Tensor:
        return pose_jacobian(self.frames, self.lever, self.board)[:, 0]


def image_columns(q: Tensor, corners: object, known: KnownCamera, *, camera_on_tool: bool) -> dict[str, Any]:
    """The columns of :meth:`Measurements.from_images`, poses among them; arguments and errors as there."""
    given = torch.as_tensor(corners, dtype=torch.float64, device=HOST).detach().clone()
    if given.ndim != 3 or given.shape[2] != 5:
        fix = "pass x, y, z of the board's corners and their pixels u, v, NaN for corners that an image does not show"
        raise MeasurementError.of("`corners`", expected="shape (N, K, 5)", got=tuple(given.shape), fix=fix)
    check_rows(q, given, "corners")
    given = given.masked_fill(given.isnan().any(2, keepdim=True), torch.nan)
    images = Images(given[..., :3], given[..., 3:], *known.size)
    _check_size(images, known.camera)
    found = sighted(images, known.camera, known.board)
    if known.camera is not None and len(q) >= FEWEST_IMAGES:
        _check_camera(found, sighted(images, None, known.board))
    shared = -found.shared if camera_on_tool else found.shared  # of inverse poses, see pose_frames.py
    errors = {"pose_covariance": found.covariance, "pose_shared": shared}
    return {"poses": found.poses, "corners": given, "camera": found.camera} | errors


def _check_size(images: Images, camera: Camera | None) -> None:
    """Raise MeasurementError for corners outside of the images, or a camera of another size."""
    size = images.width, images.height
    fix = "pass the size of the images in which the corners were found, and a camera calibrated at that size"
    if camera is not None and (camera.width, camera.height) != size:
        expected, got = f"images of {camera.width} x {camera.height} pixels as of the camera", f"{size[0]} x {size[1]}"
        raise MeasurementError.of("the size of the images", expected=expected, got=got, fix=fix)
    if not bool(images.seen.any()):
        raise MeasurementError.of("`corners`", expected="some corners", got="NaN alone")
    low, high = (torch.stack(list(images.pixels[images.seen].aminmax(dim=0)))).tolist()
    if min(low) < -1.0 or high[0] > size[0] or high[1] > size[1]:
        got = f"from ({low[0]:.0f}, {low[1]:.0f}) to ({high[0]:.0f}, {high[1]:.0f})"
        expected = f"pixels within images of {size[0]} x {size[1]}"
        raise MeasurementError.of("the corners", expected=expected, got=got, fix=fix)


def _check_camera(found: Sights, free: Sights) -> None:
    """Refuse, or warn of, images that the given camera explains worse than a free one."""
    factor = found.camera.noise / free.camera.noise
    if factor < CAMERA_WARNED:
        return
    given, own = (", ".join(f"{v:.0f}" for v in one.camera.lens[:4].tolist()) for one in (found, free))
    got = f"{found.camera.noise:.2f} px with fx, fy, cx, cy = {given}, and {free.camera.noise:.2f} px with {own}"
    fix = "leave the camera out, or pass that of these images: same camera, zoom, focus and size"
    if factor > CAMERA_REFUSED:
        what = "errors of corners with the given camera"
        raise MeasurementError.of(what, expected="no larger than with any other", got=got, fix=fix)
    warn_user(sentence(f"the given camera does not quite fit these images: errors of corners are {got}", fix=fix))
