"""Scales: defaults, the log posterior against scipy and formulas, the search; rows and folds that are left out."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import inf

import numpy as np
import pytest
import torch
from kind_bank import kind_named
from numbers_bank import LIMIT, drawn, inside, normal, rms
from process_bank import case
from product_bank import Case, noise_blocks, scales_of
from tangent_bank import (
    SETTINGS,
    built,
    covariance,
    noise_covariance,
    prior_covariance,
    shaken,
    tangent_covariance,
    weighted,
)
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.choose_scales import robot_problem, unresolved_errors
from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.scales import leave_one_out as one_out
from diffeo_calib.calibration.scales import selection
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
from diffeo_calib.calibration.scales.noise_model import differing_factor
from diffeo_calib.calibration.scales.selection import Selection, defaults, log_posterior
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.result import silent
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.noise import HIDDEN_VARIANCE
from diffeo_calib.process.scales import AMPLITUDES, SCALES
from diffeo_calib.regression import tails
from diffeo_calib.regression.regions import region_factor
from diffeo_calib.regression.tails import reweight
from diffeo_calib.robots import SimulatedArm


def test_the_unit_of_length_does_not_matter() -> None:
    """The same robot ten times as large: lengths of the scales grow tenfold, angles stay."""
    setting = built("sliding")
    data, big = setting.tangent_data, torch.tensor([1, 1, 10.0, 1, 1, 1], dtype=torch.float64)
    noise, prior = setting.identification.noise, setting.identification.prior

    class Grown(GeometryMap):
        def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
            return 10.0 * super().__call__(x / big, theta)

        def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
            return 10.0 * super().jacobian(x / big, theta) / big

    geometry = setting.nominal.geometry
    large = replace(data, nominal=Grown(geometry), theta=data.theta[: geometry.size], x=data.x * big)
    grown, lengths = (
        defaults(large, 10 * noise, prior),
        dict.fromkeys(("coupled_lengthscale", "transmission_lengthscale"), big),
    )
    for name, factor in (lengths | {"task_lengthscale": 10, "sensor_noise": 10, "task_amplitude": 10}).items():
        assert_close(getattr(grown, name), factor * getattr(setting.scales, name), rtol=1e-6, atol=0)
    assert_close(grown.rotation_noise, setting.scales.rotation_noise, rtol=1e-6, atol=0)
    assert bool((grown.joint_noise > 0).all())


def log_prior(scales: dc.Hyperparameters, centre: dc.Hyperparameters) -> float:
    """Log-normal, entry by entry: amplitudes may grow a little and shrink a lot."""
    total = 0.0
    for name in SCALES:
        away = (getattr(scales, name) / getattr(centre, name)).log()
        width = torch.where((away < 0) & (name in AMPLITUDES), 2.0, 1.0)
        total -= 0.5 * float((away / width).square().sum())
    return total


@pytest.mark.parametrize("name", SETTINGS)
def test_posterior_is_likelihood_times_prior(name: str) -> None:
    setting = built(name)
    scales, data = shaken(setting.scales, 2), weighted(setting, 2)
    nominal, theta, x = data.nominal.changed(rigid=True) if data.basis is not None else data.nominal, data.theta, data.x
    total = tangent_covariance(scales, nominal, theta, x)
    total += torch.block_diag(*noise_covariance(scales, setting, theta, data.tails.weights))
    target = (data.y - nominal(x, theta) + nominal.sensitivities(x, theta) @ theta).flatten()
    if data.basis is not None:  # six numbers of every pose
        basis = torch.block_diag(*data.basis)
        total, target = basis.T @ total @ basis, basis.T @ target
    found = log_posterior(scales.logarithms(), setting.scales, data)
    density = MultivariateNormal(torch.zeros_like(target), total, validate_args=False).log_prob(target)
    assert found.likelihood == pytest.approx(float(density), rel=1e-6)
    assert found.prior == pytest.approx(log_prior(scales, setting.scales), rel=1e-9)


def test_three_slides_whose_scales_change_together_count_once() -> None:
    centre, data = of_places()
    first = 2 * data.x.shape[1]  # of the coupled length scales
    for count, expected in ((3, -0.5), (1, -0.5 * (1 / 9 + 6 / 9 / selection.AXES**2))):  # one alone hardly may
        point = centre.logarithms()
        point[first : first + count] += 0.2
        assert log_posterior(point, centre, data).prior == pytest.approx(0.2**2 * expected)


def of_places() -> tuple[dc.Hyperparameters, TangentData]:
    """Commanded places, whose axes have like scales."""
    commanded = 0.1 * normal(20, 3, seed=1)
    rows = dc.Measurements(commanded, commanded + 1e-3 * normal(20, 3, seed=2))
    data = place(dc.cartesian(commanded), rows, silent).tangent_data()
    return defaults(data, 1e-3, Prior()), data


def of_kind(name: str) -> tuple[dc.Hyperparameters, TangentData]:
    return case(name).scales, case(name).data


@pytest.mark.parametrize("rows", [of_places, *(partial(of_kind, name) for name in ("poses", "mixture", "distances"))])
def test_gradient_against_central_differences(rows: Callable[[], tuple[dc.Hyperparameters, TangentData]]) -> None:
    centre, data = rows()
    point, h = shaken(centre, 2).logarithms(), 0.01  # long steps: the prior of the base is wide

    def change(step: Tensor) -> float:
        ends = [log_posterior(point + sign * step, centre, data) for sign in (1, -1)]
        return (ends[0].likelihood + ends[0].prior) - (ends[1].likelihood + ends[1].prior)

    found = log_posterior(point, centre, data)
    start = 0
    for name in centre.searched:  # along one direction for every kind of scale
        size = getattr(centre, name).numel()
        step = torch.zeros_like(point)
        step[start : start + size] = h * normal(size, seed=start)
        start += size
        expected, scale = (8 * change(step) - change(2 * step)) / 12, float(found.gradient.abs().max())
        assert float(found.gradient @ step) == pytest.approx(expected, rel=1e-4, abs=1e-6 * scale)


@pytest.mark.slow
def test_repeatability_of_the_joints_is_distinguished_from_signal() -> None:
    """Joints that do not repeat, a perfect tracker: s must be found, and nothing may be learnt from it."""
    arm = SimulatedArm(seed=8, geometry=0, transmission=0, gravity=0, noise=0)
    q = arm.sample(360, seed=1)
    points = arm.true_points(q + 1e-4 * normal(360, 6, seed=1)) + 1e-6 * normal(360, 1, 3, seed=2)
    train, test = dc.Measurements(q[:60], points[:60]), dc.Measurements(q[60:], points[60:])
    with pytest.warns(dc.DiffeoCalibWarning, match="these rows show no errors of the robot"):
        result = dc.calibrate(arm.nominal, train)
    case = Case(arm.nominal, train, test, result)
    _, geometry, diffeomorphic = case.held_out()
    assert diffeomorphic < 1.1 * geometry
    scales, nominal = result.selection.scales, result.identification.geometry
    seen = noise_blocks(scales, nominal, test.q).diagonal(dim1=1, dim2=2).sum(1).mean().sqrt()
    assert float(seen) > 0.5 * rms(test.points - arm.true_points(test.q))
    assert float(scales.joint_noise.max()) > 3e-5


def test_the_fit_of_six_numbers_is_that_of_nine() -> None:
    """Nine coordinates keep the points rigid by the slack, which is worth a small part of the noise of a pose."""
    posed = built("posed")
    data, scales = posed.tangent_data, posed.scales
    problem = robot_problem(data, scales)
    maps = [fit(each, GaussNewton(tolerance=1e-6)).model for each in (problem, problem.whole)]
    geometry = posed.nominal.geometry  # whose points nothing bends
    tool = geometry.tool + maps[0].deformation.momenta.theta[geometry.slices["tool"]].view(-1, 3)
    assert_close(torch.pdist(tool), torch.pdist(geometry.tool), rtol=1e-6, atol=0)
    x = data.x + 0.3
    (six, covariance), (nine, _) = (each.predict(x, noise=False) for each in maps)
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert float((six - nine).abs().max() / deviation.mean()) < 0.05
    assert maps[0].slopes is None
    assert maps[0].noise.covariance.shape == (12, 9, 9)


def blocks(rows: int, coordinates: int, seed: int) -> Tensor:
    """Covariances of different sizes and directions."""
    root = normal(rows, coordinates, coordinates, seed=seed) * normal(rows, 1, coordinates, seed=seed + 1).square()
    return root @ root.mT + 1e-3 * torch.eye(coordinates, dtype=torch.float64)


def everywhere(covariance: Tensor) -> Tensor:
    return torch.ones(covariance.shape[:2], dtype=torch.bool)


def share(errors: Tensor, covariance: Tensor) -> float:
    """Share of errors (..., 3 P) whose markers lie in their 95 % regions."""
    each = torch.stack([covariance[k : k + 3, k : k + 3] for k in range(0, len(covariance), 3)])
    bodies = errors.unflatten(-1, (-1, 3))
    return inside(bodies, each.expand(*bodies.shape, 3))


def test_regions_hold_95_percent_of_a_mixture() -> None:
    for seed in range(3):
        each = blocks(60, 6, 10 * seed)
        mean = each.mean(0)
        errors = (torch.linalg.cholesky(each)[:, None] @ normal(60, 2000, 6, seed=seed)[..., None])[..., 0]
        factor = differing_factor(each, mean, everywhere(each))
        assert share(errors, mean) < 0.93
        assert share(errors, factor * mean) == pytest.approx(0.95, abs=0.01)
    each = torch.eye(3, dtype=torch.float64).repeat(100, 1, 1)
    each[0] *= 1e6
    assert differing_factor(each, each.mean(0), everywhere(each)) == pytest.approx(1.0, abs=1e-12), "never narrower"


def test_hidden_markers_do_not_count() -> None:
    each = blocks(30, 6, 3)
    seen = everywhere(each)
    seen[20:, :3] = seen[:10, 3:] = False
    hidden = torch.where(seen[:, :, None] & seen[:, None], each, HIDDEN_VARIANCE * torch.eye(6, dtype=torch.float64))
    other = torch.where(seen[:, :, None] & seen[:, None], each, torch.eye(6, dtype=torch.float64))
    mean = each.mean(0)
    assert differing_factor(hidden, mean, seen) == pytest.approx(differing_factor(other, mean, seen), rel=1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
@pytest.mark.parametrize("name", ["several kinds", "laser beams", "inclinations"])
def test_coordinates_beside_readings_have_the_tails_of_all_rows(name: str) -> None:
    """Those of the geometric calibration, which it leaves large, would widen the noise of a position by a half."""
    noise, new = kind_named(name).model.map.noise, kind_named(name).model.map.new_noise
    whole = noise.visible.sum(1) == noise.visible.sum(1).max()
    size = int(noise.visible[whole][0].sum())
    measured = noise.covariance[whole][:, :size, :size].diagonal(dim1=1, dim2=2).mean()
    assert 0.9 < float(new[:size, :size].diagonal().mean() / measured) < 1.15


def test_rows_with_known_deviations_keep_their_own() -> None:
    """They are judged by these: the mean is too large for most, and too small for the rest."""
    plain, scales = built("two markers").tangent_data, built("two markers").scales
    each = blocks(*plain.y.shape, seed=8) * 1e-8
    data = replace(plain, noise_model=replace(plain.noise_model, known=each))
    wanted = data.noise(scales) * region_factor(data.tails.freedom, 3)
    torch.testing.assert_close(data.noise_of_new_rows(scales), wanted, rtol=1e-12, atol=0.0)
    found = plain.noise_of_new_rows(scales)
    assert_close(found, found[:1].expand_as(found), rtol=1e-12, atol=0)


def test_gravity_sag_of_many_joints_is_left_out() -> None:
    # 60 joints have 16,470 unknowns of it, whose matrices took 14 GB.
    robot = dc.from_dh([dc.DHRow(0.0, 0.05, 0.08, (k % 3 - 1) * math.pi / 2) for k in range(40)])
    q = 0.4 * drawn(30, 40) - 0.2
    placed = place(robot, dc.Measurements(q, robot(q)[:, None, :3, 3], doubt=False), silent)
    with pytest.warns(dc.DiffeoCalibWarning, match="sag of 40 joints is left out .*at most 5000 unknowns of it, got 7"):
        assert placed.tangent_data().nominal.elasticity is None


# --- rows and folds that are left out, by closed forms and refits -----------------------------------------------------


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
    folds = random_folds(found, 5, 0)
    assert sorted(torch.cat([within for _, within in folds]).tolist()) == list(range(71))
    for outside, within in folds:
        assert not set(found[outside].tolist()) & set(found[within].tolist())
        assert 7 <= len(found[within].unique()) <= 8
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
    four, each = (  # four motions are too few to leave one out
        monkeypatch.setattr(one_out, "motions", lambda _, groups, size=size: groups // size)
        or cross_validated_inflation(scales, scales, of_scales(data, factor, 0), rows, seed=0)
        for size in (7, 1)
    )
    assert four == each == found[0]


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
