"""Linearised rows as one list of numbers: which are there, where they stand in the table, and what they depend on."""

from __future__ import annotations

import pytest
import torch
from process_bank import Case
from tangent_bank import normal
from torch import Tensor

from diffeo_calib.process.numbers import Numbers


def table(shown: Tensor, seed: int = 0) -> Numbers:
    """Rows of two points, whose coordinates are the numbers, with three joints and four unknowns."""
    N, R = shown.shape
    q, points, target = normal(N, 3, seed=seed), normal(N, R, seed=seed + 1), normal(N, R, seed=seed + 2)
    S, J = normal(N, R, 4, seed=seed + 3), normal(N, R, 3, seed=seed + 4)
    A = torch.eye(R, dtype=torch.float64).expand(N, R, R)
    return Numbers.of(q, points, shown, target=target, S=S, J=J, A=A)


PATTERNS = ("111111", "111000", "000111", "000000", "111111", "010001")
SHOWN = torch.tensor([[number == "1" for number in pattern] for pattern in PATTERNS])


def test_numbers_are_those_that_were_measured(case: Case) -> None:
    told, numbers = case.data.told, case.numbers
    R = told.y.shape[1]
    assert numbers.shape == told.y.shape
    assert sorted(numbers.cells.tolist()) == told.visible.flatten().nonzero()[:, 0].tolist()
    row, column = numbers.cells // R, numbers.cells % R
    assert torch.equal(numbers.owner, row)
    assert torch.equal(numbers.target, told.target[row, column])
    assert torch.equal(numbers.S, case.unknowns[numbers.cells])
    assert torch.equal(numbers.J, told.jacobian[row, column])
    assert torch.equal(numbers.q[numbers.row], told.x[row])


def test_points_that_tell_nothing_are_not_there() -> None:
    """Those of hidden markers; a row without any number is not there either."""
    numbers = table(SHOWN)
    points = normal(6, 6, seed=1).view(-1, 3)
    expected = {tuple(point) for point in points[[0, 1, 2, 5, 8, 9, 10, 11]].tolist()}
    assert {tuple(point) for point in numbers.z.tolist()} == expected
    assert len(numbers.z) == len(expected)
    assert len(numbers.q) == 5
    assert len(numbers.target) == int(SHOWN.sum())


def test_a_point_that_any_row_depends_on_is_there() -> None:
    """A height along x in one row and along z in the next."""
    A = torch.zeros(2, 1, 6, dtype=torch.float64)
    A[0, 0, 3] = A[1, 0, 5] = 1.0
    points, one = normal(2, 6, seed=1), normal(2, 1, 4, seed=2)
    numbers = Numbers.of(one[..., 0], points, torch.ones(2, 1).bool(), target=one[..., 0], S=one, J=one, A=A)
    assert torch.equal(numbers.z, points[:, 3:])
    assert torch.equal(numbers.parts[0].A[:, 0, 0], torch.eye(3, dtype=torch.float64)[[0, 2]])


@pytest.mark.parametrize("cut", [1, 3])
def test_joined_numbers_are_those_of_the_joined_table(cut: int) -> None:
    N = len(SHOWN)
    q, points, target = normal(N, 3, seed=0), normal(N, 6, seed=1), normal(N, 6, seed=2)
    S, J, A = normal(N, 6, 4, seed=3), normal(N, 6, 3, seed=4), normal(N, 6, 6, seed=5)

    def of(rows: slice) -> Numbers:
        return Numbers.of(q[rows], points[rows], SHOWN[rows], target=target[rows], S=S[rows], J=J[rows], A=A[rows])

    together, apart = of(slice(0, N)), of(slice(0, cut)).joined(of(slice(cut, N)))
    assert apart.shape == together.shape
    for numbers in (together, apart):
        assert torch.equal(numbers.in_table(numbers.target), torch.where(SHOWN, target, 0.0))
        assert torch.equal(numbers.S, S.flatten(0, 1)[numbers.cells])
        assert torch.equal(numbers.q[numbers.row], q[numbers.owner])
