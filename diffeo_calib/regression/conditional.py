"""What all ways to condition on the data share: covariances from features, and parameters apart from the fields.

A parameter such as the place of the base has a prior deviation of decimetres, and predictions deviate by micrometres:
the difference G(x, x) - G(x, data) (G + R)^-1 G(data, x) loses eight digits and more. With G = F + S Lambda^-1 S^T, F
the covariance of the fields, it is

    F(x, x) - F(x, data) (F + R)^-1 F(data, x) + D (Lambda + S^T (F + R)^-1 S)^-1 D^T
    D = S(x) - F(x, data) (F + R)^-1 S

(Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006, section 2.7), in which nothing large cancels.
Shifts that rows share (:class:`Noise`) are parameters, too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise

NOISE_ADVICE = "raise `noise` or lower the kernels' variances"
"""How to repair a matrix that float64 cannot factorise."""
BLOCK_ENTRIES = 1 << 21
"""Number of covariances between data and queries that are computed together (16 MiB, within usual caches)."""
ROUNDING_RATIO = 1e-12  # eigenvalues of correlations, relative to the largest, that are rounding errors


class Features(NamedTuple):
    """Features f of M configurations: what parameters and data add to the covariance of the fields, a column each.

    covariance(x, x') = F(x, x') + sum_k sign_k f_k(x) f_k(x')^T, with F that of the fields. Nothing large cancels.
    """

    at: Linearisation  # the linearisation, r numbers each
    values: Tensor  # (k, M r)
    signs: Tensor  # (k,) 1 or -1

    @classmethod
    def of(cls, at: Linearisation, *parts: tuple[Tensor, int]) -> Features:
        """Several features (k_i, M r), each with its sign."""
        signs = [values.new_full((len(values),), float(sign)) for values, sign in parts]
        return cls(at, torch.cat([values for values, _ in parts]), torch.cat(signs))

    def beside(self, *parts: tuple[Tensor, int]) -> Features:
        """These, and others (k_i, M r) with their signs."""
        _, values, signs = Features.of(self.at, *parts)
        return Features(self.at, torch.cat([self.values, values]), torch.cat([self.signs, signs]))

    def rows(self, index: Tensor) -> Features:
        """Those of some configurations (B,)."""
        values = self.values.unflatten(1, (len(self.at.sensitivity), -1))[:, index].flatten(1)
        return Features(self.at.rows(index), values, self.signs)

    def blocks(self) -> Tensor:
        """Covariance of every configuration of a projected linearisation with itself: (M, r, r)."""
        values = self.values.T.reshape(*self.at.sensitivity.shape[:2], -1)
        return self.at.fields.own_blocks() + (values * self.signs) @ values.mT

    def between(self, other: Features | None = None) -> Tensor:
        """Covariance (M r, M' r') with others, by default themselves."""
        theirs = self if other is None else other
        fields = self.at.fields.gram(None if other is None else other.at.fields)
        with large_work(fields.numel()):
            return fields.addmm_(self.values.T * self.signs, theirs.values)


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


class DataConditional(Conditional):
    """Conditioning with all N data of m numbers as control points; the unknown is mu, the momentum at time 1.

    Args:
        linearisation: first-order response of k1 at the data to fields and parameters. noise: R.

    Attributes:
        slopes: H (N m, K + c) derivatives by parameters and shared shifts, in units of their prior ``deviations``.
    """

    def __init__(self, linearisation: Linearisation, noise: Noise) -> None:
        self.linearisation, self.size = linearisation, linearisation.sensitivity.shape[:2].numel()
        deviations, shared = linearisation.spec.prior_variance.sqrt(), noise.shared
        self.slopes = torch.cat([linearisation.sensitivity * deviations, shared], 2).flatten(0, 1)
        self.deviations = torch.cat([deviations, shared.new_ones(shared.shape[2])])

    @abstractmethod
    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k)."""

    @abstractmethod
    def white(self, values: Tensor) -> Tensor:
        """T values (N m, k), with T^T T = (F + R)^-1 of fields and noise."""

    @property
    @abstractmethod
    def apart(self) -> tuple[Tensor, Tensor]:
        """W = T H, and the Cholesky factor B of 1 + W^T W."""

    def mu(self, target: Tensor) -> Tensor:
        """(G + R)^-1 target: (N, m) -> (N, m)."""
        return self.solve(target[:, :, None])[:, :, 0]

    def momenta(self, target: Tensor) -> Momenta:
        """Posterior mode of b, p, theta: mu transported back to time 0.

        Args:
            target: (N, m) measured minus linearised model at zero fields, m.
        """
        return self.linearisation.momenta(self.mu(target))

    def features(self, at: Linearisation) -> Features:
        """Information of the data about the fields, and about the parameters without it (K + c, M r)."""
        W, B = self.apart
        cross = self.linearisation.fields.gram(at.fields)
        with large_work(cross.numel()):
            known = self.white(cross)
        unknown = (of_parameters(at, len(B)).flatten(0, 1) * self.deviations).T - W.T @ known  # (D Lambda^-1/2)^T
        return Features.of(at, (known, -1), (torch.linalg.solve_triangular(B, unknown, upper=False), 1))


class Fields(Conditional):
    """The fields alone, before any data and without parameters."""

    size = 0

    def features(self, at: Linearisation) -> Features:
        rows = at.sensitivity.flatten(0, 1)
        return Features.of(at, (rows.new_zeros(0, len(rows)), 1))


class Opened(Conditional):
    """The same with more unknowns, of which the data so far say nothing.

    Args:
        before: without them. first: number of the first of their columns.
        deviations: (k,) of their prior.
    """

    def __init__(self, before: Conditional, first: int, deviations: Tensor) -> None:
        self.before, self.size, self.first, self.deviations = before, before.size, first, deviations

    def features(self, at: Linearisation) -> Features:
        opened = of_parameters(at, self.first + len(self.deviations))[..., self.first :] * self.deviations
        return self.before.features(at).beside((opened.flatten(0, 1).T, 1))


class Given(Conditional):
    """The same after more rows.

    Args:
        before: without them. rows: linearisation of what they report. noise: (O, r, r).

    Raises:
        NumericalError: their covariance is not positive definite in float64.
    """

    def __init__(self, before: Conditional, rows: Linearisation, noise: Tensor) -> None:
        self.before, self.rows = before, before.features(rows)
        self.size = before.size + noise.shape[:2].numel()
        self._root = lower_root(self.rows.between() + torch.block_diag(*noise))

    def features(self, at: Linearisation) -> Features:
        found = self.before.features(at)
        return found.beside((torch.linalg.solve_triangular(self._root, self.rows.between(found), upper=False), -1))


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
        self._by_gain = gain @ self.reference.values.T
        self.root, self._to_white = roots(covariance)

    def slopes(self, at: Linearisation) -> Tensor:
        """B (M m, k)."""
        return of_parameters(at, max(self.columns) + 1)[..., self.columns].flatten(0, 1)

    def features(self, at: Linearisation) -> Features:
        found = self.before.features(at)
        fields = self.gain @ self.reference.at.fields.gram(at.fields)
        g = self._to_white @ (fields + self._by_gain * found.signs @ found.values)
        return found.beside((g, -1), (self.root.T @ self.slopes(at).T - g, 1))


def without_rigid_motions(before: Conditional, reference: Linearisation, base: Sequence[int]) -> Estimated:
    """The same conditional without rigid motions, see :class:`Estimated`.

    Args:
        before: with them. reference: linearisation at X. base: numbers of the six parameters that move the base.
    """
    gain = torch.linalg.pinv(reference.sensitivity[..., list(base)].flatten(0, 1))  # (6, M m)
    return Estimated(before, reference, gain, base)


def lower_root(F: Tensor) -> Tensor:
    """L with L L^T = F (M, M); NumericalError where F is not positive definite in float64."""
    with large_work(F.numel()):
        L, info = torch.linalg.cholesky_ex(F)
    if int(info):
        raise NumericalError.of("the covariance of the rows is not positive definite", fix=NOISE_ADVICE)
    return L


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
