"""Rows that a split keeps together: repeats of a configuration, and rows of one place; exact copies of rows."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number, check_seed
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written
from diffeo_calib.measurements.checks import of_measurements

REPEAT_TOLERANCE = 1e-3
"""Configurations closer than this in every joint [rad or m] are repeats of one another."""
FEWEST_PER_DEVICE = 8
"""Rows of a device that reports readings, with which it can be placed."""
CONFIGURATIONS, PLACES = "distinct configurations", "places with sockets"
"""Words for what a split keeps together."""


def repeat_groups(q: Tensor, tolerance: float) -> Tensor:
    """Labels (N,) of repeated configurations (N, n), see :meth:`RowGroups.groups`."""
    from scipy.spatial import KDTree  # noqa: PLC0415  # slow to import, not needed to use a model

    check_number(tolerance, "`tolerance`", above=-1e-300)
    tree = KDTree(q.cpu().numpy())
    labels = np.full(len(q), -1)
    count = 0
    for row in range(len(q)):
        if labels[row] < 0:
            near = np.asarray(tree.query_ball_point(tree.data[row], tolerance, p=math.inf))
            labels[near[labels[near] < 0]] = count
            count += 1
    return torch.as_tensor(labels, dtype=torch.int64, device=HOST)


def exact_copies(table: Tensor) -> list[tuple[int, int]]:
    """(earlier row, row) for every row of a table (N, c) that repeats an earlier one exactly, NaN for NaN."""
    values = np.where(np.isnan(rows := table.cpu().numpy()), np.nan, rows) + 0.0  # one kind of NaN; -0.0 becomes 0.0
    first: dict[bytes, int] = {}
    pairs = ((first.setdefault(row.tobytes(), number), number) for number, row in enumerate(values))
    return [(earlier, number) for earlier, number in pairs if earlier != number]


def connected(first: Tensor, second: Tensor) -> Tensor:
    """(N,) labels of rows that share a label in one of two groupings (N,), or are linked by such rows."""
    from scipy.sparse import coo_matrix  # noqa: PLC0415  # slow to import, not needed to use a model
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    one, other = (labels.unique(return_inverse=True)[1].numpy() for labels in (first, second))
    count = int(one.max()) + 1
    size = count + int(other.max()) + 1
    links = coo_matrix((np.ones(len(one)), (one, count + other)), shape=(size, size))
    labels = connected_components(links)[1][one]
    return torch.as_tensor(labels, dtype=torch.int64, device=HOST).unique(return_inverse=True)[1]


def in_train(labels: Tensor, fraction: float, seed: int, kind: str = CONFIGURATIONS) -> np.ndarray:
    """Choose whole groups at random for training: labels (N,) -> boolean (N,).

    Each group, in random order, goes to training if that brings the number of rows nearer to ``round(fraction * N)``.

    Raises:
        MeasurementError: fraction outside (0, 1), or a single group, so that one part would be empty.
    """
    if not isinstance(fraction, (int, float)) or not 0.0 < fraction < 1.0:
        fix = "pass the share of rows to train on, such as 0.7"
        raise MeasurementError.of("`fraction`", expected="a number between 0 and 1", got=as_written(fraction), fix=fix)
    sizes, order = _shuffled(labels, seed, kind, fewest=2, what="cannot split into train and test")
    target, rows, chosen = round(fraction * len(labels)), 0, []
    for group in order:
        after = rows + sizes[group]
        nearer = abs(after - target) < abs(rows - target)
        if after < len(labels) and (nearer or not chosen):  # neither part may end up empty
            rows, chosen = after, [*chosen, group]
    return np.isin(labels.numpy(), chosen)


def fold_numbers(labels: Tensor, k: int, seed: int, kind: str = CONFIGURATIONS) -> np.ndarray:
    """Distribute whole groups over ``k`` folds of about equal size: labels (N,) -> fold of every row (N,).

    Raises:
        MeasurementError: k below 2, or fewer groups than folds.
    """
    if not isinstance(k, (int, np.integer)) or isinstance(k, bool) or k < 2:
        raise MeasurementError.of("`k`", expected="at least 2 folds", got=as_written(k), fix="pass 5 or 10")
    sizes, order = _shuffled(labels, seed, kind, fewest=k, what=f"cannot make {k} folds")
    largest_first = order[np.argsort(-sizes[order], kind="stable")]
    load, fold_of = np.zeros(k, dtype=np.int64), np.zeros(len(sizes), dtype=np.int64)
    for group in largest_first:
        fold_of[group] = load.argmin()
        load[fold_of[group]] += sizes[group]
    return fold_of[labels.numpy()]


def _shuffled(labels: Tensor, seed: int, kind: str, fewest: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Sizes (G,) of the groups, and their numbers (G,) in random order."""
    with of_measurements():
        checked_seed = check_seed(seed)
    sizes = np.bincount(labels.numpy())
    if len(sizes) < fewest:
        together = "the rows of a place" if kind == PLACES else f"rows within {REPEAT_TOLERANCE} rad or m"
        got = f"{len(sizes)} (in {len(labels)} rows; {together} stay together)"
        fix = f"measure more {kind.split()[-1 if kind == CONFIGURATIONS else 0]}, or ask for fewer parts"
        raise MeasurementError.of(what, expected=f"at least {fewest} {kind}", got=got, fix=fix)
    return sizes, np.random.default_rng(checked_seed).permutation(len(sizes))
