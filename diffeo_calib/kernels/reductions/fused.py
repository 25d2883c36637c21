"""Kernel sums in one compiled loop that stores nothing per pair; see the table in backends.py.

Formulas and profiles are those of all backends, compiled for this processor by LLVM at first use: 0.1 s for each
formula, profile and number of coordinates, once per machine, since the code is kept on disk. Needs the package
llvmlite, and no C compiler.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial, reduce
from threading import RLock
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import write_whole
from diffeo_calib.common.threads import in_parallel
from diffeo_calib.kernels.profiles import SHIPPED, Profile
from diffeo_calib.kernels.reductions.cache_folder import cache_folder
from diffeo_calib.kernels.reductions.formulas import Formula, Points, SumBackend
from diffeo_calib.kernels.reductions.loops import ARGUMENTS, Program, Vector
from diffeo_calib.kernels.reductions.symbols import Weights, recorded
from diffeo_calib.kernels.reductions.tiled import LARGE_PAIRS, PARTS, SHARED_PARTS, Chosen, dealt

DIGEST = hashlib.sha256().digest_size
LOCK = RLock()
"""Held while LLVM works, which does one thing at a time. Forking waits for it: in the new process nobody would release
the lock."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=LOCK.release)


class Machine:
    """This processor, and the functions compiled for it.

    Attributes:
        vector_bytes: of a register.

    Raises:
        ImportError: llvmlite is not installed.
        Exception: LLVM does not know this machine.
    """

    def __init__(self) -> None:
        import llvmlite  # noqa: PLC0415  # optional, and slow to load
        import llvmlite.binding as llvm  # noqa: PLC0415

        with suppress(RuntimeError):  # needed by some versions, refused by others
            llvm.initialize()
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        flags = llvm.get_host_cpu_features()
        name, features = llvm.get_host_cpu_name(), flags.flatten()
        self.vector_bytes = 64 if flags.get("avx512f") else 32 if flags.get("avx2") else 16
        self.mark = f"{name} {features} {llvmlite.__version__}"
        # ELF on Windows too, whose own format the loader of objects handles badly
        triple = llvm.get_process_triple() + ("-elf" if sys.platform == "win32" else "")
        self.llvm, self.loaded = llvm, set[str]()
        options = {"cpu": name, "features": features, "opt": 3, "reloc": "pic", "codemodel": "small"}
        self.target = llvm.Target.from_triple(triple).create_target_machine(**options)
        # one block of memory for each module: in a process with much memory its sections may else lie too far apart for
        # the addresses of the small code model, and LLVM ends the process
        self.engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), self.target, use_lmm=True)

    def function(self, text: str) -> Callable[..., None]:
        """Compile the function ``sums`` of a module, or load what an earlier process compiled."""
        mark = hashlib.sha256(f"{self.mark}\n{text}".encode()).hexdigest()[:24]
        with LOCK:
            if mark not in self.loaded:
                self._load(mark, text.replace("@sums(", f"@sums_{mark}("))
                self.loaded.add(mark)
            address = self.engine.get_function_address(f"sums_{mark}")
            return ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * ARGUMENTS)(address)

    def _load(self, mark: str, text: str) -> None:
        code = _kept(mark)
        if code is None:
            code = self._emit(text)
            with suppress(OSError, InputError):  # a folder that cannot be written does not matter
                write_whole(cache_folder("fused") / mark, hashlib.sha256(code).digest() + code)
        self.engine.add_object_file(self.llvm.ObjectFileRef.from_data(code))
        self.engine.finalize_object()

    def _emit(self, text: str) -> bytes:
        module = self.llvm.parse_assembly(text)
        module.verify()
        return self.target.emit_object(module)


def machine() -> Machine:
    """This processor: one for the whole program, since the functions that it compiles end with it."""
    with LOCK:
        return _machine()


@cache
def _machine() -> Machine:
    return Machine()


def _kept(mark: str) -> bytes | None:
    """The compiled module; None if there is none, or a damaged one."""
    try:
        content = (cache_folder("fused") / mark).read_bytes()
    except OSError:
        return None
    digest, code = content[:DIGEST], content[DIGEST:]
    return code if hashlib.sha256(code).digest() == digest else None


TILE_BYTES = 20 << 10  # inputs and sums of the columns of a tile: they stay in the first cache of any processor
CACHE_LINE = 64  # bytes
MOST_GROUP = 16  # largest number of points that a program processes together
MOST_OUTPUTS = 96  # sums per row beyond which products of matrices take less time
MOST_INPUTS = 64  # numbers of a point beyond which compiling takes seconds, and products of matrices take less time
MOST_VARIANTS = 64
"""Sums with profiles of one class of the user's that are compiled. With more, a parameter is being optimised, and
compiling takes too long."""


