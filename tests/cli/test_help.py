"""Help names every command, option and default, with its explanation."""

from __future__ import annotations

import pytest
from command_bank import Command

from diffeo_calib.cli.main import renamed

UNITS = "--length --angle --joint-length --joints --robot-pose --sep --decimal"
ROWS = (
    "--position --rotation --convention --rotation-angle --lever --camera-on-tool --std --rotation-std --socket "
    "--distance --distance-std --reading --session --remounted --payload --time --temperature --marker --places --by"
)
TEXTS = {
    "fit": (
        f"{ROWS} {UNITS} CSV --robot --base --tip --load --dh-convention -o --output --holdout --seed --controls "
        "--duplicates --figure --note --scales-of --report"
    ),
    "campaign": (
        f"{ROWS} {UNITS} CSV --robot --base --tip --load --dh-convention --tolerance --stdin --json-lines "
        "--once --candidates --page -n --count --accepted"
    ),
    "record": "BAG --seen -o --output --joints --still --shortest --offset",
    "evaluate": f"{ROWS} {UNITS} MODEL CSV --free -o --output --tolerance --residuals",
    "init": "CSV ROBOT --places --by -o --output --force",
    "images": "FOLDER JOINTS --board --length -o --output --board-std --report --sep --decimal",
    "predict": f"{UNITS} MODEL CSV --convention --rotation-angle --payload -o --output",
    "correct": (
        f"{UNITS} MODEL PROGRAM --position --rotation --convention --rotation-angle -o --output --tip --tool "
        "--tool-from --frame --limit --rate --payload"
    ),
    "export": (
        "MODEL --urdf --mjcf --dh --dh-convention --ur-kinematics --ur-hash --joint-offsets "
        "--correction-tables --with-tables --robot --length --angle --c --torch --onnx --camera --tool "
        "--tool-from --frame --payload --tip --field --grid"
    ),
    "plan": (
        f"{UNITS} MODEL --robot --base --tip --load --dh-convention --marker -n --count -o --output --free --seed "
        "--candidates --target-poses --measured --draw --range --tracker --floor --column --collisions "
        "--sensor --payload"
    ),
    "recalibrate": f"{ROWS} {UNITS} OLD OTHER -o --output --marker-freedom --drift --seed --note",
    "report": f"{ROWS} {UNITS} MODEL CSV -o --output --against --tolerance",
    "demo": "-o --output -n --count --seed",
}
OPTIONS = {name: [*text.split(), "--json"] for name, text in TEXTS.items()}


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
    ("former", "present"),
    [
        ("compare old new", "recalibrate old new"),
        ("-v correct --payload-mass 4 m p", "-v correct --payload 4 m p"),
        ("evaluate m t --fail-above=1mm --register -o x", "evaluate --free=both m t --tolerance=1mm -o x"),
        ("report --data t m -o p", "report m -o p t"),
        ("report --data=t m", "report m t"),
        ("demo --rows 20", "demo --count 20"),
        ("-h", "-h"),
    ],
)
def test_former_names_stand_for_present_ones(former: str, present: str) -> None:
    assert renamed(former.split()) == present.split()
    assert renamed(present.split()) == present.split()


def test_help_shows_units_defaults_ranges_and_what_is_required(command: Command) -> None:
    found = entries(command("fit", "--help").out)
    assert "required" not in found["--robot"]  # or --robot-pose
    assert "[required]" in found["CSV"]
    assert "required" not in found["--joints"]
    assert "default: 0.3" in found["--holdout"]
    assert "0.0<=x<=0.9" in found["--holdout"]
    assert "<m|mm|cm|inch>" in command("fit", "--help").out


def test_help_of_a_table_speaks_of_the_command_line(command: Command) -> None:
    """Though the words are those of the class in Python."""
    text = " ".join(command("fit", "--help").out.split())
    assert "Python" not in text.partition("Options:")[2]
    assert text.count("needed where no model knows it") == 2
    assert "hidden in that row. Repeatable." in text
    assert "in the unit of --length." in text
    assert "diffeo_calib.reports.results" in text
