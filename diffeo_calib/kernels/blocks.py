"""Products of a kernel's values with the matrices around them, for kernels whose values are diagonal matrices."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor


def diagonal_gram(values: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """The matrix of blocks left_i K(x_i, y_j) right_j^T; consecutive points y may act together.

    Args:
        values: (N Q, n, M) the diagonals of K(x_i, y_j), a row for every point y.
        left: (M, k, n). right: (N, l, Q n), Q points per block, the coordinates of one point adjacent.

    Returns:
        (M k, N l), the transpose of a contiguous matrix.
    """
    (M, k, _), (N, r, width) = left.shape, right.shape
    spread = values[..., None] * left.permute(2, 0, 1).contiguous()  # (N Q, n, M, k)
    return (right @ spread.reshape(N, width, M * k)).view(N * r, M * k).T


def component_gram(components: Iterable[tuple[int, Tensor]], left: Tensor, right: Tensor) -> Tensor:
    """The same from components that are added first, so that no term of a sum needs a large matrix: (M k, N l).

    Args:
        components: numbers c of components and their values K(x_i, y_j)_cc, (N Q, M).
        left: (M, k, n). right: (N, l, Q n).
    """
    sums: dict[int, Tensor] = {}
    for component, values in components:
        sums[component] = sums[component] + values if component in sums else values
    (M, k, n), (N, r, _), present = left.shape, right.shape, sorted(sums)
    if not present:
        return left.new_zeros(M * k, N * r)
    effect = right.reshape(N, r, -1, n)[..., present].flatten(2)
    return diagonal_gram(torch.stack([sums[c] for c in present], 1), left[..., present], effect)


def contracted(weights: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """sum_kl weights_(ik)(jl) left_ikc right_jlc, the weights of a kernel's components: (M, n, N)."""
    (M, k, n), (N, r, _) = left.shape, right.shape
    half = (left.mT @ weights.view(M, k, N * r)).view(M, n, N, r)
    return torch.einsum("icjr,jrc->icj", half, right)
