"""Help names every command, option and default; it and completion load nothing slow. Cut pipes, full disks, Ctrl-C."""

import importlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from command_bank import PROGRAM, TABLE, Command, Outcome, Site, edited, environment, make_site, run_process, set_cell

import diffeo_calib as dc
from diffeo_calib.cli import console
from diffeo_calib.cli.console import plain
from diffeo_calib.cli.declarations import COMMANDS
from diffeo_calib.common.errors import few, listed, printable, sentence

OPTIONS = {name: ["--json"] for name in COMMANDS}
for command, own in COMMANDS.items():
    OPTIONS[command] += [word for one in own.all() for word in one.names or (one.shown,)]


def entries(text: str) -> dict[str, str]:
    """Name of every argument and option -> its explanation, from the two columns of a page of help."""
    found: dict[str, str] = {}
    names: list[str] = []
    _, heading, lines = text.partition("Arguments:\n" if "Arguments:" in text else "Options:\n")
    assert heading
    for line in lines.splitlines():
        if line.startswith("  ") and not line.startswith("   "):  # "  -o, --output MODEL   Model file to write."
            head, _, explanation = line.strip().partition("  ")
            words = [word.strip(",") for word in head.split()]
            names = [word for word in words if word.startswith("-")] or words[:1]
            found |= dict.fromkeys(names, explanation.strip())
        elif line.strip():
            found |= {name: f"{found[name]} {line.strip()}".strip() for name in names}
    return found


def test_the_program_s_help_names_every_command(command: Command) -> None:
    done = command.ran("--help")
    lines = [line.strip() for line in done.out.partition("Commands:")[2].splitlines() if line.strip()]
    assert [line.split()[0] for line in lines] == list(OPTIONS)
    assert all(line.endswith(".") and not line.endswith("...") for line in lines), "no sentence is cut off"
    options = entries(done.out.partition("Commands:")[0])
    for option in ("--version", "--install-completion", "--show-completion", "-h", "--help"):
        assert options[option]


@pytest.mark.parametrize("name", OPTIONS)
def test_help_explains_every_option(name: str, command: Command) -> None:
    done = command.ran(name, "--help")
    assert done.out == command(name, "-h").out
    found = entries(done.out)
    assert set(found) == {*OPTIONS[name], "-h", "--help"}
    assert all(len(found[option].split()) >= 3 for option in OPTIONS[name])


@pytest.mark.parametrize(
    ("former", "advice"),
    [
        ("compare old new", "compare is gone; write `recalibrate OLD OTHER` without -o."),
        ("-v correct --payload-mass 4 m p", "--payload-mass is gone; write --payload."),
        ("evaluate m t --fail-above=1mm", "--fail-above is gone; write --tolerance."),
        ("export m --ur-kinematics y --ur-hash h", "--ur-hash is gone; write --ur-kinematics over a copy"),
    ],
)
def test_former_names_say_what_to_do(former: str, advice: str, command: Command) -> None:
    assert advice in command(*former.split()).err


SLOW = ("torch", "numpy", "scipy", "lxml", "yourdfpy", "matplotlib", "pykeops", "safetensors", "llvmlite")
LIGHT = f"""
import atexit, sys
sys.argv[0] = "diffeo-calib"
atexit.register(lambda: print("loaded:", *(name for name in {SLOW} if name in sys.modules), file=sys.stderr))
from diffeo_calib.__main__ import main
main()
"""


COMPLETED = {
    "diffeo-calib ": [*COMMANDS],
    "diffeo-calib pre": ["predict"],
    "diffeo-calib fit --ro": ["--robot", "--robot-pose", "--rotation", "--rotation-angle", "--rotation-std"],
    "diffeo-calib fit --length ": ["m", "mm", "cm", "um", "inch"],
    "diffeo-calib --vers": ["--version"],
}


