"""Devices that report numbers of the tool: where they stand, what they see, and how they are found.

A device sees a ball on the tool, or a frame of it. It has constants, which change by increments, such as shifts [m] and
turns [rad]. What it reports is converted to metres, so that errors of all kinds of readings are errors of positions. A
new kind of device is a subclass of :class:`Devices` in a file of its own, registered by sensors/kinds.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from diffeo_calib.common.checks import wrapped
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, few
from diffeo_calib.maps.observation import Observation, ReadPoints
from diffeo_calib.measurements.checks import numbers_of, rare_names
from diffeo_calib.measurements.poses import POINTS, of_frames, poses_of_triangles
from diffeo_calib.measurements.readings import MILLIMETRES, Readings
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import skew

if TYPE_CHECKING:
    from typing_extensions import Self

T = TypeVar("T")
MODEL_FRAME = "the frame of the model"
Shown = tuple[str, tuple[float, ...], tuple[float, ...]]
"""Unit in which r numbers are shown, and what they are multiplied by and shifted by to be in it."""
SMALLEST_M = 1e-12  # of a column of a linear system, against division by zero
ROUNDS = 20  # steps of a refinement
OUTLIER_MEDIANS = 3.0  # errors, in medians, from which rows lose their weight in a refinement
SMALLEST_MEDIAN_M = 1e-7
SMALLEST_DISTANCE_M = 1e-6
"""Nearer to its fixed end the direction of a distance, and nearer to its lens the image of a camera, is undefined."""


MILLIMETRE = "mm", 1e-3  # a unit and its size, m
CHANGE, VALUE, ROW = "change", "value", "row"
"""What a hypothesis opens: what changes at a row or drifts, one number that a device is said to hold, such as a focal
length, or a number that differs from row to row."""


class Hypothesis(NamedTuple):
    """Something that may be wrong, or change, of a device, the robot or its tool."""

    name: str  # in words
    effects: Tensor  # (N, r, U) derivatives of N rows by its unknowns, m
    # of a single unknown, and its size in m, rad or relative; None to report the motion
    unit: tuple[str, float] | None = None
    fix: str = "name the rows before and after as two devices, or use those before or after it"  # what to do about it
    about: str = CHANGE  # :data:`CHANGE`, :data:`VALUE` or :data:`ROW`
    # its deviation in right rows, of a ratio that the fit takes up; 0 for what it cannot tell from the robot's size
    usual: float = 0.0

    def amount(self, size: float, sign: str = "") -> str:
        """A size of its unknown, m, rad or relative, with its unit."""
        unit, scale = self.unit or MILLIMETRE
        return f"{size / scale:{sign}.2g} {unit}"


def _nothing() -> Tensor:
    return torch.zeros(0, dtype=torch.int64, device=HOST)


@dataclass(frozen=True, eq=False)
class Extrinsics(ABC):
    """What is known of devices of one kind beside a model, and the rows of its fit that they measured.

    Args:
        names: D names. constants: (D, c). deviations: (D, k) standard deviations of increments of these, m or rad: of
            their prior before a fit, after it of what the rows leave open.
        rows: (M,) int64, numbers of the rows that they measured; by default none. device: (M,) which of them did.
        shown: how their readings are shown; None for other kinds, and in files of old versions.
    """

    kind: ClassVar[str]
    reads: ClassVar[bool] = False
    """Whether they report readings of a model's points."""
    set_up: ClassVar[bool] = False
    """Whether they are set-ups: one alone is that of its model, and every fit finds them anew."""
    seen_points: ClassVar[int] = 0
    """Points of the tool that they see."""

    names: tuple[str, ...]
    constants: Tensor
    deviations: Tensor
    rows: Tensor = field(default_factory=_nothing)
    device: Tensor = field(default_factory=_nothing)
    shown: Shown | None = None

    def stored(self) -> dict[str, Any]:
        """For the file of a model, in m and rad."""
        values = {name: getattr(self, name).tolist() for name in ("constants", "deviations", "rows", "device")}
        return {"kind": self.kind, "names": self.names} | values | ({"shown": self.shown} if self.shown else {})

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        """Constants beside another model of the same robot: those of readings read of its points what they read before.

        Args:
            T: (4, 4) from the old frame to the new one, m.
            before, after: (N, P, 3) points of the old and the new model at the rows of the fit, m.
            markers: (P, 3) old places of the markers from the new ones, in the frames of their tips, m.
        """
        return self.constants

    def aligned(self, data: T) -> T:
        """Rows that these measured as those of the model's own set-up."""
        return data

    def sentences(self) -> list[str]:
        """What is known of each of them, in the frame of the model."""
        return []

    @property
    def elsewhere(self) -> Tensor:
        """(D,) boolean: set-ups in another frame than the model's, or with other markers."""
        return torch.zeros(len(self.names), dtype=torch.bool, device=self.constants.device)

    @property
    def cameras(self) -> dict[str, Any]:
        """As the cameras that saw a board, by their names; none for other kinds."""
        return {}

    def same_set(self, other: Extrinsics) -> bool:
        """Whether others are of one set with these: of the same kind."""
        return self.kind == other.kind

    def only(self, names: Collection[str]) -> Self:
        """Keep devices with some names, and their rows."""
        chosen = tuple(name for name in self.names if name in names)
        kept = [self.names.index(name) for name in chosen]
        places = [chosen.index(name) if name in chosen else -1 for name in self.names]
        device = torch.tensor(places, dtype=torch.int64, device=HOST)[self.device.to(HOST)]
        values = {"rows": self.rows[device >= 0], "device": device[device >= 0]}
        return replace(self, names=chosen, constants=self.constants[kept], deviations=self.deviations[kept], **values)

    def beside(self, other: Self) -> Self:
        """Add devices of the same kind under other names."""
        if not self.names:
            return other
        other = other.only({*other.names} - {*self.names})
        other = replace(other, device=other.device + len(self.names))
        every = "constants", "deviations", "rows", "device"
        values = {name: torch.cat([getattr(self, name), getattr(other, name)]) for name in every}
        return replace(self, names=(*self.names, *other.names), shown=self.shown or other.shown, **values)


