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
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise

NOISE_ADVICE = "raise `noise` or lower the kernels' variances"
"""How to repair a matrix that float64 cannot factorise."""
BLOCK_ENTRIES = 1 << 21
"""Number of covariances between data and queries that are computed together (16 MiB, within usual caches)."""
ROUNDING_RATIO = 1e-6  # deviations of a rigid motion, relative to the largest, that are rounding errors


class Features(NamedTuple):
    """Features f at M configurations: what parameters and data add to the covariance of the fields, a column each.

    covariance(x, x') = F(x, x') + sum_k sign_k f_k(x) f_k(x')^T, with F that of the fields alone.

    Args:
        values: (k, M m). signs: (k,) 1 or -1.
    """

    values: Tensor
    signs: Tensor

    @classmethod
    def of(cls, *parts: tuple[Tensor, int]) -> Features:
        """Several features (k_i, M m), each with its sign."""
        signs = [values.new_full((len(values),), float(sign)) for values, sign in parts]
        return cls(torch.cat([values for values, _ in parts]), torch.cat(signs))


class Conditional(ABC):
    """The Gaussian conditional of one linearisation on the data.

    Shifts that rows of the data share are parameters of unit variance after those of the nominal map. Linearisations
    that take part in some have columns for all; others have none.

    Attributes:
        size: number of measured coordinates or momenta that are conditioned on.
    """

    size: int

    @property
    def inner(self) -> Conditional:
        """The same with rigid motions, where they are left out."""
        return self

    @abstractmethod
    def features(self, at: Linearisation) -> Features:
        """Features of a linearisation, from which covariances between any of its configurations follow cheaply."""

    def posterior(self, at: Linearisation) -> Tensor:
        """Posterior covariance at the M configurations of a projected linearisation, all at once: (M, r, r).

        Nothing large cancels in covariances from features.
        """
        values, signs = self.features(at)
        values = values.T.reshape(*at.sensitivity.shape[:2], -1)
        return at.fields.own_blocks() + (values * signs) @ values.mT

    def covariance_between(self, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        """Posterior covariance of k1 between two linearisations, by default the same: (M m, M' m') in m^2."""
        mine, signs = self.features(at)
        theirs = mine if other is None else self.features(other).values
        return at.fields.gram(None if other is None else other.fields) + (mine.T * signs) @ theirs

    def compared(self, points: Tensor, targets: Tensor, fit: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Points (M, 3) as they are compared with targets, m: rigid motions are errors like others.

        Args:
            fit: the best rigid transform (4, 4) from points to targets.
        """
        return points

    def compared_slopes(self, slopes: Tensor) -> Tensor:
        """Derivatives (M m, k) of k1 at the map's workspace as they are compared, see :meth:`compared`."""
        return slopes

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
        return Features.of((known, -1), (torch.linalg.solve_triangular(B, unknown, upper=False), 1))


class WithoutRigidMotions(Conditional):
    """The same conditional without rigid motions: without a measuring device nothing says where the robot stands.

    Errors e of the model at reference configurations X are split into the rigid motion w = B(X)^+ e(X) that fits them
    best, and the rest; what counts at x is

        e(x) - B(x) w,    covariance  C(x, x') - g g'^T + (B(x) T - g) (B(x') T - g')^T,    g = C(x, w) T^-T,

    with B(x) the derivatives of k1(x) by the twist of the base, and T T^T = C(w, w).

    Args:
        inner: with them. reference: linearisation at X. base: numbers of the six parameters that move the base.
    """

    def __init__(self, inner: Conditional, reference: Linearisation, base: Sequence[int]) -> None:
        self.size, self._inner, self.reference, self.base = inner.size, inner, reference, list(base)
        self.fit = torch.linalg.pinv(self.motions(reference))  # (6, M m)
        self._by_motion = self.fit @ inner.features(reference).values.T
        values, vectors = torch.linalg.eigh(self.fit @ inner.covariance_between(reference) @ self.fit.mT)
        self.root = vectors * values.clamp(min=0.0).sqrt()
        self._to_white = torch.linalg.pinv(self.root, rtol=ROUNDING_RATIO)

    def motions(self, at: Linearisation) -> Tensor:
        """B (M m, 6)."""
        return at.sensitivity[..., self.base].flatten(0, 1)

    @property
    def inner(self) -> Conditional:
        return self._inner

    def features(self, at: Linearisation) -> Features:
        values, signs = self.inner.features(at)
        fields = self.fit @ self.reference.fields.gram(at.fields)
        g = self._to_white @ (fields + self._by_motion * signs @ values)
        left = self.root.T @ self.motions(at).T - g
        return Features(torch.cat([values, g, left]), torch.cat([signs, signs.new_tensor([-1.0] * 6 + [1.0] * 6)]))

    def compared(self, points: Tensor, targets: Tensor, fit: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        T = fit(points, targets)
        return points @ T[:3, :3].mT + T[:3, 3]

    def compared_slopes(self, slopes: Tensor) -> Tensor:
        return slopes - self.motions(self.reference) @ (self.fit @ slopes)


def of_parameters(at: Linearisation, count: int) -> Tensor:
    """Derivatives (M, r, count) by all parameters, zero by shifts of which a linearisation says nothing."""
    return torch.nn.functional.pad(at.sensitivity, (0, count - at.sensitivity.shape[2]))


def diagonal_blocks(matrix: Tensor, rows: int) -> Tensor:
    """The diagonal blocks of a matrix: (M m, M m) -> (M, m, m)."""
    m = len(matrix) // max(rows, 1)
    index = torch.arange(rows, device=matrix.device)
    return matrix.view(rows, m, rows, m)[index, :, index, :]
