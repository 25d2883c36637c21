#!/usr/bin/env python3
"""Fetch a public data set: 632 poses of a UR10, measured with a laser tracker and a T-Mac.

    python scripts/get_ur10_data.py FOLDER                        download
    python scripts/get_ur10_data.py FOLDER --from PLACE           use a local copy: the CSV file or a folder with it
    python benchmarks/real_robots/real_robots.py --data FOLDER    compare methods on it

From the repository christianlandgraf/ipa-robot-accuracy, series D ("ISO cubes"), Copyright (c) 2021 Christian
Landgraf, MIT licence. The script writes FOLDER/ipa_ur10/: the published table, its licence, the robot's nominal
kinematics as a URDF, and a description of robot and table for the benchmark. It prints the `diffeo-calib fit` command
for them. It uses the standard library only.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import http.client
import json
import os
import shlex
import shutil
import sys
import urllib.request
from math import pi
from pathlib import Path

REPOSITORY = "https://github.com/christianlandgraf/ipa-robot-accuracy"
COMMIT = "fec27cb23c13d95761173b02e593f940919f3da3"
PLACE = "Series_D"
FILE = "measurements_iso_cubes.csv"
URL = f"https://raw.githubusercontent.com/christianlandgraf/ipa-robot-accuracy/{COMMIT}/{PLACE}/{FILE}"
SHA256 = "a49dfd2182e662e65c217b00015433f5048ebad0f04c46c33c97a5c4a5643332"
NAME = "ipa_ur10"
TIMEOUT = 30.0  # s
MOST_BYTES = 1 << 20  # the file has 162 310 bytes; a larger one is another file

LICENCE = f"""{FILE} is from {REPOSITORY}, {PLACE}.

MIT License

Copyright (c) 2021 Christian Landgraf

Permission is hereby granted, free of charge, to any person obtaining a copy
of this software and associated documentation files (the "Software"), to deal
in the Software without restriction, including without limitation the rights
to use, copy, modify, merge, publish, distribute, sublicense, and/or sell
copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all
copies or substantial portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR
IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY,
FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER
LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM,
OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE
SOFTWARE.
"""

# Rows (a, alpha, d) in m and rad, standard convention; every calibration finds base and tool.
LENGTHS = (0.0, -0.612, -0.5723, 0.0, 0.0, 0.0)
TWISTS = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)
OFFSETS = (0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922)
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
URDF = "ur10.urdf"
BASE, TIP = "base_link", "tool0"
DESCRIPTOR = {
    "robot": {"urdf": URDF, "base": BASE, "tip": TIP},
    "csv": FILE,
    "joints": [f"{joint}_joint" for joint in JOINTS],
    "position": [f"measurement_{axis}" for axis in "xyz"],
    "length": "mm",
    "angle": "rad",
    "sep": ";",
    "decimal": ",",
    "rotation": {"columns": [f"measurement_r{axis}" for axis in "xyz"], "convention": "XYZ", "angle": "deg"},
    "source": f"{REPOSITORY}, {PLACE}, Copyright (c) 2021 Christian Landgraf, MIT licence",
}


def urdf() -> str:
    """Return the robot as a URDF: joint i + 1 is at the end of row i, at Tz(d_i) Tx(a_i) Rx(alpha_i) from joint i."""
    ends = [(0.0, 0.0, 0.0), *zip(LENGTHS, TWISTS, OFFSETS, strict=True)]
    links = [BASE, *(f"{joint}_link" for joint in JOINTS), TIP]
    lines = ["<?xml version='1.0'?>", "<!-- Nominal kinematics only, from the DH table of the UR10. -->"]
    lines += ["<robot name='ur10'>", *(f" <link name='{link}'/>" for link in links)]
    for index, (a, alpha, d) in enumerate(ends):
        name, kind = (f"{JOINTS[index]}_joint", "revolute") if index < len(JOINTS) else (f"{TIP}_joint", "fixed")
        lines += [
            f" <joint name='{name}' type='{kind}'>",
            f"  <parent link='{links[index]}'/><child link='{links[index + 1]}'/>",
            f"  <origin xyz='{a!r} 0 {d!r}' rpy='{alpha!r} 0 0'/>",
        ]
        if kind == "revolute":
            lines += [f"  <axis xyz='0 0 1'/><limit lower='{-2 * pi!r}' upper='{2 * pi!r}' effort='0' velocity='0'/>"]
        lines += [" </joint>"]
    return "\n".join([*lines, "</robot>", ""])


def fit_command(folder: Path) -> str:
    """Return the command that calibrates this robot from this table, positions only."""
    table = [f"--robot {shlex.quote(str(folder / URDF))} --base {BASE} --tip {TIP}"]
    columns = ",".join(f"measurement_{axis}" for axis in "xyz")
    table += [f"--position {columns} --length mm --angle rad --sep ';' --decimal ,"]
    table += ["-o ur10.safetensors --report ur10.html"]
    return " \\\n    ".join([f"diffeo-calib fit {shlex.quote(str(folder / FILE))}", *table])


class FetchError(Exception):
    """The data set cannot be fetched; the message says why and what to do, in one sentence."""


def download(url: str) -> bytes:
    """Return the file behind a URL.

    Raises:
        FetchError: no connection, or no such file.
    """
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT) as answer:
            return answer.read(MOST_BYTES + 1)
    except (OSError, http.client.HTTPException) as error:  # URLError and time-outs are OSErrors
        reason = getattr(error, "reason", None) or error
        text = f"{url} cannot be downloaded ({reason}); get {PLACE}/{FILE} from {REPOSITORY} in another way"
        raise FetchError(f"{text} and pass --from FILE.") from error


def local(place: Path) -> bytes:
    """Return the table from a file, or from a folder or copy of the repository that contains it.

    Raises:
        FetchError: missing, or not readable.
    """
    candidates = [place] if place.is_file() else [place / FILE, place / PLACE / FILE, place / NAME / FILE]
    found = next((path for path in candidates if path.is_file()), None)
    if found is None:
        raise FetchError(f"'{place}' is neither a file nor a folder with {FILE}; pass the path of your copy.")
    try:
        with found.open("rb") as file:
            return file.read(MOST_BYTES + 1)
    except OSError as error:
        raise FetchError(f"'{found}' cannot be read ({error.strerror}); pass a readable copy.") from error


def check(content: bytes, origin: str) -> None:
    """Raise FetchError unless this is the published file, on which this project's results were measured."""
    found = hashlib.sha256(content).hexdigest()
    if found != SHA256:
        fix = "it was changed or truncated, fetch it again"
        raise FetchError(
            f"the file from {origin} is not the published one: expected SHA-256 {SHA256}, got {found}; {fix}."
        )


