"""What a model expects of itself, and what its parts explain, against the truth of a simulated arm."""

import pytest
import torch
from campaigns import CAMPAIGNS
from degenerate import arm_of, measured
from kind_bank import kind_named, marked
from numbers_bank import rms, tensor
from product_bank import Case, simulated, with_usual_scales
from table_bank import warned
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.expected_errors import ExpectedError, OpenPlaces, expected_errors
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.reports.analysis.findings import stages_of
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform

FAR = twist_transform(tensor([0.03, -0.02, 0.01, 0.02, 0.01, -0.03]))


@pytest.mark.parametrize(("name", "free"), [("positions", False), ("ball in sockets", True)])
def test_rigid_motions_are_errors_of_a_model_in_the_frame_of_a_device_alone(name: str, free: bool) -> None:
    model = kind_named(name).model

    def away(q: Tensor) -> Tensor:
        return model(q) @ FAR[:3, :3].mT + FAR[:3, 3]

    found = expected_errors(model, {"itself": model, "away": away})
    covariance = model.map.posterior(model.map.everywhere, noise=False)[1][:, -3:, -3:]
    own = float(covariance.diagonal(dim1=1, dim2=2).sum(1).mean().sqrt())
    assert found["itself"] == pytest.approx(own, rel=1e-6)
    if free:
        assert found["away"] == pytest.approx(own, rel=1e-6)
    else:
        assert found["away"] > 0.03


@pytest.mark.slow
def test_a_marker_that_the_rows_leave_open_is_no_error_of_the_robot() -> None:
    """The truth differs from the model as expected, after the marker has been put where it fits best."""
    arm, generator = arm_of("1 marker", 0), torch.Generator().manual_seed(0)
    data = measured(arm, "1 marker", CAMPAIGNS["tool never turned"](arm, 40, generator), generator)
    model = warned(with_usual_scales, arm.nominal, data)[0].model
    found, q = ExpectedError.of(model), model.map.everywhere
    assert found.whole > 5 * found.workspace
    assert any("marker" in place for place in found.open_places)
    errors = (model(q).detach() - arm.true_points(q)).flatten(1)
    apart = rms(OpenPlaces.of(model.map).without(errors.reshape(-1, 1)).view(errors.shape))
    assert 0.3 * apart < found.workspace < 6 * apart
    by_stage = expected_errors(model, stages_of(model))
    assert by_stage["calibrated"] == pytest.approx(found.workspace)
    assert by_stage["calibrated"] < by_stage["geometric"] < by_stage["nominal"] < 5e-3
    again = ExpectedError.of(warned(model.registered, data[:12])[0])  # these rows leave it open again
    assert again.whole > 5 * again.workspace
    assert again.open_places


@pytest.mark.parametrize("name", marked())
def test_usual_rows_leave_no_place_open(name: str) -> None:
    """What is expected over the workspace is what a plan begins with, and the error of the last stage."""
    model = kind_named(name).model
    found, q = ExpectedError.of(model), model.map.everywhere
    assert found.open_places == ()
    assert found.workspace == found.whole == pytest.approx(expected_errors(model, {"itself": model})["itself"])
    if name in ("positions", "hidden markers", "poses"):
        planned = dc.plan(model, q, 1, target=q).expected_rms[0]  # over a part of the targets
        assert float(planned) == pytest.approx(found.whole, rel=0.1)


def pushed(arm: SimulatedArm, q: Tensor, errors: Tensor) -> Tensor:
    """What joint errors (N, 6) move the markers by, (N, 3 P)."""
    return (arm.truth.jacobian(q).flatten(1, 2) @ errors[:, :, None])[..., 0]


def test_parts_with_every_source_of_error(arm: Case) -> None:
    """60 poses, noise 0.02 mm; the bounds are those of the sizes, gravity and shoulder share what both explain."""
    source, q = simulated(1)[0], arm.train.q
    found = {part.name: part.displacement for part in arm.result.parts}
    assert list(found) == [
        *("geometry", "gravity on joints", "gravity on links"),
        *(f"transmission of {name}" for name in arm.robot.joint_names),
        *("coupled joint errors", "task space"),
    ]
    beyond_registration = register(source.nominal, q, source.truth.points(q)).rms
    assert found["geometry"] == pytest.approx(beyond_registration, rel=0.06)
    true = source.components(q)
    assert found["gravity on joints"] == pytest.approx(rms(pushed(source, q, true.gravity)), rel=0.25)
    for joint, name in enumerate(arm.robot.joint_names):
        alone = torch.zeros_like(true.transmission)
        alone[:, joint] = true.transmission[:, joint] - true.transmission[:, joint].mean()
        assert found[f"transmission of {name}"] == pytest.approx(rms(pushed(source, q, alone)), rel=0.25), name
    for nothing in ("gravity on links", "coupled joint errors", "task space"):  # the arm has none of these
        assert found[nothing] < 1.5e-5
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
