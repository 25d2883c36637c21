"""Checks of the files that a command writes. They run before the work starts, and import nothing slow."""

from __future__ import annotations

import os
from pathlib import Path

from diffeo_calib.cli.record import record
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import IMAGE_SUFFIXES, check_writable


def check_outputs(outputs: dict[str, Path | None], inputs: dict[str, Path]) -> None:
    """Refuse files that cannot be written, that are also read, or that are named twice, and unknown kinds of images.

    --json is one of the files.

    Args:
        outputs: option -> file to write, None if not wanted. inputs: name of an argument -> file that is read.

    Raises:
        InputError: with the option and its file.
    """
    wanted, record.path = record.path, None  # nothing is written there before the place has been checked
    named = {option: path for option, path in outputs.items() if path is not None}
    _check("--json", wanted, inputs | named)
    record.path = wanted
    taken = dict(inputs)
    for option, path in named.items():
        _check(option, path, taken)
        taken[option] = path
    check_figure(outputs.get("--figure"))


def _check(option: str, path: Path | None, taken: dict[str, Path]) -> None:
    """Refuse one file, if it is wanted."""
    if path is None:
        return
    try:
        _check_place(option, path)
        _check_apart(option, path, taken)
    except OSError as error:
        what = f"{option} {path} cannot be written ({error.strerror})"
        raise InputError.of(what, fix="name another file") from error
    check_writable(path)


def check_figure(figure: Path | None) -> Path | None:
    """The file of a figure; InputError for an unknown format of images."""
    if figure is not None and figure.suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError.of(f"--figure {figure}", expected=f"a name ending in {', '.join(IMAGE_SUFFIXES)}")
    return figure


def make_folder(folder: Path) -> None:
    """Make a folder unless it exists; InputError if that is not possible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"the folder {folder} cannot be made ({error.strerror})"
        raise InputError.of(what, fix="name another folder") from error


def _check_place(option: str, path: Path) -> None:
    if path.is_dir():
        expected, fix = "the name of a file", "add a name to it"
        raise InputError.of(f"{option} {path} is a folder", expected=expected, fix=fix)
    if not path.parent.is_dir():
        what = f"{option} {path} cannot be written, there is no folder {path.parent}"
        raise InputError.of(what, fix="make it first, or name a file in another folder")
    if path.exists() and not os.access(path, os.W_OK):
        what = f"{option} {path} cannot be written: permission denied"
        raise InputError.of(what, fix="name a file in a folder that you may write to")


def _check_apart(option: str, path: Path, taken: dict[str, Path]) -> None:
    for name, other in taken.items():
        same = path.exists() and other.exists() and path.samefile(other)
        if same or os.path.realpath(path) == os.path.realpath(other):
            raise InputError.of(f"{option} {path} is the file of {name}", fix="name another file")
