"""Help, version and shell completion load nothing slow, and the program can be started in every way."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from command_bank import environment, run_process

import diffeo_calib as dc
from diffeo_calib.cli.declarations import COMMANDS

SLOW = ("torch", "numpy", "scipy", "lxml", "yourdfpy", "matplotlib", "pykeops", "safetensors", "llvmlite")
LIGHT = f"""
import atexit, sys
sys.argv[0] = "diffeo-calib"
atexit.register(lambda: print("loaded:", *(name for name in {SLOW} if name in sys.modules), file=sys.stderr))
from diffeo_calib.__main__ import main
main()
"""


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["-h"], ["--version"], ["fit", "--help"], ["demo", "-h"]],
    ids=" ".join,
)
def test_help_and_version_load_nothing_slow(arguments: list[str]) -> None:
    done = run_process(*arguments, program=("-c", LIGHT))
    assert (done.code, done.err.strip()) == (0, "loaded:")
    expected = ["Usage: diffeo-calib"] if "--version" not in arguments else [f"diffeo-calib {dc.__version__}"]
    assert all(text in done.out for text in expected)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("diffeo-calib ", [*COMMANDS]),
        ("diffeo-calib pre", ["predict"]),
        ("diffeo-calib fit --ro", ["--robot", "--robot-pose", "--rotation", "--rotation-angle", "--rotation-std"]),
        ("diffeo-calib fit --length ", ["m", "mm", "cm", "inch"]),
        ("diffeo-calib --vers", ["--version"]),
    ],
)
def test_completion_loads_nothing_slow(words: str, expected: list[str]) -> None:
    variables = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_DIFFEO_CALIB_COMPLETE": "complete_bash"}
    done = run_process(program=("-c", LIGHT), variables=variables)
    assert (done.code, done.err.strip()) == (0, "loaded:")
    assert done.out.split() == expected


def test_the_script_of_the_completion_asks_the_program(tmp_path: Path) -> None:
    variables = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = run_process("--show-completion", "bash", variables=variables)
    assert done.code == 0
    assert "_DIFFEO_CALIB_COMPLETE=complete_bash" in done.out
    assert re.search(r"^complete .*-F \w+ diffeo-calib$", done.out, re.MULTILINE)
    done = run_process("--install-completion", "bash", variables={**variables, "HOME": str(tmp_path)})
    assert done.code == 0
    (script,) = (tmp_path / ".bash_completions").iterdir()
    assert "_DIFFEO_CALIB_COMPLETE=complete_bash" in script.read_text()
    assert str(script) in (tmp_path / ".bashrc").read_text()


def test_the_module_is_the_program() -> None:
    done = run_process("-h", program=("-m", "diffeo_calib"))
    assert done.code == 0
    assert done.out.startswith("Usage: python -m diffeo_calib [OPTIONS] COMMAND")
    wrong = run_process("nonsense", program=("-m", "diffeo_calib"))
    assert wrong.code == 2


def test_the_console_script_points_into_the_package() -> None:
    project = Path(__file__).parents[2] / "pyproject.toml"
    found = re.search(r'^diffeo-calib = "(diffeo_calib\.[\w.]+):(\w+)"$', project.read_text("utf-8"), re.MULTILINE)
    assert found is not None
    assert callable(getattr(importlib.import_module(found[1]), found[2]))
    assert version("diffeo_calib") == dc.__version__


@pytest.mark.parametrize(
    ("output", "message"), [("none/model", "make its folder first"), ("model", "no file t.csv; check")]
)
def test_errors_before_the_work_load_no_torch(output: str, message: str, tmp_path: Path) -> None:
    fit = ["fit", "t.csv", "--robot", "r.urdf", "--base", "a", "--tip", "b", "--position", "x,y,z"]
    units = ["--length", "m", "--angle", "rad", "-o", str(tmp_path / output)]
    command = [sys.executable, "-c", LIGHT, *fit, *units]
    done = subprocess.run(command, capture_output=True, env=environment(), timeout=60, check=False, encoding="utf-8")
    assert done.returncode == 1
    assert message in done.stderr
    assert "torch" not in done.stderr.splitlines()[-1]


def test_evaluate_loads_nothing_that_draws() -> None:
    program = "import sys, diffeo_calib.cli.commands.evaluate; print('matplotlib' in sys.modules)"
    assert run_process(program=("-c", program)).out == "False\n"
