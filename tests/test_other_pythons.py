"""Every module can be imported by every Python that pyproject.toml allows and this machine has."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

import diffeo_calib as dc

IMPORT_ALL = """
import importlib, pkgutil, sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from unittest.mock import MagicMock

class Anything(MetaPathFinder, Loader):
    # Stands for every library: torch and its companions take minutes to install for one more Python.
    def find_spec(self, name, path=None, target=None):
        ours = name.partition(".")[0] in {*sys.stdlib_module_names, "diffeo_calib"}
        return None if ours else ModuleSpec(name, self, is_package=True)

    def create_module(self, spec):
        return MagicMock(__path__=[])

    def exec_module(self, module):
        pass

sys.meta_path.append(Anything())
import diffeo_calib
for found in pkgutil.walk_packages(diffeo_calib.__path__, "diffeo_calib."):
    if not found.name.endswith(("__main__", ".sklearn")):  # the bases of its classes cannot be stood for
        importlib.import_module(found.name)
"""


def interpreter(version: str) -> str | None:
    """A Python of this version that runs: a name on the path may be a shim of one that is not chosen."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    for name in (f"python{version}", *map(str, sorted(pyenv.glob(f"{version}.*/bin/python")))):
        found = shutil.which(name)
        if found and subprocess.run([found, "-c", ""], capture_output=True, check=False, timeout=60).returncode == 0:
            return found
    return None


@pytest.mark.parametrize("version", ["3.10", "3.12", "3.13", "3.14"])
def test_every_module_can_be_imported(version: str) -> None:
    python = interpreter(version)
    if python is None:
        pytest.skip(f"no Python {version} here")
    command = [python, "-S", "-B", "-W", "error", "-c", IMPORT_ALL]
    environment = {**os.environ, "PYTHONPATH": str(Path(dc.__file__).parents[1])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
