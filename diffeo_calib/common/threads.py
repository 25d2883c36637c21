"""How many threads work: one policy for the whole package.

The threads of torch wait for each other after every operation, and spin while they wait. Where another process takes
one of the cores, each operation lasts until the scheduler lets the last thread finish: on two cores a fit that takes
0.2 s takes up to 14 s beside one busy process. Therefore

* small work, all that a fit, a calibration or a query does apart from large sums and large matrices, runs on one thread
  whatever ``torch.set_num_threads`` says (:func:`small_work`);
* large sums are cut into parts that run in threads of their own, each with a torch of one thread, which wait for each
  other only once, at the end (:func:`in_parallel`);
* large matrix factorisations get all threads of torch (:func:`large_work`): their operations last so long that waiting
  does not matter.

The user's ``torch.set_num_threads`` is the number of threads for large work, and is restored after every call.

The OpenBLAS of NumPy and SciPy has its own threads. They keep spinning for a while after each call and take the cores
from torch, which evaluates the functions that SciPy optimises: on two cores this doubled the time of a calibration.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

LARGE_MATRIX = 1 << 20
"""Elements from which operations on a matrix use all threads: a factorisation then takes 20 ms or more."""
T = TypeVar("T")
R = TypeVar("R")


class _Allowed(threading.local):
    """Threads that the user allows, while :func:`small_work` limits this thread's torch to one; else None."""

    threads: int | None = None


_allowed = _Allowed()


def allowed_threads() -> int:
    """Number of threads that the user's settings allow for large work."""
    import torch  # noqa: PLC0415  # the folder `runtime` works without torch

    return torch.get_num_threads() if _allowed.threads is None else _allowed.threads


@contextmanager
def small_work() -> Iterator[None]:
    """Run torch on one thread inside, large work excepted. Also a decorator; entering takes a microsecond.

    torch keeps the number of threads for each thread of the program; other threads keep theirs.
    """
    import torch  # noqa: PLC0415  # see above

    if torch.compiler.is_compiling():  # a recorded program knows no threads
        yield
        return
    count = allowed_threads()
    if _allowed.threads is not None or count == 1:
        yield
        return
    _allowed.threads = count
    _set_torch_threads(1)
    try:
        yield
    finally:
        _allowed.threads = None
        _set_torch_threads(count)


@contextmanager
def large_work(elements: int) -> Iterator[None]:
    """Let torch use all threads again inside :func:`small_work`, for operations on a large matrix.

    Args:
        elements: of the matrix; small ones leave the number of threads as it is.
    """
    count = _allowed.threads
    if elements < LARGE_MATRIX or count is None:
        yield
        return
    _set_torch_threads(count)
    try:
        yield
    finally:
        _set_torch_threads(1)


def in_parallel(function: Callable[[T], R], parts: Sequence[T]) -> Iterator[R]:
    """``function(part)`` of every part, in order, in as many threads as are allowed, each with a torch of one thread.

    Autograd does not follow what happens inside.
    """
    count = allowed_threads()
    with small_work():  # restores torch's number of threads for threads to come, which the workers set to one
        yield from map(function, parts) if count == 1 or len(parts) == 1 else _workers(count).map(function, parts)


def _set_torch_threads(count: int) -> None:
    import torch  # noqa: PLC0415  # see above

    torch.set_num_threads(count)


@cache
def _workers(count: int) -> ThreadPoolExecutor:
    """Threads that are kept, since their buffers are; forked processes make their own."""
    return ThreadPoolExecutor(count, thread_name_prefix="diffeo_calib", initializer=_start_worker)


def _start_worker() -> None:
    import torch  # noqa: PLC0415  # see above

    torch.set_num_threads(1)
    torch.set_grad_enabled(False)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_workers.cache_clear)


@contextmanager
def torch_alone() -> Iterator[None]:
    """Limit NumPy and SciPy to one thread inside; torch keeps its threads. For code that calls both in turn."""
    import scipy.linalg  # noqa: F401, PLC0415  # slow to import; its OpenBLAS is found only once it is loaded

    with _openblas("scipy").limit(limits=1):
        yield


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit NumPy to one thread inside. For long runs of small products, which threads on busy cores slow down tenfold.

    Entering takes 0.1 ms.
    """
    with _openblas("numpy").limit(limits=1):
        yield


@cache
def _openblas(loaded: str) -> Any:
    """Controller of the OpenBLAS libraries that are there once a package is loaded, those of torch excepted.

    They are looked for once, since that takes milliseconds.
    """
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415

    every = ThreadpoolController()
    openblas = [library for library in every.info() if library["internal_api"] == "openblas"]
    # some builds of torch have an OpenBLAS of their own in torch/lib or torch.libs
    paths = [library["filepath"] for library in openblas]
    return every.select(filepath=[p for p in paths if not any(d.startswith("torch") for d in Path(p).parts[-3:-1])])