@dataclass(frozen=True, eq=False)
class Devices(Extrinsics):
    """The devices of some readings, all of one kind, that of :attr:`Readings.kind`.

    A kind says how a reading follows from constants (:meth:`read`) and how these change (:meth:`changed`); derivatives
    are found by torch.
    """

    reads = True
    size_fix: ClassVar[str]
    """Advice where readings of this kind say too little about length."""
    stated_as: ClassVar[str] = ""
    """How a user writes where a new device is, to plan poses for it: the numbers of :meth:`stated`."""
    seen_points: ClassVar[int] = 1
    """The ball, or three points of each measured frame."""
    increments_each: ClassVar[int]
    """Increments k of a device."""
    numbers_each: ClassVar[int] = 1
    """Numbers r of a reading."""
    metres_each: ClassVar[float] = 1.0
    """Metres at the tool that a unit of a reading counts as."""
    unit: ClassVar[tuple[str, float]] = MILLIMETRES
    """In which readings are shown and written, and how many of it are one; see :meth:`Readings.of`."""

    @classmethod
    @abstractmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        """Constants (c,) of one device in closed form, from readings (N, r) of known bodies, see :meth:`bodies`."""

    @classmethod
    def prior(cls, offset_std: float = 0.0) -> list[float]:
        """Standard deviations of the k increments, m or rad, wide by default; ``offset_std``: see :class:`Readings`."""
        return [PLACES.found_m_rad] * cls.increments_each

    @classmethod
    def columns(cls) -> Mapping[str, Sequence[str]]:
        """Usual names of a column of readings, by the word of `fit --reading`; several columns are numbered from 1."""
        return {cls.kind: (cls.kind,)}

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        """Constants (D, c) of devices from the numbers (D, k) that say where they are, see ``stated_as``; m."""
        raise InputError.of(f"a plan for devices of the kind {cls.kind!r}", fix="write its method `stated`")

    @staticmethod
    @abstractmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        """The reading (r,) of one device with constants (c,) of one body (3,) or (4, 4), see :meth:`bodies`."""

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        """Constants (c,) of one device after increments (k,)."""
        return constants + increments

    @staticmethod
    def turned(values: Tensor, T: Tensor) -> Tensor:
        """Readings (N, r) in another frame, to which T (4, 4) leads: others only where they are along its axes."""
        return values

    @classmethod
    def check_seen(cls, constants: Tensor, points: Tensor) -> None:
        """Raise InputError for points (N, 3 k) of which devices with constants (N, c) have no reading."""

    @classmethod
    def _read_metres(cls, constants: Tensor, points: Tensor) -> Tensor:
        """(r,) of one device, of the coordinates (3 k,) that it sees, m."""
        return cls.metres_each * cls.read(constants, cls.bodies(points[None])[0])

    def observation(self, device: Tensor) -> Observation:
        """What rows of these devices (N,) observe, m."""
        constants, dim = self.constants[device], 3 * self.seen_points
        return ReadPoints(self._read_metres, constants, dim, self.numbers_each, self.check_seen)

    def by_increments(self, points: Tensor, device: Tensor) -> Tensor:
        """Derivatives (N, r, k) of what rows of these devices (N,) observe at points (N, 3 k), m, by increments."""
        constants, none = self.constants[device], torch.zeros_like(self.deviations)
        self.check_seen(constants, points)
        by_own = vmap(jacrev(self._read_metres))(constants, points)  # (N, r, c)
        return by_own @ vmap(jacrev(self.changed, argnums=1))(self.constants, none)[device]

    @property
    def root(self) -> Tensor:
        """Square root (D k, D k) of the covariance of all increments before the rows, m or rad."""
        return torch.diag(self.deviations.flatten())

    def shifted(self, shifts: Tensor) -> Devices:
        """The devices after shifts (D k,), increments in units of what is known of them."""
        increments = (self.root @ shifts).view_as(self.deviations)
        return replace(self, constants=vmap(self.changed)(self.constants, increments))

    @classmethod
    def points_of(cls, points: Tensor) -> Tensor:
        """The coordinates (N, 3 k) of what the devices see, of all points (N, P, 3) of a model."""
        return points[:, -cls.seen_points :].flatten(1)

    @classmethod
    def bodies(cls, points: Tensor) -> Tensor:
        """What the devices see by its coordinates (N, 3 k), m: balls (N, 3), a frame (N, 4, 4), or T (N, T, 4, 4)."""
        if cls.seen_points == 1:
            return points
        return of_frames(poses_of_triangles(points.unflatten(1, (-1, POINTS, 3))))

    def where(self, number: int) -> str:
        """Where a device is, in words."""
        return ", ".join(f"{value:.3f}" for value in self.constants[number].tolist())

    @property
    def places(self) -> Tensor:
        """(D, 3) to which the ball must be brought to be seen, m; none if anywhere will do."""
        return self.constants.new_zeros(0, 3)

    def sees(self, points: Tensor, device: Tensor) -> Tensor:
        """(N,) boolean: whether these devices (N,) can measure points (N, 3), m."""
        return torch.ones_like(device, dtype=torch.bool)

    @abstractmethod
    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        """Where a device is in a frame, with standard deviations of its increments (k,)."""

    def freed(self) -> Devices | None:
        """Leave open what was said to be known, to test it; None if there is nothing."""
        return None

    def check_freed(self, noise: float, free_noise: float) -> None:
        """Refuse, or warn about, what :meth:`freed` left open; noise of the geometric calibrations without, with, m."""

    def hypotheses(self, points: Tensor, device: Tensor) -> Iterator[Hypothesis]:
        """What may be wrong, or change between rows of these devices (N,) at points (N, 3), m: where each stands."""
        for name, effects in self._of_each(self.by_increments(points, device), device):
            yield Hypothesis(f"{self.kind} device '{name}'", effects)

    def _of_each(self, effects: Tensor, device: Tensor) -> Iterator[tuple[str, Tensor]]:
        """The effects (N, r, U) on the rows of each device by itself, with its name."""
        for number, name in enumerate(self.names):
            yield name, effects * (device == number)[:, None, None]

    def open_sentences(self) -> Iterator[tuple[str, str]]:
        """Directions that these devices cannot see wherever the robot goes, and advice."""
        yield from ()

    @classmethod
    def of(cls, data: Readings, constants: Tensor) -> Devices:
        """Devices with wide priors around constants (D, c)."""
        prior = constants.new_tensor(cls.prior(data.offset_std))
        return cls(data.names, constants, prior.expand(len(constants), -1), shown=data.shown)

    @classmethod
    def at(cls, data: Readings, points: Tensor) -> Devices:
        """The devices of readings of known points (N, 3 k), m, in closed form."""
        rows = [data.device == number for number in range(len(data.names))]
        bodies = cls.bodies(points)
        return cls.of(data, torch.stack([cls.start(data.values[mask], bodies[mask]) for mask in rows]))

    @property
    def freedom(self) -> int:
        """Increments of all devices."""
        return self.deviations.numel()

    def same_set(self, other: Extrinsics) -> bool:
        """Also under some of the same names."""
        return super().same_set(other) and bool(set(self.names) & set(other.names))

    def sentences(self) -> list[str]:
        return [self.sentence(number, std, MODEL_FRAME) for number, std in enumerate(self.deviations)]

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        device = torch.arange(len(self.names), device=before.device).repeat_interleave(len(before))
        old, new = (self.points_of(points).repeat(len(self.names), 1) for points in (before, after))
        sees = self.sees(old, device)
        old, new, device = old[sees], new[sees], device[sees]
        values = self.turned(self.observation(device).value(old) / self.metres[device, None], T)
        data = Readings(self.kind, old[:, :1], values, device, self.names)
        return replace(self, constants=self.at(data, new).constants).refined(data, new).constants

    @property
    def metres(self) -> Tensor:
        """(D,) metres of displacement per unit of a reading."""
        return torch.full_like(self.constants[:, 0], self.metres_each)

    def values(self, data: Readings) -> Tensor:
        """Readings (N, r) of devices under their names here, m.

        Raises:
            MeasurementError: readings of another kind or of other devices.
        """
        return data.values * self.metres[self.numbers(data)][:, None]

    def numbers(self, data: Readings) -> Tensor:
        """(N,) numbers here of the devices of some readings; MeasurementError for others than these."""
        if data.kind != self.kind or not set(data.names) <= set(self.names):
            expected, got = f"{self.kind}s of {few(self.names)}", f"{data.kind}s of {few(data.names)}"
            raise MeasurementError.of("`data`", expected=expected, got=got, fix="pass rows of the same devices")
        return numbers_of(data.names, self.names).to(data.device.device)[data.device]

    def errors(self, data: Readings, points: Tensor) -> Tensor:
        """Measured minus predicted readings (N, r), m, of the ball at points (N, 3), m."""
        return self.values(data) - self.observation(self.numbers(data)).value(points)

    def in_unit(self, data: Readings, values: Tensor) -> Tensor:
        """Values (N, r) in m as readings in the unit in which these are shown."""
        return values / self.metres[self.numbers(data)][:, None] * data.unit[1]

    def shared(self, points: Tensor, device: Tensor) -> Tensor:
        """Uncertainty of the devices, as effects of unit variance that rows share: (N, r, D k)."""
        effects = self.by_increments(points, device)  # (N, r, k)
        whose = torch.nn.functional.one_hot(device, len(self.constants)).to(effects)
        return (whose[:, None, :, None] * effects[:, :, None]).flatten(2) @ self.root

    def refined(self, data: Readings, points: Tensor) -> Devices:
        """The places that fit readings of known points (N, 3 k), m, best, by reweighted least squares."""
        devices = self
        for _ in range(ROUNDS):
            errors, slopes = devices.errors(data, points), devices.shared(points, devices.numbers(data))
            size = errors.norm(dim=1)
            level = size.median().clamp(min=SMALLEST_MEDIAN_M)
            weight = (median_weights(size, OUTLIER_MEDIANS).sqrt() / level)[:, None, None]
            eye = torch.eye(slopes.shape[2], dtype=slopes.dtype, device=slopes.device)
            matrix = torch.cat([(weight * slopes).flatten(0, 1), eye])
            target = torch.cat([(weight[..., 0] * errors).flatten(), eye[0] * 0.0])
            step = torch.linalg.lstsq(matrix, target[:, None]).solution
            devices = devices.shifted(step[:, 0])
        return devices

    def open_deviations(self, data: Readings, points: Tensor) -> Tensor:
        """(D, k) standard deviations of the increments, by the errors at known points (N, 3 k), m."""
        errors, slopes = self.errors(data, points), self.shared(points, self.numbers(data)).flatten(0, 1)
        level = errors.square().mean().sqrt().clamp(min=SMALLEST_MEDIAN_M)
        eye = torch.eye(slopes.shape[1], dtype=slopes.dtype, device=slopes.device)
        covariance = self.root @ torch.linalg.inv(slopes.mT @ slopes / level**2 + eye) @ self.root.mT
        return covariance.diagonal().clamp(min=0).sqrt().view(len(self.names), -1)


