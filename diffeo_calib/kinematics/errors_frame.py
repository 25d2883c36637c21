"""Errors of every row as a data frame."""

from __future__ import annotations

from typing import Any

import torch

from diffeo_calib.common.data_frames import data_frame
from diffeo_calib.common.device import HOST


def errors_frame(errors: Any) -> Any:
    """The errors of every row and marker as a pandas.DataFrame.

    Columns: row (the line number), marker, x, y, z (measured minus predicted; x alone of distances and heights, x
    and y of images) and error in the unit of the evaluation, and angle in rad for poses.

    Raises:
        ImportError: pandas is not installed.
    """
    N, P = errors.errors.shape
    rows = torch.arange(N, device=HOST) if errors.line_numbers is None else errors.line_numbers
    columns = {"row": rows.repeat_interleave(P), "marker": torch.arange(P, device=HOST).repeat(N)}
    if errors.away is not None:
        columns |= dict(zip("xyz", errors.away.flatten(0, 1).T, strict=False))
    columns["error"] = errors.errors.flatten()
    return data_frame(columns if errors.angles is None else columns | {"angle": errors.angles})
