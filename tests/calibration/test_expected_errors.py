"""What a model expects of its errors: in the frame of a device, or after the best rigid motion where none holds it."""

from __future__ import annotations

import warnings

import pytest
import torch
from campaigns import CAMPAIGNS
from degenerate import arm_of, measured
from kind_bank import kind_named, marked
from product_bank import with_usual_scales
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.expected_errors import ExpectedError, OpenPlaces, expected_errors, workspace_deviation
from diffeo_calib.reports.analysis.stages import stages_of
from diffeo_calib.robots.se3 import twist_transform

FAR = twist_transform(torch.tensor([0.03, -0.02, 0.01, 0.02, 0.01, -0.03], dtype=torch.float64))


@pytest.mark.parametrize(("name", "free"), [("positions", False), ("ball in sockets", True)])
def test_rigid_motions_are_errors_of_a_model_in_the_frame_of_a_device_alone(name: str, free: bool) -> None:
    model = kind_named(name).model

    def away(q: Tensor) -> Tensor:
        return model(q) @ FAR[:3, :3].mT + FAR[:3, 3]

    found = expected_errors(model, {"itself": model, "away": away})
    own = workspace_deviation(model.map)
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that is the case
        model = with_usual_scales(arm.nominal, data).model
    found, q = ExpectedError.of(model), model.map.everywhere
    assert found.whole > 5 * found.workspace
    assert any("marker" in place for place in found.open_places)
    errors = (model(q).detach() - arm.true_points(q)).flatten(1)
    apart = float(
        OpenPlaces.of(model.map).without(errors.reshape(-1, 1)).view(errors.shape).square().sum(1).mean().sqrt()
    )
    assert 0.3 * apart < found.workspace < 6 * apart
    by_stage = expected_errors(model, stages_of(model))
    assert by_stage["calibrated"] == pytest.approx(found.workspace)
    assert by_stage["calibrated"] < by_stage["geometric"] < by_stage["nominal"] < 5e-3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        moved = model.registered(data[:12])  # these rows leave it open again
    again = ExpectedError.of(moved)
    assert again.whole > 5 * again.workspace
    assert again.open_places


@pytest.mark.parametrize("name", marked())
def test_usual_rows_leave_no_place_open(name: str) -> None:
    found = ExpectedError.of(kind_named(name).model)
    assert found.open_places == ()
    assert found.workspace == found.whole


@pytest.mark.parametrize("name", ["positions", "hidden markers", "poses", "ball in sockets"])
def test_expectation_plan_and_stages_give_one_number(name: str) -> None:
    model = kind_named(name).model
    found, q = ExpectedError.of(model), model.map.everywhere
    tracker = dc.Sensor.positions() if name == "ball in sockets" else None  # no random pose is in a socket
    planned = dc.plan(model, q, 1, target=q, sensor=tracker).expected_rms[0]  # over a part of the targets
    assert float(planned) == pytest.approx(found.whole, rel=0.1)
    assert expected_errors(model, {"itself": model})["itself"] == pytest.approx(found.workspace)
