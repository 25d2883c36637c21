"""Laws that errors of every kind of measurement obey, and crossings of kinds that are refused."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import reading_bank
import torch
from kind_bank import ELSEWHERE, KINDS, Kind, kind_named
from source_bank import tracked
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")]  # few rows

Lines = dict[tuple[str, int], tuple[str, Tensor]]
Law = Callable[[Kind, Any], Any]


def lines(model: Any, rows: Any) -> Lines:
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
def test_the_errors_do_not_change(kind: str) -> None:
    """Predictions come back from a file bit by bit, those without torch nearly so."""
    own = kind_named(kind)
    again, q = dc.load(own.file), own.q(20)
    for ours, theirs in zip(again.predict(q), own.model.predict(q), strict=True):
        assert_close(ours, theirs, rtol=0, atol=0)
    assert_close(torch.from_numpy(dc.interop.load_numpy(own.file)(q.numpy())), again(q), rtol=0, atol=1e-11)
    rows = own.new.with_line_numbers(torch.arange(len(own.new)) + 100)
    expected = lines(own.model, rows)
    for law, changed in LAWS.items():
        found = lines(*changed(own, rows))
        assert set(found) == set(expected), law
        for key, (name, errors) in expected.items():
            assert found[key][0] == name, law
            assert_close(found[key][1], errors, rtol=0, atol=1e-9, equal_nan=True, msg=law)


def test_a_fit_in_another_frame_is_the_fit_moved() -> None:
    kind, T = kind_named("mixture"), twist_transform(ELSEWHERE)
    parts: Any = kind.data.parts
    measured, others = ([part for part in parts if part.without_device is free] for free in (False, True))
    measured = [part.in_frames(T.expand(len(part), 4, 4)) for part in measured]
    rows, q = dc.Observations.joined([*measured, *others]), kind.q(20)
    moved, here = dc.calibrate(kind.robot, rows, hyperparameters=kind.scales), kind.result
    for there, own in ((moved.model(q), here.model(q)), (moved.sockets.positions, here.sockets.positions)):
        assert_close(there, own @ T[:3, :3].mT + T[:3, 3], rtol=0, atol=2e-6)


def wires(first: str = "wire", second: str = "interferometer") -> tuple[Any, ...]:
    arm = SimulatedArm(0, markers=2)
    tables = [reading_bank.readings(arm, "distance", 48, zero, noise=2e-5, seed=3 + bool(zero)) for zero in (0.0, 0.03)]
    names = [tuple(f"{name} {number}" for number in range(3)) for name in (first, second)]
    return tracked(arm, 40, 5, 1), *(replace(own, names=each) for own, each in zip(tables, names, strict=True))


def test_devices_with_and_without_a_known_zero() -> None:
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
    with pytest.raises(dc.DiffeoCalibError, match=r"distances of 'wire 0', .*'wire 1'.*name"):
        dc.Observations.joined(wires("wire", "wire"))
    _, own, _ = wires()
    known = replace(own, std=torch.full_like(own.values, 1e-5))
    with pytest.raises(dc.DiffeoCalibError, match=r"wire 0.*deviations"):
        dc.Observations.joined([own, known])


@pytest.mark.parametrize("verb", [dc.evaluate, dc.CalibratedKinematics.registered, dc.compare, dc.recalibrate])
def test_a_payload_at_another_link_is_refused(verb: Callable[[Any, Any], Any]) -> None:
    kind = kind_named("payloads")
    rows = kind.new.with_payload(kind.new.payload, at="elbow")
    with pytest.raises(dc.DiffeoCalibError, match=f"payload.*'{kind.robot.tip}'.*'elbow'"):
        verb(kind.model, rows)


def test_set_ups_of_other_markers_than_those_of_the_model_are_refused() -> None:
    with pytest.raises(dc.DiffeoCalibError, match=r"same markers.*, 2, 3.*, 1, 3"):
        dc.evaluate(kind_named("positions").model, kind_named("sessions").new)


@pytest.mark.parametrize("name", ["sessions", "markers mounted anew"])
def test_rows_of_one_set_up_of_several_are_rows_of_one(name: str) -> None:
    """A part of a table knows the names of all of its set-ups."""
    kind = kind_named(name)
    rows = kind.new.rows([own == kind.new.device_names[0] for own in kind.new.device_names])
    for verb in (dc.compare, lambda *given: dc.recalibrate(*given).after):
        assert verb(kind.model, rows).rms == pytest.approx(
            verb(kind.model, rows.with_sessions(None)).rms, rel=1e-6, abs=1e-9
        )


def test_a_fit_whose_part_has_rows_of_one_set_up_is_a_fit_of_one() -> None:
    kind = kind_named("sessions")
    rows = kind.data.rows([own == "Friday" for own in kind.data.device_names])
    model = dc.calibrate(kind.robot, rows, hyperparameters=kind.scales).model
    assert not model.placement


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


def test_a_row_alone_in_its_socket_shows_no_error() -> None:
    kind = kind_named("ball in sockets")
    names = kind.new.device_names
    rows = kind.new.rows([*(k for k, name in enumerate(names) if name == names[0]), names.index("4/1")])
    found: Any = dc.evaluate(kind.model, rows)
    assert found.count == len(rows) - 1
    assert found.errors[-1].isnan()
    assert found.rms == pytest.approx(dc.evaluate(kind.model, rows.rows(slice(0, -1))).rms)
    assert any(f"1 of {len(rows)} rows show no error" in line for line in found.placed)


@pytest.mark.parametrize("verb", [dc.evaluate, dc.compare, dc.recalibrate])
def test_rows_that_are_all_alone_in_their_sockets_are_refused(verb: Callable[[Any, Any], Any]) -> None:
    kind = kind_named("ball in sockets")
    lone = kind.new.rows([kind.new.device_names.index(name) for name in dict.fromkeys(kind.new.device_names)])
    with pytest.raises(dc.DiffeoCalibError, match=r"2 rows, each of them alone in its socket.*twice"):
        verb(kind.model, lone)


@pytest.mark.parametrize("name", ["several kinds", "inclinations", "images and a tracker"])
def test_devices_are_kept_where_positions_alone_are_registered(name: str) -> None:
    kind = kind_named(name)
    model, before = kind.model, dc.evaluate(kind.model, kind.new)
    names = [own.names for own in model.placement]
    parts: Any = kind.moved.parts
    (measured,) = (part for part in parts if not part.without_device)
    for T in (torch.eye(4, dtype=torch.float64), twist_transform(0.5 * ELSEWHERE)):
        rows = measured.in_frames(T.expand(len(measured), 4, 4))
        model = model.registered(rows, learn=False)  # else `recalibrate` would count them twice
        assert [own.names for own in model.placement] == names
    judged = dc.Observations.joined([rows, *(part for part in parts if part.without_device)])
    for again in (model, dc.recalibrate(model, rows).model):
        found: Any = dc.evaluate(again, judged)
        assert found.numbers == 0
        for one, errors in found.items():
            assert errors.rms < 2.0 * before[one].rms, one  # pyright: ignore[reportIndexIssue]


def test_a_marker_in_place_of_the_ball_makes_a_model_forget_its_gauges() -> None:
    kind = kind_named("distances")
    q = kind.q(12)
    rows = dc.Measurements(q, kind.source.truth(q), kind.robot.joint_names)
    with pytest.warns(dc.DiffeoCalibWarning, match="no longer knows the devices 'device 0', 'device 1', 'device 2'"):
        found = kind.model.registered(rows)
    assert not found.placement


@pytest.mark.parametrize("on_tool", [True, False])
def test_poses_of_another_mounting_are_warned_about(on_tool: bool) -> None:
    kinds = [kind_named(name) for name in ("poses", "camera on the tool")]
    own, other = kinds if on_tool else kinds[::-1]
    with pytest.warns(dc.DiffeoCalibWarning, match=r"not those of a calibrated robot: expected a median of"):
        dc.evaluate(own.model, other.new)


@pytest.mark.parametrize("name", ["sessions", "two cameras"])
def test_set_ups_of_the_fit_stay_where_it_found_them(name: str) -> None:
    kind = kind_named(name)
    found: Any = dc.evaluate(kind.model, kind.new)
    assert found.numbers == 0
    first, second = kind.data.session_names
    known = torch.tensor([own == second for own in kind.new.device_names])
    few: Any = dc.evaluate(kind.model, kind.new.rows(known.nonzero()[:3, 0]))
    assert_close(few.errors, found.rows(known).errors[:3], equal_nan=True)
    new = kind.new.with_sessions([own.replace(first, "new") for own in kind.new.device_names])
    partly: Any = dc.evaluate(kind.model, new)
    assert partly.numbers == 6
    assert sum("away from that of the model" in line for line in partly.placed) == 1
    assert_close(partly.rows(known).errors, found.rows(known).errors, equal_nan=True)
    assert partly.rows(~known).rms < 1.2 * found.rows(~known).rms


def wrong_rows(model: Any, rows: Any, **options: Any) -> tuple[int, ...]:
    found = model.registered(rows.with_line_numbers(torch.arange(len(rows))), **options).registration
    assert found is not None
    return found.outliers


@pytest.mark.parametrize("name", ["camera on the tool", "two cameras", "images of a board", "images and a tracker"])
def test_no_clean_row_contradicts_the_others(name: str) -> None:
    found = kind_named(name).registered.registration
    assert found is not None
    assert found.outliers == ()


@pytest.mark.parametrize("name", ["camera on the tool", "two cameras"])
def test_a_row_that_contradicts_all_others_is_named_and_no_other(name: str) -> None:
    """Rows of cameras differ in their noise, and images share the errors of a lens."""
    kind = kind_named(name)
    rows = kind.new.largest_session()
    moved = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    moved[4, 0, 3] = 5e-3
    assert wrong_rows(kind.model, rows.in_frames(moved)) == (4,)


def test_two_rows_that_were_exchanged_are_named() -> None:
    kind = kind_named("camera on the tool")
    q = kind.new.q.clone()
    q[[0, 3]] = q[[3, 0]]
    assert set(wrong_rows(kind.model, with_attributes(kind.new, q=q), free="base")) == {0, 3}


def test_a_lens_that_is_known_poorly_hardly_moves_the_frame() -> None:
    """Errors of millimetres that images share are found together with the frame, which they do not leave open."""
    kind = kind_named("images of a board")
    rows = with_attributes(kind.new, pose_shared=10.0 * kind.new.pose_shared)
    (errors,) = rows.shared_errors()
    shift = (errors.slopes @ torch.ones(errors.slopes.shape[2], dtype=torch.float64)).view_as(rows.points)
    assert float(shift.abs().max()) > 1e-3
    both = rows, with_attributes(rows, points=rows.points + shift)
    before, after = (kind.model.registered(one, learn=False) for one in both)
    assert_close(after(kind.q(20)), before(kind.q(20)), rtol=0, atol=5e-5)
    assert after.registration.outliers == ()
