"""Which hypothesis explains the errors of a calibration best? All of them open unknowns u with effects E_i on row i.

    changes    c_i E_i u, with codes c_i that are zero before a row and one from it on, or that grow with the row number
    mixtures   c_i E_i u, with codes of each row's own, of a few: two tools in turn, payloads of other rows

Those that chance does not explain are compared by the left-out errors that remain with them, each relative to the most
that its kind may leave: the best is named.

Scales that were selected with a change in the rows call it noise; noise that has one sign before a row and the other
after it is still no chance, since each row adds about one to the gain. Gains of changes pay for their unknowns and
their row by the Bayesian information criterion. Codes of a mixture explain some noise too: what they explain by chance
is measured with the effects of other rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import log
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import MARKERS, SampledRows, changes_of, left_out_rms
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut, variance_ratio
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import few, sentence
from diffeo_calib.process.scales import PAYLOAD_FACTORS, Hyperparameters
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.linear_rows import Evidence
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.devices import Hypothesis

ROUNDS = 20  # of the codes of a mixture
MISTYPED = (10.0, 0.1, 1000.0, 0.001, 1 / 0.45359237, 0.45359237)  # payloads with a wrong digit, in g, in pounds
ONE_SET_UP = "one set-up for all rows, in the order of their numbers"
OPENED_M = 0.01
"""Prior RMS motion by what is opened in a model, more than what is found. Larger motions are gross, such as exchanged
markers, and left to the weights of the rows."""
SLOW = (
    "if it stood in several places, name the set-ups in a column (`session`); else let robot and device warm up, and "
    "measure in random order; or name a column of times or temperatures (`time`, `temperature`), with which the model "
    "then drifts"
)


class Candidate(NamedTuple):
    """An explanation that chance does not explain, in words.

    Args:
        left, most: parts of the RMS left-out error that remain with it, and that may remain. opens: the rows for which
            the model holds with its unknowns; none if it shall not have them. columns: (M, U) effects of these, of any
            size; None where a column of the table is wrong.
    """

    what: str
    expected: str
    fix: str
    left: float
    most: float
    opens: str = ""
    columns: Tensor | None = None


class Finding(NamedTuple):
    """The best explanation in a sentence."""

    text: str
    columns: Tensor | None  # (N, R, U) effects, m, of unknowns of unit variance that the model shall have


def judge(
    data: TangentData,
    scales: Hyperparameters,
    left_out: LeaveOneOut,
    lines: Tensor,
    names: Sequence[str],
    *,
    devices: Iterable[Hypothesis],
    bodies: Mapping[str, str],
    opens: bool,
) -> Finding | None:
    """The explanation with which left-out errors fall most, relative to what may remain; None without any.

    Args:
        data, scales, left_out: the rows of a calibration, its scales and left-out errors. lines: (N,) of the rows in
            their file: their order is that of the measurements. names: (N,) of the rows, in words. devices: what may
            change of devices in unknown places. bodies: better names of the measuring device and of what is on the
            tool. opens: whether it may be opened.
    """
    (rows, some), lines = SampledRows.of(data, scales), lines.to(data.x.device)
    if len(rows.index) < 4 * gates.CHANGE_ROWS:
        return None
    changes, sampled = changes_of(some, devices, rows.index), lines[rows.index]
    named = [cause._replace(name=bodies.get(cause.name, cause.name)) for cause in changes]
    own_names = [names[row] for row in rows.index.tolist()]
    causes = [*changed(rows, named, sampled, own_names, excess=max(1.0, variance_ratio(data, left_out)))]
    if len(sampled) >= gates.MIXED_ROWS:
        causes += [tool for cause in changes if cause.name == MARKERS for tool in two_tools(rows, cause.effects, lines)]
        causes += other_payloads(rows, some, data, scales, lines)
    opens &= len(rows.index) == len(data.x)
    return best_of([cause if opens else cause._replace(opens="") for cause in causes], rows)


def best_of(candidates: Iterable[Candidate], rows: SampledRows) -> Finding | None:
    """That with which left-out errors fall most, relative to what may remain."""
    best = min(candidates, key=lambda candidate: candidate.left / candidate.most, default=None)
    if best is None or best.left > best.most:
        return None
    moved = left_out_rms(rows.process) * (1.0 - best.left**2) ** 0.5
    fix, columns = best.fix, None
    got = f"about {1e3 * moved:.2g} mm of error; leave-one-out errors fall to {100 * best.left:.0f} % beside it"
    if best.opens and best.columns is not None and moved < OPENED_M:
        fix += f"; the model holds for {best.opens}"
        columns = rows.in_coordinates(rows.process.numbers.in_table(best.columns))
        columns = OPENED_M * columns / columns[columns.any(2)].square().sum(1).mean().sqrt()
    return Finding(sentence(best.what, expected=best.expected, got=got, fix=fix), columns)


# --- changes during the measurements ----------------------------------------------------------------------------------


class Change(NamedTuple):
    """A hypothesis from a row on, or from two, or drifting over all rows."""

    hypothesis: Hypothesis
    columns: Tensor  # (M, U) effects on the numbers of the rows
    size: Tensor  # (U,) unknowns, of a drift between the first row and the last
    evidence: float  # gain less the price of unknowns and rows by the Bayesian information criterion
    gain: float  # what it explains
    rows: tuple[int, ...]  # the first ones after a change, in the order of measurement; none of a drift

    @classmethod
    def of(
        cls, cause: Hypothesis, process: Process, codes: Sequence[Tensor], rows: Sequence[int], excess: float
    ) -> Change:
        """With codes (N,) of the rows, see above; gains are divided by ``excess``, or by what is left unexplained."""
        columns = torch.cat([process.numbers.of_table(code[:, None, None] * cause.effects) for code in codes], 1)
        evidence = Evidence.of(columns, process)
        gain, unknowns = float(evidence.gain) / max(excess, float(evidence.excess)), columns.shape[1] + len(rows)
        return cls(cause, columns, evidence.size, gain - unknowns * log(len(codes[0])), gain, tuple(sorted(rows)))

    def words(self, rows: SampledRows) -> str:
        """Phrase for the change and its size."""
        name, E, unit, *_ = self.hypothesis
        if len(self.rows) > 1:
            return f"{name} seems to have moved more than once,"
        verb = f"to have {'moved' if unit is None else 'changed'}" if self.rows else "to drift"
        size = float(self.size.abs().max())
        if unit is None:
            distances = rows.distances(E, self.size)
            size = float(distances[distances.amax(1) > 0].median(0).values.max())  # of the marker that moved most
        return f"{name} seems {verb} by about {self.hypothesis.amount(size)}"

    def candidate(self, rows: SampledRows, names: Sequence[str], others: Sequence[Change] = ()) -> Candidate:
        """Explain the rows; names of rows in the order of measurement; others that explain as much."""
        words = ", or ".join(dict.fromkeys(change.words(rows) for change in (self, *others)))
        words += " (these rows do not tell which)" * bool(others)
        words += f" near {' and '.join(names[row] for row in self.rows)}" if self.rows else " over the rows"
        kept = ("the middle of the rows", "the rows before it", "the rows before them")[len(self.rows)]
        fix = f"check what happened then; {self.hypothesis.fix}" if self.rows else SLOW
        left, most = rows.left(self.columns), gates.WORTH ** max(len(self.rows), 1)
        return Candidate(words, ONE_SET_UP, fix, left, most, kept, self.columns)


def changed(
    rows: SampledRows, hypotheses: Sequence[Hypothesis], lines: Tensor, names: Sequence[str], *, excess: float = 1.0
) -> Iterator[Candidate]:
    """The clearest change during the measurements, and clear ones from two rows on; arguments as of :func:`judge`.

    Three set-ups look like a drift, and what moves back looks like little.
    """
    order = lines.argsort()
    tried, in_order = [*changes(hypotheses, rows.process, order, excess)], [names[row] for row in order.tolist()]
    best = max(tried, key=lambda change: change.evidence)
    what, clear = best.hypothesis.name, best.evidence >= gates.CHANGE_EVIDENCE
    least = gates.CHANGE_EVIDENCE + max(best.evidence, 0.0) * bool(best.rows)
    for cause in (each for each in hypotheses if each.unit is None or (clear and each.name == what)):
        twice = changed_twice(cause, rows.process, order, excess)
        if twice.rows[1] - twice.rows[0] >= gates.CHANGE_ROWS and twice.evidence >= least:
            yield twice.candidate(rows, in_order)
    if clear:
        alike = [each for each in tried if bool(each.rows) == bool(best.rows) and each.hypothesis.name != what]
        falls = [min(best.gain - other.gain, best.evidence - other.evidence) for other in alike]
        others = [other for other, fall in zip(alike, falls, strict=True) if fall < gates.CHANGES_TOLD_APART]
        yield best.candidate(rows, in_order, others)


def changed_twice(cause: Hypothesis, process: Process, order: Tensor, excess: float) -> Change:
    """A hypothesis from its two most likely rows on: each is sought once more beside the other one."""
    first, second = _likeliest(*scans([cause.effects], process, order)), 0
    for _ in range(2):
        beside = process.opened(process.numbers.of_table(cause.effects * _from(order, first)[:, None, None]))
        first, second = _likeliest(*scans([cause.effects], beside, order)), first
    return Change.of(cause, process, [_from(order, row) for row in (first, second)], (first, second), excess)


def changes(hypotheses: Sequence[Hypothesis], process: Process, order: Tensor, excess: float = 1.0) -> Iterator[Change]:
    """Every hypothesis from its most likely row on, and drifting; ``order``: (N,) rows in the order of measurement."""
    ramp = order.argsort().to(process.mu) / (len(order) - 1) - 0.5
    for cause, scan in zip(hypotheses, scans([cause.effects for cause in hypotheses], process, order), strict=True):
        row = _likeliest(scan)
        yield Change.of(cause, process, [_from(order, row)], [row], excess)
        yield Change.of(cause, process, [ramp], [], excess)


def scans(effects: Sequence[Tensor], process: Process, order: Tensor) -> Iterator[Evidence]:
    """For each of some effects (N, R, U) the evidence of changes from every row of the order on, (N, U) and (N, U, U).

    H of the rows from k on is that of the rows from k + 1 on, and what row k adds with itself and with these.
    """
    numbers, place = process.numbers, order.argsort().to(process.mu)[process.numbers.owner]
    later = process.inverse * (0.5 + 0.5 * (place - place[:, None]).sign())  # half of that of a row with itself
    total, count = float(numbers.target @ process.mu), len(place)
    for E in effects:
        g = (E * numbers.in_table(process.mu)[..., None]).sum(1)
        H = E.mT @ numbers.in_table(later @ numbers.of_table(E))
        g, H = (each[order].flip(0).cumsum(0).flip(0) for each in (g, H + H.mT))
        yield Evidence(g, H, total, count)


def _likeliest(scan: Evidence) -> int:
    """Place in the order of the row from which a change explains most, some rows on either side."""
    fewest = gates.CHANGE_ROWS
    return fewest + int(scan.gain[fewest : len(scan.g) - fewest + 1].argmax())


def _from(order: Tensor, row: int) -> Tensor:
    """Codes (N,) of a change from a row of the order on."""
    return (order.argsort() >= row).double()


# --- rows of several kinds --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mixture:
    """Rows with effects (N, R, U) of unknowns ~ N(0, 1), each with one of K codes (N, K) that no column tells.

    By turns the unknowns follow from the codes, and each code from these and the other rows, as in a mixture whose
    rows are all decided.
    """

    rows: SampledRows
    effects: Tensor
    codes: Tensor

    def evidence(self, chosen: Tensor) -> tuple[Tensor, float]:
        """The unknowns (U,) with these codes (N,), and by how much the log evidence grows."""
        evidence = Evidence.of(self.rows.columns(self.effects, chosen), self.rows.process)
        eye = torch.eye(len(evidence.g), dtype=evidence.g.dtype, device=evidence.g.device)
        return torch.linalg.solve(evidence.H + eye, evidence.g), float(evidence.log_odds(evidence.g.new_ones(1)))

    def pulls(self, chosen: Tensor, u: Tensor) -> Evidence:
        """What each row alone says of unknowns of its own beside the codes: g (N, U) and H (N, U, U)."""
        process, numbers = self.rows.process, self.rows.process.numbers
        left = process.mu - process.inverse @ (self.rows.columns(self.effects, chosen) @ u)
        blocks = numbers.blocks(process.inverse)
        g = (self.effects * numbers.in_table(left)[..., None]).sum(1)
        return Evidence(g, self.effects.mT @ blocks @ self.effects)

    def decided(self, chosen: Tensor, u: Tensor) -> Tensor:
        """(N,) the likeliest code of each row while the others keep theirs."""
        pulls, step = self.pulls(chosen, u), self.codes - chosen[:, None]
        best = 2 * step * (pulls.g @ u)[:, None] - step.square() * (pulls.H @ u @ u)[:, None]
        return self.codes.gather(1, best.argmax(1, keepdim=True))[:, 0]

    def settled(self, chosen: Tensor) -> tuple[Tensor, Tensor, float]:
        """Codes, unknowns and log evidence from these codes on."""
        u, odds = self.evidence(chosen)
        for _ in range(ROUNDS):
            other = self.decided(chosen, u)
            better = self.evidence(other)
            if better[1] <= odds:
                break
            chosen, (u, odds) = other, better
        return chosen, u, odds


def two_tools(rows: SampledRows, effects: Tensor, lines: Tensor) -> Iterator[Candidate]:
    """Markers or tools that take turns, by the effects (N, R, U) of their shifts; lines of all rows."""
    E, N = effects * PLACES.found_m_rad, len(effects)
    mixed = Mixture(rows, E, E.new_tensor([-0.5, 0.5]).expand(N, 2))
    pulls = mixed.pulls(E.new_zeros(N), E.new_zeros(E.shape[2]))
    size = pulls.H.diagonal(dim1=1, dim2=2).sum(1, keepdim=True)
    away = pulls.g / size.clamp(min=torch.finfo(size.dtype).tiny)  # of each row, whatever it weighs
    along = away @ torch.linalg.svd(away - away.mean(0), full_matrices=False).Vh[0]
    k, sums = torch.arange(1, N, device=E.device), (along.sort().values - along.mean()).cumsum(0)[:-1]
    split = along.sort().values[(sums.square() / (k * (N - k))).argmax()]  # N. Otsu, 1979
    chosen, u, _ = mixed.settled(torch.where(along > split, 0.5, -0.5))
    fewer = chosen == (0.5 if float(chosen.mean()) < 0 else -0.5)
    if int(fewer.sum()) >= gates.CHANGE_ROWS:
        moved = 1e3 * float(rows.distances(E, u).amax(1).median())
        what = f"{int(fewer.sum())} of {N} rows seem to have another tool or marker, {moved:.3g} mm away: lines "
        fix = "name the tool of every row in a column (`marker`; or `session` with `remounted`)"
        what += few(lines[rows.index][fewer].tolist(), 5)
        columns = rows.columns(E, fewer.to(E))
        yield Candidate(what, "one tool", fix, rows.left(columns), gates.TWO_TOOLS_LEFT, "the other rows", columns)


def other_payloads(
    rows: SampledRows, some: TangentData, data: TangentData, scales: Hyperparameters, lines: Tensor
) -> Iterator[Candidate]:
    """Payloads that would explain the rows far better than their own."""
    load, sag = data.nominal.load, data.nominal.elasticity
    if not load.by_row or sag is None:
        return
    masses, expected = load.masses.to(data.x), "every payload in the row that carried it"
    loaded = torch.arange(data.nominal.sag.start, data.nominal.sag.stop, device=masses.device)[sag.loaded]
    full = some.nominal.under(torch.full_like(masses[rows.index], load.unit))  # the sag of every row under one mass
    sizes = some.prior_variance(replace(scales, payload=1.0))[loaded].sqrt()
    E = some.motions_in_numbers(some.slopes @ full.sensitivities(some.x, some.theta)[..., loaded]) * sizes

    def under(codes: Tensor, factor: float) -> Process:
        return replace(rows.process, factor=rows.process.factor.with_features(loaded, factor * rows.columns(E, codes)))

    columns = {"": masses} | dict(_other_columns(masses, lines))
    codes = {words: other[rows.index] / float(other.max()) for words, other in columns.items()}
    odds = {words: max((under(code, f).evidence, f) for f in PAYLOAD_FACTORS[::2]) for words, code in codes.items()}
    best = max(odds, key=lambda words: odds[words])
    if odds[best][0] > odds[""][0] + gates.PAYLOAD_ODDS:
        what, fix = f"the payloads seem to be {best}", "check the column: its order, unit and digits"
        left = left_out_rms(under(codes[best], odds[best][1])) / left_out_rms(rows.process)
        yield Candidate(what, expected, fix, left, gates.WORTH)
    if len(kinds := masses.unique() / load.unit) > gates.MOST_MASSES:
        return
    own, without = codes[""], rows._replace(process=under(codes[""], 0.0))
    shuffled = torch.randperm(len(own), generator=seeded(0), device=HOST).to(E.device)
    right, chance = (Mixture(without, each, kinds.expand(len(own), -1)) for each in (E, E[shuffled]))
    axes = sag.own[sag.loaded].to(E)
    (chosen, gain), (_, by_chance) = (_likeliest_codes(each, own, axes) for each in (right, chance))
    if gain - by_chance >= gates.PAYLOAD_ODDS:
        what = f"{int((chosen != own).sum())} of {len(own)} rows seem to have carried payloads of other rows, such as "
        what += f"lines {few(lines[rows.index][chosen != own].tolist(), 5)}"
        fix = "check that the column belongs to these rows; else leave it out"
        left = left_out_rms(under(chosen, 1.0)) / left_out_rms(rows.process)
        yield Candidate(what, expected, fix, left, gates.PAYLOADS_LEFT)


def _likeliest_codes(mixed: Mixture, given: Tensor, axes: Tensor) -> tuple[Tensor, float]:
    """Codes (N,) beside the rows' own, and how much more they explain; joints yield about their axes, in one sense."""
    u, odds = mixed.evidence(given)
    trials = [mixed.settled(mixed.decided(given, start)) for start in (u, axes, -axes)]
    chosen, _, best = max(trials, key=lambda trial: trial[2])
    return chosen, best - odds


def _other_columns(masses: Tensor, lines: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Payloads (N,) as they may have been meant, in words: of other lines, or some of them in another unit."""
    order, kinds = lines.argsort(), masses.unique()
    for lag in range(1, gates.LARGEST_LAG + 1):
        for way, step in (("later", -lag), ("earlier", lag)):
            yield f"those {lag} line{'s' * (lag > 1)} {way}", masses[order].roll(step)[order.argsort()]
    for mass in kinds[kinds > 0].tolist() if len(kinds) <= gates.MOST_MASSES else ():
        which = {"are": masses == mass, "are at least": masses >= mass, "are at most": masses <= mass}
        for (words, some), factor in product(which.items(), MISTYPED):
            yield f"{factor:.4g} times as large where they {words} {mass:g}", torch.where(some, factor * masses, masses)
