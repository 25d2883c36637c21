"""Calibrations of robots with branches: several tips, loads, and everything that follows from a fitted model."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from numbers_bank import rms
from product_bank import usual_scales
from simulated_body import HANDS, SimulatedUpperBody
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning

pytestmark = pytest.mark.slow  # several calibrations

ROWS = 40


@pytest.fixture(scope="module")
def body() -> SimulatedUpperBody:
    return SimulatedUpperBody(seed=2)


@pytest.fixture(scope="module")
def data(body: SimulatedUpperBody) -> dc.Measurements:
    return dc.Measurements(*body.measure(ROWS), body.nominal.joint_names, on=HANDS)


@pytest.fixture(scope="module")
def model(body: SimulatedUpperBody, data: dc.Measurements) -> dc.CalibratedKinematics:
    return dc.calibrate(body.nominal, data, hyperparameters=usual_scales(body.nominal).inflated(3.0)).model


@pytest.fixture(scope="module")
def q(body: SimulatedUpperBody) -> Tensor:
    return body.sample(100, seed=9)


@pytest.mark.filterwarnings("ignore:errors seem to depend")  # of the chain without the other arm
def test_the_weight_of_the_other_arm_counts(body: SimulatedUpperBody, data: dc.Measurements, q: Tensor) -> None:
    """One hand measured: with the other arm as a load, half the error of the serial chain at most."""
    found = []
    with pytest.warns(DiffeoCalibWarning, match="their weight bends the robot"):
        serial = body.robot(HANDS[:1])
    for robot in (serial, body.robot(HANDS[:1], HANDS[1:])):
        columns = body.columns(robot)
        one = dc.Measurements(data.q[:, columns], data.points[:, :1], robot.joint_names)
        fitted = dc.calibrate(robot, one, hyperparameters=usual_scales(robot).inflated(5.0)).model
        found.append(rms(fitted(q[:, columns]) - body.true_points(q)[:, :1]))
    assert found[1] < 0.6 * found[0]


def test_commands_of_one_arm_leave_the_other_alone(model: dc.CalibratedKinematics, q: Tensor) -> None:
    start, names = q[:20], model.robot.joint_names
    left = model.with_tool(None, tip="left_hand")
    targets = left.tool_poses(start)
    targets[:, :3, 3] += 0.002
    found = dc.compensate(left, targets, start)
    torch.testing.assert_close(left.tool_poses(found.q), targets, rtol=0, atol=1e-6)
    right = [names.index(name) for name in names if name.startswith("right")]
    own = (found.q - start)[:, [k for k in range(17) if k not in right]].norm(dim=1)
    assert float((found.q - start)[:, right].norm(dim=1).max()) < 1e-6 * float(own.max())
    beyond = targets.clone()
    beyond[:, 0, 3] += 0.05  # no correction within the bound gets there, and the other arm would help by its weight
    missed = dc.compensate(left, beyond, start)
    assert not bool(missed.reached.any())
    assert float((missed.q - start)[:, right].abs().max()) < 1e-6


def test_markers_say_on_which_tip_they_are(body: SimulatedUpperBody, data: Any, model: Any) -> None:
    def calibrated(on: Any) -> Callable[[], object]:
        return lambda: dc.calibrate(body.nominal, data.with_tips(on))

    refused(
        (r"has 2 tips .* do not say on which .* pass Measurements\(..., on=", calibrated(None)),
        (r"expected names among .*, got \['left_hand', 'tail'\]", calibrated(["left_hand", "tail"])),
        ("the markers on 'left_hand' and 'right_hand' seem to be exchanged", calibrated(HANDS[::-1])),
        ("`on`: expected 2 names, got 1", lambda: data.with_tips(["left_hand"])),
        ("on other tips than the model's", lambda: dc.evaluate(model, data.with_tips(HANDS[::-1]))),
    )
    assert dc.evaluate(model, data.with_tips(None)).rms == dc.evaluate(model, data).rms
