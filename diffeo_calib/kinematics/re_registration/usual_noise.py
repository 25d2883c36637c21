"""Noise of new rows as the rows of a fit lead to expect it."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.maps.noise import Noise
from diffeo_calib.measurements.pose_frames import block_diagonal, own_blocks
from diffeo_calib.measurements.table import Measurements


def usual_noise(fitted: FittedMap, new: Measurements) -> Tensor:
    """(M, m, m) noise of new rows in the model's frame, m^2: that of usual rows of the fit."""
    by_row = noise_of_poses(fitted, new)
    if by_row is not None:
        return by_row
    block = typical_noise(fitted.noise) if fitted.slopes is None else fitted.new_noise
    return block.expand(len(new), -1, -1)


def noise_of_poses(fitted: FittedMap, new: Measurements) -> Tensor | None:
    """(M, m, m) noise of new poses in the model's frame, m^2; None where the fit or the rows have other bodies.

    Poses err by shifts and turns, which displace their points as these stand: their deviations are those of usual rows,
    each row has modes of its own. A camera's distance from its board makes errors of turns large or small.
    """
    bodies, whole = new.bodies, fitted.slopes is None and bool(fitted.noise.visible.all())
    own, old = bodies.modes(new), bodies.modes_of(new, fitted.measured().unflatten(1, (-1, 3))) if whole else None
    if own is None or old is None:
        return None
    blocks = own_blocks(fitted.noise.covariance, old.shape[1])  # (N, T, 9, 9)
    to_modes = torch.linalg.pinv(old)
    sizes = (to_modes @ blocks @ to_modes.mT).diagonal(dim1=2, dim2=3).median(0).values  # (T, 6)
    eye = torch.eye(old.shape[2], dtype=old.dtype, device=old.device)
    apart = eye - old @ to_modes
    slack = (apart @ blocks).diagonal(dim1=2, dim2=3).sum(2) / (old.shape[2] - old.shape[3])
    return block_diagonal((own * sizes[:, None]) @ own.mT + slack.median(0).values[:, None, None] * eye)


def typical_noise(noise: Noise) -> Tensor:
    """The block (m, m) of median size among the rows that show everything: outliers have larger ones.

    If no row does, the blocks of median size of every marker, as if their errors were independent.
    """
    whole = noise.visible.all(1)
    if bool(whole.any()):
        return _of_median_size(noise.covariance[whole])
    own = noise.covariance.unflatten(2, (-1, 3)).unflatten(1, (-1, 3)).diagonal(dim1=1, dim2=3).movedim(-1, 0)
    seen = noise.visible[:, ::3].T  # (P, N)
    return torch.block_diag(*[_of_median_size(blocks[rows]) for blocks, rows in zip(own, seen, strict=True)])


def _of_median_size(blocks: Tensor) -> Tensor:
    sizes = blocks.diagonal(dim1=1, dim2=2).sum(1)
    return blocks[int(sizes.argsort()[(len(sizes) - 1) // 2])]


def larger(first: Tensor, second: Tensor) -> Tensor:
    """A covariance (M, m, m) that is nowhere smaller than either of two."""
    values, vectors = torch.linalg.eigh(second - first)
    total = first + (vectors * values.clamp(min=0.0)[:, None]) @ vectors.mT
    return 0.5 * (total + total.mT)
