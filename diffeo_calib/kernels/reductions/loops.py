"""The loops of fused kernel sums, as LLVM code.

A block of a few rows meets one vector of columns at a time: pairwise scalars, the sums of the rows and the shares of
the columns stay in registers. Where rows and columns are the same points, every pair is visited once and adds to both.
The instructions of the rows of a block take turns, since each row is one long chain of dependent ones.

Points lie coordinate by coordinate, inputs and sums in lines of one length: ``%m`` for rows, ``%n`` or ``%s`` for
columns. Their number is a multiple of :attr:`Program.group`; missing points have zero momenta.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from math import log
from typing import NamedTuple

from diffeo_calib.kernels.reductions.formulas import LEAVES, Formula, Points, Term
from diffeo_calib.kernels.reductions.symbols import Weights

ROWS = ((4, 8), (12, 4), (32, 2))
"""Sums of a row, and the number of rows of a block up to it; beyond it one row. Measured with 16 and 32 registers."""
ARGUMENTS = 11  # of the function of a program
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
BIAS, FRACTION_BITS = 1023, 52  # of a double


@dataclass(frozen=True)
class Vector:
    """The type of a vector of so many doubles."""

    lanes: int

    def __str__(self) -> str:
        return f"<{self.lanes} x double>"

    @property
    def suffix(self) -> str:
        """Suffix of the names of functions of such vectors."""
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

    def root(self, x: str) -> str:
        """The square root."""
        v = self.vector
        return self.value(f"call {v} @llvm.sqrt.{v.suffix}({v} {x})")

    def bounded(self, x: str, limit: str, side: str) -> str:
        """The limit where x is below ("olt") or above ("ogt") it; NaN stays NaN."""
        v = self.vector
        beyond = self.value(f"fcmp {side} {v} {x}, {limit}")
        return self.value(f"select <{v.lanes} x i1> {beyond}, {v} {limit}, {v} {x}")

    def exp(self, x: str, number: float, positive: bool) -> str:
        """exp(number x); beyond the range of powers of two 0 or infinity; whether x is known not to be negative."""
        factor = number / log(2.0)
        above, below = not positive or factor > 0.0, not positive or factor < 0.0
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


@dataclass(frozen=True)
class Program:
    """A kernel sum of points with some numbers of features and outputs."""

    formula: Formula
    weights: Weights
    # names of the fields of :class:`Points` that are read, and the number of their coordinates
    inputs: tuple[tuple[str, int], ...]
    vector: Vector  # the type of pairwise scalars

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Coordinates of every field."""
        return dict(self.inputs)

    @cached_property
    def outputs(self) -> list[int]:
        """Numbers in every result."""
        sizes = {None: 1, **self.sizes}
        return [sizes[terms[0].vector] * sizes[terms[0].apart] for terms in self.formula.results]

    @cached_property
    def count(self) -> int:
        """Sums of a row."""
        return sum(self.outputs)

    @cached_property
    def rows(self) -> int:
        """Rows of a block."""
        return next((rows for outputs, rows in ROWS if self.count <= outputs), 1)

    @cached_property
    def group(self) -> int:
        """Points that are processed together; their number is a multiple of it."""
        return max(self.vector.lanes, self.rows)

    def code(self) -> tuple[str, list[float]]:
        """The module, and the factors of the results, 0 for those that vanish."""
        plain, mirrored = _Block(self, mirrored=False), _Block(self, mirrored=True)
        declared = DECLARATIONS.format(v=self.vector, suffix=self.vector.suffix)
        driver = DRIVER.format(rows=self.rows, group=self.group)
        text = "\n".join([declared, plain.text("plain"), mirrored.text("mirrored"), driver])
        return text, [result.factor for result in plain.results]


