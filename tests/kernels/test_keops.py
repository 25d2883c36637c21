"""KeOps: really compiled sums against those of one matrix, its environment, and tiled sums where it does not work."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from math_bank import case_named, normal
from sum_bank import FORMULAS, assert_same, mapped, points
from torch import Tensor

from diffeo_calib.kernels.profiles import CauchyProfile, ConstantProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import keops
from diffeo_calib.kernels.reductions.formulas import FIELD, HESSIAN_PRODUCT, Dense, Formula, Points
from diffeo_calib.kernels.reductions.keops import Keops

pytestmark = pytest.mark.slow  # a compiler, or separate processes

ROOT = Path(keops.__file__).parents[3]
ROUGH = MaternProfile(1.5)
COMPILED = [*((formula, ROUGH) for formula in FORMULAS.values()), (FIELD, CauchyProfile())]
COMPILED += [(HESSIAN_PRODUCT, ConstantProfile())]  # weights without symbols, and zeros


def compiled(formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
    found = Keops().reduce(formula, profile, rows, columns)
    assert found is not None
    return found


@pytest.mark.parametrize(("formula", "profile"), COMPILED, ids=lambda one: one.name)
def test_compiled_sums(formula: Formula, profile: Profile, capfd: pytest.CaptureFixture[str]) -> None:
    for count, rows in ((5, 6), (280, 300)):
        i, j = points(rows, 1), points(count, 2)
        expected = Dense().reduce(formula, profile, i, j)
        strided = [mapped(p, lambda t: torch.stack([t, t], -1)[..., 0]) for p in (i, j)]
        assert_same(compiled(formula, profile, *strided), expected, 1e-13 * count)
        if profile != ROUGH:  # where points coincide its third derivative is singular
            assert_same(compiled(formula, profile, None, j), Dense().reduce(formula, profile, None, j), 1e-13 * count)
    assert capfd.readouterr() == ("", "")


def test_single_precision_and_denormal_numbers() -> None:
    """With `-ffast-math`, loading a compiled formula would flush denormal numbers to zero in the whole process."""
    i, j = points(6, 1), points(5, 2)
    (found,) = compiled(FIELD, GaussianProfile(), *(mapped(p, Tensor.float) for p in (i, j)))
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), *Dense().reduce(FIELD, GaussianProfile(), i, j), rtol=0, atol=1e-5)
    assert np.float64(1e-310) * 0.5 == 5e-311
    assert float(torch.tensor(1e-310, dtype=torch.float64) * 0.5) == 5e-311


@pytest.mark.parametrize("live", range(4))
def test_tiled_sums_replace_keops_where_gradients_are_needed(live: int) -> None:
    case, gradients = case_named("matern-1.5"), []
    inputs = case.points(6, seed=1), normal(6, 2, seed=4), case.points(5, seed=2), normal(5, 2, seed=3)
    for backend in ("dense", "keops"):
        tensors = [t.clone().requires_grad_(k == live) for k, t in enumerate(inputs)]
        kernel = case.kernel.using(backend)
        results = kernel.gradient(*tensors)
        loss = sum((normal(*t.shape, seed=k) * t).sum() for k, t in enumerate(results))
        gradients += torch.autograd.grad(loss, tensors[live])
        with torch.no_grad():
            again = kernel.gradient(*tensors)
        assert not any(t.requires_grad for t in again)
        assert_same(again, results, 1e-12)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-12, atol=1e-12)


def in_a_process(code: str, **environment: str) -> Any:
    """Run code in a separate process with these variables, without the user's for KeOps; return its output as JSON."""
    kept = {k: v for k, v in os.environ.items() if k not in ("CXX", "CXXFLAGS", "KEOPS_CACHE_FOLDER")}
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command, env = [sys.executable, "-c", code], {**kept, "PYTHONPATH": paths, **environment}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)  # fails if anything else is printed


LOAD = """
import json, os, sys
before = dict(os.environ)
import diffeo_calib
late = "pykeops" not in sys.modules
from diffeo_calib.kernels.reductions import keops
keops.load()
import pykeops
config = pykeops.config.pykeops_base
unchanged = dict(os.environ) == before
print(json.dumps([late, unchanged, not pykeops.verbose, config.get_cpp_env_flags(), config.get_keops_cache_folder()]))
"""


def test_import_is_late_and_silent_and_leaves_the_environment_alone(tmp_path: Path) -> None:
    """Every set of flags has its own cache folder; variables of the user are respected."""
    *known, flags, folder = in_a_process(LOAD, XDG_CACHE_HOME=str(tmp_path))
    assert (known, flags) == ([True, True, True], keops.CXXFLAGS)
    assert Path(folder).parent == tmp_path / "diffeo_calib"
    *known, flags, other = in_a_process(LOAD, XDG_CACHE_HOME=str(tmp_path), CXXFLAGS="-DOWN_FLAG")
    assert (known, flags) == ([True, True, True], "-DOWN_FLAG")
    assert other != folder
    assert Path(other).is_dir()
    assert in_a_process(LOAD, KEOPS_CACHE_FOLDER=str(tmp_path / "own"))[-1] == str(tmp_path / "own")


FALL_BACK = """
import json, sys, warnings
import torch
if {missing}:
    sys.modules["pykeops"] = None
import diffeo_calib as dc
from diffeo_calib.kernels.reductions import backends, keops

attempts, reduce = [], keops.Keops.reduce
keops.Keops.reduce = lambda *sum: attempts.append(1) or reduce(*sum)
kernel = dc.Gaussian(0.8) + dc.Matern(1.1)
x = torch.linspace(-1.0, 1.0, 10, dtype=torch.float64).view(5, 2)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    found = [kernel.using("keops").hamiltonian_gradient(x, x) for _ in range(2)]
for pair in found:
    torch.testing.assert_close(pair, kernel.using("dense").hamiltonian_gradient(x, x), rtol=1e-13, atol=1e-13)
texts = [[w.category.__name__, str(w.message)] for w in caught]
print(json.dumps([texts, len(attempts), backends.choose("keops", 9, 9, torch.device("cpu"))]))
"""
NO_FOLDER = {"XDG_CACHE_HOME": "/dev/null", "KEOPS_CACHE_FOLDER": "/dev/null/keops"}
TROUBLES: dict[str, tuple[dict[str, str], str]] = {
    "no pykeops": ({}, r"pykeops cannot be imported \(.*\)\."),
    "no compiler": ({"PATH": ""}, r"KeOps finds no C\+\+ compiler; install g\+\+, or set CXX\."),
    "no folder for files": (NO_FOLDER, r"pykeops cannot be imported \(.*\)\."),
    "a compiler that fails": ({"CXX": "false"}, r"KeOps could not compile or run a kernel sum \(.*\)\."),
}


@pytest.mark.parametrize("trouble", TROUBLES)
def test_without_keops_tiles_run_after_one_warning_and_one_attempt(trouble: str, tmp_path: Path) -> None:
    environment, message = TROUBLES[trouble]
    code = FALL_BACK.format(missing=trouble == "no pykeops")
    warned, attempts, choice = in_a_process(code, **{"XDG_CACHE_HOME": str(tmp_path), **environment})
    ((category, text),) = warned
    assert category == "DiffeoCalibWarning"
    elsewhere = " Kernel sums run in torch instead (backend 'tiled'): slower, the same numbers."
    assert re.fullmatch(message + re.escape(elsewhere), text)
    assert (attempts, choice) == (int("fails" in trouble), "tiled")
