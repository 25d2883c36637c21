"""`model.registered`: laws, truth of the simulated arm, honest deviations, outliers, bad input, files."""

from __future__ import annotations

import warnings
from dataclasses import replace
from math import log
from pathlib import Path
from typing import Any

import pytest
import torch
from product_bank import Case, covered, simulated, simulated_poses, ur10_measurements, ur10_scales
from table_bank import refused
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.model_header import describe, rebuild_registration
from diffeo_calib.interop.numpy_model import load_numpy
from diffeo_calib.kinematics.registered_map import Registration, check_isotropic, moved
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.regression.linear_rows import LinearRows
from diffeo_calib.robots.se3 import twist_transform

pytestmark = pytest.mark.slow  # several calibrations

NEW_MARKER = torch.tensor([[-0.08, 0.05, 0.21]], dtype=torch.float64)
NOISE = 2e-5


def transform(seed: int = 0) -> Tensor:
    """A rigid transform, metres and radians."""
    return twist_transform(torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))


def by(T: Tensor, points: Tensor) -> Tensor:
    """Points (..., 3) seen from another frame."""
    return points @ T[:3, :3].mT + T[:3, 3]


def seen(case: Case, rows: slice, T: Tensor) -> dc.Measurements:
    """Held-out rows of a case, measured from another place."""
    return dc.Measurements(case.test.q[rows], by(T, case.test.points[rows]), case.robot.joint_names)


