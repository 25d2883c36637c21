"""Kernel sums give the same answer every way, splits share no row, and nothing untrue is said of clean tables."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import clean_campaigns
import false_alarms
import ours
import peers
import protocols
import pytest
import torch
from landmarks import Landmarks, Method, exact, landmarks

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

ROWS = slice(0, 20)
METHODS: tuple[type[Method], ...] = (ours.Ours, ours.Dense, ours.Tiled, peers.NaiveDense, peers.DenseAutograd)


@pytest.fixture(scope="module")
def data() -> Landmarks:
    return landmarks(300, 3)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", ["sum", "rhs", "adjoint"])
def test_results_are_exact(data: Landmarks, method: type[Method], task: str) -> None:
    if task not in method.tasks:
        pytest.skip("not offered")
    for found, expected in zip(method(data).function(task, 1)(), exact(task, data, ROWS), strict=True):
        assert float((found[ROWS] - expected).norm() / expected.norm()) < 1e-11


def test_repeats_stay_on_one_side_and_all_rows_are_used() -> None:
    q, points = SimulatedArm(seed=1).measure(50)
    data = dc.Measurements(torch.cat([q, q + 1e-5]), torch.cat([points, points + 1e-6]))
    found = list(protocols.splits(data, protocols.PROTOCOLS, [30, None], seeds=2))
    assert [(split.protocol, split.size, split.index) for split in found] == [
        *(("kfold", "all", fold) for fold in range(5)),
        *(("curve", size, seed) for seed in range(2) for size in ("30", "all")),
        ("extrapolate", "all", 0),
    ]
    for split in found:
        train, test = ({tuple(row) for row in each.q.mul(1e3).round().tolist()} for each in (split.train, split.test))
        assert train.isdisjoint(test)
        assert len(split.train) == (30 if split.size == "30" else 100 - len(split.test))


TABLES = 13, *(pytest.param(number, marks=pytest.mark.slow) for number in (26, 108))


@pytest.mark.parametrize("number", TABLES)
def test_a_clean_table(number: int) -> None:
    found = false_alarms.judged(number)
    assert not found["refused"], found["texts"]
    assert not found["untrue"], found["texts"]


def test_a_mistake_is_an_untrue_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """The device was moved, and the corpus does not know it."""
    honest = clean_campaigns.campaign

    def moved(of: Any, folder: Path) -> Any:
        made = honest(replace(of, rows=60, noise_mm=0.02, off_mm=0.3), folder)
        shift = torch.zeros(60, 1, 3, dtype=torch.float64)
        shift[30:] = 0.003
        return replace(made, data=made.data.shifted(shift))

    monkeypatch.setattr(false_alarms, "campaign", moved)
    assert "something moved" in str(false_alarms.judged(22)["untrue"])
