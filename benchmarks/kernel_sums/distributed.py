"""Kernel sums, a flow with its gradient and a fit, shared by several processes, against one process.

    torchrun --nproc-per-node 2 benchmarks/kernel_sums/distributed.py --out distributed.json

Every process uses one thread (torchrun's default). One process alone and all together take turns, so that a busy
machine affects both; while one works, the others wait for its message. On GPUs start one process for each.

Tasks: `sum` (Gaussian, of points with themselves), `loss_and_gradient` (landmarks.py, one RK8 step), and `fit`: 12,000
measurements of the elastic arm, 200 control points, two Gauss-Newton steps.

Fields of a record:

    seconds_alone, seconds_together   medians of one call; speed_up: their ratio, the median of the ratios of each turn
    relative_difference               largest |difference| / |result alone| of the results (Frobenius norms)
    same_everywhere                   whether all processes have the same numbers, bit by bit
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / room) for room in ("paper_arm", "")]  # shared modules

import os
import time
from collections.abc import Callable, Iterator
from statistics import median

import harness
import torch
import torch.distributed as messages
from harness import Record
from landmarks import LENGTHSCALE, landmarks
from ours import Ours
from section_5 import section_5
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.kernels.reductions import distributed
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.robots import elastic_rr

SIZES = {"sum": (4096, 16384, 65536), "loss_and_gradient": (1024, 4096), "fit": (12_000,)}
QUICK_SIZES = {"sum": (4096,), "loss_and_gradient": (2100,), "fit": (3000,)}
CONTROLS, ITERATIONS = 200, 2


class _Flow(Ours):
    """The flow of landmarks.py on a given backend."""

    def __init__(self, n: int, device: str, backend: Backend) -> None:
        super().__init__(landmarks(n, 3, device))
        self.kernel = dc.Gaussian(lengthscale=LENGTHSCALE).using(backend).to(device)


def work(task: str, n: int, device: str) -> Callable[[Backend], list[Tensor]]:
    """A function that does the task on a backend."""
    if task == "fit":
        grid = section_5(0.01)
        x = 2.0 * torch.pi * (torch.rand(n, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5)
        joint, task_kernel = grid.spec.joint_kernel, grid.spec.task_kernel
        measured = elastic_rr.real(x)
        problem = dc.Problem(
            elastic_rr.nominal, x, measured, joint_kernel=joint, task_kernel=task_kernel, noise=0.01
        ).to(device)
        solver = dc.GaussNewton(max_iterations=ITERATIONS)
        options = {"solver": solver, "integrator": dc.RK4(2), "controls": CONTROLS}
        return lambda backend: [dc.fit(problem, backend=backend, **options).model(problem.x[:500])]
    if task == "sum":
        return lambda backend: _Flow(n, device, backend).sum()
    return lambda backend: _Flow(n, device, backend).loss_and_gradient(1)


def measure(quick: bool, repeats: int) -> Iterator[Record]:
    """One record for each task and size; every process calls it, rank 0 keeps the records."""
    own = distributed.ranks()
    device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu"
    for task, sizes in (QUICK_SIZES if quick else SIZES).items():
        for n in sizes:
            run, alone, together, ratios = work(task, n, device), [], [], []
            results: dict[str, list[Tensor]] = {}
            for turn in range(1 + (1 if quick else repeats if n < 65536 else max(3, repeats // 3))):
                if own.own == 0:
                    results["alone"], one = timed(lambda run=run: run("auto"), device)
                messages.barrier()
                results["together"], all_of_them = timed(lambda run=run: run("distributed"), device)
                messages.barrier()
                if turn and own.own == 0:  # the first turn is for caches
                    alone.append(one)
                    together.append(all_of_them)
                    ratios.append(one / all_of_them)
            record = {"task": task, "n": n, "ranks": own.count, "threads": torch.get_num_threads(), "device": device}
            record |= {"same_everywhere": same(results["together"])}
            if own.own == 0:
                record |= {"seconds_alone": median(alone), "seconds_together": median(together)}
                pairs = zip(results["together"], results["alone"], strict=True)
                difference = max(float((a - b).norm() / b.norm()) for a, b in pairs)
                yield record | {"speed_up": median(ratios), "relative_difference": difference, "repeats": len(alone)}
            else:
                yield record


def timed(call: Callable[[], list[Tensor]], device: str) -> tuple[list[Tensor], float]:
    """Results and seconds."""
    begin = time.perf_counter()
    found = call()
    if device != "cpu":
        torch.cuda.synchronize()
    return found, time.perf_counter() - begin


def same(found: list[Tensor]) -> bool:
    """Whether all processes have these numbers, bit by bit."""
    flat = torch.cat([t.detach().flatten() for t in found])
    lowest, highest = flat.clone(), flat.clone()
    messages.all_reduce(lowest, messages.ReduceOp.MIN)
    messages.all_reduce(highest, messages.ReduceOp.MAX)
    return bool(torch.equal(lowest, highest))


def program() -> None:
    """Measure; rank 0 reports."""
    arguments = harness.parser(__doc__)
    arguments.add_argument("--repeats", type=harness.count, default=9, help="turns of each task")
    options = arguments.parse_args()
    if distributed.ranks().own == 0:
        harness.report(measure(options.quick, options.repeats), options.out)
    else:
        list(measure(options.quick, options.repeats))


if __name__ == "__main__":
    harness.guarded(program)
