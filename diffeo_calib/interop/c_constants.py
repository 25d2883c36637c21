"""Constants of a program in the layout of the generated C source (c_source.py), and as its text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, isinf

import numpy as np

from diffeo_calib.runtime.arrays import Array
from diffeo_calib.runtime.chain import CalibratedChain, Sag
from diffeo_calib.runtime.flow import RadialTerm, RecordedFlow
from diffeo_calib.runtime.tables import JointTables

LANES = 16
"""Controls per block: inner loops of constant length, which compilers turn into vector instructions."""


@dataclass(frozen=True, eq=False)
class TermConstants:
    """A term whose controls come in blocks, without the components that it does not move.

    Args:
        name: of its C function. term: the term.
    """

    name: str
    term: RadialTerm

    @property
    def profile(self) -> str:
        """Name of kappa, and of its C function."""
        return self.term.profile

    @property
    def inputs(self) -> list[int]:
        """Columns of x: those on lines, then those on circles."""
        return [*self.term.lines, *self.term.circles]

    @property
    def lines(self) -> int:
        """Number of columns on lines."""
        return len(self.term.lines)

    @property
    def circles(self) -> int:
        """Number of columns on circles."""
        return len(self.term.circles)

    @property
    def scales(self) -> Array:
        """Inverse length scales of the inputs."""
        return self.term.scales

    @cached_property
    def centre(self) -> Array:
        """Of the controls on the lines: differences of far points would lose digits."""
        return self.term.controls[..., list(self.term.lines)].mean(axis=(0, 1))

    @property
    def constant(self) -> float:
        """Sum of s^2 over the circles: half the squared distance is that minus a product of features."""
        return float((self._circle_scales**2).sum())

    @cached_property
    def outputs(self) -> np.ndarray:
        """Components that the term moves."""
        return np.flatnonzero(self.term.weights.any(axis=(0, 1)))

    @property
    def width(self) -> int:
        """Components of a weight: an even number, if they are several, since vector registers hold pairs."""
        return len(self.outputs) + (len(self.outputs) % 2 if len(self.outputs) > 1 else 0)

    @cached_property
    def features(self) -> Array:
        """(S, blocks, D, LANES): lines from the centre, then cosine and sine of every circle."""
        controls, scales = self.term.controls, self._circle_scales
        straight = (controls[..., list(self.term.lines)] - self.centre) * self.scales[: self.lines]
        angles = controls[..., list(self.term.circles)]
        turning = np.stack([np.cos(angles) * scales, np.sin(angles) * scales], axis=-1)  # (S, C, circles, 2)
        both = [straight, turning.reshape(*angles.shape[:2], 2 * self.circles)]
        return _blocks(np.concatenate(both, axis=-1)).swapaxes(2, 3)

    @cached_property
    def weights(self) -> Array:
        """(S, blocks, LANES, width)."""
        missing = self.width - len(self.outputs)
        return _blocks(np.pad(self.term.weights[..., self.outputs], ((0, 0), (0, 0), (0, missing))))

    @property
    def _circle_scales(self) -> Array:
        return self.scales[self.lines :]


def _blocks(values: Array) -> Array:
    """(S, C, D) -> (S, blocks, LANES, D), filled up with zeros."""
    missing = -values.shape[1] % LANES
    return np.pad(values, ((0, 0), (0, missing), (0, 0))).reshape(len(values), -1, LANES, values.shape[2])


@dataclass(frozen=True, eq=False)
class TableConstants:
    """Tables of all stages and joints, one after the other.

    Args:
        tables: of a flow.
    """

    tables: JointTables

    @property
    def joints(self) -> Sequence[int]:
        """Numbers of the tabulated joints."""
        return self.tables.joints

    @property
    def first(self) -> list[int]:
        """First row of every table, stage by stage, and the number of rows."""
        lengths = [len(table.knots) for stage in self.tables.stages for table in stage]
        return [0, *np.cumsum(lengths).tolist()]

    @cached_property
    def knots(self) -> Array:
        """(rows,) rad."""
        return np.concatenate([table.knots for stage in self.tables.stages for table in stage])

    @property
    def derivatives(self) -> Array:
        """(rows, 3) f, f', f''."""
        return np.concatenate([table.values for stage in self.tables.stages for table in stage])


