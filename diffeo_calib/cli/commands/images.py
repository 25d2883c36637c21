"""`diffeo-calib images`: folders of images as a table of corners; `record`: a ROS bag as a table of its stops."""

from __future__ import annotations

import shlex
from pathlib import Path

from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.detection import Board
from diffeo_calib.cameras.files import camera_text
from diffeo_calib.cli.console import progress_bar, record, say
from diffeo_calib.cli.declarations import ImagesOptions, RecordOptions
from diffeo_calib.cli.tables import stated_numbers
from diffeo_calib.common.checks import check_number
from diffeo_calib.common.errors import shown
from diffeo_calib.common.files import write_together, write_whole
from diffeo_calib.measurements.bags import read_bag, read_images
from diffeo_calib.measurements.csv.cells import csv_text
from diffeo_calib.measurements.csv.joined import PLACE, TURN, StopLimits, pictured, rows_of, stops
from diffeo_calib.measurements.csv.sensors import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.image_folders import page, read_folders
from diffeo_calib.measurements.table_format import TableFormat, options_of


def run(given: ImagesOptions) -> None:
    """Find the board, and write corners, cameras and overview."""
    output, table = given.output, TableFormat(given.length, "rad", given.sep, given.decimal)
    with progress_bar() as progress:
        found = read_folders(given.folders, given.joints, Board.of(given.board), table.sep, progress)
    several = len(found) > 1
    lines = [[IMAGE, *found[0].header, *POINT, *PIXEL, *[CAMERA] * several]]
    cameras, contents, refused = dict[str, Path](), dict[Path, bytes](), dict[str, str]()
    for folder in found:
        lines += [[*cells, *[folder.name] * several] for cells in folder.rows(table.per_metre, table.decimal)]
        cameras[folder.name] = output.with_name(f"{folder.name}.yaml") if several else output.with_suffix(".yaml")
        contents[cameras[folder.name]] = camera_text(folder.camera(BoardPrior(scale=given.board_std))).encode()
        why = {f"{folder.name}/{image.name}" if several else image.name: image.refused for image in folder.images}
        refused |= {name: reason for name, reason in why.items() if reason}
    contents[output] = csv_text(lines, table.sep, "\r\n").encode()
    if given.report is not None:
        contents[given.report] = page(found).encode()
    write_together(contents)
    for name, reason in refused.items():
        say(f"{name}: {reason}: left out")
    for folder in found:
        width, height = folder.size
        used = f"{len(folder.used)} of {len(folder.images)} images of {width} x {height} pixels"
        if folder.paired:
            say(f"{f'{folder.name}: ' * several}{folder.paired}")
        corners = sum(len(image.numbers) for image in folder.used)
        say(f"{f'{folder.name}: ' * several}{used}, {corners} corners: {shown(output)}")
    options = " ".join(f"--reading corners={shown(path)}" for path in cameras.values())
    say(f"fit {shown(output)} ... {options}" + ", with --camera-on-tool if the camera is on the tool" * (not several))
    rows, files = sum(len(one.used) for one in found), {"camera": cameras[found[0].name]} if not several else cameras
    record.add(rows=rows, refused=refused, files={"table": output, **files})


def run_record(given: RecordOptions) -> None:
    """Find the stops, write them, and say how to go on."""
    output, offset = given.output, given.offset
    values = stated_numbers("--still", given.still, (1, 2), "MOTION, or MOTION,SECONDS such as 0.001,0.5")
    for value in values:
        check_number(value, "--still", above=0.0)
    check_number(offset or 0.0, "--offset", above=-1e12, below=1e12)
    limits = StopLimits(**dict(zip(("joints", "shortest"), values, strict=False)))
    joints, names, readings = read_bag(given.bag, given.joints, given.seen)
    if readings.values.shape[1]:
        at_stops, offset = stops(joints, readings, limits, offset)
        table = rows_of(names, at_stops)
        write_whole(output, csv_text([list(table[0]), *(row.values() for row in table)]).encode())
        say(f"{len(at_stops)} stops written to {shown(output)}; {offset:.3f} s were added to the times of {given.seen}")
        if readings.values.shape[1] > len(PLACE) and TURN[0] not in table[0]:
            say(f"without rotations: those of {given.seen} never change, as of a device that measures none")
        turned = {"rotation": [TURN], "convention": "quat_xyzw"} if TURN[0] in table[0] else {}
        say(f"fit {shown(output)} {shlex.join(options_of(TableFormat('m', 'rad', position=PLACE, **turned)))} ...")
    else:
        offset = offset or 0.0
        at_stops, without = pictured(joints, readings.times, limits, offset)
        times, files = [time for _, time in at_stops], dict[float, str]()
        for time, suffix, content in read_images(given.bag, given.seen, times):
            files[time] = f"{times.index(time):05d}{suffix}"
            write_whole(output.parent / files[time], content)
        rows = [{IMAGE: files[time], **dict(zip(names, q.tolist(), strict=True))} for q, time in at_stops]
        write_whole(output, csv_text([list(rows[0]), *(row.values() for row in rows)]).encode())
        left = f"; {without} stops without an image were left out" * bool(without)
        say(f"{len(at_stops)} images of stops written beside {shown(output)}{left}")
        say(f"images {shown(output.parent)} {shown(output)} --board ... --length m -o corners.csv")
    record.add(rows=len(at_stops), clock_offset_s=offset, files={"table": output})
