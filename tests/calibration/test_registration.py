"""Registration: any frame and marker is found, from few poses, and undetermined directions are reported."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from pathlib import Path

import pytest
import torch
from product_bank import ur10_measurements
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.robots import Geometry, SimulatedArm, from_dh
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import twist_transform

ARM = SimulatedArm()


def draw(*shape: int, seed: int = 0, size: float = 1.0) -> Tensor:
    return size * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def somewhere(seed: int, markers: int = 1) -> Geometry:
    """The simulated arm's nominal chain, metres away in any orientation, with markers within centimetres."""
    base = torch.eye(4, dtype=torch.float64)
    base[:3, :3] = torch.linalg.qr(draw(3, 3, seed=seed)).Q
    base[:3, 0] *= torch.linalg.det(base[:3, :3])
    base[:3, 3] = draw(3, seed=seed + 1, size=3.0)
    return replace(Geometry.nominal(ARM.nominal, markers), base=base, tool=draw(markers, 3, seed=seed + 2, size=0.1))


@pytest.mark.parametrize("markers", [1, 3])
@pytest.mark.parametrize("seed", range(12))
def test_registration_finds_any_frame_and_marker(seed: int, markers: int) -> None:
    truth, q = somewhere(seed, markers), ARM.sample(12, seed)
    found = register(ARM.nominal, q, truth.points(q))
    torch.testing.assert_close(found.geometry.base, truth.base, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.geometry.tool, truth.tool, rtol=0, atol=1e-9)
    assert found.rms < 1e-12
    assert found.status.startswith("converged")


def test_registration_does_not_depend_on_the_frame_of_the_data() -> None:
    q, points = ARM.measure(40)
    first = register(ARM.nominal, q, points)
    for seed in range(20):
        move = somewhere(100 + seed).base
        again = register(ARM.nominal, q, points @ move[:3, :3].mT + move[:3, 3])
        torch.testing.assert_close(again.geometry.base, move @ first.geometry.base, rtol=0, atol=1e-9)
        torch.testing.assert_close(again.geometry.tool, first.geometry.tool, rtol=0, atol=1e-9)
        assert again.rms == pytest.approx(first.rms, rel=1e-9)


def test_registration_is_a_minimum_and_reports_its_deviations() -> None:
    q, points = ARM.measure(60)
    found = register(ARM.nominal, q, points)
    geometry, parts = found.geometry, found.geometry.slices
    gradient = torch.einsum("npa,npak->k", geometry.points(q) - points, geometry.sensitivities(q))
    assert gradient[parts["base"]].abs().max() < 1e-10
    weight = 60 * found.rms**2 / 3 / PLACES.marker_m**2  # of the prior, as much as all rows
    torch.testing.assert_close(gradient[parts["tool"]], -weight * geometry.tool.flatten(), rtol=1e-3, atol=1e-10)
    assert bool((found.deviations[parts["joints"]] == 0).all())
    assert bool((found.deviations[parts["base"]] > 0).all())
    assert "mm RMS" in found.status


def test_registration_keeps_the_joint_errors_it_is_given() -> None:
    truth = somewhere(3)
    truth = replace(truth, joint_errors=twist_transform(draw(6, 6, size=0.02)))
    q = ARM.sample(15)
    found = register(replace(truth, base=torch.eye(4), tool=torch.zeros(2, 3)), q, truth.points(q))
    torch.testing.assert_close(found.geometry.base, truth.base, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.geometry.joint_errors, truth.joint_errors)


def test_registration_from_four_poses_needs_its_many_starts() -> None:
    # With so few poses a single start, even the linear solution, sometimes ends in another local minimum.
    for seed in range(60):
        truth, q = somewhere(seed), ARM.sample(4, seed)
        found = register(ARM.nominal, q, truth.points(q))
        torch.testing.assert_close(found.geometry.base, truth.base, rtol=0, atol=1e-6)
        assert found.rms < 1e-12


def test_three_poses_of_one_marker_fit_in_several_ways_and_the_status_says_so() -> None:
    truth, q = somewhere(7), ARM.sample(3)
    found = register(ARM.nominal, q, truth.points(q))
    assert found.rms < 1e-12
    assert "only as many coordinates as unknowns" in found.status


@pytest.mark.parametrize(("markers", "poses"), [(1, 4), (2, 3), (3, 2)])
def test_registration_from_few_poses_predicts_them(markers: int, poses: int) -> None:
    truth, q = somewhere(7, markers), ARM.sample(poses, 5)
    assert register(ARM.nominal, q, truth.points(q)).rms < 1e-9


@pytest.mark.parametrize(("markers", "poses", "need"), [(1, 2, 3), (2, 1, 2), (3, 1, 2)])
def test_too_few_poses_are_explained(markers: int, poses: int, need: int) -> None:
    truth, q = somewhere(7, markers), ARM.sample(poses)
    message = f"cannot be found: expected at least {need} poses, got {poses}, that is {3 * markers * poses} coordinates"
    with pytest.raises(MeasurementError, match=message):
        register(ARM.nominal, q, truth.points(q))


def test_joints_that_never_move_leave_directions_undetermined() -> None:
    truth, q = somewhere(8), ARM.sample(30)
    q[:, 5] = 0.3  # the wrist tells nothing about the marker, but the other joints do
    found = register(ARM.nominal, q, truth.points(q))
    torch.testing.assert_close(found.geometry.tool, truth.tool, rtol=0, atol=1e-9)
    q[:] = q[0]
    stuck = register(ARM.nominal, q, truth.points(q))
    assert stuck.rms < 1e-9
    assert "6 of 9 directions of base and markers undetermined" in stuck.status
    assert identify(stuck.geometry, q, truth.points(q)).rms < 1e-6


def test_planar_arm_attributes_undetermined_directions_to_the_base() -> None:
    planar = from_dh([(0.5, 0, 0), (0.4, 0, 0), (0.2, 0, 0)], name="planar")
    base = somewhere(9).base
    truth = replace(Geometry.nominal(planar), base=base, tool=torch.tensor([[0.03, -0.02, 0.0]]))
    q = draw(40, 3)
    found = register(planar, q, truth.points(q))
    torch.testing.assert_close(found.geometry.base, base, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.geometry.tool, truth.tool, rtol=0, atol=1e-9)
    assert "1 of 9 directions" in found.status


def test_gantry_that_never_turns() -> None:
    slides = [(0, pi / 2, 0, pi / 2, "prismatic"), (0, pi / 2, 0, pi / 2, "prismatic"), (0, 0, 0, 0, "prismatic")]
    gantry = from_dh(slides, name="gantry")
    truth = replace(Geometry.nominal(gantry), base=somewhere(10).base)
    q = draw(20, 3)
    found = register(gantry, q, truth.points(q))
    torch.testing.assert_close(found.geometry.base, truth.base, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.geometry.tool, torch.zeros(1, 3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert "3 of 9 directions" in found.status


def test_a_ur10(ur10_folder: Path) -> None:
    robot, data = ur10_measurements(ur10_folder)
    assert 1e3 * register(robot, data.q, data.points).rms < 0.774
    train, test = data.split(0.7, seed=0)
    geometry = register(robot, train.q, train.points).geometry
    assert 1e3 * dc.evaluate(geometry.points, test).rms < 0.82
