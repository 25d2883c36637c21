"""Laws that errors of every kind of measurement obey, and crossings of kinds that are refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import reading_bank
import torch
from kind_bank import KINDS, Kind, kind_named
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows

Lines = dict[tuple[str, int], tuple[str, Tensor]]
Law = Callable[[Kind, Any], Any]


def lines(model: Any, rows: Any) -> Lines:
    """Kind and line of every row -> name of its device, and its errors."""
    found: Any = dc.evaluate(model, rows)
    each = {}
    for one in found.values() if isinstance(found, Mapping) else [found]:
        names = one.devices or [""] * len(one.errors)
        for line, name, own in zip(one.line_numbers.tolist(), names, one.errors, strict=True):
            each[one.kind, line] = name, own
    return each


LAWS: dict[str, Law] = {
    "rows in another order": lambda kind, rows: (kind.model, rows.rows(list(reversed(range(len(rows)))))),
    "joined of one part": lambda kind, rows: (kind.model, dc.Observations.joined([rows])),
    "joined of two halves": lambda kind, rows: (
        kind.model,
        dc.Measurements.joined([rows.rows(slice(0, len(rows) // 2)), rows.rows(slice(len(rows) // 2, None))]),
    ),
    "parts in another order": lambda kind, rows: (kind.model, dc.Measurements.joined(rows.parts[::-1])),
    "saved and loaded": lambda kind, rows: (dc.load(kind.file), rows),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", LAWS)
def test_the_errors_do_not_change(law: str, kind: str) -> None:
    own = kind_named(kind)
    rows = own.new.with_line_numbers(torch.arange(len(own.new)) + 100)
    expected, found = lines(own.model, rows), lines(*LAWS[law](own, rows))
    assert set(found) == set(expected)
    for key, (name, errors) in expected.items():
        assert found[key][0] == name
        assert_close(found[key][1], errors, rtol=0, atol=1e-9, equal_nan=True)


# --- several devices of one kind ------------------------------------------------------------------------------------


def wires(first: str = "wire", second: str = "interferometer") -> tuple[Any, Any, Any]:
    """Positions, and distances of devices with and without a known zero."""
    arm = SimulatedArm(0, markers=2)
    q, points = arm.measure(40, seed=5)
    tables = [reading_bank.readings(arm, "distance", 48, zero, noise=2e-5, seed=3 + bool(zero)) for zero in (0.0, 0.03)]
    named = [
        replace(own, names=tuple(f"{name} {number}" for number in range(3)))
        for own, name in zip(tables, (first, second), strict=True)
    ]
    return dc.Measurements(q, points[:, 1:], arm.nominal.joint_names), named[0], named[1]


def test_devices_with_and_without_a_known_zero_are_all_known_to_the_model() -> None:
    tables = wires()
    data = dc.Observations.joined(tables)
    model = dc.calibrate(SimulatedArm(0).nominal, data, hyperparameters=reading_bank.scales()).model  # pyright: ignore
    for judged in (*tables, data):
        assert dc.evaluate(model, judged).numbers == 0
    names = {name for own in tables[1:] for name in own.names}
    again = model.registered(data)  # pyright: ignore
    assert {name for own in again.placement for name in own.names} == names
    found: Any = dc.evaluate(again, data)
    assert found.numbers == 0
    assert max(one.rms for one in found.values()) < 1e-4


def test_one_name_for_devices_of_one_kind_that_read_in_two_ways_is_refused() -> None:
    with pytest.raises(dc.DiffeoCalibError, match=r"distances of 'wire 0', .*'wire 1'.*name"):
        dc.Observations.joined(wires("wire", "wire"))


def test_known_deviations_of_a_part_of_the_readings_of_a_device_are_refused() -> None:
    _, own, _ = wires()
    known = replace(own, std=torch.full_like(own.values, 1e-5))
    with pytest.raises(dc.DiffeoCalibError, match=r"wire 0.*deviations"):
        dc.Observations.joined([own, known])


# --- crossings that are refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", [dc.evaluate, dc.CalibratedKinematics.registered, dc.compare, dc.recalibrate])
def test_a_payload_at_another_link_is_refused(verb: Callable[[Any, Any], Any]) -> None:
    kind = kind_named("payloads")
    rows = kind.new.with_payload(kind.new.payload, at="elbow")
    with pytest.raises(dc.DiffeoCalibError, match=f"payload.*'{kind.robot.tip}'.*'elbow'"):
        verb(kind.model, rows)


def test_set_ups_of_other_markers_than_those_of_the_model_are_refused() -> None:
    with pytest.raises(dc.DiffeoCalibError, match=r"same markers.*, 2, 3.*, 1, 3"):
        dc.evaluate(kind_named("positions").model, kind_named("sessions").new)


# --- parts of tables ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", [dc.compare, dc.recalibrate])
@pytest.mark.parametrize("name", ["sessions", "markers mounted anew"])
def test_rows_of_one_set_up_of_several_are_rows_of_one(name: str, verb: Callable[[Any, Any], Any]) -> None:
    """A part of a table knows the names of all of its set-ups."""
    kind = kind_named(name)
    rows = kind.new.rows([own == kind.new.device_names[0] for own in kind.new.device_names])
    found, alone = verb(kind.model, rows), verb(kind.model, rows.with_sessions(None))
    assert_close(torch.tensor(_rms(found)), torch.tensor(_rms(alone)), rtol=1e-6, atol=1e-9)


def _rms(found: Any) -> float:
    return getattr(found, "after", found).rms


def test_a_fit_whose_part_has_rows_of_one_set_up_is_a_fit_of_one() -> None:
    kind = kind_named("sessions")
    rows = kind.data.rows([own == "Friday" for own in kind.data.device_names])
    model = dc.calibrate(kind.robot, rows, hyperparameters=kind.scales).model
    assert not model.placement


def test_errors_of_several_tips_are_a_frame() -> None:
    kind = kind_named("several tips")
    found: Any = dc.evaluate(kind.model, kind.new)
    assert found.to_frame()["angle"].to_numpy().tolist() == pytest.approx(found.angles.flatten().tolist(), nan_ok=True)


@pytest.mark.parametrize(("name", "set_up"), [("sessions", "Monday"), ("markers mounted anew", "b")])
def test_a_recalibration_with_rows_of_one_set_up_knows_where_all_of_them_are(name: str, set_up: str) -> None:
    """Its frame and markers are those of the model now; the others are where they were."""
    kind = kind_named(name)
    moved = kind.moved
    own = moved.rows([name == set_up for name in moved.device_names])
    found = dc.recalibrate(kind.model, own)
    judged: Any = dc.evaluate(found.model, own)
    assert judged.rms == pytest.approx(found.after.rms, rel=0.5)
    rows = moved if kind.data.remounted else kind.new  # markers have one measuring frame, which has moved
    for one in set(rows.device_names) - {set_up}:
        judged = dc.evaluate(found.model, rows.rows([name == one for name in rows.device_names]))
        assert judged.numbers == 0
        assert judged.rms < 3e-4
