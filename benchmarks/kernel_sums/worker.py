"""A method in its own process: it shares no memory, flags or threads with other methods, and may fail alone.

The parent asks to `open` a case, to `measure` it (first call: results, memory, errors) and then, in turn with other
workers, to `time` it. Only one worker runs at a time; all other workers wait on their pipes.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import math
import multiprocessing
import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from harness import Record
from landmarks import Method, landmarks
from numpy.linalg import norm
from numpy.typing import NDArray
from torch import Tensor

METHODS = {
    "auto": "ours:Ours",
    "dense": "ours:Dense",
    "fused": "ours:Fused",
    "tiled": "ours:Tiled",
    "tiled_rk4": "ours:TiledRK4",
    "tiled_unpooled": "ours:TiledUnpooled",
    "keops": "ours:Keops",
    "keops_default_flags": "ours:KeopsDefaultFlags",
    "naive_dense": "peers:NaiveDense",
    "dense_autograd": "peers:DenseAutograd",
    "keops_tutorial": "peers:KeopsTutorial",
    "keops_tuned": "peers:KeopsTuned",
    "diffrax": "peers_jax:Diffrax",
    "c": "peers_c:C",
}
BATCH_SECONDS, BATCH_CALLS = 0.02, 200
"""Short calls are timed in batches: duration [s] and largest number of calls of a batch."""
WARM_SECONDS = 2.0
"""Calls shorter than this are made once, untimed, before each batch, to wake up caches and threads."""
SLACK = 1e-3
"""Relative tolerance of the target: the same method has the same end-point error to rounding."""
CORRECTIONS = 6
MIB = 2.0**20


class WorkerError(Exception):
    """The reason why there are no numbers."""


class Case(NamedTuple):
    """One measured case."""

    task: str
    n: int
    dim: int
    device: str


class Goal(NamedTuple):
    """Reference results, and the accuracy that the time stepping must reach.

    Attributes:
        rows: rows of the results that are compared.
        results: exact results of these rows; None if they cost too much.
        endpoint: q(1) of all points; None if it costs too much, or if the task has no flow.
        target: largest allowed error of q(1).
        small_endpoint, small_target: the same for the small problem on which the number of steps is chosen.
    """

    rows: slice
    results: list[NDArray[np.float64]] | None = None
    endpoint: NDArray[np.float64] | None = None
    target: float | None = None
    small_endpoint: NDArray[np.float64] | None = None
    small_target: float = 0.0


class Worker:
    """The parent's side."""

    def __init__(self, backend: str) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs, backend), daemon=True)
        self.process.start()
        theirs.close()

    def send(self, message: tuple[Any, ...]) -> None:
        """Send a method's name and arguments; :meth:`answer` returns the result."""
        with contextlib.suppress(OSError):  # a dead worker does not answer either
            self.pipe.send(message)

    def ask(self, message: tuple[Any, ...], timeout: float) -> Any:
        """Send a message and return the answer."""
        self.send(message)
        return self.answer(timeout)

    def answer(self, timeout: float) -> Any:
        """Wait for the answer to the last message.

        Raises:
            WorkerError: the worker failed, died, or took too long.
        """
        try:
            if not self.pipe.poll(timeout):
                self.close()
                raise WorkerError(f"stopped after {timeout:.0f} s")
            answer = self.pipe.recv()
        except (EOFError, OSError) as error:
            self.close()
            raise WorkerError(f"the process died, exit code {self.process.exitcode} (out of memory?)") from error
        if isinstance(answer, WorkerError):
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def method_class(backend: str) -> type[Method]:
    """Import a method."""
    module, _, name = METHODS[backend].partition(":")
    return getattr(importlib.import_module(module), name)


def serve(pipe: Connection, backend: str) -> None:
    """The worker's side: answer until the parent has ended."""
    server = Server(backend)
    while True:
        try:
            name, *arguments = pipe.recv()
        except EOFError:
            return
        try:
            answer = getattr(server, name)(*arguments)
        except Exception as error:  # any failure of a peer becomes a record
            answer = describe(error)
        pipe.send(answer)


def describe(error: Exception) -> WorkerError:
    """One line."""
    text = " ".join(str(error).split())
    return WorkerError(f"{type(error).__name__}: {text[:160]}")


