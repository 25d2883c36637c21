"""`diffeo-calib record`: a bag as a table of stops, or as the images of stops and their joint values."""

from __future__ import annotations

import shlex

from diffeo_calib.cli.console import say
from diffeo_calib.cli.options import Command
from diffeo_calib.cli.record import record
from diffeo_calib.common.errors import shown
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.bags import read_bag, read_images
from diffeo_calib.measurements.csv.images import IMAGE
from diffeo_calib.measurements.csv.writing import csv_text
from diffeo_calib.measurements.stops import PLACE, TURN, StopLimits, pictured, rows_of, stops
from diffeo_calib.measurements.table_format import TableFormat, options_of


def run(given: Command) -> None:
    """Find the stops, write them, and say how to go on."""
    output, offset, limits = given.output, given.offset, StopLimits(joints=given.still, shortest=given.shortest)
    joints, names, seen = read_bag(given.bag, given.joints, given.seen)
    if seen.values.shape[1]:
        found, offset = stops(joints, seen, limits, offset)
        table = rows_of(names, found)
        write_whole(output, csv_text([list(table[0]), *(row.values() for row in table)], ",", "\n"))
        say(f"{len(found)} stops written to {shown(output)}; {offset:.3f} s were added to the times of {given.seen}")
        if seen.values.shape[1] > len(PLACE) and TURN[0] not in table[0]:
            say(f"without rotations: those of {given.seen} never change, as of a device that measures none")
        turned = {"rotation": [TURN], "convention": "quat_xyzw"} if TURN[0] in table[0] else {}
        say(f"fit {shown(output)} {shlex.join(options_of(TableFormat('m', 'rad', position=PLACE, **turned)))} ...")
    else:
        offset = offset or 0.0
        found, without = pictured(joints, seen.times, limits, offset)
        times, files = [time for _, time in found], dict[float, str]()
        for time, suffix, content in read_images(given.bag, given.seen, times):
            files[time] = f"{times.index(time):05d}{suffix}"
            write_whole(output.parent / files[time], content)
        rows = [{IMAGE: files[time], **dict(zip(names, q.tolist(), strict=True))} for q, time in found]
        write_whole(output, csv_text([list(rows[0]), *(row.values() for row in rows)], ",", "\n"))
        left = f"; {without} stops without an image were left out" * bool(without)
        say(f"{len(found)} images of stops written beside {shown(output)}{left}")
        say(f"images {shown(output.parent)} {shown(output)} --board ... --length m -o corners.csv")
    record.add(rows=len(found), clock_offset_s=offset, files={"table": output})
