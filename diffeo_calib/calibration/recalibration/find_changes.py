"""Changes since a robot was calibrated: likelihood ratios for every joint, its offset, the load, the geometry.

The residuals r of new rows are N(0, K_0) if only device and markers have moved; if part k has changed, too, they are
N(0, K_0 + s^2 G_k), with G_k the covariance of that part in the old model and s^2 the variance of the change relative
to it. The noise may have changed by a factor f. Part k is named if

    LR_k = 2 max_{s, f} log N(r; 0, K_0(f) + s^2 G_k) - 2 max_f log N(r; 0, K_0(f))

is larger than for all but 1 % of samples from K_0, in each of which the largest ratio of all parts counts and s and f
are found anew. Rows are weighted twice, as if everything might have changed and as if nothing had, so that neither a
change counts as outliers nor outliers as a change; the larger probability counts. What was named may then drift, and
the test is repeated for the rest. Rows outside the joint ranges of the old rows take no part: errors there are
extrapolation, not change.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import degrees, inf
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.judged_rows import find_block
from diffeo_calib.calibration.recalibration.drift import (
    NEGLIGIBLE_EIGENVALUE_SHARE,
    OFFSET_DEVIATION_RAD_M,
    ChangedPart,
    Drift,
    offsets_of,
    parts_of,
)
from diffeo_calib.calibration.recalibration.new_rows import OUTLIER_WEIGHT, NewRows, NewSetUp
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import sentence, warn_user, with_deviation
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.regression.conditional import roots
from diffeo_calib.regression.linear_rows import Evidence

LEVEL = 0.01  # probability that anything is named although nothing has changed


@dataclass(frozen=True)
class Change:
    """Something that has changed.

    Args:
        part: name of the joint, "gravity" or "geometry".
        size: RMS of the change over the new rows: rad or m of a joint, m of the markers for other parts. Of an offset
            what must be added to a reading of the joint beyond what was added at the old date: a joint that is at q by
            its encoder is at q + size where the old model has it at q.
        angle: whether the size is in rad.
        displacement: RMS displacement of the markers by it, m.
        probability: that chance makes any likelihood ratio as large.
        deviation: standard deviation of an offset; None for other parts.
        others: offsets that explain the rows as well.
        where: the rows that show it, in words; empty if all do.
    """

    part: str
    size: float
    angle: bool
    displacement: float
    probability: float
    deviation: float | None = None
    others: tuple[str, ...] = ()
    where: str = ""

    def __str__(self) -> str:
        size, where = f"{1e3 * self.size:.2g}", f"{self.where}: " * bool(self.where)
        if self.deviation is not None:
            size = with_deviation(1e3 * self.size, 1e3 * self.deviation)
        size = f"{size} mrad ({degrees(self.size):.2g} degrees)" if self.angle else f"{size} mm"
        by = f", which moves the markers by {1e3 * self.displacement:.2g} mm" if self.angle else ""
        part = where + " or ".join((self.part, *self.others)) + " (these rows do not tell which)" * bool(self.others)
        return f"{part} has changed by {size}{by} (by chance with a probability of at most {self.probability:.2g})"


class Offset(NamedTuple):
    """A change of a joint's offset: the smallest that rows show in nine cases of ten, or one that they may hide."""

    joint: str  # its name
    angle: bool  # whether the others are in rad, else in m
    size: float  # is added to a reading as that of a :class:`Change`; infinite if places hide any
    deviation: float = 0.0  # of the size; zero of the smallest one
    instead: str = ""  # what has moved otherwise, in words; empty for those

    def __str__(self) -> str:
        unit = "mrad" if self.angle else "mm"
        if not self.instead:
            return f"{self.joint} none" if self.size == inf else f"{self.joint} {1e3 * self.size:.2g} {unit}"
        size = f"{with_deviation(1e3 * self.size, 1e3 * self.deviation)} {unit}"
        return f"{self.instead}, or the offset of {self.joint} has changed by {size}: these rows cannot tell which"