class Server:
    """A method, its problem, and the clocks."""

    case: Case
    method: Method
    run: Callable[[], list[Any]]

    def __init__(self, backend: str) -> None:
        self.backend = backend
        self.calls, self.warm = 1, False

    def open(self, case: Case) -> Record:
        """Import the method and set up its problem."""
        if case.device == "cpu":
            os.environ["JAX_PLATFORMS"] = "cpu"
        self.kind = method_class(self.backend)
        os.environ.update(self.kind.environment)  # before the libraries that read it are imported
        self.case, self.run, self.warm = case, list, False  # the last case's memory is free before the next one's
        self.method = self.kind(landmarks(case.n, case.dim, case.device))
        return {}

    def measure(self, goal: Goal) -> Record:
        """Compile, run once, and return all fields but the times; `estimate` is the duration of that run."""
        steps = self._fewest_steps(goal) if self.case.task == "loss_and_gradient" else 0
        for _ in range(CORRECTIONS):
            record, results = self._first_run(steps)
            if goal.endpoint is None:
                break
            error = largest(results[1], goal.endpoint)
            record |= {"steps": steps, "endpoint_error": error}
            if goal.target is None or error <= goal.target * (1.0 + SLACK):
                break
            steps += max(1, steps // 50)
        if steps:
            record["steps"] = steps
        if goal.results is not None:
            pairs = [(r[goal.rows].cpu().numpy(), exact) for r, exact in zip(results, goal.results, strict=False)]
            record["relative_error"] = max(float(norm(r - exact) / norm(exact)) for r, exact in pairs)
        return record

    def _first_run(self, steps: int) -> tuple[Record, list[Tensor]]:
        begin = time.perf_counter()
        self.method.compile(self.case.task, steps)
        compiled = time.perf_counter()
        memory = Memory(self.case.device, self.backend)
        self.run = self.method.function(self.case.task, steps)
        start = time.perf_counter()
        results = self.run()
        estimate = time.perf_counter() - start
        record: Record = {"compile_seconds": compiled - begin, "estimate": estimate, "peak_mib": memory.peak()}
        record["threads"] = self.method.threads()
        self.calls = max(1, min(BATCH_CALLS, math.ceil(BATCH_SECONDS / estimate)))
        return record, self.method.tensors(results)

    def _fewest_steps(self, goal: Goal) -> int:
        """The fewest steps for the target on the small problem, by the method's order."""
        if goal.small_endpoint is None:
            return 1
        expected, target = goal.small_endpoint, goal.small_target * (1.0 + SLACK)
        small = self.kind(landmarks(len(expected), self.case.dim, self.case.device))
        errors: dict[int, float] = {}
        steps = 2
        while steps not in errors and len(errors) < CORRECTIONS:
            errors[steps] = largest(small.endpoint(steps), expected)
            steps = max(1, math.ceil(steps * (errors[steps] / target) ** (1.0 / self.method.order)))
        while largest(small.endpoint(steps), expected) > target:
            steps += 1
        return steps

    def time(self) -> tuple[float, float]:
        """Wall and processor seconds of one call."""
        if self.calls > 1 or self.warm:
            self.run()
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(self.calls):
            self.run()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        self.warm = wall / self.calls < WARM_SECONDS
        return wall / self.calls, cpu / self.calls


def largest(result: Tensor, expected: NDArray[np.float64]) -> float:
    """Return the largest difference."""
    return float(np.abs(result.cpu().numpy() - expected).max())


class Memory:
    """Peak memory above the memory in use when this object was made, in MiB."""

    def __init__(self, device: str, backend: str) -> None:
        gc.collect()
        self.kind = device if device == "cpu" or backend != "diffrax" else "jax"
        if self.kind == "cuda":
            torch.cuda.reset_peak_memory_stats()
        if self.kind == "cpu":
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # sets VmHWM back to VmRSS
        self.base = self._read(peak=False)

    def peak(self) -> float:
        """Peak since then, MiB."""
        return (self._read(peak=True) - self.base) / MIB

    def _read(self, peak: bool) -> float:
        if self.kind == "cuda":
            return torch.cuda.max_memory_allocated() if peak else torch.cuda.memory_allocated()
        if self.kind == "jax":
            import jax  # noqa: PLC0415  # optional

            stats = jax.devices()[0].memory_stats() or {}
            return stats.get("peak_bytes_in_use" if peak else "bytes_in_use", math.nan)
        field = "VmHWM:" if peak else "VmRSS:"
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(1024.0 * float(line.split()[1]) for line in lines if line.startswith(field))
