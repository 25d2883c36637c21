"""Lengths against descriptions, rows of no robot, something that moved during them, and drift with a column."""

from __future__ import annotations

import re
from copy import copy
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from again_bank import true_error
from kind_bank import kind_named
from numbers_bank import drawn, normal, rms, tensor
from product_bank import simulated, simulated_poses, ur10_measurements, ur10_scales
from reading_bank import readings, scales
from table_bank import warned
from tangent_bank import Setting, covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.gates import CHANGE_ROWS
from diffeo_calib.calibration.diagnostics.hypotheses import worth_it
from diffeo_calib.calibration.diagnostics.judge import changes
from diffeo_calib.calibration.placing.placement import FRAME_M_RAD, GROWTH, OFFSET_RAD_M, Drift
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.sensors.devices import Hypothesis
from diffeo_calib.sensors.known_drift import KnownDrift

ARM = SimulatedArm(2)
ROWS, LINK = 80, "elbow_joint"


def lengths(data: dc.Measurements | dc.Readings) -> tuple[dc.CalibrationResult, list[str]]:
    result, texts = warned(dc.calibrate, ARM.nominal, data, hyperparameters=scales())
    return result, [one for one in texts if "seems to differ" in one]


def numbers(pattern: str, text: str | None) -> list[float]:
    """What the groups of a pattern match."""
    found = re.search(pattern, str(text))
    assert found is not None, text
    return [float(number) for number in found.groups()]


