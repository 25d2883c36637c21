"""Generated C sources, compiled with all warnings as errors and called by ctypes."""

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from diffeo_calib.interop.c_source import c_source
from diffeo_calib.runtime.program import Program

COMPILER = shutil.which("gcc") or shutil.which("cc")
CPLUSPLUS = shutil.which("g++") or shutil.which("c++")
WARNINGS = ("-Wall", "-Wextra", "-pedantic", "-Werror")
STRICT = ("-O2", *WARNINGS)
C99 = ("-std=c99", *STRICT)
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler")

Array = np.ndarray
_DOUBLES = ctypes.POINTER(ctypes.c_double)


def compiled(command: Sequence[str | Path | None]) -> None:
    """Run a compiler; its complaints are the message of the failure."""
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[:3000]


class CModel:
    """A source file as a shared library."""

    def __init__(self, source: Path, joints: int, markers: int, prefix: str | None = None) -> None:
        library = source.with_suffix(".so")
        # Users' -O2, which test_c_files.py compiles with, takes longer and gives the same numbers.
        compiled([COMPILER, "-std=c99", "-O0", *WARNINGS, "-fPIC", "-shared", "-o", library, source, "-lm"])
        self.path, self.n, self.markers, self.prefix = library, joints, markers, prefix or source.stem
        self.library = ctypes.CDLL(str(library))

    def points(self, q: Array) -> Array:
        """(N, n) -> (N, P, 3)."""
        return np.stack([self._value("markers", row, (self.markers, 3)) for row in q])

    def points_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """(N, n) -> (N, P, 3), (N, P, 3, n)."""
        return self._both("markers", q, (self.markers, 3), (self.markers, 3, self.n))

    def poses(self, q: Array) -> Array:
        """(N, n) -> (N, 4, 4)."""
        return np.stack([self._value("tool_pose", row, (4, 4)) for row in q])

    def poses_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """(N, n) -> (N, 4, 4), (N, 6, n)."""
        return self._both("tool_pose", q, (4, 4), (6, self.n))

    def newton_step(self, q: Array, target: Array, weight: float = 0.1, bound: float = 0.1) -> tuple[Array, float]:
        """(n,), (4, 4) -> joint values after the step (n,), error before it."""
        step = getattr(self.library, f"{self.prefix}_newton_step")
        step.restype = ctypes.c_double
        q, target, after = np.array(q, float), np.ascontiguousarray(target), np.empty(self.n)
        numbers = ctypes.c_double(weight), ctypes.c_double(bound)
        return after, step(_pointer(q), _pointer(target), *numbers, _pointer(after))

    def _both(self, name: str, q: Array, shape: tuple[int, ...], slopes: tuple[int, ...]) -> tuple[Array, Array]:
        jacobians = np.empty((len(q), *slopes))
        values = [self._value(name, row, shape, out) for row, out in zip(q, jacobians, strict=True)]
        return np.stack(values), jacobians

    def _value(self, name: str, q: Array, shape: tuple[int, ...], jacobian: Array | None = None) -> Array:
        q, value = np.array(q, float), np.empty(shape)
        getattr(self.library, f"{self.prefix}_{name}")(_pointer(q), _pointer(value), _pointer(jacobian))
        return value


def c_model(program: Program, folder: Path, tool: Array, limits: Array | None = None) -> CModel:
    """The program in C, in the measuring frame; without limits of the joints (n, 2) by default."""
    n = program.chain.n
    limits = np.tile([-np.inf, np.inf], (n, 1)) if limits is None else limits
    texts = {"robot": "robot", "joints": [], "frame_name": "the measuring frame", "remarks": []}
    made = c_source(program, "generated", "robot", tool=tool, frame=np.eye(4), limits=limits, **texts)
    for suffix, text in zip((".c", ".h"), made, strict=True):
        (folder / f"generated{suffix}").write_text(text)
    return CModel(folder / "generated.c", n, len(program.markers), "robot")


def _pointer(values: Array | None) -> object:
    return None if values is None else values.ctypes.data_as(_DOUBLES)
