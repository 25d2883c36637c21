"""Rows of one kind, what tables of all kinds have in common: columns, selections, splits that keep repeats together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number, check_seed
from diffeo_calib.common.data_frames import data_frame
from diffeo_calib.common.device import HOST, methods_outside_inference_mode, usable
from diffeo_calib.common.errors import MeasurementError, as_written, warn_user
from diffeo_calib.measurements import checks

if TYPE_CHECKING:
    from typing_extensions import Self

    from diffeo_calib.robots.payload import Payload

T = TypeVar("T")
ON_HOST = ("line_numbers", "session", "device", "seen_by")  # columns of numbers that stay on the host
NO_SOCKET = -1  # number of the socket of rows whose positions a device measured
REPEAT_TOLERANCE = 1e-3  # configurations closer than this in every joint [rad or m] are repeats of one another
FEWEST_PER_DEVICE = 8  # rows of a device that reports readings, with which it can be placed
CONFIGURATIONS, PLACES = "distinct configurations", "places with sockets"  # words for what a split keeps together


def with_attributes(data: T, **attributes: object) -> T:
    """A copy with other attributes."""
    set_attributes(changed := copy(data), **attributes)
    return changed


def set_attributes(data: object, **attributes: object) -> None:
    """Fill attributes of a frozen object."""
    for name, value in attributes.items():
        object.__setattr__(data, name, value)


@methods_outside_inference_mode
class RowGroups:
    """N rows of one kind with a value per column and row, its columns are the attributes ``BY_ROW`` that are not None.

    Rows of several kinds are :class:`Observations`, whose ``parts`` are tables of one kind each.

    Attributes:
        covariates: (N, K) values with which something may drift, such as times and temperatures, in any unit.
    """

    BY_ROW: ClassVar[tuple[str, ...]] = ()  # attributes with a value for each row, all of them tensors (N, ...)
    ALIKE: ClassVar[tuple[str, ...]] = ()  # other attributes in which tables agree that are joined
    NUMBERED: ClassVar[tuple[str, str]]
    """The column of numbers of set-ups or devices, -1 for none, and the attribute with their names."""
    flattery: ClassVar[str] = ""  # what errors of these rows do not show where no device measured a position

    q: Tensor
    line_numbers: Tensor
    joint_names: tuple[str, ...] | None = None
    payload: Tensor | None = None
    payload_at: str | None = None
    file_sha256: str | None = None
    origin: object | None = None
    covariates: Tensor | None = None
    covariate_names: tuple[str, ...] = ()
    without_device: bool = True  # whether neither a position nor a pose was measured
    kind: Any
    COMPARED: ClassVar[tuple[str, ...]] = ("q",)  # columns in which a row that repeats another one equals it
    measured: Any
    """() -> name -> values (N,) of every column but joints, payloads and covariates, in SI units and pixels."""

    @property
    def parts(self) -> tuple[Self, ...]:
        """This table alone, so that it can be treated like :class:`Observations`."""
        return (self,)

    @property
    def index(self) -> tuple[Tensor]:
        """(N,) int64 row numbers of this one part."""
        return (torch.arange(len(self), device=HOST),)

    @property
    def columns(self) -> dict[str, Tensor]:
        """The columns that this table has, by name."""
        return {name: values for name in self.BY_ROW if (values := getattr(self, name)) is not None}

    @property
    def stated(self) -> object:
        """What is said of the devices, for :attr:`sha256`."""
        return getattr(self, self.NUMBERED[1])

    @property
    def sha256(self) -> str:
        """SHA-256 of the file that the rows were read from, or of the arrays if they come from Python."""
        arrays, names = dict[str, Tensor](), dict[str, bytes]()
        for part, rows in zip(self.parts, self.index, strict=True):
            arrays |= {f"{len(names)} {name}": part.columns[name] for name in part.columns if name != "line_numbers"}
            arrays |= {f"{len(names)} rows": rows}
            names[f"{len(names)} {part.kind}"] = repr(part.stated).encode()
        return self.file_sha256 or checks.arrays_sha256(arrays, names)

    @property
    def column_kind(self) -> object:
        """Key that is equal for tables that can be joined into one."""
        return self.kind

    @property
    def device_names(self) -> list[str]:
        """(N,) name of the device, or of its set-up, of each row; "" without one."""
        column, names = self.NUMBERED
        return checks.texts_of(getattr(self, column), getattr(self, names), len(self))

    @property
    def row_names(self) -> list[str]:
        """(N,) how texts name the rows: by their lines, images by their files too."""
        return [f"row {line}" for line in self.line_numbers.tolist()]

    def beside_images(self) -> list[tuple[Any, Tensor]]:
        """Rows as they stand beside images of a board with the same tool: tables, and row numbers (M,) here."""
        return [(self, *self.index)]

    def rows(self, index: object) -> Self:
        """The rows chosen by an integer, slice, list of integers or boolean mask, in that order.

        IndexError for an index out of range, MeasurementError for an empty selection, or nothing that chooses rows.
        """
        chosen = checks.chosen_rows(index, len(self))
        return with_attributes(self, **{name: t[chosen.to(t.device)] for name, t in self.columns.items()})

    def of_each(self, change: Callable[[Any, Tensor], Any]) -> Self:
        """Return the rows after a change of each part, given with its row numbers (N_i,)."""
        return change(self, *self.index)

    def to_frame(self) -> Any:
        """A pandas.DataFrame of the rows, in SI units and pixels, whose index are the line numbers.

        Its columns are the joints (q1, q2, ... without names), those of :meth:`measured`, known masses as payload, and
        covariates. ImportError if pandas is not installed.
        """
        names = self.joint_names or [f"q{joint + 1}" for joint in range(self.n)]
        payload = {} if self.payload is None else {"payload": self.payload}
        columns = dict(zip(names, self.q.T, strict=True)) | self.measured() | payload | self.drifting
        return data_frame(columns, self.line_numbers.numpy())

    def doubted(self, doubt: bool = True) -> Self:
        """Warn about exact copies of rows and joint values that look like degrees."""
        if doubt:
            self.warn_of_copies()
            largest, joint = (float(value) for value in self.q.abs().amax(dim=0).max(dim=0))
            if largest > checks.LARGEST_JOINT_ANGLE_RAD:  # the kinds of the joints are not known
                name = f" ('{self.joint_names[int(joint)]}')" if self.joint_names else ""
                text = f"`q`, column {int(joint)}{name} reaches {largest:g}: values look like degrees, or like "
                warn_user(f"{text}millimetres of a prismatic joint; convert them to rad or m if they are.")
        return self

    def warn_of_copies(self) -> None:
        """Warn about exact copies of rows, which predict each other."""
        if pairs := self.copies():
            earlier, later = (self.row_names[row] for row in pairs[0])
            text = f"{len(pairs)} of {len(self)} rows repeat an earlier row exactly: first {later}, of {earlier}"
            warn_user(f"{text}; real repeats differ by noise: remove these rows if they are copies.")

    @classmethod
    def in_one(cls, tables: Sequence[Self]) -> Self:
        """Tables that one table can hold, in order; MeasurementError if they differ in their columns."""
        if len(tables) == 1:
            return tables[0]
        column, texts = cls.NUMBERED  # of set-ups or devices, whose numbers become those of all
        names = tuple(dict.fromkeys(name for table in tables for name in getattr(table, texts)))
        parts = []
        for table in tables:
            new, numbers = checks.numbers_of([*getattr(table, texts), ""], names), getattr(table, column)
            parts.append(table if numbers is None else with_attributes(table, **{column: new[numbers], texts: names}))
        check_alike(parts, cls.BY_ROW, cls.ALIKE)
        whole = {name: torch.cat([table.columns[name] for table in parts]) for name in parts[0].columns}
        same = {name: common([getattr(table, name) for table in tables]) for name in ("file_sha256", "origin")}
        return with_attributes(parts[0], **whole, **same)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} rows, {self.n} joints)"

    def __getitem__(self, index: object) -> Self:
        return self.rows(index)

    def __iter__(self) -> Iterator[Self]:
        return (self.rows(i) for i in range(len(self)))

    def with_columns(self, **columns: object) -> Self:
        """Return the rows with other attributes; tensors (N, ...) have a value for each row."""

        def changed(part: Any, rows: Tensor) -> Any:
            chosen = {name: v[rows.to(v.device)] if isinstance(v, Tensor) else v for name, v in columns.items()}
            return with_attributes(part, **chosen)

        return self.of_each(changed)

    def to(self, device: torch.device | str) -> Self:
        """Return the rows with their values on a device."""
        place = usable(device)

        def moved(part: Any, _: Tensor) -> Any:
            return with_attributes(part, **{k: v.to(place) for k, v in part.columns.items() if k not in ON_HOST})

        return self.of_each(moved)

    def with_joint_names(self, names: Sequence[str]) -> Self:
        """Return the rows with n distinct names of the joints, else MeasurementError."""
        return self.with_columns(joint_names=checks.checked_names(names, "names", self.n, "column of `q`"))

    def with_payload(self, payload: object, at: str | None = None) -> Self:
        """Return the rows with a payload of known mass, whose sag a calibration then finds.

        Args:
            payload: masses (N,), or one for all rows, in any unit: 0 without load. None if they are not known.
            at: name of the link that carries it at its origin, a tip or a `load` of the robot; its only tip by default.

        Raises:
            MeasurementError: not one per row, negative, or not finite.
        """
        if payload is None:
            return self.with_columns(payload=None, payload_at=at)
        fix = "pass one mass for all rows, or one for each"
        masses = checks.copied(payload, "payload", (), (len(self),), fix=fix).to(self.q.device)
        if negative := (masses.reshape(-1) < 0).nonzero().flatten().tolist():
            what, got = f"`payload`, row {negative[0]}" if masses.ndim else "`payload`", f"{float(masses.min()):g}"
            raise MeasurementError.of(what, expected="a mass of 0 or more", got=got, fix="correct it")
        return self.with_columns(payload=masses.expand(len(self)).clone(), payload_at=at)

    def with_covariates(self, *, time: object = None, temperature: object = None) -> Self:
        """Return the rows with columns (N,), in any unit, with which device or arm may drift; None if not known.

        A calibration looks for drifts in proportion to them; where leave-one-out errors prove one, it becomes part of
        the model, which then holds for the middle of each column's range.

        Raises:
            MeasurementError: not one per row, or not finite.
        """
        given = {name: values for name, values in (("time", time), ("temperature", temperature)) if values is not None}
        fix = "pass a finite number for each row"
        parts = [checks.copied(values, name, (len(self),), fix=fix).to(self.q.device) for name, values in given.items()]
        return self.with_columns(covariates=torch.stack(parts, 1) if parts else None, covariate_names=tuple(given))

    def with_load(self, load: Payload) -> Self:
        """Return the rows with the masses of a payload, if there is one."""
        return self if not load else self.with_payload(load.masses.to(self.q.device), load.link)

    def with_line_numbers(self, line_numbers: Sequence[int] | Tensor) -> Self:
        """Return the rows with line numbers (N,), which tell where every row comes from, else MeasurementError."""
        lines = checks.copied(line_numbers, "line_numbers", (len(self),), fix="pass one per row")
        return self.with_columns(line_numbers=lines.to(HOST, torch.int64))

    def copies(self) -> list[tuple[int, int]]:
        """(earlier row, row) for every row that repeats an earlier one of its kind exactly; real repeats differ."""
        pairs = list[tuple[int, int]]()
        for part, rows in zip(self.parts, self.index, strict=True):
            each = [getattr(part, name).to(part.q) for name in part.COMPARED]
            values = torch.cat([numbers.reshape(len(part), -1) for numbers in each], 1).cpu().numpy()
            values = np.where(np.isnan(values), np.nan, values) + 0.0  # one kind of NaN; -0.0 becomes 0.0
            first: dict[bytes, int] = {}
            for numbers, row in zip(values, rows.tolist(), strict=True):
                earlier = first.setdefault(numbers.tobytes(), row)
                pairs += [(min(earlier, row), max(earlier, row))] * (earlier != row)
        return sorted(pairs, key=lambda pair: pair[1])

    @property
    def masses(self) -> Tensor:
        """(N,) payloads of the rows; (0,) where they are not known."""
        return self.q.new_zeros(0) if self.payload is None else self.payload

    @property
    def drifting(self) -> dict[str, Tensor]:
        """The covariates (N,) by name."""
        return {} if self.covariates is None else dict(zip(self.covariate_names, self.covariates.T, strict=True))

    @property
    def socket_numbers(self) -> Tensor:
        """(N,) int64, number of each row's socket, -1 for other rows."""
        return torch.full((len(self.q),), NO_SOCKET, dtype=torch.int64, device=HOST)

    @property
    def places(self) -> Tensor:
        """(N,) int64, number of the place of each row's socket, -1 for other rows."""
        return self.socket_numbers

    def groups(self, tolerance: float = REPEAT_TOLERANCE) -> Tensor:
        """Labels (N,) int64 0, 1, ... of repeated configurations, in the order of first appearance.

        The first row without a group leads a new one, which takes all later rows without a group that are within
        ``tolerance`` [rad or m] of the leader in every joint: rows along a slow trajectory do not chain into a single
        group. Angles are compared without wrapping.
        """
        from scipy.spatial import KDTree  # noqa: PLC0415  # slow to import, not needed to use a model

        check_number(tolerance, "`tolerance`", above=-1e-300)
        tree = KDTree(self.q.cpu().numpy())
        labels, count = np.full(len(self.q), -1), 0
        for row in range(len(labels)):
            if labels[row] < 0:
                near = np.asarray(tree.query_ball_point(tree.data[row], tolerance, p=math.inf))
                labels[near[labels[near] < 0]] = count
                count += 1
        return torch.as_tensor(labels, dtype=torch.int64, device=HOST)

    def split(self, fraction: float = 0.7, seed: int = 0) -> tuple[Self, Self]:
        """Split at random into (train, test), keeping repeated configurations together, and the sockets of a place.

        Where some positions were measured, these alone are held out: rows in sockets stay in ``train``. Groups of
        repeats go in random order to ``train`` where that brings its size nearer to ``round(fraction * N)`` rows. A
        device keeps the rows in ``train`` that it needs to be placed. Both parts keep the order of the rows.

        Raises:
            MeasurementError: fraction outside (0, 1), or one configuration or place, so that a part would be empty.
        """
        held, labels, kind = self._divided
        units, names, test = labels.numpy(), np.full(len(self), "", dtype=object), np.zeros(len(self), dtype=bool)
        for part, rows in zip(self.parts, self.index, strict=True):  # devices of other kinds are others
            each = zip(part.device_names, (part.places != NO_SOCKET).tolist(), strict=True)
            names[rows.numpy()] = ["" if rests else name and f"{part.kind} {name}" for name, rests in each]
        test[held] = out = ~in_train(labels, fraction, seed, kind)
        for name in np.unique(names[test]):
            mask = (names == name) & (name != "")
            for unit in np.unique(units[out & mask[held]]) if mask.sum() >= FEWEST_PER_DEVICE else ():
                if (mask & ~test).sum() < FEWEST_PER_DEVICE and (test[held] & (units != unit)).any():
                    test[held[units == unit]] = False
        return self.rows(~test), self.rows(test)

    def folds(self, k: int = 5, seed: int = 0) -> list[tuple[Self, Self]]:
        """``k`` pairs (train, test) whose test parts cover every row once; repeats stay together.

        Where some positions were measured, they cover these: rows in sockets are in every ``train``.
        MeasurementError for k below 2, or fewer distinct configurations than folds.
        """
        if not isinstance(k, (int, np.integer)) or isinstance(k, bool) or k < 2:
            raise MeasurementError.of("`k`", expected="at least 2 folds", got=as_written(k), fix="pass 5 or 10")
        held, units, kind = self._divided
        sizes, order = _shuffled(units, seed, kind, fewest=k, what=f"cannot make {k} folds")
        load, fold_of = np.zeros(k, dtype=np.int64), np.zeros(len(sizes), dtype=np.int64)
        for group in order[np.argsort(-sizes[order], kind="stable")]:  # the largest first
            fold_of[group] = load.argmin()
            load[fold_of[group]] += sizes[group]
        fold = np.full(len(self), -1)
        fold[held] = fold_of[units.numpy()]
        return [(self.rows(fold != i), self.rows(fold == i)) for i in range(k)]

    def place_lines(self, held_out: Self) -> Iterator[str]:
        """A sentence where the sockets of one place alone are left beside rows that are held out."""
        here, there = (len({*rows.places.tolist()} - {NO_SOCKET}) for rows in (self, held_out))
        if here == 1 and there:
            yield f"the sockets of one place alone are fitted, those of {there} more are held out: --holdout 0 fits all"

    @property
    def _divided(self) -> tuple[np.ndarray, Tensor, str]:
        """The rows (M,) that splits divide, labels (M,) of those that stay together, and a word for these.

        Together stay repeats, and the rows of a place.
        """
        resting = self.places != NO_SOCKET
        rows = (resting | True if self.without_device else ~resting).nonzero()[:, 0]
        alone = int(self.places.max()) + 1 + torch.arange(len(self), device=HOST)
        labels = connected(torch.where(resting, self.places, alone)[rows], self.rows(rows).groups())
        return rows.numpy(), labels, PLACES if bool(resting.all()) else CONFIGURATIONS


