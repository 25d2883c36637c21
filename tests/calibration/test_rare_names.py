"""A name that few rows carry is told with its rows, and with the name that was probably meant."""

from __future__ import annotations

from typing import Any

import pytest
from kind_bank import kind_named

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError


def in_sockets(data: Any, row: int, name: str) -> dc.Measurements:
    """The rows, one of them in a socket of another name."""
    names = list(data.row_sockets)
    names[row] = name
    return dc.Measurements.from_sockets(data.q, names, data.joint_names)


def in_sessions(data: Any, row: int, name: str) -> dc.Measurements:
    names = list(data.device_names)
    names[row] = name
    return data.with_sessions(names)


def of_devices(data: dc.Readings, row: int, name: str) -> dc.Readings:
    names = data.device_names
    names[row] = name
    return dc.Readings.heights(data.q, data.values[:, 0], names, data.joint_names)


def test_a_lone_socket_is_told_by_its_row() -> None:
    kind = kind_named("ball in sockets")
    words = r"'0/0x' in 1 row \(5\), perhaps meant as '0/0'"
    with pytest.raises(MeasurementError, match=words):
        dc.calibrate(kind.robot, in_sockets(kind.data, 5, "0/0x"), hyperparameters=kind.scales)
    new, words = in_sockets(kind.new, 5, "4/0x"), r"'4/0x' in 1 row \(5\), perhaps meant as '4/0'"
    found = dc.evaluate(kind.model, new)
    assert any("1 of 12 rows show no error" in text and "'4/0x' in 1 row (5)" in text for text in found.placed)
    for verb in (dc.recalibrate, dc.compare):
        with pytest.warns(DiffeoCalibWarning, match=words):
            verb(kind.model, new)


def test_a_lone_session_is_told_by_its_row() -> None:
    kind = kind_named("sessions")
    usual = kind.data.device_names[5]
    words = rf"'{usual}x' in 1 row \(5\), perhaps meant as '{usual}'"
    with pytest.raises(MeasurementError, match=words):
        dc.calibrate(kind.robot, in_sessions(kind.data, 5, f"{usual}x"), hyperparameters=kind.scales)


def test_a_lone_device_is_told_by_its_row() -> None:
    kind = kind_named("heights")
    words = r"'devise 0' in 1 row \(6\), perhaps meant as 'device 0'"
    with pytest.raises(MeasurementError, match=words):
        dc.calibrate(kind.robot, of_devices(kind.data, 6, "devise 0"), hyperparameters=kind.scales)
