"""Is a new row right? By its distance from what the accepted rows predict, and by what explains a larger one.

A row is judged by d^2 = e^T S^-1 e, chi-squared if it is right. Two kinds of causes explain errors:

* of one row: its unit, its joints are those of another row, two markers are exchanged, one marker is wrong. A cause is
  named if the row fits when it is undone.
* from a row k on: a device has moved, a marker has slipped, a joint has another offset. With w = L^-1 e the whitened
  errors of the last rows in order and B the effects of a cause, zero before row k, the cause gains |P w|^2, P the
  projection onto L^-1 B; chance gains chi-squared (diagnostics/moved_devices.py). Rows that were taken in one by one
  count again here: small changes show in several rows only. A single wrong row, which six unknowns of a device explain
  as well, is no change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from math import log
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.moved_devices import Cause
from diffeo_calib.common.quantiles import chi2_above, chi2_probability
from diffeo_calib.process.numbers import Numbers


@dataclass(frozen=True)
class JudgementLimits:
    """When a row counts as wrong, and when a cause is named.

    Args:
        chance: probability that a right row counts as wrong. undone: the same once its mistake is undone.
        change: probability that chance gains as much as a named change. A campaign of 100 rows asks for about 10,000
            changes, most of them much alike.
        remaining: probability, by chance, of the errors that a named change leaves.
        fewest_rows: rows after a change. window: last rows among which changes are sought.
        spare: numbers beyond the unknowns of a change that must show it.
        typical_rows: last accepted rows whose squares, at this share of them, say how large right ones are relative
            to chance; fewest_typical: of them, with fewer it is ``at_first``. A model of few rows is overconfident.
        told_apart: gain by which a change must exceed that of another cause; else both are named. By as much it must
            exceed what is gained if nothing but the last row is wrong.
    """

    chance: float = 1e-8
    undone: float = 1e-3
    change: float = 1e-6
    remaining: float = 1e-3
    fewest_rows: int = 2
    window: int = 12
    spare: int = 3
    typical_rows: int = 30
    typical_share: float = 0.8
    fewest_typical: int = 8
    at_first: float = 2.0
    told_apart: float = 6.0


LIMITS = JudgementLimits()


@dataclass(frozen=True)
class Change:
    """Something that changed between two rows.

    Args:
        row: number of the first row after it. cause: in words. size: in ``unit``. others: causes that explain as much.
        fix: what to do. line: of the row, see :class:`Verdict`.
    """

    row: int
    cause: str
    size: float
    unit: str
    others: tuple[str, ...] = ()
    fix: str = ""
    line: int = 0

    def __str__(self) -> str:
        others = "".join(f", or {name}" for name in self.others)
        by = f"{self.size:.2g} {self.unit} before row {self.line}"
        return f"{self.cause}{others} has changed by about {by}; {self.fix}"


@dataclass(frozen=True)
class Verdict:
    """Verdict of a campaign on a row.

    Args:
        row: its number in the campaign, from 0.
        fits: whether it is where the accepted rows before it predict it; None if they could not yet.
        accepted: whether it was taken in.
        error: how far it is from its prediction, m at the tool: RMS of its numbers. expected: the same as expected.
        cause: the likely cause of a wrong row, in words. change: what changed before it or before earlier rows.
        expected_error: error of the robot over the target after this row, m; None before the first model.
        decided: whether the user accepted or rejected it. again: whether its pose is to be measured again.
        shown: unit in which errors of its kind are shown, and how many of it are a metre at the tool.
        line: number by which texts name the row: its line in the file, see :attr:`Measurements.line_numbers`.
    """

    row: int
    fits: bool | None
    accepted: bool
    error: float = 0.0
    expected: float = 0.0
    cause: str = ""
    change: Change | None = None
    expected_error: float | None = None
    decided: bool = False
    shown: tuple[str, float] = ("mm", 1e3)
    again: bool = False
    line: int = 0

    def __str__(self) -> str:
        again = "; to be measured again" * self.again
        if self.fits is None:
            return f"row {self.line}: not judged yet{self.cause and f' ({self.cause})'}{again}"
        unit, per_metre = self.shown
        size = (
            f"{per_metre * self.error:.3g} {unit} from its prediction, {per_metre * self.expected:.2g} {unit} are usual"
        )
        how = "fits" if self.fits and self.change is None else "looks wrong"
        text = f"row {self.line} {how}: {size}{self.cause and f'; {self.cause}'}{again}"
        return text if self.change is None else f"{text}; {self.change}"

    def entry(self) -> dict[str, Any]:
        """The same for programs: lengths in mm, and the sentence."""
        same = {name: getattr(self, name) for name in ("line", "fits", "accepted", "cause")}
        sizes = {"error_mm": 1e3 * self.error, "usual_mm": 1e3 * self.expected}
        change = None if self.change is None else {k: v for k, v in asdict(self.change).items() if k != "row"}
        return same | sizes | {"change": change, "text": str(self)}


class Seen(NamedTuple):
    """Rows as the accepted ones before them predict them.

    Args:
        numbers: R of them. error: (R,) measured minus predicted, m. covariance: (R, R) with noise, m^2.
    """

    numbers: Numbers
    error: Tensor
    covariance: Tensor

    def given(self, wanted: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """Errors, m, and covariance, m^2, of some numbers given others: masks (R,) of both."""
        cross = self.covariance[wanted][:, known]
        gain = torch.linalg.solve(self.covariance[known][:, known], cross.T).T
        return self.error[wanted] - gain @ self.error[known], self.covariance[wanted][:, wanted] - gain @ cross.T


class Measure(NamedTuple):
    """The distance of a row: d^2, its degrees of freedom, and the RMS of its error and of the expected one, m."""

    square: float
    freedom: int
    error: float
    expected: float

    def fits(self, typical: float, chance: float = LIMITS.chance) -> bool:
        """Whether chance explains it; ``typical``: size of right squares relative to chi-squared."""
        return self.square <= typical * chi2_above(chance, self.freedom)


def measure(seen: Seen, row: int, known: Tensor, freedom: int, some: Tensor | None = None) -> Measure:
    """The distance of a row from what accepted rows and some others say.

    Args:
        seen: rows in order. row: its place. known: (N,) boolean: the rows that count as right. freedom: of the row.
        some: (R,) boolean: which of all numbers count; all of the row by default.
    """
    owner = seen.numbers.owner
    wanted = (owner == row) if some is None else some & (owner == row)
    error, covariance = seen.given(wanted, known[owner] & (owner != row))
    square = float(error @ torch.linalg.solve(covariance, error))
    expected = float(covariance.diagonal().mean().clamp(min=0).sqrt())
    return Measure(square, freedom, float(error.square().mean().sqrt()), expected)


def exchanged(y: Tensor, bodies: int) -> Iterator[tuple[str, Tensor]]:
    """Values (1, m) of a row with two bodies exchanged, in words and numbers."""
    each = y.unflatten(1, (bodies, -1))
    for a, b in combinations(range(bodies), 2):
        order = list(range(bodies))
        order[a], order[b] = b, a
        yield f"markers {a} and {b} seem to be exchanged", each[:, order].flatten(1)


def find_change(
    seen: Seen,
    numbers: list[int],
    causes: Sequence[Cause],
    flags: tuple[Tensor, Tensor],
    *,
    single: Measure,
    typical: float,
    limits: JudgementLimits = LIMITS,
) -> Change | None:
    """Change found among rows in order, the last one included; None if chance explains everything.

    Args:
        seen: N rows as earlier ones predict them. numbers: theirs. causes: effects (N, R, U) on what they tell, m.
        flags: (N,) boolean: the rows that were accepted, and those that a change may explain.
        single: the distance of the last row. typical: see :meth:`Measure.fits`.
    """
    if not causes:
        return None
    known, doubted = flags
    owner, found, sizes = seen.numbers.owner, [], [cause.effects.shape[2] for cause in causes]
    effects = seen.numbers.of_table(torch.cat([cause.effects for cause in causes], 2))
    for first in range(len(numbers) - limits.fewest_rows + 1):
        after = (owner >= first) & doubted[owner]
        error, covariance = seen.given(after, (owner < first) & known[owner])
        low, whole = torch.linalg.cholesky(covariance), torch.cat([error[:, None], effects[after]], 1)
        error, *each = torch.linalg.solve_triangular(low, whole, upper=False).split([1, *sizes], 1)
        white = error[:, 0]
        for cause, B, columns in zip(causes, effects[after].split(sizes, 1), each, strict=True):
            spare = len(white) - B.shape[1]
            if spare < limits.spare:
                continue
            u = torch.linalg.lstsq(columns, white, driver="gelsd").solution
            fit = columns @ u
            gain, left = float(fit.square().sum()) / typical, float((white - fit).square().sum()) / typical
            if left <= chi2_above(limits.remaining, spare):
                found.append((gain - B.shape[1] * log(len(white)), gain, first, cause, B @ u, u, len(white)))
    best = max(found, key=lambda one: one[0], default=None)
    if best is None or chi2_probability(best[1], len(best[5])) > limits.change:
        return None
    score, _, first, cause, moved, u, count = best
    if score < single.square / typical - single.freedom * log(count) + limits.told_apart:
        return None
    others = {one[3].name for one in found if one[0] > score - limits.told_apart} - {cause.name}
    unit, size = cause.unit or ("mm", 1e-3)
    points = 3.0 if cause.basis is None else 3.0 * cause.basis.shape[2] / cause.basis.shape[1]  # numbers of a point
    change = float(u.abs().max()) if cause.unit else float((points * moved.square().mean()).sqrt())
    return Change(numbers[first], cause.name, change / size, unit, tuple(sorted(others)), cause.fix)
