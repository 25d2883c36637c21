"""The loops of fused kernel sums, as LLVM code.

A block of a few rows meets one vector of columns at a time: pairwise scalars, the sums of the rows and the shares of
the columns stay in registers. Where rows and columns are the same points, every pair is visited once and adds to both.
The instructions of the rows of a block take turns, since each row is one long chain of dependent ones.

Points lie coordinate by coordinate, inputs and sums in lines of one length: ``%m`` for rows, ``%n`` or ``%s`` for
columns. Their number is a multiple of :attr:`Program.group`; missing points have zero momenta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from typing import NamedTuple

from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, Points, Term
from diffeo_calib.kernels.reductions.fused.symbols import Code, Symbol, Vector

ROWS = ((4, 8), (12, 4), (32, 2))
"""Sums of a row, and the number of rows of a block up to it; beyond it one row. Measured with 16 and 32 registers."""
Factors = tuple[str, str]
"""Names of two values that are multiplied."""
LOOPS = {"symmetric": 7, "rectangular": 9}
"""Functions of a program, and the number of their arguments."""


@dataclass(frozen=True)
class Program:
    """A kernel sum of points with some numbers of features and outputs.

    Args:
        inputs: names of the fields of :class:`Points` that are read, and the number of their coordinates.
        vector: the type of pairwise scalars.
    """

    formula: Formula
    profile: Profile
    inputs: tuple[tuple[str, int], ...]
    vector: Vector

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
        """Of a block."""
        return next((rows for outputs, rows in ROWS if self.count <= outputs), 1)

    @cached_property
    def group(self) -> int:
        """Points that are processed together; their number is a multiple of it."""
        return max(self.vector.lanes, self.rows)

    def code(self) -> tuple[str, list[float]]:
        """The module, and the factors of the results, 0 for those that vanish.

        Raises:
            TypeError, AttributeError: the profile uses other operations than those of :class:`Symbol`.
        """
        plain, mirrored = _Block(self, mirrored=False), _Block(self, mirrored=True)
        declared = DECLARATIONS.format(v=self.vector, suffix=self.vector.suffix)
        drivers = DRIVERS.format(rows=self.rows, group=self.group)
        text = "\n".join([declared, plain.text("plain"), mirrored.text("mirrored"), drivers])
        return text, [result.factor for result in plain.results]


class SymbolicPairs:
    """Pairwise scalars of a row and a vector of columns, as symbols."""

    def __init__(self, code: Code) -> None:
        self.code = code

    def joined(self, a: list[str], b: list[str]) -> list[str]:
        """Vectors one after the other."""
        return a + b

    def apart(self, e: list[str], f: list[str]) -> list[str]:
        """e_i - f_j."""
        return [self.code.call("fsub", a, b) for a, b in zip(e, f, strict=True)]

    def dot(self, a: list[str], b: list[str]) -> Symbol:
        """a_i . b_j."""
        total = self.code.call("fmul", a[0], b[0])
        for one, other in zip(a[1:], b[1:], strict=True):
            total = self.code.fused(one, other, total)
        return Symbol(self.code, total, positive=a is b)

    def squared_distance(self, e: list[str], f: list[str]) -> Symbol:
        """|e_i - f_j|^2."""
        apart = self.apart(e, f)
        return self.dot(apart, apart)

    def squared_distance_change(self, e: list[str], de: list[str], f: list[str], df: list[str]) -> Symbol:
        """2 (e_i - f_j) . (de_i - df_j)."""
        return self.dot(self.apart(e, f), self.apart(de, df)) * 2.0


class _Result(NamedTuple):
    """A result of the formula: the sums at some places, to be multiplied by a factor, of terms that do not vanish.

    Args:
        odd: whether row and column have shares of opposite signs.
    """

    places: range
    factor: float
    terms: list[Term]
    odd: bool


class _Place(NamedTuple):
    """Names of an array, the length of its lines, and a point."""

    array: str
    length: str
    point: str


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
        weights = [
            program.formula.weights(SymbolicPairs(code), program.profile, i, columns)
            for code, i in zip(codes, points, strict=True)
        ]
        self.loop.lines += [line for lines in zip(*[code.lines for code in codes], strict=True) for line in lines]
        self.results = self._results(weights[0])
        self.starts = [[f"%s{r}_{k}" for k in range(program.count)] for r in rows]
        self.sums = [list(names) for names in self.starts]
        self.shares = [self.loop.constant(0.0)] * len(self.sums[0])
        for code in codes:
            code.lines = self.loop.lines
        for result in self.results:
            for term in result.terms:
                for r in rows:
                    weight = weights[r][term.weight] * (term.factor / result.factor)
                    products = self._products(term, weight, points[r], columns)
                    for k, (ours, theirs) in zip(result.places, products, strict=True):
                        self.sums[r][k] = codes[r].fused(*ours, self.sums[r][k])
                        if mirrored:
                            self.shares[k] = codes[r].fused(*theirs, self.shares[k])

    def text(self, name: str) -> str:
        """The function."""
        for result in self.results if self.mirrored else []:
            self._store_shares(result)
        for r, sums in enumerate(self.sums):
            self._store_sums(r, sums)
        zero, starts = (
            self.loop.constant(0.0),
            [(r, k) for r, names in enumerate(self.starts) for k in range(len(names))],
        )
        phis = [
            f"  {self.starts[r][k]} = phi {self.vector} [ {zero}, %entry ], [ {self.sums[r][k]}, %loop ]"
            for r, k in starts
        ]
        return BLOCK.format(
            name=name,
            indices="\n".join(f"  %i{r} = add i64 %i, {r}" for r in range(self.program.rows)),
            head="\n".join(self.head.lines),
            loop="\n".join([*phis, *self.loop.lines]),
            lanes=self.vector.lanes,
            tail="\n".join(self.tail.lines),
        )

    def _results(self, weights: list[Symbol]) -> list[_Result]:
        found, place = [], 0
        for terms, size in zip(self.program.formula.results, self.program.outputs, strict=True):
            present = [t for t in terms if weights[t.weight].scale != 0.0]
            factor = weights[present[0].weight].scale * present[0].factor if present else 0.0
            found.append(_Result(range(place, place + size), factor, present, terms[0].apart is not None))
            place += size
        return found

    def _points(self, load: Callable[[int], str]) -> Points:
        """Points whose inputs are loaded one by one."""
        found, place = {}, 0
        for name, size in self.program.inputs:
            found[name] = [load(place + k) for k in range(size)]
            place += size
        return Points(**found)

    def _address(self, code: Code, k: int, place: _Place) -> str:
        """Of the number at a point in the k-th line of an array."""
        number = code.value(f"add i64 {code.value(f'mul i64 {place.length}, {k}')}, {place.point}")
        return code.value(f"getelementptr double, ptr {place.array}, i64 {number}")

    def _spread(self, k: int, at: str) -> str:
        """An input of a row, in all lanes."""
        code, v = self.head, self.vector
        number = code.value(f"load double, ptr {self._address(code, k, _Place('%rows', '%m', at))}")
        first = code.value(f"insertelement {v} poison, double {number}, i32 0")
        return code.value(f"shufflevector {v} {first}, {v} poison, <{v.lanes} x i32> zeroinitializer")

    def _column(self, k: int) -> str:
        """An input of the columns."""
        address = self._address(self.loop, k, _Place("%columns", "%n", "%j"))
        return self.loop.value(f"load {self.vector}, ptr {address}, align 8")

    def _products(self, term: Term, weight: Symbol, i: Points, j: Points) -> list[tuple[Factors, Factors]]:
        """Factors of what a term adds to each sum of a row, and to the column's, but for the sign of differences."""
        code, w = weight.code, weight.plain
        ours, theirs = [w], [w]
        if term.vector is not None:
            ours, theirs = getattr(j, term.vector), getattr(i, term.vector)
            if term.apart is None:
                return [((w, b), (w, c)) for b, c in zip(ours, theirs, strict=True)]
            ours = [code.call("fmul", w, b) for b in ours]
            theirs = [code.call("fmul", w, c) for c in theirs] if self.mirrored else ours
        apart = SymbolicPairs(code).apart(getattr(i, term.apart or ""), getattr(j, term.apart or ""))
        return [((a, d), (b, d)) for a, b in zip(ours, theirs, strict=True) for d in apart]

    def _store_shares(self, result: _Result) -> None:
        for k in result.places if result.terms else ():
            address = self._address(self.loop, k, _Place("%out", "%n", "%j"))
            self._accumulate(self.loop, self.vector, address, self.shares[k], "fsub" if result.odd else "fadd")

    def _store_sums(self, r: int, sums: list[str]) -> None:
        code, v = self.tail, self.vector
        for k in [k for result in self.results if result.terms for k in result.places]:
            total = code.value(f"call reassoc double @llvm.vector.reduce.fadd.{v.suffix}(double 0.0, {v} {sums[k]})")
            address = self._address(code, k, _Place("%out", "%m", f"%i{r}"))
            self._accumulate(code, "double", address, total, "fadd")

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
DRIVERS = """
define void @symmetric(ptr %points, i64 %n, i64 %s, ptr %out, ptr %tiles, i64 %count, i64 %side) #0 {{
entry:
  br label %tile
tile:
  %t = phi i64 [ 0, %entry ], [ %t1, %tile.next ]
  %place = getelementptr i64, ptr %tiles, i64 %t
  %number = load i64, ptr %place
  %a0 = mul i64 %number, %side
  %a1.far = add i64 %a0, %side
  %a1 = call i64 @llvm.smin.i64(i64 %a1.far, i64 %n)
  br label %column
column:
  %b0 = phi i64 [ %a0, %tile ], [ %b1.far, %column.next ]
  %b1.far = add i64 %b0, %side
  %b1 = call i64 @llvm.smin.i64(i64 %b1.far, i64 %n)
  %own = icmp eq i64 %a0, %b0
  br label %row
row:
  %i = phi i64 [ %a0, %column ], [ %i1, %row.next ]
  %i1 = add i64 %i, {rows}
  br i1 %own, label %diagonal, label %row.next
diagonal:
  %g0 = and i64 %i, -{group}
  %g1 = add i64 %g0, {group}
  call void @plain(ptr %points, i64 %s, ptr %points, i64 %s, ptr %out, i64 %i, i64 %g0, i64 %g1)
  br label %row.next
row.next:
  %low = phi i64 [ %b0, %row ], [ %g1, %diagonal ]
  call void @mirrored(ptr %points, i64 %s, ptr %points, i64 %s, ptr %out, i64 %i, i64 %low, i64 %b1)
  %row.more = icmp slt i64 %i1, %a1
  br i1 %row.more, label %row, label %column.next
column.next:
  %column.more = icmp slt i64 %b1.far, %n
  br i1 %column.more, label %column, label %tile.next
tile.next:
  %t1 = add i64 %t, 1
  %tile.more = icmp slt i64 %t1, %count
  br i1 %tile.more, label %tile, label %end
end:
  ret void
}}

define void @rectangular(
  ptr %rows, i64 %m, ptr %columns, i64 %n, i64 %s, ptr %out, i64 %first, i64 %last, i64 %side
) #0 {{
entry:
  br label %column
column:
  %b0 = phi i64 [ 0, %entry ], [ %b1.far, %column.next ]
  %b1.far = add i64 %b0, %side
  %b1 = call i64 @llvm.smin.i64(i64 %b1.far, i64 %n)
  br label %row
row:
  %i = phi i64 [ %first, %column ], [ %i1, %row ]
  call void @plain(ptr %rows, i64 %m, ptr %columns, i64 %s, ptr %out, i64 %i, i64 %b0, i64 %b1)
  %i1 = add i64 %i, {rows}
  %row.more = icmp slt i64 %i1, %last
  br i1 %row.more, label %row, label %column.next
column.next:
  %column.more = icmp slt i64 %b1.far, %n
  br i1 %column.more, label %column, label %end
end:
  ret void
}}
"""
"""Tiles of a part of the sums: of a triangle, where the points of a diagonal group meet all of their group; of rows."""
