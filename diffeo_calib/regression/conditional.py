"""What is known from rows of fields and parameters: one Gaussian, conditioned on more rows by one block of Cholesky.

Rows report S u + J v(q) + A w(z) + e, to first order, of parameters u ~ N(0, P) and fields v and w. With F the
covariance by the fields, R that of the noise e, L L^T = F + R, W = L^-1 S P^1/2 and B B^T = 1 + W^T W,

    P^-1/2 u^ = B^-T B^-1 W^T alpha,    alpha = L^-1 target,    mu = L^-T (alpha - W P^-1/2 u^) = K^-1 target,

where K = F + R + S P S^T is never formed: a parameter such as the place of the base has a prior deviation of
decimetres, and predictions deviate by micrometres. What is left of the covariance of two predictions is

    F(x, x') - V(x)^T V(x') + D(x)^T D(x'),    V = L^-1 F(rows, x),    D = B^-1 (P^1/2 S(x)^T - W^T V)

(Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006, section 2.7), in which nothing large cancels.
V and D are the features of x. So are those of any knowledge before the rows, whose V and D take the place of none and
of P^1/2 S^T: of control points, of a model that was placed anew, of unknowns that were opened since.
Shifts that rows share (:class:`Noise`) are parameters, too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan

import torch
from torch import Tensor

from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation, Numbers
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import Factor, lower_root

BLOCK_ENTRIES = 1 << 21
"""Number of covariances between data and queries that are computed together (16 MiB, within usual caches)."""
ROUNDING_RATIO = 1e-12  # eigenvalues of correlations, relative to the largest, that are rounding errors


@dataclass(frozen=True, eq=False)
class Features:
    """V and D of M configurations with r numbers each, see above, from which their covariances follow cheaply."""

    at: Linearisation  # the configurations
    known: Tensor  # V (k, M r)
    unknown: Tensor  # D (u, M r)

    @cached_property
    def by_fields(self) -> Tensor:
        """(M r, M r) covariance by the fields apart from all parameters, F - V^T V."""
        fields = self.at.fields.gram()
        with large_work(fields.numel()):
            return fields.addmm_(self.known.T, self.known, alpha=-1.0)

    def beside(self, known: Tensor, unknown: Tensor) -> Features:
        """These, and others (k, M r) and (u, M r)."""
        return replace(self, known=torch.cat([self.known, known]), unknown=torch.cat([self.unknown, unknown]))

    def rows(self, index: Tensor) -> Features:
        """Features of some configurations (B,)."""
        M = len(self.at.sensitivity)
        parts = (part.unflatten(1, (M, -1))[:, index].flatten(1) for part in (self.known, self.unknown))
        return Features(self.at.rows(index), *parts)

    def blocks(self) -> Tensor:
        """Covariance of every configuration of a projected linearisation with itself: (M, r, r)."""
        known, unknown = (part.T.unflatten(0, self.at.sensitivity.shape[:2]) for part in (self.known, self.unknown))
        return self.at.fields.own_blocks() - known @ known.mT + unknown @ unknown.mT

    def between(self, other: Features | None = None) -> Tensor:
        """Covariance (M r, M' r') with others, by default themselves."""
        if other is None:
            return self.by_fields.addmm(self.unknown.T, self.unknown)
        fields = self.at.fields.gram(other.at.fields)
        with large_work(fields.numel()):
            return fields.addmm_(self.known.T, other.known, alpha=-1.0).addmm_(self.unknown.T, other.unknown)


class Conditional(ABC):
    """The Gaussian conditional of linearisations on the data.

    Shifts that rows of the data share are parameters of unit variance after those of the nominal map, and unknowns
    that were opened later come after these. Of columns that a linearisation has not it does not depend, and a
    conditional leaves those out that it does not know.
    """

    size: int  # number of measured coordinates or momenta that are conditioned on

    @abstractmethod
    def features(self, at: Linearisation) -> Features:
        """Features of a linearisation, from which covariances between any of its configurations follow cheaply."""

    def given(self, new: Numbers, noise: Tensor, at: Features | None = None) -> Process:
        """What is known after rows with noise (N, R, R); ``at``: :meth:`features` of all of them, if known already.

        Raises:
            NumericalError: their covariance is not positive definite in float64.
        """
        at = self.features(new.at) if at is None else at
        known, unknown = new.there(at.known.T), new.there(at.unknown.T)
        factor = Factor.of(new.with_noise(at.by_fields, noise), unknown)
        return Process(self, new, known, factor, factor.white(new.target[:, None])[:, 0])

    def posterior(self, at: Linearisation) -> Tensor:
        """Posterior covariance at the M configurations of a projected linearisation, all at once: (M, r, r)."""
        return self.features(at).blocks()

    def covariance_between(self, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        """Posterior covariance of k1 between two linearisations, by default the same: (M m, M' m') in m^2."""
        return self.features(at).between(None if other is None else self.features(other))

    def covariance(self, at: Linearisation, directions: Tensor | None = None) -> Tensor:
        """Posterior covariance of k1 at the M configurations of a linearisation.

        Args:
            directions: (M, r, m) linear functions of k1(x) whose covariance is wanted instead of that of all m
                coordinates. The fewer, the faster.

        Returns:
            (M, r, r), in m^2 without directions.
        """
        count, m, _ = at.sensitivity.shape
        if directions is None:
            directions = torch.eye(m, dtype=at.sensitivity.dtype, device=at.sensitivity.device).expand(count, m, m)
        wanted = directions.shape[1]
        blocks = [at.sensitivity.new_zeros(0, wanted, wanted)]
        together = max(1, BLOCK_ENTRIES // max(wanted * self.size, 1))
        for rows in torch.arange(count, device=directions.device).split(together) if count else ():
            blocks.append(self.posterior(at.rows(rows).projected(directions[rows])))
        return torch.cat(blocks)


@dataclass(frozen=True, eq=False)
class BeforeData(Conditional):
    """The fields and parameters with these deviations (K,), before any data."""

    deviations: Tensor
    size = 0

    def features(self, at: Linearisation) -> Features:
        unknown = (of_parameters(at, len(self.deviations)).flatten(0, 1) * self.deviations).T
        return Features(at, unknown[:0], unknown)


class Opened(Conditional):
    """A conditional with more unknowns, of which the data so far say nothing.

    Args:
        before: without them. first: number of the first of their columns.
        deviations: (k,) of their prior.
    """

    def __init__(self, before: Conditional, first: int, deviations: Tensor) -> None:
        self.before, self.size, self.first, self.deviations = before, before.size, first, deviations

    def features(self, at: Linearisation) -> Features:
        features = self.before.features(at)
        opened = of_parameters(at, self.first + len(self.deviations))[..., self.first :] * self.deviations
        return features.beside(features.known[:0], opened.flatten(0, 1).T)


@dataclass(frozen=True, eq=False)
class Process(Conditional):
    """The posterior of fields and parameters by rows, see above.

    Args:
        before: what was known before them. numbers: M of the rows so far. known: (M, k) V of these before.
        factor: of their covariance then, with noise. alpha: (M,).
    """

    before: Conditional
    numbers: Numbers
    known: Tensor
    factor: Factor
    alpha: Tensor

    @classmethod
    def of_rows(cls, at: Linearisation, noise: Noise) -> Process:
        """By a linearisation of all data, with the prior of its parameters and with what the rows share."""
        deviations, shared = at.spec.prior_variance.sqrt(), noise.shared
        prior = BeforeData(torch.cat([deviations, shared.new_ones(shared.shape[2])]))
        at = at.with_columns(shared, len(deviations)) if shared.shape[2] else at
        return prior.given(Numbers.of(at, shown=noise.visible), noise.covariance)

    @property
    def size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.before.size + len(self.alpha)

    def given(self, new: Numbers, noise: Tensor, at: Features | None = None) -> Process:
        at = self.features(new.at) if at is None else at
        L, k = lower_root(new.with_noise(at.by_fields, noise)), self.known.shape[1]
        known, unknown = new.there(at.known.T), new.there((self.factor.B @ at.unknown).T)
        right = torch.cat([(new.target - known[:, k:] @ self.alpha)[:, None], unknown], 1)
        right = torch.linalg.solve_triangular(L, right, upper=False)
        return replace(
            self,
            numbers=self.numbers.joined(new),
            known=torch.cat([self.known, known[:, :k]]),
            factor=self.factor.joined(known[:, k:].T, L, right[:, 1:]),
            alpha=torch.cat([self.alpha, right[:, 0]]),
        )

    def opened(self, E: Tensor, size: float | None = None) -> Process:
        """Return the rows beside unknowns of this deviation, of any by default, with effects (M, U) on them alone."""
        E = E / E.norm(dim=0).clamp(min=torch.finfo(E.dtype).tiny) if size is None else size * E
        return replace(self, factor=self.factor.beside(E))

    def features(self, at: Linearisation) -> Features:
        before = self.before.features(at)
        cross = self.numbers.gram(at).addmm_(self.known, before.known, alpha=-1.0)
        more = self.factor.white(cross)
        unknown = torch.linalg.solve_triangular(self.factor.B, before.unknown - self.factor.W.T @ more, upper=False)
        return Features(at, torch.cat([before.known, more]), unknown)

    def mean(self, at: Features) -> Tensor:
        """(M r,) of numbers, with these features."""
        by_unknown = torch.linalg.solve_triangular(self.factor.B, (self.factor.W.T @ self.alpha)[:, None], upper=False)
        return at.known[self.known.shape[1] :].T @ self.alpha + at.unknown.T @ by_unknown[:, 0]

    @cached_property
    def _solved(self) -> tuple[Tensor, Tensor]:
        return self.factor.solved(self.numbers.target[:, None])

    @property
    def mu(self) -> Tensor:
        """(M,) K^-1 target."""
        return self._solved[0][:, 0]

    @property
    def inverse(self) -> Tensor:
        """(M, M) K^-1."""
        return self.factor.inverse

    @property
    def evidence(self) -> float:
        """log N(target; 0, K) of all numbers; that of later ones given the others is a difference."""
        return self.factor.log_density(self.numbers.target, self.mu)

    @property
    def estimate(self) -> Tensor:
        """(K,) posterior mean of the parameters of the nominal map."""
        return self._parameters(self._solved[1])

    def momenta(self, target: Tensor) -> Momenta:
        """Posterior mode of b, p, theta by another target (N, R): fields by mu, transported back to time 0."""
        mu, shift = self.factor.solved(self.numbers.of_table(target)[:, None])
        return self._momenta(mu[:, 0], shift)

    def of_white(self, values: Tensor) -> Momenta:
        """Momenta of mu = C values with C C^T = K^-1: (M,)."""
        mu = self.factor.of_white(values)
        return self._momenta(mu, self.factor.W.T @ (self.factor.L.T @ mu[:, None]))

    def _momenta(self, mu: Tensor, shift: Tensor) -> Momenta:
        """With parameters apart, since S^T mu would lose their digits; ``shift``: (K, 1) P^-1/2 u."""
        momenta = self.numbers.at.fields.momenta(self.numbers.in_table(mu))
        return replace(momenta, theta=self._parameters(shift))

    def _parameters(self, shift: Tensor) -> Tensor:
        variance = self.numbers.at.spec.prior_variance
        return variance.sqrt() * shift[: len(variance), 0]

    def about(self, target: Tensor) -> Process:
        """Return the rows with another target (N, R)."""
        target = self.numbers.of_table(target)
        alpha = self.factor.white(target[:, None])[:, 0]
        return replace(self, numbers=replace(self.numbers, target=target), alpha=alpha)

    def left_out(self, group: Tensor) -> tuple[Tensor, Tensor]:
        """Errors (M,) of groups of numbers as all others predict them, and their covariances with noise in (M, M).

        Args:
            group: (M,) that of each number; negative for none, with the error NaN.
        """
        errors, covariance = torch.full_like(self.mu, nan), torch.zeros_like(self.inverse)
        counts = group[group >= 0].unique(return_counts=True)[1]
        parts = group.argsort(stable=True)[int((group < 0).sum()) :].split(counts.tolist())
        for size in counts.unique().tolist():
            at = torch.stack([part for part in parts if len(part) == size])
            block = torch.linalg.inv(self.inverse[at[:, :, None], at[:, None]])
            errors[at] = (block @ self.mu[at][:, :, None])[:, :, 0]
            covariance[at[:, :, None], at[:, None]] = block
        return errors, covariance

    def rows_left_out(self, group: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Left-out errors (N, R) and covariances (N, R, R) by row; group: (N,), by default each by itself."""
        owner = self.numbers.owner
        errors, covariance = self.left_out(owner if group is None else group[owner])
        return self.numbers.in_table(errors), self.numbers.blocks(covariance)