@pytest.mark.parametrize(("scale", "said"), [(3e-3, False), (2e-2, True)])
def test_axes_of_a_machine_of_slides_are_as_wrong_as_its_spindles(scale: float, said: bool) -> None:
    q = torch.rand(60, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wrong = q * (1.0 + scale * tensor([1.0, -0.6, 0.8])) + 2e-4 * (6 * q.roll(1, 1)).sin() + normal(60, 3, size=2e-5)
    _, texts = warned(dc.calibrate, dc.cartesian(q), dc.Measurements(q, wrong))
    assert any("along x seems to differ by +2" in text for text in texts) is said
    assert any("seems to differ" in text for text in texts) is said


@cache
def clean() -> tuple[dc.CalibrationResult, list[str]]:
    return lengths(dc.Measurements(*ARM.measure(ROWS, seed=1)))


@pytest.mark.parametrize(
    ("factors", "name", "percent"),
    [((1.01,) * 3, "the size of the robot", 1.0), ((1.0, 1.001, 1.0), "the scale of the measuring frame along y", 0.1)],
)
def test_a_wrong_scale_is_named_with_its_size(factors: tuple[float, ...], name: str, percent: float) -> None:
    (q, y), scale = ARM.measure(ROWS, seed=1), tensor(factors)
    result, (text,) = lengths(dc.Measurements(q, y * scale))
    assert numbers(rf"{name} seems to differ by \+([\d.]+) %", text) == pytest.approx([percent], rel=0.25)
    assert result.expected.workspace == pytest.approx(rms((y - y.mean((0, 1))) * (scale - 1)), rel=0.3)


def test_a_wrong_link_is_the_robots_and_leaves_no_position_in_doubt() -> None:
    """The fit takes it up; with a wrong scale of the device beside it positions are in doubt."""
    arm, q = copy(ARM), ARM.sample(ROWS, 1)
    theta, start = torch.zeros(arm.truth.size, dtype=torch.float64), 6 + 6 * ARM.nominal.joint_names.index(LINK)
    along = ARM.nominal.offsets[ARM.nominal.joint_names.index(LINK)]
    theta[start : start + 3] = 6e-3 * torch.nn.functional.normalize(along[:3, :3].mT @ along[:3, 3], dim=0)
    arm.truth = arm.truth.absorb(theta)
    right, (text,) = lengths(dc.Measurements(q, arm.true_points(q)))
    assert numbers(rf"^the link before {LINK} .* differ by \+([\d.]+) mm", text) == pytest.approx([6.0], rel=0.2)
    assert right.expected.workspace < 2e-4
    doubted, (text,) = lengths(dc.Measurements(q, 1.01 * arm.true_points(q)))
    assert "positions that may be wrong by" in text
    assert doubted.expected.workspace > 2e-3


@pytest.mark.parametrize(("share", "noticed"), [(0.6, False), (1.5, True)])
def test_the_result_tells_which_scales_pass_without_a_warning(share: float, noticed: bool) -> None:
    """The size that is told apart from none, of the clean rows: rows in a tracker's wrong scale are judged by it."""
    q, y = ARM.measure(ROWS, seed=1)
    (right, silent), found = clean(), clean()[0].lengths[0]
    assert silent == []
    assert abs(right.lengths[0].value) < 3 * right.lengths[0].deviation < 0.004
    wrong, texts = lengths(dc.Measurements(q, y * (1 + share * found.unnoticed - found.value)))
    assert bool(texts) == noticed
    assert found.motion == pytest.approx(rms(y - y.mean((0, 1))), rel=0.15)
    said, size = str(wrong.lengths[0]), wrong.lengths[0]
    assert f"moves points by {1e3 * abs(size.value) * size.motion:.2g} mm" in said
    assert "may be wrong without a warning" in said


def test_sockets_without_a_known_distance_show_no_size() -> None:
    """Neither another one nor a change: what the ball differs within a socket is no motion."""
    kind = kind_named("ball in sockets")
    table = with_attributes(kind.data, distances=(), distance_std=None)
    result, (text,) = warned(dc.calibrate, kind.robot, table, hyperparameters=kind.scales)
    assert "no distance between sockets is known" in text
    size = result.lengths[0]
    assert abs(size.value) < size.deviation
    assert size.deviation > 0.01


def test_the_scale_of_a_wire_is_checked_in_the_same_way() -> None:
    data = readings(ARM, "distance", ROWS, zero=0.02)
    _, (text,) = lengths(with_attributes(data, values=1.01 * data.values))
    assert numbers(r"the size of the robot seems to differ by \+([\d.]+) %", text) == pytest.approx([1.0], rel=0.2)
    assert lengths(data)[1] == []


def test_the_controllers_own_positions_are_warned_about() -> None:
    """Also rounded to 0.1 mm, and as poses."""
    q = ARM.sample(ROWS, 1)
    poses = ARM.nominal(q)
    y = poses[:, None, :3, 3] + tensor([0.5, 0.2, 0.1])
    poses[:, :3, 3] = (1e4 * y[:, 0]).round() / 1e4
    exact, rounded = (dc.Measurements(q, own, doubt=False) for own in (y, poses[:, None, :3, 3]))
    for data in (exact, rounded, dc.Measurements.from_poses(q, poses, doubt=False)):
        with pytest.warns(DiffeoCalibWarning, match="show no errors of the robot.*if they were computed"):
            dc.calibrate(ARM.nominal, data, hyperparameters=scales())
    machine = dc.cartesian(y[:, 0])  # without links, more accurate than usual arms
    places = y + 3e-5 * torch.sin(8 * y[..., [1, 2, 0]]) + 1e-5 * normal(*y.shape, seed=3)
    _, said = warned(dc.calibrate, machine, dc.Measurements(dc.pose_inputs(machine, y[:, 0]), places))
    assert not [text for text in said if "no errors of the robot" in text]


@pytest.mark.parametrize("lever", [10.0, 1e-4])
def test_levers_in_another_unit_are_refused(lever: float) -> None:
    q = ARM.sample(ROWS, 1)
    with pytest.raises(MeasurementError, match=rf"lever.* got {1e3 * lever:g} mm"):
        dc.calibrate(ARM.nominal, dc.Measurements.from_poses(q, ARM.truth.poses(q), lever=lever))


# --- changes ----------------------------------------------------------------------------------------------------------


def from_row(points: Tensor, row: int, change: Tensor) -> Tensor:
    changed = points.clone()
    changed[row:] += change
    return changed


def test_the_gain_is_that_of_the_definition() -> None:
    """Every change point by itself, with explicit matrices."""
    arm, measurements, _ = simulated(24)
    setting = Setting(arm.nominal, measurements)
    data, effects = setting.tangent_data, normal(24, 3, 4, seed=0)
    order = torch.from_numpy(np.random.default_rng(1).permutation(24))
    inverse, r = torch.linalg.inv(covariance(data, setting.scales)), data.target.flatten()
    gains = []
    for row in range(CHANGE_ROWS, 24 - CHANGE_ROWS + 1):
        B = torch.zeros(24, 3, 4, dtype=torch.float64)
        B[order[row:]] = effects[order[row:]]
        B = B.flatten(0, 1)
        g, H = B.T @ inverse @ r, B.T @ inverse @ B
        gains.append(float(g @ torch.linalg.solve(H, g)))
    jump, _ = changes([Hypothesis("any", effects)], data.process(setting.scales), order)
    assert jump.rows == (CHANGE_ROWS + int(np.argmax(gains)),)
    left = (float(r @ inverse @ r) - max(gains)) / len(r)
    assert jump.gain == pytest.approx(max(gains) / max(1.0, left), rel=1e-5)
    wide, _ = changes([Hypothesis("any", effects)], data.process(setting.scales), order, 3.0 + left)
    assert wide.gain == pytest.approx(max(gains) / (3.0 + left), rel=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:wrist_3_joint")
@pytest.mark.filterwarnings("ignore:the place of the marker on 'ee_link' is known to")
def test_rows_in_which_the_tool_hardly_turns_do_not_tell_device_from_marker(ur10_folder: Path) -> None:
    """Both shifts are the same there, and both are named."""
    robot, data = ur10_measurements(ur10_folder)
    points = from_row(data.points[:100], 50, tensor([6e-4, 0.0, 8e-4]))
    moved = dc.Measurements(data.q[:100], points)
    with pytest.warns(DiffeoCalibWarning, match="these rows do not tell which") as caught:
        dc.calibrate(robot, moved, hyperparameters=ur10_scales())
    (text,) = [str(w.message) for w in caught if "moved by" in str(w.message)]
    assert text.count("moved by about 1 mm") == 2
    assert all(what in text for what in ("the measuring device", "a marker", "near row 50"))


THIRD = SimulatedArm(3)
Q, POINTS = THIRD.measure(ROWS, seed=1)


def told(points: Tensor, *, given: bool = True) -> str | None:
    """What is said of changes in these rows, whose numbers tell their order, with scales given or selected."""
    mixed = torch.from_numpy(np.random.default_rng(0).permutation(ROWS))
    return said(THIRD.nominal, dc.Measurements(Q, points)[mixed], given=given)


def said(robot: dc.Tree, data: dc.Measurements, *, given: bool = True) -> str | None:
    """The same of any rows."""
    _, texts = warned(dc.calibrate, robot, data, hyperparameters=scales() if given else None)
    return next((text for text in texts if "seems to" in text), None)


@pytest.mark.parametrize(("joint", "size"), [(0, 5e-4), (2, 5e-4), (5, 2e-3)])
def test_a_joint_that_jumps_is_named_with_row_and_size(joint: int, size: float) -> None:
    """From row 30 of 80 on; of the first and the last joint another cause explains as much."""
    after = Q.clone()
    after[30:, joint] += size
    text = told(POINTS + THIRD.true_points(after) - THIRD.true_points(Q))
    name = THIRD.nominal.joint_names[joint]
    found, row = numbers(rf"^{name} seems to have changed by about ([\d.]+) mrad.*?near row (\d+)", text)
    assert found == pytest.approx(1e3 * size, rel=0.3)
    assert row == pytest.approx(30, abs=4)
    assert ("these rows do not tell which" in str(text)) == (joint in (0, 5))


@pytest.mark.filterwarnings("ignore:leave-one-out errors contradict")
def test_a_model_holds_for_the_rows_before_a_slip() -> None:
    """Its error was half of the slip, with a quarter of the true places outside of the regions."""
    rows = dc.Measurements(Q, from_row(POINTS, 50, THIRD.truth.poses(Q)[50:, None, :3, 1] * 1e-3))
    with pytest.warns(DiffeoCalibWarning, match="near row 50.* the model holds for the rows before it"):
        result = dc.calibrate(THIRD.nominal, rows, hyperparameters=scales())
    assert result.partial
    new = THIRD.sample(200, seed=2)
    mean, covariance = result.model.predict(new, noise=False)
    errors = THIRD.true_points(new) - mean
    assert rms(errors) < 1e-4
    assert covariance.diagonal(dim1=-2, dim2=-1).sum() < 4 * errors.square().sum()

    def interrupting(task: str, done: int, total: int) -> None:
        if task == "hyper-parameters" and done == 5:
            raise KeyboardInterrupt

    with pytest.warns(DiffeoCalibWarning, match="near row 50") as said:  # it is not opened then
        assert dc.calibrate(THIRD.nominal, rows, progress=interrupting).interrupted
    assert not any("holds for" in str(one.message) for one in said)


def test_a_slow_drift_is_told_from_a_jump() -> None:
    shift = 4e-4 * tensor([0.6, 0.8, 0.0])
    drift = told(POINTS + torch.linspace(0, 1, ROWS, dtype=torch.float64)[:, None, None] * shift)
    (size,) = numbers(r"^the measuring device or the robot's base seems to drift by about ([\d.]+) mm over", drift)
    assert size == pytest.approx(0.4, rel=0.2)
    jump = told(from_row(POINTS, 25, shift), given=False)
    size, row = numbers(r"^the measuring device.* about ([\d.]+) mm near row (\d+)", jump)
    assert size == pytest.approx(0.4, rel=0.3)
    assert row == pytest.approx(25, abs=1)
    assert told(POINTS) is None


def test_a_device_that_turns_and_comes_back_is_named() -> None:
    """0.1 mrad at 3 m for a quarter of the rows was silent, with true errors five times as large."""
    arm = SimulatedArm(1)
    q, points = arm.measure(120, seed=1)
    points[40:70] = points[40:70] @ rotation(tensor([0.0, 6e-5, 8e-5])).mT
    text = said(arm.nominal, dc.Measurements(q, points))
    found = numbers(r"^the measuring device .* moved more than once, near row (\d+) and row (\d+)", text)
    assert found == pytest.approx([40, 70], abs=3)


def test_a_scale_that_changes_is_seen_in_poses() -> None:
    """It moves poses apart and turns none. 2000 ppm from row 30 of 80 on."""
    arm, data, _ = simulated_poses(80)
    poses = data.poses.clone()
    middle = poses[:, :3, 3].mean(0)
    poses[30:, :3, 3] = middle + 1.002 * (poses[30:, :3, 3] - middle)
    text = said(arm.nominal, dc.Measurements.from_poses(data.q, poses))
    found, row = numbers(r"^the scale of the device .* changed by about ([\d.e+]+) ppm.* near row (\d+)", text)
    assert found == pytest.approx(2000, rel=0.3)
    assert row == pytest.approx(30, abs=3)
    assert said(arm.nominal, data) is None


# --- drift with a column of times or temperatures ---------------------------------------------------------------------


DRIFTING = SimulatedArm(seed=0)
OF_DRIFT, OFFSET_RAD = 80, 4e-4


def hours(count: int) -> Tensor:
    """Times in random order, from 3 to 7 h."""
    return 3.0 + 4.0 * drawn(count, seed=1)


def turned(q: Tensor, time: Tensor, offset: float = OFFSET_RAD) -> Tensor:
    """Joint values whose second one is off by ``offset`` between the first hour and the last."""
    moved = q.clone()
    moved[:, 1] += offset * ((time - 3.0) / 4.0 - 0.5)
    return moved


def drifting_rows(offset: float = OFFSET_RAD) -> dc.Measurements:
    q, time = DRIFTING.sample(OF_DRIFT + 60, seed=4), hours(OF_DRIFT + 60)
    points = DRIFTING.true_points(turned(q, time, offset)) + normal(OF_DRIFT + 60, 1, 3, seed=2, size=2e-5)
    return dc.Measurements(q, points, DRIFTING.nominal.joint_names).with_covariates(time=time)


def calibrated(data: object) -> Any:
    return warned(dc.calibrate, DRIFTING.nominal, data, hyperparameters=scales())[0]


def drifts(result: Any) -> list[Drift]:
    return [own for own in result.placement if isinstance(own, Drift)]


@pytest.fixture(scope="module")
def drifted() -> tuple[dc.Measurements, dc.Measurements, Any]:
    """Rows of a fit, others of the same drift, and the calibration."""
    data = drifting_rows()
    return data[:OF_DRIFT], data[OF_DRIFT:], calibrated(data[:OF_DRIFT])


def test_a_joint_offset_that_drifts_is_part_of_the_model(drifted: Any) -> None:
    train, other, result = drifted
    plain = calibrated(train.with_covariates())
    (drift,) = drifts(result)
    (line,) = drift.sentences()
    found = re.search(f"the offset of {DRIFTING.nominal.joint_names[1]} by ([^ ]+)", line)
    assert float(found[1]) == pytest.approx(1e3 * OFFSET_RAD, rel=0.3)
    assert drifts(plain) == []
    assert dc.evaluate(result.model, result.aligned(other)).rms < 0.7 * dc.evaluate(plain.model, other).rms
    assert true_error(result.model, DRIFTING) < true_error(plain.model, DRIFTING)


def test_a_column_with_which_nothing_drifts_changes_nothing() -> None:
    train = drifting_rows(0.0)[:40]
    plain, result = calibrated(train.with_covariates()), calibrated(train)
    assert drifts(result) == []
    assert torch.equal(plain.model(train.q), result.model(train.q))


@pytest.mark.slow
def test_readings_show_a_drift_too() -> None:
    time, still = hours(150), readings(DRIFTING, "height", 150)
    moved = readings(DRIFTING, "height", 150, noise=2e-5, turned=lambda q: turned(q, time, 2 * OFFSET_RAD))
    data = dc.Readings.heights(still.q, moved.values[:, 0], moved.device_names, DRIFTING.nominal.joint_names)
    plain, result = calibrated(data), calibrated(data.with_covariates(time=time))
    assert len(drifts(result)) == 1
    assert true_error(result.model, DRIFTING) < true_error(plain.model, DRIFTING)


def test_rows_are_brought_to_the_middle_of_the_column() -> None:
    """Shift, turn, growth and offsets, written out: effects are slopes, `points` has them, `aligned` undoes them."""
    q, time = DRIFTING.sample(20, seed=3), hours(20)
    geometry = Geometry.nominal(DRIFTING.nominal, 2)
    nominal = GeometryMap(geometry, elastic=True)
    zero = torch.zeros(nominal.parameters, dtype=torch.float64)
    unknowns = normal(13, seed=5)
    size = unknowns * tensor([FRAME_M_RAD] * 6 + [GROWTH] + [OFFSET_RAD_M] * 6)
    a = ((time - time.min()) / (time.max() - time.min()) - 0.5)[:, None]
    plain = nominal(q, zero)
    centre = plain.view(-1, 3).mean(0)
    away = nominal(q + a * size[7:], zero).view(20, 2, 3) - centre
    turn = torch.linalg.cross((a * size[3:6])[:, None].expand_as(away), away)
    moved = away + centre + (a * size[:3])[:, None] + turn + (a * size[6])[..., None] * away
    data = dc.Measurements(q, moved).with_covariates(time=time)
    drift: Any = Drift.of_table(data, DRIFTING.nominal)[0]
    whole = torch.eye(6, dtype=torch.float64).expand(len(plain), 6, 6)
    effects = drift.effects(SimpleNamespace(nominal=nominal, y=plain, points=plain, slopes=whole))
    assert_close(effects @ unknowns, moved.flatten(1) - plain, rtol=0, atol=1e-5)
    constants = torch.cat([drift.devices.constants[:, :2], centre[None], size[None]], 1)
    found = replace(drift.devices, constants=constants, deviations=size[None].abs())
    back = found.undone(data)
    assert_close(nominal(back.q, zero), back.points.flatten(1), rtol=0, atol=1e-5)
    assert back.covariates is None
    assert_close(found.points(lambda q: nominal(q, zero).view(-1, 2, 3), data), moved, rtol=0, atol=1e-5)


def test_a_model_keeps_its_drift(drifted: Any, tmp_path: Path) -> None:
    _, other, result = drifted
    dc.save(result.model, tmp_path / "m.safetensors")
    model = dc.load(tmp_path / "m.safetensors")
    assert isinstance(model, dc.CalibratedKinematics)
    known, told, untold = KnownDrift.of(model), dc.evaluate(model, other), dc.evaluate(model, other.with_covariates())
    assert told.rms == pytest.approx(dc.evaluate(result.model, other).rms, rel=1e-9)
    assert told.rms < 0.7 * untold.rms
    assert "time 5" in " ".join(untold.placed)  # from 3 to 7
    assert list(known.of_joints()) == drifts(result)[0].sentences()
    with torch.inference_mode():
        again = model.registered(other)
    assert KnownDrift.of(again) is None
    assert KnownDrift.of(DRIFTING) is None


def test_beyond_its_rows_a_drift_stays_as_at_the_end(drifted: Any) -> None:
    model = drifted[2].model
    known: Any = KnownDrift.of(model)
    late, last = (drifted[1].with_covariates(time=torch.full((60,), t, dtype=torch.float64)) for t in (900.0, 7.0))
    assert_close(known.points(model, late), known.points(model, last), rtol=0, atol=1e-6)
    (line,) = [line for line in known.in_rows(late) if "outside" in line]
    assert re.search(r"\b60\b", line)
    assert dc.evaluate(model, late).placed[-1] == line
    for end in known.ends["time"]:  # the rows of the fit reach them
        there = drifted[1].with_covariates(time=torch.full((60,), end, dtype=torch.float64))
        assert not [line for line in known.in_rows(there) if "outside" in line]


@pytest.mark.parametrize(("left", "better"), [([0.9] * 100, True), ([1.0] * 99 + [0.0], False), ([0.99] * 100, False)])
def test_a_drift_must_help_most_rows_and_not_one(left: list[float], better: bool) -> None:
    """Left-out errors of 1, with one of 30 in the second case: without it the mean square falls to a tenth."""
    before = torch.ones(100, dtype=torch.float64)
    before[-1] = 1.0 if left[-1] else 30.0
    assert worth_it(before[:, None], before.new_tensor(left)[:, None]) == better
