"""What is on the tool in several set-ups of one measuring frame: markers mounted anew, or several cameras on the tool.

A model holds the markers, or the measured frame, of one set-up. Those of another one are shifted markers p + d, or a
frame X M, X that of the model: with the pose K of the tip, its rows show K (p + d), or K X M.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.measurements.pose_frames import frames_of_points
from diffeo_calib.measurements.poses import poses_from_marks, poses_of_triangles
from diffeo_calib.measurements.rare_names import rare_names
from diffeo_calib.measurements.rows import NO_SOCKET, with_attributes
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import nearest_rotations, skew, transforms, twist_transform

if TYPE_CHECKING:
    from typing_extensions import Self

FEWEST_ROWS = 4
"""Rows of a session from which its frame, or what is on the tool, is found."""
GROSS_DISTANCES = 10.0
"""Rows that are farther than this many median distances take no part."""
MOUNTING, MOUNTED_FRAME = "mounting", "mounted frame"
"""Kinds of what a model keeps of them."""
View = Callable[[Tensor], Tensor]
"""Poses (M, 4, 4) of a model's tool in its measuring frame -> those that a set-up measures, m."""
Turns = Callable[[Tensor], Tensor]
"""Joint values (N, n) -> (N, P', 3, 3) turns of the tips that carry a model's points, P' >= the markers P."""


@dataclass(frozen=True, eq=False)
class Mounted(ABC):
    """What is on the tool in some set-ups of one measuring frame.

    Args:
        names: S set-ups. constants: (S, c). deviations: (S, k) of increments of these, m and rad.
        turns: of the tips.
        new: names of the set-ups that were found from the rows that are judged.
    """

    kind: ClassVar[str]
    shape: ClassVar[tuple[int, int]]
    """Of the constants of one."""
    names: tuple[str, ...]
    constants: Tensor
    deviations: Tensor
    turns: Turns
    new: tuple[str, ...] = ()

    @classmethod
    @abstractmethod
    def of(cls, predicted: Tensor, data: Measurements, turns: Turns) -> Self:
        """The set-ups of some rows where these fit points (N, P, 3) of the model's tool best, m."""

    @abstractmethod
    def aligned(self, data: Measurements) -> Measurements:
        """Rows of these set-ups as those of the model's tool; so are rows that name no set-up."""

    @staticmethod
    @abstractmethod
    def increments(points: Tensor, slopes: Tensor | None, by_tool: Tensor) -> Tensor:
        """What increments with their prior deviations do to R numbers of N rows: (N, R, k).

        Args:
            points: (N, P, 3) of the model's tool, m. slopes: (N, R, 3 P) of the numbers by these; None for coordinates.
            by_tool: (N, R, 3 P) the same by the points' places on the tool.
        """

    def in_any_frame(self, data: Measurements) -> Measurements:
        """Rows of known set-ups as those of the model's tool, under their names, wherever the device stands now."""
        return data

    def after(self, known: Mounted) -> Self:
        """These, found in rows that :meth:`in_any_frame` of others had changed."""
        return self

    @abstractmethod
    def moved(self, others: Sequence[int], steps: Tensor, covariance: Tensor) -> Self:
        """Some set-ups (T,) after increments (T, k), in prior deviations, that are known to a covariance (T k, T k)."""

    @abstractmethod
    def sentences_of_each(self) -> list[str]:
        """What is known of every set-up but the model's."""

    @property
    @abstractmethod
    def same(self) -> Tensor:
        """(c,) constants of the model's own set-up."""

    def views(self) -> list[View]:
        """How each set-up sees poses of the model; as the model where markers were mounted anew."""
        return [lambda poses: poses for _ in self.names]

    def with_reference(self, reference: int) -> Self:
        """The same, one of them the model's."""
        own = torch.arange(len(self.names), device=HOST)[:, None] == reference
        return replace(
            self,
            constants=torch.where(own, self.same, self.constants),
            deviations=self.deviations.masked_fill(own, 0.0),
            new=(),
        )

    def beside(self, other: Self) -> Self:
        """These, and those of other names, found from the rows that are judged."""
        new = [number for number, name in enumerate(other.names) if name not in self.names]
        names = tuple(other.names[number] for number in new)
        values = ((getattr(one, k) for one in (self, other)) for k in ("constants", "deviations"))
        constants, deviations = (torch.cat([own, theirs[new]]) for own, theirs in values)
        return replace(self, names=(*self.names, *names), constants=constants, deviations=deviations, new=names)

    @property
    def fitted_numbers(self) -> int:
        """How many numbers were found from the rows that are judged."""
        return len(self.new) * self.deviations.shape[1]

    def sentences(self) -> list[str]:
        """What was found from the rows that are judged."""
        lines = [f"{self.fitted_numbers} numbers were found from these rows: errors of few rows flatter"]
        return lines + self.sentences_of_each() if self.new else []

    def of_rows(self, data: Measurements) -> Tensor:
        """(N, c) the constants of every row."""
        known = [*self.names, ""]
        whose = torch.tensor([known.index(name) for name in data.device_names], dtype=torch.int64, device=HOST)
        return torch.cat([self.constants, self.same[None]])[whose].to(data.points)


