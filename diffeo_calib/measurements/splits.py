"""Repeated configurations, and random splits and folds that keep repeats together."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number, check_seed
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, as_written
from diffeo_calib.common.inference_mode import methods_outside_inference_mode
from diffeo_calib.measurements.sockets import NO_SOCKET

if TYPE_CHECKING:
    from typing_extensions import Self

REPEAT_TOLERANCE = 1e-3
"""Configurations closer than this in every joint [rad or m] are repeats of one another."""
CONFIGURATIONS, PLACES = "distinct configurations", "places with sockets"
"""What stays together in a split."""


def repeat_groups(q: Tensor, tolerance: float) -> Tensor:
    """Label repeated configurations: (N, n) -> (N,) int64 labels 0, 1, ... in the order of first appearance.

    The first row without a group leads a new one, which takes all later rows without a group that are within
    ``tolerance`` of the leader in every joint. Rows along a slow trajectory thus do not chain into a single group.
    """
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
    checked_seed = _seed(seed)
    sizes = np.bincount(labels.numpy())
    if len(sizes) < fewest:
        together = "the rows of a place" if kind == PLACES else f"rows within {REPEAT_TOLERANCE} rad or m"
        got = f"{len(sizes)} (in {len(labels)} rows; {together} stay together)"
        fix = f"measure more {kind.split()[-1 if kind == CONFIGURATIONS else 0]}, or ask for fewer parts"
        raise MeasurementError.of(what, expected=f"at least {fewest} {kind}", got=got, fix=fix)
    return sizes, np.random.default_rng(checked_seed).permutation(len(sizes))


def _seed(seed: object) -> int:
    try:
        return check_seed(seed)
    except InputError as error:
        raise MeasurementError(str(error)) from None


@methods_outside_inference_mode
class RowGroups:
    """Rows that are divided, with repeated configurations kept together, and the sockets of a place."""

    q: Tensor

    def rows(self, index: object) -> Self:
        """Some of the rows."""
        raise NotImplementedError

    def copies(self) -> list[tuple[int, int]]:
        """Return (earlier row, row) for every row that repeats an earlier one exactly: real repeats differ by noise."""
        raise NotImplementedError

    @property
    def places(self) -> Tensor:
        """(N,) int64, number of the place of each row's socket, -1 for other rows."""
        return self.socket_numbers

    @property
    def socket_numbers(self) -> Tensor:
        """(N,) int64, number of each row's socket, -1 for other rows."""
        return torch.full((len(self.q),), NO_SOCKET, dtype=torch.int64, device=HOST)

    @property
    def without_device(self) -> bool:
        """Whether no position was measured."""
        return True

    def groups(self, tolerance: float = REPEAT_TOLERANCE) -> Tensor:
        """Label repeated configurations: rows with the same label are repeats of one another.

        The first row without a group leads a new one, which takes all later rows without a group that are within
        ``tolerance`` of the leader in every joint: rows along a slow trajectory do not chain into a single group.
        Angles are compared without wrapping.

        Args:
            tolerance: largest difference from the leader in any joint, rad or m.

        Returns:
            (N,) int64 labels 0, 1, ... in the order of first appearance.
        """
        return repeat_groups(self.q, tolerance)

    def split(self, fraction: float = 0.7, seed: int = 0) -> tuple[Self, Self]:
        """Split at random into (train, test), keeping repeated configurations together, and the sockets of a place.

        Where some positions were measured, these alone are held out: rows in sockets stay in ``train``. Groups of
        repeats are shuffled; each in turn goes to ``train`` if that brings its size nearer to ``round(fraction * N)``
        rows. Both parts keep the order of the rows.

        Args:
            fraction: wanted share of rows in ``train``, between 0 and 1.
            seed: of the shuffle.

        Raises:
            MeasurementError: fraction outside (0, 1), or one configuration or place, so that a part would be empty.
        """
        held, units = self._divided
        test = np.zeros(len(self.q), dtype=bool)
        test[held] = ~in_train(units, fraction, seed, self._kind)
        return self.rows(~test), self.rows(test)

    def folds(self, k: int = 5, seed: int = 0) -> list[tuple[Self, Self]]:
        """Return ``k`` pairs (train, test) whose test parts cover every row once; repeats stay together.

        Where some positions were measured, they cover these: rows in sockets are in every ``train``.

        Args:
            k: number of folds, at least 2.
            seed: of the shuffle of the groups of repeats.

        Raises:
            MeasurementError: k below 2, or fewer distinct configurations than folds.
        """
        held, units = self._divided
        fold = np.full(len(self.q), -1)
        fold[held] = fold_numbers(units, k, seed, self._kind)
        return [(self.rows(fold != i), self.rows(fold == i)) for i in range(k)]

    @property
    def _divided(self) -> tuple[np.ndarray, Tensor]:
        """The rows (M,) that splits divide, and labels (M,) of those that stay together: repeats, or a place's rows."""
        places = self.places
        others = places == NO_SOCKET
        if bool(others.all()):
            return np.arange(len(self.q)), self.groups()
        if not self.without_device:
            rows = others.nonzero()[:, 0]
            return rows.numpy(), repeat_groups(self.q[rows.to(self.q.device)], REPEAT_TOLERANCE)
        if not bool(others.any()):
            return np.arange(len(self.q)), places.unique(return_inverse=True)[1]
        alone = places.max() + 1 + torch.arange(len(places), device=HOST)
        return np.arange(len(self.q)), connected(torch.where(others, alone, places), self.groups())

    @property
    def _kind(self) -> str:
        """What these labels are of."""
        return PLACES if self.without_device and bool((self.places >= 0).all()) else CONFIGURATIONS