@dataclass(frozen=True, eq=False)
class FlowConstants:
    """A flow that does not vanish.

    Args:
        name: beginning of its C functions' names. title: what it does. flow: the flow.
    """

    name: str
    title: str
    flow: RecordedFlow

    @property
    def size(self) -> int:
        """Components of a point."""
        return self.flow.size

    @property
    def steps(self) -> int:
        """Number of equal Runge-Kutta steps."""
        return self.flow.steps

    @property
    def stages(self) -> int:
        """Stages per step."""
        return len(self.flow.weights)

    @property
    def coefficients(self) -> Array:
        """Runge-Kutta coefficients times the length of a step."""
        return self.flow.coefficients / self.steps

    @property
    def weights(self) -> Array:
        """Runge-Kutta weights times the length of a step."""
        return self.flow.weights / self.steps

    @cached_property
    def terms(self) -> list[TermConstants]:
        """Sums over the controls."""
        return [TermConstants(f"{self.name}_term{k}", term) for k, term in enumerate(self.flow.terms, 1)]

    @cached_property
    def tables(self) -> TableConstants | None:
        """Functions of single joints; None without."""
        return None if self.flow.tables is None else TableConstants(self.flow.tables)


@dataclass(frozen=True, eq=False)
class SagConstants:
    """Gravity sag with moments as sums of o_f x c_f, in place of the matrix W of blocks -[c_f]x.

    Args:
        chain: the chain. sag: its sag.
    """

    chain: CalibratedChain
    sag: Sag

    @property
    def count(self) -> int:
        """Number K of coordinates."""
        return len(self.sag.joints)

    @property
    def masses(self) -> Array:
        """(K, F, 3) c."""
        W = self.sag.moments.reshape(self.count, 3, len(self.sag.offsets), 3)
        return -np.stack([W[:, 2, :, 1], W[:, 0, :, 2], W[:, 1, :, 0]], axis=-1)

    @property
    def moved(self) -> np.ndarray:
        """(F, n_all) 1 where joint l moves place f as seen from the ground."""
        return (self.sag.moved != 0) * 1

    @property
    def shifts(self) -> np.ndarray:
        """(K,) whether the coordinate shifts its joint, or turns it."""
        return np.any(self._directions[:, 0], axis=1)

    @property
    def directions(self) -> Array:
        """(K, 3) of the shift, or the axis of the turn."""
        return np.where(self.shifts[:, None], self._directions[:, 0], self._directions[:, 1])

    @property
    def _directions(self) -> Array:
        """(K, 2, 3) shift and rotation vector of the coordinate's own joint."""
        blocks = self.sag.directions.reshape(self.count, len(self.chain.axes), 2, 3)
        return blocks[np.arange(self.count), self.sag.joints]


WIDTH = 120
"""Longest line of numbers."""


def number(value: float) -> str:
    """The shortest decimal text that a compiler reads back as the same number; integers stay integers."""
    if isinstance(value, int):
        return str(value)
    if isinf(value):
        return "HUGE_VAL" if value == inf else "-HUGE_VAL"
    return repr(value)


def array(values: object) -> str:
    """An initialiser with a pair of braces for every dimension."""
    given = values.tolist() if isinstance(values, np.ndarray) else values
    if not isinstance(given, Sequence):
        raise TypeError(f"no array: {given!r}")
    return _braces(given)


def pose(transform: np.ndarray) -> str:
    """An initialiser of the generated struct Pose from a transform (4, 4)."""
    return f"{{{_row(transform[:3, :3].ravel().tolist())}, {_row(transform[:3, 3].tolist())}}}"


def poses(transforms: np.ndarray) -> str:
    """An initialiser of an array of Pose from transforms (L, 4, 4)."""
    return "{\n" + ",\n".join(f"    {pose(transform)}" for transform in transforms) + "}"


def _braces(values: Sequence) -> str:
    if not isinstance(values[0], list | tuple):
        return _row(values)
    return "{" + ",\n".join(_braces(part) for part in values) + "}"


def _row(values: Sequence) -> str:
    return "{" + ",\n".join(_lines([number(value) for value in values])) + "}"


def _lines(words: Sequence[str]) -> Iterator[str]:
    line = ""
    for word in words:
        if line and len(line) + len(word) + 3 > WIDTH:
            yield line
            line = word
        else:
            line = f"{line}, {word}" if line else word
    yield line
