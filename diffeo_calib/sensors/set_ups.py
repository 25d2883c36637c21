"""Set-ups between which the device was moved, or what is on the tool: measuring frames, markers, several cameras.

A model holds the measuring frame and the tool of one set-up. With the pose K of the tip and its markers p, or the frame
X on the tool, the rows of another set-up show T K p (the device was moved), K (p + d) (markers were mounted anew), or
K X M (several cameras on the tool).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, few, listed
from diffeo_calib.common.quantiles import largest_known
from diffeo_calib.measurements.checks import numbers_of, rare_names
from diffeo_calib.measurements.poses import angle_between, frames_of_points, poses_from_marks, poses_of_triangles
from diffeo_calib.measurements.rows import NO_SOCKET, with_attributes
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES, rigid_fit
from diffeo_calib.robots.se3 import nearest_rotations, skew, transforms, twist_transform
from diffeo_calib.sensors.devices import Extrinsics

if TYPE_CHECKING:
    from typing_extensions import Self

FEWEST_ROWS = 4  # rows of a session from which its frame, or what is on the tool, is found
GROSS_DISTANCES = 10.0  # rows that are farther than this many median distances take no part
ROUNDS = 3
SESSION, MOUNTING, MOUNTED_FRAME = "session", "mounting", "mounted frame"  # kinds of what a model keeps of them
NUMBERS_OF_A_FRAME = 6
ROWS = "these rows"  # name of the set-up of rows that name none
View = Callable[[Tensor], Tensor]
"""Poses (M, 4, 4) of a model's tool in its measuring frame -> those that a set-up measures, m."""
Turns = Callable[[Tensor], Tensor]
"""Joint values (N, n) -> (N, P', 3, 3) turns of the tips that carry a model's points, P' >= the markers P."""


