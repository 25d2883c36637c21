"""Kernel sums and a whole flow with its gradient: the package's backends against other ways of writing them.

    python benchmarks/kernel_sums/lazy_vs_dense.py --out sums.json

landmarks.py describes the tasks and the problem. Backends of the package: dense, tiled, keops, and
keops_default_flags (the same formulas with pykeops' own compiler flags and summation scheme); tiled_rk4 is tiled
with RK4 as time stepping (all other rows use RK8), tiled_unpooled is tiled with new matrices for every tile. Peers:
peers.py (naive_dense, dense_autograd, keops_tutorial, keops_tuned), peers_jax.py (diffrax) and peers_c.py (c).

Every case runs in its own process (worker.py; with --quick there is one process per backend); the processes of one
task and size are timed in turn. On a busy machine use --threads 1: two threads wait for each other. In
`loss_and_gradient` every method takes the fewest steps that make its end point as accurate as the package's RK4 with
5 steps. `adjoint` of the autograd peers is the backward pass alone; its graph is built before.

Fields of a record:

    seconds, cpu_seconds   medians of one call, wall time and processor time of all threads; least_seconds: the minimum
    compile_seconds        before the first call: importing pykeops, compiling or loading, starting threads
    peak_mib               peak memory of the first call, above the memory in use before it
    relative_error         largest |difference| / |exact| of the results (Frobenius norms); exact is, for sum, rhs and
                           adjoint, 64 rows summed from plain differences, for loss_and_gradient the gradient by the
                           package's RK8 with 6 steps (3 steps above 1024 points)
    endpoint_error         largest error of a coordinate of q(1) against that run
    steps, threads         as used; auto: whether the package would choose this backend
    failure                why there are no numbers
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import math
import os
from argparse import Namespace
from collections.abc import Iterable, Iterator
from itertools import groupby, product
from statistics import median

import harness
import torch
from harness import Record
from landmarks import SCALING_ROWS, TASKS, exact, landmarks
from ours import Dense, Ours, TiledRK4
from rich.console import Console
from worker import METHODS, Case, Goal, Worker, WorkerError

from diffeo_calib.kernels.reductions import backends

OURS = ("dense", "fused", "tiled", "keops", "keops_default_flags", "tiled_rk4", "tiled_unpooled")
PEERS = ("naive_dense", "dense_autograd", "keops_tutorial", "keops_tuned", "diffrax", "c")
SIZES = {"cpu": (256, 1024, 4096, 16384), "cuda": (1024, 4096, 16384, 100_000, 1_000_000)}
DIMS = (2, 3, 6)
STEPS, REFERENCE_STEPS, CHEAPER_REFERENCE_STEPS, CHEAP_POINTS = 5, 6, 3, 1024
REFERENCE_POINTS = {"cpu": 16384, "cuda": 100_000}
"""Most points for which the flow is integrated with the reference's many steps."""
EXACT_ROWS, EXACT_PAIRS = 64, 1 << 24
LIMIT_SECONDS, EXPENSIVE_SECONDS, START_SECONDS, COMPILE_SECONDS = 60.0, 2.0, 120.0, 900.0
REPEATS, EXPENSIVE_REPEATS, QUICK_REPEATS = 7, 3, 3
MEMORY_SHARE = 0.8
COLUMNS = ("task", "backend", "n", "dim", "device", "auto", "seconds", "cpu_seconds", "compile_seconds", "peak_mib")
COLUMNS = (*COLUMNS, "relative_error", "steps", "endpoint_error", "failure")

NUMBERS = ("seconds", "least_seconds", "cpu_seconds", "peak_mib", "relative_error", "compile_seconds", "steps")
NUMBERS = (*NUMBERS, "endpoint_error", "threads")

