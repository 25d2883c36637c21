"""A robot that is measured again in another way: rows of every kind, sessions, payloads."""

from __future__ import annotations

import copy
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import again_bank
import pytest
import torch
from again_bank import OTHERWISE, WORN_ROWS, height, sockets
from kind_bank import kind_named

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # few rows
ARM = again_bank.arm()


def quietly(work: Any, *given: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return work(*given)


@cache
def recalibrated(name: str) -> dc.Recalibration:
    """A case's model and the new rows of the same robot."""
    case = OTHERWISE[name]
    return quietly(dc.recalibrate, again_bank.model(case.old), case.new(ARM, case.count, 5))


@pytest.mark.parametrize("name", OTHERWISE)
def test_new_rows_make_the_model_better(name: str) -> None:
    found = recalibrated(name)
    assert again_bank.true_error(found.model, ARM) < again_bank.true_error(again_bank.model(OTHERWISE[name].old), ARM)
    assert found.fit.converged
    assert found.changes.found == ()
    assert found.marker == "same"
    assert found.rms_after <= found.rms_before


@pytest.mark.parametrize("name", WORN_ROWS)
def test_a_worn_joint_is_found(name: str) -> None:
    case, worn = WORN_ROWS[name], ARM.worn(again_bank.WORN, again_bank.FACTOR)
    found: Any = dc.compare(again_bank.model(case.old), case.new(worn, case.count, 5))
    (change,) = found.changes.found
    assert change.part == worn.nominal.joint_names[again_bank.WORN]
    assert str(found).startswith(f"{change.part} has changed")
    assert 1e-4 < change.size < 2e-3
    assert change.displacement > 1e-5


@pytest.mark.parametrize("rows", [height, sockets])
def test_what_was_measured_is_in_the_file(rows: Any, tmp_path: Path) -> None:
    model = again_bank.model(rows)
    dc.save(model, tmp_path / "model.safetensors")
    loaded: Any = dc.load(tmp_path / "model.safetensors")
    assert torch.equal(loaded.map.measured(), model.map.measured())
    for read, kept in zip(loaded.placement, model.placement, strict=True):
        assert read.stored() == kept.stored()
    again = dc.recalibrate(loaded, rows(ARM, 30, 5))
    dc.save(again.model, tmp_path / "again.safetensors")
    back: Any = dc.load(tmp_path / "again.safetensors")
    q = ARM.sample(5, seed=3)
    assert torch.equal(back(q), again.model(q))
    assert torch.equal(back.predict(q)[1], again.model.predict(q)[1])


def test_rows_of_a_fit_linearised_around_it_lead_to_it() -> None:
    """y - h(k1) of readings follows from the momenta: A k1 measured minus A k1 is R times the pull."""
    model = again_bank.model(again_bank.height)
    A, y = model.map.linearised_rows()
    pull = model.map.noise.solve(y - (A @ model.map(model.map.x)[:, :, None])[:, :, 0])
    end = model.map.geodesic.end_momenta.reshape(len(y), -1)
    torch.testing.assert_close((A.mT @ pull[:, :, None])[:, :, 0], end, rtol=1e-6, atol=1e-6 * float(end.abs().max()))


def test_old_rows_of_readings_keep_their_payloads() -> None:
    """Heights are linear in the points: rows linearised around the fit are the measured ones but for each plane."""
    model = again_bank.model(again_bank.laden_height)
    away = model.map.linearised_rows()[1] - model.map.measured()
    for device in range(3):  # devices take turns
        own = away[device::3]
        torch.testing.assert_close(own, own.mean().expand_as(own), rtol=0, atol=1e-6)
    again = dc.recalibrate(model, again_bank.laden_height(ARM, 30, 5)).model
    for mass in (0.0, 10.0):
        old, new = (again_bank.true_error(one.with_payload(mass), ARM, mass) for one in (model, again))
        assert new < 1.1 * old


def test_a_recalibrated_model_keeps_its_devices() -> None:
    """Beside the robot in the new frame; what new rows see as these say: one has moved by 3 mm."""
    kind = kind_named("several kinds")
    model, rows, q = kind.model, kind.moved, kind.q(30)
    positions, heights = (part for part in rows.parts if part.kind in ("position", "height"))
    new = dc.Observations.joined([positions, replace(heights, values=heights.values + 3e-3)])
    again = dc.recalibrate(model, new).model
    before, after = model.predict_readings(q), again.predict_readings(q)
    assert [(one.kind, one.device) for one in after] == [(one.kind, one.device) for one in before]
    for one, other in zip(before, after, strict=True):
        further = 3.0 * (one.kind == "height")
        allowed = 5 * (one.deviations.square() + other.deviations.square()).sqrt()
        assert bool(((other.mean - one.mean - further).abs() < allowed)[one.mean.isfinite()].all()), one.device


def test_sockets_of_a_registered_model_are_known_as_means_of_their_rows() -> None:
    kind = kind_named("mixture")
    found = quietly(kind.model.registered, kind.moved)
    sockets = next(own for own in found.placement if own.kind == "socket")
    seen = found(kind.moved.q).detach()[:, -1].numpy()
    again = set(kind.moved.row_sockets) - {""}
    assert set(sockets.names) - again == set(kind.data.row_sockets) - {""} - again  # they stay where they were
    for name, place, deviation in zip(sockets.names, sockets.constants, sockets.deviations, strict=True):
        if name not in again:
            continue
        own = seen[[row for row, other in enumerate(kind.moved.row_sockets) if other == name]]
        assert own.mean(0) == pytest.approx(place.numpy(), abs=1e-9)
        assert own.std(0, ddof=1) / len(own) ** 0.5 == pytest.approx(deviation.numpy(), rel=1e-6)


def test_a_session_that_deviates_is_a_change_and_no_outliers() -> None:
    """A joint wears between two of three sessions."""
    model, worn = again_bank.model(again_bank.positions), ARM.worn(again_bank.WORN, 5.0)
    tables = [again_bank.positions(ARM, 16, 5), again_bank.positions(ARM, 16, 6), again_bank.positions(worn, 12, 7)]
    joint, names = ARM.nominal.joint_names[again_bank.WORN], ["a"] * 16 + ["b"] * 16 + ["c"] * 12
    rows: Any = dc.Measurements.joined(tables)
    with pytest.warns(dc.DiffeoCalibWarning, match="session 'c' deviates"):
        found: Any = dc.recalibrate(model, rows.with_sessions(names))
    assert [(one.part, one.where) for one in found.changes.found] == [(joint, "session 'c'")]
    (block,) = quietly(dc.compare, model, rows).changes.found
    assert block.where in {f"rows {first} to 43" for first in (32, 33, 34)}


def test_every_session_has_its_own_frame() -> None:
    frames: Any = next(iter(recalibrated("positions, then two sessions").placement))
    between = torch.linalg.inv(again_bank.ELSEWHERE) @ again_bank.ELSEWHERE @ again_bank.TRIPOD
    assert frames.names == ("before", "after")
    other = frames.transforms[1 - frames.reference]
    between = between if frames.reference == 0 else torch.linalg.inv(between)
    seen = again_bank.ELSEWHERE @ between @ torch.linalg.inv(again_bank.ELSEWHERE)
    torch.testing.assert_close(other[:3, :3], seen[:3, :3], rtol=0, atol=3e-4)


def test_a_ball_the_model_does_not_know_is_one_more_marker() -> None:
    found = recalibrated("positions, then sockets").model
    assert (found.markers, found.ball) == (2, True)
    torch.testing.assert_close(found.geometry.tool[1], found.geometry.tool[0], rtol=0, atol=2e-3)  # the same one here


def test_another_ball_is_found() -> None:
    """The ball of the readings sits elsewhere on the tool: neither a change nor a contradiction."""
    arm = copy.copy(again_bank.arm())
    arm.truth = replace(arm.truth, tool=arm.truth.tool + torch.tensor([[0.03, -0.02, 0.01]], dtype=torch.float64))
    found = dc.recalibrate(again_bank.model(again_bank.distance), again_bank.distance(arm, 60, 5))
    assert found.marker == "other"
    assert found.changes.found == ()
    assert again_bank.true_error(found.model, arm) < again_bank.true_error(again_bank.model(again_bank.distance), ARM)


def test_a_ball_and_a_model_of_poses_are_refused() -> None:
    kind = kind_named("poses")
    with pytest.raises(InputError, match="the new rows: expected poses"):
        dc.recalibrate(kind.model, again_bank.sockets(ARM, 30, 5).with_joint_names(kind.robot.joint_names))