class Estimated(Conditional):
    """Errors e(x) - B(x) w of the model beside unknowns w that were estimated from it, w = A e(X) + other errors.

    So it is where device and markers of another date were found by rows X. Without a measuring device nothing says
    where the robot stands: w is the rigid motion that fits the errors at X best, which counts for none. With U = T T^T
    the covariance of w,

        C(x, x') - g g'^T + (B(x) T - g) (B(x') T - g')^T,    g = C(x, X) A^T T^-T.

    Args:
        before: C. reference: linearisation at X, M rows of m numbers. gain: A (k, M m).
        columns: numbers of the columns B of a linearisation; zero where it has none.
        covariance: U (k, k); by default that of A e(X).
    """

    def __init__(
        self,
        before: Conditional,
        reference: Linearisation,
        gain: Tensor,
        columns: Sequence[int],
        covariance: Tensor | None = None,
    ) -> None:
        self.before, self.size, self.gain, self.columns = before, before.size, gain, list(columns)
        self.reference = before.features(reference)
        covariance = gain @ self.reference.between() @ gain.T if covariance is None else covariance
        self.root, self._to_white = roots(covariance)

    def slopes(self, at: Linearisation) -> Tensor:
        """B (M m, k)."""
        return of_parameters(at, max(self.columns) + 1)[..., self.columns].flatten(0, 1)

    def features(self, at: Linearisation) -> Features:
        features = self.before.features(at)
        fields = self.gain @ self.reference.at.fields.gram(at.fields)
        known, unknown = (self.gain @ part.T for part in (self.reference.known, self.reference.unknown))
        g = self._to_white @ (fields - known @ features.known + unknown @ features.unknown)
        return features.beside(g, self.root.T @ self.slopes(at).T - g)


