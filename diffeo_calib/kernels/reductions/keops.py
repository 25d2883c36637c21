"""Sums as KeOps LazyTensors: one fused, compiled loop per formula, see the table in backends.py.

pykeops is imported on first use. Each formula is compiled once per machine (about 5 s) with its C++
compiler and kept in a separate cache folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import platform
from collections.abc import Callable
from functools import cache, reduce
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.cache_folder import cache_folder
from diffeo_calib.kernels.reductions.formulas import LEAVES, Formula, Points, SumBackend, factors
from diffeo_calib.kernels.reductions.symbols import Weights, recorded

CXXFLAGS = (
    "-march=native -fno-math-errno -fno-trapping-math -fno-signed-zeros -fassociative-math -D__FAST_MATH__"
    if platform.system() == "Linux" and platform.machine() in {"x86_64", "AMD64"}
    else ""
)
"""Compiler flags with which the loop is vectorised, including exponentials (glibc's vector functions need the macro):
3 to 4 times faster. `-ffast-math` itself would also make the whole process flush denormal numbers to zero."""


class KeopsUnavailableError(NumericalError):
    """pykeops is missing, or finds no compiler."""


OPERATIONS: dict[str, Callable[..., Any]] = {
    "product": lambda a, b, _: a * b,
    "ratio": lambda a, b, _: a / b,
    "sum": lambda a, b, c: a + b * c,
    "shift": lambda a, c: a + c,
    "scale": lambda a, c: a * c,
    "inverse": lambda a, _: 1.0 / a,
    "exp": lambda a, c: (a * c).exp(),
    "sqrt": lambda a, _: a.sqrt(),
    "relu": lambda a, _: a.relu(),
}
"""Operations of :class:`Node` on LazyTensors."""


def _lazy(weights: Weights, keops: ModuleType, i: Points, j: Points) -> list[Any]:
    """The weights without their scales as LazyTensors, which are never materialised; None for the number one."""

    def apart(e: Tensor, f: Tensor) -> Any:
        return keops.Vi(e.contiguous()) - keops.Vj(f.contiguous())

    def leaf(name: str) -> Any:
        if name == "r2":
            return (apart(i.features, j.features) ** 2).sum(-1)
        if name == "rho":
            return apart(i.features, j.features) | apart(2.0 * i.d_features, 2.0 * j.d_features)
        left, right = factors(name, i, j)
        return keops.Vi(left.contiguous()) | keops.Vj(right.contiguous())

    lazy: dict[int | None, Any] = {None: None}
    for k, (name, operands, number) in weights.steps():
        lazy[k] = leaf(name) if name in LEAVES else OPERATIONS[name](*(lazy[o] for o in operands), number)
    return [lazy[node] for node, _ in weights.results]


class Keops(SumBackend):
    """Fused lazy sums."""

    def trouble(self) -> str:
        return self.failure or _missing()

    def reduce(
        self, formula: Formula, profile: Profile, rows: Points | None, columns: Points
    ) -> tuple[Tensor, ...] | None:
        rows, weights = columns if rows is None else rows, recorded(formula, profile)
        if weights is None:
            return None
        keops, summands = load(), formula.summands(columns)
        with torch.no_grad():
            lazy = _lazy(weights, keops, rows, columns)
            some = [(w, b) for w, b in zip(lazy, summands, strict=True) if w is not None]
            sums = iter(())
            try:
                if some:
                    terms = reduce(lambda a, b: a.concat(b), [w * keops.Vj(b.contiguous()) for w, b in some])
                    # KeOps' default sums in blocks of 200: the branch this needs prevents vectorisation of the loop
                    total = terms.sum(dim=1, sum_scheme="direct_sum")
                    sums = iter(torch.split(total, [b.shape[1] for _, b in some], dim=1))
            except Exception as error:  # the compiler chain may raise anything
                return self.failed(f"KeOps could not compile or run a kernel sum ({error}).")
            reduced = [
                scale * (b.sum(0).expand(len(rows.features), -1) if w is None else next(sums))
                for w, b, (_, scale) in zip(lazy, summands, weights.results, strict=True)
            ]
        return formula.finish(reduced, rows)


@cache
def load() -> ModuleType:
    """Import pykeops.torch with this module's flags and cache folder, silently.

    CXXFLAGS and KEOPS_CACHE_FOLDER of the environment take precedence.

    Raises:
        KeopsUnavailableError: pykeops is not installed, or finds no C++ compiler.
    """
    added: dict[str, str] = {}
    try:
        if "KEOPS_CACHE_FOLDER" not in os.environ:
            added["KEOPS_CACHE_FOLDER"] = str(_cache_folder(os.environ.get("CXXFLAGS", CXXFLAGS)))
        if "CXXFLAGS" not in os.environ:
            added["CXXFLAGS"] = CXXFLAGS
        os.environ.update(added)  # KeOps reads the environment once, when it is imported
        with contextlib.redirect_stdout(io.StringIO()) as messages:
            import pykeops  # noqa: PLC0415
            import pykeops.torch as keops  # noqa: PLC0415

            pykeops.set_verbose(False)
    except Exception as error:
        raise KeopsUnavailableError.of(f"pykeops cannot be imported ({error})") from error
    finally:
        for name in added:
            os.environ.pop(name, None)
    if "No C++ compiler" in messages.getvalue():
        raise KeopsUnavailableError.of("KeOps finds no C++ compiler", fix="install g++, or set CXX")
    return keops


def _cache_folder(flags: str) -> Path:
    """A cache folder for these flags and this processor, neither of which is part of KeOps' own file names."""
    try:
        processor = Path("/proc/cpuinfo").read_text(encoding="utf-8").partition("\n\n")[0]
        processor = "\n".join(line for line in processor.splitlines() if line.startswith(("model name", "flags")))
    except OSError:
        processor = platform.processor()
    mark = hashlib.sha256(f"{flags}\n{processor}".encode()).hexdigest()[:12]
    return cache_folder(f"keops-{mark}")


@cache
def _missing() -> str:
    """Why pykeops cannot be imported or finds no compiler; empty where it can. Tried once."""
    try:
        load()
    except KeopsUnavailableError as error:
        return str(error)
    return ""
