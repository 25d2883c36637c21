"""The benchmark of kernel sums: every method in torch computes the same, and the program writes complete records."""

from __future__ import annotations

from argparse import Namespace

import lazy_vs_dense
import ours
import peers
import pytest
import torch
from landmarks import TASKS, Landmarks, Method, exact, landmarks

from diffeo_calib.kernels.reductions.backends import BACKENDS

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

ROWS = slice(0, 20)
METHODS: tuple[type[Method], ...] = (ours.Ours, ours.Dense, ours.Tiled, peers.NaiveDense, peers.DenseAutograd)


@pytest.fixture(scope="module")
def data() -> Landmarks:
    """More points than a tile has rows."""
    return landmarks(300, 3)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", ["sum", "rhs", "adjoint"])
def test_results_are_exact(data: Landmarks, method: type[Method], task: str) -> None:
    if task not in method.tasks:
        pytest.skip("not offered")
    for found, expected in zip(method(data).function(task, 1)(), exact(task, data, ROWS), strict=True):
        assert float((found[ROWS] - expected).norm() / expected.norm()) < 1e-11


@pytest.mark.parametrize("task", TASKS)
def test_tiles_of_plain_matrices_change_nothing(data: Landmarks, task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pooled = ours.Tiled(data).function(task, 1)()
    monkeypatch.setitem(BACKENDS, "tiled", ours.PlainTiles())
    for one, other in zip(ours.Tiled(data).function(task, 1)(), pooled, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-13)


def test_time_steps_have_their_order(data: Landmarks) -> None:
    small = Landmarks(*(part[:40] for part in data))
    end = ours.Dense(small).endpoint(6)
    coarse, fine = (float((ours.TiledRK4(small).endpoint(steps) - end).abs().max()) for steps in (4, 8))
    assert 10 < coarse / fine < 25  # 2^4
    assert float((peers.DenseAutograd(small).endpoint(8) - end).abs().max()) == pytest.approx(fine, rel=1e-3)


@pytest.mark.slow
def test_the_program_measures_in_processes() -> None:
    plan = Namespace(devices=["cpu"], dims=[2], tasks=["sum", "loss_and_gradient"], sizes=[64], repeats=2, quick=True)
    plan.backends = ["tiled", "naive_dense"]
    records = list(lazy_vs_dense.measure(plan))
    assert [(record["task"], record["backend"]) for record in records] == [
        *(("sum", backend) for backend in plan.backends),
        ("loss_and_gradient", "tiled"),
    ]
    for record in records:
        assert record["failure"] is None
        assert 0.0 < lazy_vs_dense.number(record, "least_seconds") <= lazy_vs_dense.number(record, "seconds")
        assert lazy_vs_dense.number(record, "relative_error") < (1e-12 if record["task"] == "sum" else 1e-5)
