"""A few hundred cases of every fuzzing program: no traceback, no hang, nothing silently wrong.

A failure names the seed: `python benchmarks/robustness/PROGRAM.py --seed K --only` repeats it.
"""

from __future__ import annotations

import commands
import model_files
import pytest
import table_mutations
import tables
import urdfs
from fuzzing import Outcome, defects, judged

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, warn_user


def test_robot_descriptions() -> None:
    assert not defects("urdfs.py", urdfs.case, range(300))


def test_tables_that_are_read() -> None:
    """Those that are judged without a search for the likely mistake, which takes seconds."""
    quick = [
        seed
        for seed in range(250)
        if not any(slow.__name__ in tables.mutated(seed)[0] for slow in table_mutations.SLOW)
    ]
    quick = [seed for seed in quick if seed % tables.WHOLE_EVERY]
    found = [one for seed in quick for one in defects("tables.py", tables.case, range(seed, seed + 1))]
    assert len(quick) > 100
    assert not found


@pytest.mark.slow
def test_tables() -> None:
    assert not defects("tables.py", tables.case, range(100))


def test_model_files() -> None:
    assert not defects("model_files.py", model_files.case, range(200))


def test_commands() -> None:
    assert not defects("commands.py", commands.case, range(40))


def test_outcomes() -> None:
    """What the programs call a defect."""

    def fail() -> str:
        raise KeyError("x")

    def refuse() -> str:
        raise InputError.of("`q`", expected="numbers", got="x")

    def mumble() -> str:
        raise InputError("two\nlines")

    def warn() -> str:
        warn_user("Something looks wrong.")
        return "wrong, but not silently"

    endings = {fail: Outcome.traceback, refuse: Outcome.refused, mumble: Outcome.traceback, warn: Outcome.warned}
    for work, outcome in endings.items():
        assert judged(work)[0] is outcome
    assert judged(lambda: "")[0] is Outcome.right
    assert judged(lambda: "far off")[0] is Outcome.wrong
    assert [outcome.name for outcome in Outcome if outcome.defect] == ["traceback", "hang", "wrong"]


def test_a_wrong_axis_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pinocchio is the second opinion: a reader that takes every axis for x is found out."""
    honest = dc.load_urdf

    def careless(path: object, base: str, tip: str) -> dc.Chain:
        file = path.read_bytes().replace(b'axis xyz="0 0 1"', b'axis xyz="1 0 0"')  # pyright: ignore
        path.write_bytes(file)  # pyright: ignore
        return honest(path, base, tip)  # pyright: ignore

    monkeypatch.setattr(dc, "load_urdf", careless)
    assert any("SILENTLY WRONG" in one for one in defects("urdfs.py", urdfs.case, range(20)))
