"""Two files as one table, joined by names, times, or stops; joints as expressions of columns, or as commanded poses."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bag_bank import place, standing
from table_bank import random_poses
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.columns import Columns, JointExpressions, PoseColumns
from diffeo_calib.measurements.csv.files import read_joints, read_poses, write_measurements
from diffeo_calib.measurements.csv.joined import HeldFile, Recording, StopLimits, joined_file, pictured, stops
from diffeo_calib.measurements.csv.lines import read_cells, write_columns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, TableFormat

JOINTS = ("pose,a,b", "p1,1,2", "p2,3,4", "p3,5,6")
PLACES = ("x,y,z,pose", "9,9,9,p3", "", "8,8,8,p1", "7,7,7,p4")


def joined(folder: Path, joints: Any = JOINTS, places: Any = PLACES, by: str = "pose", **how: bool) -> HeldFile:
    for name, lines in (("joints", joints), ("places", places)):
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return joined_file(folder / "joints.csv", folder / "places.csv", by, **how)


def test_lines_have_the_numbers_of_the_places(tmp_path: Path) -> None:
    """The column may have two names, and files separators of their own; a name in both says of which it is."""
    expected = [(2, ["p3", "5", "6", "9", "9", "9"]), (4, ["p1", "1", "2", "8", "8", "8"])]
    found = joined(tmp_path)
    assert found.sentence == (
        "2 lines of places.csv are joined with lines of joints.csv by pose; lines without a partner: "
        "1 of joints.csv (p2) and 1 of places.csv (p4)"
    )
    assert read_cells(found, ",") == (["pose", "a", "b", "x", "y", "z"], expected)
    two = joined(tmp_path, places=("x,y,z,name of the pose", *PLACES[1:]), by="pose=name of the pose")
    marks = joined(tmp_path, places=tuple(line.replace(",", ";") for line in PLACES))
    for other in (two, marks):
        assert read_cells(other, ",") == (["pose", "a", "b", "x", "y", "z"], expected)
    header, _ = read_cells(joined(tmp_path, joints=("pose,x,b", *JOINTS[1:])), ",")
    assert header == ["pose", "joints.x", "b", "places.x", "y", "z"]


def test_mistakes_name_both_files(tmp_path: Path) -> None:
    found = joined(tmp_path, places=(*PLACES[:3], "?,8,8,p1"))
    with pytest.raises(MeasurementError, match=r"places\.csv, joined with .*joints\.csv', line 4, column 'x'.*'\?'"):
        dc.read_measurements(found, ["a", "b"], ["x", "y", "z"], length="m", angle="rad")
    twice = (*PLACES, "6,6,6,p1")
    for joints, places, by, message in (
        ((*JOINTS, "p3,7,8"), PLACES, "pose", r"places\.csv', line 2, pose p3: expected one partner, got lines 4, 5"),
        (JOINTS, twice, "pose", r"joints\.csv', line 2, pose p1: .* got lines 4, 6 .*--marker"),
        (JOINTS, ("x,y,z,pose", "1,2,3,q1"), "pose", "--by pose: expected values that both files have, got 3 of"),
        (("name,a,b", *JOINTS[1:]), PLACES, "name", r"places\.csv', header: no column \['name'\]"),
    ):
        with pytest.raises(MeasurementError, match=message):
            joined(tmp_path, joints, places, by)
    assert len(read_cells(joined(tmp_path, places=twice, several=True), ",")[1]) == 3


def test_nearest_times_within_half_a_step(tmp_path: Path) -> None:
    times = [0.0, 1.0, 2.0, 5.0, 6.0, 7.0]
    joints = ("t,a", *(f"{t},{k}" for k, t in enumerate(times)))
    places = ("t,x", "0.8,10", "3.4,11", "6.3,12")
    found = joined(tmp_path, joints, places, "t")
    assert [(line, cells[1:]) for line, cells in read_cells(found, ",")[1]] == [(2, ["1", "10"]), (4, ["4", "12"])]
    assert "by the nearest time, at most 0.3 apart" in found.sentence
    assert "1 of places.csv (3.4)" in found.sentence
    other = joined(tmp_path, ("t,a", "0.8,10", "3.4,11", "6.3,12"), ("t,x", *joints[1:]), "t")
    assert [line for line, _ in read_cells(other, ",")[1]] == [3, 6]
    dates = ("t,x", "2024-06-01T09:59:59.800,10", "2024-06-01T10:00:02.400,11", "2024-06-01T10:00:05.300,12")
    dated = (f"2024-06-01 10:00:{t - 1:06.3f},{k}" for k, t in enumerate(times[1:], 1))
    third = joined(tmp_path, ("t,a", "2024-06-01 09:59:59.000,0", *dated), dates, "t")
    assert [(line, cells[1:]) for line, cells in read_cells(third, ",")[1]] == [(2, ["1", "10"]), (4, ["4", "12"])]
    assert "at most 0.3 apart" in third.sentence, "seconds"


CLOCKS = ((50.0, 53.1, 61.0), [2, 3, 4]), ((0.1, 7.0, 11.2), [2, 4]), ((50.0, 54.0, 61.0), [])


@pytest.mark.parametrize(("places", "order"), CLOCKS)
def test_the_same_stops_by_two_clocks(places: tuple[float, ...], order: list[int], tmp_path: Path) -> None:
    """Pauses that agree tell the offset; else the times are compared as they are."""
    files = ("t,a", "0,1", "3,2", "11,3"), ("t,x", *(f"{t},{k}" for k, t in enumerate(places)))
    if not order:  # pauses of other stops
        with pytest.raises(MeasurementError, match="values that both files have"):
            joined(tmp_path, *files, "t")
        return
    found = joined(tmp_path, *files, "t")
    assert [line for line, _ in read_cells(found, ",")[1]] == order
    assert ("-50.00 added" in found.sentence) == (len(order) == 3)


STOPS, STAND_S, MOVE_S, OFFSET_S = 8, 1.5, 0.7, 0.437
NOISE_M = 2e-5


def angle(times: np.ndarray) -> np.ndarray:
    """Two joints (T, 2), rad."""
    return standing(np.random.default_rng(0).uniform(-1, 1, (STOPS, 2)), STAND_S, MOVE_S, times)


def recordings(seed: int = 1) -> tuple[Recording, Recording]:
    random, last = np.random.default_rng(seed), STOPS * (STAND_S + MOVE_S)
    joints, seen = np.arange(0, last, 0.01), np.arange(0, last, 1 / 130)
    noisy = place(angle(seen)) + NOISE_M * random.standard_normal((len(seen), 3))
    return Recording(joints, angle(joints)), Recording(seen - OFFSET_S, noisy)


# 100: both on one grid of times; clocks that begin at the same number, or anywhere
@pytest.mark.parametrize(("offset", "rate"), [(1.37, 27), (0.0, 100), (9.13, 60), (-1.7e9, 50)])
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


def test_stops_the_offset_noise_and_images_are_found() -> None:
    found, offset = stops(*recordings())
    assert offset == pytest.approx(OFFSET_S, abs=0.03)
    assert len(found) == len(stops(*recordings(), offset=OFFSET_S)[0]) == STOPS
    for number, one in enumerate(found):
        assert number * (STAND_S + MOVE_S) < one.time < number * (STAND_S + MOVE_S) + STAND_S + MOVE_S
        np.testing.assert_allclose(one.joints, angle(np.array([one.time]))[0], rtol=0, atol=5e-4)
        np.testing.assert_allclose(one.seen, place(one.joints[None])[0], rtol=0, atol=1e-4)
        assert np.all((one.deviations > 0.6 * NOISE_M) & (one.deviations < 1.6 * NOISE_M))
        assert one.count > 100
    joints, _ = recordings()
    middles = np.arange(STOPS) * (STAND_S + MOVE_S) + 0.5 * STAND_S
    times = np.concatenate([middles[1:] + 0.1, middles[1:] - 0.2, middles + 0.5 * (STAND_S + MOVE_S), [0.02]])
    found, without = pictured(joints, times - 3.0, offset=3.0)
    assert [time for _, time in found] == pytest.approx(list(middles[1:] + 0.1 - 3.0))
    assert without == 1
    np.testing.assert_allclose([q for q, _ in found], angle(middles[1:]), rtol=0, atol=5e-4)
    values = 3.0 + 0.2 * np.random.default_rng(0).normal(size=(20_000, 2))
    assert Recording(np.arange(20_000.0), values).noise == pytest.approx(0.2, rel=0.03)


def test_recordings_without_stops_or_common_times_are_refused() -> None:
    joints, seen = recordings()
    still, early = Recording(joints.times, np.zeros_like(joints.values)), Recording(seen.times - 1000, seen.values)
    for call, message in (
        (lambda: stops(still, seen), "offset between the clocks"),
        (lambda: stops(joints, seen, StopLimits(shortest=5.0)), "stops"),
        (lambda: stops(joints, early), r"-1000\.437 to -98"),
        (lambda: stops(joints, early, offset=0.0), r"-1000\.437 to -98"),
        (lambda: pictured(joints, seen.times + 1000), r"0\.000 to 17"),
        (lambda: pictured(joints, np.arange(STOPS - 1) * (STAND_S + MOVE_S) + STAND_S + 0.35), "without an image"),
    ):
        with pytest.raises(MeasurementError, match=message):
            call()


@pytest.mark.parametrize(
    ("text", "factors", "constant"),
    [
        ("J1", {"J1": 1.0}, 0.0),
        ("-J2+90", {"-J2+90": 1.0}, 0.0),
        ("Base (deg) {x}", {"Base (deg) {x}": 1.0}, 0.0),
        ("-{J2}+90", {"J2": -1.0}, 90.0),
        ("{J3} + {J2}", {"J3": 1.0, "J2": 1.0}, 0.0),
        ("0.5*{J4}", {"J4": 0.5}, 0.0),
        ("{Joint-4 [deg]}/2 - 1e-1", {"Joint-4 [deg]": 0.5}, -0.1),
        ("360/4096*{ticks5}-180", {"ticks5": 360 / 4096}, -180.0),
        ("180/pi*{q}+pi/2", {"q": 180 / math.pi}, math.pi / 2),
        ("+{a}-{b}*2+{a}", {"a": 2.0, "b": -2.0}, 0.0),
    ],
)
def test_what_a_text_means(text: str, factors: dict[str, float], constant: float) -> None:
    found = JointExpressions.of([text])
    assert dict(zip(found.columns, found.matrix[0].tolist(), strict=True)) == pytest.approx(factors)
    assert float(found.offset) == pytest.approx(constant)
    assert bool(found.plain) == ("{" not in text or text.endswith("{x}"))


def test_what_is_not_linear_or_not_told_is_refused() -> None:
    for text in ("{a}*{b}", "1/{a}", "{a}/0", "{a}+1/0"):
        with pytest.raises(MeasurementError, match=r"expected a linear expression of columns.*sums of terms"):
            JointExpressions.of([text])
    for texts in (["{a}+{b}"], ["{a}", "2*{a}+1"], ["{a}+{b}", "{c}"]):
        with pytest.raises(MeasurementError, match="columns that the joints determine"):
            JointExpressions.of(texts).cells(torch.zeros(2, len(texts), dtype=torch.float64))
    for text, message in (
        ("x,y,z,a,b,c", "expected =CONVENTION behind them"),
        ("x,y,z,a,b=xyz", "expected 6 names of columns"),
        ("x,y,z,a,b,c=zz", "`convention`: expected"),
        ("x,y,x", "expected names of columns"),
        ("x,y,z,,b,c=xyz", "expected 6 names of columns"),
    ):
        with pytest.raises(MeasurementError, match=message):
            PoseColumns.of(text)


def test_a_table_is_read_and_written_in_its_own_columns(tmp_path: Path) -> None:
    """Degrees, a coupled joint and a slide in mm; the file keeps its columns, the data the robot's names."""
    texts, kinds = ["-{A}+90", "{B}+{A}", "{s}+5"], ["revolute", "revolute", "prismatic"]
    plain, path = TableFormat("mm", "deg"), tmp_path / "t.csv"
    table = replace(plain, joints=texts, kinds=kinds)
    cells = [[10.0, 20.0, 7.0], [-30.0, 5.0, 9.5]]
    path.write_text("\n".join(["note,s,A,B,x,y,z", *(f"n,{s},{a},{b},100,2,{k}" for k, (a, b, s) in enumerate(cells))]))
    rows = [[math.radians(90 - a), math.radians(a + b), (s + 5) / 1e3] for a, b, s in cells]
    expected = torch.tensor(rows, dtype=torch.float64)
    assert_close(read_joints(path, table), expected)
    names, how = ["j1", "j2", "j3"], {"length": "mm", "angle": "deg"}
    data = dc.read_measurements(path, names, ["x", "y", "z"], joints=texts, kinds=kinds, **how)
    assert data.joint_names == tuple(names)
    assert_close(data.q, expected)
    assert isinstance(data.origin, TableOrigin)
    assert "--joints '-{A}+90,{B}+{A},{s}+5'" in data.origin.options
    write_measurements(tmp_path / "again.csv", data, plain, joints=texts, kinds=kinds)
    assert (tmp_path / "again.csv").read_text().startswith("A,B,s,x,y,z")
    assert_close(read_joints(tmp_path / "again.csv", table), expected)
    moved = Columns.of(table.joints_only()).cells(expected + 0.01, {})
    write_columns(tmp_path / "new.csv", read_cells(path, table.sep), moved, plain)
    assert_close(read_joints(tmp_path / "new.csv", table), expected + 0.01)


