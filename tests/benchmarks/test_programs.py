"""The guard finds what is worse; kernel sums are exact, splits share no row, nothing untrue is said of clean tables."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import clean_campaigns
import false_alarms
import guard
import ours
import peers
import protocols
import pytest
import torch
from landmarks import Landmarks, Method, exact, landmarks

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

BASELINE = Path(guard.__file__).parent / "baselines" / "guard.json"
ANY_PROCESSOR = guard.Tolerance(case=1.15, mean=1.05, share=0.05, time=float("inf"))


@pytest.fixture(scope="module")
def recorded() -> guard.Cases:
    return guard.cases(guard.read(BASELINE))


def test_a_robot_is_calibrated_as_well_as_recorded(recorded: guard.Cases, monkeypatch: pytest.MonkeyPatch) -> None:
    verbs = {"calibrate", "evaluate", "predict", "registered", "recalibrate", "compare"}
    kept = {verb: work for verb, work in guard.guard_verbs.VERBS.items() if verb in verbs}
    monkeypatch.setattr(guard.guard_verbs, "VERBS", kept)
    found = guard.cases(guard.measured(guard.QUICK[0]))
    assert {verb for verb, _ in found} == verbs
    rows, worse = guard.judged(found, recorded, ANY_PROCESSOR)
    assert rows[-1]["errors"] >= 5
    assert not worse


CASE = ("calibrate", "positions")


WORSE = {"error": 1.06, "true": 1.06, "new": 0.8, "inside": 0.8, "said": 2.0}


def test_a_worse_case_is_found_and_the_baseline_is_not_worse_than_itself(recorded: guard.Cases) -> None:
    rows, worse = guard.judged(recorded, recorded, guard.Tolerance())
    assert not worse
    assert rows[-1]["mean_ratio"] == pytest.approx(1.0)
    assert not [note for own in recorded.values() for note in own.get("note", []) if note]
    for field, factor in [*WORSE.items(), ("true", None)]:
        found = copy.deepcopy(recorded)
        found[CASE][field] = [factor and factor * value for value in found[CASE][field]]
        ((sentence),) = guard.judged(found, recorded, guard.Tolerance(mean=2.0))[1]
        names = {"said": "expected and true error"}.get(field, field) if factor else "no true any more"
        assert sentence.startswith(f"calibrate, positions: {names}")


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
