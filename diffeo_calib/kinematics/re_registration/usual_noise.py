"""Noise of new rows as the rows of a fit lead to expect it."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.re_registration.registered_map import turned
from diffeo_calib.maps.noise import Noise
from diffeo_calib.measurements.pose_frames import block_diagonal, own_blocks
from diffeo_calib.measurements.table import Measurements


def noise_of_rows(fitted: FittedMap, new: Measurements, T: Tensor, block: Tensor, factor: float | None) -> Tensor:
    """(M, m, m) noise of new rows in the model's frame, m^2: a block, of poses by row; their own where it is larger.

    Poses err by shifts and turns, which displace their points as these stand: their deviations are those of usual rows,
    each row has modes of its own. A camera's distance from its board makes errors of turns large or small.

    Args:
        fitted: a fit. new: the rows. T: (4, 4) from the frame of the model to theirs, m. block: (m, m) of a row, m^2.
        factor: on the variances of poses of the fit; None where the fit or the rows have other bodies.
    """
    there = new.in_frames(torch.linalg.inv(T).expand(len(new), -1, -1))
    bodies, total = new.bodies, block.expand(len(new), -1, -1)
    known = factor is not None and fitted.slopes is None and bool(fitted.noise.visible.all())
    own, old = bodies.modes(there), bodies.modes_of(there, fitted.measured().unflatten(1, (-1, 3))) if known else None
    if own is not None and old is not None:
        blocks = own_blocks(fitted.noise.covariance, old.shape[1])  # (N, T, 9, 9)
        to_modes = torch.linalg.pinv(old)
        sizes = (to_modes @ blocks @ to_modes.mT).diagonal(dim1=2, dim2=3).median(0).values  # (T, 6)
        eye = torch.eye(old.shape[2], dtype=old.dtype, device=old.device)
        apart = eye - old @ to_modes
        slack = (apart @ blocks).diagonal(dim1=2, dim2=3).sum(2) / (old.shape[2] - old.shape[3])
        each = (own * sizes[:, None]) @ own.mT + slack.median(0).values[:, None, None] * eye
        total = factor * block_diagonal(each)
    return total if new.covariance is None else larger(total, turned(new.covariance, T[:3, :3].mT))


def typical_noise(noise: Noise) -> Tensor:
    """The block (m, m) of median size among the rows that show everything: outliers have larger ones.

    If no row does, the blocks of median size of every marker, as if their errors were independent.
    """
    whole = noise.visible.all(1)
    if bool(whole.any()):
        return _of_median_size(noise.covariance[whole])
    own, seen = own_blocks(noise.covariance, noise.visible.shape[1] // 3), noise.visible[:, ::3]
    return torch.block_diag(*[_of_median_size(own[seen[:, k], k]) for k in range(seen.shape[1])])


def _of_median_size(blocks: Tensor) -> Tensor:
    sizes = blocks.diagonal(dim1=1, dim2=2).sum(1)
    return blocks[int(sizes.argsort()[(len(sizes) - 1) // 2])]


def larger(first: Tensor, second: Tensor) -> Tensor:
    """A covariance (M, m, m) that is nowhere smaller than either of two."""
    values, vectors = torch.linalg.eigh(second - first)
    total = first + (vectors * values.clamp(min=0.0)[:, None]) @ vectors.mT
    return 0.5 * (total + total.mT)