OPERATIONS: dict[str, Callable[..., str]] = {
    "product": lambda code, a, b, _: code.call("fmul", a, b),
    "ratio": lambda code, a, b, _: code.call("fdiv", a, b),
    "sum": lambda code, a, b, c: code.fused(b, code.constant(c), a),
    "shift": lambda code, a, c: code.call("fadd", a, code.constant(c)),
    "scale": lambda code, a, c: code.call("fmul", a, code.constant(c)),
    "inverse": lambda code, a, _: code.call("fdiv", code.constant(1.0), a),
    "sqrt": lambda code, a, _: code.root(a),
    "relu": lambda code, a, _: code.bounded(a, code.constant(0.0), "olt"),
}
"""Operations of :class:`Node` as instructions, but for the exponential."""


class _Lowering:
    """Weights of a row and a vector of columns, as instructions.

    Args:
        code: where they are written. i, j: names of the points' coordinates.
    """

    def __init__(self, code: Code, weights: Weights, i: Points, j: Points) -> None:
        self.code, self.i, self.j = code, i, j
        nodes: dict[int, str] = {}
        for k, (name, operands, number) in weights.steps():
            values = [nodes[o] for o in operands]
            if name in LEAVES:
                nodes[k] = self._leaf(name)
            elif name == "exp":
                nodes[k] = code.exp(*values, number, weights.positive[operands[0]])
            elif name == "relu" and weights.nodes[operands[0]].name == "r2":
                nodes[k] = values[0]  # a sum of squares here
            else:
                nodes[k] = OPERATIONS[name](code, *values, number)
        self.results = [(None if node is None else nodes[node], scale) for node, scale in weights.results]

    def weight(self, number: int, factor: float) -> str:
        """A weight times a number."""
        value, scale = self.results[number]
        constant = self.code.constant(scale * factor)
        if value is None:
            return constant
        return value if scale * factor == 1.0 else self.code.call("fmul", value, constant)

    def apart(self, field: str) -> list[str]:
        """e_i - f_j of a field."""
        pairs = zip(getattr(self.i, field), getattr(self.j, field), strict=True)
        return [self.code.call("fsub", a, b) for a, b in pairs]

    def _leaf(self, name: str) -> str:
        i, j = self.i, self.j
        if name == "s":
            return self._dot(i.momenta, j.momenta)
        if name == "ds":
            return self._dot([*i.d_momenta, *i.momenta], [*j.momenta, *j.d_momenta])
        apart = self.apart("features")
        if name == "r2":
            return self._dot(apart, apart)
        return self.code.call("fmul", self._dot(apart, self.apart("d_features")), self.code.constant(2.0))

    def _dot(self, a: list[str], b: list[str]) -> str:
        total = self.code.call("fmul", a[0], b[0])
        for left, other in zip(a[1:], b[1:], strict=True):
            total = self.code.fused(left, other, total)
        return total


class _Result(NamedTuple):
    """A result of the formula: the sums at some places, to be multiplied by a factor, of terms that do not vanish.

    Args:
        odd: whether row and column have shares of opposite signs.
    """

    places: range
    factor: float
    terms: list[Term]
    odd: bool


