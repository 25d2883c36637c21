"""Campaigns in several set-ups: a device that was moved, markers mounted anew; found, judged, predicted, refused."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from product_bank import with_usual_scales
from source_bank import MOUNTED, MOVED, remounted
from table_bank import refused
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation

ARM = SimulatedArm(seed=1)
"""That of the markers mounted anew."""


def table(rows: int, seed: int) -> dc.Measurements:
    return dc.Measurements(*ARM.measure(rows, seed=seed), ARM.nominal.joint_names)


@pytest.mark.slow
def test_the_frames_are_found_and_rows_of_a_session_brought_into_that_of_the_model() -> None:
    result, arm = kind_named("sessions").result, SimulatedArm(seed=5, markers=2)
    sessions, q = result.sessions, arm.sample(50, seed=8)
    monday, centre = sessions.names.index("Monday"), torch.tensor([0.0, 0.0, 0.5, 1.0], dtype=torch.float64)
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
        (r"the names of sessions: expected 6 names", lambda: data.with_sessions(["a", "b"])),
        (r"the names of sessions: expected 6 names", lambda: data.with_sessions(torch.zeros(6, device="meta"))),
        (r"the names of sessions: 1 row\(s\)", lambda: data.with_sessions(["a", " ", "b", "b", "a", "a"])),
    )


def test_the_shifts_of_markers_are_found() -> None:
    result = kind_named("markers mounted anew").result
    found = result.sessions.devices
    away = (found.constants - MOUNTED[["abc".index(name) for name in found.names]]).abs()
    assert bool((away < 5 * found.deviations + 1e-9).all())
    assert float(found.deviations.max()) < 5e-5
    said = [
        re.search(r"session '(\w)': its marker is ([\d.]+) .* mm away", one) for one in result.placement.sentences()
    ]
    assert [(one[1], round(float(one[2]), 1)) for one in said if one] == [("b", 5.0), ("c", 5.0)]


def test_rows_of_known_and_of_new_mountings_are_judged() -> None:
    kind, rows = kind_named("markers mounted anew"), table(40, 5)
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
        error = own.mean - truth - 1e3 * turns @ MOUNTED[number]
        squares = (error[:, None] @ torch.linalg.solve(own.covariance, error[..., None])).flatten()
        assert float((squares < 7.81).double().mean()) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("said", [False, True])
def test_the_other_account_is_named_where_it_fits_far_better(said: bool) -> None:
    """Frames are taken for markers, and markers for frames."""
    rows = table(60, 1)
    names = remounted(ARM, rows).device_names
    if said:
        T = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
        T[[name == "b" for name in names], :3, :3] = rotation(torch.tensor([2e-3, 1e-3, -2e-3], dtype=torch.float64))
        data = rows.in_frames(T)
    else:
        data = remounted(ARM, rows).with_sessions(None)
    with pytest.warns(dc.DiffeoCalibWarning) as caught:
        with_usual_scales(ARM.nominal, data.with_sessions(names, remounted=said))
    assert sum("--remounted" in str(one.message) for one in caught) == 1
