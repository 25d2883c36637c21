"""The generated files as C: names, memory, threads, warnings, C++, the example of the header, and refusals."""

from __future__ import annotations

import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from c_bank import C99, COMPILER, CPLUSPLUS, STRICT, CModel, compiled, needs_compiler
from deformation_bank import model_of
from robots_bank import CHAINS

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop import CFiles, write_c
from diffeo_calib.interop.c_source import array, number
from diffeo_calib.kinematics.provenance import Provenance

FUNCTIONS = ("markers", "tool_pose", "newton_step")
MAIN = """
#include <stdio.h>
#include "robot.h"
{functions}
int main(void)
{{
{body}
    return 0;
}}
"""
CORRECTED = """
    double start[6] = {0.3, -0.8, 1.1, 0.4, 0.9, -0.2}, q[6], T[16];
    robot_tool_pose(start, T, NULL);
    T[3] += 1e-3;
    if (!correct(start, T, q)) return 1;
    T[3] += 1e3;
    if (correct(start, T, q)) return 2;
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> CFiles:
    return write_c(model_of(CHAINS["mimic joints"]), tmp_path_factory.mktemp("c") / "robot.c")


def undefined_and_defined(library: Path) -> tuple[set[str], dict[str, str]]:
    """Names that an object file needs, and those that it has with their sections."""
    listing = subprocess.run(["nm", library], capture_output=True, text=True, check=True, timeout=60).stdout
    words = [line.split() for line in listing.splitlines()]
    needed = {word[1].partition("@")[0] for word in words if len(word) == 2 and word[0] == "U"}
    return needed, {word[2]: word[1] for word in words if len(word) == 3}


@needs_compiler
def test_calls_from_several_threads(files: CFiles) -> None:
    made = CModel(files.source, 3, 2)
    each = np.random.default_rng(5).uniform(-1, 1, (2, 400, 3))
    expected = [made.poses_and_jacobian(rows) for rows in each]
    with ThreadPoolExecutor(2) as threads:
        for number, found in enumerate(threads.map(made.poses_and_jacobian, [*each] * 9)):
            np.testing.assert_equal(found, expected[number % 2])


@needs_compiler
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
def test_names_and_memory(files: CFiles) -> None:
    """Only the documented names are global; mathematics alone is needed; no data can be written."""
    target = files.source.with_suffix(".o")
    compiled([COMPILER, *C99, "-fno-stack-protector", "-c", files.source, "-o", target])
    needed, defined = undefined_and_defined(target)
    assert needed <= {"sin", "cos", "sincos", "exp", "sqrt", "fmod", "atan2", "fabs", "memset", "memcpy", "memmove"}
    assert {name for name, kind in defined.items() if kind.isupper() and kind != "R"} == set(files.functions)
    assert files.functions == tuple(f"robot_{name}" for name in FUNCTIONS)
    assert [name for name, kind in defined.items() if kind in "bBdDcC"] == []


@needs_compiler
@pytest.mark.skipif(CPLUSPLUS is None, reason="no C++ compiler")
def test_the_files_are_cplusplus_too(files: CFiles, tmp_path: Path) -> None:
    compiled([CPLUSPLUS, "-std=c++11", *STRICT, "-x", "c++", "-c", files.source, "-o", tmp_path / "robot.o"])


@needs_compiler
def test_the_example_of_the_header(tmp_path: Path) -> None:
    files = write_c(model_of(CHAINS["arm"]), tmp_path / "robot.c")
    text = files.header.read_text()
    example = text[text.index(" * Example") : text.index(" */\n#ifndef")]
    lines = [line[7:] for line in example.splitlines() if line.startswith(" *     ")]
    (tmp_path / "main.c").write_text(MAIN.format(functions="\n".join(lines), body=CORRECTED))
    program = tmp_path / "main"
    compiled([COMPILER, *C99, "-o", program, tmp_path / "main.c", files.source, "-lm"])
    subprocess.run([program], check=True, timeout=60)


@pytest.mark.slow
@needs_compiler
def test_undefined_behaviour_and_addresses(files: CFiles, tmp_path: Path) -> None:
    main = """
    double q[3] = {0.1, 0.2, 0.3}, p[6], J[18], T[16], K[18];
    int step;
    for (step = 0; step < 100; ++step) {
        robot_markers(q, p, J), robot_tool_pose(q, T, K), T[3] += 1e-3;
        robot_newton_step(q, T, 0.1, 0.5, q);
        q[step % 3] += 40.0;
    }
    q[0] = q[0] / (q[0] - q[0]), robot_markers(q, p, J), robot_newton_step(q, T, 0.1, 0.5, q);
    """
    (tmp_path / "main.c").write_text(MAIN.format(functions="", body=main))
    program, sanitizers = tmp_path / "main", "-fsanitize=undefined,address"
    command = [COMPILER, *C99, "-g", sanitizers, "-fno-sanitize-recover=all", "-I", files.header.parent]
    linked = subprocess.run(
        [*command, "-o", program, tmp_path / "main.c", files.source, "-lm"], capture_output=True, text=True, check=False
    )
    if linked.returncode and "cannot find" in linked.stderr:
        pytest.skip("no sanitizers")
    assert linked.returncode == 0, linked.stderr[:3000]
    subprocess.run([program], check=True, timeout=120)


def test_numbers_come_back_bit_for_bit() -> None:
    bits = np.random.default_rng(0).integers(0, 2**63 - 1, 2000, dtype=np.int64)
    values = bits.view(np.float64)[np.isfinite(bits.view(np.float64))]
    values = np.concatenate([values, -values, [0.0, -0.0, 5e-324, 1.7976931348623157e308]])
    read = [float(word) for word in re.split(r"[\s,{}]+", array(values)) if word]
    np.testing.assert_array_equal(np.array(read).view(np.int64), values.view(np.int64))
    assert (number(float("inf")), number(float("-inf")), number(3)) == ("HUGE_VAL", "-HUGE_VAL", "3")


def test_the_header_tells_joints_limits_frame_and_tool(tmp_path: Path) -> None:
    model = model_of(CHAINS["slides"]).with_tool([0.0, 0.1, 0.2])
    limited = [replace(joint, lower=-1.5) if joint.name == "j1" else joint for joint in model.robot.joints]
    model.robot = dc.Chain("slides", model.robot.base, model.robot.tip, limited)
    files = write_c(model, tmp_path / "robot.c")
    text = files.header.read_text()
    for line in ("q[0]  j0 [m]: no limits", "q[1]  j1 [rad]: -1.5 to inf", "the robot's base", "0 1 0 0.1; 0 0 1 0.2"):
        assert line in text


@needs_compiler
def test_names_cannot_end_a_comment(tmp_path: Path) -> None:
    model = model_of(CHAINS["one joint"])
    joint = replace(model.robot.joints[0], name="j */ /* ??/\n\\ \u2603 /*/")
    model.robot = dc.Chain("*/ #error", model.robot.base, model.robot.tip, [joint])
    model.provenance = Provenance("2026-11-22T10:00:00+00:00", "0.1", "ab" * 32, 'serial */ 17\nof "two"')
    files = write_c(model, tmp_path / "my-robot 2.c")
    assert files.prefix == "my_robot_2"
    assert "fitted 2026-11-22" in files.header.read_text()
    compiled([COMPILER, *C99, "-c", files.source, "-o", tmp_path / "robot.o"])


@pytest.mark.parametrize(
    ("path", "options", "message"),
    [
        ("model.cpp", {}, "`path`: expected the name of a C file"),
        ("/", {}, "`path`: expected the name of a C file"),
        ("model.c", {"frame": "world"}, "`frame`: expected 'base' or 'measuring', got 'world'"),
        ("model.c", {"prefix": "a-b"}, "prefix of names in C"),
        ("7axes.c", {}, "pass `prefix`"),
        ("model.c", {"tool": [1.0, 2.0]}, "tool"),
        ("no/such/model.c", {}, "cannot be written"),
    ],
)
def test_refusals(path: str, options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        write_c(model_of(CHAINS["one joint"]), tmp_path / path, **options)
    assert list(tmp_path.iterdir()) == []


def test_models_without_constant_stages(tmp_path: Path) -> None:
    model = model_of(CHAINS["one joint"], dc.TorchDiffEq())
    with pytest.raises(InputError, match="cannot be written as C"):
        write_c(model, tmp_path / "model.c")


def test_files_of_other_origin_stay(tmp_path: Path) -> None:
    model, header = model_of(CHAINS["one joint"]), tmp_path / "model.h"
    header.write_text("/* mine */")
    with pytest.raises(InputError, match="was not generated"):
        write_c(model, tmp_path / "model.c")
    assert header.read_text() == "/* mine */"
    header.unlink()
    write_c(model, tmp_path / "model.c")
    write_c(model, tmp_path / "model.c")  # its own files are replaced
