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

from dataclasses import dataclass, replace
from math import degrees, inf
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import Evidence
from diffeo_calib.calibration.diagnostics.row_order import find_block
from diffeo_calib.calibration.recalibration.new_rows import OUTLIER_WEIGHT, WeighedRows
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import sentence, warn_user, with_deviation
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.maps.linearisation import Linearisation

SMALLEST_AMPLITUDE_SHARE = 0.5
"""A small transmission error counts with this share of the largest joint's amplitude: it may have grown."""
OFFSET_DEVIATION_RAD_M = 3e-4
"""Of a joint offset, to which the sizes of changes are relative: they span 0.05 to 5 mrad."""
NEGLIGIBLE_EIGENVALUE_SHARE = 1e-6
"""Eigenvalues of a transmission's covariance below this share of the largest are left out."""


@dataclass(frozen=True, eq=False)
class ChangedPart:
    """A part of a model that may have changed: a hypothesis whose prior is that of the part in the old model.

    Args:
        name: of the joint, or "gravity" or "geometry".
        joint: the column of the joint whose error or offset it is; None for parameters of the nominal map.
        kernel: that of the joint's error; None for its offset, which all readings lack since then.
        columns: (k,) numbers of the parameters. deviations: (k,) their prior standard deviations.
    """

    name: str
    joint: int | None = None
    kernel: RadialKernel | None = None
    columns: Tensor | None = None
    deviations: Tensor | None = None

    @property
    def offset(self) -> bool:
        """Whether it is the offset of a joint."""
        return self.joint is not None and self.kernel is None

    def shapes(self, at: Linearisation) -> Tensor:
        """(M, c) columns whose products are the prior covariance of the joint's errors, rad or m."""
        points = at.joint[0].points
        if self.kernel is None:
            return torch.full_like(points[:, :1], OFFSET_DEVIATION_RAD_M)
        one = points.new_zeros(len(points), 1, points.shape[1])
        one[:, 0, self.joint] = 1.0
        values, vectors = torch.linalg.eigh(self.kernel.gram(points, one, points, one))
        kept = values > NEGLIGIBLE_EIGENVALUE_SHARE * values[-1]
        return vectors[:, kept] * values[kept].sqrt()

    def root(self, at: Linearisation) -> Tensor:
        """(M, m, c) columns whose products are the part's prior covariance at M configurations, m."""
        if self.joint is None:
            return at.sensitivity[..., self.columns] * self.deviations
        return at.joint_to_start[:, :, self.joint, None] * self.shapes(at)[:, None]


def offsets_of(rows: WeighedRows) -> list[ChangedPart]:
    """The offsets of all joints, which are tested beside the parts: the geometry has them, among much else."""
    chain = rows.points.fitted.geometry.chain
    return [ChangedPart(f"the offset of {name}", joint) for joint, name in enumerate(chain.joint_names)]


def parts_of(rows: WeighedRows) -> list[ChangedPart]:
    """The parts of the model: every joint with a transmission term, gravity, geometry."""
    spec, nominal = rows.fitted.geodesic.spec, rows.points.fitted
    chain, prior = nominal.geometry.chain, spec.prior_variance
    own = {t.output: t for t in spec.joint_kernel.terms if isinstance(t, RadialKernel) and t.output is not None}
    least = SMALLEST_AMPLITUDE_SHARE**2 * max((float(term.variance) for term in own.values()), default=0.0)
    found: list[ChangedPart] = []
    for joint, term in own.items() if least > 0 else ():
        kernel = RadialKernel.from_config(term.to_config() | {"variance": max(float(term.variance), least)})
        found.append(ChangedPart(chain.joint_names[joint], joint, kernel))
    every = torch.arange(len(prior), device=prior.device)
    groups = {"gravity": every[nominal.sag], "geometry": every[nominal.geometry.slices["joints"]]}
    for name, columns in groups.items():
        supported = columns[prior[columns] > 0]
        if len(supported):
            found.append(ChangedPart(name, columns=supported, deviations=prior[supported].sqrt()))
    return found


