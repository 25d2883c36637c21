"""Ctrl-C at any moment: one sentence, and the best model so far if there is one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from command_bank import Command, Outcome, Site, environment, make_site

import diffeo_calib as dc
from diffeo_calib.cli.console import Interrupts
from diffeo_calib.cli.record import record


def test_ctrl_c_before_there_is_a_model_is_exit_130(site: Site, command: Command, tmp_path: Path) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    command.monkeypatch.setattr("diffeo_calib.cli.commands.fit.calibrate", interrupted)
    done = command(*site.fit(site.csv, tmp_path / "none.safetensors"))
    assert done.code == 130
    assert not (tmp_path / "none.safetensors").exists()
    assert "interrupted" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize("seconds", [0.1, 0.6])
def test_ctrl_c_while_the_package_is_imported(seconds: float, site: Site, tmp_path: Path) -> None:
    """The program has begun, its imports have not ended: one sentence at once, no traceback."""
    program = "import diffeo_calib.__main__ as program; print('begun', flush=True); program.main()"
    command = [sys.executable, "-c", program, *map(str, site.fit(site.csv, tmp_path / "none.safetensors"))]
    options: dict[str, Any] = {"env": environment(), "encoding": "utf-8", "start_new_session": True}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        time.sleep(seconds)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert err == "error: interrupted before there was a result to keep.\n"


def test_ctrl_c_is_raised_once_and_only_where_there_is_a_state_to_keep(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, and the second time, the process ends."""
    ended: list[str] = []
    monkeypatch.setattr("diffeo_calib.cli.console.end_process", ended.append)
    before = signal.getsignal(signal.SIGINT)
    interrupts, seen, notes = Interrupts(), [], []
    interrupts.install()
    try:
        progress = interrupts.watching(lambda *given: seen.append(given), notes.append)
        progress("geometry", 0, 1)
        signal.raise_signal(signal.SIGINT)
        assert ended == ["interrupted before there was a result to keep"]
        interrupts.install()
        progress("hyper-parameters", 1, 40)
        signal.raise_signal(signal.SIGINT)
        assert len(ended) == 1
        with pytest.raises(KeyboardInterrupt):
            progress("hyper-parameters", 2, 40)
        progress("Gauss-Newton", 0, 30)
        signal.raise_signal(signal.SIGINT)
        assert ended[1:] == ["interrupted again, stopped at once"]
        Interrupts().install()
        record.add(files={"program": "corrected.csv"})
        signal.raise_signal(signal.SIGINT)
        assert ended[2:] == ["interrupted; written: corrected.csv"]
    finally:
        signal.signal(signal.SIGINT, before)
        record.add(files={})
    assert interrupts.asked
    assert notes[0].startswith("interrupted: finishing with the best state so far")
    assert len(seen) == 4


INTERRUPTIBLE = """
import os, signal, sys
from diffeo_calib.__main__ import main
from diffeo_calib.cli.commands import fit

calibrate, moment = fit.calibrate, sys.argv.pop(1)

def reporting(robot, data, *, progress, **options):
    def step(task, done, total):
        if f"{task} {done}" == moment:  # sent from outside, it could come after the last step
            print(moment, flush=True)
            os.kill(os.getpid(), signal.SIGINT)
        progress(task, done, total)
    return calibrate(robot, data, progress=step, **options)

fit.calibrate = reporting
main()
"""


@pytest.mark.slow
def test_ctrl_c_in_a_real_process_writes_the_model(tmp_path: Path) -> None:
    moment, site, path = "hyper-parameters 3", make_site(tmp_path, rows=40), tmp_path / "cut.safetensors"
    process = subprocess.run(
        [sys.executable, "-c", INTERRUPTIBLE, moment, *map(str, site.fit(site.csv, path))],
        capture_output=True,
        env=environment(),
        encoding="utf-8",
        timeout=240,
        start_new_session=True,
        check=False,
    )
    out, err = process.stdout, process.stderr
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert moment in out
    assert "interrupted" in out
    assert "model: " in out
    model = dc.load(path)
    assert isinstance(model, dc.CalibratedKinematics)
    _, test = site.data.split(0.7, seed=0)
    done = Outcome(130, out, err)
    assert done.numbers("calibrated", "12 held out")[0] == pytest.approx(
        1e3 * dc.evaluate(model, test).rms, abs=1.01e-4
    )
    assert done.numbers("calibrated", "12 held out")[0] < done.numbers("geometric", "12 held out")[0]
