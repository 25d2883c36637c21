"""Calibration with payloads of known mass: the sag under any other payload is predicted."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from kind_bank import kind_named
from product_bank import with_usual_scales
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.fitting.result import silent
from diffeo_calib.robots import SimulatedArm

pytestmark = pytest.mark.slow  # several calibrations

ARM = SimulatedArm(seed=1)


KIND = kind_named("payloads")


@pytest.fixture(scope="module")
def other() -> dc.Measurements:
    """True places of other configurations under payloads that were not measured."""
    masses = torch.from_numpy(np.random.default_rng(1).choice([1.0, 6.0, 8.5], 200))
    q = ARM.sample(200, seed=2)
    return dc.Measurements(q, ARM.true_points(q, masses)).with_payload(masses)


def test_masses_beyond_the_fit(other: dc.Measurements) -> None:
    with pytest.warns(DiffeoCalibWarning, match="a payload of 20 is beyond the 0 to 10 in the measurements of the fit"):
        KIND.model.with_payload(20.0)
    with pytest.warns(DiffeoCalibWarning, match="a payload of 30 is beyond"):
        dc.evaluate(KIND.model, other.with_payload(30.0))
    for mass in (np.int64(4), np.float32(4), torch.tensor(4.0)):
        assert KIND.model.with_payload(mass).payload == 4.0  # pyright: ignore[reportArgumentType]


def test_sag_under_other_payloads_is_predicted(other: dc.Measurements) -> None:
    assert KIND.result.fit.converged
    without = with_usual_scales(ARM.nominal, KIND.data.with_payload(None))
    errors = dc.evaluate(KIND.model, other).rms, dc.evaluate(without.model, other.with_payload(None)).rms
    assert errors[0] < 0.5 * errors[1]
    unknown = ARM.true_points(other.q, 10.0) - ARM.true_points(other.q, 0.0)
    known = KIND.model.with_payload(10.0)(other.q) - KIND.model.with_payload(0.0)(other.q)
    assert float((known - unknown).norm(dim=-1).mean()) < 0.25 * float(unknown.norm(dim=-1).mean())
    assert {part.name: part.displacement for part in KIND.result.parts}["payload"] > 1e-4


def test_predicted_deviations_hold(other: dc.Measurements) -> None:
    inside = []
    for mass in (1.0, 6.0, 8.5):
        own = other.payload == mass
        mean, covariance = KIND.model.with_payload(mass).predict(other.q[own], noise=False)
        away = (other.points[own] - mean)[:, 0]
        inside.append((away * torch.linalg.solve(covariance[:, 0], away)).sum(-1) < 7.815)  # 95 % of chi-squared, 3
    assert float(torch.cat(inside).double().mean()) > 0.85


def test_payloads_that_cannot_be(other: dc.Measurements) -> None:
    rows, loaded, plain = KIND.data, KIND.model, kind_named("positions")

    def calibrated(data: Any, **options: Any) -> Callable[[], object]:
        return lambda: dc.calibrate(ARM.nominal, data, **options)

    refused(
        ("calibrated with payloads, the measurements have none", lambda: dc.evaluate(loaded, other.with_payload(None))),
        ("the model was calibrated without", lambda: dc.evaluate(plain.model, plain.new.with_payload(3.0))),
        ("calibrated without payloads", lambda: plain.model.with_payload(3.0)),
        ("`mass` of the payload: expected a number of 0 or more, got -1", lambda: loaded.with_payload(-1.0)),
        ("expected a number of 0 or more", lambda: loaded.with_payload(10**400)),
        (r"expected 0 to 10 in .* of the fit, got 1e\+300; check its unit", lambda: loaded.with_payload(1e300)),
        ("all payloads are 0", calibrated(rows.with_payload(0.0))),
        ("`controls` of measurements with payloads: expected 'all', got 20", calibrated(rows, controls=20)),
        (r"the link of the payload.*flange.*got wrist", calibrated(rows.with_payload(1.0, at="wrist"))),
        ("row 1: expected a mass of 0 or more, got -2", lambda: rows[:2].with_payload([1.0, -2.0])),
        ("payload", lambda: rows.with_payload([1.0, 2.0])),
    )


def test_one_payload_in_all_rows_is_warned_about() -> None:
    q, points = ARM.measure(14, seed=4)
    with pytest.warns(DiffeoCalibWarning, match="all rows carry the same payload"):
        place(ARM.nominal, dc.Measurements(q, points).with_payload(6.0), silent).tangent_data()
