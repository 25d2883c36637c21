"""Is a new row right? By its distance from what the accepted rows predict, and by what explains a larger one.

A row is judged by d^2 = e^T S^-1 e, chi-squared if it is right. Two kinds of causes explain errors:

* of one row: its unit, its joints are those of another row, two markers are exchanged, one marker is wrong. A cause is
  named if the row fits when it is undone.
* from a row k on: a device has moved, a marker has slipped, a joint has another offset. By chance such a hypothesis
  gains chi-squared (regression/conditional.py) from the errors of the last rows. Rows that were taken in one by one
  count again here: small changes show in several rows only. A single wrong row, which six unknowns of a device explain
  as well, is no change, whichever of them it is: it may have been taken in, and rows near it seem to be wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import log
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.common.device import HOST
from diffeo_calib.common.quantiles import chi2_above, chi2_probability
from diffeo_calib.maps.linearisation import Numbers
from diffeo_calib.maps.noise import HIDDEN_VARIANCE
from diffeo_calib.regression.conditional import Features, Process
from diffeo_calib.regression.linear_rows import Evidence
from diffeo_calib.sensors.devices import Hypothesis


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
        """The verdict for programs: lengths in mm, and the sentence."""
        same = {name: getattr(self, name) for name in ("line", "fits", "accepted", "cause")}
        sizes = {"error_mm": 1e3 * self.error, "usual_mm": 1e3 * self.expected}
        change = None if self.change is None else {k: v for k, v in asdict(self.change).items() if k != "row"}
        return same | sizes | {"change": change, "text": str(self)}


class Measure(NamedTuple):
    """The distance of a row: d^2, its degrees of freedom, and the RMS of its error and of the expected one, m."""

    square: float
    freedom: int
    error: float
    expected: float

    def fits(self, typical: float, chance: float = gates.WRONG_ROW_CHANCE) -> bool:
        """Whether chance explains it; ``typical``: size of right squares relative to chi-squared."""
        return self.square <= typical * chi2_above(chance, self.freedom)


class Seen(NamedTuple):
    """Rows as accepted ones before them predict them.

    Args:
        numbers: of the rows. error: (R,) of R of them, measured minus predicted, m. covariance: (R, R) with noise, m^2.
    """

    numbers: Numbers
    error: Tensor
    covariance: Tensor

    @classmethod
    def of(cls, process: Process, numbers: Numbers, noise: Tensor, at: Features) -> Seen:
        """All numbers, with noise (N, R, R) of the rows, m^2; ``at``: their features."""
        error = numbers.target - numbers.there(process.mean(at))
        return cls(numbers, error, numbers.with_noise(at.between(), noise))

    def some(self, wanted: Tensor) -> Seen:
        """Some of them, (R,) boolean."""
        return Seen(self.numbers, self.error[wanted], self.covariance[wanted][:, wanted])

    def measure(self, freedom: int) -> Measure:
        """Their distance, with so many degrees of freedom."""
        square = float(self.error @ torch.linalg.solve(self.covariance, self.error))
        expected = float(self.covariance.diagonal().mean().clamp(min=0).sqrt())
        return Measure(square, freedom, float(self.error.square().mean().sqrt()), expected)

    def one_wrong(self, used: Tensor, typical: float, count: int) -> float:
        """The most that one wrong row explains of some numbers (R,), less the price of its own among so many."""
        some, owner, scores = self.some(used), self.numbers.owner[used], []
        precision = torch.linalg.inv(some.covariance)
        for row in owner.unique():
            mask, solved = owner == row, precision[owner == row] @ some.error
            gain = float(solved @ torch.linalg.solve(precision[mask][:, mask], solved))
            scores.append(gain / typical - len(solved) * log(count))
        return max(scores)

    def in_order(self, accepted: Tensor) -> tuple[Tensor, Callable[[int, int], Seen]]:
        """One row after the other, each as those before it predict it that are accepted, (N,) boolean.

        Returns:
            lower Cholesky factor of the covariance, in which rows that are not accepted tell nothing; and a function:
            rows from one to before another, as the accepted ones before them predict them.
        """
        owner = self.numbers.owner
        hidden = HIDDEN_VARIANCE * (~accepted[owner]).to(self.error)
        root = torch.linalg.cholesky(self.covariance + torch.diag(hidden))
        white = torch.linalg.solve_triangular(root, self.error[:, None], upper=False)[:, 0]

        def rows(first: int, last: int) -> Seen:
            start, end = (int((owner < row).sum()) for row in (first, last))
            part, before = slice(start, end), root[start:end, :start]
            numbers = self.numbers.rows(torch.arange(first, last, device=owner.device))
            error = self.error[part] - before @ white[:start]
            return Seen(numbers, error, self.covariance[part, part] - before @ before.T)

        return root, rows


def find_change(
    view: Seen,
    numbers: list[int],
    hypotheses: Sequence[Hypothesis],
    flags: tuple[Tensor, Tensor],
    *,
    typical: float,
    coordinates: int,
) -> Change | None:
    """Change found among rows in order, the last one included; None if chance explains everything.

    Args:
        view: N rows as earlier ones predict them. numbers: theirs. hypotheses: effects (N, R, U) on what they tell, m.
        flags: (N,) boolean: the rows that were accepted, and those that a change may explain.
        typical: see :meth:`Measure.fits`. coordinates: of the points of a row.
    """
    if not hypotheses:
        return None
    accepted, doubted = (flag[view.numbers.owner] for flag in flags)
    later = view.numbers.owner >= torch.arange(len(numbers) - gates.ROWS_AFTER_CHANGE + 1, device=HOST)[:, None]
    after = later & doubted  # (F, M) numbers, for each first row of a change
    used = after | (~later & accepted)
    effects = [view.numbers.of_table(hypothesis.effects) for hypothesis in hypotheses]
    every = torch.cat([view.error[:, None], *effects], 1)
    right = every.new_zeros(*used.shape, every.shape[1])
    for first, mask in enumerate(used):  # given the rows before, which come first
        both = every[mask].clone()
        both[:, 1:] *= after[first, mask, None]
        root = torch.linalg.cholesky(view.covariance[mask][:, mask])
        right[first, mask] = torch.linalg.solve_triangular(root, both, upper=False)
    right *= after[:, :, None]
    white, W = right[:, :, 0], right[:, :, 1:]
    counts, total = after.sum(1).tolist(), (white.square().sum(1) / typical).tolist()
    g, H, candidates, start = (W.mT @ white[:, :, None])[..., 0], W.mT @ W, [], 0
    for hypothesis, E in zip(hypotheses, effects, strict=True):
        size, part = E.shape[1], slice(start, start + E.shape[1])
        start += size
        u = Evidence(g[:, part], H[:, part, part]).size
        for first, gain in enumerate(((g[:, part] * u).sum(1) / typical).tolist()):
            rows, spare = counts[first], counts[first] - size
            if spare >= gates.SPARE_NUMBERS and total[first] - gain <= chi2_above(gates.LEFT_CHANCE, spare):
                moved = E[after[first]] @ u[first]
                candidates.append((gain - size * log(rows), gain, first, hypothesis, moved, u[first], rows))
    best = max(candidates, key=lambda choice: choice[0], default=None)
    if best is None or chi2_probability(best[1], len(best[5])) > gates.JUMP_CHANCE:
        return None
    score, _, first, what, moved, u, count = best
    if score < view.one_wrong(used[first], typical, count) + gates.CHANGES_TOLD_APART:
        return None
    others = {choice[3].name for choice in candidates if choice[0] > score - gates.CHANGES_TOLD_APART} - {what.name}
    unit, size = what.unit or ("mm", 1e-3)
    points = 3.0 * view.numbers.shape[1] / coordinates  # numbers of a point
    change = float(u.abs().max()) if what.unit else float((points * moved.square().mean()).sqrt())
    return Change(numbers[first], what.name, change / size, unit, tuple(sorted(others)), what.fix)
