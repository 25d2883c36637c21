"""Large sums within an accuracy: plane waves against sums over all pairs, up to a million points.

    python benchmarks/kernel_sums/accuracy.py --out accuracy.json

Points and momenta are those of the other benchmarks. Length scales are theirs, half of the cube's side, and half of
that, since waves gain less where the length scale is small. Sums over all pairs are timed up to `--exact` points, and
beyond them estimated from their number. Errors are those of 256 rows, relative to the sum of the momenta's absolute
values.

Fields of a record:

    method        "pairs", or "waves" with its accuracy
    seconds       CPU time of one sum, all threads together
    measured      whether it was timed; else that of a quarter of the points times 16
    error         the largest one in 256 rows
    peak_mib      growth of the process's largest memory by the sum
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import resource
import time
from collections.abc import Callable, Iterator

import harness
import torch
from harness import Record
from landmarks import LENGTHSCALE, landmarks
from torch import Tensor

import diffeo_calib as dc

SIZES, QUICK_SIZES, DIM = (4096, 16384, 65536, 262144, 1048576), (4096,), 3
ACCURACIES = (1e-3, 1e-6, 1e-9)
CHECKED = 256
Call = Callable[[dc.Kernel], Tensor]


def measured(call: Call, kernel: dc.Kernel) -> tuple[Tensor, Record]:
    """The result of a sum, and what it took."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    found = call(kernel)
    seconds = time.process_time() - begin
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return found, {"seconds": seconds, "measured": True, "peak_mib": grown}


def measure(sizes: tuple[int, ...], exact: int) -> Iterator[Record]:
    """One record for each length scale, task, size and method."""
    for lengthscale in (LENGTHSCALE, 0.5 * LENGTHSCALE):
        kernel, last = dc.Gaussian(lengthscale), {}
        for n in sizes:
            q, p, *_ = landmarks(n, DIM)
            some = q[:: max(1, n // CHECKED)]
            tasks: dict[str, Call] = {
                "sum": lambda k, q=q, p=p: k.field(None, q, p),
                "rhs": lambda k, q=q, p=p: k.hamiltonian_gradient(q, p)[0],
            }
            for task, call in tasks.items():
                what: Record = {"lengthscale": lengthscale, "task": task, "n": n}
                if n <= exact:
                    _, taken = measured(call, kernel.using("tiled"))
                else:
                    taken = {"seconds": 16.0 * last[task], "measured": False}
                seconds = taken["seconds"]
                last[task] = seconds
                yield what | {"method": "pairs"} | taken
                for accuracy in ACCURACIES:
                    found, taken = measured(call, kernel.using("tiled", accuracy=accuracy))
                    error = (found[:: max(1, n // CHECKED)] - kernel.field(some, q, p)).abs().max() / p.abs().sum()
                    yield what | {"method": f"waves {accuracy:g}"} | taken | {"error": float(error)}


def program() -> None:
    """Measure and report."""
    arguments = harness.parser(__doc__)
    arguments.add_argument("--exact", type=harness.count, default=65536, help="most points of a sum over all pairs")
    arguments.add_argument("--threads", type=harness.count, default=1, help="threads of the sums")
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    harness.report(measure(QUICK_SIZES if options.quick else SIZES, options.exact), options.out)


if __name__ == "__main__":
    harness.guarded(program)