SIMULATED_DRAWS = 2000
NOISE_FACTORS = 0.4 * 30.0 ** (torch.arange(12, dtype=torch.float64, device="cpu") / 11)
"""Factors 0.4 to 12 on the variance of the noise: another device, another day."""
SIZES = 0.03 * 1e4 ** (torch.arange(25, dtype=torch.float64, device="cpu") / 24)
"""Variances 0.03 to 300 of a change, relative to the old variance of its part."""


class Ratio(NamedTuple):
    """The likelihood ratio of one part.

    Args:
        value: 2 log of the ratio. probability: that chance makes the largest ratio of all parts as large.
        variance: likeliest variance of the change, relative to the old variance of its part.
    """

    value: float
    probability: float
    variance: float

    def least_certain(self, other: Ratio) -> Ratio:
        """This ratio with the larger probability, and the smaller value, of both."""
        return Ratio(min(self.value, other.value), max(self.probability, other.probability), self.variance)


def likelihood_ratios(rows: WeighedRows, roots: dict[str, Tensor], seed: int) -> tuple[dict[str, Ratio], float]:
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
    seen = rows.visible.flatten()  # what was not measured has no noise whose level may change
    R, base, residual = R[seen][:, seen], base[seen][:, seen], rows.residual.flatten()[seen, None]
    factors = [torch.linalg.cholesky(base + f * R) for f in NOISE_FACTORS.to(base)]

    def white(values: Tensor) -> list[Tensor]:
        return [torch.linalg.solve_triangular(factor, values, upper=False) for factor in factors]

    def densities(whitened: list[Tensor]) -> Tensor:
        """(noise, k) log densities without a change, but for a constant."""
        each = zip(whitened, factors, strict=True)
        return torch.stack([-0.5 * r.square().sum(0) - factor.diagonal().log().sum() for r, factor in each])

    likeliest = int(densities(white(residual)).argmax())
    draws = torch.randn(len(R), SIMULATED_DRAWS, generator=seeded(seed), dtype=base.dtype, device=HOST).to(base.device)
    samples = white(torch.cat([residual, factors[likeliest] @ draws], 1))
    plain, sizes, ratios, variances = densities(samples), SIZES.to(base), dict[str, Tensor](), dict[str, float]()
    for name, root in roots.items():
        each = zip(white(root.flatten(0, 1)[seen]), samples, plain, strict=True)
        changed = torch.cat([own + Evidence((E.T @ r).mT, E.T @ E).log_odds(sizes) for E, r, own in each])
        ratios[name] = 2.0 * (changed.amax(0) - plain.amax(0))
        variances[name] = float(SIZES[int(changed[:, 0].argmax()) % len(SIZES)])
    largest = torch.stack(list(ratios.values())).amax(0)[1:]
    found = {}
    for name, values in ratios.items():
        value = float(values[0])
        found[name] = Ratio(value, (1 + int((largest >= value).sum())) / (1 + SIMULATED_DRAWS), variances[name])
    return found, float(NOISE_FACTORS[likeliest].sqrt())


LEVEL = 0.01
"""Probability that anything is named although nothing has changed."""
FEWEST_ROWS = 5
MOST_OUTLIERS = 0.5
"""Share of the rows of a session that hardly count, from which it deviates as a whole."""
RANGE_MARGIN = 0.02
"""Rows may lie outside of the old joint ranges by this share of them."""


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
        return f"{self.where}: {self._what}" if self.where else self._what

    @property
    def _what(self) -> str:
        size = f"{1e3 * self.size:.2g}"
        if self.deviation is not None:
            size = with_deviation(1e3 * self.size, 1e3 * self.deviation)
        size = f"{size} mrad ({degrees(self.size):.2g} degrees)" if self.angle else f"{size} mm"
        by = f", which moves the markers by {1e3 * self.displacement:.2g} mm" if self.angle else ""
        part = " or ".join((self.part, *self.others)) + " (these rows do not tell which)" * bool(self.others)
        return f"{part} has changed by {size}{by} (by chance with a probability of at most {self.probability:.2g})"


