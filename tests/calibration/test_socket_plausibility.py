"""Rows in sockets that cannot be right are refused or named; tables that are no such rows, too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from product_bank import with_usual_scales
from simulated_sockets import SocketRows, rest_in_sockets
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.socket_plausibility import check_registration, check_sockets
from diffeo_calib.calibration.identification.registration import register_sockets
from diffeo_calib.calibration.placing.sockets import stages_by_sockets
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.robots import SimulatedArm

PAIR = ("0", "1")
DISTANCES = {PAIR: 0.05}


@pytest.fixture(scope="module")
def arm() -> SimulatedArm:
    return SimulatedArm(seed=2)


@pytest.fixture(scope="module")
def rows(arm: SimulatedArm) -> SocketRows:
    return rest_in_sockets(arm, seed=2, places=3, rows=6)


def table(rows: SocketRows, names: tuple[str, ...] | None = None, **options: object) -> dc.Measurements:
    given = {"distances": DISTANCES, "distance_std": 3e-5} | options
    return dc.Measurements.from_sockets(rows.q, names or rows.names, **given)  # pyright: ignore[reportArgumentType]


def test_clean_rows_pass(arm: SimulatedArm, rows: SocketRows) -> None:
    places, placed, (registration, identification) = stages_by_sockets(arm.nominal, table(rows))
    assert identification.rms < registration.rms < 2e-3
    assert len(places.positions) == 6
    assert bool(placed.points.isfinite().all())


def test_rows_and_distances_that_cannot_be(arm: SimulatedArm, rows: SocketRows) -> None:
    bare: Any = {"distances": None, "distance_std": None}

    def staged(data: dc.Measurements) -> Callable[[], object]:
        return lambda: stages_by_sockets(arm.nominal, data)

    refused(
        (r"at least 2 rows in every socket.*, got '2/1' in 1 row", staged(table(rows).rows(slice(0, 31)))),
        ("sockets: expected at least 9, got 6", staged(table(rows, **bare).rows([0, 1, 6, 7, 12, 13]))),
        (r"expected about (49|50)\..* mm, by the robot, got 5e\+04 mm", staged(table(rows, distances={PAIR: 50.0}))),
        ("check the unit of `distances`", staged(table(rows, distances={PAIR: 5e-5}))),
    )
    for options, words in (
        (bare, "the size of the robot rests on its description"),
        ({"distances": {PAIR: 0.06}}, "check between which sockets it is"),
    ):
        with pytest.warns(dc.DiffeoCalibWarning, match=words):
            stages_by_sockets(arm.nominal, table(rows, **options))


def test_rows_in_a_wrong_socket_are_named(arm: SimulatedArm, rows: SocketRows) -> None:
    names = list(rows.names)
    names[3], names[20] = "0/1", "0/0"
    with pytest.warns(dc.DiffeoCalibWarning, match=r"2 of 36 rows .* row 3 fits '0/0', row 20 fits '1/1'"):
        stages_by_sockets(arm.nominal, table(rows, tuple(names)))


@pytest.mark.filterwarnings("ignore:the known distance")
def test_names_that_say_nothing_are_warned_about(arm: SimulatedArm, rows: SocketRows) -> None:
    names = tuple(rows.names[(7 * row) % 36] for row in range(36))
    with pytest.warns(dc.DiffeoCalibWarning, match="the ball is in no socket"):
        stages_by_sockets(arm.nominal, table(rows, names))


def turned(rows: SocketRows, arm: SimulatedArm, change: Callable[[torch.Tensor], torch.Tensor]) -> dc.Measurements:
    """Rows that differ in the last joints alone: how the tool turns is then known."""
    return dc.Measurements.from_sockets(change(rows.q[:1].repeat(12, 1)), ["a"] * 12)


def test_a_tool_that_never_turns_or_tilts(arm: SimulatedArm, rows: SocketRows) -> None:
    def still(q: torch.Tensor) -> torch.Tensor:
        return q + 1e-4 * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)

    def upright(q: torch.Tensor) -> torch.Tensor:
        q[:, 0] += torch.linspace(-0.8, 0.8, 12, dtype=q.dtype)
        return q

    for change, expect in ((still, pytest.raises(MeasurementError, match="the tool hardly turns")),
                           (upright, pytest.warns(dc.DiffeoCalibWarning, match="never tilted"))):  # fmt: skip
        data = turned(rows, arm, change)
        with expect:
            check_registration(arm.nominal, data, register_sockets(arm.nominal, data.q, data.socket))


def test_tables_that_cannot_be_made(rows: SocketRows) -> None:
    wrong: Any = table
    refused(
        ("`sockets`: expected 36 names, one per row, got 1", lambda: wrong(rows, ("0/0",))),
        (r"18 row\(s\) have no name, the first is row 1", lambda: wrong(rows, ("0/0", " ") * 18)),
        (r"1 row\(s\) have no name", lambda: wrong(rows, [None, *rows.names[1:]])),
        ("expected 36 names, one per row, got 'abcd'", lambda: wrong(rows, "abcd")),
        ("expected 36 names, one per row, got 5", lambda: wrong(rows, 5)),
        ("`distances`: expected a dictionary, got .*0.05", lambda: wrong(rows, distances=[("0", "1", 0.05)])),
        ("`distance_std` without `distances`", lambda: wrong(rows, distances=None)),
        ("`distance_std`: expected a positive number in m, got None", lambda: wrong(rows, distance_std=None)),
        ("`distance_std`: expected a positive number", lambda: wrong(rows, distance_std=-1.0)),
        ("the distance of .* expected metres above 0", lambda: wrong(rows, distances={("0", "1"): 0.0})),
        ("expected names of two sockets, got .*'0/0', '0/1'", lambda: wrong(rows, distances={("0", "7"): 0.1})),
        ("a known distance: expected names of two sockets", lambda: wrong(rows, distances={("0", "0"): 0.1})),
        ("expected one value", lambda: wrong(rows, distances={("0", "1"): 0.05, ("0/0", "0/1"): 0.06})),
    )


def test_distances_by_name(rows: SocketRows) -> None:
    known: Any = table(rows, distances={("0", "1"): 0.05, ("0/0", "2/1"): 0.7}).sockets
    assert known.distances == ((0, 1, 0.05), (2, 3, 0.05), (4, 5, 0.05), (0, 5, 0.7))
    assert known.place_names == ("0", "1", "2")


def test_splits_hold_out_whole_places(rows: SocketRows) -> None:
    data = table(rows)
    train, test = data.split(0.7, seed=1)
    assert (len(train), len(test)) == (24, 12)
    names = {data.sockets.names[k].split("/")[0] for k in test.socket.tolist()}  # pyright: ignore
    assert len(names) == 1
    assert sorted(len(held) for _, held in data.folds(3)) == [12, 12, 12]
    with pytest.raises(MeasurementError, match="expected at least 4 places with sockets, got 3"):
        data.folds(4)


def test_no_position_is_made_up(arm: SimulatedArm, rows: SocketRows, tmp_path: object) -> None:
    data = table(rows)
    assert bool(data.points.isnan().all())
    assert "6 sockets" in repr(data)
    assert data.sha256 != table(rows, distance_std=1e-5).sha256
    names = tuple(reversed(rows.names))
    assert data.sha256 != table(rows, names).sha256
    tracked = with_usual_scales(arm.nominal, dc.Measurements(*arm.measure(15, seed=2))).model
    for verb in (dc.evaluate, dc.CalibratedKinematics.registered):
        with pytest.raises(InputError, match="calibrated with measured positions"):
            verb(tracked, data)
    with pytest.raises(MeasurementError, match="rows with sockets: expected no sessions"):
        dc.calibrate(arm.nominal, data.with_sessions(["a"] * 18 + ["b"] * 18))
    with pytest.raises(MeasurementError, match="rows with sockets: expected no payloads"):
        check_sockets(arm.nominal, data.with_payload(2.0))


def test_rows_in_sockets_are_shown_and_joined() -> None:
    q = torch.arange(8, dtype=torch.float64).view(4, 2)
    data = dc.Measurements.from_sockets(q, ["a/0", "a/1"] * 2)
    assert "2 sockets" in data._repr_html_()
    frame = data.to_frame()
    assert list(frame.columns) == ["q1", "q2", "socket"]
    assert list(frame["socket"]) == ["a/0", "a/1"] * 2
    joined = dc.Measurements.joined([data, data])
    assert torch.equal(joined.socket, data.socket.repeat(2))  # pyright: ignore[reportArgumentType, reportOptionalMemberAccess]
    other = dc.Measurements.from_sockets(q, ["a/0", "b/1"] * 2)
    with pytest.raises(MeasurementError, match="the tables differ in sockets; join rows"):
        dc.Measurements.joined([data, other])
