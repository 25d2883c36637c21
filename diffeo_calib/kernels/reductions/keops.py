"""Sums as KeOps LazyTensors: one fused, compiled loop per formula, see the table in backends.py.

pykeops is imported on first use. Each formula is compiled once per machine (about 5 s) with its C++
compiler and kept in a separate cache folder.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import io
import os
import platform
import shutil
import stat
import tempfile
import warnings
from collections.abc import Callable, Sequence
from functools import cache, reduce
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import DiffeoCalibWarning, NumericalError, sentence
from diffeo_calib.kernels.profiles import Profile
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
    """pykeops is missing, finds no compiler, or could not compile a formula."""


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

    found: dict[int | None, Any] = {None: None}
    for k, (name, operands, number) in weights.steps():
        found[k] = leaf(name) if name in LEAVES else OPERATIONS[name](*(found[o] for o in operands), number)
    return [found[node] for node, _ in weights.results]


class Keops(SumBackend):
    """Fused lazy sums.

    Attributes:
        failed: whether a compilation or a run has failed; KeOps is not tried again then.
    """

    def __init__(self) -> None:
        self.failed = False

    def usable(self) -> bool:
        return not self.failed and available()

    def reduce(
        self, formula: Formula, profile: Profile, rows: Points | None, columns: Points
    ) -> tuple[Tensor, ...] | None:
        """As :meth:`SumBackend.reduce`; KeopsUnavailableError if compiling or running the formula failed."""
        rows, weights = columns if rows is None else rows, recorded(formula, profile)
        if weights is None:
            return None
        keops, summands = load(), formula.summands(columns)
        with torch.no_grad():
            lazy = _lazy(weights, keops, rows, columns)
            terms = [w * keops.Vj(b.contiguous()) for w, b in zip(lazy, summands, strict=True) if w is not None]
            sums = iter(self._summed(terms, [b.shape[1] for w, b in zip(lazy, summands, strict=True) if w is not None]))
            found = [
                scale * (b.sum(0).expand(len(rows.features), -1) if w is None else next(sums))
                for w, b, (_, scale) in zip(lazy, summands, weights.results, strict=True)
            ]
        return formula.finish(found, rows)

    def _summed(self, terms: list[Any], widths: list[int]) -> Sequence[Tensor]:
        """The sums over all columns in one loop."""
        if not terms:
            return []
        fused = reduce(lambda a, b: a.concat(b), terms)
        # KeOps' default sums in blocks of 200: the branch this needs prevents vectorisation of the loop.
        try:
            return torch.split(fused.sum(dim=1, sum_scheme="direct_sum"), widths, dim=1)
        except Exception as error:  # the compiler chain may raise anything
            self.failed = True
            raise KeopsUnavailableError.of(f"KeOps could not compile or run a kernel sum ({error})") from error


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
def available() -> bool:
    """Whether pykeops can be imported and finds a compiler; tried once, with one warning if not."""
    try:
        load()
    except KeopsUnavailableError as error:
        warn(str(error))
        return False
    return True


def warn(reason: str) -> None:
    """Warn, once per reason, that the fallback runs."""
    _warned(f"{reason} Kernel sums run in torch instead (backend 'tiled'): slower, the same numbers.")


@cache
def _warned(text: str) -> None:
    warnings.warn(text, DiffeoCalibWarning, stacklevel=2)  # not warn_user: models do not record it


def cache_folder(name: str) -> Path:
    """A folder of this name in the user's cache, made if there is none: the code in it is executed.

    Where it cannot be made, or others may write to it or have written there, one of this process, with one warning.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):
        base = os.path.expanduser("~/.cache") if os.environ.get("HOME") != "" else ""
    return (_kept_folder(base, name) if os.path.isabs(base) else None) or _passing_folder(base)


@cache
def _kept_folder(base: str, name: str) -> Path | None:
    """The folder, without links, if nobody else can write to it, has written there or can put another in its place."""
    folder = Path(base, "diffeo_calib", name)
    try:
        for part in (folder.parents[1], folder.parent, folder):
            part.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder = folder.resolve()
        if hasattr(os, "getuid"):  # not on Windows, where the home folders are private
            me, own = os.getuid(), folder.stat()
            for found in (*map(os.stat, folder.parents), own):
                sticky = found.st_mode & stat.S_ISVTX and found is not own  # only its owner renames what lies there
                if found.st_uid not in {0, me} or (found.st_mode & 0o022 and not sticky):
                    return None
            for entry in folder.rglob("*"):
                with contextlib.suppress(FileNotFoundError):  # another process has finished with it
                    if entry.lstat().st_uid != me:
                        return None
            folder.chmod(0o700)  # whatever the mode of the files that KeOps will make
    except OSError:
        return None
    return folder


@cache
def _passing_folder(base: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="diffeo_calib-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    place = Path(base, "diffeo_calib")
    what = f"compiled kernel sums are kept for this run only: '{place}' is no folder that you alone can write to"
    _warned(sentence(what, fix="remove it, or name a folder of yours in the variable XDG_CACHE_HOME"))
    return folder