@dataclass(frozen=True, eq=False)
class SetUps(Extrinsics):
    """What differs between some set-ups and that of a model.

    Args:
        turns: of the tips; None for kinematics that do not tell.
        increments_each: numbers of a set-up that a fit leaves open.
    """

    set_up = True
    shape: ClassVar[tuple[int, int]] = (4, 4)
    """Of the constants of one."""
    key: ClassVar[str] = "mountings"
    """Of their entry in results of the command line."""
    what: ClassVar[str]
    unit: ClassVar[float] = PLACES.session_m_rad
    """Prior deviation of an increment in a fit, m or rad."""
    turns: Turns | None = None
    increments_each: int = 0

    @classmethod
    @abstractmethod
    def of(cls, predicted: Tensor, data: Measurements, turns: Turns | None) -> Self:
        """The set-ups of some rows where these fit points (N, P, 3) of the model best, m.

        Raises:
            MeasurementError: no sessions, or fewer than 4 rows in one.
        """

    @classmethod
    def among(cls, devices: Mapping[str, Any], turns: Turns | None) -> Self:
        """Set-ups of this kind among the devices that a model knows, by kind."""
        none = torch.zeros(0, 0, dtype=torch.float64, device=HOST)
        return replace(devices.get(cls.kind, cls((), none, none)), turns=turns)

    @abstractmethod
    def aligned(self, data: Any) -> Any:
        """Also rows that name no set-up; MeasurementError for rows of one that is not known."""

    @abstractmethod
    def increments(self, points: Tensor, slopes: Tensor, by_tool: Tensor, centre: Tensor) -> Tensor:
        """What increments with their prior deviations do to R numbers of N rows: (N, R, k).

        Args:
            points: (N, P, 3) of the model's tool, m. slopes: (N, R, 3 P) of the numbers by these; None for coordinates.
            by_tool: (N, R, 3 P) the same by the points' places on the tool. centre: (3,) about which frames turn, m.
        """

    @abstractmethod
    def stepped(self, constants: Tensor, steps: Tensor, centre: Tensor, T: Tensor) -> Tensor:
        """Constants (T, c) after increments (T, k), m and rad, as of :meth:`moved`."""

    @abstractmethod
    def sentence(self, number: int) -> str:
        """What is known of a set-up."""

    def in_any_frame(self, data: Measurements) -> Measurements:
        """Rows of known set-ups as those of the model's tool, under their names, wherever the device stands now."""
        return data

    def after(self, old: SetUps) -> Self:
        """Set-ups that were found in rows that :meth:`in_any_frame` of others had changed."""
        return self

    @property
    def same(self) -> Tensor:
        """(c,) constants of the model's own set-up."""
        return torch.eye(4, dtype=self.constants.dtype, device=self.constants.device).flatten()

    @property
    def elsewhere(self) -> Tensor:
        """(S,) boolean: the set-ups but the model's."""
        return (self.constants != self.same).any(1)

    def view(self, number: int, poses: Tensor) -> Tensor:
        """What a set-up sees of poses (M, 4, 4) of the model, m; the same where markers were mounted anew."""
        return poses

    def moved(self, others: Sequence[int], steps: Tensor, std: Tensor, centre: Tensor, T: Tensor) -> Self:
        """Some set-ups (T,) after increments (T, k), in prior deviations, and with their deviations.

        Frames turn about a centre (3,), m, in a frame from which T (4, 4) leads to that of the model.
        """
        constants, deviations = self.constants.clone(), self.deviations.clone()
        constants[others] = self.stepped(constants[others], self.unit * steps, centre, T)
        deviations[others] = self.unit * std
        return replace(self, constants=constants, deviations=deviations)

    def with_reference(self, reference: int) -> Self:
        """Make one of them the model's."""
        mask = torch.arange(len(self.names), device=HOST)[:, None] == reference
        constants, deviations = torch.where(mask, self.same, self.constants), self.deviations.masked_fill(mask, 0.0)
        return replace(self, constants=constants, deviations=deviations)

    @property
    def fitted_numbers(self) -> int:
        """How many numbers these set-ups took, if they were found from the rows that are judged."""
        return len(self.names) * (self.deviations.shape[1] or NUMBERS_OF_A_FRAME)

    def sentences(self) -> list[str]:
        """What is known of every set-up but the model's."""
        return [self.sentence(number) for number in self.elsewhere.nonzero()[:, 0].tolist()]

    def found_sentences(self) -> list[str]:
        """That these set-ups were found from the rows that are judged, and what is known of them."""
        count = len(self.names)
        what = f"the {self.what} of {'one session' if count == 1 else f'{count} sessions'} were found from these rows"
        line = f"{what}, {self.fitted_numbers} numbers in all: with few rows the errors look smaller than they are"
        return [line, *map(self.sentence, range(count))]

    def entry(self) -> dict[str, object]:
        """Constants by name, for programs."""
        return dict(zip(self.names, self.constants.unflatten(1, self.shape).tolist(), strict=True))

    def of_rows(self, data: Measurements) -> Tensor:
        """(N, c) the constants of every row."""
        return torch.cat([self.constants, self.same[None]])[self.numbers(data)].to(data.points)

    def numbers(self, data: Any) -> Tensor:
        """(N,) number here of each row's set-up, -1 for none; MeasurementError for one that is not known."""
        names, named = data.device_names, ["" if name == ROWS else name for name in self.names]
        if data.session is None and named != [""]:
            raise MeasurementError.of("the measurements have no sessions", fix="pass data.with_sessions(names)")
        unknown = [name for name in dict.fromkeys(names) if name and name not in named]
        if unknown:
            fix = "register the model with rows of the new set-up"
            raise MeasurementError.of(f"the sessions {unknown}", expected=f"some of {listed(self.names)}", fix=fix)
        return numbers_of(names, named)


