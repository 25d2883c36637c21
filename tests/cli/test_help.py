"""Help names every command, option and default, with its explanation; it and completion load nothing slow."""

import importlib
import re
from importlib.metadata import version
from pathlib import Path

import pytest
from command_bank import Command, Site, edited, run_process, set_cell

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


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["fit", "--help"], ["demo", "-h"]], ids=" ".join)
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
