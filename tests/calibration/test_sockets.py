"""A ball in sockets, alone and beside other kinds: accuracy, laws of the gauge, devices, rows that cannot be right."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from numbers_bank import normal, rigid_rms, rms, tensor
from reading_bank import DISTANCES, readings, scales
from simulated_sockets import SocketRows, rest_in_sockets
from source_bank import resting, tracked
from table_bank import refused, warned
from tangent_bank import covariance

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.plausibility import check_socket_registration
from diffeo_calib.calibration.identification.identification import KindRows, Rows, estimated, held_parameters
from diffeo_calib.calibration.identification.registration import register, register_sockets
from diffeo_calib.calibration.placing.place import Placed, place
from diffeo_calib.calibration.scales.leave_one_out import inflation_by_places
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.readings import SocketReadings
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.regression.regions import region_factor
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.sensors.coordinates import fitting_devices

KIND = kind_named("ball in sockets")
ARM, DATA = KIND.robot, KIND.data


def test_the_sockets_are_where_they_are() -> None:
    found, rows = KIND.result.sockets, rest_in_sockets(SimulatedArm(seed=0), seed=3, places=5, rows=6)
    truth = torch.stack([rows.positions[name] for name in found.names])
    T = rigid_fit(found.positions, truth)
    errors = found.positions @ T[:3, :3].mT + T[:3, 3] - truth
    assert float(errors.norm(dim=1).square().mean().sqrt()) < 9e-5
    assert 0.1 < float((errors / found.devices.deviations).square().mean()) < 2.5
    first, second = found.positions[:2]
    assert abs(float((first - second).norm()) - 0.05) < 2e-5  # known to 1e-5


@pytest.fixture(scope="module")
def placed() -> Placed:
    return place(ARM, DATA, silent)


def test_deviations_grow_where_places_contradict_each_other(placed: Placed) -> None:
    """The ratio of squared errors of left-out places, by conditioning on the rows of the others."""
    tangent, found = placed.tangent_data(), placed.identification
    scales = defaults(tangent, 0.3 * found.noise, found.prior)
    K, r, total, count = covariance(tangent, scales), tangent.target.flatten(), 0.0, int(DATA.places.max()) + 1
    for number in range(count):
        own = (DATA.places == number).repeat_interleave(3)
        gain = torch.linalg.solve(K[~own][:, ~own], K[~own][:, own]).mT
        errors, spread = r[own] - gain @ r[~own], K[own][:, own] - gain @ K[~own][:, own]
        total += float(errors @ torch.linalg.solve(spread, errors))
    ratio = total / (3 * len(DATA) - 3 * 2 * count)
    assert ratio > 1.5, "scales that are too small"

    def factor(scales: dc.Hyperparameters) -> float:
        return inflation_by_places(tangent, scales, DATA.places, DATA.device, DATA.groups())

    assert factor(scales) == pytest.approx(ratio * region_factor(count, 3), rel=1e-5)
    assert factor(defaults(tangent, 10 * found.noise, found.prior)) == region_factor(count, 3)


def test_a_size_that_is_not_the_robots_is_warned_about() -> None:
    wrong = with_attributes(DATA, distances=tuple((*own[:-1], 0.051) for own in DATA.distances), distance_std=3e-5)
    result, texts = warned(dc.calibrate, ARM, wrong, hyperparameters=scales())
    (text,) = [one for one in texts if "seems to differ" in one]
    assert re.match(r"the (distance of .*\(51.00 mm\)|size of the robot) seems to differ by \+", text), text
    assert result.lengths[0].value == pytest.approx(0.02, abs=0.006)
    assert result.expected.workspace > 3e-3


# --- rows that cannot be right ----------------------------------------------------------------------------------------

PAIR = ("0", "1")


BARE = SimulatedArm(seed=2)


@pytest.fixture(scope="module")
def some() -> SocketRows:
    return rest_in_sockets(BARE, seed=2, places=3, rows=6)


def table(rows: SocketRows, names: tuple[str, ...] | None = None, **options: object) -> SocketReadings:
    given = {"distances": DISTANCES, "distance_std": 3e-5} | options
    return dc.Measurements.from_sockets(rows.q, names or rows.names, **given)  # pyright: ignore[reportArgumentType]


def test_rows_and_distances_that_cannot_be(some: SocketRows) -> None:
    bare: Any = {"distances": None, "distance_std": None}
    device, resting = MIXED.source.rows.parts
    few = dc.Measurements.joined([device.rows([0, 1]), resting])

    def staged(data: SocketReadings) -> Callable[[], object]:
        return lambda: place(BARE.nominal, data, silent)

    refused(
        (
            r"sockets: expected at least 2 rows with each name, got '2/1' in 1 row",
            staged(table(some).rows(slice(0, 31))),
        ),
        ("9 unknowns .* expected at least 3 poses", staged(few)),
        ("sockets: expected at least 9, got 6", staged(table(some, **bare).rows([0, 1, 6, 7, 12, 13]))),
        (r"expected about (49|50)\..* mm, by the robot, got 5e\+04 mm", staged(table(some, distances={PAIR: 50.0}))),
        ("check the unit of `distances`", staged(table(some, distances={PAIR: 5e-5}))),
        ("rows with sockets: expected no sessions", lambda: table(some).with_sessions(["a"] * 18 + ["b"] * 18)),
        ("expected 'flange', got 'hand'", lambda: dc.evaluate(KIND.model, KIND.new.with_tips(["hand"]))),
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
            place(BARE.nominal, table(some, **options), silent)


def test_rows_in_a_wrong_socket_are_named(some: SocketRows) -> None:
    names = list(some.names)
    names[3], names[20] = "2/1", "0/0"
    with pytest.warns(dc.DiffeoCalibWarning, match=r"2 of 36 rows .* row 3 fits '0/0', row 20 fits '1/1'"):
        placed = place(BARE.nominal, table(some, tuple(names)), silent)
    weights = placed.identification.tails.weights.flatten()
    assert (weights < 1e-3).nonzero()[:, 0].tolist() == [3, 20], "the other rows of these sockets count"


@pytest.mark.filterwarnings("ignore:the known distance")
def test_names_that_say_nothing_are_warned_about(some: SocketRows) -> None:
    names = tuple(some.names[(7 * row) % 36] for row in range(36))
    with pytest.warns(dc.DiffeoCalibWarning, match="the ball is in no socket"):
        place(BARE.nominal, table(some, names), silent)


def test_a_tool_that_never_turns(some: SocketRows) -> None:
    q = some.q[:1].repeat(12, 1)
    q = q + normal(*q.shape, size=1e-4)
    data = dc.Measurements.from_sockets(q, ["a"] * 12)
    found = register_sockets(Geometry.nominal(BARE.nominal), data.q, data.device)
    with pytest.raises(MeasurementError, match="the tool hardly turns"):
        check_socket_registration(BARE.nominal, data, found)


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


MIXED = kind_named("mixture")
"""Marker 0 is the ball; the tracker sees marker 1."""


def test_several_set_ups_of_the_device() -> None:
    """Rows in sockets belong to no set-up, and the places of the robot to all."""
    T = twist_transform(tensor([0.1, -0.05, 0.02, 0.0, 0.2, 0.1]))
    device, resting = MIXED.source.rows.parts
    second, truth = torch.arange(len(device)) % 3 == 1, MIXED.source.truth
    points = torch.where(second[:, None, None], device.points @ T[:3, :3].mT + T[:3, 3], device.points)
    moved = with_attributes(device, points=points).with_sessions(["ab"[int(flag)] for flag in second])
    found = dc.calibrate(MIXED.robot, dc.Measurements.joined([moved, resting]), hyperparameters=MIXED.scales)
    torch.testing.assert_close(found.sessions.transforms[1], T, rtol=0, atol=5e-4)
    q = MIXED.q(100)
    assert rms(found.model(q) - truth(q)) < 1.5 * rms(MIXED.model(q) - truth(q))


@pytest.mark.filterwarnings("ignore:the place of marker 1 on 'flange'")
def test_rows_of_another_robot() -> None:
    device, resting = MIXED.source.rows.parts
    other = with_attributes(resting, q=resting.q + tensor([0.0, 0.0, 0.0, 0.0, 0.05, 0.0]), distances=())
    with pytest.warns(dc.DiffeoCalibWarning, match="do not fit the robot whose positions were measured"):
        place(MIXED.robot, dc.Measurements.joined([device, other]), silent)


def test_rows_of_a_noisy_kind_take_nothing_from_precise_ones() -> None:
    """Every kind of rows has a noise of its own: 2 mm of distances, 0.02 mm of positions of the same marker."""
    arm = SimulatedArm(seed=2, transmission=0, gravity=0, noise=2e-5)
    q, points = arm.measure(30)
    data, test = readings(arm, "distance", 120, noise=2e-3), arm.sample(200, 9)
    start = register(arm.nominal, q, points).geometry
    parts = KindRows.positions(q, points), KindRows.read(data, fitting_devices(data, start.points(data.q)))
    found = [estimated(Rows(start, some), held_parameters(start)) for some in (parts[:1], parts)]
    alone, both = (rms(one.geometry.points(test) - arm.true_points(test)) for one in found)
    assert both < 1.1 * alone
    for weights in found[1].weights:
        assert 0.5 < float(weights.median()) < 1.5


# --- tables of several kinds ------------------------------------------------------------------------------------------

PLAIN = SimulatedArm(3)


def read(kind: str, count: int) -> dc.Readings:
    return readings(PLAIN, kind, count, noise=2e-5)


def fit_of(data: dc.Observations) -> Any:
    """With the noise of each kind given."""
    noise = replace(scales(), other_noise=tensor([2e-5] * (len(data.parts) - 1)))
    return dc.calibrate(PLAIN.nominal, data, hyperparameters=noise)  # type: ignore[arg-type]


def test_sockets_and_distances_alone() -> None:
    """As good as the model says; errors of every kind are judged by themselves, and better than by geometry."""
    data: Any = dc.Observations.joined([resting(PLAIN, 4, 5), read("distance", 36)])
    result, q = fit_of(data), PLAIN.sample(200, 9)
    error = rigid_rms(result.model(q), PLAIN.true_points(q))
    assert 0.5 * result.expected.workspace < error < 1.8 * result.expected.workspace
    assert result.fit.converged
    kinds = result.errors(data)
    assert len(kinds) == 2
    for one in kinds.values():
        assert one["calibrated"].rms < one["geometric"].rms


@pytest.mark.slow
def test_the_order_of_the_rows_does_not_matter() -> None:
    data: Any = dc.Observations.joined([tracked(PLAIN, 20, 4), read("distance", 24), read("height", 24)])
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(2))
    order[order.argmin()], order[0] = order[0].clone(), 0  # positions stay the first kind
    mixed = data.rows(order.tolist())
    one, other = (fit_of(rows).model(PLAIN.sample(20, 9)) for rows in (data, mixed))
    torch.testing.assert_close(other, one, rtol=0, atol=1e-6)
