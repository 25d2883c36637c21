"""Functions in place of a robot: `--robot-pose A,B,...=FILE.py:NAME`."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
import torch
from command_bank import Command
from commanded_bank import cells, drawn, write_columns
from documentation_bank import write_commanded_tables
from numbers_bank import rigid_rms
from torch.testing import assert_close

from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv import columns as joints
from diffeo_calib.measurements.csv.columns import PoseColumns

MEASURED = ["--position", "x,y,z", "--length", "mm", "--angle", "deg"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"'own.py' cannot be read \(No such file or directory\)"),
        ("1 +", "'own.py' does not run: got SyntaxError"),
        ("f = 1 / 0", "'own.py' does not run: got ZeroDivisionError"),
        ("import sys; sys.exit()", "'own.py' does not run: got SystemExit"),
        ("def f(q): raise SystemExit", "own.py:f of 5 rows: got SystemExit"),
        (
            "from __future__ import annotations; import dataclasses, other; f = other.f\n"
            "@dataclasses.dataclass\nclass A: a: int\n",
            r"returns: expected places \(5, k\).* got \(4, 2\)",
        ),
        ("f = None", "the file 'own.py': expected a function f"),
        ("def f(q): return q @ q", "own.py:f of 5 rows: got RuntimeError"),
        ("def f(q): return q[:, :1].expand(-1, 4)", r"returns: expected places \(5, k\).* got \(5, 4\)"),
        ("def f(q): return q[:4]", r"returns: expected places \(5, k\).* got \(4, 2\)"),
        ("def f(q): return 1.0", r"returns: expected places \(5, k\).* got \(\)"),
        ("def f(q): return (q - q[2:3]).log()", "of row .*2.*: expected finite numbers"),
        *((f"def f(q): return q{how}", "of a row: expected always the same") for how in (" - q.mean(0)", ".cumsum(0)")),
    ],
)
def test_refused_functions(text: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    joints._names.cache_clear()
    if text is not None:
        (tmp_path / "own.py").write_text(text, encoding="utf-8")
        (tmp_path / "other.py").write_text("def f(q): return q[:4]", encoding="utf-8")
    with pytest.raises(MeasurementError, match=message):
        PoseColumns.of("a,b=own.py:f").poses(drawn(5, 2, seed=0))


@pytest.mark.usefixtures("given_scales")
def test_a_function_in_place_of_a_robot(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which a campaign file names beside it; a model file starts no program."""
    monkeypatch.chdir(tmp_path)
    write_commanded_tables(tmp_path)
    pose, model = ["--robot-pose", "q1,q2,q3=my_delta.py:kinematics"], "m.safetensors"
    entries = {"csv": "delta.csv", "robot-pose": pose[1], "position": "x,y,z", "length": "mm", "angle": "deg"}
    Path("c.toml").write_text("\n".join(f'{name} = "{value}"' for name, value in entries.items()), encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path / "elsewhere")
        done = command("fit", tmp_path / "c.toml", "-o", tmp_path / model)
    assert done.code == 0, done.error
    done = command("evaluate", model, "delta.csv")
    assert done.code == 1
    assert "type it again, a model file starts no program: --robot-pose q1,q2,q3=" in done.error
    done = command.ran("predict", model, "delta.csv", *pose, "-o", "p.csv")
    text = Path("my_delta.py").read_text(encoding="utf-8")
    for written, options, away in (("300.5 *", [], r"0\.\d+ mm"), ("300 *", ["--length", "m"], r".e\+05 mm")):
        joints._names.cache_clear()
        Path("my_delta.py").write_text(text.replace("300 *", written), encoding="utf-8")
        done = command("evaluate", model, "delta.csv", *pose, *options)
        assert re.search("py:kinematics: expected the function that the model was fitted with, .*" + away, done.error)
    Path("metres.py").write_text(f"{text.replace('return elbows', 'return 1e-3 * (elbows')})", encoding="utf-8")
    done = command("fit", "delta.csv", *pose[:1], pose[1].replace("my_delta", "metres"), *MEASURED, "-o", "w")
    assert "1000 times too large: check their unit (--length), and that of the commanded ones" in done.error
    done = command("predict", model, "delta.csv", "--robot-pose", "q1,q2,q3", "-o", "q.csv")
    assert "type it again, a model file starts no program" in done.error  # joint values are no places
    (header, *rows), (_, *measured) = cells(Path("p.csv")), cells(Path("delta.csv"))
    assert header[:6] == ["x", "y", "z", "predicted_x", "predicted_y", "predicted_z"]
    found = torch.tensor([[float(cell) for cell in row[:6]] for row in rows], dtype=torch.float64)
    q = torch.tensor([[float(cell) for cell in row[:3]] for row in measured], dtype=torch.float64)
    kinematics = runpy.run_path("my_delta.py")["kinematics"]
    nominal, exact = kinematics(q), 1.001 * kinematics(q + torch.tensor([0.1, -0.05, 0.08]))  # without noise
    assert_close(found[:, :3], nominal, rtol=0, atol=1e-6)
    assert float((found[:, 3:] - exact).norm(dim=1).mean()) < 0.2 * rigid_rms(nominal, exact)
    command.ran("plan", model, "-n", "3", *pose, "-o", "n.csv")
    assert cells(Path("n.csv"))[0] == ["x", "y", "z", "rank"]
    done = command.ran("correct", model, "targets.csv", *pose, "-o", "c.csv")
    header, *rows = cells(Path("c.csv"))
    assert {row[header.index("status")] for row in rows} == {"reached"}
    corrected = [[float(row[header.index(axis)]) for axis in "xyz"] for row in rows]
    assert "q1" not in header  # of the program before
    again = write_columns(Path("again.csv"), x_y_z=torch.tensor(corrected, dtype=torch.float64))
    command.ran("predict", model, again, "--robot-pose", "x,y,z", *MEASURED[2:], "-o", "a.csv")
    reached = [[float(cell) for cell in row[3:6]] for row in cells(Path("a.csv"))[1:]]
    wanted = nominal[:5] - nominal[:5].mean(0)
    assert rigid_rms(wanted, torch.tensor(reached, dtype=torch.float64)) < 0.05  # of the frame of the device