class _Block:
    """Writes the function of one block of rows and a range of columns.

    Args:
        mirrored: whether columns get their share too.
    """

    def __init__(self, program: Program, mirrored: bool) -> None:
        self.program, self.mirrored, self.vector = program, mirrored, program.vector
        numbers, rows = count(), range(program.rows)
        self.head, self.loop, self.tail = (Code(self.vector, numbers) for _ in range(3))
        points = [self._points(lambda k, r=r: self._spread(k, f"%i{r}")) for r in rows]
        columns = self._points(self._column)
        codes = [Code(self.vector, numbers) for _ in rows]
        lowered = [_Lowering(code, program.weights, i, columns) for code, i in zip(codes, points, strict=True)]
        self.loop.lines += [line for lines in zip(*[code.lines for code in codes], strict=True) for line in lines]
        self.results = self._results()
        self.starts = [[f"%s{r}_{k}" for k in range(program.count)] for r in rows]
        self.sums = [list(names) for names in self.starts]
        self.shares = [self.loop.constant(0.0)] * len(self.sums[0])
        for code in codes:
            code.lines = self.loop.lines
        for result in self.results:
            for term in result.terms:
                for r in rows:
                    products = self._products(term, lowered[r], term.factor / result.factor)
                    for k, (ours, theirs) in zip(result.places, products, strict=True):
                        self.sums[r][k] = codes[r].fused(*ours, self.sums[r][k])
                        if mirrored:
                            self.shares[k] = codes[r].fused(*theirs, self.shares[k])

    def text(self, name: str) -> str:
        """The function."""
        for result in self.results:
            for k in result.places if self.mirrored and result.terms else ():
                address = self._address(self.loop, k, "%out", "%n", "%j")
                self._accumulate(self.loop, self.vector, address, self.shares[k], "fsub" if result.odd else "fadd")
        code, v = self.tail, self.vector
        for r, sums in enumerate(self.sums):
            for k in [k for result in self.results if result.terms for k in result.places]:
                add = f"@llvm.vector.reduce.fadd.{v.suffix}"
                total = code.value(f"call reassoc double {add}(double 0.0, {v} {sums[k]})")
                self._accumulate(code, "double", self._address(code, k, "%out", "%m", f"%i{r}"), total, "fadd")
        zero = self.loop.constant(0.0)
        phis = [
            f"  {start} = phi {self.vector} [ {zero}, %entry ], [ {total}, %loop ]"
            for starts, totals in zip(self.starts, self.sums, strict=True)
            for start, total in zip(starts, totals, strict=True)
        ]
        return BLOCK.format(
            name=name,
            indices="\n".join(f"  %i{r} = add i64 %i, {r}" for r in range(self.program.rows)),
            head="\n".join(self.head.lines),
            loop="\n".join([*phis, *self.loop.lines]),
            lanes=self.vector.lanes,
            tail="\n".join(self.tail.lines),
        )

    def _results(self) -> list[_Result]:
        results, place, scales = [], 0, [scale for _, scale in self.program.weights.results]
        for terms, size in zip(self.program.formula.results, self.program.outputs, strict=True):
            present = [t for t in terms if scales[t.weight] != 0.0]
            factor = scales[present[0].weight] * present[0].factor if present else 0.0
            results.append(_Result(range(place, place + size), factor, present, terms[0].apart is not None))
            place += size
        return results

    def _points(self, load: Callable[[int], str]) -> Points:
        """Points whose inputs are loaded one by one."""
        points, place = {}, 0
        for name, size in self.program.inputs:
            points[name] = [load(place + k) for k in range(size)]
            place += size
        return Points(**points)

    def _address(self, code: Code, k: int, array: str, length: str, point: str) -> str:
        """Address of the number at a point in the k-th line of an array whose lines have a length."""
        number = code.value(f"add i64 {code.value(f'mul i64 {length}, {k}')}, {point}")
        return code.value(f"getelementptr double, ptr {array}, i64 {number}")

    def _spread(self, k: int, at: str) -> str:
        """An input of a row, in all lanes."""
        code, v = self.head, self.vector
        number = code.value(f"load double, ptr {self._address(code, k, '%rows', '%m', at)}")
        first = code.value(f"insertelement {v} poison, double {number}, i32 0")
        return code.value(f"shufflevector {v} {first}, {v} poison, <{v.lanes} x i32> zeroinitializer")

    def _column(self, k: int) -> str:
        """An input of the columns."""
        address = self._address(self.loop, k, "%columns", "%n", "%j")
        return self.loop.value(f"load {self.vector}, ptr {address}, align 8")

    def _products(self, term: Term, at: _Lowering, factor: float) -> list[tuple[tuple[str, str], tuple[str, str]]]:
        """Factors of what a term adds to each sum of a row, and to the column's, but for the sign of differences."""
        code, w = at.code, at.weight(term.weight, factor)
        ours, theirs = [w], [w]
        if term.vector is not None:
            ours, theirs = getattr(at.j, term.vector), getattr(at.i, term.vector)
            if term.apart is None:
                return [((w, b), (w, c)) for b, c in zip(ours, theirs, strict=True)]
            ours = [code.call("fmul", w, b) for b in ours]
            theirs = [code.call("fmul", w, c) for c in theirs] if self.mirrored else ours
        apart = at.apart(term.apart or "")
        return [((a, d), (b, d)) for a, b in zip(ours, theirs, strict=True) for d in apart]

    def _accumulate(self, code: Code, kind: object, address: str, number: str, operation: str) -> None:
        old, new = code.name(), code.name()
        code.lines += [
            f"  {old} = load {kind}, ptr {address}, align 8",
            f"  {new} = {operation} {kind} {old}, {number}",
            f"  store {kind} {new}, ptr {address}, align 8",
        ]


