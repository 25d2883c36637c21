"""Some cases of every fuzzing program: no traceback, no hang, nothing silently wrong.

A failure names the seed: `python benchmarks/robustness/PROGRAM.py --seed K --only` repeats it.
"""

import commands
import model_files
import pytest
import tables
import urdfs
from fuzzing import defects

import diffeo_calib as dc

pytestmark = pytest.mark.slow  # several calibrations


def test_robot_descriptions() -> None:
    assert not defects("urdfs.py", urdfs.case, range(200))


def test_tables_that_are_read() -> None:
    seeds = [seed for seed in range(300) if tables.depth(seed) is tables.Depth.read]
    assert len(seeds) > 250
    assert not [one for seed in seeds for one in defects("tables.py", tables.case, range(seed, seed + 1))]


@pytest.mark.parametrize("seed", [66, 366, 533, 966])
def test_a_table_that_is_registered(seed: int) -> None:
    assert tables.depth(seed) is tables.Depth.registered
    assert not defects("tables.py", tables.case, range(seed, seed + 1))


def test_model_files() -> None:
    assert not defects("model_files.py", model_files.case, range(15))


def test_commands() -> None:
    seeds = [seed for seed in range(12) if commands.mutated(seed)[0] != "fit"]
    assert not [one for seed in seeds for one in defects("commands.py", commands.case, range(seed, seed + 1))]


def test_a_wrong_axis_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pinocchio is the second opinion: a reader that takes every axis for x is found out."""
    honest = dc.load_urdf

    def careless(path: object, base: str, tip: str) -> dc.Chain:
        file = path.read_bytes().replace(b'axis xyz="0 0 1"', b'axis xyz="1 0 0"')  # pyright: ignore
        path.write_bytes(file)  # pyright: ignore
        return honest(path, base, tip)  # pyright: ignore

    monkeypatch.setattr(dc, "load_urdf", careless)
    assert any("SILENTLY WRONG" in one for one in defects("urdfs.py", urdfs.case, range(20)))
