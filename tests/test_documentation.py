"""Commands and snippets of README and site run, on files of the names that they use; links lead somewhere."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command_bank import Command
from documentation_bank import commands, shown_outputs, words, write_tables
from product_bank import with_usual_scales
from typer import Context
from typer.main import get_command

from diffeo_calib.cli.main import app

ROOT = Path(__file__).parents[1]
README, PAGES = ROOT / "README.md", ROOT / "scripts/docs/pages"
TEXTS = [README, *(PAGES / name for name in re.findall(r"[\w/]+\.md", (ROOT / "scripts/docs/mkdocs.yml").read_text()))]
"""In the order of the site; pages that it makes itself are no files."""
MOST_LINES = 130
ELSEWHERE = "camera.md", "live.md", "makers.md"
"""Pages whose commands examples, tests/campaign and tests/cli/test_column_names.py run; here options are checked."""


def texts() -> dict[Path, str]:
    return {path: path.read_text(encoding="utf-8") for path in TEXTS if path.is_file()}


def snippets(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("documentation")
    write_tables(place, rows=50)
    return place


def test_the_readme_is_a_front_door_and_links_lead_somewhere() -> None:
    text = README.read_text(encoding="utf-8")
    assert text.count("\n") <= MOST_LINES
    assert len(snippets(text)) == 2
    assert len(commands(text)) == 4
    assert {path for path in TEXTS if path.is_file()} == {README, *PAGES.rglob("*.md")}
    made, benchmarks = {"commands.md", "benchmarks.md"}, (ROOT / "benchmarks/README.md").read_text(encoding="utf-8")
    headings = {re.sub(r"[^\w -]", "", line).strip().lower().replace(" ", "-") for line in benchmarks.splitlines()}
    for path, text in texts().items():
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
            assert (path.parent / target).is_file() or Path(target).name in made, (path.name, target)
        for target in re.findall(r"(?<![\w/(])((?:scripts|benchmarks|tests|diffeo_calib)/[\w./]+\w)", text):
            assert (ROOT / target).exists(), (path.name, target)
        assert headings.issuperset(re.findall(r"benchmarks/README\.md#([\w-]+)\)", text)), path.name


@pytest.mark.parametrize("name", ELSEWHERE)
def test_options_of_pages_that_run_elsewhere_are_known(name: str) -> None:
    (text,) = (text for path, text in texts().items() if path.name == name)
    assert commands(text)
    known: Any = get_command(app)
    for line in commands(text):
        _, verb, *words = shlex.split(line)
        command = known.commands[verb]
        command.make_parser(Context(command)).parse_args(words)


@pytest.mark.slow
def test_snippets_run_one_after_the_other(folder: Path) -> None:
    code = "\n".join(dict.fromkeys(snippet for text in texts().values() for snippet in snippets(text)))
    words, env = [sys.executable, "-W", "error", "-c", code], {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300, env=env, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("converged") >= 2


@pytest.mark.filterwarnings("ignore:the place of the marker on 'tool0' along")  # the tool's x axis is always vertical
@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_commands_run_one_after_the_other(folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the accuracy of the UR10 is what the text says; scales of simulated robots are given."""
    monkeypatch.chdir(folder)
    whole = [line for path, text in texts().items() if path.name not in ELSEWHERE for line in commands(text)]
    accuracy = r"632 poses; ([0-9.]+) mm RMS on the held-out rows of this split, geometry ([0-9.]+)"
    found = re.search(accuracy, "".join(texts().values()))
    assert found is not None
    shown = {line: output for text in texts().values() for line, output in shown_outputs(text).items()}
    assert len(shown) >= 12
    ran = 0
    for line in dict.fromkeys(whole):
        program, *arguments = shlex.split(line)
        assert program == "diffeo-calib"
        real = any(word.startswith("data/") for word in arguments)
        if real and not (folder / "data").is_dir():
            continue
        with monkeypatch.context() as patch:
            if not real:
                patch.setattr("diffeo_calib.cli.commands.fit.calibrate", with_usual_scales)
            done = command(*arguments)
        assert done.code == 0, (line, done.err)
        printed = {words(each) for each in f"{done.out}\n{done.err}".splitlines()}
        assert not [each for each in shown.get(line, []) if words(each) not in printed], line
        if real:
            rms = [done.numbers(stage, "190 held out")[0] for stage in ("calibrated", "geometric")]
            assert [f"{value:.3f}" for value in rms] == [found[1], found[2]]
        ran += 1
    assert ran >= 18
