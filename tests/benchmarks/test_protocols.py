"""Splits of the benchmark on real robots: disjoint, nested, beyond the training range."""

from __future__ import annotations

import protocols
import torch

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm


def repeated() -> dc.Measurements:
    """50 configurations, each measured twice."""
    q, points = SimulatedArm(seed=1).measure(50)
    return dc.Measurements(torch.cat([q, q + 1e-5]), torch.cat([points, points + 1e-6]))


def keys(data: dc.Measurements) -> set[tuple[float, ...]]:
    return {tuple(row) for row in data.q.mul(1e3).round().tolist()}


def test_repeats_stay_on_one_side_and_all_rows_are_used() -> None:
    data = repeated()
    found = list(protocols.splits(data, protocols.PROTOCOLS, [30, None], seeds=2))
    assert [(split.protocol, split.size, split.index) for split in found] == [
        *(("kfold", "all", fold) for fold in range(5)),
        *(("curve", size, seed) for seed in range(2) for size in ("30", "all")),
        ("extrapolate", "all", 0),
    ]
    for split in found:
        assert keys(split.train).isdisjoint(keys(split.test))
        assert len(split.train) == (30 if split.size == "30" else 100 - len(split.test))


def test_curves_are_nested_and_drawn_from_the_same_split() -> None:
    data = repeated()
    small, large, whole = protocols.curve(data, [60, 30, 5000, None], seed=1)
    train, test = data.split(0.7, 1)
    assert [len(split.train) for split in (small, large, whole)] == [30, 60, len(train)]
    assert keys(small.train) < keys(large.train) <= keys(train)
    for split in (small, large, whole):
        assert torch.equal(split.test.q, test.q)


def test_extrapolation_is_beyond_the_first_joint() -> None:
    train, test = protocols.beyond(repeated())
    assert float(train.q[:, 0].max()) <= float(test.q[:, 0].min()) + 1e-4
    assert len(train) == 70
