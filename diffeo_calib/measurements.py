"""Measured pairs (joint configuration, marker positions): the table, its subsets, splits and folds.

Everything is SI and float64: radians for revolute joints, metres for prismatic joints and for points.
Files in other units are read and written by :mod:`diffeo_calib.tables`. Nothing here knows a robot
or a kernel.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.checks import Shape, as_tensor
from diffeo_calib.errors import DiffeoCalibWarning, InputError, MeasurementError, sentence

REPEAT_TOLERANCE = 1e-3
"""Configurations closer than this in every joint (rad or m) are repeats of one another."""
MANY_TURNS = 4 * math.pi
"""No usual axis turns this far (rad), so larger values are probably degrees."""


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Measurements:
    """N joint configurations and the measured positions of P markers fixed on the tool.

    Args:
        q: (N, n) joint configurations, rad (revolute) or m (prismatic).
        points: (N, P, 3) measured positions of the P markers, m; (N, 3) means one marker.
        joint_names: n names, in the order of the columns of ``q``.
        marker_names: P names.
        doubt: whether to warn about rows and values that look wrong.

    The tensors are detached float64 copies: later changes of the arguments do not reach them.

    Raises:
        MeasurementError: wrong shape, no row, different numbers of rows, NaN or infinite values
            (first place named), a number of names that does not match.

    Warns:
        DiffeoCalibWarning: exact repeats of a row; joint values so large that they look like degrees.
            Nothing is dropped.
    """

    q: Tensor
    points: Tensor
    joint_names: tuple[str, ...] | None
    marker_names: tuple[str, ...] | None

    def __init__(
        self,
        q: object,
        points: object,
        joint_names: Sequence[str] | None = None,
        marker_names: Sequence[str] | None = None,
        *,
        doubt: bool = True,
    ) -> None:
        angles = _copy(q, "q", ("N", "n"), fix="pass one row per measurement")
        places = _copy(points, "points", ("N", "P", 3), ("N", 3), fix="pass x, y and z of every marker, in metres")
        places = places.reshape(len(places), -1, 3).to(angles.device)  # (N, 3) -> (N, 1, 3)
        if len(angles) != len(places):
            what, fix = "`q` and `points` differ in their number of rows", "pass one row of each per measurement"
            raise _error(what, expected=f"{len(angles)} rows of `points`", got=len(places), fix=fix)
        joints = _unique_names(joint_names, "joint_names", angles.shape[1], "column of `q`")
        markers = _unique_names(marker_names, "marker_names", places.shape[1], "marker in `points`")
        for name, value in (("q", angles), ("points", places), ("joint_names", joints), ("marker_names", markers)):
            object.__setattr__(self, name, value)  # the class is frozen
        if doubt:
            _doubt_copies(self)
            _doubt_degrees(self)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def markers(self) -> int:
        """Number of markers P."""
        return self.points.shape[1]

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        counts = (len(self), "row"), (self.n, "joint"), (self.markers, "marker")
        return f"Measurements({', '.join(f'{count} {thing}' + 's' * (count != 1) for count, thing in counts)})"

    def __getitem__(self, index: object) -> Measurements:
        return self.rows(index)

    def __iter__(self) -> Iterator[Measurements]:
        return (self.rows(i) for i in range(len(self)))

    def rows(self, index: object) -> Measurements:
        """Return the rows chosen by an integer, slice, list of integers or boolean mask, in that order.

        Raises:
            IndexError: an index out of range, or a mask of the wrong length.
            MeasurementError: no row is left.
        """
        if isinstance(index, Tensor):
            index = index.numpy(force=True)
        key = index if isinstance(index, slice) else np.asarray(index)
        chosen = np.arange(len(self))[key] if isinstance(key, slice) or key.size else np.arange(0)
        chosen = torch.as_tensor(np.atleast_1d(chosen), device=self.q.device)
        if len(chosen) == 0:
            fix = "choose other rows"
            raise _error("the selection holds no row", expected="at least one", got=0, fix=fix)
        q, points = self.q[chosen], self.points[chosen]
        return Measurements(q, points, self.joint_names, self.marker_names, doubt=False)

    def groups(self, tolerance: float = REPEAT_TOLERANCE) -> Tensor:
        """Label repeated configurations: rows with the same label are repeats of one another.

        The first row that belongs to no group yet leads a new one, which takes all later free rows within
        ``tolerance`` of it in every joint. A group is thus no wider than its leader's neighbourhood: rows along
        a slow trajectory do not chain into a single group. Angles are compared as they are, without wrapping:
        q and q + 2 pi are different configurations.

        Args:
            tolerance: largest difference from the leader in any joint, rad or m.

        Returns:
            (N,) int64 labels 0, 1, ... in the order of first appearance.
        """
        from scipy.spatial import KDTree  # noqa: PLC0415  # slow to import, not needed to use a model

        tree = KDTree(self.q.cpu().numpy())
        labels = np.full(len(self), -1)
        count = 0
        for row in range(len(self)):
            if labels[row] < 0:
                near = np.asarray(tree.query_ball_point(tree.data[row], tolerance, p=math.inf))
                labels[near[labels[near] < 0]] = count
                count += 1
        return torch.as_tensor(labels, dtype=torch.int64)

    def copies(self) -> list[tuple[int, int]]:
        """Return (earlier row, row) for every row that copies an earlier one exactly: real repeats differ by noise."""
        table = torch.cat([self.q, self.points.flatten(1)], dim=1).cpu().numpy() + 0.0  # -0.0 becomes 0.0
        first: dict[bytes, int] = {}
        pairs = ((first.setdefault(values.tobytes(), row), row) for row, values in enumerate(table))
        return [(earlier, row) for earlier, row in pairs if earlier != row]

    def split(self, fraction: float = 0.7, seed: int = 0) -> tuple[Measurements, Measurements]:
        """Split at random into (train, test), keeping repeated configurations together.

        Groups of repeats are shuffled; each in turn goes to ``train`` if that brings it nearer to
        ``round(fraction * N)`` rows. Both parts keep the order of the rows. Same seed, same split.

        Args:
            fraction: wanted share of rows in ``train``, between 0 and 1.
            seed: of the shuffle.

        Raises:
            MeasurementError: fraction outside (0, 1), or all rows repeat one configuration, so that one
                part would be empty.
        """
        if not 0.0 < fraction < 1.0:
            fix = "pass the share of rows to train on, such as 0.7"
            raise _error("`fraction`", expected="a number between 0 and 1", got=fraction, fix=fix)
        labels, sizes, order = self._shuffled_groups(seed, wanted=2, what="cannot split into train and test")
        target, have, taken = round(fraction * len(self)), 0, []
        for group in order:
            after = have + sizes[group]
            nearer = abs(after - target) < abs(have - target)
            if after < len(self) and (nearer or not taken):  # neither part may end up empty
                have, taken = after, [*taken, group]
        in_train = np.isin(labels, taken)
        return self.rows(in_train), self.rows(~in_train)

    def folds(self, k: int = 5, seed: int = 0) -> list[tuple[Measurements, Measurements]]:
        """Return ``k`` pairs (train, test) whose test parts cover every row once; repeats stay together.

        Args:
            k: number of folds, at least 2.
            seed: of the shuffle of the groups of repeats.

        Raises:
            MeasurementError: k below 2, or fewer distinct configurations than folds.
        """
        if k < 2:
            raise _error("`k`", expected="at least 2 folds", got=k, fix="pass 5 or 10")
        labels, sizes, order = self._shuffled_groups(seed, wanted=k, what=f"cannot make {k} folds")
        largest_first = order[np.argsort(-sizes[order], kind="stable")]
        load, fold_of = np.zeros(k, dtype=np.int64), np.zeros(len(sizes), dtype=np.int64)
        for group in largest_first:
            fold_of[group] = load.argmin()
            load[fold_of[group]] += sizes[group]
        fold = fold_of[labels]
        return [(self.rows(fold != i), self.rows(fold == i)) for i in range(k)]

    def _shuffled_groups(self, seed: int, wanted: int, what: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return labels (N,), group sizes (G,) and a random order of the groups (G,)."""
        labels = self.groups().numpy()
        sizes = np.bincount(labels)
        if len(sizes) < wanted:
            got = f"{len(sizes)} (in {len(self)} rows; rows within {REPEAT_TOLERANCE} rad or m stay together)"
            fix = "measure more configurations, or ask for fewer parts"
            raise _error(what, expected=f"at least {wanted} distinct configurations", got=got, fix=fix)
        return labels, sizes, np.random.default_rng(seed).permutation(len(sizes))


