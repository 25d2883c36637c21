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
from typing import Any

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
DESCRIPTOR: dict[str, Any] = {
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
    turning = f"  <axis xyz='0 0 1'/><limit lower='{-2 * pi!r}' upper='{2 * pi!r}' effort='0' velocity='0'/>"
    joints = [*((joint, "revolute", turning) for joint in JOINTS), (TIP, "fixed", "")]
    lines = ["<?xml version='1.0'?>", "<!-- Nominal kinematics only, from the DH table of the UR10. -->"]
    lines += ["<robot name='ur10'>", *(f" <link name='{link}'/>" for link in links)]
    for parent, child, (a, alpha, d), (name, kind, more) in zip(links, links[1:], ends, joints, strict=False):
        lines += [
            f" <joint name='{name}_joint' type='{kind}'>",
            f"  <parent link='{parent}'/><child link='{child}'/>",
            f"  <origin xyz='{a!r} 0 {d!r}' rpy='{alpha!r} 0 0'/>{more}",
            " </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def content_of(source: Path | None) -> bytes:
    """The published table: downloaded, or from a file, a folder, or a copy of the repository.

    Exits with a sentence if there is none, or if it is not the file on which this project's results were measured.
    """
    try:
        if source is None:
            with urllib.request.urlopen(URL, timeout=TIMEOUT) as answer:
                content = answer.read(MOST_BYTES + 1)
        else:
            places = [source, source / FILE, source / PLACE / FILE, source / NAME / FILE]
            found = next((path for path in places if path.is_file()), None)
            if found is None:
                sys.exit(f"error: '{source}' is neither a file nor a folder with {FILE}; pass the path of your copy.")
            content = found.read_bytes()[: MOST_BYTES + 1]
    except (OSError, http.client.HTTPException) as error:  # URLError and time-outs are OSErrors
        text = f"{source or URL} cannot be read ({getattr(error, 'reason', None) or error})"
        sys.exit(f"error: {text}; get {PLACE}/{FILE} from {REPOSITORY} in another way and pass --from FILE.")
    if (digest := hashlib.sha256(content).hexdigest()) != SHA256:
        fix = f"expected SHA-256 {SHA256}, got {digest}; it was changed or truncated, fetch it again."
        sys.exit(f"error: the file from {source or URL} is not the published one: {fix}")
    return content


def write(folder: Path, content: bytes) -> Path:
    """Write the whole data set or nothing, and return its folder. Existing files are never changed."""
    target, staging = folder / NAME, folder / f".{NAME}.{os.getpid()}"
    described = (json.dumps(DESCRIPTOR, indent=1) + "\n").encode()
    files = {FILE: content, "LICENSE.md": LICENCE.encode(), URDF: urdf().encode(), "dataset.json": described}
    try:
        if target.is_dir() and any(target.iterdir()):
            if any(not (own := target / name).is_file() or own.read_bytes() != data for name, data in files.items()):
                sys.exit(f"error: '{target}' exists with other contents; choose another folder, or remove it first.")
            return target
        staging.mkdir(parents=True)
        for name, data in files.items():
            (staging / name).write_bytes(data)
        staging.rename(target)  # one step, onto nothing or an empty folder
    except OSError as error:
        shutil.rmtree(staging, ignore_errors=True)
        sys.exit(f"error: '{target}' cannot be written ({error.strerror}); choose another folder.")
    return target


def main(given: list[str] | None = None) -> None:
    """Run; a failure prints one sentence and exits with code 1."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help=f"folder of data sets; {NAME}/ is made in it")
    parser.add_argument("--from", dest="source", type=Path, metavar="PLACE", help="a local copy of the CSV")
    arguments = parser.parse_args(given)
    target = write(arguments.folder, content_of(arguments.source))
    print(f"wrote {target}: 632 poses of a UR10 from {REPOSITORY} ({PLACE}), MIT licence, see its LICENSE.md")
    table, robot = (shlex.quote(str(target / name)) for name in (FILE, URDF))
    columns = ",".join(DESCRIPTOR["position"])
    print(f"""now calibrate it (less than a minute; 0.11 mm RMS in held-out rows):

  diffeo-calib fit {table} \\
    --robot {robot} --base {BASE} --tip {TIP} \\
    --position {columns} --length mm --angle rad --sep ';' --decimal , \\
    -o ur10.safetensors --report ur10.html

or compare methods: python benchmarks/real_robots/real_robots.py --data {arguments.folder} --quick""")


if __name__ == "__main__":
    main()