def without_rigid_motions(before: Conditional, reference: Linearisation, base: Sequence[int]) -> Estimated:
    """A conditional without rigid motions, see :class:`Estimated`.

    Args:
        before: with them. reference: linearisation at X. base: numbers of the six parameters that move the base.
    """
    gain = torch.linalg.pinv(reference.sensitivity[..., list(base)].flatten(0, 1))  # (6, M m)
    return Estimated(before, reference, gain, base)


def roots(covariance: Tensor, rounding: float = ROUNDING_RATIO) -> tuple[Tensor, Tensor]:
    """T (k, k) with T T^T = U, and its pseudo-inverse; U may be singular, and of numbers in different units."""
    variances = covariance.diagonal().clamp(min=0.0)
    scale = torch.where(variances > 0.0, variances, 1.0).sqrt()
    values, vectors = torch.linalg.eigh(covariance / scale / scale[:, None])
    values = values.clamp(min=0.0)
    kept = values > rounding * values[-1]
    inverse = torch.where(kept, values, torch.inf).rsqrt()
    return scale[:, None] * vectors * values.sqrt(), (vectors * inverse).T / scale


def of_parameters(at: Linearisation, count: int) -> Tensor:
    """Derivatives (M, r, count) by the first parameters, zero by those of which a linearisation says nothing."""
    return torch.nn.functional.pad(at.sensitivity, (0, count - at.sensitivity.shape[2]))


def diagonal_blocks(matrix: Tensor, rows: int) -> Tensor:
    """The diagonal blocks of a matrix: (M m, M m) -> (M, m, m)."""
    m = len(matrix) // max(rows, 1)
    index = torch.arange(rows, device=matrix.device)
    return matrix.view(rows, m, rows, m)[index, :, index, :]