def common(values: Sequence[T]) -> T | None:
    """The value that all have in common; None if they differ."""
    first = values[0]
    same = all(value is first or (isinstance(first, str) and value == first) for value in values)
    return first if same else None


def check_alike(parts: Sequence[RowGroups], by_row: Sequence[str], alike: Sequence[str]) -> None:
    """MeasurementError for tables that differ in having columns ``by_row``, or in other attributes ``alike``."""
    for part in parts:
        other = [name for name in alike if getattr(part, name, None) != getattr(parts[0], name, None)]
        other += [name for name in by_row if (getattr(part, name) is None) != (getattr(parts[0], name) is None)]
        if other:
            fix = "join rows that were measured in the same way, under the same names"
            raise MeasurementError.of(f"the tables differ in {', '.join(other)}", fix=fix)


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


def in_train(labels: Tensor, fraction: float, seed: int, kind: str) -> np.ndarray:
    """(N,) boolean: whole groups of labels (N,), at random, see :meth:`RowGroups.split`."""
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


def _shuffled(labels: Tensor, seed: int, kind: str, fewest: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Sizes (G,) of the groups, and their numbers (G,) in random order."""
    with checks.of_measurements():
        checked_seed = check_seed(seed)
    sizes = np.bincount(labels.numpy())
    if len(sizes) < fewest:
        got = f"{len(sizes)} (in {len(labels)} rows; repeats, and the rows of a place, stay together)"
        fix = "measure more of them, or ask for fewer parts"
        raise MeasurementError.of(what, expected=f"at least {fewest} {kind}", got=got, fix=fix)
    return sizes, np.random.default_rng(checked_seed).permutation(len(sizes))