@dataclass(frozen=True)
class Changes:
    """Changes, the clearest first.

    Args:
        found: the changes.
        probabilities: name of every part -> that chance makes any likelihood ratio as large as this part's.
        noise: standard deviation of the new rows' noise relative to that of the old rows.
        rows: number of rows that were tested: those within the old joint ranges.
        level: probability of a false alarm; None if nothing was tested on request.
        smallest: of every joint, the smallest change of its offset that the rows would show; empty once one was found.
    """

    found: tuple[Change, ...] = ()
    probabilities: dict[str, float] = field(default_factory=dict)
    noise: float = 1.0
    rows: int = 0
    level: float | None = None
    smallest: tuple[Offset, ...] = ()

    @property
    def tested(self) -> bool:
        """Whether the robot was tested: else a change of it may be in new places of device and markers."""
        return bool(self.probabilities)

    def __str__(self) -> str:
        if self.level is None:
            return "changes of the robot were not tested"
        if not self.tested:
            few = f"only {self.rows} rows lie within the joint ranges that the model knows"
            return f"{few}: changes of the robot were not tested, and new places may hide one"
        if not self.found:
            places = "the places of device and markers, which may hide an offset of the first or the last joint"
            rows = f", {self.rows} rows" * bool(self.rows)
            return f"no change was found but {places} (tested at {100 * self.level:g} %{rows})"
        return "; ".join(map(str, self.found))


SIMULATED_DRAWS = 2000
NOISE_FACTORS = 0.4 * 30.0 ** (torch.arange(12, dtype=torch.float64, device="cpu") / 11)  # on its variance
SIZES = 0.03 * 1e4 ** (torch.arange(25, dtype=torch.float64, device="cpu") / 24)  # relative to old variances


class Ratio(NamedTuple):
    """The likelihood ratio of one part."""

    value: float  # 2 log of it
    probability: float  # that chance makes the largest ratio of all parts as large
    variance: float  # likeliest variance of the change, relative to the old variance of its part


def likelihood_ratios(rows: NewRows, roots: dict[str, Tensor], seed: int) -> tuple[dict[str, Ratio], float]:
    """Ratios of all parts.

    Args:
        rows: the new rows, with the changes that are known already.
        roots: name -> (M, m, c) columns of each part's covariance, m. seed: of the samples.

    Returns:
        name -> ratio, and the likeliest standard deviation of the noise without a change, relative to that of the rows.
    """
    given = rows.given
    base = given.C + given.slopes @ given.prior @ given.slopes.T
    R = torch.block_diag(*rows.weighted_noise)
    visible = rows.visible.flatten()  # what was not measured has no noise whose level may change
    R, base, residual = R[visible][:, visible], base[visible][:, visible], rows.residual.flatten()[visible, None]
    # In the basis in which R is 1 and the rest diagonal all levels of noise are.
    root_of_noise = torch.linalg.cholesky(R)
    half = torch.linalg.solve_triangular(root_of_noise, base, upper=False)
    rest, Q = torch.linalg.eigh(torch.linalg.solve_triangular(root_of_noise, half.T, upper=False))
    levels = rest.clamp(min=0.0) + NOISE_FACTORS.to(base)[:, None]

    def aligned(values: Tensor) -> Tensor:
        return Q.T @ torch.linalg.solve_triangular(root_of_noise, values, upper=False)

    def densities(values: Tensor) -> Tensor:
        """(noise, k) log densities without a change, but for a constant."""
        return -0.5 * (levels.reciprocal() @ values.square() + levels.log().sum(1)[:, None])

    measured = aligned(residual)
    likeliest = int(densities(measured).argmax())
    draws = torch.randn(len(R), SIMULATED_DRAWS, generator=seeded(seed), dtype=base.dtype, device=HOST).to(base.device)
    samples = torch.cat([measured, levels[likeliest].sqrt()[:, None] * draws], 1)
    plain, sizes, ratios, variances = densities(samples), SIZES.to(base), dict[str, Tensor](), dict[str, float]()
    for name, root in roots.items():
        U, s, _ = torch.linalg.svd(aligned(root.flatten(0, 1)[visible]), full_matrices=False)
        E = (U * s)[:, s.square() > NEGLIGIBLE_EIGENVALUE_SHARE * s[0].square()]
        each = zip(E.T / levels[:, None], plain, strict=True)
        changed = torch.cat([density + Evidence((F @ samples).mT, F @ E).log_odds(sizes) for F, density in each])
        ratios[name] = 2.0 * (changed.amax(0) - plain.amax(0))
        variances[name] = float(SIZES[int(changed[:, 0].argmax()) % len(SIZES)])
    largest = torch.stack(list(ratios.values())).amax(0)[1:]
    by_part = {}
    for name, values in ratios.items():
        value = float(values[0])
        by_part[name] = Ratio(value, (1 + int((largest >= value).sum())) / (1 + SIMULATED_DRAWS), variances[name])
    return by_part, float(NOISE_FACTORS[likeliest].sqrt())


