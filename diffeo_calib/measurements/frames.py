"""The same measurements in another measuring frame."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.measurements.frozen import with_attributes
from diffeo_calib.measurements.table import Measurements


def check_one_set_up(data: Measurements) -> None:
    """Raise MeasurementError for rows of several set-ups, which one place of the model cannot fit."""
    present = [] if data.session is None else [data.session_names[k] for k in data.session.unique().tolist() if k >= 0]
    if len(present) > 1:
        fix = (
            "take those of one, register the model at those of another (`model.registered`), or bring those of "
            "the fit into one frame (`result.aligned(data)`)"
        )
        raise MeasurementError.of("rows to compare a model with", expected="one set-up", got=few(present), fix=fix)


def in_frames(data: Measurements, transforms: Tensor) -> Measurements:
    """Measurements whose rows are moved by rigid transforms.

    Args:
        data: N rows. transforms: (N, 4, 4) from each row's frame to the new one [m].

    Returns:
        The rows in the new frame, as one session. Standard deviations along axes are those along the new axes, as if
        the errors of the coordinates were independent; those of a camera on the tool are along its own axes.
    """
    T = transforms.to(data.points)
    R, shift = T[:, :3, :3], T[:, None, :3, 3]
    changes: dict[str, object] = {"points": data.points @ R.mT + shift, "session": None, "session_names": ()}
    if data.poses is not None:
        changes["poses"] = (T if data.poses.ndim == 3 else T[:, None]) @ data.poses
    if data.pose_covariance is not None and data.pose_shared is not None and data.board is None:
        axes = torch.zeros_like(data.pose_covariance)
        axes[:, :3, :3] = axes[:, 3:, 3:] = R
        changes["pose_covariance"] = axes @ data.pose_covariance @ axes.mT
        changes["pose_shared"] = axes @ data.pose_shared
    if data.std is not None and data.board is None:
        changes["std"] = (data.std.square() @ R.square().mT).sqrt()
    if data.rotation_std is not None and data.board is None:
        variances = data.rotation_std.view(len(data), -1, 3).square()
        changes["rotation_std"] = (variances @ R.square().mT).sqrt().view_as(data.rotation_std)
    return with_attributes(data, **changes)
