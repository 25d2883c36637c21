"""One-dimensional periodic functions as tables: a joint's transmission error at every stage of the flow.

A term of the joint kernel that acts on one revolute joint alone makes the field

    f(x) = sum_j w_j kappa(2 (1 - cos(x - q_j)) / l^2),

a function of that joint's value. Quintic Hermite interpolation of (f, f', f'') replaces the sum. Matern kernels have
kinks in a higher derivative at the controls: these are knots, so that the function is smooth within every cell. Cells
are halved until the error at their middle is below :data:`TOLERANCE`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import FORMULAS, NUMPY, Array, as_index

TOLERANCE = 1e-13  # largest error of a table, rad; for fields above 1 rad relative to the largest
FEWEST_CELLS, MOST_CELLS = 64, 16384
CLOSEST_KNOTS_RAD = 1e-5  # kinks closer than this to a knot, rad, become no knots of their own
BLOCK = 1 << 14  # largest number of kernel values that are held at once
TURN = 2 * np.pi
CIRCLE_SPACING_RAD = 8.0
"""Distance between the circles of two joints on the line where all cells are searched at once; more than 2 pi."""


@dataclass(frozen=True, eq=False)
class PeriodicSum:
    """sum_j w_j kappa(2 (1 - cos(x - q_j)) / l^2) at one stage."""

    profile: str  # name of kappa
    lengthscale: float  # l, a pure number
    angles: Array  # (C,) q_j, rad
    weights: Array  # (C,) w_j, rad

    @property
    def kinks(self) -> Array:
        """Where a derivative of low order jumps, in [0, 2 pi)."""
        return np.mod(self.angles, TURN) if self.profile.startswith("matern") else np.zeros(0)

    def derivatives(self, x: Array) -> Array:
        """f, f', f'' in rad, 1, 1/rad: (K, 3) at x (K,)."""
        cosine, sine, scale = np.cos(self.angles), np.sin(self.angles), 2.0 / self.lengthscale**2
        out, size = np.empty((len(x), 3)), max(BLOCK // len(self.angles), 1)
        for rows in (slice(first, first + size) for first in range(0, len(x), size)):
            around = np.stack([np.cos(x[rows]), np.sin(x[rows])], axis=1)
            along, across = around @ np.stack([cosine, sine]), around @ np.stack([-sine, cosine])  # cos, sin of x - q
            kappa, slope, curvature = FORMULAS[self.profile](scale * (1.0 - along), range(3))
            first, second = scale * across, scale * along  # derivatives of the squared distance
            sums = (kappa, slope * first, curvature * first**2 + slope * second)
            out[rows] = np.stack([s @ self.weights for s in sums], axis=1)
        return out


@dataclass(frozen=True, eq=False)
class Table:
    """A function on the circle, interpolated in cells."""

    knots: Array  # (K + 1,) ascending from 0 to 2 pi
    values: Array  # (K + 1, 3) f, f', f'' there; the last row repeats the first

    @property
    def coefficients(self) -> Array:
        """Coefficients of (x - knot)^0 ... (x - knot)^5 in every cell: (6, K)."""
        h, (left, right) = np.diff(self.knots), (self.values[:-1].T, self.values[1:].T)
        f, d, c = left[0], left[1] * h, left[2] * h**2
        df, dd, dc = right[0] - f - d - 0.5 * c, right[1] * h - d - c, right[2] * h**2 - c
        rows = (f, d, 0.5 * c, 10 * df - 4 * dd + 0.5 * dc, -15 * df + 7 * dd - dc, 6 * df - 3 * dd + 0.5 * dc)
        return np.stack([row / h**k for k, row in enumerate(rows)])


@dataclass(frozen=True, eq=False)
class JointTables:
    """Functions of single joints at every stage."""

    joints: slice | list[int]  # numbers of the L joints, ascending, as an index
    stages: tuple[tuple[Table, ...], ...]  # for every stage a table per joint
    selection: Array  # (L, n) units of these joints
    shifts: Array  # (L,) of the circles of the joints, which lie side by side on a line
    # (S, power of 2) first knots of the cells of a stage on this line, ascending; of each circle's first cell a place
    # before it
    starts: Array
    cells: Array  # (S, 7, K) first knot, and coefficients of (x - knot)^0 ... (x - knot)^5.

    @classmethod
    def of(cls, joints: Sequence[int], stages: Sequence[Sequence[Table]], size: int) -> JointTables:
        """Tables of these joints of n at every stage."""
        shifts = CIRCLE_SPACING_RAD * np.arange(len(joints), dtype=np.float64)
        most = max(sum(len(table.knots) - 1 for table in tables) for tables in stages)
        starts = np.full((len(stages), 1 << most.bit_length()), CIRCLE_SPACING_RAD * (len(joints) + 1))
        cells = np.zeros((len(stages), 7, most))
        for stage, tables in enumerate(stages):
            knots = np.concatenate([t.knots[:-1] + shift for t, shift in zip(tables, shifts, strict=True)])
            rows = np.vstack([knots, np.concatenate([t.coefficients for t in tables], axis=1)])
            first = np.isin(knots, shifts)
            starts[stage, : len(knots)], cells[stage, :, : len(knots)] = knots - 1.0 * first, rows
        return cls(as_index(joints), tuple(map(tuple, stages)), np.eye(size)[list(joints)], shifts, starts, cells)

    def velocity_and_jacobian(self, stage: int, x: Array) -> tuple[Array, Array]:
        """f of every joint in its component (N, n), and the derivative of the interpolated f, (N, n, n)."""
        value, u, c = tabulated(self, stage, x, NUMPY)
        slope = (((5 * c[5] * u + 4 * c[4]) * u + 3 * c[3]) * u + 2 * c[2]) * u + c[1]
        return value @ self.selection, (slope @ self.selection)[..., None] * np.eye(x.shape[1])


def tabulated(tables: Any, stage: int, x: Any, use: Any) -> tuple[Any, Any, list[Any]]:
    """f of every joint (N, L) at x (N, n), the distances (N, L) from the knots, and the coefficients there.

    ``tables`` are the constants of :class:`JointTables`, as arrays of a library.
    """
    t = use.within_turn(x[..., tables.joints]) + tables.shifts
    start, *c = use.cells_around(tables.starts[stage], tables.cells[stage], t)
    u = t - start
    return _quintic(c, u), u, c


def _quintic(c: Any, u: Any) -> Any:
    return ((((c[5] * u + c[4]) * u + c[3]) * u + c[2]) * u + c[1]) * u + c[0]


def tabulate(sums: Sequence[PeriodicSum]) -> Table | None:
    """A table of the sum of these functions; None if it would need more than :data:`MOST_CELLS` cells."""
    places = np.sort(np.concatenate([np.linspace(0.0, TURN, FEWEST_CELLS + 1), *(s.kinks for s in sums)]))
    places = places[np.concatenate([[True], np.diff(places) > CLOSEST_KNOTS_RAD])]
    knots = np.concatenate([places[places < TURN - CLOSEST_KNOTS_RAD], [TURN]])
    values = _derivatives(sums, knots)
    limit = TOLERANCE * max(1.0, float(np.abs(values[:, 0]).max()))
    open_cells = np.ones(len(knots) - 1, dtype=bool)
    while open_cells.any():
        middles = 0.5 * (knots[:-1] + knots[1:])[open_cells]
        c, u = Table(knots, values).coefficients[:, open_cells], middles - knots[:-1][open_cells]
        wrong = np.abs(_quintic(c, u) - _derivatives(sums, middles)[:, 0]) > limit
        if len(knots) + int(wrong.sum()) > MOST_CELLS:
            return None
        cells = np.flatnonzero(open_cells)[wrong]  # to be halved
        knots, halves = np.insert(knots, cells + 1, middles[wrong]), cells + np.arange(len(cells))
        values = np.insert(values, cells + 1, _derivatives(sums, middles[wrong]), axis=0)
        open_cells = np.isin(np.arange(len(knots) - 1), [halves, halves + 1])
    return Table(knots, values)


def _derivatives(sums: Sequence[PeriodicSum], x: Array) -> Array:
    return np.sum([s.derivatives(x) for s in sums], axis=0)
