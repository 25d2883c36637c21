"""Two files as one table, joined by names, times, or the stops of recordings with clocks of their own."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from bag_bank import place, standing

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.joined import JoinedFile, Recording, StopLimits, joined_file, pictured, stops
from diffeo_calib.measurements.csv.lines import read_cells

JOINTS = ("pose,a,b", "p1,1,2", "p2,3,4", "p3,5,6")
PLACES = ("x,y,z,pose", "9,9,9,p3", "", "8,8,8,p1", "7,7,7,p4")


def joined(
    folder: Path, joints: tuple[str, ...] = JOINTS, places: tuple[str, ...] = PLACES, by: str = "pose", **how: bool
) -> JoinedFile:
    for name, lines in (("joints", joints), ("places", places)):
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return joined_file(folder / "joints.csv", folder / "places.csv", by, **how)


def test_lines_have_the_numbers_of_the_places(tmp_path: Path) -> None:
    found = joined(tmp_path)
    header, lines = read_cells(found, ",")
    assert header == ["pose", "a", "b", "x", "y", "z"]
    assert lines == [(2, ["p3", "5", "6", "9", "9", "9"]), (4, ["p1", "1", "2", "8", "8", "8"])]
    assert found.sentence == (
        "2 lines of places.csv are joined with lines of joints.csv by pose; lines without a partner: "
        "1 of joints.csv (p2) and 1 of places.csv (p4)"
    )


def test_the_column_may_have_two_names(tmp_path: Path) -> None:
    places = ("x,y,z,name of the pose", *PLACES[1:])
    header, lines = read_cells(joined(tmp_path, places=places, by="pose=name of the pose"), ",")
    assert header == ["pose", "a", "b", "x", "y", "z"]
    assert lines[0] == (2, ["p3", "5", "6", "9", "9", "9"])


def test_messages_name_both_files(tmp_path: Path) -> None:
    found = joined(tmp_path, places=(*PLACES[:3], "?,8,8,p1"))
    with pytest.raises(
        MeasurementError, match=r"places\.csv, joined with .*joints\.csv', line 4, column 'x'.*got '\?'"
    ):
        dc.read_measurements(found, ["a", "b"], ["x", "y", "z"], length="m", angle="rad")


def test_files_may_have_separators_of_their_own(tmp_path: Path) -> None:
    found = joined(tmp_path, places=tuple(line.replace(",", ";") for line in PLACES))
    assert read_cells(found, ",")[1][0] == (2, ["p3", "5", "6", "9", "9", "9"])


def test_a_name_in_both_files_says_of_which_it_is(tmp_path: Path) -> None:
    header, _ = read_cells(joined(tmp_path, joints=("pose,x,b", *JOINTS[1:])), ",")
    assert header == ["pose", "joints.x", "b", "places.x", "y", "z"]


def test_several_partners_are_one_error(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"places\.csv', line 2, pose p3: expected one partner, got lines 4, 5"):
        joined(tmp_path, joints=(*JOINTS, "p3,7,8"))
    twice = (*PLACES, "6,6,6,p1")
    with pytest.raises(MeasurementError, match=r"joints\.csv', line 2, pose p1: .* got lines 4, 6 .*--marker"):
        joined(tmp_path, places=twice)
    assert len(read_cells(joined(tmp_path, places=twice, several=True), ",")[1]) == 3


def test_files_without_common_values_are_one_error(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"--by pose: expected values that both files have, got 3 of joints.csv"):
        joined(tmp_path, places=("x,y,z,pose", "1,2,3,q1"))
    with pytest.raises(MeasurementError, match=r"places\.csv', header: no column \['name'\]"):
        joined(tmp_path, joints=("name,a,b", *JOINTS[1:]), by="name")


def test_nearest_times_within_half_a_step(tmp_path: Path) -> None:
    """Each line of the shorter file has a partner, unless the other one has a gap there."""
    times = [0.0, 1.0, 2.0, 5.0, 6.0, 7.0]
    joints = ("t,a", *(f"{t},{k}" for k, t in enumerate(times)))
    places = ("t,x", "0.8,10", "3.4,11", "6.3,12")
    found = joined(tmp_path, joints, places, "t")
    assert [(line, cells[1:]) for line, cells in read_cells(found, ",")[1]] == [(2, ["1", "10"]), (4, ["4", "12"])]
    assert "by the nearest time, at most 0.3 apart" in found.sentence
    assert "1 of places.csv (3.4)" in found.sentence
    other = joined(tmp_path, ("t,a", "0.8,10", "3.4,11", "6.3,12"), ("t,x", *joints[1:]), "t")
    assert [line for line, _ in read_cells(other, ",")[1]] == [3, 6]


@pytest.mark.parametrize(("second", "order"), [(3.1, [2, 3, 4]), (7.0, [2, 4])])
def test_a_row_each_of_the_same_stops_by_two_clocks(second: float, order: list[int], tmp_path: Path) -> None:
    """Pauses that agree tell the offset; else the times are compared as they are."""
    joints, places = ("t,a", "0,1", "3,2", "11,3"), ("t,x", "50.0,1", f"{50 + second},2", "61.0,3")
    if len(order) == 2:
        places = ("t,x", "0.1,1", f"{second},2", "11.2,3")
    found = joined(tmp_path, joints, places, "t")
    assert [line for line, _ in read_cells(found, ",")[1]] == order
    assert ("-50.00 added" in found.sentence) == (len(order) == 3)
    with pytest.raises(MeasurementError, match="values that both files have"):  # pauses of other stops
        joined(tmp_path, joints, ("t,x", "50,1", "54,2", "61,3"), "t")


STOPS, STAND_S, MOVE_S, OFFSET_S = 8, 1.5, 0.7, 0.437
NOISE_M = 2e-5


def angle(times: np.ndarray) -> np.ndarray:
    """Two joints (T, 2), rad."""
    return standing(np.random.default_rng(0).uniform(-1, 1, (STOPS, 2)), STAND_S, MOVE_S, times)


def recordings(seed: int = 1) -> tuple[Recording, Recording]:
    """Joints 100 times, places 130 times a second by a clock that is behind."""
    random, last = np.random.default_rng(seed), STOPS * (STAND_S + MOVE_S)
    joints, seen = np.arange(0, last, 0.01), np.arange(0, last, 1 / 130)
    noisy = place(angle(seen)) + NOISE_M * random.standard_normal((len(seen), 3))
    return Recording(joints, angle(joints)), Recording(seen - OFFSET_S, noisy)


@pytest.mark.parametrize(("offset", "rate"), [(0.0, 27), (1.37, 27), (0.0, 100)])  # 100: both on one grid of times
def test_recordings_with_clocks_of_their_own(offset: float, rate: float, tmp_path: Path) -> None:
    """One line for every stop, from its middle; columns that only count or that do not move do not matter."""
    one, two = (np.arange(first, STOPS * (STAND_S + MOVE_S), step) for first, step in ((0.0, 0.01), (0.4, 1 / rate)))
    seen = 1e3 * place(angle(two)) + np.random.default_rng(0).normal(0.0, 0.02, (len(two), 3))
    lines = (f"{t:.4f},{k},{a:.6f},{b:.6f},5" for k, (t, (a, b)) in enumerate(zip(one, angle(one), strict=True)))
    places = (f"{t - offset:.4f},{x:.4f},{y:.4f},{z:.4f}" for t, (x, y, z) in zip(two, seen, strict=True))
    found = joined(tmp_path, ("t,n,a,b,c", *lines), ("t,x,y,z", *places), "t")
    rows = np.array([[float(cell) for cell in cells] for _, cells in read_cells(found, ",")[1]])
    assert len(rows) == STOPS
    np.testing.assert_allclose(rows[:, 5:], 1e3 * place(rows[:, 2:4]), rtol=0, atol=0.2)
    words = re.search(r"middle of every stop, (\S*) s added to the times of places.csv", found.sentence)
    assert words is not None
    assert abs(float(words[1]) - offset) < 0.03


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
