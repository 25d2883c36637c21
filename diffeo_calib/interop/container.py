"""The container of model files: arrays by name in safetensors, a JSON header, a checksum. Needs NumPy alone.

A SHA-256 checksum over header and arrays detects damaged and edited files. Reading executes nothing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from diffeo_calib.common.errors import ModelFileError

FORMAT = 3
"""Version of the file layout; files of other versions are refused."""
ENTRY = "diffeo_calib"
"""Key of the header in the file's metadata."""

UNSOUND = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""Raised by contents that do not fit together: a forged header can hold any value in any place."""

Header = dict[str, Any]


def read_arrays(path: Path) -> tuple[Header, dict[str, np.ndarray]]:
    """Header and arrays of a file; ModelFileError: it cannot be read, or has another format or a wrong checksum."""
    if not path.is_file():
        raise ModelFileError.of(f"there is no model file {path}", fix="check the path")
    unreadable, written = f"{path} cannot be read as a model file", "pass a file written by `save` or `fit -o`"
    try:
        with path.open("rb") as file:
            beginning = file.read(9)  # eight bytes of length, then a JSON header
    except OSError as error:
        raise ModelFileError.of(f"{unreadable} ({error.strerror})", fix="pass the name of a readable file") from error
    if len(beginning) == 9 and beginning[8:] != b"{":  # what is cut short has its own sentence
        kind = "a URDF" if path.suffix.lower() in (".urdf", ".xml", ".xacro") else "another kind of file"
        raise ModelFileError.of(f"{unreadable}: it is {kind}", fix=written)
    try:
        with safe_open(path, framework="np") as file:
            text = (file.metadata() or {}).get(ENTRY)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # not a dict
        header = json.loads(text) if text is not None else None
        sealed = isinstance(header, dict) and header.pop("digest", None) == digest(header, arrays)
    except (SafetensorError, OSError, *UNSOUND) as error:
        fix = "it is damaged or cut short: copy or save it again"
        raise ModelFileError.of(f"{unreadable} ({error})", fix=fix) from error
    if not isinstance(header, dict):
        raise ModelFileError.of(f"{path} is not a diffeo_calib model", fix=written)
    if header.get("format") != FORMAT:
        what, fix = f"{path} has format version {header.get('format')!r}", "read it with the version that wrote it"
        raise ModelFileError.of(what, expected=FORMAT, fix=fix)
    if not sealed:
        what = f"{path} was damaged or edited: its checksum does not match"
        raise ModelFileError.of(what, fix="save the model again")
    return header, arrays


def digest(header: Header, arrays: Mapping[str, Any]) -> str:
    """SHA-256 over a header (without its checksum) and the arrays, or tensors on the CPU."""
    sha = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        shape = tuple(int(size) for size in arrays[name].shape)
        sha.update(f"{name} torch.{array.dtype} {shape}".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()
