"""Devices in unknown places: what their rows share, and what a fit says about them.

What is not known of a device is an error that all its rows share, with a prior: noise R = blockdiag(R_i) + Z Z^T, whose
columns Z are the effects of shifts c ~ N(0, I). After the fit their posterior is

    c = Z^T R^-1 (y - h(k1)),    cov(c) = (1 + Z^T (G + blockdiag(R_i))^-1 Z)^-1.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.result import Fit
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.sensors.devices import Extrinsics, Hypothesis
from diffeo_calib.sensors.set_ups import SetUps
from diffeo_calib.sensors.tables import Coordinates, OtherReadings

S = TypeVar("S", bound="DeviceSet")
T = TypeVar("T")


class Seen(Protocol):
    """N rows around a map, as sets of devices see them: of a calibration around k0, new ones around an old model."""

    @property
    def nominal(self) -> GeometryMap: ...  # k0
    @property
    def y(self) -> Tensor: ...  # (N, R) m
    @property
    def points(self) -> Tensor: ...  # (N, 3 P) of the map, m
    @property
    def slopes(self) -> Tensor: ...  # (N, R, 3 P) of what was measured
    @property
    def by_tool(self) -> Tensor: ...  # (N, R, 3 P) derivatives by the places of the points on their tips


class OtherRows(NamedTuple):
    """Rows of devices that are known, as they were measured."""

    data: Any  # all of them
    coordinates: Coordinates | None  # those that tell coordinates
    aligned: Coordinates | None  # the same in the frame of the model
    readings: list[OtherReadings]  # the others, by kind
    centre: Tensor  # (3,) the middle of the rows with which the devices were found, m


class Settled(NamedTuple):
    """Result of a fit for the shifts of one set of devices."""

    shifts: Tensor  # (c,) their posterior mean
    covariance: Tensor  # (c, c)
    fitted: FittedMap  # the map, its covariances without rigid motions if no device holds the frame
    # (3,) the middle of the rows, m, in the frame of the devices, from which transform (4, 4) leads to that of the
    # model
    centre: Tensor
    transform: Tensor
    known: SetUps | None = None  # what the old model knew of the tool in each set-up; None of a calibration


@dataclass(frozen=True, eq=False)
class DeviceSet(ABC):
    """Devices of one kind in a calibration."""

    size_advice: ClassVar[str] = ""
    """What would make the robot's size better known; nothing where these devices have a size of their own."""
    # where they are, and their rows; before a fit the deviations of their increments are those of the prior
    devices: Extrinsics

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the devices."""
        return self.devices.names

    @property
    def rows(self) -> Tensor:
        """(M,) numbers of the rows that they measured."""
        return self.devices.rows

    @property
    def device(self) -> Tensor:
        """(M,) which of them did."""
        return self.devices.device

    def by_row(self, count: int) -> Tensor:
        """(N,) numbers of the devices of all rows, -1 for rows of none."""
        numbers = torch.full((count,), NO_SOCKET, dtype=torch.int64, device=HOST)
        numbers[self.rows] = self.device
        return numbers

    def of_rows(self: S, rows: Tensor) -> S:
        """Renumber the rows: ``rows`` (M,) are their numbers in a larger table."""
        return self.measuring(rows[self.rows], self.device)

    def measuring(self: S, rows: Tensor, device: Tensor) -> S:
        """Give the devices other rows (M,), each measured by one of them."""
        return replace(self, devices=replace(self.devices, rows=rows, device=device))

    @abstractmethod
    def effects(self, data: Seen) -> Tensor:
        """Uncertainty of the devices, as effects of unit variance that rows share: (N, R, c), m."""

    def settled(self: S, fit: Settled) -> S:
        """The devices where a fit puts them."""
        return self

    @abstractmethod
    def with_rows(self: S, other: OtherRows) -> S:
        """Replace the rows of the devices; MeasurementError for other devices."""

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:  # noqa: B027
        """Warn (DiffeoCalibWarning) of what these devices leave open in a model, and of what would show it."""

    def hypotheses(self, data: Seen) -> Iterable[Hypothesis]:
        """What of these devices may change during the measurements, or be wrong, with effects (N, R, U) on all rows."""
        return ()

    @property
    def bodies(self) -> Mapping[str, str]:
        """Better names of what stands, and of what is on the tool, than those of diagnostics/hypotheses.py."""
        return {}

    def elsewhere(self, row: int, points: Tensor, devices: Placement) -> Elsewhere:
        """A row of the table at other points (M, P, 3) of the model, m, as far as these of all devices measured it."""
        return Elsewhere(torch.ones(len(points), dtype=torch.bool, device=points.device), points.new_zeros(0, 3))

    def sentences(self) -> list[str]:
        """Where the devices are."""
        return self.devices.sentences()

    def entry(self) -> dict[str, Any]:
        """Where the devices are, for programs, in m and rad."""
        return {}


class Placement(tuple[DeviceSet, ...]):
    """The devices of a calibration, a set of each kind."""

    def one(self, kind: type[S]) -> S | None:
        """The first set of a kind; None without one."""
        return next((part for part in self if isinstance(part, kind)), None)

    def hypotheses(self, data: Seen, about: str) -> list[Hypothesis]:
        """Hypotheses about a subject of :class:`Hypothesis`: what devices are said to hold, or what may change."""
        return [hypothesis for part in self for hypothesis in part.hypotheses(data) if hypothesis.about == about]

    @property
    def bodies(self) -> Mapping[str, str]:
        """See :attr:`DeviceSet.bodies`."""
        return {name: words for part in self for name, words in part.bodies.items()}

    def shared(self, data: Seen) -> Tensor:
        """Effects of all devices, side by side: (N, R, c)."""
        return torch.cat([data.y.new_zeros(*data.y.shape, 0), *(part.effects(data) for part in self)], 2)

    def settled(self, fitted: Fit, around: FittedMap, data: Seen, transform: Tensor, **known: Any) -> Placement:
        """Move the devices to where a fit puts them; its last shifts are theirs."""
        sets, shifts, sizes = list[DeviceSet](), fitted.shifts, [devices.effects(data).shape[2] for devices in self]
        centre = data.points.unflatten(1, (-1, 3)).mean((0, 1))
        first, numbers = len(around.geodesic.spec.prior_variance), torch.arange(len(shifts), device=shifts.device)
        whole = around.parameter_covariance(first + numbers) if len(shifts) else shifts[:, None]  # after those of k0
        for devices, part in zip(self, numbers[len(shifts) - sum(sizes) :].split(sizes), strict=True):
            covariance = whole[part[:, None], part]
            sets.append(devices.settled(Settled(shifts[part], covariance, around, centre, transform, **known)))
        return Placement(sets)

    def aligned(self, data: T) -> T:
        """Measured positions in the frame of the model; unchanged where one set-up measured all."""
        for part in self:
            data = part.devices.aligned(data)
        return data

    def sentences(self) -> list[str]:
        return [line for part in self for line in part.sentences()]

    def entry(self) -> dict[str, Any]:
        entries: dict[str, Any] = {}
        for name, entry in (item for part in self for item in part.entry().items()):
            before = entries.get(name, {})  # of devices of another kind
            entries[name] = entry | {key: before[key] | entry[key] for key in before}
        return entries

    def placed(self) -> tuple[Extrinsics, ...]:
        """What a model keeps of all devices."""
        return tuple(part.devices for part in self if part.names)


class Elsewhere(NamedTuple):
    """A row as some devices would measure it at M other configurations."""

    there: Tensor  # (M,) boolean, where they can
    places: Tensor  # (D, 3) in the measuring frame, m, to which it has to bring the ball; none for anywhere
    changed: Callable[[Any], Any] = lambda copies: copies  # of a table, copies of the row at these joint values