@dataclass(frozen=True, eq=False)
class MeasuringFrames(SetUps):
    """Measuring frames: constants are the transforms T (16) from that of the model, of unknown deviations."""

    kind, key, what = SESSION, "sessions", "frames"

    @classmethod
    def of(cls, predicted: Tensor, data: Measurements, turns: Turns | None) -> MeasuringFrames:
        """The markers stay; points may have a ball as one more."""
        names, session = sessions_of(data)
        predicted = predicted[:, : data.markers]
        check_same_markers(predicted, data.points)
        rows = [(session == place).to(predicted.device) for place in range(len(names))]
        frames = torch.stack([robust_fit(predicted[some], data.points[some]).to(HOST) for some in rows]).flatten(1)
        cameras = set(data.session_names) <= set(data.cameras)  # nothing on the tool was mounted again between these
        free = NUMBERS_OF_A_FRAME + 3 * data.markers * (not cameras)
        return cls(names, frames, frames[:, :0], turns=turns, increments_each=free)

    def aligned(self, data: Any) -> Any:
        return data.in_frames(torch.linalg.inv(self.of_rows(data).unflatten(1, (4, 4))))

    def increments(self, points: Tensor, slopes: Tensor, by_tool: Tensor, centre: Tensor) -> Tensor:
        """What is left of the differences between the frames, and markers mounted again."""
        frame = slopes @ (self.unit * frame_slopes(points, centre))
        return torch.cat([frame, PLACES.remounted_m * by_tool], 2)[..., : self.increments_each]

    def stepped(self, constants: Tensor, steps: Tensor, centre: Tensor, T: Tensor) -> Tensor:
        step = twist_transform(steps[:, :NUMBERS_OF_A_FRAME])
        step[:, :3, 3] += centre - step[:, :3, :3] @ centre
        return (constants.unflatten(1, (4, 4)) @ T @ step @ torch.linalg.inv(T)).flatten(1)

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        return (self.constants.unflatten(1, (4, 4)) @ torch.linalg.inv(T)).flatten(1)

    def view(self, number: int, poses: Tensor) -> Tensor:
        return self.constants[number].view(4, 4) @ poses

    def sentence(self, number: int) -> str:
        shift, turn = _size(self.constants[number])
        away = f"{1e3 * shift:.4g} mm and {1e3 * turn:.4g} mrad away from that of the model"
        return f"session '{self.names[number]}': its frame is {away}"


@dataclass(frozen=True, eq=False)
class MountedMarkers(SetUps):
    """Markers: constants are their shifts (3 P) from those of the model, in the frames of their tips, m."""

    kind, shape, what, unit = MOUNTING, (-1, 3), "markers", PLACES.remounted_m

    @classmethod
    def of(cls, predicted: Tensor, data: Measurements, turns: Turns | None) -> MountedMarkers:
        names, whose = sessions_of(data)
        P = min(data.markers, predicted.shape[1])
        away = _turned(turns, data)[:, :P].mT @ (data.points[:, :P] - predicted[:, :P])[..., None]
        middles = [_middle(away[whose == number][..., 0]) for number in range(len(names))]
        shifts, deviations = (torch.stack(each).flatten(1).to(HOST) for each in zip(*middles, strict=True))
        return cls(names, shifts, deviations, turns=turns, increments_each=3 * data.markers)

    def aligned(self, data: Any) -> Any:
        shifts = self.of_rows(data).unflatten(1, (-1, 3))
        return data.shifted(-(_turned(self.turns, data)[:, : shifts.shape[1]] @ shifts[..., None])[..., 0])

    def increments(self, points: Tensor, slopes: Tensor, by_tool: Tensor, centre: Tensor) -> Tensor:
        return self.unit * by_tool

    def stepped(self, constants: Tensor, steps: Tensor, centre: Tensor, T: Tensor) -> Tensor:
        return constants + steps

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        return self.constants + markers.flatten()[: self.constants.shape[1]]

    def sentence(self, number: int) -> str:
        shift, std = (values[number].view(-1, 3) for values in (self.constants, self.deviations))
        sizes = zip((1e3 * shift.norm(dim=1)).tolist(), (1e3 * std.norm(dim=1) / 3**0.5).tolist(), strict=True)
        each = zip(sizes, seen_mounted(std).tolist(), strict=True)
        text = ", ".join(f"{size:.3f} +- {spread:.3f} mm" if shown else "not seen" for (size, spread), shown in each)
        markers = "markers are" if len(shift) > 1 else "marker is"
        return f"session '{self.names[number]}': its {markers} {text} away from that of the model"

    @property
    def same(self) -> Tensor:
        return self.constants.new_zeros(self.constants.shape[1])


