"""The package loads its public names when they are first used; a submodule never hides one of them."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

import diffeo_calib as dc

PACKAGE = Path(dc.__file__).parent
SLOW = (
    "torch",
    "numpy",
    "scipy",
    "lxml",
    "yourdfpy",
    "matplotlib",
    "pykeops",
    "torchdiffeq",
    "safetensors",
    "rich",
    "typer",
)
"""Libraries that a bare import does not load."""


def run(code: str) -> str:
    """Standard output of Python code in a process of its own."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=PACKAGE.parent, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_bare_import_loads_nothing_slow() -> None:
    code = f"import sys, diffeo_calib as dc; dc.__version__; dir(dc); print(*(m for m in {SLOW} if m in sys.modules))"
    assert run(code) == ""


def test_models_are_used_without_scipy() -> None:
    file = PACKAGE.parent / "tests/interop/data/robot_format_3.safetensors"
    code = f"import sys, diffeo_calib as dc; m = dc.load({str(file)!r}); m([[0.1] * m.robot.n]); dc.calibrate; "
    assert run(code + "print('scipy' in sys.modules)") == "False"


def test_errors_are_loaded_without_torch() -> None:
    assert run("import sys, diffeo_calib as dc; dc.DiffeoCalibError; print('torch' in sys.modules)") == "False"


def test_every_public_name_is_loaded_and_listed() -> None:
    assert set(dc.__all__) <= set(dir(dc))
    assert not {"TYPE_CHECKING", "annotations", "import_module", "logging"} & set(dir(dc))
    for name in dc.__all__:
        assert getattr(dc, name).__module__.startswith("diffeo_calib.")
    assert len(set(dc.__all__)) == len(dc.__all__)


SUBMODULES_FIRST = """
import diffeo_calib.calibration.calibrate, diffeo_calib.fitting.fit, diffeo_calib.kinematics.evaluation
import diffeo_calib as dc
print(dc.calibrate.__name__, dc.fit.__name__, dc.evaluate.__name__)
from diffeo_calib import *
print(fit is dc.fit, all(callable(getattr(dc, name)) for name in dc.__all__))
print(all(getattr(dc, name).__name__ == f"diffeo_calib.{name}" for name in FOLDERS))
"""
FOLDERS = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}


def test_submodules_do_not_hide_functions() -> None:
    """Neither when they are imported first, in a new process, nor after the functions."""
    assert run(SUBMODULES_FIRST.replace("FOLDERS", repr(FOLDERS))) == "calibrate fit evaluate\nTrue True\nTrue"
    functions = dc.fit, dc.calibrate, dc.evaluate
    for name in ("fitting.fit", "calibration.calibrate", "kinematics.evaluation"):
        importlib.import_module(f"diffeo_calib.{name}")
    assert (dc.fit, dc.calibrate, dc.evaluate) == functions
    assert set(dir(dc)) >= FOLDERS


def test_names_seen_by_type_checkers_are_those_that_are_loaded() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (checking,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    imports = [
        node for node in ast.walk(checking) if isinstance(node, ast.ImportFrom) and "diffeo_calib." in str(node.module)
    ]
    seen = {alias.name: node.module for node in imports for alias in node.names}
    assert set(seen) == {*dc.__all__, "plots"}
    for name, module in seen.items():
        assert getattr(sys.modules[str(module)], name) is getattr(dc, name), "the table names another module"


def test_no_module_has_the_name_of_a_public_function() -> None:
    """The import of a module binds its name in its package, here in place of the function."""
    modules = {path.stem for path in PACKAGE.iterdir() if path.is_dir() or path.suffix == ".py"}
    assert not modules & set(dc.__all__)


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match=r"^module 'diffeo_calib' has no attribute 'calibarte'$"):
        dc.calibarte  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ImportError, match="cannot import name 'calibarte'"):
        from diffeo_calib import calibarte  # noqa: F401  # pyright: ignore[reportAttributeAccessIssue]
    assert not hasattr(dc, "_calibrate")


def test_the_wheel_holds_every_file_of_the_package() -> None:
    """Its data too: URDF, JSON schema, C sources, templates."""
    root = PACKAGE.parent
    packed = {file.distribution_path for file in WheelBuilder(str(root)).recurse_included_files()}
    there = {path.relative_to(root).as_posix() for path in PACKAGE.rglob("*.*") if "__pycache__" not in path.parts}
    assert packed == {name for name in there if (root / name).is_file()}


def test_extras_in_messages_and_pages_exist() -> None:
    root = PACKAGE.parent
    project = (root / "pyproject.toml").read_text(encoding="utf-8")
    table = project.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    files = [*PACKAGE.rglob("*.py"), *(root / "scripts/docs/pages").rglob("*.md")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in files)
    named = set(re.findall(r"pip install \W*(?:diffeo_calib|\.)\[(\w+)\]", text))
    assert {"camera", "collisions", "fused", "notebooks", "onnx", "ros"} == named
    assert named <= set(re.findall(r"^(\w+) = ", table, re.MULTILINE))
