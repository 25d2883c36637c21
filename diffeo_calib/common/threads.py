"""Threads of NumPy and SciPy, which compete with those of torch.

The OpenBLAS of NumPy and SciPy has its own threads. They keep spinning for a while after each call and take the cores
from torch, which evaluates the functions that SciPy optimises: on two cores this doubled the time of a calibration.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any


@contextmanager
def torch_alone() -> Iterator[None]:
    """Limit NumPy and SciPy to one thread inside; torch keeps its threads. For code that calls both in turn."""
    import scipy.linalg  # noqa: F401, PLC0415  # slow to import; its OpenBLAS is found only once it is loaded

    with _openblas().limit(limits=1):
        yield


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit NumPy to one thread inside. For long runs of small products, which threads on busy cores slow down tenfold.

    Entering takes 0.1 ms.
    """
    with _openblas_of_numpy().limit(limits=1):
        yield


@cache
def _openblas_of_numpy() -> Any:
    return _openblas()  # looking for libraries takes milliseconds: once


def _openblas() -> Any:
    """Controller of the OpenBLAS libraries that are loaded, those of torch excepted."""
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415

    found = ThreadpoolController()
    openblas = [library for library in found.info() if library["internal_api"] == "openblas"]
    return found.select(filepath=[library["filepath"] for library in openblas if not belongs_to_torch(library)])


def belongs_to_torch(library: dict[str, str]) -> bool:
    """Whether a library belongs to torch: some builds have an OpenBLAS of their own in torch/lib or torch.libs."""
    return any(part.startswith("torch") for part in Path(library["filepath"]).parts[-3:-1])