DECLARATIONS = """
declare {v} @llvm.fmuladd.{suffix}({v}, {v}, {v})
declare {v} @llvm.sqrt.{suffix}({v})
declare double @llvm.vector.reduce.fadd.{suffix}(double, {v})
declare i64 @llvm.smin.i64(i64, i64)
attributes #0 = {{ nounwind "min-legal-vector-width"="512" "prefer-vector-width"="512" "no-stack-arg-probe" }}
"""
"""Attributes: vectors as wide as the registers, whatever the processor's default; large frames without a probe, which
is a function of the C library on Windows."""
BLOCK = """
define internal void @{name}(ptr %rows, i64 %m, ptr %columns, i64 %n, ptr %out, i64 %i, i64 %low, i64 %high) #0 {{
entry:
{indices}
{head}
  %some = icmp slt i64 %low, %high
  br i1 %some, label %loop, label %end
loop:
  %j = phi i64 [ %low, %entry ], [ %next, %loop ]
{loop}
  %next = add i64 %j, {lanes}
  %more = icmp slt i64 %next, %high
  br i1 %more, label %loop, label %done
done:
{tail}
  br label %end
end:
  ret void
}}
"""
DRIVER = """
define void @sums(ptr %rows, i64 %m, ptr %columns, i64 %n, i64 %s, ptr %out, i64 %first, i64 %last, i64 %height,
                  i64 %side, i64 %mirrored) #0 {{
entry:
  %triangle = icmp ne i64 %mirrored, 0
  br label %tile
tile:
  %a0 = phi i64 [ %first, %entry ], [ %a1.far, %tile.next ]
  %a1.far = add i64 %a0, %height
  %a1 = call i64 @llvm.smin.i64(i64 %a1.far, i64 %last)
  %start = select i1 %triangle, i64 %a0, i64 0
  br label %column
column:
  %b0 = phi i64 [ %start, %tile ], [ %b1.far, %column.next ]
  %b1.far = add i64 %b0, %side
  %b1 = call i64 @llvm.smin.i64(i64 %b1.far, i64 %n)
  %own = icmp eq i64 %b0, %a0
  br label %row
row:
  %i = phi i64 [ %a0, %column ], [ %i1, %row.next ]
  %i1 = add i64 %i, {rows}
  br i1 %triangle, label %half, label %all
all:
  call void @plain(ptr %rows, i64 %m, ptr %columns, i64 %s, ptr %out, i64 %i, i64 %b0, i64 %b1)
  br label %row.next
half:
  br i1 %own, label %diagonal, label %mirror
diagonal:
  %g0 = and i64 %i, -{group}
  %g1 = add i64 %g0, {group}
  call void @plain(ptr %rows, i64 %m, ptr %columns, i64 %s, ptr %out, i64 %i, i64 %g0, i64 %g1)
  br label %mirror
mirror:
  %low = phi i64 [ %b0, %half ], [ %g1, %diagonal ]
  call void @mirrored(ptr %rows, i64 %m, ptr %columns, i64 %s, ptr %out, i64 %i, i64 %low, i64 %b1)
  br label %row.next
row.next:
  %row.more = icmp slt i64 %i1, %a1
  br i1 %row.more, label %row, label %column.next
column.next:
  %column.more = icmp slt i64 %b1.far, %n
  br i1 %column.more, label %column, label %tile.next
tile.next:
  %tile.more = icmp slt i64 %a1.far, %last
  br i1 %tile.more, label %tile, label %end
end:
  ret void
}}
"""
"""Rows ``first`` to ``last`` with all columns; or rows of tiles of a triangle, from the diagonal on, where points of a
diagonal group meet all of their group, and later points count both ways."""