@pytest.mark.parametrize(("length", "angle"), [("mm", "deg"), ("m", "rad")])
@pytest.mark.parametrize("convention", ["rotvec", "quat_wxyz", "matrix", "zyx", "XYZ"])
def test_commanded_poses_there_and_back(convention: str, length: str, angle: str, tmp_path: Path) -> None:
    commanded = random_poses(12)
    turns = rotation_numbers(commanded[:, :3, :3], convention, angle=angle)
    cells = torch.cat([UNITS_PER_METRE[length] * commanded[:, :3, 3], turns], 1)
    names = [f"c{k}" for k in range(cells.shape[1])]
    path = tmp_path / "commanded.csv"
    path.write_text("\n".join([",".join(names), *(",".join(map(repr, row)) for row in cells.tolist()), ""]))
    columns, table = PoseColumns.of(f"{','.join(names)}={convention}"), TableFormat(length, angle)
    assert_close(read_poses(path, replace(table, joints=columns))[1], commanded, rtol=0, atol=1e-12)
    robot = dc.cartesian(commanded)
    table = replace(table, joints=replace(columns, robot=robot))
    q = read_joints(path, table)
    assert_close(robot(q), commanded, rtol=0, atol=1e-12)
    q[2] = torch.nan  # rows without a command stay empty
    again = Columns.of(table.joints_only()).joints_from_si(q)
    assert again.isnan().all(1).tolist() == [row == 2 for row in range(12)]
    kept = torch.arange(12) != 2
    back = PoseColumns(columns.columns, convention, angle=angle).poses(again[kept])
    assert_close(back[:, :3, :3], commanded[kept, :3, :3], rtol=0, atol=1e-12)
    assert_close(again[kept, :3], cells[kept, :3], rtol=1e-12, atol=1e-12)
