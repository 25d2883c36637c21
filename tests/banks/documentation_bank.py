"""Tables under the names that README and site use, and the outputs that tutorials show."""

import os
import re
import runpy
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import get_ur10_data
import torch
from commanded_bank import bent, drawn, flange, seen, write_columns
from init_bank import write_socket_table, write_wire_table
from product_bank import simulated, simulated_poses

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import TableFormat

POSES = Path(__file__).parents[2] / "scripts/docs/pages/howto/poses.md"

OFFSET = 5e-4
"""Of the second joint since the first calibration, rad."""
COMMAND = re.compile(r"^    (diffeo-calib (?:.*\\\n)*.*)\n(?:\n```text\n((?:(?!```).*\n)*)```\n)?", re.MULTILINE)
"""A command of a page, and the output below it."""
CUT = "..."


def write_tables(place: Path, rows: int = 100) -> None:
    """A simulated arm, and tables of its measurements, of this many rows for the fit."""
    arm, train, test = simulated(rows)
    arm.write_urdf(place / "robot.urdf")
    names, table = arm.nominal.joint_names, TableFormat("mm", "deg")
    later = test.q.clone()
    later[:, 1] -= OFFSET
    changed = dc.Measurements(later, test.points)
    for name, data in (
        ("measurements", train),
        ("other", test[:60]),
        ("joints", test[:60]),
        ("program", test[:40]),
        ("new", changed[:20]),
        ("check", changed[20:40]),
    ):
        write_measurements(place / f"{name}.csv", data.with_joint_names(names), table)
    write_socket_table(place / "block.csv", arm, "01", 0, places=6, rows=20)
    write_wire_table(place / "wire.csv", arm, 0)
    posed = simulated_poses(30)[1]
    rotation = replace(table, rotation=["rx", "ry", "rz"], convention="XYZ", rotation_angle="deg")
    write_measurements(place / "poses.csv", posed, rotation)
    write_commanded_tables(place)
    source = os.environ.get("DIFFEO_CALIB_DATA")
    if source:
        get_ur10_data.main([str(place / "data"), "--from", str(Path(source) / "ipa_ur10")])


def write_commanded_tables(place: Path) -> None:
    """Of flange poses with those of a board, and of places of a gantry."""
    commanded = flange()
    hand_eye = seen(commanded, camera_on_tool=True)
    turns = [rotation_numbers(own[:, :3, :3], *how) for own, how in ((commanded, ("xyz",)), (hand_eye, ("quat_xyzw",)))]
    poses = {"X_Y_Z": 1e3 * commanded[:, :3, 3], "RX_RY_RZ": turns[0].rad2deg()}
    write_columns(place / "flange.csv", **poses, tx_ty_tz=1e3 * hand_eye[:, :3, 3], qx_qy_qz_qw=turns[1])
    places = torch.rand(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    write_columns(
        place / "machine.csv", cmdx_cmdy_cmdz=1e3 * places, x_y_z=1e3 * (bent(places) + 2e-5 * drawn(40, 3, seed=2))
    )
    delta = runpy.run_path(str(write_delta(place)))["kinematics"]
    q = 5.0 + 50.0 * torch.rand(40, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    seen_there = 1.001 * delta(q + torch.tensor([0.1, -0.05, 0.08])) + 0.03 * drawn(40, 3, seed=4)
    write_columns(place / "delta.csv", q1_q2_q3=q, x_y_z=seen_there)
    write_columns(place / "targets.csv", q1_q2_q3=q[:5])


def write_delta(place: Path) -> Path:
    """The delta robot of the page about commanded poses."""
    path, text = place / "my_delta.py", POSES.read_text(encoding="utf-8")
    path.write_text(text.partition("```python\n")[2].partition("```")[0], encoding="utf-8")
    return path


def commands(text: str) -> list[str]:
    """The commands of a page, a line each."""
    return [one_line(found[1]) for found in COMMAND.finditer(text)]


def one_line(command: str) -> str:
    return " ".join(command.replace("\\\n", " ").split())


def shown_outputs(text: str) -> dict[str, list[str]]:
    """The outputs of a page's commands that it shows, line by line, without the marks of what was cut."""
    found = {one_line(one[1]): one[2] for one in COMMAND.finditer(text) if one[2]}
    return {command: [line for line in output.splitlines() if line != CUT] for command, output in found.items()}


def with_outputs(text: str, output_of: Callable[[str], list[str]]) -> str:
    """The page with the outputs of its commands anew."""

    def block(found: re.Match[str]) -> str:
        lines = output_of(one_line(found[1]))
        return f"    {found[1]}\n\n```text\n" + "".join(f"{line}\n" for line in shortened(lines)) + "```\n"

    return COMMAND.sub(block, text)


MOST_LINES, LAST = 18, 4


def shortened(lines: list[str]) -> Iterator[str]:
    """At most so many of the lines that are not empty, and a mark where some are missing."""
    lines = [line.rstrip() for line in lines if line.strip()]
    if len(lines) <= MOST_LINES:
        yield from lines
        return
    yield from [*lines[: MOST_LINES - LAST], CUT, *lines[-LAST:]]


def words(line: str) -> tuple[str, ...]:
    """The first words of a line, numbers left out: what does not depend on the processor."""
    return tuple(re.sub(r"[-+]?\d[\d.e+-]*", "#", line).split()[:3])
