"""Rows of several kinds as one observation, and noise with shifts that rows share, against the explicit matrix."""

from dataclasses import replace

import pytest
import torch
from fit_bank import random_start, shared_noise
from math_bank import normal, two_marker_problem, uniform
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.maps import linearisation
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise, measured_coordinates, without_hidden
from diffeo_calib.maps.nominal import SmoothMap
from diffeo_calib.maps.observation import LinearFunctionals, Part, ReadPoints, Stacked
from diffeo_calib.sensors.range import FixedPoints

PROBLEM = two_marker_problem(uniform(9, 2, seed=1))
DEFORMED = PROBLEM.deform(random_start(PROBLEM), dc.RK4(2))


@pytest.mark.parametrize("rows", [1, 4])
def test_covariance_with_itself_is_that_with_an_equal_one(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """By blocks below the diagonal and their transposes, the last one smaller."""
    at = DEFORMED.linearise()
    expected = at.gram(replace(at))
    monkeypatch.setattr(linearisation, "GRAM_ROWS", rows)
    assert_close(at.gram(), expected, rtol=0, atol=1e-14 * float(expected.abs().max()))
    assert_close(at.gram(), at.gram().T, rtol=0, atol=1e-14 * float(expected.abs().max()))


def test_values_at_the_controls_are_those_of_the_fit() -> None:
    """As a copy, for the very same configurations only, and not around another map there or elsewhere."""
    x = DEFORMED.x.clone()
    DEFORMED.at_controls(x).add_(1.0)  # pyright: ignore[reportOptionalMemberAccess]
    assert_close(DEFORMED.at_controls(x), DEFORMED(x), rtol=0, atol=1e-13)
    shifted = SmoothMap(lambda at: PROBLEM.spec.nominal(at, at.new_zeros(0)) + 1.0)
    own = GeodesicDeformation(replace(DEFORMED.spec, at_controls=shifted), x, DEFORMED.momenta, dc.RK4(2))
    for other, at in (
        (DEFORMED, x.flip(0)),
        (DEFORMED, x[:-1]),
        (DEFORMED.with_nominal(shifted), x),  # another tool
        (own, x),  # markers of their own at every row of the fit
    ):
        assert other.at_controls(at) is None


N, M, R = 7, 6, 3
Z = normal(N, M, seed=1)
LENGTHS, HEIGHTS = torch.tensor([4, 0, 2]), torch.tensor([1, 6])


def table() -> Stacked:
    """Three distances and two pairs of heights of different points; rows 3 and 5 report nothing."""
    distances = ReadPoints(FixedPoints.read, torch.cat([3.0 + normal(3, 3, seed=2), normal(3, 1, seed=3)], 1), 3)
    heights = LinearFunctionals(normal(2, 2, 3, seed=4), normal(2, 2, seed=5))
    parts = [
        Part(LENGTHS, torch.tensor([3, 4, 5]), torch.tensor([1]), distances),
        Part(HEIGHTS, torch.tensor([0, 1, 2]), torch.tensor([2, 0]), heights),
    ]
    return Stacked(N, R, M, parts)


def test_values_are_those_of_each_kind_and_slopes_those_of_differences() -> None:
    every = table()
    found, (lengths, heights) = every.value(Z), every.parts
    assert_close(found[LENGTHS, 1], lengths.observe.value(Z[LENGTHS, 3:])[:, 0])
    assert_close(found[HEIGHTS][:, [2, 0]], heights.observe.value(Z[HEIGHTS, :3]))
    assert int((found != 0).sum()) == 3 + 4
    step, h = normal(N, M, seed=6), 1e-6
    change = (every.value(Z + h * step) - every.value(Z - h * step)) / (2 * h)
    assert_close((every.slope(Z) @ step[..., None])[..., 0], change, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("index", [[4, 1, 1], [0, 5], [6, 2, 4, 3, 0]])
def test_rows_are_those_of_the_whole(index: list[int]) -> None:
    rows, every = torch.tensor(index), table()
    some = every.rows(rows)
    assert len(some) == len(index)
    assert_close(some.value(Z[rows]), every.value(Z)[rows])
    assert_close(some.slope(Z[rows]), every.slope(Z)[rows])


def explicit(noise: Noise) -> Tensor:
    flat = noise.shared.flatten(0, 1)
    return torch.block_diag(*noise.covariance) + flat @ flat.T


def test_the_operations_are_those_of_the_explicit_matrix() -> None:
    R, values = shared_noise(6, 3), normal(6, 3, seed=3)
    matrix = explicit(R)
    torch.testing.assert_close(R.solve(values).flatten(), torch.linalg.solve(matrix, values.flatten()))
    torch.testing.assert_close(R.multiply(values[..., None]).flatten(), matrix @ values.flatten())
    torch.testing.assert_close(R.add_to(torch.zeros_like(matrix)), matrix)
    rows = torch.tensor([4, 1])
    some = matrix.view(6, 3, 6, 3)[rows][:, :, rows].reshape(6, 6)
    torch.testing.assert_close(explicit(R.rows(rows)), some)
    torch.testing.assert_close(explicit(R.own), torch.block_diag(*R.covariance))


def test_a_correlation_of_rounding_errors_is_symmetric() -> None:
    """Products of Jacobians may leave 1e-19 and 1.00001e-19 beside variances of 1e-10."""
    blocks = 1e-10 * torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    blocks[1, 0, 1], blocks[1, 1, 0] = 1e-19, 1.00001e-19
    assert torch.equal(Noise(blocks).covariance, blocks)
    blocks[1, 1, 0] = 1e-12
    with pytest.raises(InputError, match=r"`noise`.* at row 1"):
        Noise(blocks)


@pytest.mark.parametrize("reduced", [False, True])
def test_a_map_knows_its_measurements(reduced: bool) -> None:
    """The measurements that momenta imply are those of the fit, or, with few control points, lead to the same map."""
    problem = two_marker_problem(uniform(15, 2, seed=3), shared_noise(15, 4))
    solver, steps = dc.GaussNewton(tolerance=1e-12), dc.RK4(4)
    controls = problem.x[::2] if reduced else None
    fitted = dc.fit(problem, solver, steps, controls=controls)
    implied = fitted.model.measured()
    if not reduced:
        torch.testing.assert_close(implied, problem.y, rtol=0.0, atol=1e-5)
    problem.y = implied
    again = dc.fit(problem, solver, steps, controls=controls, start=fitted.momenta)
    new = uniform(20, 2, seed=8)
    torch.testing.assert_close(again.model(new), fitted.model(new), rtol=0.0, atol=1e-4)


def gaps(rows: int = 9, m: int = 6) -> tuple[Tensor, Tensor]:
    """Random blocks, and which coordinates of them were measured."""
    root = normal(rows, m, m, seed=5)
    visible = (normal(rows, m // 3, seed=6) > -0.3).repeat_interleave(3, 1)
    visible[0], visible[1, :3] = True, False
    return root @ root.mT + torch.eye(m, dtype=torch.float64), visible


def test_hidden_coordinates_carry_no_information() -> None:
    """And stay hidden in another frame and with weights."""
    blocks, visible = gaps()
    hidden = without_hidden(blocks, visible)
    noise, values = Noise(hidden), normal(*visible.shape, seed=7)
    solved = noise.solve(values)
    for row, seen in enumerate(visible):
        expected = torch.linalg.solve(blocks[row][seen][:, seen], values[row, seen])
        torch.testing.assert_close(solved[row, seen], expected, rtol=1e-9, atol=1e-12)
        assert float(solved[row, ~seen].abs().sum()) < 1e-6
    turn = torch.block_diag(*2 * [torch.linalg.qr(normal(3, 3, seed=8)).Q])
    turned = turn @ hidden @ turn.mT
    for same in (noise.visible, Noise(0.5 * (turned + turned.mT)).visible, measured_coordinates(turned / 2.5)):
        assert same.tolist() == visible.tolist()  # 2.5: the largest weight of a row


def test_mean_block_leaves_out_what_was_hidden() -> None:
    blocks, visible = gaps()
    mean = Noise(without_hidden(blocks, visible)).mean
    for k in range(visible.shape[1]):
        own = blocks[visible[:, k], k, k]
        assert float(mean[k, k]) == pytest.approx(float(own.mean()), rel=1e-12)
    assert float(torch.linalg.eigvalsh(mean)[0]) > 0
    large = 1e12 * blocks  # the unit of a map that is no robot's
    assert bool(Noise(large).visible.all())
    torch.testing.assert_close(Noise(large).mean, large.mean(0))
