"""Fused sums: they equal sums over one matrix, whatever the threads, the processor's vectors, and what is installed."""

import errno
import os
import subprocess
import sys
import threading
import warnings
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from math_bank import normal
from sum_bank import Formulated, assert_same, mapped, points
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.kernels.profiles import GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends, formulas
from diffeo_calib.kernels.reductions import fused as sums
from diffeo_calib.kernels.reductions.formulas import FIELD, GRADIENT, HESSIAN_PRODUCT, Dense, Formula, Points
from diffeo_calib.kernels.reductions.fused import Fused
from diffeo_calib.kernels.reductions.loops import Program

pytest.importorskip("llvmlite")
FULL = HESSIAN_PRODUCT


def fused(formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
    found = Fused().reduce(formula, profile, rows, columns)
    assert found is not None
    return found


@pytest.mark.parametrize("lanes", [2, 4, 8, 16])
def test_vectors_of_every_width(lanes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processors without wide registers, and wider ones: LLVM splits or joins vectors where it must."""
    monkeypatch.setattr(sums.machine(), "vector_bytes", 8 * lanes)
    monkeypatch.setattr(sums, "MOST_GROUP", max(16, lanes))
    j = points(61, 2)
    assert_same(fused(FULL, GaussianProfile(), None, j), Dense().reduce(FULL, GaussianProfile(), None, j), 1e-11)


def test_the_exponential_is_exact_to_rounding() -> None:
    """From 1 down to the smallest normal numbers, and beyond; the argument itself is rounded, too."""
    r = torch.linspace(0.0, 60.0, 4001, dtype=torch.float64)[:, None]
    one = Points(torch.zeros(1, 1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64))
    (found,) = fused(FIELD, GaussianProfile(), Points(r), one)
    exact, limits = (-0.5 * r.square()).exp(), torch.finfo(torch.float64)
    assert bool(((found - exact).abs() <= exact * (1e-15 + limits.eps * r.square()) + limits.tiny * 9).all())
    assert float(found[0]) == 1.0


def test_points_that_are_not_finite_or_far_away() -> None:
    """The first are seen; the others add nothing: a large polynomial times an exponential that is zero."""
    unusual = torch.tensor(0x7FF80000000007A2).view(torch.float64)  # NaN with other bits, such as R's "not available"
    for value in (float("nan"), float("inf"), unusual):
        j = points(40, 2)
        j.features[7, 1] = value
        assert all(bool(t.isnan().any()) for t in fused(FULL, GaussianProfile(), None, j))
        assert bool(fused(FIELD, GaussianProfile(), None, j)[0][7].isnan().all())
    i, j = points(4, 1), points(30, 2)
    i.features[:] = 1e100
    for nu in (1.5, 3.5):
        assert not any(bool(t.any()) for t in fused(GRADIENT, MaternProfile(nu), i, j))


def test_numbers_of_a_profile_that_change(monkeypatch: pytest.MonkeyPatch) -> None:
    """Profiles may read constants of their class or module, or the contents of an object; these may be optimised."""
    monkeypatch.setattr(sums, "MOST_VARIANTS", 2)
    numbers: dict[str, float] = {}
    backend, profile, j = Fused(), Formulated(lambda r2: (-(r2 * numbers["alpha"])).exp()), points(30, 2)
    compiled = []
    for numbers["alpha"] in (0.3, 0.9, 0.5, 0.3):
        found = backend.reduce(FIELD, profile, None, j)
        compiled.append(found is not None)
        assert_same(found or (), Dense().reduce(FIELD, profile, None, j) if found else (), 1e-12)
    assert compiled == [True, True, False, True]


def test_what_cannot_be_compiled_is_left_to_others() -> None:
    j = points(30, 2)
    for other in (j._replace(momenta=j.momenta.float()), mapped(j, Tensor.float)):
        assert Fused().reduce(FIELD, GaussianProfile(), None, other) is None
    assert Fused().reduce(FIELD, Formulated(torch.cos), None, j) is None
    wide = j._replace(momenta=normal(30, sums.MOST_OUTPUTS + 1, seed=1))
    long = j._replace(features=normal(30, sums.MOST_INPUTS, seed=1))  # 2500 coordinates would take minutes
    for unusual in (wide, long):
        assert Fused().reduce(FIELD, GaussianProfile(), None, unusual) is None
        expected = Dense().reduce(FIELD, GaussianProfile(), None, unusual)
        assert_same(backends.evaluate(FIELD, GaussianProfile(), None, unusual, "fused"), expected, 1e-12)


def test_compiled_code_is_kept_where_it_can_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    j, compiled = points(30, 2), []
    emit = sums.Machine._emit
    monkeypatch.setattr(sums.Machine, "_emit", lambda self, text: compiled.append(1) or emit(self, text))
    found = []
    for damage in (False, False, True):
        monkeypatch.setattr(sums, "machine", cache(sums.Machine))
        for file in (tmp_path / "diffeo_calib" / "fused").glob("*") if damage else ():
            file.write_bytes(file.read_bytes()[:-9])
        found.append(fused(FIELD, GaussianProfile(), None, j))
    assert len(compiled) == 2
    assert all(torch.equal(found[0][0], other[0]) for other in found[1:])
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(sums, "machine", cache(sums.Machine))
    j = points(30, 2)
    with pytest.warns(DiffeoCalibWarning, match="kept for this run only"):
        found = fused(FIELD, GaussianProfile(), None, j)
    assert_same(found, Dense().reduce(FIELD, GaussianProfile(), None, j), 1e-12)
    # nor a full disk, which would become fuller with every process
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "full"))
    monkeypatch.setattr(os, "replace", Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    monkeypatch.setattr(sums, "machine", cache(sums.Machine))
    fused(FIELD, GaussianProfile(), None, j)
    assert list((tmp_path / "full" / "diffeo_calib" / "fused").iterdir()) == []


def test_without_llvmlite_tiles_do_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "llvmlite", None)
    monkeypatch.setattr(sums, "machine", sums.Machine)
    sums._missing.cache_clear()
    formulas._warn.cache_clear()
    q, a = normal(200, 3, seed=1), normal(200, 3, seed=2)
    expected = dc.Gaussian(0.5).using("tiled").field(None, q, a)
    try:
        assert backends.choose("auto", 200, 200, torch.device("cpu")) == "tiled"
        assert torch.equal(dc.Gaussian(0.5).field(None, q, a), expected)  # without a warning
        with pytest.warns(DiffeoCalibWarning, match=r"llvmlite.*diffeo_calib\[fused\].*tiled"):
            assert torch.equal(dc.Gaussian(0.5).using("fused").field(None, q, a), expected)
    finally:
        sums._missing.cache_clear()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_process_forked_while_a_thread_compiles_can_compile() -> None:
    held, compiled = threading.Event(), threading.Event()

    def compiling() -> None:
        with sums.LOCK:
            held.set()
            compiled.wait(0.1)

    thread = threading.Thread(target=compiling)
    thread.start()
    assert held.wait(5.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, from Python 3.12 on
        child = os.fork()
    if child == 0:
        os._exit(0 if sums.LOCK.acquire(timeout=2.0) else 1)
    thread.join()
    assert os.waitpid(child, 0)[1] == 0


def test_a_failure_of_llvm_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = Fused()
    monkeypatch.setattr(Program, "code", lambda self: ("nonsense", [1.0]))
    formulas._warn.cache_clear()
    with pytest.warns(DiffeoCalibWarning, match="LLVM could not compile"):
        assert backend.reduce(FIELD, GaussianProfile(), None, points(30, 2)) is None
    assert not backend.usable()
    assert backend.reduce(FIELD, GaussianProfile(), None, points(30, 2)) is None


FAR_APART = """
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
    done = subprocess.run([sys.executable, "-c", FAR_APART], capture_output=True, text=True, check=False)
    assert done.stdout == "done\n", done.stderr[-500:]
