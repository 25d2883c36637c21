"""Calibration with a ball in sockets: accuracy, laws of the gauge, held-out places, and rows that cannot be right."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from product_bank import with_usual_scales
from reading_bank import scales
from simulated_sockets import SocketRows, rest_in_sockets
from table_bank import refused
from tangent_bank import covariance
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.choose_scales import ChosenScales
from diffeo_calib.calibration.diagnostics.plausibility import check_socket_registration
from diffeo_calib.calibration.identification.registration import register_sockets
from diffeo_calib.calibration.placing.place import Placed, place
from diffeo_calib.calibration.placing.readings import SocketDevices
from diffeo_calib.calibration.scales.leave_one_out import inflation_by_places, leave_one_out
from diffeo_calib.calibration.scales.selection import Selection, defaults
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.readings import SocketReadings
from diffeo_calib.regression.regions import region_factor
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.robots.placement import rigid_fit

DISTANCES = {("0", "1"): 0.05}


@pytest.fixture(scope="module")
def arm() -> SimulatedArm:
    return SimulatedArm(seed=0)


@pytest.fixture(scope="module")
def rows(arm: SimulatedArm) -> SocketRows:
    return rest_in_sockets(arm, seed=0, rows=12)


@pytest.fixture(scope="module")
def data(arm: SimulatedArm, rows: SocketRows) -> SocketReadings:
    names = arm.nominal.joint_names
    return dc.Measurements.from_sockets(rows.q, rows.names, names, distances=DISTANCES, distance_std=1e-5)


@pytest.fixture(scope="module")
def result(arm: SimulatedArm, data: SocketReadings) -> Any:
    return with_usual_scales(arm.nominal, data)


def aligned(points: Tensor, truth: Tensor) -> Tensor:
    """What remains of the errors of points (N, 3) after the best rigid motion."""
    T = rigid_fit(points, truth)
    return points @ T[:3, :3].mT + T[:3, 3] - truth


def test_the_sockets_are_where_they_are(result: Any, rows: SocketRows) -> None:
    found = result.sockets
    truth = torch.stack([rows.positions[name] for name in found.names])
    errors = aligned(found.positions, truth)
    assert float(errors.norm(dim=1).square().mean().sqrt()) < 6e-5
    assert 0.1 < float((errors / found.devices.deviations).square().mean()) < 2.5
    first, second = found.positions[0], found.positions[1]
    assert abs(float((first - second).norm()) - 0.05) < 2e-5  # known to 1e-5


@pytest.fixture(scope="module")
def placed(arm: SimulatedArm, data: SocketReadings) -> Placed:
    return place(arm.nominal, data, silent)


def test_places_left_out_by_leaving_them_out(data: SocketReadings, placed: Placed) -> None:
    """Closed form against a regression without the rows of the place."""
    tangent, devices = placed.tangent_data(), placed.placement.one(SocketDevices)
    scales = defaults(tangent, placed.identification.noise, placed.identification.prior)
    chosen = ChosenScales(Selection(scales, "defaults"), tangent, leave_one_out(tangent, scales))
    socket, own = devices.device, devices.sockets.place[devices.device] == 2
    rest, gone = (flags.nonzero()[:, 0] for flags in (~own, own))
    mu = tangent.rows(rest).process(scales).mu.view(-1, 3)
    gram = tangent.linearisation(scales).gram().view(len(data), 3, len(data), 3)
    predicted = (
        torch.einsum("iajb,jb->ia", gram[gone][:, :, rest], mu) + devices.positions[socket[gone]] - tangent.target[gone]
    )
    torch.testing.assert_close(devices.left_out(chosen)[own], predicted, rtol=0, atol=1e-9)


def test_deviations_grow_where_places_contradict_each_other(data: SocketReadings, placed: Placed) -> None:
    """The ratio of squared errors of left-out places, by conditioning on the rows of the others."""
    tangent, found = placed.tangent_data(), placed.identification
    scales = defaults(tangent, 0.3 * found.noise, found.prior)
    K, r, total = covariance(tangent, scales), tangent.target.flatten(), 0.0
    for number in range(6):
        own = (data.places == number).repeat_interleave(3)
        gain = torch.linalg.solve(K[~own][:, ~own], K[~own][:, own]).mT
        errors, spread = r[own] - gain @ r[~own], K[own][:, own] - gain @ K[~own][:, own]
        total += float(errors @ torch.linalg.solve(spread, errors))
    ratio = total / (3 * len(data) - 3 * 12)
    assert ratio > 1.5, "scales that are too small"
    groups = data.groups()
    factor = inflation_by_places(tangent, scales, data.places, data.device, groups)
    assert factor == pytest.approx(ratio * region_factor(6, 3), rel=1e-5)
    wide = defaults(tangent, 10 * found.noise, found.prior)
    assert inflation_by_places(tangent, wide, data.places, data.device, groups) == region_factor(6, 3)


def test_a_size_that_is_not_the_robots_is_warned_about(arm: SimulatedArm, rows: SocketRows) -> None:
    names = arm.nominal.joint_names
    wrong = dc.Measurements.from_sockets(rows.q, rows.names, names, distances={("0", "1"): 0.051}, distance_std=3e-5)
    with pytest.warns(dc.DiffeoCalibWarning, match=r"differ") as caught:
        result = dc.calibrate(arm.nominal, wrong, hyperparameters=scales())
    (text,) = [str(one.message) for one in caught if "seems to differ" in str(one.message)]
    assert re.match(r"the (distance of .*\(51.00 mm\)|size of the robot) seems to differ by \+", text), text
    assert result.lengths[0].value == pytest.approx(0.02, abs=0.006)
    assert result.expected.workspace > 3e-3


# --- rows that cannot be right ----------------------------------------------------------------------------------------

PAIR = ("0", "1")


@pytest.fixture(scope="module")
def plain() -> SimulatedArm:
    return SimulatedArm(seed=2)


@pytest.fixture(scope="module")
def some(plain: SimulatedArm) -> SocketRows:
    return rest_in_sockets(plain, seed=2, places=3, rows=6)


def table(rows: SocketRows, names: tuple[str, ...] | None = None, **options: object) -> SocketReadings:
    given = {"distances": DISTANCES, "distance_std": 3e-5} | options
    return dc.Measurements.from_sockets(rows.q, names or rows.names, **given)  # pyright: ignore[reportArgumentType]


def test_rows_and_distances_that_cannot_be(plain: SimulatedArm, some: SocketRows) -> None:
    bare: Any = {"distances": None, "distance_std": None}
    ball = kind_named("ball in sockets")

    def staged(data: SocketReadings) -> Callable[[], object]:
        return lambda: place(plain.nominal, data, silent)

    refused(
        (
            r"sockets: expected at least 2 rows with each name, got '2/1' in 1 row",
            staged(table(some).rows(slice(0, 31))),
        ),
        ("sockets: expected at least 9, got 6", staged(table(some, **bare).rows([0, 1, 6, 7, 12, 13]))),
        (r"expected about (49|50)\..* mm, by the robot, got 5e\+04 mm", staged(table(some, distances={PAIR: 50.0}))),
        ("check the unit of `distances`", staged(table(some, distances={PAIR: 5e-5}))),
        ("rows with sockets: expected no sessions", lambda: table(some).with_sessions(["a"] * 18 + ["b"] * 18)),
        ("expected 'flange', got 'hand'", lambda: dc.evaluate(ball.model, ball.new.with_tips(["hand"]))),
        ("expected names alone", lambda: dc.Readings.of("socket", some.q, 0.0, some.names)),
        ("rows with sockets: expected no payloads", staged(table(some).with_payload(2.0))),
        *(
            ("calibrated with measured positions", lambda verb=verb: verb(kind_named("positions").model, table(some)))
            for verb in (dc.evaluate, dc.CalibratedKinematics.registered)
        ),
    )
    for options, words in (
        (bare, "the size of the robot rests on its description"),
        ({"distances": {PAIR: 0.06}}, "check between which sockets it is"),
    ):
        with pytest.warns(dc.DiffeoCalibWarning, match=words):
            place(plain.nominal, table(some, **options), silent)


def test_rows_in_a_wrong_socket_are_named(plain: SimulatedArm, some: SocketRows) -> None:
    names = list(some.names)
    names[3], names[20] = "2/1", "0/0"
    with pytest.warns(dc.DiffeoCalibWarning, match=r"2 of 36 rows .* row 3 fits '0/0', row 20 fits '1/1'"):
        placed = place(plain.nominal, table(some, tuple(names)), silent)
    weights = placed.identification.tails.weights.flatten()
    assert (weights < 1e-3).nonzero()[:, 0].tolist() == [3, 20], "the other rows of these sockets count"


@pytest.mark.filterwarnings("ignore:the known distance")
def test_names_that_say_nothing_are_warned_about(plain: SimulatedArm, some: SocketRows) -> None:
    names = tuple(some.names[(7 * row) % 36] for row in range(36))
    with pytest.warns(dc.DiffeoCalibWarning, match="the ball is in no socket"):
        place(plain.nominal, table(some, names), silent)


def test_a_tool_that_never_turns(plain: SimulatedArm, some: SocketRows) -> None:
    q = some.q[:1].repeat(12, 1)
    q = q + 1e-4 * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    data = dc.Measurements.from_sockets(q, ["a"] * 12)
    found = register_sockets(Geometry.nominal(plain.nominal), data.q, data.device)
    with pytest.raises(MeasurementError, match="the tool hardly turns"):
        check_socket_registration(plain.nominal, data, found)


def test_tables_that_cannot_be_made(some: SocketRows) -> None:
    wrong: Any = table
    named, pair = "expected 36 names, one per row, got", "expected names of two sockets"
    refused(
        (f"{named} 1", lambda: wrong(some, ("0/0",))),
        (r"18 row\(s\) have no name, the first is row 1", lambda: wrong(some, ("0/0", " ") * 18)),
        (r"1 row\(s\) have no name", lambda: wrong(some, [None, *some.names[1:]])),
        (f"{named} 'abcd'", lambda: wrong(some, "abcd")),
        (f"{named} 5", lambda: wrong(some, 5)),
        ("`distances`: expected a dictionary, got .*0.05", lambda: wrong(some, distances=[("0", "1", 0.05)])),
        ("`distance_std` without `distances`", lambda: wrong(some, distances=None)),
        ("`distance_std`: expected a positive number in m, got None", lambda: wrong(some, distance_std=None)),
        ("`distance_std`: expected a positive number", lambda: wrong(some, distance_std=-1.0)),
        ("the distance of .* expected a positive number in m", lambda: wrong(some, distances={PAIR: 0.0})),
        (f"{pair}, got .*'0/0', '0/1'", lambda: wrong(some, distances={("0", "7"): 0.1})),
        (f"a known distance: {pair}", lambda: wrong(some, distances={("0", "0"): 0.1})),
        ("expected one value", lambda: wrong(some, distances={PAIR: 0.05, ("0/0", "0/1"): 0.06})),
    )
    with pytest.warns(dc.DiffeoCalibWarning, match="1 of 2 rows repeat an earlier row"):
        dc.Measurements.from_sockets(some.q[[0, 0]], ["a", "b"])
    with pytest.warns(dc.DiffeoCalibWarning, match="between sockets are not used beside images"):
        table(some).beside_images()
    assert table(some).with_sessions(["day"] * 36).names == table(some).names
    known = wrong(some, distances={PAIR: 0.05, ("0/0", "2/1"): 0.7})
    assert known.lengths == [(0, 1, 0.05), (2, 3, 0.05), (4, 5, 0.05), (0, 5, 0.7)]


def test_splits_hold_out_whole_places(some: SocketRows) -> None:
    data = table(some)
    train, test = data.split(0.7, seed=1)
    assert (len(train), len(test)) == (24, 12)
    assert len({name.split("/")[0] for name in test.names}) == 1
    assert [*train.place_lines(test)] == []
    one, other = data.rows(data.places < 2).split(0.7)
    assert "those of 1 more are held out: --holdout 0" in "".join(one.place_lines(other))
    with pytest.raises(MeasurementError, match="expected at least 2 places with sockets, got 1"):
        test.split()
