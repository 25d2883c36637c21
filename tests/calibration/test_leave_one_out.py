"""Rows and folds that are left out: weights, errors and deviations outside of the fit, by closed forms and refits."""

from dataclasses import replace
from functools import cache, partial
from math import inf

import numpy as np
import pytest
import torch
from product_bank import scales_of, usual_scales
from scipy.stats import chi2
from tangent_bank import Setting, built, covariance, normal, prior_covariance
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
from diffeo_calib.regression.tails import Tails, reweight
from diffeo_calib.robots import SimulatedArm


@cache
def arm(markers: int, rows: int) -> Setting:
    """Clean measurements, and scales that suit them."""
    simulated = SimulatedArm(seed=4, markers=markers)
    found = Setting(simulated.nominal, dc.Measurements(*simulated.measure(rows, seed=5)))
    found.scales = usual_scales(simulated.nominal)
    return found


def weighted(data: TangentData) -> TangentData:
    """With weights of any size, and a narrow prior of the base: G + R spans eight powers of ten with the usual."""
    weights = np.random.default_rng(0).uniform(0.05, 1.5, tuple(data.tails.weights.shape))
    return replace(data, place_deviation=1e-3).with_tails(Tails(4.0, torch.from_numpy(weights)))


CASES = {"one marker": lambda: arm(1, 60), "two markers": lambda: arm(2, 40), "poses": lambda: built("posed")}


@pytest.mark.parametrize("name", ["two markers", "poses"])
def test_weights_are_those_of_the_errors_under_the_posterior(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Conditioned on everything: the mean error, and the uncertainty of the signal. One round, from given weights."""
    data, scales = weighted(CASES[name]().tangent_data), CASES[name]().scales
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


@pytest.mark.parametrize("name", CASES)
def test_leave_one_out_is_refitting_without_the_row(name: str) -> None:
    data, scales = weighted(CASES[name]().tangent_data), CASES[name]().scales
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
        assert abs((squares / inflation(90.0 - freedom) < chi2.ppf(0.95, 3)).mean() - 0.95) < 0.003
    assert inflation(None) == 1.0
    assert inflation(89.9) == inflation(82.0)
    assert inflation(70.0, 60) == inflation(70.0), "repeats add nothing"


def test_rows_along_motions_and_repeats_belong_together() -> None:
    """In one motion, and in one fold."""
    rng = np.random.default_rng(0)
    starts, steps = rng.uniform(-1, 1, (8, 1, 6)), 0.01 * rng.standard_normal((8, 1, 6)) * np.arange(5)[:, None]
    along, alone = torch.from_numpy((starts + steps).reshape(40, 6)), torch.from_numpy(rng.uniform(-1, 1, (30, 6)))
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


def test_right_scales_are_hardly_widened(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the uncertainty of the factor, and by what a search changes that sees fewer rows."""
    data, scales, found = built("sliding").tangent_data, built("sliding").scales, []
    monkeypatch.setattr(one_out, "ITERATIONS", 1)
    factor = torch.linalg.cholesky(covariance(data, scales))
    for seed in range(5):  # measurements of a robot that the scales describe exactly
        target = (factor @ normal(data.y.numel(), seed=seed)).view_as(data.y)
        drawn, rows = replace(data, y=data.y + target - data.target), torch.arange(len(data.x))
        found.append(cross_validated_inflation(scales, scales, drawn, rows, seed=seed) or 0.0)
    assert min(found) > 0.5
    assert 0.9 < np.median(found) < 1.7, found


UNEVEN = 3e-4, 2e-5, 2e-5


@pytest.mark.parametrize(
    ("along", "field", "repeats", "expected"),
    [(UNEVEN, 1e-3, 0, 3e-4), (UNEVEN, 3e-5, 0, 3e-5), (UNEVEN, 1e-3, 10, 0.0), ((6e-5, 6e-5, 6e-5), 1e-3, 0, 0.0)],
)
def test_noise_of_commands_is_an_error_of_the_machine(
    along: tuple[float, ...], field: float, repeats: int, expected: float
) -> None:
    """Unless a device explains it as well, or repeats show it; and of no more than the machine's other errors."""
    x = 0.5 * torch.rand(60, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = place(dc.cartesian(x), dc.Measurements(x, x + 1e-4 * normal(*x.shape, seed=0)), silent).tangent_data()
    quiet = dict.fromkeys(("transmission_amplitude", "task_amplitude"), 1e-8)
    usual = {"coupled_lengthscale": 0.3, "coupled_amplitude": field, "sensor_noise": 5e-5}
    scales = scales_of(3, 3, joint_noise=along, **usual, **quiet)
    target = (torch.linalg.cholesky(covariance(data, scales)) @ normal(data.y.numel(), seed=1)).view_as(data.y)
    drawn, found = replace(data, y=data.y + target - data.target), Selection(scales, "")
    variances = unresolved_errors(found, scales, drawn, len(x) - repeats, factor=4.0)
    assert (0.0 if variances is None else float(variances.max() / 4.0) ** 0.5) == pytest.approx(expected, rel=1e-3)


def test_parts_of_the_space_show_errors_that_no_row_does() -> None:
    """A field below the noise, three times as large as the scales say."""
    x = 0.5 * torch.rand(192, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = place(dc.cartesian(x), dc.Measurements(x, x + 1e-4 * normal(*x.shape, seed=0)), silent).tangent_data()
    quiet = dict.fromkeys(("transmission_amplitude", "task_amplitude", "joint_noise"), 1e-8)
    right, small = (
        scales_of(3, 3, coupled_lengthscale=0.15, coupled_amplitude=size, sensor_noise=1e-4, **quiet)
        for size in (6e-5, 2e-5)
    )
    factor, by_parts, by_rows = torch.linalg.cholesky(covariance(data, right)), [], []
    for seed in range(3):
        target = (factor @ normal(data.y.numel(), seed=seed)).view_as(data.y)
        drawn = replace(data, y=data.y + target - data.target)
        by_rows.append(variance_ratio(drawn, leave_one_out(drawn, small)))
        by_parts.append([inflation_by_parts(drawn, scales) for scales in (right, small)])
    found = np.median(by_parts, 0)
    assert 0.9 < found[0] < 1.4, by_parts
    assert found[1] > 1.25 * np.median(by_rows), (by_parts, by_rows)
    assert halved(x.repeat(2, 1))[:192].equal(halved(x.repeat(2, 1))[192:])  # repeats are left out together
    assert halved(x).bincount().tolist() == [6] * 32
