"""A campaign file: the options of `fit` in a TOML file beside the table, so that they are written once.

    csv = "measurements.csv"            robot = "robot.urdf"
    base = "base_link"                  tip = "flange"
    position = ["x,y,z"]                length = "mm"
    angle = "deg"                       output = "robot.safetensors"

`diffeo-calib fit campaign.toml` runs as if the options had been typed; options that are typed as well come last and
win. Paths are relative to the folder of the file.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from diffeo_calib.common.errors import InputError, as_written

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

SUFFIX = ".toml"
COMMAND = "fit"
PATHS = ("csv", "robot", "output", "figure", "report", "json")
"""Entries that name files."""
REPEATED = ("position", "tip", "load", "distance")
"""Entries that may be lists: one option for each value."""
LONGEST_FILE = 1 << 20
"""Bytes: a file of options is short."""


def expanded(arguments: Sequence[str], known: Sequence[str]) -> list[str]:
    """The same command line with a campaign file written out; unchanged without one.

    Args:
        arguments: of the program. known: names of the options of `fit`, without dashes.

    Raises:
        InputError: the file cannot be read, is no TOML, or has an entry that is no option.
    """
    words = list(arguments)
    at = next((place for place, word in enumerate(words) if not word.startswith("-")), 0)
    if len(words) < at + 2 or words[at] != COMMAND or not words[at + 1].lower().endswith(SUFFIX):
        return words
    path = Path(words[at + 1])
    entries = _read(path)
    names = [name.replace("_", "-") for name in entries]
    unknown = [name for name in names if name not in (*known, "csv")]
    if unknown:
        expected = f"options of `fit`: csv, {', '.join(known)}"
        raise InputError.of(f"{path}: {', '.join(unknown)}", expected=expected, fix="correct the names")
    if "csv" not in names:
        raise InputError.of(f"{path} has no entry csv", fix='add csv = "measurements.csv", the table to calibrate with')
    options = [word for name, value in zip(names, entries.values(), strict=True) for word in _words(path, name, value)]
    return [*words[: at + 1], _text(path, "csv", entries["csv"]), *options, *words[at + 2 :]]


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > LONGEST_FILE:
            raise InputError.of(f"{path}", expected="a file of options", got="more than 1 MiB")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError.of(f"{path} cannot be read ({error.strerror})", fix="check the path") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError.of(
            f"{path} is no TOML", got=str(error), fix='write one option per line: length = "mm"'
        ) from error


def _words(path: Path, name: str, value: object) -> list[str]:
    """One entry as words of a command line."""
    if name == "csv":
        return []
    option = "--" + name
    if isinstance(value, bool):
        return [option] if value else []
    values = value if isinstance(value, list) else [value]
    if name not in REPEATED and isinstance(value, list):
        values = [",".join(map(str, value))]
    return [word for one in values for word in (option, _text(path, name, one))]


def _text(path: Path, name: str, value: object) -> str:
    """A value as a word; files relative to the folder of the campaign."""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise InputError.of(f"{path}: {name}", expected="text or a number", got=as_written(value))
    return str(path.parent / str(value)) if name in PATHS else str(value)
