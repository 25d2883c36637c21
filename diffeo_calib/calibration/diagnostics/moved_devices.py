"""Did something change during the measurements? The tripod, the robot's foot, a marker, a joint offset, a zero.

With K = G + R the covariance of the model's errors at its scales, something that changes at row k by unknowns u adds
B_k u to the errors r, with the effects B_k of the rows, zero before k. Twice the gain in log likelihood by the best u:

    gain_k = g^T H^-1 g,    g = B_k^T K^-1 r,    H = B_k^T K^-1 B_k,

chi-squared with one degree of freedom per unknown if nothing changed. Scales that were selected with the change in the
rows call it noise; noise that has one sign before a row and the other after it is still no chance, since each row adds
about one to the gain. Chance makes the largest of all gain_k exceed t with probability

    t^(U/2) e^(-t/2) / (2^(U/2) Gamma(U/2)) ((1 - U/t) log((1 - e)^2 / e^2) + 4/t),    e: share of the rows left out

(M. Csorgo, L. Horvath, "Limit theorems in change-point analysis", 1997, section 1.3). What drifts with the row number
has one B for all rows, and gains chi-squared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import exp, lgamma, log
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence
from diffeo_calib.common.quantiles import chi2_median, chi2_probability
from diffeo_calib.kinematics.nominal import rigid_motions
from diffeo_calib.process.process import Process
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.robots.se3 import skew

RELATIVE_RIDGE = 1e-9
"""Relative size of the diagonal that keeps H invertible where rows do not determine all unknowns."""


@dataclass(frozen=True)
class ChangeLimits:
    """When a change is reported.

    Args:
        fewest_rows: smallest number of rows on either side of a change point.
        chance: probability that chance alone explains the largest of all gains, from which nothing is reported.
        noise_share: RMS motion by a change, in standard deviations of the noise, below which it does not matter.
        other_markers: a single marker moved if some other marker moved by less than this share of its motion.
        told_apart: difference of gains, or of Bayesian information criteria, up to which another cause is named too.
        worth: part of the RMS leave-one-out error that must remain at most with the change in the model.
        coordinates: measured coordinates of the random rows that stand for all where there are more.
    """

    fewest_rows: int = 5
    chance: float = 1e-5
    noise_share: float = 0.3
    other_markers: float = 0.5
    told_apart: float = 6.0
    worth: float = 0.97
    coordinates: int = 2000


LIMITS = ChangeLimits()
BASE, MARKERS = "the measuring device or the robot's base", "a marker or the tool"
SCALE = "the scale of the device or the size of the robot"
NEW_SET_UP = "name the set-ups in a column (`session`), or use the rows before or after it"
TWO_ROBOTS = "calibrate the rows before it, and recalibrate that model with the rows after it"
SLOW = (
    "if it stood in several places, name the set-ups in a column (`session`); else let robot and device warm up, and "
    "measure in random order; or name a column of times or temperatures (`time`, `temperature`), with which the model "
    "then drifts"
)


class Cause(NamedTuple):
    """Something that may change.

    Args:
        name: in words. effects: (N, m, U) derivatives of all rows by the unknowns, m.
        unit: in which a single unknown is reported, and its size in m or rad; None to report the motion of the points.
        fix: what to do about a sudden change.
        basis: (N, c, m) the coordinates of the rows' points by their numbers, see :attr:`TangentData.basis`, or None.
    """

    name: str
    effects: Tensor
    unit: tuple[str, float] | None = None
    fix: str = NEW_SET_UP
    basis: Tensor | None = None

    def told_by(self, data: TangentData) -> Cause:
        """The same with effects on the numbers that the rows tell, of effects on all coordinates."""
        return self._replace(effects=data.motions_in_numbers(self.effects), basis=data.basis)


class ChangePoint(NamedTuple):
    """The most likely change point.

    Args:
        row: the first row after it, in the order of measurement. gain: see above. change: (U,) the unknowns u.
        effects: (N, m, U) derivatives of all rows by the unknowns.
    """

    row: int
    gain: float
    change: Tensor
    effects: Tensor

    @property
    def motion(self) -> Tensor:
        """(N, m) displacement of every row by the change, m."""
        return self.effects @ self.change


class Finding(NamedTuple):
    """A cause that explains errors: at a change point, or drifting over all rows.

    Args:
        cause: what. point: how much, of a drift between the first row and the last. drifts: which of both.
        columns: (N, m, U) effects in the rows: zero before the change, or growing with the row.
    """

    cause: Cause
    point: ChangePoint
    drifts: bool
    columns: Tensor

    @property
    def evidence(self) -> float:
        """Gain less the price of the unknowns by the Bayesian information criterion; the row is one more."""
        return self.point.gain - (len(self.point.change) + (not self.drifts)) * log(len(self.columns))

    @property
    def displacement(self) -> float:
        """RMS motion of a coordinate by the change over the rows that show it, m."""
        moved = (self.columns @ self.point.change).square().sum(1)
        shown = moved > 0
        count = self.columns.shape[1] if self.cause.basis is None else self.cause.basis.shape[1]
        return float((moved[shown].mean() / count).sqrt()) if bool(shown.any()) else 0.0

    def chance(self, limits: ChangeLimits) -> float:
        """Probability that chance alone gains as much."""
        gain, unknowns = self.point.gain, len(self.point.change)
        if self.drifts:
            return chi2_probability(gain, unknowns)
        return chance_of_jump(gain, unknowns, limits.fewest_rows / len(self.columns))

    def words(self, limits: ChangeLimits) -> str:
        """Phrase for the change and its size."""
        verb, change = "to drift" if self.drifts else "to have moved", self.point.change
        if self.cause.unit is not None:
            unit, size = self.cause.unit
            verb = verb if self.drifts else "to have changed"
            return f"{self.cause.name} seems {verb} by about {float(change.abs().max()) / size:.2g} {unit}"
        name, distance = self._moved(limits)
        return f"{name} seems {verb} by about {1e3 * distance:.2g} mm"

    def _moved(self, limits: ChangeLimits) -> tuple[str, float]:
        """Phrase for what moved, and how far, m."""
        motion, basis = self.point.motion, self.cause.basis
        motion = motion if basis is None else (basis @ motion[:, :, None])[:, :, 0]
        size = 3 if motion.shape[1] % 3 == 0 else motion.shape[1]
        distances = motion.unflatten(1, (-1, size)).norm(dim=-1)  # of every marker
        shown = distances.amax(1) > 0
        typical = distances[shown].median(0).values
        if self.cause.name != MARKERS:
            return self.cause.name, float(typical[typical > 0].median())
        distance = float(typical.max())
        single = float(typical.min()) < limits.other_markers * distance
        return f"marker {int(typical.argmax())}" if single else self.cause.name, distance


def change_during(
    numbers: Tensor,
    data: TangentData,
    scales: Hyperparameters,
    left_out: LeaveOneOut,
    devices: Callable[[], Iterable[Cause]] = tuple,
    *,
    seed: int = 0,
    limits: ChangeLimits = LIMITS,
) -> str | None:
    """A sentence about the clearest change during the measurements, with the row, the size and what to do; or None.

    Args:
        numbers: (N,) numbers of the rows; their order is that of the measurements.
        data: the measurements. scales: those of the model. left_out: leave-one-out errors with these.
        devices: what may change of devices in unknown places. seed: draws the rows where there are too many.
        limits: when a change is reported.
    """
    rows, some = data.sample(len(data.x), limits.coordinates, seed)
    if len(rows) < 4 * limits.fewest_rows:
        return None
    least = limits.noise_share * float(some.new_noise(scales).diagonal().mean().sqrt())
    causes = _on_rows((*causes_of(data), *devices()), rows, some)
    numbers, process = numbers.to(rows.device)[rows], some.process(scales)
    order = numbers.argsort()
    usual = data.noise_model.of_freedom(chi2_median, left_out.squares)
    excess = max(1.0, float((left_out.squares / usual).nanmedian()))  # of errors that the scales understate
    found = findings(causes, process, order, excess=excess, limits=limits)
    found = [one for one in found if one.displacement > least]
    if not found or 2 * len(causes) * min(one.chance(limits) for one in found) > limits.chance:
        return None
    best = max(found, key=lambda one: one.evidence)
    others = [one for one in found if one.cause.name != best.cause.name and _as_good(one, best, limits)]
    words = dict.fromkeys(one.words(limits) for one in (best, *others))
    before, after = left_out_rms(process), left_out_rms(Beside(process, best.columns))
    if best.drifts and (moved := moved_twice(best, process, order, limits)):
        lines = " and ".join(str(int(numbers[order[row]])) for row in moved)
        what = f"{best.cause.name} seems to have moved more than once, near rows {lines}"
        return sentence(what, expected="one set-up for all rows", fix=f"check what happened then; {best.cause.fix}")
    if after > limits.worth * before:
        return None
    where = "over the rows" if best.drifts else f"near row {int(numbers[order[best.point.row]])}"
    return sentence(
        f"{', or '.join(words)}{' (these rows do not tell which)' * bool(others)} {where}",
        expected="one set-up for all rows, in the order of their numbers",
        got=f"leave-one-out errors that fall to {100 * after / before:.0f} % with this change in the model",
        fix=SLOW if best.drifts else f"check what happened then; {best.cause.fix}",
    )


def _on_rows(causes: Iterable[Cause], rows: Tensor, some: TangentData) -> list[Cause]:
    """Those that move some of the rows, with effects on the numbers that these tell."""
    own = [one._replace(effects=one.effects[rows]) for one in causes]
    return [one.told_by(some) for one in own if bool((one.effects != 0).any())]


class Beside:
    """Rows beside changes of any size with these columns (N, m, U): K^-1 and K^-1 target, as a process has them."""

    def __init__(self, process: Process, columns: Tensor) -> None:
        self.numbers, C = process.numbers, process.numbers.of_table(columns)
        U, H = process.inverse @ C, C.T @ process.inverse @ C
        self.inverse = process.inverse - U @ torch.linalg.pinv(H + _ridge(H), hermitian=True) @ U.T
        self.mu = self.inverse @ self.numbers.target


def moved_twice(
    drift: Finding, process: Process, order: Tensor, limits: ChangeLimits = LIMITS
) -> tuple[int, int] | None:
    """First rows after two sudden changes of a cause that predict left-out rows better than its drift; else None.

    Three set-ups look like a drift. The first change point is sought once more beside the second one.
    """
    effects, known, found = drift.cause.effects, process, []
    for _ in range(3):
        found.append(find_change_point(effects, known, order, limits.fewest_rows).row)
        known = Beside(process, _from_row(effects, order, found[-1]))
    low, high = sorted(found[1:])
    both = Beside(process, torch.cat([_from_row(effects, order, row) for row in (low, high)], 2))
    apart = high - low >= limits.fewest_rows
    return (
        (low, high)
        if apart and left_out_rms(both) < limits.worth * left_out_rms(Beside(process, drift.columns))
        else None
    )


def _from_row(effects: Tensor, order: Tensor, row: int) -> Tensor:
    """Effects (N, m, U) of a change before this row of the order."""
    columns = effects.clone()
    columns[order[:row]] = 0.0
    return columns


def _as_good(one: Finding, best: Finding, limits: ChangeLimits) -> bool:
    """Whether the rows do not tell a cause apart from the best one: it explains as much, or is as probable."""
    explains = one.point.gain > best.point.gain - limits.told_apart
    return one.drifts == best.drifts and (explains or one.evidence > best.evidence - limits.told_apart)


def findings(
    causes: Iterable[Cause], process: Process, order: Tensor, *, excess: float = 1.0, limits: ChangeLimits = LIMITS
) -> list[Finding]:
    """Every cause at its best change point, and drifting.

    Gains are divided by ``excess``, or by the mean square of what the cause leaves unexplained where that is larger.
    """
    found, target = [], process.numbers.target
    total, count = float(process.mu @ target), len(target)

    def judged(point: ChangePoint) -> ChangePoint:
        return point._replace(gain=point.gain / max(excess, (total - point.gain) / count))

    for cause in causes:
        jump = find_change_point(cause.effects, process, order, limits.fewest_rows)
        found.append(Finding(cause, judged(jump), False, _from_row(cause.effects, order, jump.row)))
        columns = evenly_growing(cause.effects, order)
        found.append(Finding(cause, judged(_drift(cause.effects, columns, process)), True, columns))
    return found


def chance_of_jump(gain: float, unknowns: int, edge: float) -> float:
    """Probability that chance makes the largest gain of all change points larger; ``edge``: share e left out."""
    if gain <= unknowns + 1:
        return 1.0
    density = exp(0.5 * unknowns * log(0.5 * gain) - 0.5 * gain - lgamma(0.5 * unknowns))
    return min(1.0, density * ((1 - unknowns / gain) * 2.0 * log((1 - edge) / edge) + 4.0 / gain))


def evenly_growing(effects: Tensor, order: Tensor) -> Tensor:
    """Effects (N, m, U) that grow from -1/2 in the first row to 1/2 in the last."""
    ramp = torch.empty_like(effects[:, 0, 0])
    ramp[order] = torch.linspace(-0.5, 0.5, len(order), dtype=effects.dtype, device=effects.device)
    return ramp[:, None, None] * effects


def _drift(effects: Tensor, columns: Tensor, process: Process) -> ChangePoint:
    """The change from the first row to the last that explains most."""
    C = process.numbers.of_table(columns)
    g, H = C.T @ process.mu, C.T @ process.inverse @ C
    u = torch.linalg.pinv(H + _ridge(H), hermitian=True) @ g  # noise-free rows may leave H singular even so
    return ChangePoint(0, float(g @ u), u, effects)


def left_out_rms(known: Process | Beside) -> float:
    """RMS of leave-one-out errors, m."""
    total = 0.0
    for part, block in zip(known.numbers.parts, known.numbers.diagonal_blocks(known.inverse), strict=True):
        mu = known.mu[part.numbers].view(*part.cells.shape, 1)
        total += float(torch.linalg.solve(block, mu).square().sum())
    return (total / len(known.numbers.q)) ** 0.5


def _ridge(H: Tensor) -> Tensor:
    """Ridge that keeps H (..., U, U) invertible where rows do not determine all unknowns."""
    level = RELATIVE_RIDGE * H.diagonal(dim1=-2, dim2=-1).amax()
    return level * torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)


def causes_of(data: TangentData) -> list[Cause]:
    """Possible changes of robot, tool and measuring frame, and their effects on all rows."""
    points, geometry = data.points.unflatten(1, (-1, 3)), data.nominal.geometry
    base, markers = _base_motions(points), _shifts(geometry.marker_poses(data.x)[..., :3, :3])
    if data.basis is not None:  # nothing bends a frame
        markers = markers @ torch.block_diag(*rigid_motions(geometry.tool.flatten()).to(markers.device))
    if data.slopes is not None:
        base, markers = data.slopes @ base, data.slopes @ markers
    kinds = data.noise_model.row_kinds
    if kinds is not None:
        base[kinds > 0] = 0.0  # a ball in a socket does not show where the device of other rows stands
    found = [] if data.held else [Cause(BASE, base), Cause(BASE, base[..., :3])]
    found.append(Cause(MARKERS, markers))
    places = data.places.unflatten(1, (-1, 3))
    away = (places - places.mean((0, 1))).flatten(1)[..., None]
    found.append(Cause(SCALE, away if data.slopes is None else data.slopes @ away, ("ppm", 1e-6)))
    for joint, name in enumerate(geometry.chain.joint_names):
        if joint > 0 or not data.held:  # without a device no row shows an offset of the first joint
            unit = "mrad" if data.space.periodic[joint] else "mm"
            found.append(Cause(name, data.jacobian[..., joint, None], (unit, 1e-3), TWO_ROBOTS))
    return found


def find_change_point(
    effects: Tensor, known: Process | Beside, order: Tensor, fewest_rows: int = LIMITS.fewest_rows
) -> ChangePoint:
    """The most likely change point.

    Args:
        effects: (N, m, U) derivatives of the rows by the unknowns. known: the rows.
        order: (N,) row numbers in the order of measurement.
        fewest_rows: smallest number of rows on either side.
    """
    (n, _, unknowns), owner = effects.shape, known.numbers.owner
    E = known.numbers.of_table(effects)

    def by_row(values: Tensor) -> Tensor:
        """Sums over the numbers of each row, the last row first: (M, k) -> (N, k)."""
        return values.new_zeros(n, values.shape[1]).index_add_(0, owner, values)[order].flip(0)

    g = by_row(E * known.mu[:, None]).cumsum(0)
    H = E.new_empty(n, unknowns, unknowns)  # of the last 1 ... N rows
    for u in range(unknowns):
        half = by_row(E[:, u, None] * known.inverse)  # (N, M)
        for v in range(u + 1):
            H[:, u, v] = H[:, v, u] = by_row((half * E[:, v]).T).cumsum(0).cumsum(1).diagonal()
    H = H + RELATIVE_RIDGE * H[-1].diagonal().amax() * torch.eye(unknowns, dtype=H.dtype, device=H.device)
    u = (torch.linalg.pinv(H, hermitian=True) @ g[..., None])[..., 0]
    gains = (g * u).sum(1)[fewest_rows - 1 : n - fewest_rows]
    count = int(gains.argmax()) + fewest_rows  # rows after the change point
    return ChangePoint(n - count, float(gains.max()), u[count - 1], effects)


def _base_motions(points: Tensor) -> Tensor:
    """Shift and turn about the points' centre: (N, P, 3) -> (N, 3 P, 6)."""
    arms = points - points.mean((0, 1))
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*points.shape[:2], 3, 3)
    return torch.cat([eye, -skew(arms)], dim=-1).flatten(1, 2)


def _shifts(rotations: Tensor) -> Tensor:
    """Shifts of every marker in its tip's frame: (N, P, 3, 3) -> (N, 3 P, 3 P)."""
    own = torch.eye(rotations.shape[1], dtype=rotations.dtype, device=rotations.device)
    return torch.einsum("npab,pk->npakb", rotations, own).flatten(3).flatten(1, 2)
