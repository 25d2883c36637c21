"""KeOps and its environment: its import changes nothing, and tiled sums replace it where it does not work."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from diffeo_calib.kernels.reductions import keops

pytestmark = pytest.mark.slow  # separate processes

ROOT = Path(keops.__file__).parents[3]
ELSEWHERE = " Kernel sums run in torch instead (backend 'tiled'): slower, the same numbers."


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
    late, unchanged, silent, flags, folder = in_a_process(LOAD, XDG_CACHE_HOME=str(tmp_path))
    assert (late, unchanged, silent, flags) == (True, True, True, keops.CXXFLAGS)
    assert Path(folder).parent == tmp_path / "diffeo_calib"
    *known, flags, other = in_a_process(LOAD, XDG_CACHE_HOME=str(tmp_path), CXXFLAGS="-DOWN_FLAG")
    assert (*known, flags) == (True, True, True, "-DOWN_FLAG")
    assert other != folder
    assert Path(other).is_dir()
    assert in_a_process(LOAD, KEOPS_CACHE_FOLDER=str(tmp_path / "own"))[-1] == str(tmp_path / "own")


def test_without_a_folder_that_can_be_made_there_is_one_for_the_process() -> None:
    code = "import warnings\nwarnings.simplefilter('ignore')" + LOAD
    folder = Path(in_a_process(code, XDG_CACHE_HOME="/dev/null")[-1])
    assert folder.name.startswith("diffeo_calib-")
    assert not folder.exists()


FALL_BACK = """
import json, sys, warnings
import torch
if {missing}:
    sys.modules["pykeops"] = None
import diffeo_calib as dc
from diffeo_calib.kernels.reductions import backends
from diffeo_calib.kernels.reductions import keops
from diffeo_calib.kernels.reductions import tiled

calls = dict(load=0, compile=0, tiled=0)

def counted(name, function):
    def run(*args):
        calls[name] += 1
        return function(*args)
    return run

keops.load = counted("load", keops.load)
keops.Keops.reduce = counted("compile", keops.Keops.reduce)
tiled.Tiled.reduce = counted("tiled", tiled.Tiled.reduce)
kernel = dc.Gaussian(0.8) + dc.Matern(1.1)
x = torch.linspace(-1.0, 1.0, 10, dtype=torch.float64).view(5, 2)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    found = [kernel.using("keops").hamiltonian_gradient(x, x) for _ in range(2)]
expected = kernel.using("dense").hamiltonian_gradient(x, x)
for pair in found:
    torch.testing.assert_close(pair, expected, rtol=1e-13, atol=1e-13)
texts = [[w.category.__name__, str(w.message)] for w in caught]
print(json.dumps([texts, calls, backends.choose("keops", 9, 9, torch.device("cpu"))]))
"""
TROUBLES: dict[str, tuple[dict[str, str], str, tuple[int, int]]] = {
    "no pykeops": ({}, r"pykeops cannot be imported \(.*\)\.", (1, 0)),
    "no compiler": ({"PATH": ""}, r"KeOps finds no C\+\+ compiler; install g\+\+, or set CXX\.", (1, 0)),
    "no folder for files": (
        {"XDG_CACHE_HOME": "/dev/null", "KEOPS_CACHE_FOLDER": "/dev/null/keops"},
        r"pykeops cannot be imported \(.*\)\.",
        (1, 0),
    ),
    "a compiler that fails": (
        {"CXX": "false"},
        r"KeOps could not compile or run a kernel sum \(.*\)\.",
        (2, 1),
    ),
}


@pytest.mark.parametrize("trouble", TROUBLES)
def test_without_keops_tiles_run_after_one_warning_and_one_attempt(trouble: str, tmp_path: Path) -> None:
    environment, message, (loads, compilations) = TROUBLES[trouble]
    code = FALL_BACK.format(missing=trouble == "no pykeops")
    warned, calls, choice = in_a_process(code, **{"XDG_CACHE_HOME": str(tmp_path), **environment})
    ((category, text),) = warned
    assert category == "DiffeoCalibWarning"
    assert re.fullmatch(message + re.escape(ELSEWHERE), text)
    assert calls == {"load": loads, "compile": compilations, "tiled": 4}
    assert choice == "tiled"
