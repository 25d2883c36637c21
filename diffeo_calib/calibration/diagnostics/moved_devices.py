"""Did something change during the measurements? The tripod, the robot's foot, a marker, a joint offset, a zero.

Something that changes at row k has effects that are zero before; their gain (hypotheses.py) is chi-squared with one
degree of freedom per unknown if nothing changed. Scales that were selected with the change in the rows call it noise;
noise that has one sign before a row and the other after it is still no chance, since each row adds about one to the
gain. Chance makes the largest of the gains of all rows exceed t with probability

    t^(U/2) e^(-t/2) / (2^(U/2) Gamma(U/2)) ((1 - U/t) log((1 - e)^2 / e^2) + 4/t),    e: share of the rows left out

(M. Csorgo, L. Horvath, "Limit theorems in change-point analysis", 1997, section 1.3). What drifts with the row number
has one set of effects for all rows, and gains chi-squared.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import exp, lgamma, log
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import Evidence, left_out_rms, opened
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence
from diffeo_calib.common.quantiles import chi2_median, chi2_probability
from diffeo_calib.kinematics.nominal import rigid_motions
from diffeo_calib.process.process import Process
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.process.tails import FACTORS
from diffeo_calib.sensors.devices import Hypothesis
from diffeo_calib.sensors.set_ups import frame_slopes

BASE, MARKERS = "the measuring device or the robot's base", "a marker or the tool"
SCALE = "the scale of the device or the size of the robot"
NEW_SET_UP = "name the set-ups in a column (`session`), or use the rows before or after it"
TWO_ROBOTS = "calibrate the rows before it, and recalibrate that model with the rows after it"
SLOW = (
    "if it stood in several places, name the set-ups in a column (`session`); else let robot and device warm up, and "
    "measure in random order; or name a column of times or temperatures (`time`, `temperature`), with which the model "
    "then drifts"
)

VARIATION_M = torch.logspace(-6, -2, 41, dtype=torch.float64, device="cpu")
"""RMS motions by a number that differs from row to row."""


class Finding(NamedTuple):
    """A hypothesis that explains errors: from a row on, or drifting over all rows."""

    hypothesis: Hypothesis  # what, with effects (N, R, U)
    columns: Tensor  # (N, R, U) its effects in the rows
    size: Tensor  # (U,) of a drift between the first row and the last
    gain: float  # what it explains
    row: int | None  # the first one after a change, in the order of measurement; None for a drift

    @property
    def evidence(self) -> float:
        """Gain less the price of the unknowns by the Bayesian information criterion; the row is one more."""
        return self.gain - (len(self.size) + (self.row is not None)) * log(len(self.columns))

    @property
    def displacement(self) -> float:
        """RMS motion of a row by it, over the rows that show it, m."""
        moved = (self.columns @ self.size).square().sum(1)
        return float(moved[moved > 0].mean().nan_to_num(0.0).sqrt())

    @property
    def chance(self) -> float:
        """Probability that chance alone gains as much."""
        if self.row is None:
            return chi2_probability(self.gain, len(self.size))
        return chance_of_jump(self.gain, len(self.size), gates.CHANGE_ROWS / len(self.columns))

    def words(self, data: TangentData) -> str:
        """Phrase for the change and its size."""
        name, verb = self.hypothesis.name, "to drift" if self.row is None else "to have moved"
        if self.hypothesis.unit is not None:
            verb = verb if self.row is None else "to have changed"
            return f"{name} seems {verb} by about {self.hypothesis.amount(float(self.size.abs().max()))}"
        motion = data.in_coordinates(self.hypothesis.effects @ self.size)
        size = 3 if motion.shape[1] % 3 == 0 else motion.shape[1]
        distances = motion.unflatten(1, (-1, size)).norm(dim=-1)  # of every marker
        typical = distances[distances.amax(1) > 0].median(0).values
        distance = float(typical[typical > 0].median())
        if name == MARKERS and data.basis is None:
            distance = float(typical.max())
            single = float(typical.min()) < gates.OTHER_MARKERS * distance
            name = f"marker {int(typical.argmax())}" if single else name
        return f"{name} seems {verb} by about {self.hypothesis.amount(distance)}"


def change_during(
    numbers: Tensor,
    data: TangentData,
    scales: Hyperparameters,
    left_out: LeaveOneOut,
    devices: Iterable[Hypothesis] = (),
    *,
    bodies: Mapping[str, str] = MappingProxyType({}),
) -> str | None:
    """A sentence about the clearest change during the measurements, with the row, the size and what to do; or None.

    Args:
        numbers: (N,) numbers of the rows; their order is that of the measurements.
        data: the measurements. scales: those of the model. left_out: leave-one-out errors with these.
        devices: what may change of devices in unknown places. bodies: better names of :data:`BASE` and :data:`MARKERS`.
    """
    rows, some = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)
    if len(rows) < 4 * gates.CHANGE_ROWS:
        return None
    least = gates.CHANGE_NOISE_SHARE * float(some.new_noise(scales).trace().sqrt())
    numbers, process = numbers.to(rows.device)[rows], some.process(scales)
    order = numbers.argsort()
    usual = data.noise_model.of_freedom(chi2_median, left_out.squares)
    excess = max(1.0, float((left_out.squares / usual).nanmedian()))  # of errors that the scales understate
    changes = [one._replace(name=bodies.get(one.name, one.name)) for one in changes_of(some, devices, rows)]
    found = findings(changes, process, order, excess=excess)
    likely = [one for one in found if one.displacement > least]
    if not likely or len(found) * min(one.chance for one in likely) > gates.CHANGE_CHANCE:
        return None
    best = max(likely, key=lambda one: one.evidence)
    what, fix = best.hypothesis.name, best.hypothesis.fix

    def as_good(one: Finding) -> bool:
        apart = min(best.gain - one.gain, best.evidence - one.evidence)
        same = (one.row is None) == (best.row is None)
        return same and one.hypothesis.name != what and apart < gates.CHANGES_TOLD_APART

    words = dict.fromkeys(one.words(some) for one in (best, *filter(as_good, likely)))
    before, after = left_out_rms(process), left_out_rms(opened(process, process.numbers.of_table(best.columns)))
    if best.row is None and (moved := moved_twice(best.hypothesis.effects, process, order, after)):
        lines = " and ".join(str(int(numbers[order[row]])) for row in moved)
        text = f"{what} seems to have moved more than once, near rows {lines}"
        return sentence(text, expected="one set-up for all rows", fix=f"check what happened then; {fix}")
    if after > gates.WORTH * before:
        return None
    where = "over the rows" if best.row is None else f"near row {int(numbers[order[best.row]])}"
    return sentence(
        f"{', or '.join(words)}{' (these rows do not tell which)' * any(map(as_good, likely))} {where}",
        expected="one set-up for all rows, in the order of their numbers",
        got=f"leave-one-out errors that fall to {100 * after / before:.0f} % with this change in the model",
        fix=SLOW if best.row is None else f"check what happened then; {fix}",
    )


def findings(
    hypotheses: Sequence[Hypothesis], process: Process, order: Tensor, *, excess: float = 1.0
) -> list[Finding]:
    """Every hypothesis from its most likely row on, and drifting.

    Gains are divided by ``excess``, or by the mean square of what is left unexplained where that is larger.
    ``order``: (N,) row numbers in the order of measurement.
    """
    found = []
    for one in hypotheses:
        for first in (change_row(one.effects, process, order), None):
            columns = _shown(one.effects, order, first)
            evidence = Evidence.of(process.numbers.of_table(columns), process)
            gain = float(evidence.gain) / max(excess, evidence.excess)
            found.append(Finding(one, columns, evidence.size, gain, first))
    return found


def change_row(effects: Tensor, process: Process, order: Tensor) -> int:
    """Place in the order (N,) of the row from which effects (N, R, U) explain most, some rows on either side."""
    (n, _, unknowns), owner, fewest = effects.shape, process.numbers.owner, gates.CHANGE_ROWS
    E = process.numbers.of_table(effects)

    def by_row(values: Tensor) -> Tensor:
        """Sums over the numbers of each row, the last row first: (M, k) -> (N, k)."""
        return values.new_zeros(n, values.shape[1]).index_add_(0, owner, values)[order].flip(0)

    g = by_row(E * process.mu[:, None]).cumsum(0)
    H = E.new_empty(n, unknowns, unknowns)  # of the last 1 ... N rows
    for u in range(unknowns):
        half = by_row(E[:, u, None] * process.inverse)  # (N, M)
        for v in range(u + 1):
            H[:, u, v] = H[:, v, u] = by_row((half * E[:, v]).T).cumsum(0).cumsum(1).diagonal()
    return n - fewest - int(Evidence(g, H).gain[fewest - 1 : n - fewest].argmax())


def _shown(effects: Tensor, order: Tensor, row: int | None) -> Tensor:
    """Effects (N, R, U) from a row of the order on; of a drift from -1/2 in the first row to 1/2 in the last."""
    place = order.argsort()
    shares = place.double() / (len(order) - 1) - 0.5 if row is None else (place >= row).double()
    return shares.to(effects)[:, None, None] * effects


def moved_twice(effects: Tensor, process: Process, order: Tensor, left: float) -> tuple[int, int] | None:
    """First rows after two sudden changes that leave less than the RMS left-out error, m, of a drift; else None.

    Three set-ups look like a drift. The first change is sought once more beside the second one.
    """

    def with_changes(*rows: int) -> Process:
        columns = torch.cat([_shown(effects, order, row) for row in rows], 2)
        return opened(process, process.numbers.of_table(columns))

    row = change_row(effects, process, order)
    low, high = sorted([row := change_row(effects, with_changes(row), order) for _ in range(2)])
    apart = high - low >= gates.CHANGE_ROWS
    return (low, high) if apart and left_out_rms(with_changes(low, high)) < gates.WORTH * left else None


class Variation(NamedTuple):
    """A number that differs from row to row: which, with effects on coordinates, its deviation, and log odds."""

    hypothesis: Hypothesis
    size: float
    odds: float

    @property
    def sentence(self) -> str:
        """What differs by how much, and what to do."""
        e = self.hypothesis.effects
        moved = 1e3 * self.size * float((3 * e[e != 0].square().mean()).sqrt())
        got = f"about {self.hypothesis.amount(self.size)}, which moves the tool by {moved:.2g} mm"
        what = f"{self.hypothesis.name} seems to differ"
        return sentence(what, expected="the same for all rows", got=got, fix=self.hypothesis.fix)


def variation(data: TangentData, scales: Hyperparameters, hypotheses: Iterable[Hypothesis]) -> Variation | None:
    """The likeliest number that differs from row to row, if it is clear: an unknown u_i ~ N(0, s^2) of every row i.

    It is clear beside the tails of the noise, but seems small beside those that it makes: s counts all but gross rows.
    """
    rows, some = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)

    def varying(one: Hypothesis, process: Process) -> Variation:
        e = process.numbers.of_table(some.motions_in_numbers(one.effects[rows]))[:, 0]
        numbers = torch.arange(len(e), device=rows.device)
        E = e.new_zeros(len(e), len(rows)).index_put((numbers, process.numbers.owner), e)
        sizes = VARIATION_M.to(e) / float(e[e != 0].square().mean().sqrt())
        odds = Evidence.of(E[:, (E != 0).any(0)], process).log_odds(sizes.square())
        return Variation(one, float(sizes[odds.argmax()]), float(odds.max()))

    found = (varying(one, some.process(scales)) for one in hypotheses)
    clear, weights = max(found, key=lambda one: one.odds, default=None), some.tails.weights
    if clear is None or clear.odds < gates.ROW_ODDS:
        return None
    tails = replace(some.tails, weights=weights.where(weights < 1.0 / FACTORS[0], 1.0))
    return varying(clear.hypothesis, some.with_tails(tails).process(scales))


def chance_of_jump(gain: float, unknowns: int, edge: float) -> float:
    """Probability that chance makes the largest gain of all change points larger; ``edge``: share e left out."""
    if gain <= unknowns + 1:
        return 1.0
    density = exp(0.5 * unknowns * log(0.5 * gain) - 0.5 * gain - lgamma(0.5 * unknowns))
    return min(1.0, density * ((1 - unknowns / gain) * 2.0 * log((1 - edge) / edge) + 4.0 / gain))


def changes_of(data: TangentData, devices: Iterable[Hypothesis] = (), index: Tensor | None = None) -> list[Hypothesis]:
    """What may change of robot, tool, measuring frame, and devices, with effects on what rows tell.

    Args:
        devices: with effects on more rows, of which these have the numbers ``index`` (N,).
    """
    points, geometry = data.points.unflatten(1, (-1, 3)), data.nominal.geometry
    base, R = frame_slopes(points, points.mean((0, 1))), geometry.marker_turns(data.x)
    own = torch.eye(R.shape[1], dtype=R.dtype, device=R.device)
    markers = torch.einsum("npab,pk->npakb", R, own).flatten(3).flatten(1, 2)  # (N, 3 P, 3 P), in the tips' frames
    if data.basis is not None:  # nothing bends a frame
        markers = markers @ torch.block_diag(*rigid_motions(geometry.tool.flatten()).to(markers.device))
    places = data.places.unflatten(1, (-1, 3))
    away = (places - places.mean((0, 1))).flatten(1)[..., None]
    base, markers, away = (data.slopes @ each for each in (base, markers, away))
    base = (
        base * (data.noise_model.row_kinds == 0)[:, None, None]
    )  # a ball in a socket does not show where the device of other rows stands
    frames = [] if data.adrift else [base, base[..., :3]]
    found = [Hypothesis(BASE, each, fix=NEW_SET_UP) for each in frames]
    found.append(Hypothesis(MARKERS, markers, fix=NEW_SET_UP))
    found.append(Hypothesis(SCALE, away, ("ppm", 1e-6), NEW_SET_UP))
    for joint, name in enumerate(geometry.chain.joint_names):
        if joint > 0 or not data.adrift:  # without a device no row shows an offset of the first joint
            unit = "mrad" if data.space.periodic[joint] else "mm"
            found.append(Hypothesis(name, data.jacobian[..., joint, None], (unit, 1e-3), TWO_ROBOTS))
    found += [one._replace(effects=one.effects[index]) for one in devices]
    every = (one for one in found if bool((one.effects != 0).any()))
    return [one._replace(effects=data.motions_in_numbers(one.effects)) for one in every]
