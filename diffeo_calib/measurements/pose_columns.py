"""Measured poses as the columns of a table: frames, their points, and known standard deviations."""

from __future__ import annotations

from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.pose_frames import checked_frames, of_frames, points_of_frames
from diffeo_calib.measurements.table_checks import check_rows, deviations
from diffeo_calib.measurements.tool_camera import inverse_poses
from diffeo_calib.measurements.visibility import marker_deviations


def pose_columns(
    q: Tensor, poses: object, lever: float, position_std: object, rotation_std: object, *, camera_on_tool: bool
) -> dict[str, Tensor | None]:
    """The columns "poses", "points", "board" and known deviations of measurements.

    Arguments are those of :meth:`Measurements.from_poses`.

    Raises:
        MeasurementError: as there.
    """
    try:
        frames, board = checked_frames(poses).to(q.device), None
        if camera_on_tool:
            frames, board = _camera_in_board(frames)
        points = points_of_frames(frames, lever)
    except InputError as error:
        raise MeasurementError(str(error)) from None
    check_rows(q, frames, "poses")
    known = {"position_std": position_std, "rotation_std": rotation_std}
    std, turns = (_deviations(value, name, frames[..., :3, 3]) for name, value in known.items())
    single = turns is not None and frames.shape[1] == 1
    rotations = turns[:, 0] if single and turns is not None else turns
    known = {"std": std, "rotation_std": rotations, "board": board}
    return {"poses": of_frames(frames), "points": points} | known


def _camera_in_board(frames: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse poses of one frame (N, 1, 4, 4), and the place (N, 3) of the board in the camera's frame, m."""
    if frames.shape[1] > 1:
        fix = "calibrate each arm with its own camera, or give the poses of the cameras in the board's frame"
        raise InputError.of("poses of a camera on the tool", expected="one tip", got=frames.shape[1], fix=fix)
    return inverse_poses(frames), frames[:, 0, :3, 3]


def _deviations(value: object, name: str, places: Tensor) -> Tensor | None:
    """Standard deviations (N, T, 3) of values as they are given for frames at (N, T, 3)."""
    if places.shape[1] > 1:
        return marker_deviations(value, places, name)
    found = deviations(value, name, places[:, 0])
    return None if found is None else found[:, None]
