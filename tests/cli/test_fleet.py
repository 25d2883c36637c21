"""Many campaigns with one command: each in its own process, output in one piece, failures counted, Ctrl-C for all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_bank import Command, Site, edited, environment, rows_of

import diffeo_calib as dc
from diffeo_calib.cli import campaign as fleet
from diffeo_calib.cli.app import DECLARED as KNOWN
from diffeo_calib.cli.campaign import Fleet, asked
from diffeo_calib.common.errors import InputError


def campaign(folder: Path, name: str, text: str = 'csv = "a.csv"\n') -> str:
    path = folder / f"{name}.toml"
    path.write_text(text + f'output = "{name}.safetensors"\n', encoding="utf-8")
    return str(path)


def test_campaigns_and_options_are_told_apart(tmp_path: Path) -> None:
    a, b = campaign(tmp_path, "a"), campaign(tmp_path, "b")
    assert asked(["fit", a, b, "--jobs", "2", "--holdout", "0"], KNOWN) == Fleet([a, b], ["--holdout", "0"], 2)
    assert asked(["fit", "--jobs=3", a], KNOWN) == Fleet([a], [], 3)
    assert asked(["fit", a, b], KNOWN) == Fleet([a, b], [], 1)


@pytest.mark.parametrize("words", [[], ["fit"], ["fit", "a.csv"], ["fit", "a.toml"], ["evaluate", "a.toml", "b.toml"]])
def test_other_command_lines_stay(words: list[str]) -> None:
    assert asked(words, KNOWN) is None


@pytest.mark.parametrize("words", [["--jobs"], ["--jobs", "0"], ["--jobs", "many"], ["--jobs=-1"], ["--jobs="]])
def test_jobs_are_counted(words: list[str], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--jobs: expected how many"):
        asked(["fit", campaign(tmp_path, "a"), *words], KNOWN)


def test_mistakes_are_found_before_anything_runs(tmp_path: Path) -> None:
    a, b = campaign(tmp_path, "a"), campaign(tmp_path, "b", 'lenght = "mm"\n')
    with pytest.raises(InputError, match="lenght"):
        asked(["fit", a, b], KNOWN)
    with pytest.raises(InputError, match="toml"):
        asked(["fit", "a.csv", "--jobs", "2"], KNOWN)
    for option in ("-o", "--json", "--figure=x.png"):
        with pytest.raises(InputError, match="one file for all campaigns"):
            asked(["fit", a, campaign(tmp_path, "c"), option, "x"], KNOWN)
    (tmp_path / "d.toml").write_text('csv = "d.csv"\noutput = "a.safetensors"\n')
    with pytest.raises(InputError, match=r"a\.toml and .*d\.toml write the same model, a\.safetensors"):
        asked(["fit", a, str(tmp_path / "d.toml")], KNOWN)


# --- Processes ---------------------------------------------------------------------------------------------------


def sites(site: Site, folder: Path, names: str) -> list[str]:
    """Campaigns with the same table and other models, and one whose table does not exist."""
    few = edited(site, folder / "few.csv", rows_of(*range(11)))  # a quick fit
    words = [str(word) for word in site.fit(few, Path("x.safetensors"))]
    entries = {words[k].lstrip("-"): words[k + 1] for k in range(2, len(words) - 1) if words[k].startswith("--")}
    entries |= {"csv": str(few)}
    found = []
    for name in names:
        own = entries | ({"csv": "nowhere.csv"} if name == "x" else {})
        text = "".join(
            f'{key} = ["{value}"]\n' if key == "position" else f'{key} = "{value}"\n'
            for key, value in own.items()
            if key != "output"
        )
        found.append(campaign(folder, name, text))
    return found


@pytest.mark.slow
def test_each_runs_alone_and_failures_are_counted(site: Site, tmp_path: Path) -> None:
    words = ["fit", *sites(site, tmp_path, "axb"), "--jobs", "2", "--holdout", "0"]
    done = subprocess.run(
        [sys.executable, "-m", "diffeo_calib", *words],
        env=environment(), capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stdout + done.stderr
    assert "2 of 3 campaigns done; failed: " in done.stdout
    blocks = done.stdout.split("== ")[1:]
    heads = {Path(block.partition(":")[0]).stem: block for block in blocks}
    assert set(heads) == set("axb")
    assert "exit code 1" in heads["x"].splitlines()[0]
    assert "nowhere.csv" in heads["x"]
    for name in "ab":
        assert ": done, " in heads[name].splitlines()[0]
        assert f"{name}.safetensors" in heads[name]
        assert not any(f"{other}.safetensors" in heads[name] for other in "abx" if other != name)
        assert isinstance(dc.load(tmp_path / f"{name}.safetensors"), dc.CalibratedKinematics)


@pytest.mark.slow
def test_ctrl_c_reaches_all(site: Site, tmp_path: Path) -> None:
    words = ["fit", *sites(site, tmp_path, "abc"), "--jobs", "2"]
    options = {"env": environment(), "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-m", "diffeo_calib", *words], start_new_session=True, **options) as process:
        time.sleep(3.0)
        os.kill(process.pid, signal.SIGINT)
        time.sleep(0.5)
        if process.poll() is None:
            os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130, out + err
    assert "interrupted" in err
    assert not (tmp_path / "c.safetensors").exists()


def test_exit_codes_count(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command) -> None:
    """With a program that fails in place of the calibration."""
    monkeypatch.setattr(fleet, "LOOK_SECONDS", 0.001)
    monkeypatch.setattr(fleet, "COMMAND", "no-such-command")
    code = fleet.run(Fleet([campaign(tmp_path, "a"), campaign(tmp_path, "b")], [], 2))
    assert code == 2
    monkeypatch.setattr(fleet, "MOST_FAILED", 1)
    assert fleet.run(Fleet([campaign(tmp_path, "a"), campaign(tmp_path, "b")], [], 1)) == 1
