"""Compiled sums in a process whose memory is in use: the parts of a module must still lie near to each other."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("llvmlite")

CODE = """
import mmap
import torch
import diffeo_calib as dc

x, kept = torch.rand(50, 3, dtype=torch.float64), []
for kernel in (dc.Gaussian(0.5), dc.Cauchy(0.5), dc.Matern(0.5)):
    for name in ("field", "hamiltonian_gradient", "field_and_jacobian"):
        kept += [mmap.mmap(-1, size * mmap.PAGESIZE) for size in (1, 2, 3) for _ in range(200)]  # fills the holes
        kept.append(mmap.mmap(-1, 3 << 30))  # never touched
        points = {"field": (None, x, x), "hamiltonian_gradient": (x, x)}.get(name, (x, x, x))
        getattr(kernel.using("fused"), name)(*points)
print("done")
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory that is only reserved")
def test_modules_load_between_large_blocks_of_memory() -> None:
    """Addresses within a module have 32 bits: parts that are allocated one by one make LLVM end the process."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.stdout == "done\n", done.stderr[-500:]
