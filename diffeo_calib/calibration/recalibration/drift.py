"""What differs between two dates of a robot, and by how much: parts of a model, and sizes of their change.

Temperature, wear and screws change everything a little, and a sister robot differs in everything. Errors of offsets,
transmissions, load and geometry may differ from the old ones by s^2 times their old prior variance, another s^2 for
each of the four and for each joint that a test has named (find_changes.py). Together they maximise the evidence of the
new rows with log-normal priors.

Where old errors f ~ N(0, P) are known, those now, f + d with d ~ N(0, s^2 P), have the variance s^2 P. In one problem
of old and new rows the same follows from a prior N(0, (1 + s^2) P) and old rows that share errors of variance
s^2 (1 + s^2) P. From P and s^2 P that variance would be at most P, however much a part has worn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import log
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.recalibration.new_rows import OUTLIER_WEIGHT, NewRows
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kernels.base import Kernel, SumKernel
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.registered_map import robot_map
from diffeo_calib.maps.linearisation import Linearisation

SMALLEST_AMPLITUDE_SHARE = 0.5  # of the largest joint's amplitude: a smaller transmission error may have grown
OFFSET_DEVIATION_RAD_M = 3e-4  # of a joint offset, to which the sizes of changes are relative: they span 0.05 to 5 mrad
NEGLIGIBLE_EIGENVALUE_SHARE = 1e-5  # eigenvalues of a part's covariance below this share of the largest are left out


@dataclass(frozen=True, eq=False)
class ChangedPart:
    """A part of a model that may have changed, by columns whose products are the prior covariance of the change."""

    name: str  # of the joint, or "gravity" or "geometry"
    columns: Callable[[Linearisation], Tensor]  # (M, m, c) at M configurations, m; of a joint's errors (M, c), rad or m
    joint: int | None = None  # whose errors they are; None for parameters of the nominal map
    offset: bool = False  # whether it is the offset of the joint, which all readings lack since then
    variance: float = 1.0  # of the change, relative to the old variance of the part
    kernels: dict[int, float] = field(default_factory=dict)  # number of a term of the joint kernel -> variance of it
    parameters: Tensor | float = 0.0  # (K,) variances of parameters of the nominal map

    def shapes(self, at: Linearisation) -> Tensor:
        """The columns, with the variance of the change."""
        return self.variance**0.5 * self.columns(at)

    def root(self, at: Linearisation) -> Tensor:
        """(M, m, c) the columns at M configurations, m."""
        shapes = self.shapes(at)
        return shapes if self.joint is None else at.joint_to_start[:, :, self.joint, None] * shapes[:, None]

    def before(self, at: Linearisation) -> Tensor:
        """(M, m, c) columns of old rows in a problem of the robot as it is now, see the module."""
        return (1.0 + self.variance) ** 0.5 * self.root(at)


def grown(spec: Any, drifts: Sequence[ChangedPart]) -> tuple[Kernel, Tensor]:
    """Joint kernel and variances of parameters of a robot that differs from the old one by so much."""
    terms, prior = [*spec.joint_kernel.terms], spec.prior_variance.clone()
    for part in drifts:
        prior += part.variance * part.parameters
        for number, variance in part.kernels.items():
            config, more = terms[number].to_config(), part.variance * variance
            terms[number] = RadialKernel.from_config(config | {"variance": config["variance"] + more})
    return SumKernel(terms), prior


def offsets_of(fitted: FittedMap) -> list[ChangedPart]:
    """The offsets of all joints, which are tested beside the parts: the geometry has them, among much else."""

    def same(at: Linearisation) -> Tensor:
        return torch.full_like(at.joint[0].points[:, :1], OFFSET_DEVIATION_RAD_M)

    geometry, offsets = robot_map(fitted).geometry, list[ChangedPart]()
    for joint, name in enumerate(geometry.chain.joint_names):
        number = geometry.chain.moving_names.index(name)
        first = geometry.slices["joints"].start + 6 * number + 3 * int(geometry.chain.revolute[number])
        variances = torch.zeros_like(fitted.geodesic.spec.prior_variance)
        variances[first : first + 3] = (OFFSET_DEVIATION_RAD_M * geometry.chain.axes[number]).square()
        offsets.append(ChangedPart(f"the offset of {name}", same, joint, offset=True, parameters=variances))
    return offsets


def parts_of(fitted: FittedMap) -> list[ChangedPart]:
    """The parts of a robot's map: every joint with a transmission term, gravity, geometry."""
    spec, nominal = fitted.geodesic.spec, robot_map(fitted)
    names = nominal.geometry.chain.joint_names
    terms = enumerate(spec.joint_kernel.terms)
    by_joint = {t.output: (number, t) for number, t in terms if isinstance(t, RadialKernel) and t.output is not None}
    least = SMALLEST_AMPLITUDE_SHARE**2 * max((float(term.variance) for _, term in by_joint.values()), default=0.0)

    def of_joint(kernel: RadialKernel, joint: int, at: Linearisation) -> Tensor:
        points = at.joint[0].points
        unit = points.new_zeros(len(points), 1, points.shape[1])
        unit[:, 0, joint] = 1.0
        values, vectors = torch.linalg.eigh(kernel.gram(points, unit, points, unit))
        kept = values > NEGLIGIBLE_EIGENVALUE_SHARE * values[-1]
        return vectors[:, kept] * values[kept].sqrt()

    def of_parameters(some: Tensor, at: Linearisation) -> Tensor:
        return at.sensitivity[..., some] * spec.prior_variance[some].sqrt()

    parts: list[ChangedPart] = []
    for joint, (number, term) in by_joint.items() if least > 0 else ():
        size = max(float(term.variance), least)
        kernel = RadialKernel.from_config(term.to_config() | {"variance": size})
        parts.append(ChangedPart(names[joint], partial(of_joint, kernel, joint), joint, kernels={number: size}))
    for name, some in {"gravity": nominal.sag, "geometry": nominal.geometry.slices["joints"]}.items():
        variances = torch.zeros_like(spec.prior_variance)
        variances[some] = spec.prior_variance[some]
        if len(at := variances.nonzero()[:, 0]):
            parts.append(ChangedPart(name, partial(of_parameters, at), parameters=variances))
    return parts


