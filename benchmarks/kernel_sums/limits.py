"""Kernel sums as a share of the machine's limit: exponentials per second in cache, and memory bandwidth.

    python benchmarks/kernel_sums/limits.py --threads 1 --out limits.json

A sum over N points needs an exponential for each of N (N + 1) / 2 pairs, since the kernel is symmetric: with the
processor's rate of exponentials, and nothing else to do, that is the limit. Fused loops compute their own exponential,
a polynomial, and may pass it. Tiles stay in the cache; memory bandwidth is the limit of methods that store the N x N
matrix, which pass through it three times. Rates and sums take turns; all
times are those of the processor's cores, so that other processes count less.

Fields of a record:

    seconds                  median CPU time of all threads of one sum, divided by the number of threads
    pairs_per_second         N^2 / seconds
    exponentials_per_second  of torch.exp on 2^16 numbers, one thread, times threads
    share                    of the limit: N (N + 1) / 2 exponentials at that rate, divided by seconds
    stored_share             the same for a matrix that is stored: 3 N^2 numbers at `bytes_per_second`
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
from collections.abc import Callable, Iterator
from statistics import median

import harness
import torch
from harness import Record
from landmarks import landmarks
from ours import Fused, Tiled

SIZES, QUICK_SIZES, DIM = (1024, 4096, 16384), (1024,), 3
IN_CACHE, IN_MEMORY, CALLS = 1 << 16, 1 << 24, 50
TASKS = ("sum", "rhs", "adjoint")
METHODS = {"fused": Fused, "tiled": Tiled}


def cpu_seconds(call: Callable[[], object], calls: int = 1) -> float:
    """CPU seconds of one call, of all threads."""
    begin = time.process_time()
    for _ in range(calls):
        call()
    return (time.process_time() - begin) / calls


def rates() -> dict[str, Callable[[], float]]:
    """Functions that measure the machine: numbers and bytes per second of one thread."""
    small = -torch.rand(IN_CACHE, dtype=torch.float64)
    large, out = torch.rand(IN_MEMORY, dtype=torch.float64), torch.empty_like(small)
    target = torch.empty_like(large)
    return {
        "exponentials_per_second": lambda: IN_CACHE / cpu_seconds(lambda: torch.exp(small, out=out), CALLS),
        "bytes_per_second": lambda: 2 * 8 * IN_MEMORY / cpu_seconds(lambda: target.copy_(large)),
    }


def measure(backend: str, quick: bool, repeats: int) -> Iterator[Record]:
    """One record for each task and size."""
    threads, meters = torch.get_num_threads(), rates()
    for n in QUICK_SIZES if quick else SIZES:
        method = METHODS[backend](landmarks(n, DIM))
        for task in TASKS:
            call = method.function(task, 1)
            call()
            found: dict[str, list[float]] = {name: [] for name in (*meters, "seconds")}
            for _ in range(repeats):
                torch.set_num_threads(1)
                for name, meter in meters.items():
                    found[name].append(meter() * threads)
                torch.set_num_threads(threads)
                found["seconds"].append(cpu_seconds(call) / threads)
            medians = {name: median(values) for name, values in found.items()}
            limit = 0.5 * n * (n + 1) / medians["exponentials_per_second"]
            stored = 3 * 8 * n * n / medians["bytes_per_second"]
            yield (
                {"backend": backend, "task": task, "n": n, "threads": threads, "repeats": repeats}
                | medians
                | {
                    "pairs_per_second": n * n / medians["seconds"],
                    "share": limit / medians["seconds"],
                    "stored_share": stored / medians["seconds"],
                }
            )


def program() -> None:
    """Measure and report."""
    arguments = harness.parser(__doc__)
    arguments.add_argument("--repeats", type=harness.count, default=9, help="turns of each sum")
    arguments.add_argument("--threads", type=harness.count, default=1, help="threads of the sums")
    arguments.add_argument("--backend", choices=tuple(METHODS), default="fused", help="the sums")
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    harness.report(measure(options.backend, options.quick, options.repeats), options.out)


if __name__ == "__main__":
    harness.guarded(program)