def write(folder: Path, content: bytes) -> Path:
    """Write the whole data set or nothing, and return its folder. Existing files are never changed.

    Raises:
        FetchError: a folder that cannot be written, or that has other contents.
    """
    target, staging = folder / NAME, folder / f".{NAME}.{os.getpid()}"
    files = {FILE: content, "LICENSE.md": LICENCE.encode(), URDF: urdf().encode(), "dataset.json": _json(DESCRIPTOR)}
    made = [path for path in (folder, *folder.parents) if not path.exists()]  # inner ones first
    try:
        if _holds(target, files):
            return target
        _check_writable(next(path for path in (folder, *folder.parents) if path.exists()))
        staging.mkdir(parents=True)
        for name, data in files.items():
            (staging / name).write_bytes(data)
        staging.rename(target)  # one step, onto nothing or an empty folder
    except OSError as error:
        shutil.rmtree(staging, ignore_errors=True)
        _remove_empty(made)
        raise FetchError(f"'{target}' cannot be written ({error.strerror}); choose another folder.") from error
    return target


def _holds(target: Path, files: dict[str, bytes]) -> bool:
    """Whether the data set exists already; other contents of the folder belong to the user."""
    if not target.is_dir() or not any(target.iterdir()):
        return False
    if all((target / name).is_file() and (target / name).read_bytes() == data for name, data in files.items()):
        return True
    raise FetchError(f"'{target}' exists with other contents; choose another folder, or remove it first.")


def _check_writable(folder: Path) -> None:
    """Respect a folder that is marked read-only, although the system lets an administrator write to it."""
    if not folder.stat().st_mode & 0o222:
        raise PermissionError(errno.EACCES, "it is read-only")


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:  # missing, or not empty: not ours
            return


def _json(value: object) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()


def fetch(folder: Path, source: Path | None) -> Path:
    """Get, check and write the data set; return its folder."""
    content = download(URL) if source is None else local(source)
    check(content, URL if source is None else f"'{source}'")
    return write(folder, content)


def main(given: list[str] | None = None) -> None:
    """Run; a failure prints one sentence and exits with code 1."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help=f"folder of data sets; {NAME}/ is made in it")
    parser.add_argument("--from", dest="source", type=Path, metavar="PLACE", help="a local copy of the CSV")
    arguments = parser.parse_args(given)
    try:
        target = fetch(arguments.folder, arguments.source)
    except FetchError as error:
        sys.exit(f"error: {error}")
    print(f"wrote {target}: 632 poses of a UR10 from {REPOSITORY} ({PLACE}), MIT licence, see its LICENSE.md")
    print("now calibrate it (less than a minute; 0.11 mm RMS in held-out rows):")
    print(f"\n  {fit_command(target)}\n")
    print(f"or compare methods: python benchmarks/real_robots/real_robots.py --data {arguments.folder} --quick")


if __name__ == "__main__":
    main()
