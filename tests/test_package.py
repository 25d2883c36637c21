"""The package loads its public names when they are first used; a submodule never hides one of them."""

import ast
import importlib
import logging
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder
from product_bank import simulated, with_usual_scales

import diffeo_calib as dc

PACKAGE = Path(dc.__file__).parent
SLOW = ["torch", "numpy", "scipy", "lxml", "yourdfpy", "matplotlib", "pykeops", "torchdiffeq", "safetensors", "rich"]
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


FIELDS = ["interop.numpy_model.NumpyKinematics", "kinematics.device_readings.PredictedReadings"]
FIELDS += ["kinematics.provenance.Provenance", "kinematics.provenance.Summary", "kinematics.transmission.NamedGearLine"]
FIELDS += [f"measurements.{name}" for name in ("csv.sensors.ReadingColumns", "csv.sensors.SocketColumns")]


@pytest.mark.parametrize("name", [*FIELDS, "measurements.table_format.TableFormat"])
def test_help_and_the_page_say_what_the_fields_of_results_and_tables_are(name: str) -> None:
    module, _, own = name.rpartition(".")
    kind = getattr(importlib.import_module(f"diffeo_calib.{module}"), own)
    text = (kind.__doc__ or "").partition("Args:")[2]
    assert [field.name for field in fields(kind) if f"{field.name}: " not in text] == []


def test_names_are_those_that_are_loaded() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (checking,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    imports = [node for node in ast.walk(checking) if isinstance(node, ast.ImportFrom)]
    seen = {one.name: node.module for node in imports for one in node.names if "diffeo_calib." in str(node.module)}
    assert set(seen) == {*NAMES, "plots"}, "the only list of names"
    for name, module in seen.items():
        public = getattr(dc, name)  # loads submodules
        assert public is getattr(importlib.import_module(str(module)), name), "the table names another module"
    with pytest.raises(AttributeError, match=r"^module 'diffeo_calib' has no attribute 'calibarte'$"):
        dc.calibarte  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    assert not hasattr(dc, "_calibrate")


def test_files_and_extras_exist() -> None:
    """In the wheel data too: URDF, JSON schema, C sources, templates; extras of messages; files of versions.sh."""
    root = PACKAGE.parent
    packed = {file.distribution_path for file in WheelBuilder(str(root)).recurse_included_files()}
    there = {path.relative_to(root).as_posix() for path in PACKAGE.rglob("*.*") if "__pycache__" not in path.parts}
    assert packed == {name for name in there if (root / name).is_file()}
    root = PACKAGE.parent
    project = (root / "pyproject.toml").read_text(encoding="utf-8")
    table = project.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    files = [*PACKAGE.rglob("*.py"), *(root / "scripts/docs/pages").rglob("*.md")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in files)
    named = set(re.findall(r"pip install \W*(?:diffeo_calib|\.)\[(\w+)\]", text))
    assert {"camera", "collisions", "excel", "fused", "notebooks", "onnx", "ros"} == named
    assert named <= set(re.findall(r"^(\w+) = ", table, re.MULTILINE))
    text = (PACKAGE.parent / "scripts" / "versions.sh").read_text(encoding="utf-8")
    names = re.findall(r"tests/[\w/.]+", text)
    assert len(names) > 10
    assert [name for name in names if not (PACKAGE.parent / name).exists()] == []


def test_the_steps_of_a_calibration(caplog: pytest.LogCaptureFixture) -> None:
    arm, train, _ = simulated(30)
    points = train.points.clone()
    points[7] += 0.01
    with caplog.at_level(logging.INFO, logger="diffeo_calib"):
        with_usual_scales(arm.nominal, dc.Measurements(train.q, points))
    found = [record.getMessage() for record in caplog.records if record.name.startswith("diffeo_calib.")]
    assert {record.levelname for record in caplog.records} == {"INFO"}
    begins = ("calibrating", "registration: ", "scales: ", "fit of 30 rows: converged", "rows that look")
    places = [next(k for k, text in enumerate(found) if text.startswith(begin)) for begin in begins]
    assert places == sorted(places)
    assert found[places[-1]] == "rows that look wrong and hardly count: 7"