FEWEST_ROWS = 5
MOST_OUTLIERS = 0.5  # share of the rows of a session that hardly count, from which it deviates as a whole
RANGE_MARGIN = 0.02  # rows may lie outside of the old joint ranges by this share of them
SOMETHING = "something"  # a change whose part rows do not tell


def find_changes(rows: NewRows, *, level: float = LEVEL, seed: int = 0) -> tuple[Changes, list[ChangedPart]]:
    """Test new rows for changes: all together, and every session and block of rows that do not fit by itself.

    Rows that follow one another, or are a session of their own, and deviate together are no outliers.

    Returns:
        what was found, and what may drift: nothing where only a part of the rows shows a change.

    Warns:
        DiffeoCalibWarning: too few rows within the old joint ranges for a test.
    """
    changes, drifts = _changes_of(rows, level=level, seed=seed)
    if not changes.tested:
        warn_user(sentence(str(changes), fix=f"measure {FEWEST_ROWS} poses or more within these ranges"))
    groups = groups_of(rows)
    if changes.found or not groups:
        return changes, drifts
    named = []
    for where, (index, deviates) in groups.items():
        verdict, _ = _changes_of(group := rows.kept(index), level=level / len(groups), seed=seed)
        named += [replace(change, where=where) for change in verdict.found]
        if deviates and not verdict.found:
            numbers = 3 if rows.noise_model.size % 3 == 0 else rows.noise_model.size
            size = float(group.residual.unflatten(1, (-1, numbers)).square().sum(2).mean().sqrt())  # m at the tool
            named.append(Change(SOMETHING, size, angle=False, displacement=size, probability=level, where=where))
    return replace(changes, found=tuple(named)), []


def groups_of(rows: NewRows) -> dict[str, tuple[Tensor, bool]]:
    """Rows that were measured together, by their names: their numbers, and whether hardly any fits the old model.

    Sessions, if there are several, and else the block of rows that hardly count.
    """
    data, flags = rows.set_up.data, (rows.tails.weights < OUTLIER_WEIGHT).any(1).to(HOST)
    for sessions in rows.set_up.sessions:  # one set, if there are several
        groups = {f"session '{name}'": sessions.rows[sessions.device == k] for k, name in enumerate(sessions.names)}
        return {name: (index, float(flags[index].double().mean()) > MOST_OUTLIERS) for name, index in groups.items()}
    distinct = len(data.line_numbers.unique()) == len(data)
    numbers = data.line_numbers.to(HOST) if distinct else torch.arange(len(data), device=HOST)
    order = numbers.argsort()
    place = find_block(flags[order])
    if place is None or place[1] - place[0] < FEWEST_ROWS:
        return {}
    block = order[place[0] : place[1]]
    first, *_, last = numbers[block].tolist()
    return {f"rows {first} to {last}": (block, True)}


def _changes_of(rows: NewRows, *, level: float, seed: int) -> tuple[Changes, list[ChangedPart]]:
    """Test rows together; arguments as of :func:`find_changes`."""
    low, high = rows.fitted.x.amin(0), rows.fitted.x.amax(0)
    margin = RANGE_MARGIN * (high - low)
    rows = rows.kept(((rows.q >= low - margin) & (rows.q <= high + margin)).all(1).nonzero()[:, 0])
    if len(rows) < FEWEST_ROWS:
        return Changes(rows=len(rows), level=level), []
    parts = {part.name: part for part in (*parts_of(rows.fitted), *offsets_of(rows.fitted))}
    roots = {name: part.root(rows.at) for name, part in parts.items()}
    drift = Drift(rows.with_weights())
    few_fit = (drift.rows.tails.weights < OUTLIER_WEIGHT).any(1).double().mean() > MOST_OUTLIERS and drift.explains
    rows = drift.doubted
    drifts, reasons, first, noise = list[ChangedPart](), list[tuple[float, tuple[str, ...]]](), dict[str, float](), 1.0
    while roots:
        ratios, factor = likelihood_ratios(rows, roots, seed)
        # A few outliers look like a change, and a change looks like outliers: it must stand out with either weights.
        # Where hardly a row fits the old model these are no outliers.
        doubted = not few_fit and (not first or min(test.probability for test in ratios.values()) <= level)
        strict = likelihood_ratios(rows.with_weights(), roots, seed)[0] if doubted else ratios
        for name, (value, probability, variance) in ratios.items():
            other = strict[name]
            ratios[name] = Ratio(min(value, other.value), max(probability, other.probability), variance)
        if not first:
            first, noise = {name: ratio.probability for name, ratio in ratios.items()}, factor
        name = min(ratios, key=lambda each: (ratios[each].probability, -ratios[each].value))
        best = ratios.pop(name)
        if best.probability > level:
            break
        drifts.append(replace(parts[name], variance=best.variance))
        rows = rows.drifting([best.variance**0.5 * roots.pop(name)])
        least = best.value - gates.OFFSETS_TOLD_APART if parts[name].offset else inf
        as_good = [each for each, rival in ratios.items() if parts[each].offset and rival.value > least]
        reasons.append((best.probability, tuple(as_good)))
    changes = tuple(_change(rows, drift, *why) for drift, why in zip(drifts, reasons, strict=True))
    chain, smallest = rows.marks.fitted.geometry.chain, list[Offset]()
    for joint, part in enumerate([] if drifts else offsets_of(rows.fitted)):
        size = SHOWN * OFFSET_DEVIATION_RAD_M / float(rows.evidence(part.root(rows.at)).H.sqrt())
        size = size if size < LARGEST_OFFSET_RAD_M else inf
        smallest.append(Offset(chain.joint_names[joint], chain.kinds[joint] != "prismatic", size))
    return Changes(changes, first, noise, len(rows), level, tuple(smallest)), drifts


