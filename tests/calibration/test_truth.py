"""Findings about simulated robots against the true errors: parts of the model, and transmission errors.

Two pairs of errors are equivalent and are compared together. The registration compensates part of every error, so
geometry is compared with the true geometry itself, not by the size of its part. The load on the shoulder and the
first harmonic of its transmission error are both sines of the same angle.
"""

from __future__ import annotations

import pytest
import torch
from product_bank import Case, calibrated, simulated
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.robots import SimulatedArm

pytestmark = pytest.mark.slow

FINE = 5e-6
"""Noise of a coordinate with which transmission errors of single joints are compared, m."""


def rms(displacements: Tensor) -> float:
    """Of displacements with coordinates in triples, mm."""
    return 1e3 * float(displacements.reshape(-1, 3).square().sum(-1).mean().sqrt())


def sizes(case: Case) -> dict[str, float]:
    """Part -> displacement, mm."""
    return {part.name: 1e3 * part.displacement for part in case.result.parts}


def pushed(arm: SimulatedArm, q: Tensor, errors: Tensor) -> Tensor:
    """What joint errors (N, 6) move the markers by, (N, 3 P)."""
    return (arm.truth.jacobian(q).flatten(1, 2) @ errors[:, :, None])[..., 0]


def missed(case: Case, arm: SimulatedArm, joint: int) -> float:
    """Error of the transmission found of a joint over the size of the true one, RMS, without their mean values."""
    low, high = arm.nominal.limits[joint].tolist()
    q = torch.zeros(400, arm.nominal.n, dtype=torch.float64)
    q[:, joint] = torch.linspace(low, high, 400, dtype=torch.float64)
    true = arm.components(q).transmission[:, joint]
    error = case.model.transmission(arm.nominal.joint_names[joint], q[:, joint]) - true
    return float((error - error.mean()).norm() / (true - true.mean()).norm())


def test_parts_with_every_source_of_error(arm: Case) -> None:
    """60 poses, noise 0.02 mm; the bounds are those of the sizes, gravity and shoulder share what both explain."""
    source, found, q = simulated(1)[0], sizes(arm), arm.train.q
    assert list(found) == [
        *("geometry", "gravity on joints", "gravity on links"),
        *(f"transmission of {name}" for name in arm.robot.joint_names),
        *("coupled joint errors", "task space"),
    ]
    beyond_registration = 1e3 * register(source.nominal, q, source.truth.points(q)).rms
    assert found["geometry"] == pytest.approx(beyond_registration, rel=0.06)
    true = source.components(q)
    assert found["gravity on joints"] == pytest.approx(rms(pushed(source, q, true.gravity)), rel=0.25)
    for joint, name in enumerate(arm.robot.joint_names):
        alone = torch.zeros_like(true.transmission)
        alone[:, joint] = true.transmission[:, joint] - true.transmission[:, joint].mean()
        assert found[f"transmission of {name}"] == pytest.approx(rms(pushed(source, q, alone)), rel=0.25), name
    for nothing in ("gravity on links", "coupled joint errors", "task space"):  # the arm has none of these
        assert found[nothing] < 0.015
    joints = true.transmission + true.gravity
    moved = arm.model(q).detach() - arm.model.geometry.points(q)
    assert rms(moved.flatten(1) - pushed(source, q, joints)) < 0.4 * rms(pushed(source, q, joints))


def test_transmission_alone() -> None:
    """Every curve within 15 % (wrist roll 30 %: 0.1 m of lever arm) from 60 poses with noise 0.005 mm."""
    case, source = calibrated(60, geometry=0, gravity=0, noise=FINE), simulated(1, geometry=0, gravity=0)[0]
    for joint, bound in enumerate((0.1, 0.1, 0.1, 0.15, 0.13, 0.3)):
        assert missed(case, source, joint) < bound, joint
    for nothing in ("gravity on joints", "gravity on links", "coupled joint errors", "task space"):
        assert sizes(case)[nothing] < 0.005, nothing
    q = case.train.q
    assert rms(case.model.geometry.points(q) - source.truth.points(q)) < 0.02
    assert case.held_out()[2] < 0.03 * 1e-3


def test_gravity_alone() -> None:
    case, source = calibrated(40, geometry=0, transmission=0), simulated(1, geometry=0, transmission=0)[0]
    found, q = sizes(case), case.train.q
    deflected = rms(pushed(source, q, source.components(q).gravity))
    assert deflected > 0.5
    assert found.pop("gravity on joints") == pytest.approx(deflected, rel=0.05)
    del found["geometry"]  # part of the registration was compensated
    assert max(found.values()) < 0.015, found
    assert rms(case.model.geometry.points(q) - source.truth.points(q)) < 0.04
    assert case.held_out()[2] < 0.06 * 1e-3


def test_transmission_is_what_moves_the_markers(arm: Case) -> None:
    """To first order: the flow's momenta along the joint's own kernel, whatever the other joints are."""
    values = torch.linspace(-3, 3, 7, dtype=torch.float64)
    scales, deformation = arm.result.selection.scales, arm.model.map.deformation
    for index, name in enumerate(arm.robot.joint_names):
        away = (10 - 10 * (values[:, None] - deformation.x[None, :, index]).cos()).clamp(min=0).sqrt()
        away = away / scales.transmission_lengthscale[index]
        kernel = (1 + away + away**2 / 3) * (-away).exp()  # Matern 5/2
        expected = scales.transmission_amplitude[index] ** 2 * kernel @ deformation.momenta.joint[:, index]
        assert_close(arm.model.transmission(name, values), expected, rtol=1e-9, atol=1e-15)


def test_transmission_of_no_joint_or_of_nonsense(arm: Case) -> None:
    of = arm.model.transmission
    refused(
        (r"`joint`: expected waist_joint, shoulder_joint, .*got", lambda: of("elbow", [0.0])),
        ("`values` has the wrong shape", lambda: of("elbow_joint", 0.3)),
        (r"1 value\(s\) that are not finite", lambda: of("elbow_joint", [torch.nan])),
        ("`values` cannot be read as numbers", lambda: of("elbow_joint", "home")),
    )
    assert of("elbow_joint", []).shape == (0,)
