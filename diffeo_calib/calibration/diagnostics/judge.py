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
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import (
    MARKERS,
    SampledRows,
    changes_of,
    left_out_rms,
    worth_it,
)
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut, variance_ratio
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import few, sentence, warn_user
from diffeo_calib.process.evidence import Evidence
from diffeo_calib.process.scales import PAYLOAD_FACTORS, Hyperparameters
from diffeo_calib.regression.conditional import Process
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.devices import Hypothesis

ROUNDS = 20  # of the codes of a mixture
MISTYPED = (10.0, 0.1, 1000.0, 0.001, 1 / 0.45359237, 0.45359237)  # payloads with a wrong digit, in g, in pounds
ONE_SET_UP = "one set-up for all rows, in the order of their numbers"
NOTHING = torch.zeros(0, 0, dtype=torch.float64, device=HOST)
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
        left, most: parts of the RMS left-out error that remain with it, and that may remain. columns: (M, U) effects of
            unknowns of any size that it opens. opens: the rows for which the model then holds; none if it is not to.
    """

    what: str
    expected: str
    fix: str
    left: float
    most: float
    opens: str = ""
    columns: Tensor = NOTHING


class Finding(NamedTuple):
    """The best explanation in a sentence."""

    text: str
    columns: Tensor | None  # (N, R, U) effects, m, of unknowns of unit variance that the model shall have
    of_table: bool  # whether a column of the table is wrong, which explains wrong rows, too


def judge(
    data: TangentData,
    scales: Hyperparameters,
    left_out: LeaveOneOut,
    lines: Tensor,
    names: Sequence[str],
    *,
    devices: Iterable[Hypothesis] = (),
    bodies: Mapping[str, str] = MappingProxyType({}),
    opens: bool = True,
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
    if best.opens and moved < OPENED_M:
        fix += f"; the model holds for {best.opens}"
        columns = rows.in_coordinates(rows.process.numbers.in_table(best.columns))
        columns = OPENED_M * columns / columns[columns.any(2)].square().sum(1).mean().sqrt()
    return Finding(sentence(best.what, expected=best.expected, got=got, fix=fix), columns, best.columns is NOTHING)


# --- changes during the measurements ----------------------------------------------------------------------------------


class Change(NamedTuple):
    """A hypothesis from a row on, or drifting over all rows."""

    hypothesis: Hypothesis
    codes: Tensor  # (N,) of the rows, see above
    size: Tensor  # (U,) unknowns, of a drift between the first row and the last
    gain: float  # what it explains
    row: int | None  # the first one after a change, in the order of measurement; None for a drift

    @property
    def evidence(self) -> float:
        """Gain less the price of the unknowns by the Bayesian information criterion; the row is one more."""
        return self.gain - (len(self.size) + (self.row is not None)) * log(len(self.codes))

    def words(self, rows: SampledRows) -> str:
        """Phrase for the change and its size."""
        name, verb = self.hypothesis.name, "to drift" if self.row is None else "to have moved"
        if self.hypothesis.unit is not None:
            verb = verb if self.row is None else "to have changed"
            return f"{name} seems {verb} by about {self.hypothesis.amount(float(self.size.abs().max()))}"
        distances = rows.distances(self.hypothesis.effects, self.size)
        typical = distances[distances.amax(1) > 0].median(0).values  # of each marker
        return f"{name} seems {verb} by about {self.hypothesis.amount(float(typical.max()))}"


def changed(
    rows: SampledRows, hypotheses: Sequence[Hypothesis], lines: Tensor, names: Sequence[str], *, excess: float = 1.0
) -> Iterator[Candidate]:
    """The clearest change during the measurements; arguments as of :func:`changes` and :func:`judge`."""
    process, order = rows.process, lines.argsort()
    tried = [*changes(hypotheses, process, order, excess=excess)]
    best = max(tried, key=lambda change: change.evidence)
    what, _, _, advice, *_ = best.hypothesis
    sudden, clear = best.row is not None, best.evidence >= gates.CHANGE_EVIDENCE
    once, fix = sudden * max(best.evidence, 0.0), f"check what happened then; {advice}"
    for cause in (each for each in hypotheses if each.unit is None or (clear and each.name == what)):
        yield from changed_twice(rows, cause, order, names, once, excess=excess)
    if not clear:
        return
    alike = [each for each in tried if (each.row is not None) == sudden and each.hypothesis.name != what]
    falls = [min(best.gain - other.gain, best.evidence - other.evidence) for other in alike]
    others = [other for other, fall in zip(alike, falls, strict=True) if fall < gates.CHANGES_TOLD_APART]
    words = ", or ".join(dict.fromkeys(change.words(rows) for change in (best, *others)))
    words += " (these rows do not tell which)" * bool(others)
    words += " over the rows" if best.row is None else f" near {names[order[best.row]]}"
    kept, advice = ("the rows before it", fix) if sudden else ("the middle of the rows", SLOW)
    columns = rows.columns(best.hypothesis.effects, best.codes)
    yield Candidate(words, ONE_SET_UP, advice, rows.left(columns), gates.WORTH, kept, columns)


def changed_twice(
    rows: SampledRows, hypothesis: Hypothesis, order: Tensor, names: Sequence[str], once: float, *, excess: float
) -> Iterator[Candidate]:
    """Three set-ups, which look like a drift, or what moves back, which looks like little.

    Each change is sought once more beside the other one. ``once``: evidence of a single one; others as of
    :func:`changes`.
    """
    (what, E, _, advice, *_), process = hypothesis, rows.process
    first, second = _likeliest(*scans([E], process, order)), 0
    for _ in range(2):
        beside = process.opened(rows.columns(E, _from(order, first)))
        first, second = _likeliest(*scans([E], beside, order)), first
    columns = torch.cat([rows.columns(E, _from(order, row)) for row in (first, second)], 1)
    both = Evidence.of(columns, process)
    evidence = float(both.gain) / max(excess, float(both.excess)) - (columns.shape[1] + 2) * log(len(order))
    if abs(first - second) >= gates.CHANGE_ROWS and evidence >= once + gates.CHANGE_EVIDENCE:
        near = " and ".join(names[order[row]] for row in sorted((first, second)))
        words, fix = f"{what} seems to have moved more than once, near {near}", f"check what happened then; {advice}"
        yield Candidate(words, ONE_SET_UP, fix, rows.left(columns), gates.WORTH**2, "the rows before them", columns)


def changes(
    hypotheses: Sequence[Hypothesis], process: Process, order: Tensor, *, excess: float = 1.0
) -> Iterator[Change]:
    """Every hypothesis from its most likely row on, and drifting.

    Gains are divided by ``excess``, or by the mean square of what is left unexplained where that is larger.
    ``order``: (N,) row numbers in the order of measurement.
    """
    ramp = order.argsort().to(process.mu) / (len(order) - 1) - 0.5
    for cause, scan in zip(hypotheses, scans([cause.effects for cause in hypotheses], process, order), strict=True):
        row = _likeliest(scan)
        jump = scan._replace(g=scan.g[row], H=scan.H[row])
        drift = Evidence.of(process.numbers.of_table(ramp[:, None, None] * cause.effects), process)
        for evidence, codes, first in ((jump, _from(order, row), row), (drift, ramp, None)):
            gain = float(evidence.gain) / max(excess, float(evidence.excess))
            yield Change(cause, codes, evidence.size, gain, first)


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
    """Payloads that would explain the rows far better than their own.

    Args:
        rows, some: those that are judged, and their measurements. data, lines: all rows, and theirs in their file.
    """
    load, sag = data.nominal.load, data.nominal.elasticity
    if not load.by_row or sag is None:
        return
    masses, expected = load.masses.to(data.x), "every payload in the row that carried it"
    loaded = torch.arange(data.nominal.sag.start, data.nominal.sag.stop, device=masses.device)[sag.loaded]
    full = some.nominal.under(torch.full_like(masses[rows.index], load.unit))  # the sag of every row under one mass
    sizes = some.prior_variance(replace(scales, payload=1.0))[loaded].sqrt()
    E = some.motions_in_numbers(some.slopes @ full.sensitivities(some.x, some.theta)[..., loaded]) * sizes

    def under(codes: Tensor, factor: float) -> Process:
        return rows.process.with_effects(loaded, factor * rows.columns(E, codes))

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
    (chosen, gain), (_, by_chance) = (
        _likeliest_codes(each, own, sag.own[sag.loaded].to(E)) for each in (right, chance)
    )
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


def warn_of_taken_scales(taken: LeaveOneOut, chosen: LeaveOneOut) -> None:
    """Warn if left-out errors prove that the scales of other robots are not those of these rows."""
    if worth_it(taken.errors, chosen.errors):
        left = float((chosen.errors.square().nansum() / taken.errors.square().nansum()).sqrt())
        got = f"leave-one-out errors that fall to {100 * left:.0f} % with scales of their own"
        warn_user(sentence("`scales_of` does not suit these rows", got=got, fix="leave it out (--scales-of)"))
