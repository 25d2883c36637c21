"""Help names every command, option and default, with its explanation."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_bank import Command

from diffeo_calib.cli.declarations import COMMANDS

OPTIONS = {
    name: ["--json", *(word for one in options.all() for word in one.names or (one.shown,))]
    for name, options in COMMANDS.items()
}


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
    done = command("--help")
    assert done.code == 0
    lines = [line.strip() for line in done.out.partition("Commands:")[2].splitlines() if line.strip()]
    assert [line.split()[0] for line in lines] == list(OPTIONS)
    assert all(line.endswith(".") and not line.endswith("...") for line in lines), "no sentence is cut off"
    options = entries(done.out.partition("Commands:")[0])
    for option in ("--version", "--install-completion", "--show-completion", "-h", "--help"):
        assert options[option]


@pytest.mark.parametrize("name", OPTIONS)
def test_help_explains_every_option(name: str, command: Command) -> None:
    done = command(name, "--help")
    assert done.code == 0
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


def test_a_campaign_file_with_a_former_name_says_what_to_do(tmp_path: Path, command: Command) -> None:
    (tmp_path / "c.toml").write_text('csv = "t.csv"\npayload_mass = 3\n')
    assert "--payload-mass is gone; write --payload." in command("fit", tmp_path / "c.toml").err


def test_help_shows_units_defaults_ranges_and_what_is_required(command: Command) -> None:
    """In words of the command line, though those of tables are of the class in Python."""
    page = command("fit", "--help").out
    found, text = entries(page), " ".join(page.split())
    assert "required" not in found["--robot"] + found["--joints"]  # or --robot-pose
    assert "[required]" in found["CSV"]
    assert "default: 0.3" in found["--holdout"]
    assert "0.0<=x<=0.9" in found["--holdout"]
    assert "<m|mm|cm|inch>" in page
    assert "Python" not in text.partition("Options:")[2]
    assert text.count("needed where no model knows it") == 2
    assert "all are in the plane of x and y. Repeatable." in text
    assert "in the unit of --length." in text
    assert "diffeo_calib.reports.results" in text
