"""Rows of several kinds that no column tells apart: two tools in turn, or payloads of other rows.

Row i is off by c_i E_i u: the unknowns u are the same in all rows, c_i is one of a few codes. By turns u follows from
the codes, and each code from u and the other rows, as in a mixture whose rows are all decided. Codes explain some noise
too: what they explain by chance is measured with the effects of other rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import Evidence, left_out_rms, opened
from diffeo_calib.calibration.diagnostics.moved_devices import MARKERS, changes_of
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import few, sentence
from diffeo_calib.process.process import Process
from diffeo_calib.process.scales import Hyperparameters

ROUNDS = 20
FACTORS = (10.0, 0.1, 1000.0, 0.001, 1 / 0.45359237, 0.45359237)
"""Of one payload that was mistyped, or is in another unit: a digit, g, pounds."""


@dataclass(frozen=True)
class Mixture:
    """Rows of a process, with effects (N, R, U) of unknowns ~ N(0, 1), and the codes (N, K) of which each has one."""

    process: Process
    effects: Tensor
    codes: Tensor

    def columns(self, chosen: Tensor) -> Tensor:
        """Effects (M, U) on the numbers of the process, with a code (N,) for each row."""
        return self.process.numbers.of_table(self.effects * chosen[:, None, None])

    def evidence(self, chosen: Tensor) -> tuple[Tensor, float]:
        """The unknowns (U,) with these codes, and by how much the log evidence grows."""
        found = Evidence.of(self.columns(chosen), self.process)
        eye = torch.eye(len(found.g), dtype=found.g.dtype, device=found.g.device)
        return torch.linalg.solve(found.H + eye, found.g), float(found.log_odds(found.g.new_ones(1)))

    def decided(self, chosen: Tensor, u: Tensor) -> Tensor:
        """(N,) the likeliest code of each row while the others keep theirs."""
        g, h = self.pulls(self.effects @ u[:, None], chosen, u)
        step = self.codes - chosen[:, None]
        best = (2 * step * g - step.square() * h[:, None]).argmax(1, keepdim=True)
        return self.codes.gather(1, best)[:, 0]

    def pulls(self, effects: Tensor, chosen: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """What each row alone says of unknowns of its own beside the codes: g (N, U) and trace of H (N,), see Evidence.

        Args:
            effects: (N, R, U) of these. chosen: (N,) codes. u: unknowns with these.
        """
        owner, e = self.process.numbers.owner, self.process.numbers.of_table(effects)
        left = self.process.mu - self.process.factor.solve(self.columns(chosen) @ u[:, None])[:, 0]
        own = self.process.inverse * (owner[:, None] == owner)
        none = e.new_zeros(len(chosen), e.shape[1])
        return none.index_add(0, owner, e * left[:, None]), none.index_add(0, owner, e * (own @ e)).sum(1)

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

    def left(self, chosen: Tensor) -> float:
        """Part of the RMS left-out error that remains with these codes."""
        return left_out_rms(opened(self.process, self.columns(chosen))) / left_out_rms(self.process)


def two_tools(data: TangentData, scales: Hyperparameters, lines: Tensor) -> str | None:
    """A sentence about markers or tools that take turns; None where they do not.

    Args:
        data: N rows. scales: those of the model. lines: (N,) of the rows in their file.
    """
    rows, some = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)
    change = next((one for one in changes_of(some) if one.name == MARKERS), None)
    if change is None or len(rows) < gates.MIXED_ROWS:
        return None
    process, N = some.process(scales), len(rows)
    E = change.effects * some.place_deviation
    mixed = Mixture(process, E, E.new_tensor([-0.5, 0.5]).expand(N, 2))
    g, h = mixed.pulls(E, E.new_zeros(N), E.new_zeros(E.shape[2]))
    away = g / h.clamp(min=torch.finfo(h.dtype).tiny)[:, None]  # of each row, whatever it weighs
    along = away @ torch.linalg.svd(away - away.mean(0), full_matrices=False).Vh[0]
    k, sums = torch.arange(1, N, device=g.device), (along.sort().values - along.mean()).cumsum(0)[:-1]
    split = along.sort().values[(sums.square() / (k * (N - k))).argmax()]  # N. Otsu, 1979
    chosen, u, _ = mixed.settled(torch.where(along > split, 0.5, -0.5))
    fewer = chosen == (0.5 if float(chosen.mean()) < 0 else -0.5)
    if int(fewer.sum()) < gates.CHANGE_ROWS or (left := mixed.left(chosen)) > gates.TWO_TOOLS_LEFT:
        return None
    motion = some.in_coordinates(E @ u)
    bodies = motion.unflatten(1, (-1, 3 if motion.shape[1] % 3 == 0 else motion.shape[1]))
    moved = 1e3 * float(bodies.norm(dim=2).amax(1).median())
    where = few(lines[rows.to(lines.device)][fewer.to(lines.device)].tolist(), 5)
    return sentence(
        f"{int(fewer.sum())} of {N} rows seem to have another tool or marker, {moved:.3g} mm away: lines {where}",
        expected="one tool",
        got=f"leave-one-out errors that fall to {100 * left:.0f} % with two",
        fix="name the tool of every row in a column (`marker`; or `session` with `remounted`)",
    )


def other_payloads(data: TangentData, scales: Hyperparameters, lines: Tensor) -> str | None:
    """A sentence about payloads that would explain the rows far better than their own; None if none do.

    Args:
        data: N rows. scales: those of the model. lines: (N,) of the rows in their file.
    """
    masses, unit = data.nominal.load.masses.to(data.x), data.nominal.load.unit
    if not data.nominal.load.by_row or len(masses.unique()) > gates.MOST_MASSES or len(masses) < gates.MIXED_ROWS:
        return None
    rows, some = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)
    process, part, own = some.process(scales), some.nominal.sag, masses[rows] / unit
    loaded = torch.arange(part.start, part.stop, device=masses.device)[some.nominal.elasticity.loaded]
    full = some.nominal.under(torch.full_like(own, unit))  # the sag of every row under the same mass
    S = full.sensitivities(some.x, some.theta)[..., loaded]
    sizes = some.prior_variance(replace(scales, payload=1.0))[loaded].sqrt()
    E = some.motions_in_numbers(S if some.slopes is None else some.slopes @ S) * sizes
    mixed = Mixture(process, E, masses.unique() / unit - own[:, None])
    odds = {words: mixed.evidence(other[rows] / unit - own)[1] for words, other in _other_columns(masses, lines)}
    best = max(odds, key=lambda words: odds[words])
    if odds[best] > gates.PAYLOAD_ODDS:
        what, fix = f"the payloads seem to be {best}", "check the column: its order, unit and digits"
        return sentence(what, got=f"log odds of {odds[best]:.0f} against those of the table", fix=fix)
    u, shuffled = process.estimate[loaded] / sizes, torch.randperm(len(own), generator=seeded(0), device=HOST)
    chance = Mixture(process, E[shuffled.to(E.device)], mixed.codes)
    (chosen, _, found), by_chance = (each.settled(each.decided(0 * own, u)) for each in (mixed, chance))
    if found - by_chance[2] < gates.PAYLOAD_ODDS or (left := mixed.left(chosen)) > gates.PAYLOADS_LEFT:
        return None
    wrong = (chosen != 0).to(lines.device)
    where = few(lines[rows.to(lines.device)][wrong].tolist(), 5)
    return sentence(
        f"{int(wrong.sum())} of {len(rows)} rows seem to have carried payloads of other rows, such as lines {where}",
        expected="every payload in the row that carried it",
        got=f"leave-one-out errors that fall to {100 * left:.0f} % so",
        fix="check that the column belongs to these rows; else leave it out",
    )


def _other_columns(masses: Tensor, lines: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Payloads (N,) as they may have been meant, in words: of other lines, or one of them in another unit."""
    order = lines.argsort().to(masses.device)
    for lag in range(1, gates.LARGEST_LAG + 1):
        for way, step in (("later", -lag), ("earlier", lag)):
            yield f"those {lag} line{'s' * (lag > 1)} {way}", masses[order].roll(step)[order.argsort()]
    for mass in masses.unique().tolist():
        for factor in FACTORS:
            yield f"{factor * mass:.4g} where they are {mass:g}", torch.where(masses == mass, factor * mass, masses)
