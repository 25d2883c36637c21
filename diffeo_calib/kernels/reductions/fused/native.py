"""LLVM code compiled for this processor, by llvmlite, and kept on disk."""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from threading import Lock
from typing import Any

from diffeo_calib.kernels.reductions.folder import cache_folder

DIGEST = hashlib.sha256().digest_size


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
        found = llvm.get_host_cpu_features()
        name, features = llvm.get_host_cpu_name(), found.flatten()
        self.vector_bytes = 64 if found.get("avx512f") else 32 if found.get("avx2") else 16
        self.mark = f"{name} {features} {llvmlite.__version__}"
        # ELF on Windows too, whose own format the loader of objects handles badly
        triple = llvm.get_process_triple() + ("-elf" if sys.platform == "win32" else "")
        self.llvm, self.lock, self.loaded = llvm, Lock(), set[str]()
        options = {"cpu": name, "features": features, "opt": 3, "reloc": "pic", "codemodel": "small"}
        self.target = llvm.Target.from_triple(triple).create_target_machine(**options)
        self.engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), self.target)

    def functions(self, text: str, names: Mapping[str, int]) -> list[Any]:
        """Compile a module, or load what an earlier process compiled, and return some of its functions.

        Args:
            names: of the functions, with the number of their arguments: addresses or 64-bit integers.
        """
        mark = hashlib.sha256(f"{self.mark}\n{text}".encode()).hexdigest()[:24]
        for name in names:
            text = text.replace(f"@{name}(", f"@{name}_{mark}(")
        with self.lock:
            if mark not in self.loaded:
                self._load(mark, text)
                self.loaded.add(mark)
            kinds = [ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * arguments) for arguments in names.values()]
            addresses = [self.engine.get_function_address(f"{name}_{mark}") for name in names]
            return [kind(address) for kind, address in zip(kinds, addresses, strict=True)]

    def _load(self, mark: str, text: str) -> None:
        code = _kept(mark)
        if code is None:
            code = self._emit(text)
            _keep(mark, code)
        self.engine.add_object_file(self.llvm.ObjectFileRef.from_data(code))
        self.engine.finalize_object()

    def _emit(self, text: str) -> bytes:
        module = self.llvm.parse_assembly(text)
        module.verify()
        return self.target.emit_object(module)


@cache
def machine() -> Machine:
    """This processor."""
    return Machine()


def _kept(mark: str) -> bytes | None:
    """The compiled module; None if there is none, or a damaged one."""
    try:
        content = (cache_folder("fused") / mark).read_bytes()
    except (OSError, RuntimeError):
        return None
    digest, code = content[:DIGEST], content[DIGEST:]
    return code if hashlib.sha256(code).digest() == digest else None


def _keep(mark: str, code: bytes) -> None:
    """Write the compiled module in one step, if the folder can be written."""
    with suppress(OSError, RuntimeError):
        folder = cache_folder("fused")
        partial = folder / f"{mark}.{os.getpid()}"
        partial.write_bytes(hashlib.sha256(code).digest() + code)
        partial.replace(folder / mark)
