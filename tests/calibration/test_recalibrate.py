"""A robot that is measured again, by rows of any kind: old and new rows make one model, and changes are named."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import again_bank
import pytest
import torch
from again_bank import ELSEWHERE, FACTOR, WORN, fitted, positions, true_error
from campaigns import CAMPAIGNS
from deformation_bank import made
from kind_bank import kind_named
from numbers_bank import normal, tensor
from product_bank import Case, covered, simulated, simulated_poses, ur10_measurements, ur10_scales, with_usual_scales
from reading_bank import readings
from source_bank import laden, resting
from table_bank import refused, warned
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.recalibration.drift import grown, parts_of
from diffeo_calib.calibration.recalibration.find_changes import NOISE_FACTORS, SIZES, likelihood_ratios
from diffeo_calib.calibration.recalibration.register import place_again, weighed
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms, twist_transform

pytestmark = pytest.mark.slow  # fits by the dozen
few_rows = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")
ARM, JOINTS, NEW = again_bank.arm(), again_bank.arm().nominal.joint_names, 30
THERE = transforms(rotation(tensor([0.3, -2.0, 0.7])), tensor([1.5, -0.4, 0.2]))
"""A measuring frame far from the first one."""
TRIPOD = twist_transform(tensor([2e-3, -1e-3, 0.5e-3, 1e-3, -2e-3, 0.5e-3]))
old = again_bank.model


def measured(robot: SimulatedArm = ARM, rows: int = NEW, seed: int = 5) -> dc.Measurements:
    return positions(robot, rows, seed, THERE)


def of_ball(kind: str, robot: SimulatedArm = ARM, rows: int = 2 * NEW, seed: int = 5, mass: Any = None) -> Any:
    found = readings(robot, kind, rows, noise=2e-5, seed=seed, payload=mass)
    return found if mass is None else found.with_payload(mass)


def with_tool(*shift: float, robot: SimulatedArm = ARM) -> SimulatedArm:
    """The arm with its marker elsewhere, m."""
    other = copy.copy(robot)
    other.truth = replace(robot.truth, tool=robot.truth.tool + tensor(shift))
    return other


@cache
def again() -> dc.Recalibration:
    """The arm after a move of the device."""
    return dc.recalibrate(old(), measured())


def two_sessions() -> dc.Measurements:
    """The tripod is moved by 2 mm after half of the rows."""
    parts = positions(ARM, 15, 5), positions(ARM, 15, 55, ELSEWHERE @ TRIPOD)
    return dc.Measurements.joined(parts).with_sessions(["before"] * 15 + ["after"] * 15)


OTHERWISE: dict[str, tuple[str, Callable[[], Any]]] = {
    "positions, then two sessions": ("", two_sessions),
    "positions, then sockets": ("", lambda: resting(ARM, 3, 5)),
    "positions, then heights": ("", lambda: of_ball("height")),
    "heights, then a tracker": ("heights", lambda: positions(ARM, NEW, 5)),
    "sockets, then distances": ("ball in sockets", lambda: of_ball("distance")),
}
"""Measured in one way and then in another: the kind of the model, and new rows of the same robot."""


def model(kind: str) -> dc.CalibratedKinematics:
    return kind_named(kind).model if kind else old()


@cache
def recalibrated(name: str) -> dc.Recalibration:
    kind, rows = OTHERWISE[name]
    return warned(dc.recalibrate, model(kind), rows())[0]


def rms(model: Any, robot: SimulatedArm = ARM) -> float:
    """Of further rows in the new place."""
    return dc.evaluate(model, measured(robot, 100, 6)).rms


# --- the same robot ---------------------------------------------------------------------------------------------------


def test_new_rows_add_to_what_the_old_model_knew() -> None:
    found, error = again(), rms(again().model)
    assert error < 0.9 * rms(old().registered(measured(), learn=False))
    assert error < 0.7 * rms(fitted(measured()))
    assert 0.9 < covered(found.model, measured(rows=100, seed=6)) <= 1.0
    assert (found.marker, found.outliers, found.changes.found) == ("same", (), ())
    assert 1.0 <= found.inflation < 1.5
    assert "no change was found" in found.status
    assert found.moved is not None
    assert_close(found.moved.transform, THERE @ torch.linalg.inv(ELSEWHERE), rtol=0.0, atol=1e-3)
    assert found.left_out_rms == pytest.approx(error, rel=0.6)


def test_recalibrated_once_more() -> None:
    """Rows of three sessions, each in its own frame."""
    short = replace(again().model.map, unresolved=torch.ones(6, dtype=torch.float64))
    found = dc.recalibrate(again().model.changed(map=short), positions(ARM, NEW, 7), drift="none")
    assert_close((more := found.model).map.unresolved, found.inflation * short.unresolved)
    assert dc.evaluate(more, positions(ARM, 100, 6)).rms < rms(again().model)
    assert len(more.configurations) == len(old().configurations) + 2 * NEW


def test_old_rows_and_new_rows_together_are_one_calibration() -> None:
    """In the same place, with the same scales: as accurate as if all rows had been measured at once."""
    new, test = positions(ARM, 40, 8), positions(ARM, 100, 9)
    once = fitted(dc.Measurements.joined([positions(ARM, len(old().configurations), 1), new]))
    twice = dc.recalibrate(old(), new, drift="none").model
    assert dc.evaluate(twice, test).rms < 1.08 * dc.evaluate(once, test).rms


@few_rows
@pytest.mark.parametrize("name", OTHERWISE)
def test_new_rows_of_another_kind_make_the_model_better(name: str) -> None:
    found = recalibrated(name)
    assert true_error(found.model, ARM) < true_error(model(OTHERWISE[name][0]), ARM)
    assert found.fit.converged
    assert (found.marker, found.changes.found) == ("same", ())
    assert found.rms_after <= found.rms_before


def test_every_session_has_its_own_frame() -> None:
    frames: Any = next(iter(recalibrated("positions, then two sessions").placement))
    assert frames.names == ("before", "after")
    between = ELSEWHERE @ TRIPOD @ torch.linalg.inv(ELSEWHERE)
    between = between if frames.reference == 0 else torch.linalg.inv(between)
    assert_close(frames.transforms[1 - frames.reference][:3, :3], between[:3, :3], rtol=0, atol=3e-4)


def test_a_ball_the_model_does_not_know_is_one_more_marker() -> None:
    found = recalibrated("positions, then sockets").model
    assert (found.markers, found.ball) == (2, True)
    assert_close(found.geometry.tool[1], found.geometry.tool[0], rtol=0, atol=2e-3)  # the same one here


@few_rows
def test_old_rows_of_readings_keep_their_payloads() -> None:
    """Heights are linear in the points: rows linearised around the fit are the measured ones but for each plane."""
    masses = tensor([0.0, 4.0, 10.0])[torch.arange(60) // 3 % 3]
    first = fitted(of_ball("height", seed=1, mass=masses))
    away = first.map.linearised_rows()[1] - first.map.measured()
    for device in range(3):  # devices take turns
        assert_close(away[device::3], away[device::3].mean().expand_as(away[device::3]), rtol=0, atol=1e-6)
    again = dc.recalibrate(first, of_ball("height", rows=30, mass=masses[:30])).model
    for mass in (0.0, 10.0):
        before, after = (true_error(one.with_payload(mass), ARM, mass) for one in (first, again))
        assert after < 1.1 * before


@few_rows
def test_a_recalibrated_model_keeps_its_devices() -> None:
    """Beside the robot in the new frame; what new rows see as these say: one has moved by 3 mm."""
    kind = kind_named("several kinds")
    rows, q = kind.moved, kind.q(30)
    seen, heights = (part for part in rows.parts if part.kind in ("position", "height"))
    new = dc.Observations.joined([seen, replace(heights, values=heights.values + 3e-3)])
    before, after = (one.predict_readings(q) for one in (kind.model, dc.recalibrate(kind.model, new).model))
    assert [(one.kind, one.device) for one in after] == [(one.kind, one.device) for one in before]
    for one, other in zip(before, after, strict=True):
        further = 3.0 * (one.kind == "height")
        allowed = 5 * (one.deviations.square() + other.deviations.square()).sqrt()
        assert bool(((other.mean - one.mean - further).abs() < allowed)[one.mean.isfinite()].all()), one.device


def test_a_ur10_measured_again(ur10_folder: Path) -> None:
    """Two series of one robot, in different set-ups and joint ranges: regions of 95 % nearly hold in the other one."""
    robot, data = ur10_measurements(ur10_folder)
    csv, columns = ur10_folder / "measurements_grid_900.csv", [f"measurement_{axis}" for axis in "xyz"]
    before = dc.read_measurements(csv, robot, columns, length="mm", angle="rad", sep=";", decimal=",")
    first = dc.calibrate(robot, before[::8], hyperparameters=ur10_scales()).model
    new, test = data.split(30 / len(data), seed=0)
    found = dc.recalibrate(first, new)
    assert dc.evaluate(found.model, test).rms < 0.9 * dc.evaluate(first.registered(new, learn=False), test).rms
    assert covered(found.model, test) > 0.83


# --- what has changed -------------------------------------------------------------------------------------------------


def test_a_worn_joint_is_named_and_followed(arm: Case) -> None:
    """With scales that were found for this arm: those of others know too little of what it may do."""
    worn = simulated(1)[0].worn(1, 2.0)
    new, test = measured(worn, 20), measured(worn, 100, 6)
    found = dc.recalibrate(arm.model, new)
    (change,) = found.changes.found
    joints, _, amplitudes, _ = worn._waves
    assert (change.part, change.angle) == ("shoulder_joint", True)
    assert change.probability < 0.01
    assert change.size == pytest.approx(float(amplitudes[joints == 1].norm()) / 2 / 2**0.5, rel=0.5)
    assert "shoulder_joint has changed by 0." in found.status
    with pytest.warns(DiffeoCalibWarning, match="times as large as the model leads to expect"):
        still = dc.recalibrate(arm.model, new, drift="none")
    assert dc.evaluate(found.model, test).rms < 0.5 * dc.evaluate(still.model, test).rms
    assert 0.88 < covered(found.model, test) <= 1.0
    new = measured(ARM.worn(2, 3.0), 30, 700)
    new = new.rows(new.q[:, 2].argsort()).with_line_numbers(range(30))  # in their order the error looks like a drift
    assert not any("seems to" in one for one in warned(old().registered, new)[1])


@few_rows
@pytest.mark.parametrize("name", ["payloads", "heights"])
def test_a_worn_joint_is_found_by_rows_of_other_kinds(name: str) -> None:
    """60 rows in sockets leave 0.5 mm, and distances show a change of no joint."""
    worn = SimulatedArm(seed=int(name == "payloads")).worn(WORN, FACTOR)
    found: Any = dc.compare(model(name), laden(worn, NEW, 5) if name == "payloads" else of_ball("height", worn, NEW))
    (change,) = found.changes.found
    assert change.part == JOINTS[WORN]
    assert str(found).startswith(f"{change.part} has changed")
    assert 1e-4 < change.size < 2e-3
    assert change.displacement > 1e-5


@pytest.mark.parametrize(("size", "named"), [(0.2, True), (0.015, False)])
def test_a_change_of_everything_is_followed_named_or_not(arm: Case, size: float, *, named: bool) -> None:
    """Geometry and transmissions: where a named geometry alone might differ the errors are 1.5 times as large."""
    aged = copy.copy(simulated(1)[0])
    theta, own = torch.zeros(aged.truth.size, dtype=torch.float64), aged.truth.slices["joints"]
    theta[own] = normal(own.stop - own.start, seed=3, size=1e-3 * size)
    aged.truth = aged.truth.absorb(theta)
    joints, waves, amplitudes, phases = aged._waves
    aged._waves = joints, waves, amplitudes * (1 + normal(len(amplitudes), seed=4, size=2 * size)), phases
    new, test = measured(aged, 20), measured(aged, 100, 6)
    found = dc.recalibrate(arm.model, new)
    assert ("geometry" in [change.part for change in found.changes.found]) == named
    assert dc.evaluate(found.model, test).rms < 0.14e-3
    still = 1.0 if named else dc.evaluate(dc.recalibrate(arm.model, new, drift="none").model, test).rms
    assert dc.evaluate(found.model, test).rms < 0.95 * still
    assert 0.9 < covered(found.model, test) <= 1.0


def test_another_tool_of_a_worn_robot_is_found() -> None:
    """Large errors are no reason to seek the marker at its old place, 110 mm away."""
    worn = with_tool(0.1, -0.05, 0.03, robot=ARM.worn(1, 12.0))
    found = dc.recalibrate(old(), measured(worn, 12))
    assert found.marker == "other"
    assert "shoulder_joint has changed by 2." in found.status
    assert rms(found.model, worn) < 1e-3
    assert covered(found.model, measured(worn, 100, 6)) > 0.8  # though the joint errs by 25 times what it did
    sister = SimulatedArm(7)
    found, _ = warned(dc.recalibrate, old(), measured(sister, 12))
    assert covered(found.model, measured(sister, 100, 6)) > 0.88  # all parts differ by more than their old errors


@few_rows
@pytest.mark.parametrize("name", ["", "distances"])
def test_another_marker_or_ball_is_neither_a_change_nor_a_contradiction(name: str) -> None:
    robot = with_tool(0.03, -0.12, 0.1)
    found = dc.recalibrate(model(name), of_ball("distance", robot) if name else positions(robot, 2 * NEW, 5))
    assert (found.marker, found.changes.found, found.outliers) == ("other", (), ())
    assert true_error(found.model, robot) < true_error(model(name), ARM)


def test_outliers_hardly_count() -> None:
    rows, points = measured(), measured().points.clone()
    for row, sign in {0: -1, 3: 1, 5: -1, 10: 1}.items():  # that everything has changed explains them less well
        points[row] += sign * tensor([0.003, -0.004, 0.0])
    spoilt = dc.recalibrate(old(), dc.Measurements(rows.q, points))
    assert spoilt.outliers == (0, 3, 5, 10)
    assert rms(spoilt.model) < 1.2 * rms(again().model)
    assert spoilt.inflation < 1.5 * again().inflation  # regions are those of the robot, not of the wrong row


@few_rows
def test_a_session_that_deviates_is_a_change_and_no_outliers() -> None:
    """A joint wears between two of three sessions."""
    worn, names = ARM.worn(WORN, 5.0), ["a"] * 16 + ["b"] * 16 + ["c"] * 12
    parts = (ARM, 16, 5), (ARM, 16, 6), (worn, 12, 7)
    rows: Any = dc.Measurements.joined([positions(*part) for part in parts])
    with pytest.warns(DiffeoCalibWarning, match="session 'c' deviates"):
        found: Any = dc.recalibrate(old(), rows.with_sessions(names))
    assert [(one.part, one.where) for one in found.changes.found] == [(JOINTS[WORN], "session 'c'")]
    (block,) = dc.compare(old(), rows).changes.found
    assert block.where in {f"rows {first} to 43" for first in (32, 33, 34)}


OFFSET = 1e-3
"""Of a joint, rad."""


def with_offset(data: dc.Measurements, joint: int, size: float = OFFSET) -> dc.Measurements:
    """Rows whose encoder of a joint reads too little."""
    q = data.q.clone()
    q[:, joint] -= size
    return dc.Measurements(q, data.points, data.joint_names)


@pytest.mark.parametrize(("joint", "what"), [(0, "device"), (5, "markers")])
def test_offsets_that_places_hide_are_named(joint: int, what: str) -> None:
    (found,) = dc.compare(old(), with_offset(positions(ARM, 24, seed=5), joint)).hidden
    assert found.joint == JOINTS[joint]
    assert found.size == pytest.approx(OFFSET, abs=4 * found.deviation)
    assert found.deviation < 0.3 * OFFSET
    assert what in str(found)


def test_the_smallest_offset_that_rows_show() -> None:
    rows = positions(ARM, 24, seed=5)
    unchanged = dc.compare(old(), rows)
    assert unchanged.hidden == ()
    waist, _, elbow, *_ = unchanged.changes.smallest
    assert waist.size == inf  # the device's place hides it
    rigid = replace(old().map.geodesic.spec, joint_kernel=old().map.geodesic.spec.joint_kernel.scaled(0.0))
    sizes = {number: size for part in parts_of(old().map) for number, size in part.kernels.items()}
    assert [float(grown(rigid, parts_of(old().map))[0].terms[number].variance) for number in sizes] == [*sizes.values()]
    assert 2e-5 < elbow.size < 3e-4
    for factor in (0.2, 1.5):
        found = dc.compare(old(), with_offset(rows, 2, factor * elbow.size)).changes.found
        assert [one.part for one in found] == [f"the offset of {elbow.joint}"] * (factor > 1)
        for one in found:
            assert one.others == ()
            assert one.deviation is not None
            assert abs(one.size - factor * elbow.size) < 4 * one.deviation < 4e-4


def test_a_change_between_two_models_is_named() -> None:
    """An offset, or wear; tests/test_matrix.py compares models between which nothing changed."""
    offset = with_offset(positions(ARM, 40, seed=7), 2, 0.4 * OFFSET)
    for rows, part in ((offset, f"the offset of {JOINTS[2]}"), (positions(ARM.worn(2, 3.0), 40, seed=7), JOINTS[2])):
        compared = dc.compare(old(), with_usual_scales(ARM.nominal, rows).model)
        assert compared.rms > 2.0 * compared.expected  # a change does not explain itself
        assert compared.telling
        (one,) = compared.changes.found
        assert one.part == part
        assert one.deviation is None or one.size == pytest.approx(0.4 * OFFSET, abs=4 * one.deviation)
        assert one.part in str(compared)


def test_places_that_a_fit_left_open_explain_no_difference_of_models() -> None:
    """With a tool that only turns about the vertical its height is open, by decimetres, and found anew."""
    q = CAMPAIGNS["tool turned about the vertical"](ARM, 30, torch.Generator().manual_seed(3))
    upright, _ = warned(with_usual_scales, ARM.nominal, dc.Measurements(q, ARM.true_points(q), doubt=False))
    compared = dc.compare(upright.model, old())
    assert compared.expected < 1e-3
    assert not compared.changes.found
    assert rms(warned(upright.model.registered, measured(rows=20))[0]) < 0.6e-3  # held to its old height, 1 mm


def test_a_model_with_payloads_is_compared_with_one_without_any_under_none() -> None:
    loaded, plain = model("payloads"), model("positions")
    for pair in ((loaded, plain), (plain, loaded)):
        found = dc.compare(*pair)
        assert found.payload == 0.0
        assert found.rms < 3.0 * found.expected
        assert str(found).startswith("with a payload of 0")


def test_ratios_are_those_of_the_definition() -> None:
    """Largest densities over all levels of noise and sizes of the change, with explicit matrices."""
    shapes, roots, noise = normal(18, 4), {"a": normal(6, 3, 2, seed=1), "b": normal(6, 3, 1, seed=2)}, normal(6, 3, 5)
    base, noise = shapes @ shapes.T, noise @ noise.mT
    residual = 3.0 * roots["a"] @ normal(2, seed=3) + normal(6, 3, seed=4)
    seen = torch.ones_like(residual, dtype=torch.bool)
    given = SimpleNamespace(C=base, slopes=base[:, :0], prior=base[:0, :0])
    rows: Any = SimpleNamespace(weighted_noise=noise, visible=seen, residual=residual, given=given)
    found, level = likelihood_ratios(rows, roots, seed=0)

    def densities(root: Tensor, sizes: Tensor) -> Tensor:  # (noise, sizes)
        columns = root.flatten(0, 1)
        levels = base + NOISE_FACTORS[:, None, None] * torch.block_diag(*noise)
        covariances = levels[:, None] + sizes[:, None, None] * (columns @ columns.T)
        return MultivariateNormal(torch.zeros_like(residual.flatten()), covariances).log_prob(residual.flatten())

    without = densities(roots["a"], torch.zeros(1, dtype=torch.float64))
    assert level**2 == pytest.approx(float(NOISE_FACTORS[without[:, 0].argmax()]))
    for name, root in roots.items():
        best = densities(root, SIZES).amax(0)
        assert found[name].value == pytest.approx(2.0 * float(best.max() - without.max()), rel=1e-6)
        assert found[name].variance == pytest.approx(float(SIZES[best.argmax()]))


def test_known_noise_of_the_new_rows_counts() -> None:
    noisy = dc.Measurements(measured().q, measured().points + normal(NEW, 1, 3, seed=3, size=1e-3), std=1e-3)
    found = dc.recalibrate(old(), noisy, drift="none")
    assert found.outliers == ()
    assert covered(found.model, measured(rows=200, seed=6)) > 0.9
    noisy.std[0] *= 2.0  # by which rows differ, whatever a usual row errs by
    noise = weighed(place_again(old(), with_attributes(noisy, std=1e-2 * noisy.std)), "same").noise
    assert_close(noise[0] - noise[1], 3e-10 * torch.eye(3, dtype=torch.float64), rtol=1e-4, atol=1e-14)


def test_what_is_warned_about() -> None:
    turns = (THERE @ ARM.truth.base @ ARM.nominal(measured().q))[:, :3, :3]
    places = measured().points + 1e-3 * turns[:, None, :, 0], 1.006 * measured().points
    remounted, large = (with_attributes(measured(), points=points) for points in places)
    other = measured(SimulatedArm(seed=9))
    for words, verb, rows, options in (
        (r"are 1\.00\d\d times those that the model predicts; check the scale", dc.compare, large, {}),
        ("of 30 new rows contradict .*belongs to this robot", dc.recalibrate, other, {"drift": "none"}),
        (r'markers have moved by .* mm, although marker="same"', dc.compare, remounted, {"marker": "same"}),
    ):
        _, texts = warned(verb, old(), rows, **options)
        assert any(re.search(words, one) for one in texts), texts


def test_interrupted_work_leaves_no_model() -> None:
    def interrupt(task: str, done: int, total: int) -> None:
        if task == "Gauss-Newton":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dc.recalibrate(old(), measured(), drift="none", progress=interrupt)


def test_what_is_refused(tmp_path: Path) -> None:
    new, first = measured(), positions(ARM, len(old().configurations), 1)
    still = dc.Measurements(new.q[:1].repeat(8, 1), new.points[:1].repeat(8, 1, 1), doubt=False)
    posed = kind_named("poses")
    dc.save(old().registered(new), tmp_path / "model")
    learnt: Any = dc.load(tmp_path / "model")
    placed, ball = learnt.registered(measured(rows=15, seed=6), learn=False), resting(ARM, 3, 5)

    def again(rows: Any = new, model: Any = None, **options: Any) -> Callable[[], object]:
        return lambda: dc.recalibrate(model or old(), rows, **options)

    refused(
        ("fitted to 60 of these 60 measurements: they would count twice; pass rows", again(first)),
        ("fitted to 30 of these 30 measurements: they would count twice; pass rows", again(model=learnt)),
        ("they would count twice", again(model=placed)),
        ("`marker`", again(marker="glued")),
        ("`drift`", again(drift="all")),
        ("seed", again(seed=-1)),
        ("the new rows: expected dc.Measurements", again("table.csv")),
        ("`model`", again(model="model.safetensors")),
        (r"expected 1 marker\(s\), got 2 marker.*register", again(simulated(9, markers=2)[1])),
        (r"expected 1 marker\(s\), got poses.*register", again(simulated_poses(9)[1])),
        ("the new rows: expected poses", again(ball.with_joint_names(posed.robot.joint_names), posed.model)),
        (
            r"no place of device and markers explains these rows.*`length`",
            again(dc.Measurements(new.q, 1e3 * new.points, doubt=False)),
        ),
        (r"do not tell where the measuring device stands.*several joints", lambda: dc.compare(old(), still)),
        ("models of one robot", lambda: dc.compare(old(), made("slides"))),
    )