@dataclass(frozen=True, eq=False)
class MountedFrames(SetUps):
    """Measured frames, as of several cameras: constants are the transforms M (16), their increments X exp(e) M."""

    kind, what = MOUNTED_FRAME, "frames on the tool"

    @classmethod
    def of(cls, predicted: Tensor, data: Measurements, turns: Turns | None) -> MountedFrames:
        names, whose = sessions_of(data)
        lever = data.bodies.pose_lever()
        X = frames_of_points(predicted[:, :3], lever)[:, 0]
        places = (data.points - X[:, None, :3, 3]) @ X[:, :3, :3]  # in the frame of the model's tool
        middles = [_middle(places[whose == number]) for number in range(len(names))]
        points, deviations = (torch.stack(each).to(HOST) for each in zip(*middles, strict=True))
        shifts = deviations.square().mean(1).sqrt()
        M = poses_from_marks(points, lever).flatten(1)
        free = {"turns": turns, "increments_each": NUMBERS_OF_A_FRAME}
        return cls(names, M, torch.cat([shifts, shifts / lever], 1), **free)

    def aligned(self, data: Any) -> Any:
        return data.on_frames(self.of_rows(data).unflatten(1, (4, 4)))

    def increments(self, points: Tensor, slopes: Tensor, by_tool: Tensor, centre: Tensor) -> Tensor:
        steps = self.unit * own_slopes(points[:, :3])
        return slopes[..., : steps.shape[1]] @ steps

    def in_any_frame(self, data: Measurements) -> Measurements:
        if not data.remounted or not set(data.device_names) <= {*self.names, ""}:
            return data
        names = {"session": data.session, "session_names": data.session_names, "remounted": True}
        return with_attributes(self.aligned(data), **names)

    def after(self, old: SetUps) -> MountedFrames:
        if not set(self.names) <= set(old.names):
            return self
        index = [old.names.index(name) for name in self.names]
        M, before = (each.unflatten(1, (4, 4)) for each in (self.constants, old.constants[index]))
        here = (self.deviations == 0).all(1, keepdim=True)  # the reference is where it was before
        deviations = torch.where(here, old.deviations[index], self.deviations)
        return replace(self, constants=(M @ before).flatten(1), deviations=deviations)

    def stepped(self, constants: Tensor, steps: Tensor, centre: Tensor, T: Tensor) -> Tensor:
        return (twist_transform(steps) @ constants.unflatten(1, (4, 4))).flatten(1)

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        old, new = (poses_of_triangles(points[:, :3]) for points in (before, after))
        change = torch.linalg.inv(new) @ T @ old
        mean = transforms(nearest_rotations(change[:, :3, :3].mean(0)), change[:, :3, 3].mean(0))
        return (mean @ self.constants.unflatten(1, (4, 4))).flatten(1)

    def view(self, number: int, poses: Tensor) -> Tensor:
        return poses @ self.constants[number].view(4, 4)

    def sentence(self, number: int) -> str:
        shift, turn = _size(self.constants[number])
        spread, degrees = 1e3 * float(self.deviations[number, :3].norm()), turn * 180.0 / torch.pi
        away = f"{1e3 * shift:.3f} +- {spread:.3f} mm and {degrees:.3f} degrees away on the tool from the model's"
        return f"'{self.names[number]}' is {away}"


TRANSFORMS = SESSION, MOUNTED_FRAME  # kinds whose constants are transforms


def set_up_kind(data: Measurements) -> type[SetUps]:
    """What differs between the set-ups of rows."""
    return mounted_kind(data.lever) if data.remounted else MeasuringFrames


def mounted_kind(lever: float | None) -> type[SetUps]:
    """What is mounted on a tool: markers, or frames, whose points are at the distance ``lever``, m."""
    return MountedMarkers if lever is None else MountedFrames


def check_same_markers(points: Tensor, measured: Tensor) -> None:
    """Raise InputError for points (N, P, 3) of other markers than those that were measured."""
    if points.shape != measured.shape:
        raise InputError.of(
            "the model and the measurements do not have the same markers",
            expected=f"predictions of shape {tuple(measured.shape)}",
            got=tuple(points.shape),
            fix="evaluate on the markers that the model was calibrated with, in the same order",
        )


