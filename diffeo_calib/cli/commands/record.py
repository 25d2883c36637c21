"""`diffeo-calib record`: a bag as a table of stops."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from diffeo_calib.cli.console import say
from diffeo_calib.cli.record import record
from diffeo_calib.common.errors import shown
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.bags import read_bag
from diffeo_calib.measurements.stops import StopLimits, stops

PLACE, TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")


def run(bag: Path, topics: tuple[str, str], output: Path, limits: StopLimits, offset: float | None) -> None:
    """Find the stops, write them, and say how to go on."""
    joints, names, seen = read_bag(bag, *topics)
    found, offset = stops(joints, seen, limits, offset)
    turned = seen.values.shape[1] > len(PLACE)
    text = io.StringIO(newline="")
    sheet = csv.writer(text, lineterminator="\n")
    sheet.writerow(["time", *names, *PLACE, *(TURN if turned else ()), *(f"std_{axis}" for axis in PLACE), "readings"])
    for one in found:
        turn = one.seen[3:] / np.linalg.norm(one.seen[3:]) if turned else one.seen[3:]
        numbers = [one.time, *one.joints, *one.seen[:3], *turn, *one.deviations[:3]]
        sheet.writerow([*map(repr, map(float, numbers)), one.count])
    write_whole(output, text.getvalue().encode())
    record.add(rows=len(found), clock_offset_s=offset, files={"table": output})
    say(f"{len(found)} stops written to {shown(output)}; {offset:.3f} s were added to the times of {topics[1]}")
    rotation = f" --rotation {','.join(TURN)} --convention quat_xyzw" * turned
    say(f"fit {shown(output)} --position {','.join(PLACE)}{rotation} --length m --angle rad ...")