@pytest.mark.parametrize("words", ["--help", "--version", "fit --help", "demo -h", *COMPLETED])
def test_help_version_and_completion_load_nothing_slow(words: str) -> None:
    variables = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_DIFFEO_CALIB_COMPLETE": "complete_bash"}
    given = {"variables": variables} if words in COMPLETED else {}
    done = run_process(*words.split() * (not given), program=("-c", LIGHT), **given)
    assert (done.code, done.err.strip()) == (0, "loaded:")
    if given:
        assert done.out.split() == COMPLETED[words]
    else:
        assert ("Usage: diffeo-calib" if "-h" in words else f"diffeo-calib {dc.__version__}") in done.out


def test_the_module_and_the_console_script() -> None:
    done = run_process("-h", program=("-m", "diffeo_calib"))
    assert done.code == 0
    assert done.out.startswith("Usage: python -m diffeo_calib [OPTIONS] COMMAND")
    wrong = run_process("nonsense", program=("-m", "diffeo_calib"))
    assert wrong.code == 2
    project = Path(__file__).parents[2] / "pyproject.toml"
    found = re.search(r'^diffeo-calib = "(diffeo_calib\.[\w.]+):(\w+)"$', project.read_text("utf-8"), re.MULTILINE)
    assert found is not None
    assert callable(getattr(importlib.import_module(found[1]), found[2]))
    assert version("diffeo_calib") == dc.__version__


ESCAPE = "\x1b[31mred\x07"


def test_control_characters_are_escaped_everywhere() -> None:
    whole = sentence(ESCAPE, expected=ESCAPE, got=ESCAPE, fix=ESCAPE)
    for text in (whole, few([ESCAPE]), listed([ESCAPE]), plain(ESCAPE)):
        assert text.isprintable()
        assert "\\x1b" in text
    assert printable("a\u202eb\udcff\x00") == "a\\u202eb\\udcff\\x00"
    assert printable("Gelenk 1, \u03b1 \u95a2\u7bc0") == "Gelenk 1, \u03b1 \u95a2\u7bc0"
    assert plain("two\nlines") == "two\nlines"


@pytest.mark.parametrize("text", [ESCAPE, "x" * 100_000])
def test_control_characters_of_a_file(text: str, small_site: Site, command: Command, tmp_path: Path) -> None:
    bad = [edited(small_site, tmp_path / f"{row}.csv", set_cell(row, 2, text)) for row in (0, 3)]
    given: list[list[object]] = [small_site.fit(csv, tmp_path / "model") for csv in bad]
    given.append(small_site.fit(small_site.csv, tmp_path / "model", "--position", text))
    if text == ESCAPE:
        given.append(small_site.fit(tmp_path / f"{text}.csv", tmp_path / "model"))
    for words in given:
        done = command(*words)
        assert done.code == 1
        assert "\x1b" not in done.err + done.out
        assert len(done.error) < 1500
        assert "elbow_joint" in done.error or words not in given[:2]


def test_keywords_are_said_as_options_unless_as_those_of_Python(capsys: pytest.CaptureFixture[str]) -> None:
    console.show("error", "name the column `rotation_angle`: --marker smr (in Python `marker`), sep=';'")
    assert "column --rotation-angle: --marker smr (in Python `marker`), --sep ';'" in capsys.readouterr().err


NOWHERE = {"cut pipes": {1: "|", 2: "|"}, "a full disk": {1: "/dev/full"}, "nothing": {0: "", 1: "", 2: ""}}
PLACED = """
import json, os, resource, sys
streams, limit, *words = json.loads(sys.argv[1])
for number, place in ((int(number), place) for number, place in streams.items()):
    ends = os.pipe() if place == "|" else [os.open(place, os.O_RDWR)] if place else []
    os.dup2(ends[-1], number) if ends else os.close(number)
    [os.close(end) for end in ends]
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)) if limit else None
os.execv(sys.executable, [sys.executable, "-B", *words])
"""
"""A program with other streams, and files that hold at most so many bytes, as on a full disk."""


def run(arguments: Sequence[object], streams: Mapping[int, str], limit: int = 0) -> Outcome:
    """One command; ``streams``: number -> file, "" if it is closed, "|" for a pipe that nobody reads."""
    words = [streams, limit, "-c", PROGRAM, *map(str, arguments)]
    return run_process(program=("-c", PLACED, json.dumps(words)))