@dataclass(frozen=True, eq=False)
class MountedMarkers(Mounted):
    """Markers: constants are their shifts (3 P) from those of the model, in the frames of their tips, m."""

    kind, shape = MOUNTING, (-1, 3)

    @classmethod
    def of(cls, predicted: Tensor, data: Measurements, turns: Turns) -> MountedMarkers:
        """See :class:`Mounted`."""
        names, whose = sessions_of(data)
        P = min(data.markers, predicted.shape[1])
        away = turns(data.q)[:, :P].mT @ (data.points[:, :P] - predicted[:, :P])[..., None]
        found = [_middle(away[whose == number][..., 0]) for number in range(len(names))]
        shifts, deviations = (torch.stack(each).flatten(1).to(HOST) for each in zip(*found, strict=True))
        return cls(names, shifts, deviations, turns, names)

    def aligned(self, data: Measurements) -> Measurements:
        """See :class:`Mounted`."""
        shifts = self.of_rows(data).unflatten(1, (-1, 3))
        return data.shifted(-(self.turns(data.q)[:, : shifts.shape[1]] @ shifts[..., None])[..., 0])

    @staticmethod
    def increments(points: Tensor, slopes: Tensor | None, by_tool: Tensor) -> Tensor:
        """See :class:`Mounted`."""
        return PLACES.remounted_m * by_tool

    def moved(self, others: Sequence[int], steps: Tensor, covariance: Tensor) -> MountedMarkers:
        """See :class:`Mounted`."""
        shifts, deviations = self.constants.clone(), self.deviations.clone()
        shifts[others] += PLACES.remounted_m * steps
        deviations[others] = PLACES.remounted_m * covariance.diagonal().clamp(min=0).sqrt().view_as(steps)
        return replace(self, constants=shifts, deviations=deviations)

    def sentences_of_each(self) -> list[str]:
        """See :class:`Mounted`."""
        return mounted_sentences(self.names, self.constants, self.deviations)

    @property
    def same(self) -> Tensor:
        """See :class:`Mounted`."""
        return self.constants.new_zeros(self.constants.shape[1])


@dataclass(frozen=True, eq=False)
class MountedFrames(Mounted):
    """Measured frames, as of several cameras: constants are the transforms M (16), their increments X exp(e) M."""

    kind, shape = MOUNTED_FRAME, (4, 4)

    @classmethod
    def of(cls, predicted: Tensor, data: Measurements, turns: Turns) -> MountedFrames:
        """See :class:`Mounted`."""
        names, whose = sessions_of(data)
        lever = data.bodies.pose_lever()
        X = frames_of_points(predicted[:, :3], lever)[:, 0]
        seen = (data.points - X[:, None, :3, 3]) @ X[:, :3, :3]  # in the frame of the model's tool
        found = [_middle(seen[whose == number]) for number in range(len(names))]
        points, deviations = (torch.stack(each).to(HOST) for each in zip(*found, strict=True))
        shifts = deviations.square().mean(1).sqrt()
        M = poses_from_marks(points, lever).flatten(1)
        return cls(names, M, torch.cat([shifts, shifts / lever], 1), turns, names)

    def aligned(self, data: Measurements) -> Measurements:
        """See :class:`Mounted`."""
        return data.on_frames(self.of_rows(data).unflatten(1, (4, 4)))

    @staticmethod
    def increments(points: Tensor, slopes: Tensor | None, by_tool: Tensor) -> Tensor:
        """See :class:`Mounted`."""
        found = PLACES.session_m_rad * own_slopes(points[:, :3])
        return found if slopes is None else slopes[..., : found.shape[1]] @ found

    def in_any_frame(self, data: Measurements) -> Measurements:
        """See :class:`Mounted`."""
        if not data.remounted or not set(data.device_names) <= {*self.names, ""}:
            return data
        names = {"session": data.session, "session_names": data.session_names, "remounted": True}
        return with_attributes(self.aligned(data), **names)

    def after(self, known: Mounted) -> MountedFrames:
        """See :class:`Mounted`."""
        if not set(self.names) <= set(known.names):
            return self
        own = [known.names.index(name) for name in self.names]
        M, before = (each.unflatten(1, (4, 4)) for each in (self.constants, known.constants[own]))
        here = (self.deviations == 0).all(1, keepdim=True)  # the reference is where it was before
        deviations = torch.where(here, known.deviations[own], self.deviations)
        return replace(self, constants=(M @ before).flatten(1), deviations=deviations)

    def moved(self, others: Sequence[int], steps: Tensor, covariance: Tensor) -> MountedFrames:
        """See :class:`Mounted`."""
        M, deviations = self.constants.clone(), self.deviations.clone()
        steps = PLACES.session_m_rad * steps
        M[others] = (twist_transform(steps) @ M[others].unflatten(1, (4, 4))).flatten(1)
        deviations[others] = PLACES.session_m_rad * covariance.diagonal().clamp(min=0).sqrt().view_as(steps)
        return replace(self, constants=M, deviations=deviations)

    def sentences_of_each(self) -> list[str]:
        """See :class:`Mounted`."""
        return mounted_frame_sentences(self.names, self.constants, self.deviations)

    def views(self) -> list[View]:
        """See :class:`Mounted`."""
        return [lambda poses, M=M: poses @ M for M in self.constants.unflatten(1, (4, 4))]

    @property
    def same(self) -> Tensor:
        """See :class:`Mounted`."""
        return torch.eye(4, dtype=self.constants.dtype, device=self.constants.device).flatten()


