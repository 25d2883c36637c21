"""Findings about simulated robots against the true errors: parts, transmission errors, extrapolation.

Two pairs of errors are equivalent and are compared together. The registration compensates part of every error, so
geometry is compared with the true geometry itself, not by the size of its part. The load on the shoulder and the
first harmonic of its transmission error are both sines of the same angle.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from product_bank import Case, calibrated, simulated, ur10_measurements, ur10_scales
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.robots import SimulatedArm

pytestmark = pytest.mark.slow  # calibrations by the dozen

FINE = 5e-6
"""Noise of a coordinate with which transmission errors of single joints are compared, m."""


@pytest.fixture(scope="module")
def only_transmission() -> Case:
    return calibrated(60, geometry=0, gravity=0, noise=FINE)


def truth(**errors: float) -> SimulatedArm:
    return simulated(1, **errors)[0]


def rms(displacements: Tensor) -> float:
    """Of displacements with coordinates in triples, mm."""
    return 1e3 * float(displacements.reshape(-1, 3).square().sum(-1).mean().sqrt())


def sizes(case: Case) -> dict[str, float]:
    """Part -> displacement, mm."""
    return {part.name: 1e3 * part.displacement for part in case.result.parts}


def transmissions(case: Case) -> dict[str, float]:
    return {name: size for name, size in sizes(case).items() if name.startswith("transmission of ")}


def pushed(arm: SimulatedArm, q: Tensor, errors: Tensor) -> Tensor:
    """What joint errors (N, 6) move the markers by, (N, 3 P)."""
    return (arm.truth.jacobian(q).flatten(1, 2) @ errors[:, :, None])[..., 0]


def wrong_geometry(case: Case, arm: SimulatedArm) -> float:
    """From the true geometry to the one that was found, mm RMS over the measured configurations."""
    q = case.train.q
    return rms(case.model.geometry.points(q) - arm.truth.points(q))


def waves(arm: SimulatedArm, joint: int, count: int = 400) -> tuple[Tensor, Tensor]:
    """Values over the range of a joint, and its true transmission error there."""
    low, high = arm.nominal.limits[joint].tolist()
    values = torch.linspace(low, high, count, dtype=torch.float64)
    q = torch.zeros(count, arm.nominal.n, dtype=torch.float64)
    q[:, joint] = values
    return values, arm.components(q).transmission[:, joint]


def missed(case: Case, arm: SimulatedArm, joint: int, *, forget: int = 0) -> float:
    """Error of the transmission found of a joint over the size of the true one, RMS, without their mean values.

    ``forget`` is the number of harmonics that do not count either.
    """
    values, true = waves(arm, joint)
    found = case.model.transmission(arm.nominal.joint_names[joint], values)
    angles = [k * values for k in range(1, forget + 1)]
    basis = torch.stack([torch.ones_like(values), *(a.sin() for a in angles), *(a.cos() for a in angles)], 1)

    def rest(curve: Tensor) -> Tensor:
        return curve - basis @ torch.linalg.lstsq(basis, curve[:, None], driver="gelsd").solution[:, 0]

    return float(rest(found - true).norm() / rest(true).norm())


def test_parts_with_every_source_of_error(arm: Case) -> None:
    """60 poses, noise 0.02 mm; the bounds are those of the sizes, gravity and shoulder share what both explain."""
    source, found, q = truth(), sizes(arm), arm.train.q
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


def test_transmission_alone(only_transmission: Case) -> None:
    """Every curve within 15 % (wrist roll 30 %: 0.1 m of lever arm) from 60 poses with noise 0.005 mm."""
    source, found = truth(geometry=0, gravity=0), sizes(only_transmission)
    for joint, bound in enumerate((0.1, 0.1, 0.1, 0.15, 0.13, 0.3)):
        assert missed(only_transmission, source, joint) < bound, joint
    for nothing in ("gravity on joints", "gravity on links", "coupled joint errors", "task space"):
        assert found[nothing] < 0.005, nothing
    assert wrong_geometry(only_transmission, source) < 0.02
    assert only_transmission.held_out()[2] < 0.03 * 1e-3


def test_transmission_is_what_moves_the_markers(arm: Case) -> None:
    """To first order: the flow's momenta along the joint's own kernel, whatever the other joints are."""
    values = torch.linspace(-3, 3, 7, dtype=torch.float64)
    for index, name in enumerate(arm.robot.joint_names):
        curve = arm.model.transmission(name, values)
        scales, deformation = arm.result.selection.scales, arm.model.map.deformation
        away = (10 - 10 * (values[:, None] - deformation.x[None, :, index]).cos()).clamp(min=0).sqrt()
        away = away / scales.transmission_lengthscale[index]
        kernel = (1 + away + away**2 / 3) * (-away).exp()  # Matern 5/2
        expected = scales.transmission_amplitude[index] ** 2 * kernel @ deformation.momenta.joint[:, index]
        torch.testing.assert_close(curve, expected, rtol=1e-9, atol=1e-15)


def split_by_first_joint(data: dc.Measurements) -> tuple[dc.Measurements, dc.Measurements]:
    """Rows around the middle of the first joint's range, and those beyond on both sides."""
    low, high = torch.quantile(data.q[:, 0], torch.tensor([0.2, 0.8], dtype=torch.float64))
    inside = (data.q[:, 0] > low) & (data.q[:, 0] < high)
    return data.rows(inside), data.rows(~inside)


def test_beyond_the_measured_range_of_the_first_joint_of_a_ur10(ur10_folder: Path) -> None:
    robot, data = ur10_measurements(ur10_folder)
    inside, outside = split_by_first_joint(data)
    case = Case(robot, inside, outside, dc.calibrate(robot, inside, hyperparameters=ur10_scales()))
    _, geometry, diffeomorphic = case.held_out()
    assert diffeomorphic < 0.65 * geometry
