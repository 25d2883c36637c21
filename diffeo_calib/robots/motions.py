"""Motions of joints as one formula, and the product of transforms along a tree.

Every motion is ``J_l(q) = C + S sin q + D cos q + L q`` with constant 4 x 4 matrices (Rodrigues for a rotation, ``L``
for a slide), so that neither values nor types of joints are branched on: autograd, ``torch.func`` and ``vmap`` all pass
through.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffeo_calib.robots.se3 import skew


def walk(start: Tensor, offsets: Tensor, motions: Tensor, parents: Sequence[int]) -> Tensor:
    """Multiply a tree out: ``frame_l = frame_parent(l) J_parent(l) O_l``, from ``start`` where there is no parent.

    Args:
        start: (4, 4) pose of the base; (N, 4, 4) if it differs between rows.
        offsets: (F, 4, 4) constant transforms O_l; (F, N, 4, 4) if they differ between rows.
        motions: (N, n_all, 4, 4) joint motions J_l; the first n_all of the F frames are those of the joints.
        parents: F numbers of the joints before the frames, -1 for the base; a joint follows its parent.

    Returns:
        Frames (N, F, 4, 4); those of joints are before the joint's motion.
    """
    base = start.expand(motions.shape[0], 4, 4)
    steps, moved, frames = motions.unbind(1), {-1: base}, []
    for number, (offset, parent) in enumerate(zip(offsets.unbind(0), parents, strict=True)):
        frames.append(moved[parent] @ offset)
        if number < len(steps):
            moved[number] = frames[-1] @ steps[number]
    return torch.stack(frames, dim=1)


def joint_motions(terms: Tensor, q: Tensor) -> Tensor:
    """Joint motions ``C + S sin q + D cos q + L q``: terms (4, n, 4, 4), q (N, n) -> (N, n, 4, 4)."""
    constant, sine, cosine, slope = terms
    x = q[..., None, None]
    return constant + torch.sin(x) * sine + torch.cos(x) * cosine + x * slope


def turned_axes(frames: Tensor, axes: Tensor) -> Tensor:
    """Joint axes in the base: frames (N, n, 4, 4), axes (n, 3) -> (N, n, 3)."""
    return (frames[..., :3, :3] @ axes.to(frames.device)[..., None]).squeeze(-1)


def motion_terms(axes: Tensor, revolute: Tensor) -> Tensor:
    """Constants (4, n, 4, 4) of :func:`joint_motions`: Rodrigues ``1 + K^2 + K sin q - K^2 cos q``, or a slide."""
    turning = revolute[:, None, None]
    K = skew(axes) * turning
    terms = torch.zeros(4, len(axes), 4, 4, dtype=torch.float64, device="cpu")
    terms[0] = torch.eye(4, dtype=torch.float64, device="cpu")
    terms[0, :, :3, :3] += K @ K
    terms[1, :, :3, :3] = K
    terms[2, :, :3, :3] = -(K @ K)
    terms[3, :, :3, 3] = axes * ~revolute[:, None]
    return terms
