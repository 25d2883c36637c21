"""`model.registered`: laws, truth of the simulated arm, honest deviations, outliers, bad input, files."""

from __future__ import annotations

from dataclasses import replace
from math import log
from typing import Any

import pytest
import torch
from product_bank import Case, covered, simulated, simulated_poses
from table_bank import refused, warned
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.model_file import describe, rebuild_registration
from diffeo_calib.kinematics.registered_map import check_isotropic, moved
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.regression.linear_rows import LinearRows
from diffeo_calib.robots.se3 import twist_transform

pytestmark = pytest.mark.slow  # several calibrations

NEW_MARKER = torch.tensor([[-0.08, 0.05, 0.21]], dtype=torch.float64)
NOISE = 2e-5


def transform(seed: int) -> Tensor:
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


def registered(case: Case, *rows: Any, **how: Any) -> tuple[Any, Any]:
    """The registered model, and the record."""
    found = case.model.registered(*rows, **how)
    return found, found.registration


def rms(model: dc.CalibratedKinematics, data: dc.Measurements) -> float:
    return dc.evaluate(model, data).rms


@pytest.mark.parametrize("name", ["arm", "posed"])
def test_a_model_seen_from_elsewhere_is_exact(name: str, request: pytest.FixtureRequest) -> None:
    case, T = request.getfixturevalue(name), transform(1)
    model, q = case.model, case.test.q[:20]
    there = dc.CalibratedKinematics(case.robot, moved(model.map, T), lever=model.lever)
    assert_close(there(q), by(T, model(q)), rtol=0, atol=1e-12)
    assert_close(there.jacobian(q), T[:3, :3] @ model.jacobian(q), rtol=0, atol=1e-12)
    expected = T[:3, :3] @ model.predict(q)[1] @ T[:3, :3].mT
    assert_close(there.predict(q)[1], expected, rtol=1e-6, atol=1e-14)
    assert_close(there.tool_poses(q), model.tool_poses(q), rtol=0, atol=1e-12)
    assert_close(there.predict_tool_poses(q)[1], model.predict_tool_poses(q)[1], rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("learn", [True, False])
def test_registration_follows_the_frame(arm: Case, *, learn: bool) -> None:
    """registered(T @ data) = T @ registered(data), and registrations one after the other reach the same place."""
    rows, T, S, q = slice(0, 8), transform(2), transform(3), arm.test.q[20:30]
    here, first = registered(arm, seen(arm, rows, torch.eye(4, dtype=torch.float64)), free="base", learn=learn)
    there, second = registered(arm, seen(arm, rows, T), free="base", learn=learn)
    assert_close(there(q), by(T, here(q)), rtol=0, atol=1e-9)
    assert_close(second.transform, T @ first.transform, rtol=0, atol=1e-9)
    for frame, expected in (("base", here.tool_poses(q)), ("measuring", T @ here.tool_poses(q, frame="measuring"))):
        assert_close(there.tool_poses(q, frame=frame), expected, rtol=0, atol=1e-9)
    assert_close(second.frame_deviations.norm(), first.frame_deviations.norm(), rtol=1e-4, atol=0)
    if learn:
        return  # the same rows would count twice
    again = there.registered(seen(arm, rows, S @ T), free="base", learn=False)
    assert_close(again(q), by(S @ T, here(q)), rtol=0, atol=1e-8)
    assert_close(again.predict(q)[1], S[:3, :3] @ there.predict(q)[1] @ S[:3, :3].mT, rtol=0.05, atol=0)


def test_what_a_registration_adds_is_that_written_out(arm: Case) -> None:
    """Covariances of single configurations, and of several together; of a changed robot, whose frame is found."""
    q = arm.test.q[20:24]
    fitted = registered(arm, seen(arm, slice(0, 8), transform(3)), learn=False)[0].map
    found, fit = fitted.registration, fitted.unregistered
    rows, at = (fitted.geodesic.linearise(each) for each in (found.q, q))
    S = fitted.linearised_value(q)[1].sensitivity[..., fit.columns :].flatten(0, 1)
    cross = S @ found.gain @ fit.conditional.covariance_between(rows, at)
    expected = fit.conditional.covariance_between(at) + S @ found.covariance @ S.mT - cross - cross.mT
    assert_close(fitted.joint_covariance(q), expected, rtol=1e-6, atol=1e-14)
    blocks = torch.stack([expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(4)])
    assert_close(blocks, fitted.predict(q, noise=False)[1], rtol=1e-6, atol=1e-14)
    known, wider = (one.predict(q) for one in (arm.model.map, arm.model.map.inflated(50.0)))
    assert_close(wider, (known[0], 50 * known[1]), rtol=1e-6, atol=0)


@pytest.mark.parametrize("new", [False, True], ids=["its own marker", "another marker"])
def test_rows_of_the_model_itself_change_nothing(arm: Case, *, new: bool) -> None:
    """Its own predictions, moved, lead back to it; errors that they share with predictions stay as they are."""
    model, q, T = arm.model, arm.test.q, transform(4)
    points = model.tool_poses(q, NEW_MARKER[0].tolist(), frame="measuring")[:, None, :3, 3] if new else model(q)
    found, record = registered(arm, dc.Measurements(q[:12], by(T, points[:12].detach())), learn=False)
    near: Any = {"rtol": 0, "atol": 1e-5 if new else 1e-7}  # a marker that may be anywhere is pulled a little
    assert_close(record.transform, T, **near)
    assert_close(found(q), by(T, points), **near)
    assert record.rms_after < near["atol"]
    assert float(record.frame_deviations[:3].min()) > 1e-6
    assert new or record.rms_before > 0.1
    least, alone = (torch.linalg.eigvalsh(one.predict(q, noise=False)[1]).amin() for one in (found, model))
    assert float(least) > 0.1 * float(alone)


def test_another_marker(arm: Case) -> None:
    """0.2 m from the fitted one and never seen: as good as a tool centre point of the model can be."""
    T, q = transform(6), arm.test.q
    found, record = registered(arm, other_marker(NEW_MARKER, q[:12], T))
    rest = other_marker(NEW_MARKER, q[12:], T, seed=6)
    assert rms(found, rest) < 2.5 * rms(arm.model, arm.test)
    assert covered(found, rest) > 0.9
    assert record.same_place == 0.0
    away = record.markers - arm.model.geometry.tool  # on the flange of the model: the true one is elsewhere
    assert float((away - (NEW_MARKER - simulated(60)[0].truth.tool)).norm()) < 3e-4
    start = found(q[:3]).detach()
    assert float((found(found.inverse(start, q[:3] + 0.01)) - start).abs().max()) < 1e-8


def test_poses_after_a_marker_and_a_marker_after_poses(arm: Case, posed: Case) -> None:
    T, tool = transform(8), transform(20)
    tool[:3, 3] *= 0.1
    points = other_marker(mark_points(tool[None], 0.15)[0], arm.test.q, T).points
    poses = dc.Measurements.from_poses(arm.test.q, poses_from_marks(points, 0.15), lever=0.15)
    found, _ = registered(arm, poses.rows(slice(0, 8)))
    assert found.lever == 0.15
    errors: Any = dc.evaluate(found, poses.rows(slice(8, None)))
    assert errors.rms < 3.0 * rms(arm.model, arm.test)
    assert errors.orientation.rms < 0.06
    single, _ = registered(posed, other_marker(NEW_MARKER, posed.test.q[:12], T, posed=True))
    assert single.lever is None
    rest = other_marker(NEW_MARKER, posed.test.q[12:], T, seed=6, posed=True)
    assert rms(single, rest) < 2.0 * rms(posed.model, posed.test)
    assert covered(single, rest) > 0.9


def test_rows_teach_the_robot_where_nothing_else_has_changed(arm: Case) -> None:
    """More rows make it better than places alone, and what they contradict is not learnt."""
    T, count = transform(22), len(arm.model.configurations)
    rows, rest = (seen(arm, own, T) for own in (slice(0, 60), slice(60, None)))
    short = arm.model.changed(map=replace(arm.model.map, unresolved=1e-8 * torch.ones(6, dtype=torch.float64)))
    arm = replace(arm, result=replace(arm.result, model=short))
    (learnt, record), (placed, _) = (registered(arm, rows, learn=learn) for learn in (True, False))
    assert_close(learnt.map.unresolved, placed.map.unregistered.unresolved, rtol=0, atol=0)
    assert rms(learnt, rest) < 0.95 * rms(placed, rest)
    assert covered(learnt, rest) > 0.9
    assert_close(learnt.geometry.tool, record.markers, rtol=0, atol=0)
    assert len(learnt.configurations) == count + 60
    assert len(placed.registered(rows, free="marker").configurations) == count  # a frame not known exactly, and held
    bent = dc.Measurements(rows.q, rows.points * torch.tensor([1.0, 1.01, 1.0], dtype=torch.float64))
    with pytest.warns(dc.DiffeoCalibWarning, match="times as large as the model"):
        kept = arm.model.registered(bent)
    assert len(kept.configurations) == count


WRONG = (
    *({3: (0.0, y, 0.0)} for y in (0.02, 1e4)),
    *({2: shift, 5: shift} for shift in ((0.0, 0.002, -0.002), (0.0, 0.02, 0.0))),
)
THIRD = {row: (0.0, 0.002 * (-1) ** row, 0.001 * row) for row in range(1, 40, 3)}


@pytest.mark.parametrize(
    "wrong", [*WRONG, THIRD], ids=["one", "one of a lost reflector", "two by 3 mm", "two by 20 mm", "a third"]
)
def test_wrong_rows_take_no_part(wrong: dict[int, tuple[float, ...]], arm: Case) -> None:
    """Of eight, or of forty; those that are wrong alike hide each other, and are found together only."""
    T, count = transform(9), 8 if len(wrong) < 3 else 40
    data = seen(arm, slice(0, count), T)
    points = data.points.clone()
    for row, shift in wrong.items():
        points[row, 0] += torch.tensor(shift, dtype=points.dtype)
    words = rf"{len(wrong)} row\(s\) contradict all others and took no part: row {', '.join(map(str, [*wrong][:5]))}"
    with pytest.warns(dc.DiffeoCalibWarning, match=words):
        found, record = registered(arm, dc.Measurements(data.q, points))
    assert (record.outliers, record.rows) == (tuple(wrong), count - len(wrong))
    assert rms(found, seen(arm, slice(count, None), T)) < 1.5 * rms(arm.model, arm.test)


def test_what_moved_among_the_rows_is_opened(arm: Case) -> None:
    """A marker that slipped by 0.5 mm half-way: both verbs know the robot and its errors as by the rows before."""
    T, q, at = transform(9), arm.test.q, simulated(1)[0].truth.tool
    slipped = at + torch.tensor([3e-4, -4e-4, 0.0], dtype=torch.float64)
    parts = other_marker(at, q[:20], T), other_marker(slipped, q[20:40], T)
    rest, rows = other_marker(at, q[40:], T, seed=6), dc.Measurements.joined(parts).with_line_numbers(range(40))
    with pytest.warns(
        dc.DiffeoCalibWarning, match=r"a marker or the tool seems to have moved by about 0.(4[89]|5\d?) mm near row 20"
    ):
        found = [registered(arm, rows)[0], dc.recalibrate(arm.model, rows).model]
    for model in found:
        said = model.predict(rest.q)[1].diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()
        assert rms(model, rest) < 1.2 * rms(arm.model, arm.test)
        assert 0.8 * rms(model, rest) < float(said) < 1.4 * rms(model, rest)
        assert covered(model, rest) > 0.9


def test_a_tool_that_never_turned(arm: Case) -> None:
    """Another marker and poses of one orientation: frame and marker cannot be told apart, and predictions say so."""
    q = arm.test.q[:1].repeat(4, 1)
    q[:, 0] += torch.tensor([0.0, 0.4, 0.8, 1.2], dtype=torch.float64)  # about one axis only
    T = transform(12)
    (found, record), said = warned(registered, arm, other_marker(NEW_MARKER, q, T))
    assert any("the place of the marker on 'flange' along" in one for one in said)
    assert any("turn the tool about several axes" in text for text in record.undetermined)
    rest = other_marker(NEW_MARKER, arm.test.q[5:65], T, seed=6)
    assert dc.evaluate(found.__call__, rest).rms > 1e-3  # wrong elsewhere, as it must be
    assert covered(found, rest) > 0.9
    assert rms(found, other_marker(NEW_MARKER, q, T, seed=7)) < 2e-4  # right where it was measured


def test_a_marker_that_may_have_moved_is_weighed(arm: Case) -> None:
    """1 mm is found; with free="base" it is not, and the errors say so."""
    T, marker = transform(13), simulated(60)[0].truth.tool + torch.tensor([7e-4, -5e-4, 5e-4], dtype=torch.float64)
    data, rest = (other_marker(marker, arm.test.q[rows], T) for rows in (slice(0, 15), slice(15, None)))
    (placed, found), (stated, asked) = registered(arm, data), registered(arm, data, marker_std=1e-3)
    assert found.same_place < 0.05
    assert float((found.shift.norm() - 1e-3).abs()) < 4e-4
    assert asked.same_place is None
    assert max(rms(placed, rest), rms(stated, rest)) < 1.5 * rms(arm.model, arm.test)
    (_, kept), _ = warned(registered, arm, data, free="base")
    assert kept.excess > 2 * found.excess


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
    model, names, directions = arm.model, arm.robot.joint_names, "is not the same in all directions"
    two = dc.Measurements(data.q, data.points.repeat(1, 2, 1))
    still, large = (dc.Measurements(data.q, factor * data.points, doubt=False) for factor in (1e-9, 1e7))
    refused(
        (r"no place of .* explains these rows: expected at most 0\..* check that", lambda: model.registered(still)),
        (r"no place of .* explains these rows: expected at most 1\d", lambda: model.registered(large)),
        (r"`measurements`: expected dc.Measurements, got Tensor", lambda: model.registered(data.q)),  # pyright: ignore[reportArgumentType]
        (r"`free`: expected 'both' or 'base' or 'marker', got 'tool'", lambda: model.registered(data, free="tool")),
        ("`marker_std`, in m: expected a number above 0", lambda: model.registered(data, marker_std=0.0)),
        ("not determine where everything is: .* at least 3 rows, got 2", lambda: model.registered(data.rows([0, 1]))),
        ("the columns in the robot's order", lambda: model.registered(data.with_joint_names(names[::-1]))),
        (r"have shape \(N, 6\)", lambda: model.registered(dc.Measurements(data.q[:, :5], data.points))),
        (r'"base" keeps .* 1 marker\(s\), got 2 marker\(s\)', lambda: model.registered(two, free="base")),
        (directions, lambda: check_isotropic(dc.Gaussian([0.3, 0.3, 0.4], 1.0))),
        (directions, lambda: check_isotropic(dc.Gaussian(0.3, [1.0, 1.0, 2.0]))),
    )


# --- linearised rows of a new set-up: the Gaussian that they are, with explicit matrices ----------------------------

M, R, K = 6, 3, 4
DRAWS = torch.Generator().manual_seed(0)


def normal(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=DRAWS, dtype=torch.float64)


def rows(by_fit: Tensor) -> LinearRows:
    shapes, noise, prior = normal(M * R, 5), normal(M, R, R + 2), normal(K, K + 2)
    visible = torch.ones(M, R, dtype=torch.bool)
    given = normal(M, R), normal(M, R, K), shapes @ shapes.T, noise @ noise.mT, visible, prior @ prior.T, normal(K)
    return LinearRows(*given, by_fit=by_fit)


def test_evidence_and_left_out_errors_are_those_of_the_whole_covariance() -> None:
    one = rows(torch.zeros(K, K, dtype=torch.float64))
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


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_places_are_those_of_the_noise_alone_and_their_covariance_is_that_of_all_errors(size: float) -> None:
    """The gain is that of a linear Gaussian without errors of the model, C. Errors B of markers that the fit hardly
    knew widen what the rows may move, not what is known before them."""
    shapes = size * normal(K, K + 2)
    one = rows(shapes @ shapes.T)
    S, noise = one.slopes, torch.block_diag(*one.noise)
    wide = one.prior + one.by_fit
    gain = wide @ S.T @ torch.linalg.inv(S @ wide @ S.T + noise)
    assert_close(one.gain, gain)
    cross, total = gain @ S @ one.prior, S @ one.prior @ S.T + one.C + noise
    assert_close(one.covariance, one.prior - cross - cross.T + gain @ total @ gain.T)
    assert_close(one.step, one.mean + gain @ (one.residual.flatten() - S @ one.mean))
    assert_close(one.after_placing @ one.target, one.residual.flatten() - S @ one.step)
