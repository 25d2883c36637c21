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
        the errors of the coordinates were independent.
    """
    T = transforms.to(data.points)
    R, shift = T[:, :3, :3], T[:, None, :3, 3]
    changes: dict[str, object] = {"points": data.points @ R.mT + shift, "session": None, "session_names": ()}
    if data.poses is not None:
        changes["poses"] = T @ data.poses
    if data.std is not None:
        changes["std"] = (data.std.square() @ R.square().mT).sqrt()
    if data.rotation_std is not None:
        changes["rotation_std"] = (R.square() @ data.rotation_std.square()[..., None]).squeeze(-1).sqrt()
    return with_attributes(data, **changes)
