"""Symbols that write an LLVM instruction for every operation on them, so that formulas and profiles become code.

Symbols support the operators of tensors and LazyTensors. A product with a number is free: it is kept beside the value
and applied to the sums.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from math import log
from typing import Any

from diffeo_calib.kernels.reductions.formulas import Unknown

MOST_FACTORS = 8
"""Of a power in a profile."""
EXP2 = (
    1.0,
    0.6931471805599516,
    0.24022650695910472,
    0.05550410866434658,
    0.009618129107380715,
    0.001333355824648072,
    0.00015403530800818256,
    1.525264774769592e-05,
    1.321523563477604e-06,
    1.0210506458816145e-07,
    7.111758687557852e-09,
)
"""Coefficients of 2^f for |f| <= 1/2, the best ones for the largest relative error: 3e-16."""
BIAS, FRACTION_BITS = 1023, 52
"""Of a double."""


@dataclass(frozen=True)
class Vector:
    """The type of a vector of so many doubles."""

    lanes: int

    def __str__(self) -> str:
        return f"<{self.lanes} x double>"

    @property
    def suffix(self) -> str:
        """Of the names of functions of such vectors."""
        return f"v{self.lanes}f64"


class Code:
    """A list of instructions. The same operation on the same values is written once.

    Args:
        vector: the type of most values. numbers: of names, shared by all lists of a function.
    """

    def __init__(self, vector: Vector, numbers: Iterator[int]) -> None:
        self.vector, self.numbers = vector, numbers
        self.lines: list[str] = []
        self.known: dict[str, str] = {}

    def name(self) -> str:
        """A new name."""
        return f"%v{next(self.numbers)}"

    def value(self, instruction: str) -> str:
        """Name of the result of an instruction."""
        if instruction not in self.known:
            self.known[instruction] = self.name()
            self.lines.append(f"  {self.known[instruction]} = {instruction}")
        return self.known[instruction]

    def constant(self, number: float) -> str:
        """A vector of equal numbers."""
        bits = f"double 0x{struct.pack('>d', number).hex().upper()}"
        return f"<{', '.join([bits] * self.vector.lanes)}>"

    def call(self, operation: str, a: str, b: str) -> str:
        """An operation on two vectors."""
        return self.value(f"{operation} {self.vector} {a}, {b}")

    def fused(self, a: str, b: str, c: str) -> str:
        """a b + c."""
        v = self.vector
        return self.value(f"call {v} @llvm.fmuladd.{v.suffix}({v} {a}, {v} {b}, {v} {c})")

    def bounded(self, x: str, limit: str, side: str) -> str:
        """The limit where x is below ("olt") or above ("ogt") it; NaN stays NaN."""
        v = self.vector
        beyond = self.value(f"fcmp {side} {v} {x}, {limit}")
        return self.value(f"select <{v.lanes} x i1> {beyond}, {v} {limit}, {v} {x}")

    def exp2(self, x: str, factor: float, above: bool, below: bool) -> str:
        """2^(factor x); beyond the range of powers 0 or infinity.

        Args:
            above, below: whether x may lead above, below the range of powers.
        """
        # without a fraction, an exponent of zeros is 0 and one of ones is infinite
        for cut, limit in ((above, (BIAS + 1) / factor), (below, -BIAS / factor)):
            if cut:
                x = self.bounded(x, self.constant(limit), "ogt" if limit > 0 else "olt")
        v, c = self.vector, self.constant(factor)
        # adding it rounds to integers, in the last bits of the sum: those of an exponent
        shift = self.constant(1.5 * 2.0**FRACTION_BITS + BIAS)
        moved = self.fused(x, c, shift)
        f = self.fused(x, c, self.value(f"fneg {v} {self.call('fsub', moved, shift)}"))
        p, *rest = (self.constant(c) for c in reversed(EXP2))
        for c in rest:
            p = self.fused(p, f, c)
        whole = f"<{v.lanes} x i64>"
        power = self.value(f"bitcast {v} {moved} to {whole}")
        places = f"<{', '.join([f'i64 {FRACTION_BITS}'] * v.lanes)}>"
        power = self.value(f"bitcast {whole} {self.value(f'shl {whole} {power}, {places}')} to {v}")
        return self.call("fmul", p, power)  # a product, so that NaN stays NaN whatever its bits


class Symbol(Unknown):
    """scale * value, or the number ``scale`` itself where there is no value.

    Args:
        code: where operations are written. positive: whether the value is known not to be negative.
    """

    __slots__ = ("code", "positive", "scale", "value")

    def __init__(self, code: Code, value: str | None, scale: float = 1.0, positive: bool = False) -> None:
        self.code, self.value, self.scale, self.positive = code, value, scale, positive

    def __mul__(self, other: Any) -> Symbol:
        if not isinstance(other, Symbol):
            number = float(other)
            return Symbol(self.code, self.value if number else None, self.scale * number, self.positive)
        if self.value is None or other.value is None:
            one = self if other.value is None else other
            return one * (other if one is self else self).scale
        product = self.code.call("fmul", self.value, other.value)
        positive = (self.positive and other.positive) or self.value == other.value
        return Symbol(self.code, product, self.scale * other.scale, positive)

    def __add__(self, other: Any) -> Symbol:
        if not isinstance(other, Symbol):
            other = Symbol(self.code, None, float(other))
        if self.value is None and other.value is None:
            return Symbol(self.code, None, self.scale + other.scale)
        if self.value is None or self.scale == 0.0:
            return other + self.scale if self.scale else other
        ratio = other.scale / self.scale
        positive = self.positive and (other.positive or other.value is None) and ratio >= 0.0
        ratio_ = self.code.constant(ratio)
        if other.value is None:
            total = self.value if ratio == 0.0 else self.code.call("fadd", self.value, ratio_)
        elif abs(ratio) == 1.0:
            total = self.code.call("fadd" if ratio > 0.0 else "fsub", self.value, other.value)
        else:
            total = self.code.fused(other.value, ratio_, self.value)
        return Symbol(self.code, total, self.scale, positive)

    def __neg__(self) -> Symbol:
        return self * -1.0

    def __sub__(self, other: Any) -> Symbol:
        return self + -other

    def __rsub__(self, other: Any) -> Symbol:
        return -self + other

    def __truediv__(self, other: Any) -> Symbol:
        if not isinstance(other, Symbol):
            return self * (1.0 / float(other))
        if other.value is None:
            return self * (1.0 / other.scale)
        above = self.value or self.code.constant(1.0)
        ratio = self.code.call("fdiv", above, other.value)
        positive = other.positive and (self.positive or self.value is None)
        return Symbol(self.code, ratio, self.scale / other.scale, positive)

    def __rtruediv__(self, other: Any) -> Symbol:
        return Symbol(self.code, None, float(other)) / self

    def __pow__(self, power: Any) -> Symbol:
        whole = int(power)
        if whole != power or not 0 < abs(whole) <= MOST_FACTORS:
            raise TypeError(f"a power of a profile: expected a whole number up to {MOST_FACTORS}, got {power}")
        found = self
        for _ in range(abs(whole) - 1):
            found = found * self
        return found if whole > 0 else 1.0 / found

    __rmul__, __radd__ = __mul__, __add__

    def exp(self) -> Symbol:
        """Elementwise."""
        factor = self.scale / log(2.0)
        if self.value is None or factor == 0.0:
            return Symbol(self.code, None, 2.0**factor)
        above, below = not self.positive or factor > 0.0, not self.positive or factor < 0.0
        return Symbol(self.code, self.code.exp2(self.value, factor, above, below), 1.0, True)

    def sqrt(self) -> Symbol:
        """Elementwise."""
        if self.value is None:
            return Symbol(self.code, None, self.scale**0.5)
        v = self.code.vector
        root = self.code.value(f"call {v} @llvm.sqrt.{v.suffix}({v} {self.plain})")
        return Symbol(self.code, root, 1.0, True)

    def relu(self) -> Symbol:
        """max(x, 0), elementwise."""
        if self.positive and self.scale >= 0.0:
            return self
        return Symbol(self.code, self.code.bounded(self.plain, self.code.constant(0.0), "olt"), 1.0, True)

    def square(self) -> Symbol:
        """Elementwise."""
        return self * self

    @property
    def plain(self) -> str:
        """The value with its scale."""
        if self.value is None:
            return self.code.constant(self.scale)
        return self.value if self.scale == 1.0 else self.code.call("fmul", self.value, self.code.constant(self.scale))
