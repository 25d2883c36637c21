"""Rows and folds that are left out: weights, errors and deviations outside of the fit, by closed forms and refits."""

from dataclasses import replace
from functools import partial
from math import inf

import numpy as np
import pytest
import torch
from numbers_bank import LIMIT, drawn, normal
from process_bank import case
from product_bank import scales_of
from tangent_bank import built, covariance, prior_covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.choose_scales import unresolved_errors
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.scales import leave_one_out as one_out
from diffeo_calib.calibration.scales.leave_one_out import (
    LeaveOneOut,
    cross_validated_inflation,
    halved,
    inflation_by_parts,
    leave_one_out,
    motions,
    random_folds,
    variance_ratio,
)
from diffeo_calib.calibration.scales.selection import Selection
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.fitting.result import silent
from diffeo_calib.regression import tails
from diffeo_calib.regression.tails import reweight


@pytest.mark.parametrize("name", ["two markers", "poses"])
def test_weights_are_those_of_the_errors_under_the_posterior(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Conditioned on everything: the mean error, and the uncertainty of the signal. One round, from given weights."""
    data, scales = case(name).data, case(name).scales
    n, m = data.target.shape
    G, total = prior_covariance(data, scales), covariance(data, scales)
    target = data.target.flatten()
    gain = torch.linalg.solve(total, G).mT
    residual, uncertain = target - gain @ target, G - gain @ G
    moments = torch.outer(residual, residual) + (uncertain + uncertain.mT) / 2
    blocks = torch.stack([moments[m * i : m * (i + 1), m * i : m * (i + 1)] for i in range(n)])
    blocks = data.blocks_in_coordinates(blocks)
    expected = reweight(data.noise_model.squares(data.noise(scales), blocks), data.noise_model.freedom)
    monkeypatch.setattr(tails, "gross_weights", lambda *_: None)
    monkeypatch.setattr(one_out, "estimated", partial(tails.estimated, rounds=1))
    actual = one_out.weighed(data, scales).tails
    assert actual.freedom == expected.freedom < inf
    assert_close(actual.weights, expected.weights, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["one marker", "two markers", "poses"])
def test_leave_one_out_is_refitting_without_the_row(name: str) -> None:
    data, scales = case(name).data, case(name).scales
    found = leave_one_out(data, scales)
    n, m = data.target.shape
    G, total = prior_covariance(data, scales), covariance(data, scales)
    noise = data.blocks_in_numbers(data.noise(scales))
    assert found.count == data.target.numel()
    scale = float(found.errors.abs().max())
    for row in range(0, n, 5):
        own = slice(m * row, m * (row + 1))
        rest = torch.cat([torch.arange(m * row), torch.arange(m * (row + 1), m * n)])
        gain = torch.linalg.solve(total[rest][:, rest], G[rest][:, own]).mT
        error = data.target[row] - gain @ data.target.flatten()[rest]
        of_row = data.rows(torch.tensor([row]))
        assert_close(found.errors[row], of_row.in_coordinates(error[None, :, None])[0, :, 0], rtol=0, atol=1e-8 * scale)
        predicted = G[own, own] - gain @ G[rest][:, own] + noise[row]
        both = (of_row.blocks_in_coordinates(one[None]) for one in (predicted, torch.outer(error, error)))
        assert_close(found.squares[row], of_row.noise_model.squares(*both)[0], rtol=1e-7, atol=1e-8)
    trace = float(torch.linalg.solve(total, G).trace())  # of the matrix that makes fitted values from measured ones
    assert found.effective == pytest.approx(trace, rel=1e-6)


def test_few_data_inflate_the_regions_as_student_s_t_does() -> None:
    """95 % regions of three normal coordinates whose variance was estimated from nu further coordinates."""

    def inflation(effective: float | None, rows: int = 30) -> float:
        errors = torch.zeros(rows, 3, dtype=torch.float64)
        return LeaveOneOut(errors, errors[:, :1], count=3 * rows, effective=effective).inflation(30)

    for freedom in (8, 20):
        rng = np.random.default_rng(0)
        estimated = rng.chisquare(freedom, 200_000) / freedom
        squares = (rng.standard_normal((200_000, 3)) ** 2).sum(1) / estimated
        assert abs((squares / inflation(90.0 - freedom) < LIMIT).mean() - 0.95) < 0.003
    assert inflation(None) == 1.0
    assert inflation(89.9) == inflation(82.0)
    assert inflation(70.0, 60) == inflation(70.0), "repeats add nothing"


def test_rows_along_motions_and_repeats_belong_together() -> None:
    """In one motion, and in one fold."""
    steps = 0.01 * normal(8, 1, 6) * torch.arange(5)[:, None]
    along, alone = (2 * drawn(8, 1, 6) - 1 + steps).reshape(40, 6), 2 * drawn(30, 6, seed=1) - 1
    x = torch.cat([along, alone, along[:1]])
    labels = torch.cat([torch.arange(70), torch.zeros(1, dtype=torch.int64)])
    found = motions(x, labels)
    assert found[:40].view(8, 5).unique(dim=1).shape == (8, 1)
    assert len(found.unique()) == 38
    assert found[-1] == found[0]
    few = motions(along[:20], torch.arange(20))  # four motions are too few to leave one out
    assert len(few.unique()) == 20
    folds = random_folds(found, 5, 0)
    assert sorted(torch.cat([inside for _, inside in folds]).tolist()) == list(range(71))
    for outside, inside in folds:
        assert not set(found[outside].tolist()) & set(found[inside].tolist())
        assert 7 <= len(found[inside].unique()) <= 8
    assert folds[0][1].tolist() != random_folds(found, 5, 1)[0][1].tolist()


def of_scales(data: TangentData, factor: Tensor, seed: int) -> TangentData:
    """Measurements of a robot that scales describe exactly; ``factor``: of their covariance."""
    target = (factor @ normal(data.y.numel(), seed=seed)).view_as(data.y)
    return replace(data, y=data.y + target - data.target)


def test_right_scales_are_hardly_widened(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the uncertainty of the factor, and by what a search changes that sees fewer rows."""
    data, scales, found = built("sliding").tangent_data, built("sliding").scales, []
    monkeypatch.setattr(one_out, "ITERATIONS", 1)
    factor, rows = torch.linalg.cholesky(covariance(data, scales)), torch.arange(len(data.x))
    for seed in range(5):
        found.append(cross_validated_inflation(scales, scales, of_scales(data, factor, seed), rows, seed=seed) or 0.0)
    assert min(found) > 0.5
    assert 0.9 < np.median(found) < 1.7, found


def machine(rows: int) -> TangentData:
    """Commanded places, and what was measured of them."""
    x = 0.5 * drawn(rows, 3)
    return place(dc.cartesian(x), dc.Measurements(x, x + normal(*x.shape, size=1e-4)), silent).tangent_data()


UNEVEN = 3e-4, 2e-5, 2e-5


@pytest.mark.parametrize(
    ("along", "field", "repeats", "expected"),
    [(UNEVEN, 1e-3, 0, 3e-4), (UNEVEN, 3e-5, 0, 3e-5), (UNEVEN, 1e-3, 10, 0.0), ((6e-5, 6e-5, 6e-5), 1e-3, 0, 0.0)],
)
def test_noise_of_commands_is_an_error_of_the_machine(
    along: tuple[float, ...], field: float, repeats: int, expected: float
) -> None:
    """Unless a device explains it as well, or repeats show it; and of no more than the machine's other errors."""
    data, quiet = machine(60), dict.fromkeys(("transmission_amplitude", "task_amplitude"), 1e-8)
    usual = {"coupled_lengthscale": 0.3, "coupled_amplitude": field, "sensor_noise": 5e-5}
    scales = scales_of(3, 3, joint_noise=along, **usual, **quiet)
    rows = of_scales(data, torch.linalg.cholesky(covariance(data, scales)), 1)
    variances = unresolved_errors(Selection(scales, ""), scales, rows, 60 - repeats, factor=4.0)
    assert (0.0 if variances is None else float(variances.max() / 4.0) ** 0.5) == pytest.approx(expected, rel=1e-3)


def test_parts_of_the_space_show_errors_that_no_row_does() -> None:
    """A field below the noise, three times as large as the scales say."""
    data, usual = machine(192), {"coupled_lengthscale": 0.15, "sensor_noise": 1e-4}
    usual |= dict.fromkeys(("transmission_amplitude", "task_amplitude", "joint_noise"), 1e-8)
    right, small = (scales_of(3, 3, coupled_amplitude=size, **usual) for size in (6e-5, 2e-5))
    factor, by_parts, by_rows, x = torch.linalg.cholesky(covariance(data, right)), [], [], data.x
    for seed in range(3):
        rows = of_scales(data, factor, seed)
        by_rows.append(variance_ratio(rows, leave_one_out(rows, small)))
        by_parts.append([inflation_by_parts(rows, scales) for scales in (right, small)])
    found = np.mean(by_parts, 0)
    assert 0.9 < found[0] < 1.4, by_parts
    assert found[1] > 1.25 * np.mean(by_rows), (by_parts, by_rows)
    assert halved(x.repeat(2, 1))[:192].equal(halved(x.repeat(2, 1))[192:])  # repeats are left out together
    assert halved(x).bincount().tolist() == [6] * 32
