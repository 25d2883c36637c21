"""The same measurements in another measuring frame."""

from __future__ import annotations

from torch import Tensor

from diffeo_calib.measurements.frozen import with_attributes
from diffeo_calib.measurements.table import Measurements


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
    if data.std is not None and data.board is None:
        changes["std"] = (data.std.square() @ R.square().mT).sqrt()
    if data.rotation_std is not None and data.board is None:
        variances = data.rotation_std.view(len(data), -1, 3).square()
        changes["rotation_std"] = (variances @ R.square().mT).sqrt().view_as(data.rotation_std)
    return with_attributes(data, **changes)
