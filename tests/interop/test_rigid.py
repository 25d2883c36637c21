"""The best rigid kinematics of a model: exact where the model is rigid, and cross-validated."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from export_bank import rigid_model, wrong
from kind_bank import kind_named
from product_bank import Case, simulated
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.registration import with_joint_offsets
from diffeo_calib.interop.rigid import GEOMETRIC, PROJECTION, best_joint_offsets, rigid_kinematics, with_errors
from diffeo_calib.robots import Geometry


def rms(points: Tensor, others: Tensor) -> float:
    return float((points - others).square().sum(-1).mean().sqrt())


def test_a_rigid_model_is_found_again(arm: Case) -> None:
    """Where nothing but joint errors deforms the robot, rigid kinematics lose nothing, at other configurations too."""
    model = rigid_model(arm.model, wrong(arm.robot, size=1e-3))
    found = rigid_kinematics(model)
    assert (found.how, list(found.validated)) == (PROJECTION, [PROJECTION])
    assert rms(found.geometry.points(arm.test.q), model(arm.test.q)) < 2e-8
    assert found.rms <= found.largest < 1e-8
    assert found.validated[PROJECTION] < 1e-7


def test_the_geometric_calibration_is_taken_where_it_is_better(arm: Case) -> None:
    """The model has 60 poses: joint errors that are exactly the model's beat those that are estimated."""
    truth = wrong(arm.robot, size=1e-3)
    model = rigid_model(arm.model, truth)
    for errors, how in ((truth.joint_errors, GEOMETRIC), (wrong(arm.robot, size=2e-3).joint_errors, PROJECTION)):
        given = dc.CalibratedKinematics(model.robot, model.map, rigid_errors=errors)
        found = rigid_kinematics(given)
        assert found.how == how
        assert set(found.validated) == {GEOMETRIC, PROJECTION}
        assert found.validated[how] == min(found.validated.values())
        assert rms(found.geometry.points(arm.test.q), model(arm.test.q)) < 2e-8


def test_the_projection_is_a_minimum_and_its_numbers_are_those_of_the_geometry(arm: Case) -> None:
    """No change of a joint error by a tenth of its size brings the markers closer by more than the prior costs."""
    model, q, y = arm.model, arm.model.configurations, arm.model(arm.model.configurations)
    found = rigid_kinematics(dc.CalibratedKinematics(model.robot, model.map, model.summary))
    assert found.how == PROJECTION
    assert found.rms == pytest.approx(rms(found.geometry.points(q), y), rel=1e-9)
    assert found.largest == pytest.approx(float((found.geometry.points(q) - y).norm(dim=-1).max()), rel=1e-9)
    assert found.rms < found.validated[PROJECTION] < with_errors(model, None).rms
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        theta = 2e-5 * torch.randn(found.geometry.size, dtype=torch.float64, generator=generator)
        assert rms(found.geometry.points(q, theta), y) > found.rms


@pytest.mark.slow
@pytest.mark.parametrize("name", ["posed", "pair", "slider"])
def test_poses_several_markers_and_slides(name: str, request: pytest.FixtureRequest) -> None:
    model: dc.CalibratedKinematics = request.getfixturevalue(name).model
    found = rigid_kinematics(model)
    assert found.geometry.markers == model.markers
    assert found.rms < with_errors(model, None).rms / 2


@pytest.mark.parametrize("size", [1e-3, 0.2])
def test_joint_offsets_are_found_again(size: float, arm: Case) -> None:
    """Those of the waist and of the last joint are the base's and the marker's: what they say together is the same."""
    offsets = size * torch.tensor([0.0, 1.0, -0.6, 0.3, 0.8, 0.0], dtype=torch.float64)
    model = rigid_model(arm.model, with_joint_offsets(Geometry.nominal(arm.robot), offsets))
    found = best_joint_offsets(model)
    torch.testing.assert_close(found.offsets, offsets, rtol=0, atol=1e-7)
    q = arm.test.q
    assert rms(found.rigid.geometry.points(q), model(q)) < 1e-6
    nominal = replace(found.rigid.geometry, joint_errors=Geometry.nominal(arm.robot).joint_errors)
    assert rms(nominal.points(q + found.offsets), model(q)) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ball in sockets", "distances"])
def test_distances_hold_where_no_row_is(name: str) -> None:
    """Rows in sockets and at one wire show little of the robot: what is said is of the joint ranges."""
    model = kind_named(name).model
    low, high = model.configurations.amin(0), model.configurations.amax(0)
    q = low + (high - low) * torch.rand(400, len(low), dtype=low.dtype, generator=torch.Generator().manual_seed(5))
    found = rigid_kinematics(model)
    assert rms(found.geometry.points(q), model(q).detach()) == pytest.approx(found.validated[found.how], rel=0.15)


@pytest.mark.slow
def test_on_a_real_robot(ur10_150: Case) -> None:
    """Held-out rows of the UR10, 150 rows fitted: 0.40 mm, where the model's geometry left alone leaves 0.6."""
    model, test = ur10_150.model, ur10_150.test
    rigid = rigid_kinematics(model)
    found, alone = (rms(geometry.points(test.q), test.points) for geometry in (rigid.geometry, model.geometry))
    assert found < 0.43e-3 < alone
    assert rigid.validated[rigid.how] == pytest.approx(found, rel=0.15)


@pytest.mark.slow
def test_another_number_of_markers(arm: Case) -> None:
    true, q = simulated(1)[0], arm.test.q[:20]
    markers = torch.tensor([[0.05, 0.0, 0.1], [0.0, -0.06, 0.12]], dtype=torch.float64)
    true.truth = replace(true.truth, tool=markers)
    registered = arm.model.registered(dc.Measurements(q, true.true_points(q)))
    found = rigid_kinematics(registered)
    assert found.geometry.markers == 2
    fitted = rigid_kinematics(arm.model)
    assert found.rms < 2.0 * fitted.rms