class SmallestOffset(NamedTuple):
    """The smallest change of an offset, rad or m, shown in nine cases of ten; infinite if places hide it."""

    joint: str
    size: float
    angle: bool

    def __str__(self) -> str:
        size = "none" if self.size == inf else f"{1e3 * self.size:.2g} {'mrad' if self.angle else 'mm'}"
        return f"{self.joint} {size}"


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

    found: tuple[Change, ...]
    probabilities: dict[str, float]
    noise: float
    rows: int
    level: float | None
    smallest: tuple[SmallestOffset, ...] = ()

    @classmethod
    def untested(cls) -> Changes:
        """No test was wanted."""
        return cls((), {}, 1.0, 0, None)

    @property
    def tested(self) -> bool:
        """Whether the robot was tested: else a change of it may be in new places of device and markers."""
        return bool(self.probabilities)

    @property
    def few(self) -> str:
        """How many rows could be tested, in words."""
        return f"only {self.rows} rows lie within the joint ranges that the model knows"

    def __str__(self) -> str:
        if self.level is None:
            return "changes of the robot were not tested"
        if not self.tested:
            return f"{self.few}: changes were not tested, and what has changed is not known"
        if not self.found:
            places = "the places of device and markers, which may hide an offset of the first or the last joint"
            rows = f", {self.rows} rows" * bool(self.rows)
            return f"no change was found but {places} (tested at {100 * self.level:g} %{rows})"
        return "; ".join(map(str, self.found))


class Drift(NamedTuple):
    """A part that has changed, and the variance of its change relative to its old variance."""

    part: ChangedPart
    variance: float


SOMETHING = "something"
"""A change whose part rows do not tell."""


def find_changes(rows: WeighedRows, *, level: float = LEVEL, seed: int = 0) -> tuple[Changes, list[Drift]]:
    """Test new rows for changes: all together, and every session and block of rows that do not fit by itself.

    Rows that follow one another, or are a session of their own, and deviate together are no outliers.

    Args:
        rows: seen by the old model. level: see :class:`Changes`. seed: of the samples.

    Returns:
        what was found, and what may drift: nothing where only a part of the rows shows a change.

    Warns:
        DiffeoCalibWarning: too few rows within the old joint ranges for a test.
    """
    changes, drifts = _changes_of(rows, level=level, seed=seed)
    if not changes.tested:
        what = f"{changes.few}: changes of the robot were not tested, and the places that were found may hide one"
        warn_user(sentence(what, fix=f"measure {FEWEST_ROWS} poses or more within these ranges"))
    groups = groups_of(rows)
    if changes.found or not groups:
        return changes, drifts
    found = []
    for where, (index, deviates) in groups.items():
        own, _ = _changes_of(group := rows.kept(index), level=level / len(groups), seed=seed)
        found += [replace(one, where=where) for one in own.found]
        if deviates and not own.found:
            numbers = 3 if rows.noise_model.size % 3 == 0 else rows.noise_model.size
            size = float(group.residual.unflatten(1, (-1, numbers)).square().sum(2).mean().sqrt())  # m at the tool
            found.append(Change(SOMETHING, size, angle=False, displacement=size, probability=level, where=where))
    return replace(changes, found=tuple(found)), []


def groups_of(rows: WeighedRows) -> dict[str, tuple[Tensor, bool]]:
    """Rows that were measured together, by their names: their numbers, and whether hardly any fits the old model.

    Sessions, if there are several, and else the block of rows that hardly count.
    """
    data, flags = rows.before.data, (rows.tails.weights < OUTLIER_WEIGHT).any(1).to(HOST)
    named = [group for one in rows.before.sessions for group in one.groups()]
    if named:
        return {name: (own, float(flags[own].double().mean()) > MOST_OUTLIERS) for name, own in named}
    distinct = len(data.line_numbers.unique()) == len(data)
    numbers = data.line_numbers.to(HOST) if distinct else torch.arange(len(data), device=HOST)
    order = numbers.argsort()
    place = find_block(flags[order])
    if place is None or place[1] - place[0] < FEWEST_ROWS:
        return {}
    block = order[place[0] : place[1]]
    first, *_, last = numbers[block].tolist()
    return {f"rows {first} to {last}": (block, True)}