def robust_fit(points: Tensor, measured: Tensor) -> Tensor:
    """The rigid transform (4, 4) from seen to measured points (N, P, 3) by the rows that are no gross outliers, m."""
    inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
    T = torch.eye(4, dtype=points.dtype, device=points.device)
    for _ in range(ROUNDS):
        T = rigid_fit(points[inside].flatten(0, 1), measured[inside].flatten(0, 1))
        away = largest_known((points @ T[:3, :3].mT + T[:3, 3] - measured).norm(dim=-1))
        inside = away <= GROSS_DISTANCES * away.nanmedian()
    return T


def frame_slopes(points: Tensor, centre: Tensor) -> Tensor:
    """Derivatives of points by a shift and a small turn about a centre: (N, P, 3), (3,) -> (N, 3 P, 6)."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*points.shape[:2], 3, 3)
    return torch.cat([eye, -skew(points - centre)], dim=-1).flatten(1, 2)


def own_slopes(points: Tensor) -> Tensor:
    """Derivatives (N, 9, 6) of the three points (N, 3, 3) of frames by a shift and a turn along their own axes."""
    R, arms = poses_of_triangles(points)[:, None, :3, :3], points - points.mean(1, keepdim=True)
    turned = R @ -skew((arms[..., None, :] @ R)[..., 0, :])
    return torch.cat([R.expand_as(turned), turned], 3).flatten(1, 2)


def _turned(turns: Turns | None, data: Measurements) -> Tensor:
    """(N, P', 3, 3) turns of the tips; InputError for kinematics that do not tell."""
    if turns is None:
        what = "rows whose markers were mounted anew"
        raise InputError.of(what, expected="a calibrated model to compare them with", got="other kinematics")
    return turns(data.q)


def _size(constants: Tensor) -> tuple[float, float]:
    """Shift, m, and turn, rad, of a transform (16,)."""
    T = constants.view(4, 4)
    return float(T[:3, 3].norm()), float(angle_between(torch.eye(3, dtype=T.dtype, device=T.device), T[:3, :3]))


def _middle(away: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (P, 3) of points (M, P, 3) but for gross outliers, and its standard deviations; zero of hidden markers."""
    middle = away.nanmedian(0).values
    size = (away - middle).norm(dim=2)
    kept = torch.where((size <= GROSS_DISTANCES * size.nanmedian(0).values)[..., None], away, torch.nan)
    count = (~kept.isnan()).sum(0).clamp(min=1)
    mean = kept.nanmean(0).nan_to_num(0.0)
    return mean, ((kept - mean).square().nanmean(0).sqrt() / count.sqrt()).nan_to_num(PLACES.remounted_m)


def seen_mounted(deviations: Tensor) -> Tensor:
    """(..., P) boolean: markers that rows of their session showed, by the deviations (..., P, 3) of their places, m."""
    return deviations.amax(-1) < 0.5 * PLACES.remounted_m


def sessions_of(data: Measurements) -> tuple[tuple[str, ...], Tensor]:
    """Names of the sessions of some rows, and (N,) the number of each row's, -1 for none.

    Raises:
        MeasurementError: no sessions, or fewer than 4 rows in one.
    """
    if data.session is None:
        raise MeasurementError.of("the measurements have no sessions", fix="pass data.with_sessions(names)")
    present = data.session[data.session != NO_SOCKET].unique().tolist()
    session, names = torch.full_like(data.session, NO_SOCKET), tuple(data.session_names[number] for number in present)
    for place, (number, name) in enumerate(zip(present, names, strict=True)):
        rows = data.session == number
        session[rows] = place
        if int(rows.sum()) < FEWEST_ROWS:
            fix = "check the name in these rows, measure more rows in it, or leave it out"
            got = few(rare_names(data.device_names, data.line_numbers.tolist(), FEWEST_ROWS))
            raise MeasurementError.of(f"session '{name}'", expected=f"{FEWEST_ROWS} rows", got=got, fix=fix)
    return names, session
