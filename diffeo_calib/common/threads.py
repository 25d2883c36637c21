"""Threads of NumPy and SciPy, which get in the way of torch's.

Their OpenBLAS has threads of its own. After each call they spin for a while, and take the cores from torch, which
evaluates the functions that SciPy optimises: on two cores a calibration took twice as long with them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def torch_alone() -> Iterator[None]:
    """Let NumPy and SciPy use one thread inside; torch keeps its own. For code that calls both in turn."""
    import scipy.linalg  # noqa: F401, PLC0415  # slow to import; its OpenBLAS is known only once it is loaded
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415

    found = ThreadpoolController()
    theirs = [one["filepath"] for one in found.info() if one["internal_api"] == "openblas" and not _of_torch(one)]
    with found.select(filepath=theirs).limit(limits=1):
        yield


def _of_torch(library: dict[str, str]) -> bool:
    """Some builds of torch bring an OpenBLAS, too: in torch/lib or torch.libs."""
    return any(part.startswith("torch") for part in Path(library["filepath"]).parts[-3:-1])
