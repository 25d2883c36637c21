"""The weights of a pair of points as a list of operations, recorded once and lowered by every backend.

Formulas and profiles are run on symbols. What they did is then carried out on matrices (tiled.py), in compiled loops
(loops.py) or by LazyTensors (keops.py). A product with a number is free: it is kept beside the value and applied to the
sums.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import exp
from typing import Any, NamedTuple

from diffeo_calib.kernels.profiles import SHIPPED, Profile
from diffeo_calib.kernels.reductions.formulas import LEAVES, Formula

MOST_FACTORS = 8  # of a power in a profile


class Node(NamedTuple):
    """An operation on earlier nodes a, b and a number c.

    One of :data:`LEAVES`; or a b "product", a / b "ratio", a + c b "sum", a + c "shift", c a "scale", 1 / a "inverse",
    exp(c a) "exp", "sqrt", max(a, 0) "relu".
    """

    name: str
    operands: tuple[int, ...] = ()
    number: float = 1.0


@dataclass(frozen=True)
class Weights:
    """The weights w_ij of a formula with a profile."""

    nodes: tuple[Node, ...]  # what is computed, in order
    # for every weight the number of its node, None for the number one, and its scale
    results: tuple[tuple[int | None, float], ...]

    @cached_property
    def _hash(self) -> int:
        return hash((self.nodes, self.results))

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def uses(self) -> list[int]:
        """How often every node is read, by results and by nodes that are read themselves."""
        counts = [0] * len(self.nodes)
        for node, _ in self.results:
            if node is not None:
                counts[node] += 1
        for k in reversed(range(len(counts))):
            for operand in self.nodes[k].operands if counts[k] else ():
                counts[operand] += 1
        return counts

    def steps(self) -> Iterator[tuple[int, Node]]:
        """The nodes that are read, with their numbers."""
        return ((k, node) for k, node in enumerate(self.nodes) if self.uses[k])

    @cached_property
    def positive(self) -> list[bool]:
        """Whether the value of every node is known not to be negative, but for rounding."""
        signs: list[bool] = []
        for name, operands, number in self.nodes:
            square = name == "product" and operands[0] == operands[1]
            inherits = name in ("product", "ratio", "sum", "shift", "inverse") and number >= 0.0
            kept = inherits and all(signs[k] for k in operands)
            signs.append(name in ("r2", "exp", "sqrt", "relu") or square or kept)
        return signs


class Symbol:
    """scale * value of a node, or the number ``scale`` itself where there is no node.

    A symbol has no value yet: comparing it raises TypeError, where Python's defaults would answer with a guess.
    """

    __slots__ = ("node", "nodes", "scale")

    def __init__(self, nodes: dict[Node, int], node: int | None, scale: float = 1.0) -> None:
        self.nodes, self.node, self.scale = nodes, node, scale

    def _new(self, scale: float, name: str, *operands: int | None, number: float = 1.0) -> Symbol:
        """scale * an operation, which is recorded unless it was before."""
        node = Node(name, tuple(k for k in operands if k is not None), number)
        return Symbol(self.nodes, self.nodes.setdefault(node, len(self.nodes)), scale)

    def __mul__(self, other: Any) -> Symbol:
        if not isinstance(other, Symbol):
            number = float(other)
            return Symbol(self.nodes, self.node if number else None, self.scale * number)
        if self.node is None or other.node is None:
            return other * self.scale if self.node is None else self * other.scale
        return self._new(self.scale * other.scale, "product", *sorted((self.node, other.node)))

    def __add__(self, other: Any) -> Symbol:
        other = other if isinstance(other, Symbol) else Symbol(self.nodes, None, float(other))
        if self.node is None and other.node is None:
            return Symbol(self.nodes, None, self.scale + other.scale)
        if self.node is None or self.scale == 0.0:
            return other + self.scale if self.scale else other
        ratio = other.scale / self.scale
        if ratio == 0.0:
            return self
        return self._new(self.scale, "shift" if other.node is None else "sum", self.node, other.node, number=ratio)

    def __neg__(self) -> Symbol:
        return self * -1.0

    def __sub__(self, other: Any) -> Symbol:
        return self + -other

    def __rsub__(self, other: Any) -> Symbol:
        return -self + other

    def __truediv__(self, other: Any) -> Symbol:
        if not isinstance(other, Symbol) or other.node is None:
            return self * (1.0 / (other.scale if isinstance(other, Symbol) else float(other)))
        scale = self.scale / other.scale
        return self._new(scale, "inverse" if self.node is None else "ratio", self.node, other.node)

    def __rtruediv__(self, other: Any) -> Symbol:
        return Symbol(self.nodes, None, float(other)) / self

    def __pow__(self, power: Any) -> Symbol:
        whole = int(power)
        if whole != power or not 0 < abs(whole) <= MOST_FACTORS:
            raise TypeError(f"a power of a profile: expected a whole number up to {MOST_FACTORS}, got {power}")
        product = self
        for _ in range(abs(whole) - 1):
            product = product * self
        return product if whole > 0 else 1.0 / product

    def exp(self) -> Symbol:
        """Elementwise."""
        if self.node is None or self.scale == 0.0:
            return Symbol(self.nodes, None, exp(self.scale if self.node is None else 0.0))
        return self._new(1.0, "exp", self.node, number=self.scale)

    def sqrt(self) -> Symbol:
        """Elementwise."""
        if self.node is None:
            return Symbol(self.nodes, None, self.scale**0.5)
        plain = self._positive_multiple()
        return self._new(plain.scale**0.5, "sqrt", plain.node)

    def relu(self) -> Symbol:
        """max(x, 0), elementwise."""
        if self.node is None:
            return Symbol(self.nodes, None, max(self.scale, 0.0))
        plain = self._positive_multiple()
        return self._new(plain.scale, "relu", plain.node)

    def square(self) -> Symbol:
        """Elementwise."""
        return self * self

    def _positive_multiple(self) -> Symbol:
        """The value with a positive scale."""
        return self if self.scale > 0.0 else self._new(1.0, "scale", self.node, number=self.scale)

    def _refuse(self, *_: object) -> Any:
        raise TypeError("a pairwise symbol has no value to compare")

    __rmul__, __radd__ = __mul__, __add__
    __eq__ = __ne__ = __bool__ = _refuse


def recorded(formula: Formula, profile: Profile) -> Weights | None:
    """The weights of a formula with a profile; None where a profile of the user needs operations that symbols lack.

    A user's profile is recorded anew at every call, since its parameters may have changed.
    """
    return _of_package(formula, profile) if type(profile) in SHIPPED else _recorded(formula, profile)


def _recorded(formula: Formula, profile: Profile) -> Weights | None:
    nodes: dict[Node, int] = {}
    leaves = {name: Symbol(nodes, nodes.setdefault(Node(name), len(nodes))) for name in LEAVES}
    try:
        results = tuple((weight.node, weight.scale) for weight in formula.weigh(leaves.__getitem__, profile))
    except Exception:  # a profile of the user may raise anything where it gets symbols, and works with tensors
        return None
    return Weights(tuple(nodes), results)


_of_package = lru_cache(maxsize=256)(_recorded)
