"""Groups of repeated configurations, splits and folds."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from table_bank import says, some

from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import FEWEST_PER_DEVICE, REPEAT_TOLERANCE
from diffeo_calib.measurements.table import Measurements


def test_groups_gather_around_their_first_row_and_do_not_chain() -> None:
    step = 0.9 * REPEAT_TOLERANCE
    q = [[2.0, 0.0], [0.0, 0.0], [step, -step], [2 * step, 0.0], [2.0, 1.1 * REPEAT_TOLERANCE]]
    data = Measurements(q, np.arange(15.0).reshape(5, 3))
    assert data.groups().tolist() == [0, 1, 1, 2, 3]
    assert data.groups(tolerance=0.5 * step).tolist() == [0, 1, 2, 3, 4]
    assert data.groups().dtype == torch.int64


@st.composite
def repeated_measurements(draw: st.DrawFn) -> Measurements:
    """Between 2 and 8 configurations, each measured 1 to 6 times with some jitter, in random order."""
    sizes = draw(st.lists(st.integers(1, 6), min_size=2, max_size=8))
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))
    label = rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    q = np.stack([label * 0.5, label % 3], axis=1) + rng.uniform(-4e-4, 4e-4, (len(label), 2))
    points = np.stack([np.arange(len(label)), label, 0 * label], axis=1)  # x: the row, y: its group
    return Measurements(q, points)


def identity(data: Measurements) -> list[int]:
    return data.points[:, 0, 0].int().tolist()


def configuration(data: Measurements) -> list[int]:
    return data.points[:, 0, 1].int().tolist()


@given(repeated_measurements(), st.floats(0.05, 0.95), st.integers(0, 5))
def test_split_is_complete_disjoint_and_cuts_no_group(data: Measurements, fraction: float, seed: int) -> None:
    train, test = data.split(fraction, seed)
    assert sorted(identity(train) + identity(test)) == list(range(len(data)))
    assert identity(train) == sorted(identity(train))
    assert not set(configuration(train)) & set(configuration(test))
    assert len(train) > 0
    assert len(test) > 0
    largest = int(torch.bincount(data.groups()).max())
    assert abs(len(train) - round(fraction * len(data))) <= largest
    assert identity(data.split(fraction, seed)[0]) == identity(train)


@given(repeated_measurements(), st.integers(2, 4), st.integers(0, 5))
def test_folds_cover_every_row_once_and_cut_no_group(data: Measurements, k: int, seed: int) -> None:
    distinct = len(set(configuration(data)))
    if distinct < k:
        with pytest.raises(MeasurementError, match=says(f"{k} folds", f"got {distinct}")):
            data.folds(k, seed)
        return
    folds = data.folds(k, seed)
    assert len(folds) == k
    assert sorted(row for _, test in folds for row in identity(test)) == list(range(len(data)))
    for train, test in folds:
        assert sorted(identity(train) + identity(test)) == list(range(len(data)))
        assert not set(configuration(train)) & set(configuration(test))
    sizes = [len(test) for _, test in folds]
    assert max(sizes) - min(sizes) <= int(torch.bincount(data.groups()).max())


def test_split_without_repeats_is_exact_and_depends_on_the_seed() -> None:
    data = some(100)
    first, second = data.split(0.7, seed=0)[0], data.split(0.7, seed=1)[0]
    assert len(first) == len(second) == 70
    assert not torch.equal(first.q, second.q)
    assert [len(test) for _, test in data.folds(4)] == [25] * 4


@pytest.mark.parametrize("seed", range(5))
def test_a_device_keeps_the_rows_that_place_it(seed: int) -> None:
    data = some(60).with_sessions(["few"] * 10 + ["many"] * 50)
    train, test = data.split(0.7, seed)
    assert train.device_names.count("few") >= FEWEST_PER_DEVICE
    assert test.device_names.count("few") <= 2
    lone = some(10).with_sessions(["few"] * 10)
    assert len(lone.split(0.3, seed)[1]) == 2
    assert len(lone.rows(slice(0, 5)).split(0.6, seed)[1]) == 2  # too few in any case


@pytest.mark.parametrize("seed", range(5))
def test_devices_of_other_kinds_are_others_whatever_their_names(seed: int) -> None:
    table, names = some(30), ["one"] * 9 + ["two"] * 21
    given = table.q, torch.ones(30, dtype=torch.float64), names, table.joint_names
    train, _ = Observations.joined([Readings.distances(*given), Readings.heights(*given)]).split(0.6, seed)
    assert all(part.device_names.count("one") >= FEWEST_PER_DEVICE for part in train.parts)


def test_split_refuses_what_cannot_be_split() -> None:
    repeated = Measurements(np.full((3, 2), 0.5), np.arange(9.0).reshape(3, 3))
    for data in (repeated, some(1)):
        with pytest.raises(MeasurementError, match=says("cannot split", "2 distinct configurations", "got 1")):
            data.split()
    for fraction in (0.0, 1.0, 70, math.nan):
        with pytest.raises(MeasurementError, match=says("`fraction`", "between 0 and 1")):
            some(10).split(fraction)
    with pytest.raises(MeasurementError, match=says("`k`", "at least 2")):
        some(10).folds(1)
