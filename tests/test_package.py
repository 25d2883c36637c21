"""The package loads its public names when they are first used; a submodule never hides one of them."""

import ast
import importlib
import logging
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder
from product_bank import simulated, with_usual_scales

import diffeo_calib as dc

PACKAGE = Path(dc.__file__).parent
SLOW = [
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
]
"""Libraries that a bare import does not load."""
NAMES: list[str] = vars(dc)["__all__"]


ALONE = """
import sys, logging, diffeo_calib as dc
dc.__version__; dir(dc)
print(*(name for name in SLOW if name in sys.modules))
import diffeo_calib.calibration.calibrate, diffeo_calib.fitting.fit, diffeo_calib.kinematics.evaluation
model = dc.load(FILE); model([[0.1] * model.robot.n])
print("scipy" in sys.modules, dc.calibrate.__name__, dc.fit.__name__, dc.evaluate.__name__)
from diffeo_calib import *
print(fit is dc.fit, all(callable(getattr(dc, name)) for name in dc.__all__))
print(all(getattr(dc, name).__name__ == f"diffeo_calib.{name}" for name in FOLDERS))
log = logging.getLogger("diffeo_calib"); log.warning("heard by nobody")
print(log.level, [type(one).__name__ for one in log.handlers])
"""
FOLDERS = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}


def test_an_import_is_light_silent_and_hides_nothing() -> None:
    """In a process of its own: slow libraries are not loaded, submodules that come first hide no function."""
    code = ALONE.replace("FILE", repr(str(PACKAGE.parent / "tests/interop/data/robot_format_3.safetensors")))
    code = code.replace("SLOW", repr(SLOW)).replace("FOLDERS", repr(FOLDERS))
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=PACKAGE.parent, timeout=120, check=False)
    printed = ["", "False calibrate fit evaluate", "True True", "True", "0 ['NullHandler']"]
    assert (done.stdout.splitlines(), done.stderr) == (printed, "")
    assert set(dir(dc)) >= FOLDERS


@pytest.mark.parametrize(
    "name",
    [
        "interop.numpy_model.NumpyKinematics",
        "kinematics.device_readings.PredictedReadings",
        "kinematics.provenance.Provenance",
        "kinematics.provenance.Summary",
        "kinematics.transmission.NamedGearLine",
        "measurements.csv.sensors.ReadingColumns",
        "measurements.csv.sensors.SocketColumns",
        "measurements.table_format.TableFormat",
    ],
)
def test_help_and_the_page_say_what_the_fields_of_results_and_tables_are(name: str) -> None:
    module, _, own = name.rpartition(".")
    kind = getattr(importlib.import_module(f"diffeo_calib.{module}"), own)
    text = (kind.__doc__ or "").partition("Args:")[2]
    assert [field.name for field in fields(kind) if f"{field.name}: " not in text] == []


def test_names_seen_by_type_checkers_are_those_that_are_loaded() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (checking,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    imports = [
        node for node in ast.walk(checking) if isinstance(node, ast.ImportFrom) and "diffeo_calib." in str(node.module)
    ]
    seen = {alias.name: node.module for node in imports for alias in node.names}
    assert set(seen) == {*NAMES, "plots"}, "the only list of names"
    for name, module in seen.items():
        public = getattr(dc, name)  # loads submodules
        assert public is getattr(importlib.import_module(str(module)), name), "the table names another module"


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match=r"^module 'diffeo_calib' has no attribute 'calibarte'$"):
        dc.calibarte  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
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
    assert {"camera", "collisions", "excel", "fused", "notebooks", "onnx", "ros"} == named
    assert named <= set(re.findall(r"^(\w+) = ", table, re.MULTILINE))


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


@pytest.mark.parametrize("version", ["3.10", "3.14"])
def test_every_module_can_be_imported(version: str) -> None:
    python = interpreter(version)
    if python is None:
        pytest.skip(f"no Python {version} here")
    command = [python, "-S", "-B", "-W", "error", "-c", IMPORT_ALL]
    environment = {**os.environ, "PYTHONPATH": str(Path(dc.__file__).parents[1])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith("diffeo_calib.")]


@pytest.mark.usefixtures("undrawn")
def test_the_steps_of_a_calibration_and_of_a_report(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    arm, train, test = simulated(30)
    points = train.points.clone()
    points[7] += 0.01
    with caplog.at_level(logging.INFO, logger="diffeo_calib"):
        result = with_usual_scales(arm.nominal, dc.Measurements(train.q, points))
        dc.save(result.model, tmp_path / "arm.safetensors")
        both = dc.Measurements.joined([train[:20], test[:20]])
        dc.write_report(result.model, tmp_path / "arm.html", both)
    found = messages(caplog)
    assert {record.levelname for record in caplog.records} == {"INFO"}
    begins = ("calibrating", "registration: ", "scales: ", "fit of 30 rows: converged", "rows that look")
    places = [next(k for k, text in enumerate(found) if text.startswith(begin)) for begin in begins]
    assert places == sorted(places)
    assert found[places[-1]] == "rows that look wrong and hardly count: 7"
    assert f"model written to {tmp_path}/arm.safetensors" in found
    assert "judged by 20 rows it has not seen, 20 were used before" in found


def test_the_script_of_versions_names_files_that_are_there() -> None:
    text = (PACKAGE.parent / "scripts" / "versions.sh").read_text(encoding="utf-8")
    names = re.findall(r"tests/[\w/.]+", text)
    assert len(names) > 10
    assert [name for name in names if not (PACKAGE.parent / name).exists()] == []