class _Lines(NamedTuple):
    """Points as a program reads them."""

    # (inputs, length), a line for each coordinate, zero at the end. Lines of an odd number of cache lines do not
    # compete for the same places in a cache: those of a power of two take three times as long
    values: Tensor
    count: int  # points with those that fill the last group
    length: int

    @classmethod
    def of(cls, points: Points, program: Program) -> _Lines:
        """The points that a program needs."""
        inputs = torch.cat([t for t in (getattr(points, name) for name in program.formula.reads) if t is not None], 1)
        n, unit = len(inputs), CACHE_LINE // inputs.element_size()
        count = -(-n // program.group) * program.group
        length = (-(-count // unit) | 1) * unit
        return cls(torch.constant_pad_nd(inputs.T, (0, length - n)).contiguous(), count, length)


class Compiled(NamedTuple):
    """A program, the factors of its results, and its function."""

    program: Program
    factors: list[float]
    function: Callable[..., None]

    def totals(self, rows: Points | None, columns: Points, mine: Chosen = list) -> Tensor:
        """Sums without factors (outputs, count), or the parts of a process: the shares of all add up to them.

        Args:
            rows: the M points at which sums are evaluated; None for the columns themselves.
            columns: the N points of the sum.
            mine: chooses from tiles of rows those of this process.
        """
        right = _Lines.of(columns, self.program)
        left = right if rows is None else _Lines.of(rows, self.program)
        sizes = 8 * (sum(self.program.sizes.values()) + self.program.count)  # bytes of a column
        side = height = max(MOST_GROUP, 1 << (TILE_BYTES // sizes).bit_length() - 1)  # points, a power of two
        if rows is not None:
            # many rows of few columns: not so many tiles that handing them to threads takes longer than the sums
            height = max(side, -(-left.count // (SHARED_PARTS * MOST_GROUP)) * MOST_GROUP)
        tiles = mine(range(-(-left.count // height)))
        zeros = partial(torch.zeros, self.program.count, left.length, dtype=torch.float64, device=HOST)
        whole = None if rows is None else zeros()  # to which tiles of rows add in different places
        arguments = left.values.data_ptr(), left.length, right.values.data_ptr(), right.count, right.length

        def part(some: Sequence[int]) -> Tensor:
            total, whole_range = zeros() if whole is None else whole, len(some) == -(-left.count // height)
            for tile in some[:1] if whole_range else some:
                last = left.count if whole_range else min((tile + 1) * height, left.count)
                place = tile * height, last, height, side, rows is None
                self.function(*arguments, total.data_ptr(), *place)
            return total

        if left.count * right.count < LARGE_PAIRS or not tiles:
            return part(tiles)
        parts = in_parallel(part, dealt(tiles, PARTS) if whole is None else [[tile] for tile in tiles])
        return reduce(lambda total, more: total.add_(more) if whole is None else whole, parts)

    def results(self, totals: Tensor, rows: int) -> tuple[Tensor, ...]:
        """The results of the formula at M rows, from all sums."""
        results, first = [], 0
        for size, factor, (term, *_) in zip(
            self.program.outputs, self.factors, self.program.formula.results, strict=True
        ):
            total = totals[first : first + size, :rows]
            result = (total if factor == 1.0 else total * factor).T
            results.append(
                result.unflatten(1, (self.program.sizes["momenta"], -1)) if term.vector and term.apart else result
            )
            first += size
        return tuple(results)


class Fused(SumBackend):
    """Evaluates sums in compiled loops, on a CPU."""

    def __init__(self) -> None:
        self._programs: dict[tuple[Formula, Weights, tuple[tuple[str, int], ...]], Compiled | None] = {}
        self._own = Counter[type]()

    def trouble(self) -> str:
        return self.failure or _missing()

    def program(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> Compiled | None:
        """The compiled sum; None where it is not for this backend: on a GPU, for another type, an unusual profile."""
        tensors = [t for t in (*(rows or ()), *columns) if t is not None]
        fitting = all(t.dtype == torch.float64 and t.device.type == "cpu" for t in tensors)
        if not fitting or self.trouble():
            return None
        weights = recorded(formula, profile)
        if weights is None:
            return None
        key = formula, weights, tuple((name, getattr(columns, name).shape[1]) for name in formula.reads)
        if key not in self._programs:
            self._programs[key] = self._compiled(Program(*key, Vector(machine().vector_bytes // 8)), type(profile))
        return self._programs[key]

    def _compiled(self, program: Program, profile: type[Profile]) -> Compiled | None:
        if program.count > MOST_OUTPUTS or sum(program.sizes.values()) > MOST_INPUTS:
            return None
        if profile not in SHIPPED:
            if self._own[profile] == MOST_VARIANTS:
                return None
            self._own[profile] += 1
        text, factors = program.code()
        try:
            return Compiled(program, factors, machine().function(text))
        except Exception as error:  # LLVM may raise anything
            return self.failed(f"LLVM could not compile a kernel sum ({error}).")

    def reduce(
        self, formula: Formula, profile: Profile, rows: Points | None, columns: Points
    ) -> tuple[Tensor, ...] | None:
        compiled = self.program(formula, profile, rows, columns)
        if compiled is None:
            return None
        at = columns if rows is None else rows
        return compiled.results(compiled.totals(rows, columns), len(at.features))


FUSED = Fused()  # one for the whole program, which keeps what it has compiled


@cache
def _missing() -> str:
    """Why sums cannot be compiled here; empty where they can."""
    try:
        machine()
    except ImportError:
        return "The package llvmlite is not installed (pip install 'diffeo_calib[fused]')."
    except Exception as error:  # LLVM may raise anything
        return f"LLVM does not know this processor ({error})."
    return ""