@pytest.mark.parametrize(("code", "arguments"), [(0, ["--help"]), (2, ["fit"]), (1, ["predict", "m", "c", "-o", "p"])])
def test_codes_do_not_depend_on_the_streams(code: int, arguments: list[str]) -> None:
    for streams in NOWHERE.values():
        done = run(arguments, streams)
        assert done.code == code, (streams, done)
        assert "Traceback" not in done.err
        assert "Exception" not in done.err


@pytest.fixture
def files(small_site: Site, sound: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which commands run, with a model and a table."""
    (tmp_path / "model").write_bytes(sound)
    (tmp_path / "t.csv").write_bytes(small_site.csv.read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["predict", "model", "t.csv", *TABLE[2:], "-o", "a.csv"], "cut pipes"),
        (["evaluate", "model", "t.csv", *TABLE, "--free", "both", "-o", "a.csv"], "a full disk"),
        (["export", "model", "--c", "a.c"], "nothing"),
    ],
)
def test_without_output(words: list[str], where: str, files: Path, command: Command) -> None:
    results = []
    for done in (lambda: command(*words), lambda: run(words, NOWHERE[where])):
        said = done()
        assert said.code == 0, said
        assert "Traceback" not in said.err
        written = sorted(files.glob("a.*"))
        results.append({path.name: path.read_bytes() for path in written})
        for path in written:
            path.unlink()
    assert results[0].keys() == results[1].keys() != set()
    assert "predict" not in words or results[0] == results[1]


@pytest.mark.slow
def test_old_files_stay_where_the_disk_is_full(files: Path) -> None:
    """All outputs are larger than 2000 bytes."""
    old = {f"a.{suffix}": b"an old file, generated by diffeo_calib" for suffix in ("c", "h")}
    for own, content in old.items():
        (files / own).write_bytes(content)
    done = run(["export", "model", "--c", "a.c"], {}, limit=2000)
    assert done.code == 1
    assert "cannot be written (File too large); free some space" in done.error
    assert {path.name: path.read_bytes() for path in files.glob("a.*")} == old


def test_ctrl_c_while_the_package_is_imported(site: Site, tmp_path: Path) -> None:
    """The program has begun, its imports have not ended: one sentence at once, no traceback."""
    program = "import diffeo_calib.__main__ as program; print('begun', flush=True); program.main()"
    command = [sys.executable, "-c", program, *map(str, site.fit(site.csv, tmp_path / "none.safetensors"))]
    options: dict[str, Any] = {"env": environment(), "encoding": "utf-8", "start_new_session": True}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert err == "error: interrupted before there was a result to keep.\n"


@pytest.mark.slow
def test_ctrl_c_writes_the_model(tmp_path: Path, command: Command) -> None:
    site, path, calibrate = make_site(tmp_path, rows=40), tmp_path / "cut.safetensors", dc.calibrate

    def interrupted(robot: Any, data: Any, *, progress: Any, **options: Any) -> Any:
        def step(task: str, done: int, total: int) -> None:
            if (task, done) == ("hyper-parameters", 3):
                os.kill(os.getpid(), signal.SIGINT)
            progress(task, done, total)

        return calibrate(robot, data, progress=step, **options)

    command.monkeypatch.setattr("diffeo_calib.cli.commands.fit.calibrate", interrupted)
    done = command(*site.fit(site.csv, path))
    assert done.code == 130, done.err
    assert "interrupted" in done.out
    assert "model: " in done.out
    model = dc.load(path)
    assert isinstance(model, dc.CalibratedKinematics)
    _, test = site.data.split(0.7, seed=0)
    calibrated, geometric = (done.numbers(stage, "12 held out")[0] for stage in ("calibrated", "geometric"))
    assert calibrated == pytest.approx(1e3 * dc.evaluate(model, test).rms, abs=1.01e-4)
    assert calibrated < geometric
