"""Findings about simulated robots against the true errors: parts of the model, and transmission errors.

Two pairs of errors are equivalent and are compared together. The registration compensates part of every error, so
geometry is compared with the true geometry itself, not by the size of its part. The load on the shoulder and the
first harmonic of its transmission error are both sines of the same angle.
"""

from __future__ import annotations

import pytest
import torch
from product_bank import Case, simulated
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.robots import SimulatedArm

pytestmark = pytest.mark.slow


def rms(displacements: Tensor) -> float:
    """Of displacements with coordinates in triples, mm."""
    return 1e3 * float(displacements.reshape(-1, 3).square().sum(-1).mean().sqrt())


def sizes(case: Case) -> dict[str, float]:
    """Part -> displacement, mm."""
    return {part.name: 1e3 * part.displacement for part in case.result.parts}


def pushed(arm: SimulatedArm, q: Tensor, errors: Tensor) -> Tensor:
    """What joint errors (N, 6) move the markers by, (N, 3 P)."""
    return (arm.truth.jacobian(q).flatten(1, 2) @ errors[:, :, None])[..., 0]


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