SHOWN = 5.5  # standard deviations of an offset that is named in nine cases of ten at a level of 1 %
LARGEST_OFFSET_RAD_M = 5e-3  # the largest one that is tested, see SIZES


def _change(rows: NewRows, part: ChangedPart, probability: float, others: tuple[str, ...]) -> Change:
    """The change with its expected size."""
    evidence, kinds = rows.evidence(part.root(rows.at)), rows.marks.fitted.geometry.chain.kinds
    moved = part.root(rows.seen[1]) @ evidence.g
    size = displacement = float(moved.unflatten(1, (-1, 3)).square().sum(-1).mean().sqrt())
    deviation = None
    if part.joint is not None:
        shapes = part.shapes(rows.at)
        errors = shapes @ evidence.g
        size = float(errors[0]) if part.offset else float(errors.square().mean().sqrt())
        if part.offset:
            deviation = float(shapes[0, 0]) * max(1.0 - float(evidence.H), 0.0) ** 0.5
    angle = part.joint is not None and kinds[part.joint] != "prismatic"
    return Change(part.name, size, angle, displacement, probability, deviation, others)


RANK_TOLERANCE = 1e-9  # smallest eigenvalue of correlations, relative to the largest, that is not rounding


def hidden_offsets(set_up: NewSetUp, changes: Changes) -> tuple[Offset, ...]:
    """Offsets that explain where a registration found device or markers; none where a change of the robot is named."""
    rows, record = set_up.registered, set_up.registration
    if rows is None or record is None or changes.found:
        return ()
    S, J = rows.by_places.flatten(0, 1), rows.at.joint_to_start.flatten(0, 1)  # (M m, 6 + 3 P), (M m, n)
    covariance, noise = rows.inflation * rows.given.covariance, float(record.noise.diagonal().mean().sqrt())
    T, centre, chain = rows.transform, rows.centre, rows.marks.fitted.geometry.chain
    turn = rotation_numbers(T[None, :3, :3], "rotvec", angle="rad")[0]
    moved = torch.cat([T[:3, :3] @ centre + T[:3, 3] - centre, turn])  # m and rad, of the frame in that of the map
    places = {"the measuring device has moved": (slice(0, 6), moved)}
    if record.shift is not None:
        places["the markers have moved"] = (slice(6, S.shape[1]), record.shift.flatten())
    hidden = []
    for instead, (part, shift) in places.items():
        white = roots(covariance[part, part], RANK_TOLERANCE)[1]
        white = white[white.any(1)]  # markers that moved together leave it singular
        away = white @ shift
        count, total = len(away), float(away @ away)
        if total < chi2_above(LEVEL, count):
            continue
        for joint, name in enumerate(chain.joint_names):
            d = torch.linalg.lstsq(S[:, part], J[:, joint, None]).solution
            evidence = Evidence((white @ d).T @ away, (white @ d).T @ white @ d)
            if float(evidence.H) <= 0.0:  # It moves the places only as they are known not to move.
                continue
            size, deviation = float(evidence.size), float(evidence.H) ** -0.5
            unseen = abs(size) * float((J[:, joint, None] - S[:, part] @ d).square().mean().sqrt())
            left = total - float(evidence.gain)
            if unseen < gates.HIDDEN_SHARE * noise and left < chi2_above(LEVEL, max(count - 1, 1)):
                hidden.append(Offset(name, chain.kinds[joint] != "prismatic", size, deviation, instead))
    return tuple(hidden)
