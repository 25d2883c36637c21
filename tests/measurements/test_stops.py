"""Stops in two recordings with clocks of their own, and those that have an image."""

from __future__ import annotations

import numpy as np
import pytest

from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.stops import Recording, StopLimits, pictured, stops

STOPS, STAND_S, MOVE_S, OFFSET_S = 8, 1.5, 0.7, 0.437
NOISE_M = 2e-5


def angle(times: np.ndarray) -> np.ndarray:
    """Two joints (T, 2), rad: they stand for some time at random places, and move smoothly between these."""
    places = np.random.default_rng(0).uniform(-1, 1, (STOPS, 2))
    period = STAND_S + MOVE_S
    number = np.clip((times // period).astype(int), 0, STOPS - 1)
    share = np.clip((times - number * period - STAND_S) / MOVE_S, 0, 1)[:, None]
    after = places[np.minimum(number + 1, STOPS - 1)]
    return places[number] + (after - places[number]) * (3 * share**2 - 2 * share**3)


def place(q: np.ndarray) -> np.ndarray:
    """Where the tool is (T, 3), m."""
    return np.stack([np.cos(q[:, 0]), np.sin(q[:, 0]), q[:, 1]], 1)


def recordings(seed: int = 1) -> tuple[Recording, Recording]:
    """Joints 100 times, places 130 times a second by a clock that is behind."""
    random, last = np.random.default_rng(seed), STOPS * (STAND_S + MOVE_S)
    joints, seen = np.arange(0, last, 0.01), np.arange(0, last, 1 / 130)
    noisy = place(angle(seen)) + NOISE_M * random.standard_normal((len(seen), 3))
    return Recording(joints, angle(joints)), Recording(seen - OFFSET_S, noisy)


def test_stops_and_the_offset_are_found() -> None:
    found, offset = stops(*recordings())
    assert offset == pytest.approx(OFFSET_S, abs=0.03)
    assert len(found) == STOPS
    for number, one in enumerate(found):
        assert number * (STAND_S + MOVE_S) < one.time < number * (STAND_S + MOVE_S) + STAND_S + MOVE_S
        np.testing.assert_allclose(one.joints, angle(np.array([one.time]))[0], rtol=0, atol=5e-4)
        np.testing.assert_allclose(one.seen, place(one.joints[None])[0], rtol=0, atol=1e-4)
        assert np.all((one.deviations > 0.6 * NOISE_M) & (one.deviations < 1.6 * NOISE_M))
        assert one.count > 100


def test_recordings_without_stops_or_motions_are_refused() -> None:
    joints, seen = recordings()
    still = Recording(joints.times, np.zeros_like(joints.values))
    with pytest.raises(MeasurementError, match="offset between the clocks"):
        stops(still, seen)
    with pytest.raises(MeasurementError, match="stops"):
        stops(joints, seen, StopLimits(shortest=5.0))
    assert len(stops(joints, seen, offset=OFFSET_S)[0]) == STOPS


def test_recordings_of_different_times_are_refused() -> None:
    joints, seen = recordings()
    for offset in (None, 0.0):
        with pytest.raises(MeasurementError, match=r"-1000\.437 to -98"):
            stops(joints, Recording(seen.times - 1000, seen.values), offset=offset)
    with pytest.raises(MeasurementError, match=r"0\.000 to 17"):
        pictured(joints, seen.times + 1000)


def test_each_stop_takes_the_image_nearest_to_its_middle() -> None:
    joints, _ = recordings()
    middles = np.arange(STOPS) * (STAND_S + MOVE_S) + 0.5 * STAND_S
    times = np.concatenate([middles[1:] + 0.1, middles[1:] - 0.2, middles + 0.5 * (STAND_S + MOVE_S), [0.02]])
    found, without = pictured(joints, times - 3.0, offset=3.0)
    assert [time for _, time in found] == pytest.approx(list(middles[1:] + 0.1 - 3.0))
    assert without == 1
    np.testing.assert_allclose([q for q, _ in found], angle(middles[1:]), rtol=0, atol=5e-4)
    with pytest.raises(MeasurementError, match="without an image"):
        pictured(joints, middles[:-1] + 0.5 * (STAND_S + MOVE_S))