def _doubt_copies(data: Measurements) -> None:
    pairs = data.copies()
    if pairs:
        where = f"first row {pairs[0][1]}, of row {pairs[0][0]}"
        text = f"{len(pairs)} of {len(data)} rows repeat an earlier row exactly: {where}"
        text = f"{text}; real repeats differ by noise: remove them if they are copies."
        warnings.warn(text, DiffeoCalibWarning, stacklevel=3)


def _doubt_degrees(data: Measurements) -> None:
    largest, joint = (float(value) for value in data.q.abs().amax(dim=0).max(dim=0))
    if largest > MANY_TURNS:
        name = f" ('{data.joint_names[int(joint)]}')" if data.joint_names else ""
        text = f"`q`, column {int(joint)}{name} reaches {largest:g} rad: values look like degrees"
        warnings.warn(f"{text}; convert them to radians if they are.", DiffeoCalibWarning, stacklevel=3)


def _error(what: str, *, expected: object = None, got: object = None, fix: str = "") -> MeasurementError:
    return MeasurementError(sentence(what, expected=expected, got=got, fix=fix))


def _copy(value: object, name: str, shape: Shape, also: Shape | None = None, *, fix: str) -> Tensor:
    """Return a checked, detached float64 copy."""
    try:
        return as_tensor(value, name, shape, also=also, fix=fix).detach().clone()
    except InputError as error:
        raise MeasurementError(str(error)) from None


def _unique_names(names: Sequence[str] | None, what: str, count: int, each: str) -> tuple[str, ...] | None:
    if names is None:
        return None
    names = (names,) if isinstance(names, str) else tuple(names)
    if len(names) != count:
        raise _error(f"`{what}`", expected=count, got=f"{len(names)} ({names})", fix=f"pass one per {each}")
    if len(set(names)) < len(names):
        raise _error(f"`{what}`", expected="distinct names", got=list(names), fix="rename the repeated ones")
    return names
