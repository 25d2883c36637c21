"""Kinds of devices from outside the package, those of scripts/examples, and a rigid tool held by two hands."""

from pathlib import Path
from typing import Any

import inclinometer
import pytest
import torch
import two_arms_bank
from inclinometer import Inclinometers
from kind_bank import kind_named
from laser_line import Beams
from numbers_bank import drawn, normal, rms, tensor
from product_bank import simulated_poses, with_usual_scales
from source_bank import tracked
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import KINDS, kind_of, register

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows


@pytest.fixture(autouse=True)
def registered() -> None:
    """The classes of these modules, also where another test ran an example as a program in this process."""
    KINDS.update({Beams.kind: Beams, Inclinometers.kind: Inclinometers})


def test_an_inclinometer_finds_how_it_is_mounted_and_makes_the_model_better() -> None:
    """Against the truth of the simulation, and a model of the poses alone."""
    kind = kind_named("inclinations")
    (own,) = kind.result.readings
    axes, up = own.devices.constants[0, :6].view(2, 3), own.devices.constants[0, 6:]
    frames = inclinometer.frames(simulated_poses(1)[0], kind.q(1))
    model, _ = kind.model.predict_poses(kind.q(1))
    mount = model[0, :3, :3].mT @ frames[0, :3, :3]  # the model's frame is that of the poses of the table
    assert_close(axes @ mount, inclinometer.AXES, rtol=0, atol=2e-3)
    assert_close(up, torch.nn.functional.normalize(inclinometer.UP, dim=0), rtol=0, atol=2e-3)
    assert float(own.devices.deviations.max()) < 2e-3  # pyright: ignore
    alone = dc.calibrate(kind.robot, kind.data.parts[0], hyperparameters=kind.scales).model
    q = kind.q(100)
    assert kind.error_mm(kind.model(q), q) < kind.error_mm(alone(q), q)


def test_a_frame_is_seen_beside_poses_only() -> None:
    arm = simulated_poses(1)[0]
    seen = inclinometer.readings(arm, arm.sample(60))
    for rows in (seen, dc.Observations.joined([tracked(arm, 20, 0, 0), seen])):
        with pytest.raises(MeasurementError, match=r"inclination.*beside measured poses"):
            dc.calibrate(arm.nominal, rows)  # pyright: ignore
    with pytest.raises(InputError, match="poses"):
        dc.evaluate(kind_named("positions").model, seen)


def test_kinds_are_registered_once() -> None:
    assert kind_of(dc.Readings.of("line distance", torch.zeros(3, 2), 1.0, doubt=False)) is Beams
    assert register(Beams) is Beams
    for wrong in (Devices, dc.Readings, Beams(("A",), torch.zeros(1, 6), torch.zeros(4))):
        with pytest.raises(InputError, match="subclass of Devices"):
            register(wrong)  # pyright: ignore
    other = type("Other", (Beams,), {"kind": "height"})
    with pytest.raises(InputError, match="height"):
        register(other)
    assert KINDS["height"] is not other


AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
ORIGINS = ("0 {side} 0.3", "0 0 0.2", "0 0 0.35", "0.3 0 0", "0.1 0 0", "0.1 0 0")
NEWTON_STEPS = 12


JOINTS = [
    (f"{hand}_j{k}", f"{hand}_{k - 1}" if k else "base", f"{hand}_{k}", origin.format(side=side), axis)
    for hand, side in zip(two_arms_bank.HANDS, (0.35, -0.35), strict=True)
    for k, (axis, origin) in enumerate(zip(AXES, ORIGINS, strict=True))
]
"""Two arms of six joints on one base."""


def away(arms: two_arms_bank.TwoArms, q: Tensor, X: Tensor) -> Tensor:
    """(N, 6) how far the second hand is from where a tool X has it, m and rad."""
    left, right = arms.poses(q).unbind(1)
    D = torch.linalg.inv(X) @ torch.linalg.inv(left) @ right
    skewed = D[:, :3, :3] - D[:, :3, :3].mT
    turn = 0.5 * torch.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], 1)
    return torch.cat([D[:, :3, 3], turn], 1)


def holding(arms: two_arms_bank.TwoArms, X: Tensor, home: Tensor, rows: int, seed: int) -> Tensor:
    """Configurations (N, 12) in which both hands hold the tool, by Newton steps of the second arm."""
    q = home + 0.6 * (2 * drawn(rows, 12, seed=seed) - 1)
    q[:, 6:] = home[6:]
    for _ in range(NEWTON_STEPS):
        J = torch.func.jacrev(lambda x: away(arms, x, X).sum(0))(q).movedim(1, 0)[..., 6:]  # (N, 6, 6)
        step = torch.linalg.lstsq(J, away(arms, q, X)[..., None]).solution[..., 0]
        q = torch.cat([q[:, :6], q[:, 6:] - step.clamp(-0.3, 0.3)], 1)
    return q[(away(arms, q, X).abs().amax(1) < 1e-9) & (q.abs().amax(1) < 2.5)]


def relative_errors(model: Any, arms: Any, q: Tensor) -> float:
    """RMS distance of the second hand from where the first has it, against the truth, m."""
    found, true = (torch.linalg.inv(poses[:, 0]) @ poses[:, 1] for poses in (model.poses(q), arms.poses(q)))
    return rms((found - true)[:, :3, 3])


@pytest.mark.slow
def test_a_held_tool_makes_the_model_better_and_goes_through_verbs(tmp_path: Path) -> None:
    (tmp_path / "arms.urdf").write_text(two_arms_bank.urdf(JOINTS, "0.1 0 0.05", 3.0))
    robot = dc.load_urdf(tmp_path / "arms.urdf", "base", list(two_arms_bank.HANDS))
    arms, names = two_arms_bank.TwoArms(robot), robot.joint_names
    bent = tensor([0.3, 0.6, 0.9, 0.2, -0.6, 0.1])
    home = torch.cat([bent, bent * torch.tensor([-1, 1, 1, -1, 1, -1])])
    left, right = arms.poses(home[None])[0]
    X = torch.linalg.inv(left) @ right
    q, kept = holding(arms, X, home, 110, 3).tensor_split([32])
    seen = q + 2e-5 * normal(*q.shape, seed=5)  # a tool is rigid to some hundredths of a millimetre
    held, new = (
        dc.Readings.of("held tool", rows, torch.zeros(len(rows), 6), None, names, numbers=6, doubt=False)
        for rows in (seen, kept)
    )
    free = home + 0.8 * (2 * drawn(16, 12, seed=8) - 1)
    poses = dc.Measurements.from_poses(free, arms.noisy(free), names, on=two_arms_bank.HANDS)
    rows: Any = dc.Observations.joined([poses, held])
    alone = with_usual_scales(robot, poses).model
    found = with_usual_scales(robot, rows)
    assert relative_errors(found.model, arms, kept) < 0.5 * relative_errors(alone, arms, kept)
    assert_close(found.readings[0].devices.constants.view(3, 4)[:, 3], X[:3, 3], rtol=0, atol=2e-3)
    dc.save(found.model, tmp_path / "m.safetensors")
    model: Any = dc.load(tmp_path / "m.safetensors")
    assert dc.evaluate(model, new).rms < 1e-3  # pyright: ignore
    assert model.predict(kept[:3])[0].shape == (3, 6, 3)
    single = dc.Measurements.from_poses(free, arms.poses(free)[:, 0], names, on=["left"])
    with pytest.raises(MeasurementError, match=r"held tools: expected poses of 2 frames beside them, got 1"):
        dc.calibrate(robot, dc.Observations.joined([single, held]))  # pyright: ignore