def mounted_kind(data: Measurements) -> type[Mounted]:
    """What differs between the set-ups of rows that were mounted anew."""
    return MountedMarkers if data.lever is None else MountedFrames


def mounted_of(model: Any) -> Mounted:
    """What is on the tool in every set-up that a calibrated model knows, for rows that were mounted anew."""
    kind = MountedMarkers if model.lever is None else MountedFrames
    sets = [own for own in model.placement if own.kind == kind.kind]
    names = tuple(name for own in sets for name in own.names)
    none = torch.zeros(0, 0, dtype=torch.float64, device=HOST)
    found = [torch.cat([getattr(own, k) for own in sets] or [none]) for k in ("constants", "deviations")]
    return kind(names, found[0], found[1], model.turns)


def own_slopes(points: Tensor) -> Tensor:
    """Derivatives (N, 9, 6) of the three points (N, 3, 3) of frames by a shift and a turn along their own axes."""
    R, arms = poses_of_triangles(points)[:, None, :3, :3], points - points.mean(1, keepdim=True)
    turned = R @ -skew((arms[..., None, :] @ R)[..., 0, :])
    return torch.cat([R.expand_as(turned), turned], 3).flatten(1, 2)


def carried_frames(constants: Tensor, T: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Frames (S, 16) on the tool beside that of another model of the same robot, where they were.

    Args:
        constants: beside the old one. T: (4, 4) from the old measuring frame to the new one, m.
        before, after: (N, 3, 3) points of the old and the new model, m.
    """
    old, new = (poses_of_triangles(points[:, :3]) for points in (before, after))
    change = torch.linalg.inv(new) @ T @ old
    mean = transforms(nearest_rotations(change[:, :3, :3].mean(0)), change[:, :3, 3].mean(0))
    return (mean @ constants.unflatten(1, (4, 4))).flatten(1)


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


def mounted_sentences(names: Sequence[str], constants: Tensor, deviations: Tensor) -> list[str]:
    """How far markers, by their shifts (S, 3 P), m, are from those of the model; none for the model's own."""
    lines = []
    for name, *each in zip(names, *(values.unflatten(1, (-1, 3)) for values in (constants, deviations)), strict=True):
        shift, std = each
        sizes = zip((1e3 * shift.norm(dim=1)).tolist(), (1e3 * std.norm(dim=1) / 3**0.5).tolist(), strict=True)
        seen = zip(sizes, seen_mounted(std).tolist(), strict=True)
        known = ", ".join(f"{size:.3f} +- {own:.3f} mm" if shown else "not seen" for (size, own), shown in seen)
        if bool(shift.any()):
            markers = "markers are" if len(shift) > 1 else "marker is"
            lines.append(f"session '{name}': its {markers} {known} away from that of the model")
    return lines


def mounted_frame_sentences(names: Sequence[str], constants: Tensor, deviations: Tensor) -> list[str]:
    """Where frames (S, 16) are in that of the model's tool; none for the model's own."""
    lines = []
    for name, M, std in zip(names, constants.unflatten(1, (4, 4)), deviations, strict=True):
        turn = float(torch.arccos(((M[:3, :3].trace() - 1) / 2).clamp(-1, 1)).rad2deg())
        if not bool((torch.eye(4, dtype=M.dtype, device=M.device) == M).all()):
            shift, known = 1e3 * float(M[:3, 3].norm()), 1e3 * float(std[:3].norm())
            lines.append(f"'{name}' is {shift:.3f} +- {known:.3f} mm and {turn:.3f} degrees away on the tool from the")
            lines[-1] += " model's"
    return lines


def sessions_of(data: Measurements) -> tuple[tuple[str, ...], Tensor]:
    """Names of the sessions of some rows, and (N,) the number of each row's, -1 for none.

    Raises:
        MeasurementError: no sessions, or fewer than 4 rows in one.
    """
    if data.session is None:
        raise MeasurementError.of("the measurements have no sessions", fix="pass data.with_sessions(names)")
    present = data.session[data.session != NO_SOCKET].unique().tolist()
    own, names = torch.full_like(data.session, NO_SOCKET), tuple(data.session_names[number] for number in present)
    for place, (number, name) in enumerate(zip(present, names, strict=True)):
        rows = data.session == number
        own[rows] = place
        if int(rows.sum()) < FEWEST_ROWS:
            fix = "check the name in these rows, measure more rows in it, or leave it out"
            got = few(rare_names(data.device_names, data.line_numbers.tolist(), FEWEST_ROWS))
            raise MeasurementError.of(f"session '{name}'", expected=f"{FEWEST_ROWS} rows", got=got, fix=fix)
    return names, own
