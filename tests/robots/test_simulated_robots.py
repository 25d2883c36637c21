"""Simulated robots: the planar test bed against its published numbers, the arm against its known errors."""

from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import SimulatedArm, elastic_rr
from diffeo_calib.robots.simulated_arm import COMPLIANCE, PAYLOAD_CENTRE


def uniform(count: int) -> torch.Tensor:
    return 2 * pi * torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - pi


def test_error_of_the_nominal_model() -> None:
    x = uniform(100_000)
    error = (elastic_rr.nominal(x) - elastic_rr.real(x)).norm(dim=1)
    assert float(error.mean()) == pytest.approx(0.108, abs=5e-4)
    assert float(error.max()) == pytest.approx(0.184, abs=5e-4)


def test_gravity_torques_agree_with_pinocchio(tmp_path: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    arm = SimulatedArm(payload=6.0)
    arm.write_urdf(tmp_path / "arm.urdf")
    model = pin.buildModelFromUrdf(str(tmp_path / "arm.urdf"))
    flange = model.frames[model.getFrameId("flange")]
    held = pin.Inertia(6.0, np.array(PAYLOAD_CENTRE), np.eye(3))
    model.appendBodyToJoint(flange.parentJoint, held, flange.placement)
    data = model.createData()
    q = arm.sample(20)
    expected = np.stack([pin.computeGeneralizedGravity(model, data, row) for row in q.numpy()])
    # Pinocchio gives the torque that holds the arm; ours is the opposite one, of gravity.
    torch.testing.assert_close(arm.gravity_torques(q), -torch.from_numpy(expected), rtol=0, atol=1e-10)


def test_the_parts_add_up() -> None:
    arm = SimulatedArm(seed=4, markers=2)
    q = arm.sample(50)
    parts = arm.components(q)
    expected = arm.truth.points(q + parts.transmission + parts.gravity)
    torch.testing.assert_close(arm.true_points(q), expected)
    torch.testing.assert_close(parts.gravity, arm.gravity_torques(q) * torch.tensor(COMPLIANCE, dtype=torch.float64))
    bare = SimulatedArm(seed=4, markers=2, geometry=0, transmission=0, gravity=0)
    torch.testing.assert_close(parts.geometry, arm.truth.points(q) - bare.true_points(q))
    assert not bare.components(q).transmission.any()
    assert not bare.components(q).gravity.any()
    for part, least, most in (("geometry", 5e-4, 5e-3), ("transmission", 1e-4, 5e-4), ("gravity", 1e-4, 2e-3)):
        assert least < float(getattr(parts, part).abs().mean()) < most  # as those of real arms


def test_noise_and_wrong_options() -> None:
    arm = SimulatedArm(noise=2e-5, markers=3)
    q, points = arm.measure(2000, seed=1)
    assert float((points - arm.true_points(q)).std()) == pytest.approx(2e-5, rel=0.03)
    lower, upper = arm.nominal.limits.unbind(1)
    assert bool(((q >= lower) & (q <= upper)).all())
    wrong: list[dict[str, Any]] = [{"noise": -1.0}, {"gravity": -0.5}, {"markers": 0}, {"payload": float("nan")}]
    for options in wrong:
        with pytest.raises(InputError, match="of the simulated arm"):
            SimulatedArm(**options)


def test_transmission_errors_of_one_joint_each() -> None:
    arm = SimulatedArm()
    q = arm.sample(20)
    error = arm.components(q).transmission
    torch.testing.assert_close(arm.components(q + 2 * pi).transmission, error, rtol=0, atol=1e-15)
    moved = q.clone()
    moved[:, 2] += 0.5
    change = (arm.components(moved).transmission - error).abs().amax(0) > 1e-9
    assert change.tolist() == [False, False, True, False, False, False]
    arm, q = SimulatedArm(seed=5, lines=[(5, 100.0, 1e-4)]), SimulatedArm().sample(10)
    grown = arm.worn(5, 3.0).components(q).transmission - arm.components(q).transmission
    smooth = SimulatedArm(seed=5).components(q).transmission  # without lines, which do not grow
    torch.testing.assert_close(grown[:, 5], 2.0 * smooth[:, 5], rtol=0, atol=1e-15)
    assert float(grown[:, :5].abs().max()) == 0.0
    torch.testing.assert_close(arm.worn(-1, 3.0).true_points(q), arm.worn(5, 3.0).true_points(q), rtol=0, atol=0)
    with pytest.raises(IndexError):
        arm.worn(6, 3.0)
