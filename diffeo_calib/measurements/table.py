"""Measured pairs (joint configuration, marker positions or pose): the table, its subsets, splits and folds.

Everything is SI and float64: radians for revolute joints, metres for prismatic joints and for points.
A measured pose is held as a pose and as the three points that stand for it (:mod:`diffeo_calib.measurements.poses`).
Files in other units are read and written by :mod:`diffeo_calib.measurements.csv_files`. Nothing here knows a robot
or a kernel.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import Shape, as_tensor
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, MeasurementError, sentence
from diffeo_calib.measurements.poses import mark_jacobian, mark_points, rigid_poses

REPEAT_TOLERANCE = 1e-3
"""Configurations closer than this in every joint (rad or m) are repeats of one another."""
MANY_TURNS = 4 * math.pi
"""No usual axis turns this far (rad), so larger values are probably degrees."""
LEVER = 0.1
"""Distance (m) of the points that stand for a pose from its origin, unless told otherwise: that of usual tools."""
_BY_ROW = ("q", "points", "poses", "std", "rotation_std", "numbers")


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Measurements:
    """N joint configurations and the measured positions of P markers fixed on the tool.

    For measured poses see :meth:`from_poses`.

    Args:
        q: (N, n) joint configurations, rad (revolute) or m (prismatic).
        points: (N, P, 3) measured positions of the P markers, m; (N, 3) means one marker.
        joint_names: n names, in the order of the columns of ``q``.
        marker_names: P names.
        std: known standard deviations of the measured coordinates, m: one for all, (N,), (N, P) or (N, P, 3).
        doubt: whether to warn about rows and values that look wrong.

    Attributes:
        poses: (N, 4, 4) measured poses, m, if there are any; ``points`` are then the three points of each.
        lever: distance of these points from the pose's origin, m.
        std: (N, P, 3) known standard deviations of the measured positions, m; (N, 1, 3) for poses.
        rotation_std: (N, 3) those of the orientations, rad, about the axes of the measuring frame.
        numbers: (N,) int64, where every row is from: its line in the file, or its number in the first table. Subsets
            keep them.

    The tensors are detached float64 copies: later changes of the arguments do not reach them.

    Raises:
        MeasurementError: wrong shape, no row, different numbers of rows, NaN or infinite values
            (first place named), a number of names that does not match, a standard deviation that is not positive.

    Warns:
        DiffeoCalibWarning: exact repeats of a row; joint values so large that they look like degrees.
            Nothing is dropped.
    """

    q: Tensor
    points: Tensor
    joint_names: tuple[str, ...] | None
    marker_names: tuple[str, ...] | None
    poses: Tensor | None
    lever: float | None
    std: Tensor | None
    rotation_std: Tensor | None
    numbers: Tensor

    def __init__(
        self,
        q: object,
        points: object,
        joint_names: Sequence[str] | None = None,
        marker_names: Sequence[str] | None = None,
        *,
        std: object = None,
        doubt: bool = True,
    ) -> None:
        angles = _copy(q, "q", ("N", "n"), fix="pass one row per measurement")
        places = _copy(points, "points", ("N", "P", 3), ("N", 3), fix="pass x, y and z of every marker, in metres")
        places = places.reshape(len(places), -1, 3).to(angles.device)  # (N, 3) -> (N, 1, 3)
        _check_rows(angles, places, "points")
        joints = _unique_names(joint_names, "joint_names", angles.shape[1], "column of `q`")
        markers = _unique_names(marker_names, "marker_names", places.shape[1], "marker in `points`")
        known = _deviations(std, "std", places)
        _set(self, q=angles, points=places, joint_names=joints, marker_names=markers)
        _set(self, poses=None, lever=None, std=known, rotation_std=None, numbers=torch.arange(len(angles)))
        if doubt:
            _doubt_copies(self)
            _doubt_degrees(self)

    @classmethod
    def from_poses(
        cls,
        q: object,
        poses: object,
        joint_names: Sequence[str] | None = None,
        *,
        lever: float = LEVER,
        position_std: object = None,
        rotation_std: object = None,
        doubt: bool = True,
    ) -> Measurements:
        """N joint configurations and the measured poses of a frame fixed on the tool.

        Args:
            q: (N, n) joint configurations, rad (revolute) or m (prismatic).
            poses: (N, 4, 4) rigid transforms from the tool's frame to the measuring frame, m. Rotations may be off
                by 0.001, as those of files with few digits are: the nearest ones are taken.
            joint_names: n names, in the order of the columns of ``q``.
            lever: how far from the frame's origin the three points lie that stand for a pose, m. It weighs
                orientation against position: an error of 1 mrad counts like one of 0.1 mm with 0.1 m.
            position_std: known standard deviations of the positions, m: one for all, (N,) or (N, 3).
            rotation_std: those of the orientations, rad, about the axes of the measuring frame, in the same shapes.
            doubt: whether to warn about rows and values that look wrong.

        Raises:
            MeasurementError: as the constructor; a transform that is not rigid (row named); a lever or a standard
                deviation that is not positive.
        """
        angles = _copy(q, "q", ("N", "n"), fix="pass one row per measurement")
        try:
            frames = rigid_poses(poses).to(angles.device)
            marks = mark_points(frames, lever)
        except InputError as error:
            raise MeasurementError(str(error)) from None
        _check_rows(angles, frames, "poses")
        data = cls(angles, marks, joint_names, doubt=False)
        position, turn = frames[:, :3, 3], _deviations(rotation_std, "rotation_std", frames[:, :3, 3])
        known = _deviations(position_std, "position_std", position)
        _set(data, poses=frames, lever=float(lever), std=None if known is None else known[:, None], rotation_std=turn)
        if doubt:
            _doubt_copies(data)
            _doubt_degrees(data)
        return data

    @property
    def covariance(self) -> Tensor | None:
        """The known part of the noise: (N, 3 P, 3 P) in m^2, coordinates of a marker adjacent; None if unknown.

        Of a pose with position errors dt and small rotation errors w the point at arm a is off by dt + w x a, so
        that the nine coordinates have a covariance of rank 6 (3 if only one of the two is known).
        """
        if self.poses is None or self.lever is None:
            return None if self.std is None else torch.diag_embed(self.std.flatten(1).square())
        if self.std is None and self.rotation_std is None:
            return None
        nothing = torch.zeros_like(self.poses[:, :3, 3])
        position = nothing if self.std is None else self.std[:, 0]
        turn = nothing if self.rotation_std is None else self.rotation_std
        factor = mark_jacobian(self.poses, self.lever) * torch.cat([position, turn], dim=1)[:, None]
        return factor @ factor.mT

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def markers(self) -> int:
        """Number of markers P; 3 for poses, each of which is three points."""
        return self.points.shape[1]

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        counts = (len(self), "row"), (self.n, "joint"), (self.markers, "marker")
        parts = [f"{count} {thing}" + "s" * (count != 1) for count, thing in counts]
        return f"Measurements({', '.join(parts if self.poses is None else [*parts[:2], 'poses'])})"

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
        part = copy(self)
        tables = {name: getattr(self, name) for name in _BY_ROW}
        _set(part, **{name: table[chosen] for name, table in tables.items() if table is not None})
        return part

    def with_joint_names(self, names: Sequence[str]) -> Measurements:
        """Return the same measurements under other names of the joints.

        Raises:
            MeasurementError: a number of names that does not match, or a name twice.
        """
        renamed = copy(self)
        _set(renamed, joint_names=_unique_names(names, "names", self.n, "column of `q`"))
        return renamed

    def with_numbers(self, numbers: Sequence[int]) -> Measurements:
        """Return the same measurements, with other numbers (N,) that say where every row is from.

        Raises:
            MeasurementError: not one per row.
        """
        if len(numbers) != len(self):
            raise _error("`numbers`", expected=len(self), got=len(numbers), fix="pass one per row")
        numbered = copy(self)
        _set(numbered, numbers=torch.as_tensor(numbers, dtype=torch.int64))
        return numbered

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
        if not isinstance(fraction, (int, float)) or not 0.0 < fraction < 1.0:
            fix = "pass the share of rows to train on, such as 0.7"
            raise _error("`fraction`", expected="a number between 0 and 1", got=repr(fraction), fix=fix)
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
        if not isinstance(k, int) or k < 2:
            raise _error("`k`", expected="at least 2 folds", got=repr(k), fix="pass 5 or 10")
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
        text = f"`q`, column {int(joint)}{name} reaches {largest:g}: values look like degrees, or a slide's millimetres"
        warnings.warn(f"{text}; convert them to rad or m if they are.", DiffeoCalibWarning, stacklevel=3)


def _set(data: Measurements, **attributes: object) -> None:
    """Fill attributes of a frozen object."""
    for name, value in attributes.items():
        object.__setattr__(data, name, value)


def _check_rows(q: Tensor, other: Tensor, name: str) -> None:
    if len(q) != len(other):
        what, fix = f"`q` and `{name}` differ in their number of rows", "pass one row of each per measurement"
        raise _error(what, expected=f"{len(q)} rows of `{name}`", got=len(other), fix=fix)


def _deviations(value: object, name: str, like: Tensor) -> Tensor | None:
    """Standard deviations for every number of ``like`` from one for all, one per row, and so on."""
    if value is None:
        return None
    shapes = [tuple(like.shape[:axes]) for axes in range(like.ndim + 1)]
    fix = "pass one standard deviation for all, one per row, or finer"
    given = _copy(value, name, *shapes, fix=fix).to(like.device)
    bad = (given <= 0).nonzero()
    if len(bad):
        where, got = [int(i) for i in bad[0]], float(given[tuple(bad[0])])
        what = f"`{name}`" + f", first at index {where}" * bool(where)
        raise _error(what, expected="positive numbers", got=got, fix="leave it out if it is not known")
    return given.reshape(*given.shape, *[1] * (like.ndim - given.ndim)).expand(like.shape).clone()


def _error(what: str, *, expected: object = None, got: object = None, fix: str = "") -> MeasurementError:
    return MeasurementError(sentence(what, expected=expected, got=got, fix=fix))


def _copy(value: object, name: str, shape: Shape, *also: Shape, fix: str) -> Tensor:
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
