"""Campaigns in several set-ups, with markers mounted anew, or with payloads: found, judged, predicted, refused."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kind_bank import kind_named
from numbers_bank import inside, tensor
from product_bank import with_usual_scales
from source_bank import MOUNTED, MOVED, remounted, tracked
from table_bank import refused, warned
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.fitting.result import silent
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation

ARM = SimulatedArm(seed=1)
"""That of the markers mounted anew."""


@pytest.mark.slow
def test_the_frames_are_found_and_rows_of_a_session_brought_into_that_of_the_model() -> None:
    result, arm = kind_named("sessions").result, SimulatedArm(seed=5, markers=2)
    sessions, q = result.sessions, arm.sample(50, seed=8)
    monday, centre = sessions.names.index("Monday"), tensor([0.0, 0.0, 0.5, 1.0])
    assert sessions.reference == 1 - monday  # the larger one
    found = sessions.transforms[monday]
    assert_close(found[:3, :3], MOVED[:3, :3], rtol=0, atol=1e-4)
    assert_close(found @ centre, MOVED @ centre, rtol=0, atol=3e-4)
    assert len(sessions.sentences()) == 1
    rows = dc.Measurements(q, arm.true_points(q) @ MOVED[:3, :3].mT + MOVED[:3, 3], arm.nominal.joint_names)
    assert dc.evaluate(result.model, result.aligned(rows.with_sessions(["Monday"] * 50))).rms < 2e-4
    message = r"the sessions \['Sunday'\]: expected some of .*; register the model"
    refused((message, lambda: result.aligned(rows.with_sessions(["Sunday"] * 50))))


@pytest.mark.slow
def test_rows_of_several_set_ups_that_cannot_be(tmp_path: Path) -> None:
    kind, four = kind_named("sessions"), r"session 'a': expected 4 rows, got 'a' in 3 rows"
    data, whole = kind.new.rows(slice(0, 6)).with_sessions(["a", "b"] * 3), kind.data
    rare = whole.with_sessions(["b"] * (len(whole) - 3) + ["a"] * 3)
    refused(
        (four, lambda: dc.evaluate(kind.model, data)),
        (four, lambda: dc.write_report(kind.model, tmp_path / "page.html", data)),
        (four, lambda: dc.evaluate(kind.model, data.rows([0, 2, 4]))),
        (four, lambda: dc.calibrate(kind.robot, rare)),
        (r"the names of sessions: expected 6 names", lambda: data.with_sessions(torch.zeros(6, device="meta"))),
    )


def test_the_shifts_of_markers_are_found() -> None:
    result = kind_named("markers mounted anew").result
    found = result.sessions.devices
    away = (found.constants - MOUNTED[["abc".index(name) for name in found.names]]).abs()
    assert bool((away < 5 * found.deviations + 1e-9).all())
    assert float(found.deviations.max()) < 5e-5
    said = re.findall(r"session '(\w)': its marker is ([\d.]+) .* mm away", "\n".join(result.placement.sentences()))
    assert [(name, round(float(mm), 1)) for name, mm in said] == [("b", 5.0), ("c", 5.0)]


def test_rows_of_known_and_of_new_mountings_are_judged() -> None:
    kind, rows = kind_named("markers mounted anew"), tracked(ARM, 40, 5)
    model, plain, new = kind.model, dc.evaluate(kind.model, rows), remounted(ARM, rows)
    known: Any = dc.evaluate(model, new)
    assert known.numbers == 0
    renamed = new.with_sessions([f"{name} again" for name in new.device_names], remounted=True)
    placed: Any = dc.evaluate(model, renamed)
    assert placed.numbers == 9
    assert max(known.rms, placed.rms) < 1.2 * plain.rms
    assert any("session 'b again': its marker is" in text for text in placed.placed)
    alone: Any = dc.evaluate(model, new.rows(slice(1, None, 5)))  # the second session, whose name the others keep
    assert (alone.count, alone.numbers) == (8, 0)
    assert alone.rms < 1.5 * plain.rms
    assert dc.evaluate(model, new.with_sessions(None)).rms > 2e-3
    refused(("mounted anew", lambda: dc.evaluate(kind.result.identification.geometry.points, new)))


def test_the_marker_of_each_mounting_is_predicted() -> None:
    """Its errors are those that are expected."""
    q = ARM.sample(200, seed=11)
    truth, turns = 1e3 * ARM.true_points(q)[:, 0], ARM.truth.marker_poses(q)[:, 0, :3, :3]
    found = {one.device: one for one in kind_named("markers mounted anew").model.predict_readings(q)}
    assert set(found) == {"b", "c"}
    for number, name in ((1, "b"), (2, "c")):
        own = found[name]
        assert own.unit == "mm"
        assert inside(own.mean - truth - 1e3 * turns @ MOUNTED[number], own.covariance) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("said", [False, True])
def test_the_other_account_is_named_where_it_fits_far_better(said: bool) -> None:
    """Frames are taken for markers, and markers for frames."""
    rows = tracked(ARM, 60, 1)
    names, T = remounted(ARM, rows).device_names, torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    T[[name == "b" for name in names], :3, :3] = rotation(tensor([2e-3, 1e-3, -2e-3]))
    data = rows.in_frames(T) if said else remounted(ARM, rows).with_sessions(None)
    texts = warned(with_usual_scales, ARM.nominal, data.with_sessions(names, remounted=said))[1]
    assert sum("--remounted" in text for text in texts) == 1


LADEN = kind_named("payloads")


@pytest.fixture(scope="module")
def other() -> dc.Measurements:
    """True places of other configurations under payloads that were not measured."""
    masses = torch.from_numpy(np.random.default_rng(1).choice([1.0, 6.0, 8.5], 200))
    q = ARM.sample(200, seed=2)
    return dc.Measurements(q, ARM.true_points(q, masses)).with_payload(masses)


@pytest.mark.slow
def test_masses_beyond_the_fit(other: dc.Measurements) -> None:
    with pytest.warns(DiffeoCalibWarning, match="a payload of 20 is beyond the 0 to 10 in the measurements of the fit"):
        LADEN.model.with_payload(20.0)
    with pytest.warns(DiffeoCalibWarning, match="a payload of 30 is beyond"):
        dc.evaluate(LADEN.model, other.with_payload(30.0))
    for mass in (np.int64(4), np.float32(4), torch.tensor(4.0)):
        assert LADEN.model.with_payload(mass).payload == 4.0  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_sag_under_other_payloads_is_predicted_with_its_deviations(other: dc.Measurements) -> None:
    assert LADEN.result.fit.converged
    without = with_usual_scales(ARM.nominal, LADEN.data.with_payload(None))
    errors = dc.evaluate(LADEN.model, other).rms, dc.evaluate(without.model, other.with_payload(None)).rms
    assert errors[0] < 0.5 * errors[1]
    unknown = ARM.true_points(other.q, 10.0) - ARM.true_points(other.q, 0.0)
    known = LADEN.model.with_payload(10.0)(other.q) - LADEN.model.with_payload(0.0)(other.q)
    assert float((known - unknown).norm(dim=-1).mean()) < 0.25 * float(unknown.norm(dim=-1).mean())
    assert {part.name: part.displacement for part in LADEN.result.parts}["payload"] > 1e-4
    held = []
    for mass in (1.0, 6.0, 8.5):
        own = other.payload == mass
        mean, covariance = LADEN.model.with_payload(mass).predict(other.q[own], noise=False)
        held.append(inside(other.points[own] - mean, covariance) * int(own.sum()))
    assert sum(held) > 0.85 * len(other)


@pytest.mark.slow
def test_payloads_that_cannot_be(other: dc.Measurements) -> None:
    rows, loaded, plain = LADEN.data, LADEN.model, kind_named("positions")

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
        ("payload", lambda: rows.with_payload([1.0, 2.0])),
    )


@pytest.mark.slow
def test_one_payload_in_all_rows_is_warned_about() -> None:
    q, points = ARM.measure(14, seed=4)
    with pytest.warns(DiffeoCalibWarning, match="all rows carry the same payload"):
        place(ARM.nominal, dc.Measurements(q, points).with_payload(6.0), silent).tangent_data()
