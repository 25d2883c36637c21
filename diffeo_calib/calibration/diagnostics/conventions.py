"""What the joint values of a table mean where the robot does not explain its rows: signs, zeros, couplings and units.

Sought are M and b with which the joint values ``q = M q_read + b`` explain the rows. Signs, couplings and units are
tried from discrete starts; the zeros b, and factors that are not known, are found by damped least squares. The places
p(q, c) = R(q) c + t(q) of a marker c are compared with what was seen by a projector P that removes all that a frame can
explain, affine functions of the measured places, or one place for each socket: |P p| is made small. No frame has to be
found, so that many starts are cheap. What is left is judged by a rigid registration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from math import degrees, pi
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree

# Rows of the search, starts of zeros without a change of sign, starts that go on, and equivalents made plain.
ROWS, ZEROS, KEPT, EXAMINED = 24, 64, 64, 8
FIRST_STEPS, STEPS, LAST_STEPS = 5, 20, 6
LARGEST_STEP, MARKER_M = 0.7, 0.5  # of joints, rad or m, and of the marker on the tip, m
PROMISING = 0.02  # share of the spread that is left in an affine frame by what is examined further
# A plainer value is right if it leaves no more than this share, or this multiple of what the best one leaves.
NICE, KEEPS = 0.015, 3.0
SMALLEST_LIMIT = 0.001  # of the share that a convention may leave: rows that the robot explains need none
LEAST_PART, MOST_PART = 0.04, 2.2  # of a joint's limits, within which its values lie in the right unit
TURNS, MOST_TURNS = 4, 1.5  # number of their factor among all, and turns up to which values may be turns
SLACK, MOST_BEYOND = 0.02, 0.02  # rad or m by which values may be beyond limits, and share of rows that may be
LARGEST_PERCENT = 101.0  # from which values are not -100..100 or 0..100 of the limits
RATIOS = sorted(range(2, 401), key=lambda ratio: (ratio % 10 > 0, ratio % 5 > 0))  # of gears, the usual ones first
RIGHT_ANGLES = {1.0: "+pi/2", -1.0: "-pi/2", 2.0: "+pi"}


@dataclass(frozen=True, eq=False)
class Convention:
    """Joint values ``q @ matrix.T + offset`` in the place of those that were read, q (N, n) [rad or m]."""

    robot: Tree  # n joints
    matrix: Tensor  # (n, n)
    offset: Tensor  # (n,) rad or m
    left: float  # what they leave, as a share of the spread

    @property
    def cost(self) -> int:
        """How many values are not those that were read; a factor of all joints counts once, and with it its zero."""
        diagonal, mixed = self.matrix.diagonal(), (self.matrix != 0.0).sum(1) > 1
        factors = {round(value, 9) for value in diagonal.abs().tolist()} - {0.0, 1.0}
        zeros = [round(value, 9) for value in self.offset.tolist() if value]
        changes = (diagonal < 0.0).sum() + mixed.sum() + (diagonal == 0.0).sum() // 2
        return int(changes) + len(factors) + len(set(zeros) if factors else zeros)

    def texts(self, names: tuple[str, ...] | list[str], angle: str, per_metre: float) -> list[str]:
        """Expressions for `joints`: names of the columns, and the units of the table."""
        texts = []
        for k, turns in enumerate(self.robot.periodic):
            terms = [_term(value, name, angle) for value, name in zip(self.matrix[k].tolist(), names, strict=True)]
            zero = float(self.offset[k])
            constant = (degrees(zero) if angle == "deg" else zero) if turns else zero * per_metre
            quarters = RIGHT_ANGLES.get(round(zero / (pi / 2), 6)) if turns and angle == "rad" else None
            text = "".join(terms).removeprefix("+") + (quarters or f"{constant:+.6g}" * (constant != 0.0))
            texts.append(text[1:-1] if text[1:-1] in names else text)
        return texts

    def of_columns(self, matrix: Tensor, offset: Tensor, angle: str, per_metre: float) -> Convention:
        """Conventions of cells (N, c) of columns where the joint values that were read are ``matrix @ cells + offset``.

        Args:
            matrix: (n, c). offset: (n,), in the units of the table. angle, per_metre: these units.
        """
        turn = pi / 180 if angle == "deg" else 1.0
        per_unit = offset.new_tensor([turn if turns else 1.0 / per_metre for turns in self.robot.periodic])
        factors = self.matrix.to(matrix)
        return replace(self, matrix=factors @ matrix, offset=self.offset.to(offset) + factors @ (per_unit * offset))


def _term(value: float, name: str, angle: str) -> str:
    """A factor and its column: -360/4096*{name}."""
    turn, words = (360.0, "360") if angle == "deg" else (2 * pi, "2*pi")
    named = {1.0: "", 180 / pi: "180/pi*", pi / 180: "pi/180*"} | {1 / ratio: f"1/{ratio}*" for ratio in RATIOS}
    named |= {turn: f"{words}*"} | {turn / 2**k: f"{words}/{2**k}*" for k in range(8, 25)}
    text = next((text for size, text in named.items() if abs(size - abs(value)) < 1e-9 * size), f"{abs(value):.6g}*")
    return f"{'-' if value < 0.0 else '+'}{text}{{{name}}}" if value else ""


def conventions(
    robot: Tree, data: Measurements, left: Callable[[Tensor], float], per_rad: float = 1.0
) -> list[Convention]:
    """The plainest conventions that explain rows which the robot does not explain as they were read.

    Args:
        robot: n joints. data: N rows. left: what a rigid registration of joint values (N, n) leaves, as a share of the
            spread. per_rad: how many of the table's angles are one rad.

    Returns:
        none if nothing explains the rows far better; several if the rows do not tell them apart.
    """
    rows, columns, tip = data.explained()
    limit = min(gates.RIGHT_READING, gates.OTHER_READING_LEFT * left(data.q))
    if min(len(rows), ROWS) < 2 * (2 + robot.n) or limit < SMALLEST_LIMIT:
        return []
    some = torch.randperm(len(rows), generator=seeded(0), device=HOST)[:ROWS]
    rows, columns = rows[some], columns[some]
    columns = columns[:, (columns != 0).any(0)]
    Q = torch.linalg.qr(columns / columns.norm(dim=0).clamp(min=1e-12)).Q
    projector = torch.eye(len(Q), dtype=Q.dtype, device=Q.device) - Q @ Q.mT
    search = _Search(robot, robot.tips.index(tip) if tip else 0, data.q[rows], projector, per_rad)

    def judged(matrix: Tensor, offset: Tensor) -> Convention:
        return Convention(robot, matrix, offset, left(data.q @ matrix.mT + offset))

    def rigid(starts: _Starts) -> Iterator[_Starts]:
        """Conventions that are good in a rigid frame too, one for each pattern of signs."""
        kept = list[Tensor]()
        for row, pattern in enumerate(starts.matrix.sign()):
            skipped = len(kept) == EXAMINED or any(torch.equal(pattern, candidate) for candidate in kept)
            if not skipped and judged(starts.matrix[row], starts.offset[row]).left < limit:
                kept.append(pattern)
                yield starts.some(slice(row, row + 1))

    first = next((candidate for starts in search.tried() for candidate in rigid(search.best(starts))), None)
    plain = [] if first is None else [search.plainer(candidate) for candidate in rigid(search.equivalents(first))]
    good = sorted((judged(*candidate) for candidate in plain), key=lambda candidate: candidate.left)
    near = [candidate for candidate in good if candidate.left < min(limit, KEEPS * good[0].left)]
    least = min((candidate.cost for candidate in near), default=0)
    plainest = [candidate for candidate in near if candidate.cost == least and least]
    (low, high), beyond = robot.limits.to(data.q).mT, list[int]()
    for way in plainest:
        q = data.q @ way.matrix.mT + way.offset
        q = q - robot.whole_turns(q)
        beyond.append(int(((q < low - SLACK) | (q > high + SLACK)).sum()))
    most = min(beyond, default=0) + MOST_BEYOND * len(data)  # the limits tell apart what the rows do not
    return [way for way, count in zip(plainest, beyond, strict=True) if count <= most]


class _Starts(NamedTuple):
    """B conventions: matrices (B, n, n), zeros (B, n), which of them and which factors are sought, what they leave."""

    matrix: Tensor
    offset: Tensor
    free: Tensor
    scaled: Tensor
    share: Tensor

    def some(self, rows: Tensor | slice) -> _Starts:
        """Some of them."""
        return _Starts(*(part[rows] for part in self))

    @staticmethod
    def joined(parts: list[_Starts]) -> _Starts:
        """All of them."""
        return _Starts(*map(torch.cat, zip(*parts, strict=True)))


class _Search:
    """The search over rows q (N, n), as read, of the tip with this number; see :func:`conventions`."""

    def __init__(self, robot: Tree, tip: int, q: Tensor, projector: Tensor, per_rad: float) -> None:
        self.robot, self.tip, self.q, self.projector, self.per_rad = robot, tip, q, projector, per_rad
        self.turning, limits = torch.tensor(robot.periodic, dtype=torch.bool, device=HOST), robot.limits
        half = torch.where(self.turning, pi, 1.0).to(limits)[:, None]
        bounded = limits.isfinite() & (limits[:, 1:] > limits[:, :1])
        # (n, 2) limits, half a turn or a metre to both sides where there are none [rad or m]
        self.room = torch.where(bounded, limits, torch.cat([-half, half], 1))
        self.width = self.room[:, 1] - self.room[:, 0]
        # -100..100 and 0..100 of the limits, degrees, radians, turns and ticks as factors (n,) of the values as read
        ticks = [2 * pi / 2**k * per_rad for k in (0, *range(8, 25))]
        plain = [value * torch.ones_like(self.width) for value in (pi / 180, 180 / pi, *ticks)]
        self.factors = [self.width / 200.0 * per_rad, self.width / 100.0 * per_rad, *plain]

    def tried(self) -> Iterator[_Starts]:
        """Starts: signs and zeros; exchanged or coupled columns; other units of all joints, and of some."""
        n, turning, width = self.robot.n, self.turning, self.width
        identity, span = torch.eye(n, dtype=torch.float64, device=HOST), self.q.amax(0) - self.q.amin(0)
        large = turning & (span > MOST_PART * width)
        small = turning & (span < LEAST_PART * width)
        if not bool(large.any()):
            yield self.starts(identity, self.zeros(ZEROS))
        exchanged = ([b if k == a else a if k == b else k for k in range(n)] for a, b in combinations(range(n), 2))
        mixed = [self.starts(identity[order], self.zeros(2), 0) for order in exchanged]
        for k in (k for k in range(n - 1) if bool(turning[k] & turning[k + 1])):
            for sign in (1.0, -1.0):
                coupled = identity.clone()
                coupled[k + 1, k] = sign
                mixed.append(self.starts(coupled, self.zeros(4), 3))
        if not bool(large.any()) and mixed:
            yield _Starts.joined(mixed)
        strange = bool((large | small | ~turning).all())
        percent = bool(((self.q * self.per_rad)[:, turning].abs() <= LARGEST_PERCENT).all())
        turns = bool(((self.q * self.per_rad)[:, turning].abs() <= MOST_TURNS).all())
        moving = turning & (span > gates.FIXED_RANGE)
        for number, factor in enumerate(self.factors if bool(turning.any()) else ()):
            part = (factor * span / width)[moving]
            possible = strange or (percent and number < 2) or (turns and number == TURNS)
            if possible and bool(((part < MOST_PART) & (part > LEAST_PART)).all()):
                starts = self.starts(torch.where(turning, factor, 1.0)[:, None] * identity, self.zeros(ZEROS // 2))
                yield starts._replace(scaled=(moving & (number < 2)).expand_as(starts.offset))  # limits are rough
        for odd in (large, large | small):
            if 0 < int(odd.sum()) < max(int(turning.sum()), 2):
                starts = self.starts(identity, self.zeros(ZEROS))
                grid = torch.rand(starts.offset.shape, generator=seeded(1), dtype=torch.float64, device=HOST)
                size = torch.where(odd, 0.08 * 12.0**grid * width / span.clamp(min=1e-9), 1.0)
                yield starts._replace(matrix=starts.matrix * size[..., None], scaled=odd.expand_as(starts.offset))

    def zeros(self, count: int) -> Tensor:
        """None, the middle of the limits, half a turn, the lower limits, and random right angles: (count, n)."""
        generator, shape = seeded(0), (count, self.robot.n)
        quarters = torch.randint(-1, 3, shape, generator=generator, device=HOST) * (pi / 2)
        drawn = torch.rand(shape, generator=generator, dtype=torch.float64, device=HOST) < 0.5
        offsets = torch.where(drawn & self.turning, quarters, 0.0).double()
        usual = self.room.mean(1), torch.where(self.turning, -pi, 0.0).double(), self.room[:, 0]
        offsets[:4] = torch.stack([torch.zeros_like(usual[0]), *usual])[:count]
        return offsets

    def starts(self, matrix: Tensor, zeros: Tensor, most: int = 4, *, fewer: bool = True) -> _Starts:
        """One matrix with up to ``most`` changes of sign, and zeros (K, n), half as many for each change."""
        n, matrices, offsets = self.robot.n, [], []
        for flips in (joints for count in range(most + 1) for joints in combinations(range(n), count)):
            sign = torch.ones(n, 1, dtype=torch.float64, device=HOST)
            sign[list(flips)] = -1.0
            offsets.append(zeros[: max(len(zeros) >> len(flips), 2)] if fewer else zeros)
            matrices.append((sign * matrix).expand(len(offsets[-1]), n, n))
        offset = torch.cat(offsets)
        none = torch.zeros_like(offset, dtype=torch.bool)
        return _Starts(torch.cat(matrices), offset, ~none, none, torch.full_like(offset[:, 0], torch.inf))

    def best(self, starts: _Starts) -> _Starts:
        """The most promising, improved; the best first."""
        starts = self.improved(starts, FIRST_STEPS)
        improved = self.improved(starts.some(starts.share.argsort()[:KEPT]), STEPS)
        order = improved.share.argsort()
        return improved.some(order[improved.share[order] < PROMISING])

    def equivalents(self, start: _Starts) -> _Starts:
        """One of the starts (1,), and those with other signs and half turns that explain as much, few signs first."""
        n, turns = self.robot.n, self.robot.periodic
        halves = [(), *((k,) for k in range(n)), *((k, k + gap) for gap in (2, 3) for k in range(n - gap))]
        added = [[pi if k in joints else 0.0 for k in range(n)] for joints in halves if all(turns[k] for k in joints)]
        zeros = start.offset + torch.tensor(added, dtype=torch.float64, device=HOST)
        bare = start.matrix[0] * torch.where(start.matrix[0].diagonal() < 0.0, -1.0, 1.0)[:, None]
        starts = self.starts(bare, zeros, fewer=False)
        tried = self.improved(starts._replace(scaled=start.scaled.expand_as(starts.offset)), 2)
        tried = self.improved(tried.some(tried.share < PROMISING + float(start.share)), FIRST_STEPS)
        good = tried.some(tried.share < max(NICE, KEEPS * float(start.share)))
        return _Starts.joined([good, start])

    def plainer(self, start: _Starts) -> tuple[Tensor, Tensor]:
        """M and b of one of the starts (1,), with known factors and the plainest zeros that explain as much."""
        limit, ones = max(NICE, KEEPS * float(start.share)), torch.ones_like(self.width)
        identity = torch.eye(self.robot.n, dtype=torch.bool, device=HOST)
        usual = torch.stack([*self.factors, *(ones / ratio for ratio in (1, *RATIOS))])
        for k in start.scaled[0].nonzero()[:, 0].tolist():
            near = usual[(usual[:, k] / start.matrix[0, k].abs().max() - 1.0).abs() < 0.05, k]
            tried = _Starts.joined([start] * max(len(near), 1))
            if len(near):
                matrix = torch.where(identity[k][:, None], tried.matrix.sign() * near[:, None, None], tried.matrix)
                start = self._taken(start, tried._replace(matrix=matrix, scaled=tried.scaled & ~identity[k]), limit)
        for k in range(self.robot.n):
            ends = [float(self.room[k].mean()), *self.room[k].tolist()]
            nice = [0.0, *([pi / 2, -pi / 2, pi] if bool(self.turning[k]) else []), *ends]
            tried = _Starts.joined([start] * len(nice))
            values = torch.tensor(nice, dtype=torch.float64, device=HOST)[:, None]
            offset = torch.where(identity[k], values, tried.offset)
            start = self._taken(start, tried._replace(offset=offset, free=tried.free & ~identity[k]), limit)
        turned = (pi - (pi - start.offset[0]).remainder(2 * pi)).rad2deg().round(decimals=1).deg2rad()
        rounded = torch.where(self.turning, turned, start.offset[0].round(decimals=4))
        return start.matrix[0], torch.where(start.free[0], rounded, start.offset[0])

    def _taken(self, now: _Starts, tried: _Starts, limit: float) -> _Starts:
        """The first that leaves little and about as little as the best of them, else what there was."""
        tried = self.improved(tried, LAST_STEPS)
        good = (tried.share < min(limit, 1.5 * max(float(tried.share.min()), NICE / 3))).nonzero()[:1, 0]
        return tried.some(good) if len(good) else now

    def improved(self, starts: _Starts, steps: int) -> _Starts:
        """Damped least squares in the zeros, the sought factors and the marker's place on the tip."""
        matrix, offset, n = starts.matrix, starts.offset, self.robot.n
        marker, damping = offset.new_zeros(len(offset), 3), offset.new_full((len(offset),), 1e-2)
        now = self._unexplained(matrix, offset, marker)
        for _ in range(steps):
            residual, slopes, turned, share = now
            by_size = slopes * ((matrix.sign() @ self.q.mT).mT[:, :, None] * starts.scaled[:, None, None])
            design = torch.cat([slopes * starts.free[:, None, None], by_size, turned], 3).flatten(2)
            design = (self.projector @ design).unflatten(2, (3, -1)).flatten(1, 2)
            normal, gradient = design.mT @ design, (design.mT @ residual.flatten(1)[..., None])[..., 0]
            size = normal.diagonal(dim1=1, dim2=2)
            damped = normal + torch.diag_embed(damping[:, None] * (size + 1e-3 * size.amax(1, True)) + 1e-9)
            step, sizes = -torch.linalg.solve(damped, gradient), matrix.abs().amax(2)
            scaled = matrix * ((sizes + step[:, n : 2 * n]).clamp(min=1e-9) / sizes)[..., None]
            moved = offset + step[:, :n].clamp(-LARGEST_STEP, LARGEST_STEP)
            tried = scaled, moved, (marker + step[:, 2 * n :]).clamp(-MARKER_M, MARKER_M)
            then = self._unexplained(*tried)
            better = then[3] < share
            pairs = zip((matrix, offset, marker, *now), (*tried, *then), strict=True)
            taken = [torch.where(better.view(-1, *[1] * (old.ndim - 1)), new, old) for old, new in pairs]
            matrix, offset, marker, *now = taken
            damping = torch.where(better, damping / 4, damping * 4).clamp(1e-6, 1e6)
        return starts._replace(matrix=matrix, offset=offset, share=now[3])

    def _unexplained(self, matrix: Tensor, offset: Tensor, marker: Tensor) -> list[Tensor]:
        """What no frame explains (B, N, 3), slopes by joints (B, N, 3, n), rotations (B, N, 3, 3), share (B,)."""
        robot, shape = self.robot, (len(matrix), len(self.q))
        places = robot.places((self.q @ matrix.mT + offset[:, None]).flatten(0, 1))
        end = places[:, robot.tip_places][:, self.tip]
        p = end[:, :3, 3] + (end[:, :3, :3] @ marker.repeat_interleave(shape[1], 0)[..., None])[..., 0]
        moved = robot.ancestors[robot.tip_places][self.tip : self.tip + 1]
        slopes = robot.point_slopes(places[:, : robot.moving], p[:, None], moved)[:, 0].unflatten(0, shape)
        p = p.unflatten(0, shape)
        residual, spread = self.projector @ p, (p - p.mean(1, keepdim=True)).square().sum((1, 2))
        share = (residual.square().sum((1, 2)) / spread.clamp(min=1e-12)).sqrt()
        return [residual, slopes, end[:, :3, :3].unflatten(0, shape), share]