def check_devices(data: Readings) -> None:
    """Refuse devices with too few rows to be placed: a plane, a fixed point or a camera takes three to six numbers."""
    short = rare_names(data.device_names, data.line_numbers.tolist(), data.fewest)
    if short:
        fix = "check the names in these rows, measure more rows of them, or leave them out"
        expected = f"at least {data.fewest} rows with each name"
        raise MeasurementError.of(f"{data.kind}s", expected=expected, got=few(short), fix=fix)


def refuse_first(rows: Tensor, what: str, fix: str) -> None:
    """Raise InputError for the first of some rows, (N,) boolean; none of it under torch.func."""
    if not wrapped(rows) and bool(rows.any()):
        raise InputError.of(f"row {int(rows.nonzero()[0])} {what}", fix=fix)


def least_squares(matrix: Tensor, target: Tensor) -> Tensor:
    """Least squares with columns of equal size, small directions left at zero."""
    scale = matrix.square().mean(0).sqrt().clamp(min=SMALLEST_M)
    scaled = torch.linalg.lstsq(matrix / scale, target[:, None], rcond=1e-4, driver="gelsd").solution[:, 0]
    return scaled / scale


def median_weights(distances: Tensor, half: float) -> Tensor:
    """Weights (N,) of rows by their distances (N,), m, half at some medians: 1 / (1 + (d / (half median))^2)."""
    return 1.0 / (1.0 + (distances / (half * distances.median().clamp(min=SMALLEST_MEDIAN_M))).square())


def across(directions: Tensor) -> Tensor:
    """Two unit vectors at right angles to each direction and to each other: (..., 3) -> (..., 2, 3)."""
    return torch.linalg.svd(directions[..., None, :], full_matrices=True).Vh[..., 1:, :]


def moved_pose(rows: Tensor, twist: Tensor) -> Tensor:
    """The rows (..., 12) of a transform after a shift and a turn (..., 6) in the frame that it leads to, m and rad."""
    turn, shift = torch.linalg.matrix_exp(skew(twist[..., 3:])), torch.nn.functional.pad(twist[..., :3, None], (3, 0))
    return (turn @ rows.unflatten(-1, (3, 4)) + shift).flatten(-2)