def _changes_of(rows: WeighedRows, *, level: float, seed: int) -> tuple[Changes, list[Drift]]:
    """Test rows together; arguments as of :func:`find_changes`."""
    rows = rows.kept(within_old_range(rows))
    if len(rows) < FEWEST_ROWS:
        return Changes((), {}, 1.0, len(rows), level), []
    parts = {part.name: part for part in (*parts_of(rows), *offsets_of(rows))}
    roots = {name: part.root(rows.at) for name, part in parts.items()}
    rows = rows.changed(tails=rows.if_drifting(list(roots.values())).tails)
    drifts, found, first, others, noise = [], {}, {}, {}, 1.0
    while roots:
        ratios, factor = likelihood_ratios(rows, roots, seed)
        # A few outliers look like a change, and a change looks like outliers: it must stand out with either weights.
        strict, _ = likelihood_ratios(rows.with_weights(), roots, seed)
        ratios = {name: each.least_certain(strict[name]) for name, each in ratios.items()}
        if not first:
            first, noise = ratios, factor
        name = min(ratios, key=lambda each: (ratios[each].probability, -ratios[each].value))
        if ratios[name].probability > level:
            break
        rows = rows.drifting([ratios[name].variance ** 0.5 * roots.pop(name)])
        drifts.append(Drift(parts[name], ratios[name].variance))
        found[name] = ratios[name]
        least = ratios[name].value - gates.OFFSETS_TOLD_APART
        as_good = [each for each in ratios if each != name and parts[each].offset and ratios[each].value > least]
        others[name] = tuple(as_good) if parts[name].offset else ()
    changes = tuple(
        _change(rows, drift, probability=found[name].probability, others=others[name])
        for name, drift in zip(found, drifts, strict=True)
    )
    probabilities = {name: ratio.probability for name, ratio in first.items()}
    return Changes(changes, probabilities, noise, len(rows), level, () if drifts else _smallest(rows)), drifts


SHOWN = 5.5
"""Standard deviations of an offset that is named in nine cases of ten at a level of 1 %."""
LARGEST_OFFSET_RAD_M = 5e-3
"""The largest one that is tested, see SIZES."""


def _smallest(rows: WeighedRows) -> tuple[SmallestOffset, ...]:
    """See :class:`Changes`."""
    chain, found = rows.points.fitted.geometry.chain, []
    for joint, part in enumerate(offsets_of(rows)):
        evidence = rows.evidence(part.root(rows.at))
        size = SHOWN * OFFSET_DEVIATION_RAD_M / float(evidence.H.sqrt())
        size = size if size < LARGEST_OFFSET_RAD_M else inf
        found.append(SmallestOffset(chain.joint_names[joint], size, chain.kinds[joint] != "prismatic"))
    return tuple(found)


def within_old_range(rows: WeighedRows) -> Tensor:
    """(k,) numbers of the rows within the ranges of the joints in the old rows."""
    low, high = rows.fitted.x.amin(0), rows.fitted.x.amax(0)
    margin = RANGE_MARGIN * (high - low)
    return ((rows.q >= low - margin) & (rows.q <= high + margin)).all(1).nonzero()[:, 0]


def _change(rows: WeighedRows, drift: Drift, *, probability: float, others: tuple[str, ...]) -> Change:
    """The change with its expected size."""
    (part, variance), kinds = drift, rows.points.fitted.geometry.chain.kinds
    evidence = rows.evidence(part.root(rows.at))
    moved = part.root(rows.seen[1]) @ (variance * evidence.g)
    size = displacement = float(moved.unflatten(1, (-1, 3)).square().sum(-1).mean().sqrt())
    deviation = None
    if part.joint is not None:
        errors = part.shapes(rows.at) @ (variance * evidence.g)
        size = float(errors[0]) if part.offset else float(errors.square().mean().sqrt())
    if part.offset:
        deviation = OFFSET_DEVIATION_RAD_M * (variance * max(1.0 - variance * float(evidence.H), 0.0)) ** 0.5
    angle = part.joint is not None and kinds[part.joint] != "prismatic"
    return Change(part.name, size, angle, displacement, probability, deviation, others)
