"""Sums in several processes: the same numbers as in one, in every rank; a lost rank is an error in all others."""

import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from math_bank import rr_problem
from sum_bank import apart, points

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import GaussianProfile
from diffeo_calib.kernels.reductions import backends, distributed
from diffeo_calib.kernels.reductions.distributed import LostRankError, Ranks
from diffeo_calib.kernels.reductions.formulas import FIELD, GRADIENT, Formula
from diffeo_calib.kernels.reductions.fused import FUSED
from diffeo_calib.kernels.reductions.tiled import Tiled

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("distributed_program.py")
PATHS = os.pathsep.join(str(ROOT / name) for name in ("", "tests/banks", "benchmarks/paper_arm"))
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": PATHS}


@pytest.mark.slow
def test_torchrun_gives_every_rank_the_numbers_of_one_process(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*command, str(PROGRAM), str(tmp_path)],
        env=ENVIRONMENT, capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second = (torch.load(tmp_path / f"found_{rank}.pt") for rank in range(2))
    bounds = {"sums": 1e-12, "fits": 1e-8}  # conjugate gradients stop at 1e-11
    for name, bound in bounds.items():
        for one, other, alone in zip(first[name], second[name], first["alone"][name], strict=True):
            assert torch.equal(one, other), name
            assert float((one - alone).norm()) <= bound * float(alone.norm()), name


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("formula", [FIELD, GRADIENT])
def test_shares_add_up(count: int, formula: Formula) -> None:
    """Of points with themselves and with others, for small and for large tiles, and for compiled loops."""
    many, profile, ranks = points(701, 1), GaussianProfile(), [Ranks(own, count).mine for own in range(count)]
    for rows in (None, points(467, 2)):
        at, expected = many if rows is None else rows, Tiled().reduce(formula, profile, rows, many)
        for tiles in (Tiled(360), Tiled(10_000), Tiled(1_000_000)):
            shares = [tiles.share(formula, profile, rows, many, mine) for mine in ranks]
            sums = [torch.stack(parts).sum(0) for parts in zip(*shares, strict=True)]
            torch.testing.assert_close(formula.finish(sums, at), expected, rtol=1e-12, atol=1e-10)
        compiled = FUSED.program(formula, profile, rows, many)
        if compiled is not None:
            total = torch.stack([compiled.totals(rows, many, mine) for mine in ranks]).sum(0)
            torch.testing.assert_close(compiled.results(total, len(at.features)), expected, rtol=1e-12, atol=1e-10)


def test_what_ranks_refuse(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match=r"several processes: got no RANK, .* start it with `torchrun"):
        backends.evaluate(FIELD, GaussianProfile(), *apart(), "distributed")

    def gathered(found: list[torch.Tensor], own: torch.Tensor) -> None:
        for rank, numbers in enumerate(found):
            numbers.copy_(own * (1.0 + (1e-6 if rank else 1e-12)))

    monkeypatch.setattr(distributed.messages, "all_gather", gathered)
    with pytest.raises(LostRankError, match="the points of rank 1, 2 differ from those of rank 0"):
        Ranks(0, 3).check_agreement("the points", torch.ones(2, dtype=torch.float64))
    monkeypatch.setattr(distributed, "ranks", lambda: Ranks(0, 2))
    monkeypatch.setitem(backends.BACKENDS, "distributed", distributed.Distributed(smallest=1))
    monkeypatch.setattr(distributed.messages, "all_gather", Mock(side_effect=RuntimeError("closed by peer\n...")))
    with pytest.raises(LostRankError, match=r"rank 0 of 2 waited for another process .*\(closed by peer\)"):
        dc.fit(
            rr_problem(3), integrator=dc.RK4(1), backend="distributed"
        )  # no error of numbers, after which steps shrink