History = dict[tuple[str, str, int, str], tuple[int, float, float]]
"""By backend, task, dim and device: the largest n measured, seconds of a call and its memory in MiB."""


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every case and backend, small problems first."""
    history: History = {}
    workers: dict[str, Worker] = {}
    for device, dim, task in product(plan.devices, plan.dims, plan.tasks):
        for n in plan.sizes or SIZES[device]:
            try:
                yield from compare(Case(task, n, dim, device), plan.backends, history, workers, plan.repeats)
            finally:
                for backend in [] if plan.quick else list(workers):
                    workers.pop(backend).close()
    for worker in workers.values():
        worker.close()


def compare(
    case: Case, names: Iterable[str], history: History, workers: dict[str, Worker], repeats: int
) -> Iterator[Record]:
    """Measure one case with every backend that offers it; existing processes are reused."""
    records = {backend: blank(case, backend) for backend in names if offers(backend, case.task)}
    for backend, record in records.items():
        record["failure"] = too_much(case, backend, history)
        if record["failure"] is None and backend not in workers:
            workers[backend] = Worker(backend)
    running = {b: workers[b] for b, record in records.items() if record["failure"] is None}
    first_calls(case, running, records)
    take_times({b: w for b, w in running.items() if records[b]["failure"] is None}, records, repeats)
    for backend, record in records.items():
        remember(case, backend, record, history)
        record.pop("estimate", None)
        yield record


def blank(case: Case, backend: str) -> Record:
    """Return a record without numbers."""
    auto = backends.choose("auto", case.n, case.n, torch.device(case.device)) == backend
    start: Record = {"task": case.task, "backend": backend, "n": case.n, "dim": case.dim, "device": case.device}
    return start | {"dtype": "float64", **dict.fromkeys(NUMBERS), "auto": auto, "failure": None}


def offers(backend: str, task: str) -> bool:
    """Whether a backend has the task."""
    return {"naive_dense": task in ("sum", "rhs"), "tiled_rk4": task == "loss_and_gradient"}.get(backend, True)


def too_much(case: Case, backend: str, history: History) -> str | None:
    """Reason to skip a case: time or memory extrapolated from a smaller n as n^2 (n^1.5 where overhead dominates)."""
    n, seconds, mib = history.get((backend, case.task, case.dim, case.device), (case.n, 0.0, 0.0))
    growth = (case.n / n) ** (1.5 if n < CHEAP_POINTS else 2.0)
    if math.isinf(seconds):
        return "not tried: it failed for fewer points"
    if seconds * growth > LIMIT_SECONDS:
        return f"not tried: about {seconds * growth:.0f} s per call"
    if mib * growth > MEMORY_SHARE * free_mib(case.device):
        return f"not tried: about {mib * growth / 1024.0:.0f} GiB"
    return None


def free_mib(device: str) -> float:
    """Memory that is free."""
    if device == "cuda":
        return torch.cuda.mem_get_info()[0] / 2.0**20
    lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("MemAvailable:"))


def remember(case: Case, backend: str, record: Record, history: History) -> None:
    """Keep the numbers that too_much extrapolates; a backend that failed is not tried with more points."""
    numbers = [record["seconds"] or record.get("estimate"), record["peak_mib"]]
    seconds, mib = (float(x) if x is not None else math.nan for x in numbers)
    key = (backend, case.task, case.dim, case.device)
    if record["failure"] is None:
        history[key] = (case.n, seconds, max(mib, 0.0))
    elif key not in history or not str(record["failure"]).startswith("not tried"):
        history[key] = (case.n, math.inf, 0.0)


def first_calls(case: Case, workers: dict[str, Worker], records: dict[str, Record]) -> None:
    """Results, memory and compile time, one worker at a time."""
    if not workers:
        return
    target = goal(case)
    for worker in workers.values():  # imports run side by side
        worker.send(("open", case))
    for backend, worker in workers.items():
        attempt(worker, None, START_SECONDS, records[backend])
    for backend, worker in workers.items():
        if records[backend]["failure"]:
            continue
        answer = attempt(worker, ("measure", target), COMPILE_SECONDS, records[backend])
        records[backend] |= answer or {}
        estimate = float(records[backend].get("estimate") or 0.0)
        if estimate > LIMIT_SECONDS:
            records[backend]["failure"] = f"not timed: {estimate:.0f} s per call"


def attempt(worker: Worker, message: tuple[object, ...] | None, timeout: float, record: Record) -> Record | None:
    """Ask, or wait for the answer to what was sent; a failure goes into the record."""
    try:
        return worker.answer(timeout) if message is None else worker.ask(message, timeout)
    except WorkerError as error:
        record["failure"] = str(error)
        return None


def take_times(workers: dict[str, Worker], records: dict[str, Record], repeats: int) -> None:
    """Medians and minima of calls made in turn, so that a slow spell of the machine hits all methods."""
    samples: dict[str, list[tuple[float, float]]] = {backend: [] for backend in workers}
    for turn in range(repeats):
        for backend, worker in workers.items():
            estimate = float(records[backend]["estimate"] or 0.0)
            if records[backend]["failure"] or (turn >= EXPENSIVE_REPEATS and estimate > EXPENSIVE_SECONDS):
                continue
            try:
                samples[backend].append(worker.ask(("time",), 5.0 * LIMIT_SECONDS))
            except WorkerError as error:
                records[backend]["failure"] = str(error)
    for backend, pairs in samples.items():
        if pairs and records[backend]["failure"] is None:
            wall, cpu = zip(*pairs, strict=True)
            records[backend] |= {"seconds": median(wall), "least_seconds": min(wall), "cpu_seconds": median(cpu)}


def goal(case: Case) -> Goal:
    """Return the reference results of a case."""
    data = landmarks(case.n, case.dim, case.device)
    if case.task != "loss_and_gradient":
        rows = slice(0, max(1, min(EXACT_ROWS, EXACT_PAIRS // case.n)))
        return Goal(rows, [r.cpu().numpy() for r in exact(case.task, data, rows)])
    small = Dense(landmarks(min(case.n, SCALING_ROWS), case.dim))
    small_end = small.endpoint(REFERENCE_STEPS)
    small_target = float((TiledRK4(small.data).endpoint(STEPS) - small_end).abs().max())
    everything = Goal(slice(None), small_endpoint=small_end.numpy(), small_target=small_target)
    if case.n > REFERENCE_POINTS[case.device]:
        return everything
    ours = Ours(data)
    gradient, end = ours.loss_and_gradient(REFERENCE_STEPS if case.n <= CHEAP_POINTS else CHEAPER_REFERENCE_STEPS)
    error = float((TiledRK4(data).endpoint(STEPS) - end).abs().max())
    return everything._replace(results=[gradient.cpu().numpy()], endpoint=end.cpu().numpy(), target=error)


def ratios(records: Iterable[Record]) -> Iterator[Record]:
    """For every case, compare the fastest peer with the package's choice and with its fastest backend.

    Ratios above 1 are in the package's favour; `cpu_ratio` takes the peer with the least processor time,
    `memory_ratio` the fastest peer.
    """
    names = ("task", "n", "dim", "device")
    for case, group in groupby(records, key=lambda r: tuple(r[name] for name in names)):
        done = [r for r in group if r["failure"] is None]
        peers = [r for r in done if r["backend"] in PEERS]
        ours = [r for r in done if r["backend"] in OURS[:3]]
        chosen = next((r for r in ours if r["auto"]), None)
        if not peers or chosen is None:
            continue
        peer, frugal = (min(peers, key=lambda r: number(r, name)) for name in ("seconds", "cpu_seconds"))
        best = min(ours, key=lambda r: number(r, "seconds"))
        yield dict(zip(names, case, strict=True)) | {
            "auto": chosen["backend"],
            "auto_seconds": chosen["seconds"],
            "best_peer": peer["backend"],
            "peer_seconds": peer["seconds"],
            "ratio": number(peer, "seconds") / number(chosen, "seconds"),
            "cpu_ratio": number(frugal, "cpu_seconds") / number(chosen, "cpu_seconds"),
            "memory_ratio": number(peer, "peak_mib") / max(number(chosen, "peak_mib"), 0.1),
            "best_ours": best["backend"],
            "best_ratio": number(peer, "seconds") / number(best, "seconds"),
        }


def number(record: Record, name: str) -> float:
    """Return a numeric field; 0 if it is missing."""
    return float(record[name] or 0.0)


def arguments() -> Namespace:
    """Parse the command line; the options narrow the table."""
    parser = harness.parser(__doc__)
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    parser.add_argument("--devices", nargs="+", choices=devices, default=devices)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--sizes", nargs="+", type=int, metavar="N")
    parser.add_argument("--dims", nargs="+", type=int, default=DIMS, metavar="D")
    parser.add_argument("--threads", type=int, help="of torch and KeOps; all cores by default")
    parser.add_argument("--repeats", type=harness.count, default=REPEATS, metavar="N", help="timed calls of a case")
    parser.add_argument("--backends", nargs="+", choices=list(METHODS), default=[*OURS, *PEERS])
    plan = parser.parse_args()
    if plan.threads:
        limit_threads(plan.threads)
    if plan.quick:
        plan.sizes, plan.dims, plan.devices, plan.repeats = [256], [3], ["cpu"], QUICK_REPEATS
    return plan


def limit_threads(threads: int) -> None:
    """Limit this process and its children; XLA can use either one thread or all."""
    os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = str(threads)
    torch.set_num_threads(threads)
    if threads == 1:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false"


def main() -> None:
    """Measure, print both tables, write the file."""
    plan = arguments()
    records = harness.report(measure(plan), plan.out, COLUMNS)
    console = Console(width=harness.WIDTH)
    console.print("The fastest peer against the package, by case (ratios above 1: the package needs less)")
    console.print(harness.table(list(ratios(records))))


if __name__ == "__main__":
    main()
