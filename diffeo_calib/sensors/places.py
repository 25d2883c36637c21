"""Where devices stand beside a model: measuring frames of set-ups, and devices of readings, placed on judged rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.common.hidden_values import largest_known
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.sensors.devices import Devices, check_devices
from diffeo_calib.sensors.kinds import kind_of

FEWEST_ROWS = 4
"""Rows of a session from which its frame is found."""
NUMBERS_OF_A_FRAME = 6
GROSS_DISTANCES = 10.0
"""Rows that are farther than this many median distances take no part in finding a frame."""
ROUNDS = 3

ROWS = "these rows"
"""Name of the set-up of rows that name none."""
BALL_IS_THE_MARKER = (
    "the model was calibrated without a measuring device: the frame of these positions was found from them, 6 numbers, "
    "as if the marker were the ball; if it is another one, register the model first (`model.registered`, evaluate "
    "--register)"
)


@dataclass(frozen=True, eq=False)
class SessionPlaces:
    """Where the measuring frames of some sessions are.

    Args:
        names: S sessions. transforms: (S, 4, 4) from the model's measuring frame to theirs, m.
    """

    names: tuple[str, ...]
    transforms: Tensor

    def aligned(self, data: Measurements) -> Measurements:
        """Rows of these sessions in the frame of the model; rows that name no session are those of the only one."""
        names = [name or self.names[0] for name in data.device_names]
        T = torch.linalg.inv(self.transforms)[[self.names.index(name) for name in names]]
        return data.in_frames(T.to(data.points.device))

    @property
    def fitted_numbers(self) -> int:
        """How many numbers were found from these rows."""
        return NUMBERS_OF_A_FRAME * len(self.names)

    def entry(self) -> dict[str, object]:
        """Transforms by name, for programs."""
        return dict(zip(self.names, self.transforms.tolist(), strict=True))

    def sentences(self) -> list[str]:
        """What was fitted, and how far every session's frame is from that of the model."""
        one = len(self.names) == 1
        whose = "the frame of the one session" if one else f"the frames of {len(self.names)} sessions"
        lines = [f"{whose} {'was' if one else 'were'} found from these rows, {self.fitted_numbers} numbers in all:"]
        lines[0] += " errors of few rows flatter"
        for name, T in zip(self.names, self.transforms, strict=True):
            turn = float(torch.arccos(((T[:3, :3].trace() - 1) / 2).clamp(-1, 1)))
            away = f"{1e3 * float(T[:3, 3].norm()):.4g} mm and {1e3 * turn:.4g} mrad away"
            lines.append(f"session '{name}': its frame is {away} from that of the model")
        return lines


def place_sessions(predicted: Tensor, data: Measurements) -> SessionPlaces:
    """Place every session of some measurements where its rows fit a model best; its markers stay.

    Args:
        predicted: (N, P, 3) markers in the frame of the model, m, perhaps with a ball as one more.
        data: N rows with sessions.

    Raises:
        MeasurementError: no sessions, or fewer than 4 rows in one.
    """
    if data.session is None:
        raise MeasurementError.of("the measurements have no sessions", fix="pass data.with_sessions(names)")
    present = data.session[data.session != NO_SOCKET].unique().tolist()
    own, names = torch.full_like(data.session, NO_SOCKET), tuple(data.session_names[number] for number in present)
    for place, number in enumerate(present):
        own[data.session == number] = place
    check_rows_of_sessions(own, names)
    predicted = predicted[:, : data.markers]
    rows = [(own == place).to(predicted.device) for place in range(len(names))]
    found = [robust_fit(predicted[some], data.points[some]).to(HOST) for some in rows]
    return SessionPlaces(names, torch.stack(found))


def check_rows_of_sessions(session: Tensor, names: tuple[str, ...]) -> None:
    """Raise MeasurementError for a session of too few rows: (N,) their numbers, -1 for none, and names."""
    counts = torch.bincount(session[session != NO_SOCKET], minlength=len(names))
    for name, count in zip(names, counts.tolist(), strict=True):
        if count < FEWEST_ROWS:
            fix = "measure more rows in it, or leave it out"
            raise MeasurementError.of(f"session '{name}'", expected=f"{FEWEST_ROWS} rows", got=count, fix=fix)


def robust_fit(seen: Tensor, measured: Tensor) -> Tensor:
    """The rigid transform (4, 4) from seen to measured points (N, P, 3) by the rows that are no gross outliers, m."""
    inside = torch.ones(len(seen), dtype=torch.bool, device=seen.device)
    T = torch.eye(4, dtype=seen.dtype, device=seen.device)
    for _ in range(ROUNDS):
        T = rigid_fit(seen[inside].flatten(0, 1), measured[inside].flatten(0, 1))
        away = largest_known((seen @ T[:3, :3].mT + T[:3, 3] - measured).norm(dim=-1))
        inside = away <= GROSS_DISTANCES * away.nanmedian()
    return T


@dataclass(frozen=True)
class Places:
    """Devices beside a model.

    Args:
        frames: of the set-ups of measured positions; None where these are in the frame of the model.
        devices: those of readings, see :func:`sensor_key`.
        ball: whether the last marker is a ball that no device of positions measures.
        found: what was found from the rows that are judged, in sentences. numbers: how many numbers that took.
    """

    frames: Any = None
    devices: Mapping[object, Devices] = field(default_factory=dict)
    ball: bool = False
    found: tuple[str, ...] = ()
    numbers: int = 0

    def aligned(self, data: Any) -> Any:
        """Measured positions in the frame of the model."""
        return data if self.frames is None else self.frames.aligned(data)

    def beside(self, other: Places) -> Places:
        """Both of them."""
        devices, found = {**self.devices, **other.devices}, (*self.found, *other.found)
        frames, ball = self.frames or other.frames, self.ball or other.ball
        return Places(frames, devices, ball, found, self.numbers + other.numbers)


def sensor_key(data: Readings) -> object:
    """What readings of the same kind of devices have in common."""
    return data.kind, data.offset_std, data.intrinsics


def fitting_devices(data: Readings, points: Tensor) -> Devices:
    """The devices where they fit readings best, for known points (N, P, 3) of the tool, m."""
    kind = kind_of(data)
    seen = kind.points_of(points)
    return kind.at(data, seen).refined(data, seen)


def placed(data: Readings, points: Tensor) -> Devices:
    """The same for rows that a user passes.

    Raises:
        MeasurementError: too few rows of a device, or readings that no place of it explains.
    """
    check_devices(data)
    try:
        return fitting_devices(data, points)
    except InputError as error:  # the ball at a fixed point or behind a camera
        fix = "check the columns of the readings, their unit, and which device each row names"
        raise MeasurementError.of(f"no place of the devices explains the readings ({error})", fix=fix) from None