def other_marker(marker: Tensor, q: Tensor, T: Tensor, seed: int = 5, *, posed: bool = False) -> dc.Measurements:
    """The arm of a calibration, with markers or with poses, its new markers measured from another place."""
    arm = simulated_poses(1)[0] if posed else simulated(1)[0]
    arm.truth = replace(arm.truth, tool=marker)
    points = by(T, arm.true_points(q))
    draw = torch.randn(points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return dc.Measurements(q, points + NOISE * draw)


def record(model: dc.CalibratedKinematics) -> Registration:
    assert model.registration is not None
    return model.registration


def rms(model: dc.CalibratedKinematics, data: dc.Measurements) -> float:
    return dc.evaluate(model, data).rms


@pytest.mark.parametrize("name", ["arm", "posed"])
def test_a_model_seen_from_elsewhere_is_exact(name: str, request: pytest.FixtureRequest) -> None:
    case, T = request.getfixturevalue(name), transform(1)
    model, q = case.model, case.test.q[:20]
    there = dc.CalibratedKinematics(case.robot, moved(model.map, T), lever=model.lever)
    torch.testing.assert_close(there(q), by(T, model(q)), rtol=0, atol=1e-12)
    torch.testing.assert_close(there.jacobian(q), T[:3, :3] @ model.jacobian(q), rtol=0, atol=1e-12)
    expected = T[:3, :3] @ model.predict(q)[1] @ T[:3, :3].mT
    torch.testing.assert_close(there.predict(q)[1], expected, rtol=1e-6, atol=1e-14)
    torch.testing.assert_close(there.geometry.base, T @ model.geometry.base, rtol=0, atol=1e-12)
    torch.testing.assert_close(there.tool_poses(q), model.tool_poses(q), rtol=0, atol=1e-12)
    torch.testing.assert_close(there.predict_tool_poses(q)[1], model.predict_tool_poses(q)[1], rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("learn", [True, False])
def test_registration_follows_the_frame(arm: Case, *, learn: bool) -> None:
    """registered(T @ data) = T @ registered(data), and registrations one after the other reach the same place."""
    rows, T, S, q = slice(0, 8), transform(2), transform(3), arm.test.q[20:30]
    here = arm.model.registered(seen(arm, rows, torch.eye(4, dtype=torch.float64)), free="base", learn=learn)
    there = arm.model.registered(seen(arm, rows, T), free="base", learn=learn)
    torch.testing.assert_close(there(q), by(T, here(q)), rtol=0, atol=1e-9)
    torch.testing.assert_close(record(there).transform, T @ record(here).transform, rtol=0, atol=1e-9)
    torch.testing.assert_close(record(there).frame_deviations.norm(), record(here).frame_deviations.norm())
    if learn:
        return  # the same rows would count twice
    again = there.registered(seen(arm, rows, S @ T), free="base", learn=False)
    torch.testing.assert_close(again(q), by(S @ T, here(q)), rtol=0, atol=1e-8)
    torch.testing.assert_close(again.predict(q)[1], S[:3, :3] @ there.predict(q)[1] @ S[:3, :3].mT, rtol=0.05, atol=0)


def test_what_a_registration_adds_is_that_written_out(arm: Case) -> None:
    """Covariances of single configurations, and of several together; of a changed robot, whose frame is found."""
    q = arm.test.q[20:24]
    fitted = arm.model.registered(seen(arm, slice(0, 8), transform(3)), learn=False).map
    found, fit = fitted.registration, fitted.unregistered
    rows, at = (fitted.geodesic.linearise(each) for each in (found.q, q))
    S = fitted.linearised_value(q)[1].sensitivity[..., fit.columns :].flatten(0, 1)
    cross = S @ found.gain @ fit.conditional.covariance_between(rows, at)
    added = S @ found.covariance @ S.mT - cross - cross.mT
    expected = fit.conditional.covariance_between(at) + added
    torch.testing.assert_close(fitted.joint_covariance(q), expected, rtol=1e-6, atol=1e-14)
    single, together = fitted.predict(q, noise=False)[1], fitted.joint_covariance(q).unflatten(0, (4, 3))
    blocks = torch.stack([together[k, :, 3 * k : 3 * k + 3] for k in range(4)])
    torch.testing.assert_close(blocks, single, rtol=1e-9, atol=1e-16)
    known, wider = (one.predict(q, noise=False)[1] for one in (arm.model.map, arm.model.map.inflated(50.0)))
    torch.testing.assert_close(wider, 50 * known, rtol=1e-6, atol=0.0)


def test_a_task_kernel_with_directions_cannot_be_moved() -> None:
    for kernel in (dc.Gaussian([0.3, 0.3, 0.4], 1.0), dc.Gaussian(0.3, [1.0, 1.0, 2.0])):
        with pytest.raises(InputError, match="is not the same in all directions"):
            check_isotropic(kernel)


def test_rows_of_the_model_itself_change_nothing(arm: Case) -> None:
    """Its own predictions, moved: the transform is found to rounding, markers stay, deviations do not vanish."""
    q, T = arm.test.q[:10], transform(4)
    found = arm.model.registered(dc.Measurements(q, by(T, arm.model(q).detach())))
    torch.testing.assert_close(record(found).transform, T, rtol=0, atol=1e-7)
    torch.testing.assert_close(record(found).markers, arm.model.geometry.tool, rtol=0, atol=1e-7)
    torch.testing.assert_close(found(arm.test.q), by(T, arm.model(arm.test.q)), rtol=0, atol=1e-7)
    assert record(found).rms_after < 1e-7
    assert float(record(found).frame_deviations[:3].min()) > 1e-6
    before = record(found).rms_before
    assert before is not None
    assert before > 0.1


@pytest.mark.parametrize("free", ["both", "base"])
def test_a_moved_tracker(arm: Case, free: str) -> None:
    T = transform(5)
    found = arm.model.registered(seen(arm, slice(0, 10), T), free=free)
    rest = seen(arm, slice(10, None), T)
    assert rms(found, rest) < 1.25 * rms(arm.model, arm.test.rows(slice(10, None)))
    assert covered(found, rest) > 0.9
    assert record(found).free == free
    assert record(found).rows == 10
    assert record(found).outliers == ()


def test_another_marker(arm: Case) -> None:
    """0.2 m from the fitted one and never seen: as good as a tool centre point of the model can be."""
    T, q = transform(6), arm.test.q
    found = arm.model.registered(other_marker(NEW_MARKER, q[:12], T))
    rest = other_marker(NEW_MARKER, q[12:], T, seed=6)
    assert rms(found, rest) < 2.5 * rms(arm.model, arm.test)
    assert covered(found, rest) > 0.9
    assert record(found).same_place == 0.0
    away = record(found).markers - arm.model.geometry.tool  # on the flange of the model: the true one is elsewhere
    assert float((away - (NEW_MARKER - simulated(60)[0].truth.tool)).norm()) < 3e-4
    torch.testing.assert_close(found.geometry.tool, record(found).markers)
    start = found(q[:3]).detach()
    assert float((found(found.inverse(start, q[:3] + 0.01)) - start).abs().max()) < 1e-8


def test_poses_after_a_marker_and_a_marker_after_poses(arm: Case, posed: Case) -> None:
    T = transform(8)
    tool = transform(20)
    tool[:3, 3] *= 0.1
    frame = mark_points(tool[None], 0.15)[0]
    points = other_marker(frame, arm.test.q, T).points
    poses = dc.Measurements.from_poses(arm.test.q, poses_from_marks(points, 0.15), lever=0.15)
    found = arm.model.registered(poses.rows(slice(0, 8)))
    assert found.lever == 0.15
    errors: Any = dc.evaluate(found, poses.rows(slice(8, None)))
    assert errors.rms < 3.0 * rms(arm.model, arm.test)
    assert errors.orientation.rms < 0.06
    single = posed.model.registered(other_marker(NEW_MARKER, posed.test.q[:12], T, posed=True))
    assert single.lever is None
    rest = other_marker(NEW_MARKER, posed.test.q[12:], T, seed=6, posed=True)
    assert rms(single, rest) < 2.0 * rms(posed.model, posed.test)
    assert covered(single, rest) > 0.9


def test_rows_teach_the_robot_where_nothing_else_has_changed(arm: Case) -> None:
    """More rows make it better than places alone, and what they contradict is not learnt."""
    T, rest = transform(22), slice(60, None)
    rows = seen(arm, slice(0, 60), T)
    learnt, placed = (arm.model.registered(rows, learn=learn) for learn in (True, False))
    assert rms(learnt, seen(arm, rest, T)) < 0.95 * rms(placed, seen(arm, rest, T))
    assert covered(learnt, seen(arm, rest, T)) > 0.9
    torch.testing.assert_close(learnt.geometry.tool, record(learnt).markers, rtol=0, atol=0)
    assert len(learnt.configurations) == len(arm.model.configurations) + 60
    held = placed.registered(rows, free="marker")  # a frame that is not known exactly, and held
    assert len(held.configurations) == len(arm.model.configurations)
    bent = dc.Measurements(rows.q, rows.points * torch.tensor([1.0, 1.01, 1.0], dtype=torch.float64))
    with pytest.warns(dc.DiffeoCalibWarning) as told:
        kept = arm.model.registered(bent)
    assert any("times as large as the model" in str(one.message) for one in told)
    assert len(kept.configurations) == len(arm.model.configurations)


@pytest.mark.parametrize("wrong", [{3: (0.0, 0.02, 0.0)}, {3: (0.0, 0.01, 0.0), 7: (-0.3, -0.3, -0.3)}])
def test_wrong_rows_take_no_part(wrong: dict[int, tuple[float, ...]], arm: Case) -> None:
    """One of eight, and two of twelve."""
    T, rows = transform(9 + len(wrong)), 4 + 4 * len(wrong)
    data = seen(arm, slice(0, rows), T)
    points = data.points.clone()
    for row, shift in wrong.items():
        points[row, 0] += torch.tensor(shift, dtype=points.dtype)
    words = rf"{len(wrong)} row\(s\) contradict all others and took no part: row {', '.join(map(str, wrong))};"
    with pytest.warns(dc.DiffeoCalibWarning, match=words):
        found = arm.model.registered(dc.Measurements(data.q, points))
    assert record(found).outliers == tuple(wrong)
    assert record(found).rows == rows - len(wrong)
    assert rms(found, seen(arm, slice(rows, None), T)) < 1.5 * rms(arm.model, arm.test)


def test_a_tool_that_never_turned(arm: Case) -> None:
    """Another marker and poses of one orientation: frame and marker cannot be told apart, and predictions say so."""
    q = arm.test.q[:1].repeat(4, 1)
    q[:, 0] += torch.tensor([0.0, 0.4, 0.8, 1.2], dtype=torch.float64)  # about one axis only
    T = transform(12)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = arm.model.registered(other_marker(NEW_MARKER, q, T))
    assert any("the place of the marker on 'flange' along" in str(one.message) for one in said)
    assert any("turn the tool about several axes" in text for text in record(found).undetermined)
    rest = other_marker(NEW_MARKER, arm.test.q[5:], T, seed=6)
    assert dc.evaluate(found.__call__, rest).rms > 1e-3  # wrong elsewhere, as it must be
    assert covered(found, rest) > 0.9
    assert rms(found, other_marker(NEW_MARKER, q, T, seed=7)) < 2e-4  # right where it was measured


def test_a_marker_that_may_have_moved_is_weighed(arm: Case) -> None:
    """1 mm is found; with free="base" it is not, and the errors say so."""
    T, marker = transform(13), simulated(60)[0].truth.tool + torch.tensor([7e-4, -5e-4, 5e-4], dtype=torch.float64)
    data, rest = (other_marker(marker, arm.test.q[rows], T) for rows in (slice(0, 15), slice(15, None)))
    placed = arm.model.registered(data)
    found = record(placed)
    assert found.shift is not None
    assert found.same_place is not None
    assert found.same_place < 0.05
    assert float((found.shift.norm() - 1e-3).abs()) < 4e-4
    assert rms(placed, rest) < 1.5 * rms(arm.model, arm.test)
    stated = arm.model.registered(data, marker_std=1e-3)
    assert record(stated).same_place is None
    assert rms(stated, rest) < 1.5 * rms(arm.model, arm.test)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        kept = arm.model.registered(data, free="base")
    assert record(kept).excess > 2 * found.excess


def test_known_deviations_count(arm: Case) -> None:
    """Rows of a coarse device leave larger deviations than those of a tracker."""
    data = seen(arm, slice(0, 8), transform(14))
    fine = record(arm.model.registered(data))
    coarse = record(arm.model.registered(dc.Measurements(data.q, data.points, std=1e-3)))
    assert float(coarse.frame_deviations[:3].norm()) > 3.0 * float(fine.frame_deviations[:3].norm())
    assert float(coarse.noise.diagonal().min()) > 0.999e-6


def test_tools_of_a_registered_model(arm: Case) -> None:
    """Inside the base nothing changes; in the measuring frame poses move, and are less certain."""
    T, q, tool = transform(15), arm.test.q[:6], [0.05, 0.0, 0.2]
    found = arm.model.registered(seen(arm, slice(0, 10), T), learn=False)
    torch.testing.assert_close(found.tool_poses(q, tool), arm.model.tool_poses(q, tool), rtol=0, atol=1e-11)
    inside = [model.predict_tool_poses(q, tool)[1] for model in (found, arm.model)]
    torch.testing.assert_close(*inside, rtol=1e-5, atol=1e-13)
    moved_poses = record(found).transform @ arm.model.tool_poses(q, tool, "measuring")
    torch.testing.assert_close(found.tool_poses(q, tool, "measuring"), moved_poses, rtol=0, atol=1e-11)
    covariance = found.predict_tool_poses(q, tool, "measuring")[1]
    assert float(torch.linalg.eigvalsh(covariance).min()) > -1e-12


@pytest.mark.parametrize("name", ["arm", "posed"])
def test_registered_models_come_back_bit_for_bit(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    case, T = request.getfixturevalue(name), transform(16)
    data = other_marker(NEW_MARKER, case.test.q[:12], T, posed=name == "posed")
    found = case.model.registered(data).with_tool([0, 0, 0.1])
    dc.save(found, tmp_path / "model")
    again: Any = dc.load(tmp_path / "model")
    q = case.test.q[:20]
    assert torch.equal(again(q), found(q))
    assert torch.equal(again.predict(q)[1], found.predict(q)[1])
    assert torch.equal(again.tool_poses(q), found.tool_poses(q))
    assert torch.equal(again.to("cpu").jacobian(q), found.jacobian(q))
    without_torch = load_numpy(tmp_path / "model")
    torch.testing.assert_close(torch.from_numpy(without_torch(q.numpy())), found(q), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.map.deformation(q).view_as(found(q)), found(q), rtol=0, atol=1e-12)
    assert again.provenance == found.provenance
    assert again.lever == found.lever
    for field in Registration.__dataclass_fields__:
        mine, theirs = getattr(record(again), field), getattr(record(found), field)
        assert torch.equal(mine, theirs) if isinstance(mine, Tensor) else mine == theirs


@pytest.mark.parametrize("new", [False, True], ids=["its own marker", "another marker"])
def test_covariances_stay_positive(arm: Case, *, new: bool) -> None:
    """Rows that fit better than expected leave the errors that they share with predictions as they are."""
    q, model = arm.test.q, arm.model
    points = model(q[:12]).detach()
    if new:
        points = model.tool_poses(q[:12], NEW_MARKER[0].tolist(), frame="measuring")[:, None, :3, 3]
    exact = dc.Measurements(q[:12], points, arm.robot.joint_names)
    covariance = model.registered(exact, learn=False).predict(q, noise=False)[1]
    alone = model.predict(q, noise=False)[1]
    least = torch.linalg.eigvalsh(covariance).amin()
    assert float(least) > 0.1 * float(torch.linalg.eigvalsh(alone).amin())


def test_files_that_do_not_fit_together(arm: Case) -> None:
    """Entries that are missing or of another kind, and tensors of another shape, are refused."""
    header, tensors = describe(arm.model.registered(seen(arm, slice(0, 8), transform(18))))
    entry = header["registration"]
    tensors = {name: tensor for name, tensor in tensors.items() if name.startswith("registration_")}
    assert rebuild_registration(entry, tensors, 6).rows == 8
    for wrong in ({}, entry | {"mood": 1}):
        with pytest.raises(TypeError, match="argument"):
            rebuild_registration(wrong, tensors, 6)
    for name in tensors:
        with pytest.raises(InputError):
            rebuild_registration(entry, tensors | {name: tensors[name][:-1]}, 6)


def test_bad_input(arm: Case) -> None:
    data = seen(arm, slice(0, 8), transform(17))
    model, names = arm.model, arm.robot.joint_names
    two = dc.Measurements(data.q, data.points.repeat(1, 2, 1))
    refused(
        (r"`measurements`: expected dc.Measurements, got Tensor", lambda: model.registered(data.q)),  # pyright: ignore[reportArgumentType]
        (r"`free`: expected 'both' or 'base' or 'marker', got 'tool'", lambda: model.registered(data, free="tool")),
        ("`marker_std`, in m: expected a number above 0", lambda: model.registered(data, marker_std=0.0)),
        ("not determine where everything is: .* at least 3 rows, got 2", lambda: model.registered(data.rows([0, 1]))),
        ("the columns in the robot's order", lambda: model.registered(data.with_joint_names(names[::-1]))),
        (r"have shape \(N, 6\)", lambda: model.registered(dc.Measurements(data.q[:, :5], data.points))),
        (r'"base" keeps .* 1 marker\(s\), got 2 marker\(s\)', lambda: model.registered(two, free="base")),
    )
    mirrored = dc.Measurements(data.q, data.points * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    with pytest.warns(dc.DiffeoCalibWarning) as told:
        model.registered(mirrored)
    assert any("times as large as the model" in str(one.message) for one in told)


# --- a real UR10, whose second half is moved by a rigid transform ---------------------------------------------------

ROWS = 120
"""Of the model."""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")
def test_a_tracker_that_moved_between_two_halves(ur10_folder: Path) -> None:
    """RMS on the other rows of the moved half, in units of that of the same model where nothing moved."""
    robot, data = ur10_measurements(ur10_folder)
    half, other = data.split(0.5, seed=0)
    model = dc.calibrate(robot, half[:ROWS], hyperparameters=ur10_scales()).model
    T = twist_transform(torch.tensor([1.0, -2.0, 0.5, 0.7, -1.2, 0.4], dtype=torch.float64))
    moved = dc.Measurements(other.q, other.points @ T[:3, :3].mT + T[:3, 3], robot.joint_names)
    for rows, most in ((20, 1.05), (6, 1.25)):
        order = torch.randperm(len(other), generator=torch.Generator().manual_seed(0))
        found = model.registered(moved.rows(order[:rows]))
        rest = order[rows:]
        assert dc.evaluate(found, moved.rows(rest)).rms < most * dc.evaluate(model, other.rows(rest)).rms
        assert covered(found, moved.rows(rest[:40])) > 0.88


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")
def test_a_marker_that_the_fit_hardly_knew(ur10_folder: Path) -> None:
    """Rows of another date, whose tool tilts otherwise, place it along the one direction that the fit left open."""
    robot, fitted = ur10_measurements(ur10_folder)
    columns = [f"measurement_{axis}" for axis in "xyz"]
    csv = ur10_folder / "measurements_grid_900.csv"
    other = dc.read_measurements(csv, robot, columns, length="mm", angle="rad", sep=";", decimal=",")
    model = dc.calibrate(robot, fitted.split(0.2, seed=0)[0], hyperparameters=ur10_scales()).model
    rows = torch.randperm(len(other), generator=torch.Generator().manual_seed(0))
    found = model.registered(other.rows(rows[:20]))
    assert dc.evaluate(found, other.rows(rows[20:])).rms < 6e-4  # held to its old place: 7 mm


# --- linearised rows of a new set-up: the Gaussian that they are, with explicit matrices ----------------------------

M, R, K = 6, 3, 4
DRAWS = torch.Generator().manual_seed(0)


def normal(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=DRAWS, dtype=torch.float64)


def rows() -> LinearRows:
    shapes, noise, prior = normal(M * R, 5), normal(M, R, R + 2), normal(K, K + 2)
    visible = torch.ones(M, R, dtype=torch.bool)
    given = normal(M, R), normal(M, R, K), shapes @ shapes.T, noise @ noise.mT, visible, prior @ prior.T, normal(K)
    return LinearRows(*given, by_fit=torch.zeros(K, K, dtype=torch.float64))


def test_evidence_and_left_out_errors_are_those_of_the_whole_covariance() -> None:
    one = rows()
    covariance = one.C + torch.block_diag(*one.noise) + one.slopes @ one.prior @ one.slopes.T
    density = MultivariateNormal(one.slopes @ one.mean, covariance)
    assert_close(one.log_evidence(), float(density.log_prob(one.residual.flatten())))
    scaled = covariance + 8.0 * (one.C + torch.block_diag(*one.noise))  # nine times the errors, the same places
    density = MultivariateNormal(one.slopes @ one.mean, scaled)
    apart = float(density.log_prob(one.residual.flatten())) - one.log_evidence(9.0)
    assert_close(apart, -0.5 * M * R * log(9.0))
    for row in range(M):
        own = torch.arange(M * R) // R == row
        gain = covariance[own][:, ~own] @ torch.linalg.inv(covariance[~own][:, ~own])
        assert_close(one.left_out[row], one.target[own] - gain @ one.target[~own])
        assert_close(torch.linalg.inv(one.precisions[row]), (covariance[own] - gain @ covariance[~own])[:, own])


def test_places_are_those_of_the_noise_alone_and_their_covariance_is_that_of_all_errors() -> None:
    """Without errors of the model it is the posterior of a linear Gaussian; with them their effect is added."""
    one = rows()
    precision = torch.block_diag(*torch.linalg.inv(one.noise))
    posterior = torch.linalg.inv(torch.linalg.inv(one.prior) + one.slopes.T @ precision @ one.slopes)
    pull = torch.linalg.solve(one.prior, one.mean) + one.slopes.T @ precision @ one.residual.flatten()
    assert_close(one.step, posterior @ pull)
    assert_close(one.covariance, posterior + one.gain @ one.C @ one.gain.T)
    left = one.residual.flatten() - one.slopes @ one.step
    assert_close(one.after_placing @ one.target, left)


def test_markers_that_the_fit_knows_poorly_follow_the_rows() -> None:
    """Their errors B widen what the rows may move, not what is known before them."""
    shapes, one = normal(K, K + 2), rows()
    one = replace(one, by_fit=shapes @ shapes.T)
    S, wide = one.slopes, one.prior + one.by_fit
    gain = wide @ S.T @ torch.linalg.inv(S @ wide @ S.T + torch.block_diag(*one.noise))
    assert_close(one.gain, gain)
    cross = gain @ S @ one.prior
    total = S @ one.prior @ S.T + one.C + torch.block_diag(*one.noise)
    assert_close(one.covariance, one.prior - cross - cross.T + gain @ total @ gain.T)
