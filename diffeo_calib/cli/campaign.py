"""A campaign file: the options of `fit` in a TOML file beside the table, so that they are written once.

    csv = "measurements.csv"            robot = "robot.urdf"
    base = "base_link"                  tip = "flange"
    position = ["x,y,z"]                length = "mm"
    angle = "deg"                       output = "robot.safetensors"

`diffeo-calib fit campaign.toml` runs as if the options had been typed. Options that are typed as well win,
also those that may be repeated, such as `--tip`. Paths are relative to the folder of the file.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

from diffeo_calib.cli.options import CORNERS
from diffeo_calib.common.errors import InputError, as_written

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

SUFFIX = ".toml"
COMMAND, LIVE = "fit", "campaign"
JOINED = ("rotation-std",)
"""Entries that may be lists of columns although the option can be repeated."""
LONGEST_FILE = 1 << 20
"""Bytes: a file of options is short."""


Known = Mapping[str, Mapping[str, Any]]
"""Command -> name of an option, without dashes, or of an argument -> type of its value."""


def expanded(arguments: Sequence[str], known: Known) -> list[str]:
    """The same command line with a campaign file written out, for `campaign` without what only `fit` knows."""
    words = list(arguments)
    at = next((place for place, word in enumerate(words) if not word.startswith("-")), 0)
    if len(words) < at + 2 or words[at] not in (COMMAND, LIVE) or not words[at + 1].lower().endswith(SUFFIX):
        return words
    path = Path(words[at + 1])
    options = known[words[at]]
    entries = {name: value for name, value in _read(path).items() if name in options or name not in known[COMMAND]}
    unknown = [name for name in entries if name not in options]
    if unknown:
        expected = f"options of `{words[at]}`: {', '.join(options)}"
        raise InputError.of(f"{path}: {', '.join(unknown)}", expected=expected, fix="correct the names")
    if "csv" not in entries:
        raise InputError.of(f"{path} has no entry csv", fix='add csv = "measurements.csv", the table to calibrate with')
    typed = {word.removeprefix("--").partition("=")[0] for word in words[at + 2 :] if word.startswith("--")}
    table = _text(path, "csv", entries.pop("csv"), options["csv"])
    kept = {name: value for name, value in entries.items() if name not in typed}
    written = [word for name, value in kept.items() for word in _words(path, name, value, options[name])]
    return [*words[: at + 1], table, *written, *words[at + 2 :]]


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > LONGEST_FILE:
            raise InputError.of(f"{path}", expected="a file of options", got="more than 1 MiB")
        entries = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return {name.replace("_", "-"): value for name, value in entries.items()}
    except OSError as error:
        raise InputError.of(f"{path} cannot be read ({error.strerror})", fix="check the path") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError.of(
            f"{path} is no TOML", got=str(error), fix='write one option per line: length = "mm"'
        ) from error


def _words(path: Path, name: str, value: object, hint: Any) -> list[str]:
    """One entry as words of a command line."""
    if isinstance(value, bool):
        return [f"--{name}"] * value
    values = value if isinstance(value, list) else [value]
    if isinstance(value, list) and (name in JOINED or not has(hint, list)):
        values = [",".join(map(str, value))]
    return [word for one in values for word in (f"--{name}", _text(path, name, one, hint))]


def _text(path: Path, name: str, value: object, hint: Any) -> str:
    """A value as a word; files relative to the folder of the campaign."""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise InputError.of(f"{path}: {name}", expected="text or a number", got=as_written(value))
    begin = CORNERS if str(value).startswith(CORNERS) and str(value).endswith(".yaml") else ""
    file = str(value).removeprefix(begin)
    return f"{begin}{path.parent / file}" if begin or has(hint, Path) else file


def has(hint: Any, part: type) -> bool:
    """Whether a type, or a part of it, is this one."""
    return part in {hint, get_origin(hint)} or any(has(one, part) for one in get_args(hint))
