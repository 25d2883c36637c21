"""A refusal needs a proof: rows that nothing explains better are calibrated, with a warning if they are doubtful."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from product_bank import with_usual_scales
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.plausibility import check_identification, check_joints
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register_inliers
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.simulated_arm import SimulatedArm


def rounded(values: Tensor, step: float) -> Tensor:
    return (values / step).round() * step


def on_a_rail(arm: SimulatedArm) -> dc.Chain:
    rail = Joint("rail", "prismatic", torch.eye(4, dtype=torch.float64), lower=-1.0, upper=1.0)
    return dc.Chain("on a rail", "ground", arm.nominal.tip, [rail, *arm.nominal.joints])


@pytest.mark.filterwarnings("ignore:rail. never moved")
def test_a_rail_that_stands_still_is_calibrated() -> None:
    """Its values, near zero, are near a multiple of any step."""
    arm = SimulatedArm(seed=1)
    q, y = arm.measure(40, seed=2)
    rail = 1e-6 * torch.arange(40, dtype=torch.float64).remainder(53)
    data = dc.Measurements(torch.cat([rail[:, None], q], 1), rounded(y, 1e-6))
    assert with_usual_scales(on_a_rail(arm), data).left_out_rms < 2e-4


def test_poses_commanded_in_whole_degrees_are_calibrated() -> None:
    """An elastic arm that errs by a millimetre, which steps of 1 degree would explain if they were reported so."""
    arm = SimulatedArm(seed=1, gravity=2.0)
    q = rounded(arm.sample(40, 3).rad2deg(), 1.0).deg2rad()
    noise = arm.noise * torch.randn(40, 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    result = with_usual_scales(arm.nominal, dc.Measurements(q, rounded(arm.true_points(q) + noise, 1e-6)))
    assert 5e-4 < result.registration.rms < 5e-3
    assert result.left_out_rms < 0.3 * result.registration.rms
    assert math.isfinite(result.expected.workspace)


def test_a_slide_moves_relative_to_its_stroke() -> None:
    slide = Joint("j3", "prismatic", torch.eye(4, dtype=torch.float64), lower=0.0, upper=0.084)
    turn = Joint("j2", "revolute", torch.eye(4, dtype=torch.float64), lower=-1.0, upper=1.0)
    robot = dc.Chain("small", "a", "b", [turn, slide])
    angles, places = torch.linspace(-1, 1, 9, dtype=torch.float64), torch.zeros(9, 1, 3, dtype=torch.float64)
    moved = dc.Measurements(torch.stack([angles, 0.02 + 0.016 * angles], 1), places)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_joints(robot, moved)
    hardly = dc.Measurements(torch.stack([angles, 0.02 + 0.001 * angles], 1), places)
    with pytest.warns(DiffeoCalibWarning, match="^j3: hardly moved"):
        check_joints(robot, hardly)


def doubted(robot: dc.Tree, data: dc.Measurements) -> None:
    start = register_inliers(robot, data)[0].geometry
    check_identification(data, identify(start, data.q, data.points))


@pytest.mark.slow
def test_rows_that_no_reading_explains_are_warned_about() -> None:
    """A tip before the joint that carries the marker; two joints that count the other way have such a reading."""
    arm = SimulatedArm(seed=1)
    q, y = arm.measure(40, seed=2)
    signs = torch.tensor([1.0, 1.0, -1.0, 1.0, -1.0, 1.0], dtype=torch.float64)
    short = dc.Chain("short", "base_link", "wrist_link", arm.nominal.joints[:-2])
    with pytest.warns(DiffeoCalibWarning, match=r"do not fit this robot, even with .* the tip link or DH convention"):
        doubted(short, dc.Measurements(q[:, :5], y))
    with pytest.raises(MeasurementError, match=r"the rows fit, in degrees and mm, with joints=.*-\{elbow_joint\}"):
        dc.calibrate(arm.nominal, dc.Measurements(q * signs, y))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shuffled", "nominal"])
def test_doubtful_rows_are_calibrated(kind: str) -> None:
    arm = SimulatedArm(seed=1)
    q, y = arm.measure(40, seed=2)
    if kind == "shuffled":
        y = y[torch.randperm(40, generator=torch.Generator().manual_seed(0))]
    else:
        y = arm.nominal(q)[:, None, :3, 3].contiguous()
    with pytest.warns(DiffeoCalibWarning) as caught:
        result = with_usual_scales(arm.nominal, dc.Measurements(q, y))
    assert math.isfinite(result.left_out_rms)
    words = "show no errors of the robot" if kind == "nominal" else "do not fit this robot, even with geometric errors"
    assert any(words in str(one.message) for one in caught)