USUAL_LOG, NAMED_LOG, EFOLDS, ALIKE_EFOLDS = -6.0, 0.0, 2.5, 1.5
"""Of the priors of s^2: logarithms of the centres of what usually differs and of what is named, the standard deviation
of all, and that of geometry, load and transmissions around their mean."""
LOG_SIZES = torch.linspace(-12.0, 6.0, 37, dtype=torch.float64, device="cpu")  # logarithms of the s^2 that are tried
NOTHING, ROUNDS = -60.0, 3  # that of what does not differ; rounds of a search for one size after the other
WRONG_SHARE = 0.05  # probability that a row is wrong, before it is seen


@dataclass(frozen=True, eq=False)
class Drift:
    """What differs between the dates of some rows, as the old model sees them, and of the old ones.

    Args:
        named: parts that a test has named.
    """

    rows: NewRows
    named: Sequence[ChangedPart] = ()

    @cached_property
    def groups(self) -> list[list[ChangedPart]]:
        """Parts with one s^2: named joints, offsets, then the others."""
        groups = {part.name: [part] for part in self.named if part.joint is not None}
        for part in (*offsets_of(self.rows.fitted), *parts_of(self.rows.fitted)):
            if part.name not in groups:
                kind = "offsets" if part.offset else "transmissions" if part.joint is not None else f"all {part.name}"
                groups.setdefault(kind, []).append(part)
        return [*groups.values()]

    @cached_property
    def roots(self) -> list[Tensor]:
        """(M, R, c) of each group."""
        return [torch.cat([part.root(self.rows.at) for part in group], 2) for group in self.groups]

    @cached_property
    def doubted(self) -> NewRows:
        """The rows with their weights if everything has changed."""
        return self.rows.changed(tails=self.rows.drifting(self.roots).with_weights().tails)

    @cached_property
    def sizes(self) -> tuple[list[float], float, float]:
        """Expected s^2 of each group, and the log odds with the likeliest of all that differs, and of what is usual."""
        evidence, grid = self.doubted.evidence(torch.cat(self.roots, 2)), LOG_SIZES.to(self.rows.y)
        counts = torch.tensor([root.shape[2] for root in self.roots], dtype=torch.int64, device=grid.device)
        joints, each = sum(part.joint is not None for part in self.named), torch.arange(len(counts), device=grid.device)
        usual, alike = each >= joints, (each > joints).to(grid)
        best = centre = torch.where(usual, USUAL_LOG, NAMED_LOG).to(grid)
        covariance = torch.diag(torch.where(each > joints, ALIKE_EFOLDS, EFOLDS).square()).to(grid)
        precision = torch.linalg.inv(covariance + EFOLDS**2 * alike * alike[:, None])

        def odds(tried: Tensor, some: Tensor) -> Tensor:
            away, sizes = (tried - centre) * some, torch.where(some, tried, NOTHING).exp()
            return evidence.log_odds_of(sizes.repeat_interleave(counts, 1)) - 0.5 * ((away @ precision) * away).sum(1)

        moves, expected, everything = each == each[:, None], list[float](), each >= 0
        for moved in (usual, *moves.repeat(ROUNDS, 1)):
            tried = torch.where(moved, grid[:, None], best)
            values = odds(tried, everything)
            best = tried[values.argmax()]
            expected.append(float(values.softmax(0) @ grid.exp()))
        total, named = float(odds(best[None], everything)), float(odds(best[None], ~usual))
        return expected[-len(counts) :], total, total - named

    @property
    def explains(self) -> bool:
        """Whether it explains the rows better than that those are wrong which do not fit the old model."""

        def evidence(rows: NewRows) -> float:
            wrong = int((rows.tails.weights < OUTLIER_WEIGHT).any(1).sum())
            return rows.given.log_evidence() + wrong * log(WRONG_SHARE)

        return evidence(self.doubted) + self.sizes[1] - evidence(self.rows) > gates.DRIFT_ODDS

    @property
    def parts(self) -> list[ChangedPart]:
        """What differs. Unless load or geometry are named it has to be clear: one worn joint changes nothing else."""
        unclear = not parts_of(self.rows.fitted) or self.sizes[2] < gates.DRIFT_ODDS
        if unclear and all(each.joint is not None for each in self.named):
            return [*self.named]
        if not self.named and not self.explains:
            return []
        each = zip(self.groups, self.sizes[0], strict=True)
        return [replace(part, variance=part.variance * size) for group, size in each for part in group]
