"""Joint values as linear expressions of columns: signs, zeros, couplings, gear ratios and encoder ticks of a table.

A text such as ``-{J2}+90``, ``{J3}+{J2}`` or ``360/4096*{ticks5}-180`` is a sum of terms: a column in braces, perhaps
times numbers, or a number. Values are in the units of the table. Any other text is the name of a column.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, listed

FACTOR = r"(?:\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|pi|\{[^{}]+\})"
TERM = rf"{FACTOR}(?:\s*[*/]\s*{FACTOR})*"
EXPRESSION = re.compile(rf"\s*[+-]?\s*{TERM}(?:\s*[+-]\s*{TERM})*\s*")
SIGNED_TERM = re.compile(rf"([+-]?)\s*({TERM})")
WITH_OPERATOR = re.compile(rf"([*/]?)\s*({FACTOR})")


@dataclass(frozen=True)
class JointExpressions:
    """The n joint values of a line as ``matrix @ cells + offset``, in the units of the table.

    Args:
        texts: n names or expressions. columns: the c columns that they name, in order of their first appearance.
        matrix: (n, c). offset: (n,).
    """

    texts: tuple[str, ...]
    columns: tuple[str, ...]
    matrix: Tensor
    offset: Tensor

    @classmethod
    def of(cls, texts: Sequence[str]) -> JointExpressions:
        """Parse names and expressions.

        Raises:
            MeasurementError: a product of columns, a column below a fraction line, or a constant.
        """
        parsed = [_parsed(text) for text in texts]
        columns = tuple(dict.fromkeys(name for factors, _ in parsed for name in factors))
        rows = [[factors.get(name, 0.0) for name in columns] for factors, _ in parsed]
        matrix = torch.tensor(rows, dtype=torch.float64, device=HOST)
        offset = torch.tensor([constant for _, constant in parsed], dtype=torch.float64, device=HOST)
        return cls(tuple(texts), columns, matrix, offset)

    @property
    def plain(self) -> Tensor:
        """(n,) boolean, which joints are columns as they are."""
        return ((self.matrix == 1.0).sum(1) == 1) & ((self.matrix != 0.0).sum(1) == 1) & (self.offset == 0.0)

    def values(self, cells: Tensor) -> Tensor:
        """Cells (N, c) -> joint values (N, n)."""
        return cells @ self.matrix.mT + self.offset

    def cells(self, values: Tensor) -> Tensor:
        """The inverse of :meth:`values`; MeasurementError where the joints do not tell every column."""
        n, c = self.matrix.shape
        if n != c or int(torch.linalg.matrix_rank(self.matrix)) < n:
            what = f"the columns {listed(self.columns)} of joints {listed(self.texts)}, to be written"
            got = f"{c} columns of {n} joints" if n != c else "joints that depend on each other"
            fix = "name as many columns as there are joints, each by an expression of its own"
            raise MeasurementError.of(what, expected="columns that the joints determine", got=got, fix=fix)
        return torch.linalg.solve(self.matrix, (values - self.offset).mT).mT


def _parsed(text: str) -> tuple[dict[str, float], float]:
    """Factor of each column, and the constant."""
    if "{" not in text or not EXPRESSION.fullmatch(text):
        return {text: 1.0}, 0.0
    factors, constant = dict[str, float](), 0.0
    for sign, term in SIGNED_TERM.findall(text):
        value, names = -1.0 if sign == "-" else 1.0, list[str]()
        for operator, factor in WITH_OPERATOR.findall(term):
            if factor.startswith("{"):
                names.append(factor[1:-1].strip() if operator != "/" else "")
            else:
                number = pi if factor == "pi" else float(factor)
                value = value * number if operator != "/" else value / number if number else torch.nan
        if len(names) > 1 or "" in names or not abs(value) < torch.inf:
            fix = "write sums of terms such as -0.5*{J2}, {J3}/2 and 90"
            raise MeasurementError.of(f"'{text}'", expected="a linear expression of columns", got=f"'{term}'", fix=fix)
        if names:
            factors[names[0]] = factors.get(names[0], 0.0) + value
        else:
            constant += value
    return factors, constant
