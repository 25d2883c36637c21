"""Measured positions and rows in sockets: tables of both, taken apart, and what cannot be right."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from mixture_bank import TRACKED
from reading_bank import scales
from simulated_sockets import SocketRows

import diffeo_calib as dc
from diffeo_calib.calibration.placing.sockets import stages_by_sockets
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.sockets import Sockets
from diffeo_calib.robots import SimulatedArm


def test_splits_hold_out_measured_positions(mixture: dc.Measurements) -> None:
    train, test = mixture.split(0.6, seed=1)
    assert train.places is not None
    assert test.places is not None
    assert bool((test.places < 0).all())
    assert (len(test), int((train.places >= 0).sum())) == (10, 64)
    held = torch.cat([part.line_numbers for _, part in mixture.folds(5)])
    assert torch.equal(held.sort().values, torch.arange(TRACKED))


def test_joined_and_taken_apart(mixture: dc.Measurements, tracked: dc.Measurements, resting: dc.Measurements) -> None:
    assert not mixture.without_device
    assert mixture.device_rows().sha256 == tracked.rows(slice(TRACKED)).sha256
    assert mixture.socket_rows().sha256 == resting.sha256
    assert torch.equal(mixture.visible.sum(0), torch.tensor([TRACKED, len(resting)]))
    assert mixture.sha256 != dc.Measurements.joined([tracked.rows(slice(1, TRACKED + 1)), resting]).sha256
    assert "2 markers, the last one in 8 sockets in 64 of the rows" in repr(mixture)
    frame = mixture.to_frame()
    assert list(frame.columns[6:]) == ["socket", "x", "y", "z"]
    assert frame["socket"].iloc[0] == ""
    assert frame["x"].isna().sum() == len(resting)
    again = dc.Measurements.joined([mixture, tracked.rows(slice(TRACKED, None))])
    assert (len(again), again.markers) == (TRACKED + 84, 2)


def test_rows_in_sockets_join_a_mixture(mixture: dc.Measurements, resting: dc.Measurements) -> None:
    """The same as if they had been joined at once, in any order; rows in other sockets are named."""
    some = resting.rows(slice(10))
    for parts, places in (([mixture, some], slice(-10, None)), ([some, mixture], slice(10))):
        both = dc.Measurements.joined(parts)
        assert both.socket is not None
        assert both.visible[places].tolist() == [[False, True]] * 10
        assert torch.equal(both.socket[places], some.socket)  # pyright: ignore[reportArgumentType]
        assert len(both.device_rows()) == TRACKED
    marked = dc.Measurements.joined([mixture.device_rows().with_sessions(["day"] * TRACKED), resting])
    whole = dc.Measurements.joined([marked, some])
    assert whole.session is not None
    assert whole.session[-10:].tolist() == [-1] * 10
    other = dc.Measurements.from_sockets(some.q, ["x/0"] * 10, some.joint_names)
    with pytest.raises(MeasurementError, match="the tables differ in sockets;"):
        dc.Measurements.joined([mixture, other])


def test_names_and_deviations_of_both(tracked: dc.Measurements, resting: dc.Measurements, arm: SimulatedArm) -> None:
    some = dc.Measurements(tracked.q, tracked.points, tracked.joint_names, ["smr"], std=1e-5)
    both = dc.Measurements.joined([some, resting])
    assert both.marker_names == ("smr", "ball")
    assert both.std is not None
    assert torch.equal(both.std.isnan(), both.points.isnan())
    assert both.device_rows().marker_names == ("smr",)


def test_a_distance_that_contradicts_the_device(arm: SimulatedArm, rows: SocketRows, tracked: dc.Measurements) -> None:
    def known(distance: float) -> dc.Measurements:
        names, given = arm.nominal.joint_names, {("0", "1"): distance}
        resting = dc.Measurements.from_sockets(rows.q, rows.names, names, distances=given, distance_std=1e-5)
        return dc.Measurements.joined([tracked, resting])

    given = replace(scales(), other_noise=torch.tensor([2e-5], dtype=torch.float64))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dc.calibrate(arm.nominal, known(0.051), hyperparameters=given)
    (text,) = [str(one.message) for one in caught if "seems to differ" in str(one.message)]
    assert re.match(r"the distance of .*\(51.00 mm\) seems to differ by \+(0.9|1)", text), text
    with pytest.raises(MeasurementError, match="check the unit of `distances`"):
        stages_by_sockets(arm.nominal, known(50.0))


def test_rows_of_another_robot(arm: SimulatedArm, tracked: dc.Measurements, resting: dc.Measurements) -> None:
    bend = torch.zeros(6, dtype=torch.float64)
    bend[4] = 0.05
    assert resting.sockets is not None
    other = with_attributes(resting, q=resting.q + bend, sockets=Sockets(resting.sockets.names))
    with pytest.warns(dc.DiffeoCalibWarning, match="do not fit the robot whose positions were measured"):
        stages_by_sockets(arm.nominal, dc.Measurements.joined([tracked, other]))


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda t, s: [t.rows([0, 1]), s], "9 unknowns .* expected at least 3 poses"),
        (lambda t, s: [t, s.rows(slice(0, 9))], r"at least 2 rows in every socket.*, got '0/1' in 1 row"),
        (lambda t, s: [with_attributes(t, points=1e3 * t.points), s], "positions seem to be 1000 times too large"),
        (lambda t, s: [t.with_payload(1.0), s.with_payload(0.0)], "rows with sockets: expected no payloads"),
        (lambda t, s: [t.with_payload(1.0), s], "the tables differ in payload"),
        (lambda t, s: [t, s.with_joint_names([f"q{k}" for k in range(6)])], "the tables differ in joint_names"),
    ],
)  # fmt: skip
def test_refused(
    use: Callable[..., list[dc.Measurements]],
    message: str,
    arm: SimulatedArm,
    tracked: dc.Measurements,
    resting: dc.Measurements,
) -> None:
    with pytest.raises(MeasurementError, match=message):
        stages_by_sockets(arm.nominal, dc.Measurements.joined(use(tracked, resting)))
