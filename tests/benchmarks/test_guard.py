"""The guard finds what is worse; one of its robots is as good as recorded."""

import copy
from pathlib import Path

import guard
import pytest

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


def test_the_baseline_is_not_worse_than_itself(recorded: guard.Cases) -> None:
    rows, worse = guard.judged(recorded, recorded, guard.Tolerance())
    assert not worse
    assert rows[-1]["mean_ratio"] == pytest.approx(1.0)
    notes = [note for own in recorded.values() for note in own.get("note", []) if note]
    assert not notes


CASE = ("calibrate", "positions")


@pytest.mark.parametrize(
    ("field", "factor", "sentence"),
    [
        ("error", 1.06, "calibrate, positions: error"),
        ("true", 1.06, "calibrate, positions: true"),
        ("new", 0.8, "calibrate, positions: new"),
        ("inside", 0.8, "calibrate, positions: inside"),
        ("said", 2.0, "calibrate, positions: expected and true error"),
        ("true", None, "calibrate, positions: no true any more"),
    ],
)
def test_a_worse_case_is_found(recorded: guard.Cases, field: str, factor: float | None, sentence: str) -> None:
    found = copy.deepcopy(recorded)
    found[CASE][field] = [factor and factor * value for value in found[CASE][field]]
    _, worse = guard.judged(found, recorded, guard.Tolerance(mean=2.0))
    assert len(worse) == 1
    assert worse[0].startswith(sentence)
